"""The README's code runs, and its map of the folders is the tree's."""

import json
import re
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest

import envs
import jaxplore
from jaxplore.methods import METHODS

ROOT = Path(__file__).parent.parent
FOLDERS = ("jaxplore", "envs", "experiments")
README = (ROOT / "README.md").read_text()


def example(word: str) -> str:
    """The README's one Python example with `word` in it."""
    (code,) = [code for code in re.findall(r"```python\n(.*?)```", README, re.DOTALL) if word in code]
    return code


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
    lines = [json.loads(line) for line in (run / "metrics.jsonl").read_text().splitlines()]
    assert lines[-1]["step"] == 600
    assert lines[-1]["policy/imagined_reward"] > 0


def test_every_method_is_in_the_table():
    (section,) = re.findall(r"\n## Methods\n(.*?)\n## ", README, re.DOTALL)
    named = re.findall(r"`(\w+)`", "".join(row.split("|")[1] for row in section.splitlines() if row.startswith("| `")))
    assert sorted(named) == sorted(METHODS)


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


def test_the_map_names_every_module():
    (tree,) = re.findall(r"## Where things are\n\n```\n(.*?)```", README, re.DOTALL)
    for folder in FOLDERS:
        for module in (ROOT / folder).glob("*.py"):
            if module.name != "__init__.py":
                assert module.name in tree, f"{folder}/{module.name} is not on the map"
    for name in re.findall(r"\w+\.py", tree):
        assert any((ROOT / folder / name).exists() for folder in FOLDERS), name


def test_public_names_exist():
    assert sorted(set(jaxplore.__all__)) == sorted(jaxplore.__all__)
    for name in jaxplore.__all__:
        assert hasattr(jaxplore, name)
