"""Numbers and names in sentences."""

from __future__ import annotations

import math
from collections.abc import Iterable


def millimetres(metres: float, otherwise: str = "lifts") -> str:
    """A margin to tipping in mm with one digit; `otherwise` if it is not finite, as for a load that lifts."""
    return f"{1e3 * metres:.1f} mm" if math.isfinite(metres) else otherwise


def number(value: float, digits: int, unit: str = "", otherwise: str = "–") -> str:
    """A number with a fixed number of digits and its unit; `otherwise` if it is not finite."""
    return f"{value:.{digits}f}{unit}".replace("-", "−") if math.isfinite(value) else otherwise


def listed(names: Iterable[str], before_last: str = "and") -> str:
    """A list of names in words: "a, b and c"."""
    found = list(names)
    return found[0] if len(found) == 1 else f"{', '.join(found[:-1])} {before_last} {found[-1]}"
