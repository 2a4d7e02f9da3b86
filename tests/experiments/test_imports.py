"""Modules of a person's own: named on the command line, kept in the run, asked for again, and never imported because a
file says so.
"""

import importlib
import json
import shutil
import sys
from pathlib import Path

import gymnasium
import pytest

import envs
from experiments import calibrate, compare, render, run
from experiments.runs.directory import RunDirectory
from experiments.runs.errors import RunError
from jaxplore.methods import METHODS
from tests.experiments import tiny

OWN = """
import gymnasium, numpy as np
from gymnasium import spaces
import envs
from jaxplore import METHODS
from tests.experiments.tiny import make_point

envs.FACTORIES["own_point"] = make_point
METHODS["own_random"] = METHODS["random"]

class Own(gymnasium.Env):
    observation_space, action_space = spaces.Box(-9.0, 9.0, (2,)), spaces.Box(-1.0, 1.0, (1,))

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return np.zeros(2, np.float32), {}

    def step(self, action):
        return np.ones(2, np.float32), 0.0, False, False, {}

gymnasium.register("own/Own-v0", Own, max_episode_steps=10)
"""


@pytest.fixture
def own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """The name of a module that has not been imported, and `forget()`, after which it has not been again."""
    name = "module_of_my_own"
    (tmp_path / f"{name}.py").write_text(OWN)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(envs, "FACTORIES", dict(envs.FACTORIES))

    def forget():
        sys.modules.pop(name, None)
        envs.FACTORIES.pop("own_point", None)
        METHODS.pop("own_random", None)
        gymnasium.registry.pop("own/Own-v0", None)
        importlib.invalidate_caches()

    yield name, forget
    forget()


def test_a_run_remembers_its_modules_and_every_command_asks_for_them(own, tell, tmp_path: Path, capsys, monkeypatch):
    name, forget = own
    out = tmp_path / "run"
    told = tell(out, f"--import={name}", "--env=own_point", "--method=own_random", *tiny.RUN)
    assert told.status == 0, told.stderr
    assert json.loads((out / "config.json").read_text())["imports"] == [name]
    assert RunDirectory(out).spec().imports == (name,)
    forget()
    expected = f"needs the module {name}, and importing it runs it. What to do: if you trust it, give --import={name}."
    commands = {
        "resume": lambda *words: run.main([f"--out={out}", "--resume", *words]),
        "config": lambda *words: run.main([f"--config={out / 'config.json'}", f"--out={tmp_path / 'again'}", *words]),
        "compare": lambda *words: compare.main([str(out), f"--out={tmp_path / 'comparison'}", *words]),
        "calibrate": lambda *words: calibrate.main([str(out), *words]),
        "render": lambda *words: render.main([str(out), *words]),
    }
    monkeypatch.setattr(render, "import_mujoco", lambda: None)
    for command, call in commands.items():
        assert call() in (1, 2), command
        assert expected in capsys.readouterr().err, command
        assert name not in sys.modules, command
    for command, status in (("resume", 0), ("config", 0), ("compare", 0), ("calibrate", 1), ("render", 1)):
        assert commands[command](f"--import={name}") == status, command
        told = capsys.readouterr().err
        assert "needs the module" not in told
        assert status == 0 or "has no belief to ask" in told or "nothing to draw" in told
        forget()


def test_a_name_that_a_file_gives_imports_nothing(own, tell, tmp_path: Path, capsys):
    # somebody else's run: its environment is in a module
    name, forget = own
    out = tmp_path / "run"
    env = f"gymnasium:{name}:own/Own-v0"
    assert tell(out, f"--env={env}", "--method=random", *tiny.RUN).status == 0, "the person's own words"
    saved = json.loads((out / "config.json").read_text())
    assert (saved["env"], saved["imports"]) == (env, [name])
    forget()
    for field in ("imports", "identity"):
        del saved[field]
    foreign = tmp_path / "foreign"
    shutil.copytree(out, foreign)
    (foreign / "config.json").write_text(json.dumps(saved))
    with pytest.raises(RunError, match=f"needs the module {name}"):
        RunDirectory(foreign).spec()
    assert compare.main([str(foreign), f"--out={tmp_path / 'comparison'}"]) == 1
    assert name not in sys.modules
    assert f"give --import={name}" in capsys.readouterr().err
    assert tell(foreign, "--resume", f"--import={name}").status == 0


def test_a_module_that_cannot_be_imported_is_named(tell, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    (tmp_path / "broken_module.py").write_text("1 / 0")
    monkeypatch.syspath_prepend(tmp_path)
    for name, error in (("broken_module", "ZeroDivisionError: division by zero"), ("no_such", "ModuleNotFoundError")):
        told = tell(tmp_path / "run", f"--import={name}", "--env=acrobot")
        assert told.status == 2
        assert f"error: --import={name}: cannot import it ({error}" in told.stderr
    assert not (tmp_path / "run").exists()


def test_imports_that_are_no_names_are_refused(tell, tmp_path: Path):
    path = tmp_path / "c.json"
    path.write_text('{"preset": "smoke", "imports": "os"}')
    told = tell(tmp_path / "run", f"--config={path}")
    assert told.status == 2
    assert "imports='os'. Allowed: a list of names of modules." in told.stderr
