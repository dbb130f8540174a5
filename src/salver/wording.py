"""Words for people."""

from __future__ import annotations

import math
from collections.abc import Iterable


def millimetres(metres: float, otherwise: str = "lifts") -> str:
    """A distance to tipping in mm with one digit; words where it is not finite, as a load that lifts has none."""
    return f"{1e3 * metres:.1f} mm" if math.isfinite(metres) else otherwise


def number(value: float, digits: int, unit: str = "", otherwise: str = "–") -> str:
    """A number of a page or a figure with a fixed number of digits and its unit; words when it is not finite."""
    return f"{value:.{digits}f}{unit}".replace("-", "−") if math.isfinite(value) else otherwise


def listed(names: Iterable[str], before_last: str = "and") -> str:
    """Names in a row: "a, b and c"."""
    found = list(names)
    return found[0] if len(found) == 1 else f"{', '.join(found[:-1])} {before_last} {found[-1]}"
