import urllib.error
import urllib.request
from pathlib import Path

import pytest

from experiments.runs.errors import RunError
from experiments.studies.watch import serve


def test_it_serves_a_directory_to_this_machine_and_stops(tmp_path: Path):
    (tmp_path / "index.html").write_text("one")
    with serve(tmp_path) as address:
        assert address.startswith("http://127.0.0.1:")
        with urllib.request.urlopen(address) as answer:
            assert answer.read() == b"one"
        (tmp_path / "index.html").write_text("two")
        with urllib.request.urlopen(address) as answer:
            assert answer.read() == b"two"
        port = int(address.split(":")[2].split("/")[0])
        with pytest.raises(RunError, match="cannot be served on"), serve(tmp_path, port):
            pass
    with pytest.raises(urllib.error.URLError):
        urllib.request.urlopen(address)
