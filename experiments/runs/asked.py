"""What `calibration.json` must hold to be read."""

from collections.abc import Mapping
from typing import Any


def is_calibration(found: Mapping[str, Any]) -> bool:
    """Whether it has what comparisons read."""
    seeds = found.get("seeds")
    return isinstance(found.get("step"), int) and isinstance(seeds, list) and all(map(_is_asked, seeds))


def _is_asked(seed: Any) -> bool:
    if not isinstance(seed, dict) or type(seed.get("seed")) is not int or not isinstance(seed.get("sets"), dict):
        return False
    told, sets = seed.get("unseen_told_from_data", ""), seed["sets"].values()
    numbers = [told, *(value for one in sets if isinstance(one, dict) for value in one.values())]
    return all(isinstance(one, dict) for one in sets) and all(
        value is None or isinstance(value, int | float) for value in numbers
    )
