"""Command lines of rubbish: each is refused in one line that names the field, the value and what is allowed, and leaves
nothing behind.
"""

import dataclasses
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from experiments import run
from experiments.runs.config import flag
from experiments.runs.presets import preset_config
from jaxplore.methods import METHODS

ANYTHING = {"preset", "coverage_dims"}
"""Fields whose values are looked at elsewhere: `preset` decides the defaults, `coverage_dims` needs the environment."""
NEGATIVE = {"explorer.ppo.extrinsic_coefficient", "explorer.ppo.intrinsic_coefficient"}


def reader(path: str) -> list[str]:
    """Flags that choose a method which reads a field."""
    if not path.startswith("explorer."):
        return []
    group = path.split(".")[1]
    for planner in ("sac", "mcts"):
        config = dataclasses.replace(preset_config("smoke").explorer, planner=planner)
        for name, method in METHODS.items():
            if group in method.reads(config):
                return [f"--method={name}", *([f"--planner={planner}"] if planner != "sac" else [])]
    raise AssertionError(f"no method reads {path}")


def rubbish(value: Any) -> list[str]:
    """What a field with this value does not take."""
    match value:
        case bool():
            return ["maybe"]
        case int():
            return ["x", "1.5", "-1", "nan", ""]
        case float():
            return ["x", "nan", "inf", "1,5"]
        case str():
            return [f"{value}x"]
        case (int(), *_):
            return ["x", "0", "-3"]
    return []


def cases(config: Any, prefix: str = "") -> Iterator[tuple[str, str]]:
    for item in dataclasses.fields(config):
        value, path = getattr(config, item.name), f"{prefix}{item.name}"
        if dataclasses.is_dataclass(value):
            yield from cases(value, f"{path}.")
        elif path not in ANYTHING:
            yield from ((path, bad) for bad in rubbish(value))


CASES = list(cases(preset_config("smoke")))
EVERY_TENTH = [
    pytest.param(*case, marks=[] if i % 15 == 0 else [pytest.mark.slow], id=f"{case[0]}={case[1]}")
    for i, case in enumerate(CASES)
]


def test_there_are_enough_of_them():
    assert len(CASES) > 300


@pytest.mark.parametrize(("path", "bad"), EVERY_TENTH)
def test_is_refused_in_a_line(
    path: str, bad: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    monkeypatch.chdir(tmp_path)
    assert run.main(["--preset=smoke", *reader(path), f"{flag(path)}={bad}"]) == 2
    told = capsys.readouterr()
    assert told.out == "" and list(tmp_path.iterdir()) == []
    (line,) = told.err.splitlines()
    name = flag(path) if path != "env" else "env"
    assert re.match(rf"error: {re.escape(name)}=\S* .*Allowed: .", line), line
    assert bad.lstrip("-").rstrip("0") in line
