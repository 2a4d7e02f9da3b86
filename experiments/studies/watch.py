"""A directory served to this machine alone, while something is written to it."""

import contextlib
import functools
import threading
from collections.abc import Iterator
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

from experiments.runs.errors import RunError

HOST = "127.0.0.1"


class _Quiet(SimpleHTTPRequestHandler):
    """Says nothing of what is asked for."""

    def log_message(self, format: str, *args: Any) -> None:
        pass


@contextlib.contextmanager
def serve(directory: Path, port: int = 0) -> Iterator[str]:
    """Serve a directory on the loopback address while the block runs; gives its URL.

    Args:
        directory: what is served.
        port: 0: a free one.

    Raises:
        RunError: the port is taken.
    """
    try:
        server = ThreadingHTTPServer((HOST, port), functools.partial(_Quiet, directory=str(directory)))
    except OSError as error:
        raise RunError(
            f"--port={port} cannot be served on ({error.strerror}). What to do: leave --port out, for a free one."
        ) from error
    server.daemon_threads = True
    thread = threading.Thread(target=server.serve_forever, daemon=True)
    thread.start()
    try:
        yield f"http://{HOST}:{server.server_port}/index.html"
    finally:
        server.shutdown()
        server.server_close()
        thread.join()
