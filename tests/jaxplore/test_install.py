"""What is installed: the wheel's files, what it renames, and what runs from it where there is no checkout."""

import ast
import importlib
import json
import os
import re
import subprocess
import sys
import textwrap
import zipfile
from pathlib import Path

import gymnasium
import pytest
from gymnasium.envs.registration import load_env_creator

import envs
from envs.adapters.to_gymnasium import GymnasiumEnv, gymnasium_id
from jaxplore._install import startup
from jaxplore._install.wheel import AT_START, FOLDERS, rename, sources

ROOT = Path(__file__).parent.parent.parent


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("wheel")
    subprocess.run(
        [sys.executable, "-m", "hatchling", "build", "--target=wheel", f"--directory={out}"],
        cwd=ROOT,
        check=True,
        capture_output=True,
    )
    (path,) = out.glob("*.whl")
    return path


def test_the_wheel_holds_the_folders_below_one_name(wheel: Path):
    with zipfile.ZipFile(wheel) as archive:
        names = archive.namelist()
        top = {name.partition("/")[0] for name in names}
        (info,) = [name for name in top if name.endswith(".dist-info")]
        assert top == {"jaxplore", "jaxplore.pth", "_jaxplore_gymnasium.py", info}
        assert len(names) == len(set(names))
        held = {name.removeprefix("jaxplore/") for name in names if re.match(r"jaxplore/(envs|experiments)/", name)}
        assert held == {path.as_posix() for path in sources(ROOT)}
        assert not [name for name in names if re.search(r"_install|results|jaxplore/(envs|experiments)\.py", name)]
        assert archive.read("jaxplore.pth").decode() == AT_START
        own = {path.relative_to(ROOT).as_posix() for path in (ROOT / "jaxplore").rglob("*.py")}
        left_out = {name for name in own - set(names)}
        assert all(re.match(r"jaxplore/(_install/|envs\.py|experiments\.py)", name) for name in left_out)


def test_nothing_in_the_wheel_imports_or_names_the_folders_by_themselves(wheel: Path):
    with zipfile.ZipFile(wheel) as archive:
        code = {name: archive.read(name).decode() for name in archive.namelist() if name.endswith(".py")}
    assert len(code) > 90
    for name, text in code.items():
        for node in ast.walk(ast.parse(text)):
            modules = [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
            modules += [str(node.module)] if isinstance(node, ast.ImportFrom) else []
            assert not [module for module in modules if module.partition(".")[0] in FOLDERS], name
            if isinstance(node, ast.Constant) and isinstance(node.value, str):
                assert not re.search(r"(?<![.\w])(envs|experiments)\.[A-Za-z_]", node.value), (name, node.value)
                assert not re.search(r"-m (envs|experiments)|import (envs|experiments)\b", node.value), name
                assert "-e ." not in node.value, name


def test_a_module_keeps_its_lines_and_everything_else(wheel: Path):
    # a renamed file differs from its source in the names alone
    with zipfile.ZipFile(wheel) as archive:
        for path in sources(ROOT):
            own, installed = (ROOT / path).read_text(), archive.read(f"jaxplore/{path.as_posix()}").decode()
            own = re.sub(r'pip install -e (\\?["\'])\.', r"pip install \1jaxplore", own)
            assert short(installed) == short(own), path
            assert len(installed.splitlines()) == len(own.splitlines())


def short(code: str) -> str:
    code = re.sub(r"from jaxplore import (envs|experiments)\b", r"import \1", code)
    return re.sub(r"jaxplore\.(?=(envs|experiments)\b)", "", code)


@pytest.mark.parametrize(
    ("source", "expected"),
    [
        ("import envs", "from jaxplore import envs"),
        ("def f():\n    import envs\n", "def f():\n    from jaxplore import envs\n"),
        ("import envs.base as base", "import jaxplore.envs.base as base"),
        ("from envs import (\n    a,\n    b,\n)", "from jaxplore.envs import (\n    a,\n    b,\n)"),
        ("from experiments.runs import a; b = 1", "from jaxplore.experiments.runs import a; b = 1"),
        ("x = 'é'; from envs import a", "x = 'é'; from jaxplore.envs import a"),
        ("a = {'mjx': 'envs.engines.mjx'}", "a = {'mjx': 'jaxplore.envs.engines.mjx'}"),
        ("a = f'python -m experiments.{name} x'", "a = f'python -m jaxplore.experiments.{name} x'"),
        ("'''After `import envs`.'''", "'''After `import jaxplore.envs`.'''"),
        ("""a = 'pip install -e ".[render]"'""", """a = 'pip install "jaxplore[render]"'"""),
        # what looks like them, and is not
        ("from brax import envs", "from brax import envs"),
        ("from .envs import a", "from .envs import a"),
        ("import brax.envs", "import brax.envs"),
        ("a = 'brax.envs.x', 'envs/ant.py'", "a = 'brax.envs.x', 'envs/ant.py'"),
        ("envs.make(x)  # envs.make", "envs.make(x)  # envs.make"),
    ],
)  # fmt: skip
def test_names_are_changed_where_they_are_ours(source: str, expected: str):
    assert rename(source) == expected


@pytest.mark.parametrize("source", ["import envs.base", "import os, envs", "f'{envs.make}'"])
def test_what_cannot_be_renamed_stops_the_build(source: str):
    with pytest.raises(ValueError, match=r"^a\.py, line 1: .* Allowed: "):
        rename(source, "a.py")


def test_gymnasium_is_told_of_every_environment_before_it_is_imported():
    assert {gymnasium_id(name): name for name in envs.FACTORIES} == startup.IDS
    for env_id, name in startup.IDS.items():
        spec = gymnasium.spec(env_id)
        assert spec.kwargs == {"name": name}
        # in a checkout by either name, whether the start-up hook is installed or not
        assert isinstance(spec.entry_point, str) and load_env_creator(spec.entry_point) is GymnasiumEnv
    assert startup.ENTRY_POINT == "jaxplore.envs.adapters.to_gymnasium:GymnasiumEnv"


WAITS = """
import sys
before = set(sys.modules)
from startup import Waiting, wait
assert not {name.partition(".")[0] for name in set(sys.modules) - before} - {"startup"}
import importlib.util
wait()
wait()
sys.meta_path.insert(1, Waiting())  # of another copy
assert importlib.util.find_spec("gymnasium") and "gymnasium" not in sys.modules
import gymnasium
assert gymnasium.spec("jaxplore/NChain-v0").entry_point.startswith("jaxplore.envs.")
assert not any(isinstance(one, Waiting) for one in sys.meta_path) and "jax" not in sys.modules
"""


def test_waiting_for_gymnasium_costs_nothing_and_ends_with_it():
    path = ROOT / "jaxplore/_install"
    done = subprocess.run([sys.executable, "-c", WAITS], env={**os.environ, "PYTHONPATH": str(path)})
    assert done.returncode == 0


def test_a_checkout_has_the_wheels_names_for_the_same_modules():
    for name in ("envs", "envs.base", "envs.adapters.from_brax", "experiments", "experiments.runs.errors"):
        own = importlib.import_module(name)
        assert importlib.import_module(f"jaxplore.{name}") is own
        assert own.__spec__ is not None and own.__spec__.name == name
    from jaxplore.experiments.runs.errors import RunError  # pyright: ignore[reportMissingImports]

    assert RunError.__module__ == "experiments.runs.errors"
    with pytest.raises(ModuleNotFoundError, match=r"jaxplore\.envs\.none"):
        importlib.import_module("jaxplore.envs.none")
    done = subprocess.run(
        [sys.executable, "-m", "jaxplore.experiments.export", "--help"], cwd=ROOT, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith("usage: python -m experiments.export")


@pytest.fixture(scope="module")
def python(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The interpreter of an environment with the wheel, the packages installed here, and no checkout."""
    venv = tmp_path_factory.mktemp("clean") / "venv"
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", venv], check=True)
    python = venv / ("Scripts/python.exe" if os.name == "nt" else "bin/python")
    pip = (sys.executable, "-m", "pip", f"--python={python}", "install", "--no-deps", "--no-index", "--quiet")
    subprocess.run([*pip, wheel], check=True)
    (packages,) = venv.rglob("site-packages")
    # Their own .pth files, the checkout's among them, are not read from there.
    others = [path for path in sys.path if Path(path) != ROOT and any(Path(path).glob("*.dist-info"))]
    (packages / "others.pth").write_text("".join(f"{path}\n" for path in others))
    return python


def carry_out(python: Path, code: str, folder: Path) -> str:
    """What a script prints, in a folder of its own; what it raises fails the test."""
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    script = ("-W", "error::UserWarning:gymnasium", "-c", textwrap.dedent(code))
    done = subprocess.run([python, *script], cwd=folder, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return done.stdout


GYMNASIUM = """
    import sys
    import gymnasium

    assert not {"jax", "jaxplore", "envs"} & set(sys.modules)
    env = gymnasium.make("jaxplore/AntMaze-v0", backend="mujoco")
    obs, info = env.reset(seed=0)
    for _ in range(10):
        obs, reward, terminated, truncated, info = env.step(env.action_space.sample())
    assert obs.shape == (31,) and info["coverage_cell"] == 0

    import jaxplore.envs

    assert type(env.unwrapped) is jaxplore.envs.to_gymnasium.GymnasiumEnv

    from jaxplore.envs.wrappers import IntrinsicConfig, IntrinsicReward

    env = IntrinsicReward(env, IntrinsicConfig(warm_up_steps=5, fit_every=5))
    env.reset(seed=0)
    rewards = [env.step(env.action_space.sample())[1] for _ in range(10)]
    assert rewards[:5] == [0.0] * 5 and min(rewards[5:]) > 0
    assert jaxplore.envs.make("nchain").spec.obs_size == 40 and "envs" not in sys.modules
    assert "site-packages" in jaxplore.__file__ and not {"envs", "experiments"} & set(sys.modules)
"""
BRAX = """
    import jax
    import jaxplore
    from brax import envs

    policy = jaxplore.load_policy("brax")
    env = envs.get_environment("inverted_pendulum", backend="spring")

    def step(state, key):
        state = env.step(state, policy.act_jax(key, state.obs))
        return state, state.reward

    first = jax.jit(env.reset)(jax.random.PRNGKey(0))
    _, rewards = jax.jit(lambda state: jax.lax.scan(step, state, jax.random.split(jax.random.key(1), 20)))(first)
    assert rewards.shape == (20,)
"""
POLICY = """
    import gymnasium
    import jaxplore

    policy = jaxplore.load_policy("ant")
    env = gymnasium.make("jaxplore/AntMaze-v0", backend="mujoco")
    obs, _ = env.reset(seed=0)
    for _ in range(10):
        obs, *_ = env.step(policy.act(obs))
    print(policy)
"""
BASELINES = """
    import gymnasium
    import jaxplore
    from stable_baselines3.common.evaluation import evaluate_policy

    policy = jaxplore.load_policy("ant")
    env = gymnasium.wrappers.TimeLimit(gymnasium.make("jaxplore/AntMaze-v0", backend="mujoco"), 10)
    print(*evaluate_policy(policy, env, n_eval_episodes=2, warn=False))
"""


@pytest.mark.slow
def test_the_examples_run_from_the_wheel(python: Path, tmp_path: Path):
    from tests.experiments.tiny import tiny_flags

    carry_out(python, GYMNASIUM, tmp_path)
    for name, method, out in (("ant_maze", "implicit", "ant"), ("brax:inverted_pendulum", "sac", "brax")):
        backend = "spring" if out == "brax" else "mujoco"
        words = [f"--env={name}", f"--backend={backend}", f"--method={method}", f"--out={out}", *tiny_flags(method)]
        code = f"import sys\nfrom jaxplore.experiments import run\nsys.exit(run.main({words!r}))"
        printed = carry_out(python, code, tmp_path)
        assert "python -m experiments" not in printed
        assert json.loads((tmp_path / out / "config.json").read_text())["env"] == name
    carry_out(python, BRAX, tmp_path)
    printed = carry_out(python, POLICY, tmp_path)
    assert printed == "Policy of implicit on ant_maze, seed 0, after 81 steps\n"
    help_text = subprocess.run(
        [python, "-m", "jaxplore.experiments.run", "--help"], cwd=tmp_path, capture_output=True, text=True, check=True
    )
    assert help_text.stdout.startswith("usage: python -m jaxplore.experiments.run")


@pytest.mark.slow
def test_the_stable_baselines3_example_runs_from_the_wheel(python: Path, tmp_path: Path):
    pytest.importorskip("stable_baselines3")
    from tests.experiments.tiny import tiny_flags

    words = ["--env=ant_maze", "--out=ant", *tiny_flags("implicit")]
    carry_out(python, f"from jaxplore.experiments import run\nassert run.main({words!r}) == 0", tmp_path)
    assert carry_out(python, BASELINES, tmp_path) == "0.0 0.0\n"
