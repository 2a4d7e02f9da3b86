import contextlib
import io
from pathlib import Path
from typing import NamedTuple

import pytest

import envs
from experiments import run
from tests.experiments import tiny


class Told(NamedTuple):
    out: Path
    status: int
    stdout: str
    stderr: str


def tell(out: Path, *words: str) -> Told:
    """Run the command line in this process."""
    stdout, stderr = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(stdout), contextlib.redirect_stderr(stderr):
        try:
            status = run.main([f"--out={out}", *words])
        except SystemExit as stop:
            status = int(stop.code or 0)
    return Told(out, status, stdout.getvalue(), stderr.getvalue())


@pytest.fixture(name="tell")
def tell_fixture():
    """`tell(out, *flags) -> Told`: run the command line in this process."""
    return tell


@pytest.fixture(scope="session")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Told:
    """A tiny run of the ant, physics on the host. Not to be written to."""
    return tell(tmp_path_factory.mktemp("finished") / "run", "--env=ant_maze", *tiny.TINY)


@pytest.fixture
def point(monkeypatch: pytest.MonkeyPatch) -> str:
    """The name of an environment that runs on the device and compiles in no time."""
    monkeypatch.setitem(envs.FACTORIES, "point", tiny.make_point)
    return "point"
