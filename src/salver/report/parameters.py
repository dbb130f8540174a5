"""Names and values of uncertain parameters as people write them."""

from __future__ import annotations

import numpy as np

_UNITS = {
    "mass": (1e3, "g"),
    "com": (1e3, "mm"),
    "position": (1e3, "mm"),
    "tilt": (180 / np.pi, "°"),
    "friction": (1.0, ""),
}
_NAMES = {"com": "centre of mass", "position": "place on the tray"}


def pretty(name: str) -> str:
    """A parameter's name for people: "cup1.com_x" is "centre of mass x of cup1"."""
    owner, _, own = name.rpartition(".")
    for key, word in _NAMES.items():
        own = own.replace(f"{key}_", f"{word} ")
    return own.replace("_", " ") + (f" of {owner}" if owner else "")


def quantity(name: str, value: float) -> str:
    """A parameter's value in the unit people use for it."""
    base = name.split(".")[-1]
    kind = next((key for key in _UNITS if base.startswith(key)), None)
    if kind is None:
        return f"{value:.3g} kg m²"
    factor, unit = _UNITS[kind]
    text = f"{factor * value:.4g}"
    return text + unit if unit == "°" else f"{text} {unit}".rstrip()
