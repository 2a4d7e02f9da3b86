"""The README is a manual: its code runs, its tables are complete, its map is the tree, its links lead somewhere."""

import importlib.util
import inspect
import json
import re
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest

import envs
import jaxplore
from jaxplore.config import ExplorationConfig, Sizes
from jaxplore.exploration import make_explorer
from jaxplore.methods import METHODS

ROOT = Path(__file__).parent.parent
PACKAGES = ("jaxplore", "envs", "experiments", "benchmarks")
README = (ROOT / "README.md").read_text()
PAGES = ("README.md", "experiments/results/README.md", "experiments/training/README.md", "benchmarks/README.md")


def example(word: str) -> str:
    """The README's one Python example with `word` in it."""
    (code,) = [code for code in re.findall(r"```python\n(.*?)```", README, re.DOTALL) if word in code]
    return code


def section(title: str) -> str:
    """The README's section of this title, without it."""
    (text,) = re.findall(rf"\n## {title}\n(.*?)(?=\n## |\Z)", README, re.DOTALL)
    return text


def first_column(text: str) -> list[str]:
    """The names in backticks in the first column of a section's tables, heads left out."""
    lines = text.splitlines()
    rows = [row for row, after in zip(lines, [*lines[1:], ""], strict=True) if not after.startswith("| ---")]
    return re.findall(r"`([^`]+)`", " ".join(row.split("|")[1] for row in rows if row.startswith("| `")))


def test_it_is_short():
    assert len(README.splitlines()) <= 200


@pytest.mark.slow
def test_an_environment_of_your_own_takes_30_lines_and_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(envs, "FACTORIES", dict(envs.FACTORIES))
    code = example("make_puck")
    assert len([line for line in code.splitlines() if line.strip()]) <= 30
    exec(code, {})
    (run,) = (tmp_path / "runs").iterdir()
    assert (run / "visitation.png").is_file()
    last = json.loads((run / "metrics.jsonl").read_text().splitlines()[-1])
    assert last["step"] == 600
    assert 4 <= last["cells"] <= 16


def test_a_method_of_your_own_takes_25_lines_and_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setitem(METHODS, "furthest", METHODS["random"])
    code = example("furthest_reward")
    assert len([line for line in code.splitlines() if line.strip()]) <= 25
    exec(code, {})
    (run,) = (tmp_path / "runs").iterdir()
    assert json.loads((run / "config.json").read_text())["method"] == "furthest"
    assert json.loads((run / "scene.json").read_text())["reward_unit"] == "normalised delta, squared"
    lines = [json.loads(line) for line in (run / "metrics.jsonl").read_text().splitlines()]
    assert lines[-1]["step"] == 600
    assert lines[-1]["policy/imagined_reward"] > 0


def test_every_method_is_in_the_table():
    assert sorted(first_column(section("Methods"))) == sorted(METHODS)


def test_the_row_on_parents_names_whose_policy_can_be_taken_over():
    def takes_over(name: str) -> bool:
        # a task in numbers, and what compiles nothing
        method, sizes = METHODS[name], Sizes(3, 1, has_reward=True)
        return method.fits(sizes) and make_explorer(method, sizes, ExplorationConfig()).adopt is not None

    (row,) = [line for line in README.splitlines() if line.startswith("| `run --parent=")]
    (names,) = re.findall(r"lasts as long as the run: ([^.]*)\.", row)
    assert sorted(re.findall(r"`(\w+)`", names)) == sorted(filter(takes_over, METHODS))


def test_every_environment_is_in_the_table():
    names = first_column(section("Environments"))
    assert sorted(name for name in names if ":" not in name) == sorted(envs.FACTORIES)
    assert sorted(name.partition(":")[0] for name in names if ":" in name) == sorted(envs.ADAPTERS)


def test_the_python_example_runs_and_its_networks_fit_the_data():
    code = example("make_amortized_svgd")
    names: dict = {}
    exec(code, names)
    predictions = np.stack([names["net"].apply({"params": take(names["networks"], i)}, names["x"]) for i in range(100)])
    truth = np.sin(3 * np.asarray(names["x"]))
    # The data's own spread is 0.69; a network that fits is far within it.
    assert np.sqrt(np.mean((predictions.mean(axis=0) - truth) ** 2)) < 0.1
    # A hundred draws are a hundred networks, not one.
    assert 0.005 < predictions.std(axis=0).mean() < 0.3


def take(tree, i):
    """The i-th network of a batch."""
    return {layer: {name: jnp.asarray(leaf)[i] for name, leaf in leaves.items()} for layer, leaves in tree.items()}


def mapped() -> tuple[set[str], set[str]]:
    """The folders on the map, and the modules on it, as paths.

    A line at the margin is of a top folder, an indented one of a folder in it or, where it starts with a file, of the
    top folder's own files; a line indented further goes on with the folder above it.
    """
    (tree,) = re.findall(r"```\n(.*?)```", section("Where things are"), re.DOTALL)
    folders, modules, top, folder = set(), set(), "", ""
    for line in tree.splitlines():
        indent, word = len(line) - len(line.lstrip()), line.split()[0]
        if indent == 0:
            top = folder = word
        elif indent == 2:
            folder = top + word if word.endswith("/") else top
        folders.add(folder)
        modules |= {folder + name for name in re.findall(r"\w+\.py", line)}
    return folders, modules


def test_the_map_is_the_tree():
    folders, modules = mapped()
    assert [folder for folder in folders if not (ROOT / folder).is_dir()] == []
    tree = {path.relative_to(ROOT).as_posix() for package in PACKAGES for path in (ROOT / package).rglob("*.py")}
    tree = {path for path in tree if not path.endswith("__init__.py")}
    # "One environment a file" stands for these.
    assert "one environment a file" in README
    environments = {Path(inspect.getfile(make)).relative_to(ROOT).as_posix() for make in envs.FACTORIES.values()}
    assert sorted(tree - environments - modules) == [], "not on the map"
    assert sorted(modules - tree) == [], "on the map, and not there"
    packages = {f"{Path(path).parent.as_posix()}/" for path in tree}
    assert sorted(packages - folders) == [], "not on the map"


@pytest.mark.parametrize("page", PAGES)
def test_what_a_page_points_to_exists(page: str):
    path = ROOT / page
    text = path.read_text()
    links = [link for link in re.findall(r"\]\(([^)\s]+)\)", text) if not re.match(r"\w+:", link)]
    titles = {re.sub(r"[^\w -]", "", title.lower()).replace(" ", "-") for title in re.findall(r"^#+ (.*)$", text, re.M)}
    for link in links:
        file, _, title = link.partition("#")
        assert (path.parent / file).exists(), link
        assert file or title in titles, link
    for file in re.findall(rf"`((?:{'|'.join(PACKAGES)})/[\w./-]*)`", text):
        assert (ROOT / file).exists(), file
    for module in re.findall(r"python -m\s+(\w+(?:\.\w+)*)", text):
        assert importlib.util.find_spec(module), module


@pytest.mark.parametrize("page", PAGES)
def test_a_page_names_only_flags_that_there_are(page: str):
    for group, field in re.findall(r"--([a-z]+)\.([a-z-]+)", (ROOT / page).read_text()):
        config = getattr(jaxplore.ExplorationConfig(), group)
        assert hasattr(config, field.replace("-", "_")), f"--{group}.{field}"


def test_public_names_exist():
    assert sorted(set(jaxplore.__all__)) == sorted(jaxplore.__all__)
    for name in jaxplore.__all__:
        assert hasattr(jaxplore, name)


def test_the_library_table_names_only_public_names():
    names = [name for name in first_column(section("As a library")) if re.fullmatch(r"\w+", name)]
    assert len(names) >= 10
    assert [name for name in names if name not in jaxplore.__all__] == []


def test_every_command_is_in_the_table():
    files = [path for path in (ROOT / "experiments").glob("*.py") if "__main__" in path.read_text()]
    commands = {path.stem for path in files} - {"posterior"}  # an old name
    assert sorted(commands - {name.split()[0] for name in first_column(section("Running"))}) == []
