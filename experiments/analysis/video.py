"""Frames as a file: a video, a GIF, or a picture of a few moments."""
# pyright: reportAttributeAccessIssue=false
# imageio ships no stubs.

import os
import tempfile
import warnings
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from experiments.runs.errors import RunError, disk_error
from experiments.runs.files import replacing

SUFFIXES = (".mp4", ".gif", ".png")
STILLS = 4
"""Moments in one picture."""
INSTALL_WRITER = 'A video needs imageio and its ffmpeg. What to do: pip install -e ".[render]".'


class Timing(NamedTuple):
    """When a file shows what."""

    places: Sequence[int]
    """Which of the states it shows."""
    lengths: Sequence[float]
    """For how long each, seconds."""


def check_target(path: Path) -> None:
    """Try whether a file can be written at `path`; leaves nothing there.

    Raises:
        RunError: no video writer, no such directory, or one that cannot be written to.
    """
    try:
        import imageio  # noqa: F401
        import imageio_ffmpeg  # noqa: F401
    except ImportError as error:
        raise RunError(INSTALL_WRITER) from error
    if path.is_dir():
        raise RunError(f"cannot write the picture {path}: a directory has that name. What to do: give another --out.")
    if not path.parent.is_dir():
        problem = f"{path.parent} is no directory. What to do: make it, or give another --out."
        raise RunError(f"cannot write the picture {path}: {problem}")
    try:
        with tempfile.TemporaryFile(dir=path.parent):
            pass
    except OSError as error:
        raise disk_error("write the picture", path, error) from error


def timing(suffix: str, num: int, dt: float) -> Timing:
    """What a file that ends in `suffix` shows of `num` states, `dt` seconds apart; the last is always among them.

    Videos and GIFs play in real time. A GIF's clock ticks in hundredths of a second, and viewers slow down what lasts
    for less than two: where steps are shorter, some are left out.
    """
    if suffix == ".png":
        places = np.linspace(0, num - 1, min(STILLS, num)).round().astype(int).tolist()
        return Timing(places, [dt] * len(places))
    if suffix == ".mp4":
        return Timing(range(num), [dt] * num)
    ticks = np.round(100 * dt * np.arange(num + 1)).astype(int)
    places = [num - 1]
    for place in range(num - 2, -1, -1):
        if ticks[places[0]] - ticks[place] >= 2:
            places.insert(0, place)
    lengths = np.diff(ticks[[*places, num]])
    return Timing(places, [max(2, int(length)) / 100 for length in lengths])


def write(path: str | os.PathLike[str], frames: Iterable[np.ndarray], lengths: Sequence[float]) -> None:
    """Write frames, whole or not at all.

    Args:
        path: a video (`.mp4`), a GIF that repeats forever (`.gif`), or a picture of them side by side (`.png`).
        frames: uint8 `[height, width, 3]`, at least one.
        lengths: of each, seconds; in a video all are as long as the first.

    Raises:
        RunError: the file cannot be written.
    """
    writer = {".mp4": _write_video, ".gif": _write_gif, ".png": _write_stills}[Path(path).suffix]
    try:
        with replacing(path) as draft:
            writer(draft, frames, lengths)
    except OSError as error:
        raise disk_error("write the picture", path, error) from error


def _write_stills(path: Path, frames: Iterable[np.ndarray], lengths: Sequence[float]) -> None:
    import imageio.v2 as imageio

    imageio.imwrite(path, np.concatenate(list(frames), axis=1))


def _write_gif(path: Path, frames: Iterable[np.ndarray], lengths: Sequence[float]) -> None:
    from PIL import Image

    images = map(Image.fromarray, frames)
    milliseconds = [round(1000 * length) for length in lengths]
    next(images).save(path, save_all=True, append_images=images, duration=milliseconds, loop=0)


def _write_video(path: Path, frames: Iterable[np.ndarray], lengths: Sequence[float]) -> None:
    import imageio.v2 as imageio

    # JAX warns of the fork that starts ffmpeg; nothing but ffmpeg runs in it.
    with (
        warnings.catch_warnings(action="ignore", category=RuntimeWarning),
        imageio.get_writer(path, fps=1 / lengths[0], macro_block_size=2) as writer,
    ):
        for frame in frames:
            writer.append_data(frame)
