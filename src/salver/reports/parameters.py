"""Uncertain parameters and their values as people write them."""

from __future__ import annotations

import numpy as np

from salver.models.uncertain.parameters import Parameter, UncertainSet

_UNITS = {
    "mass": (1e3, "g"),
    "com": (1e3, "mm"),
    "inertia": (1.0, "kg m²"),
    "position": (1e3, "mm"),
    "tilt": (180 / np.pi, "°"),
    "friction": (1.0, ""),
    "fill": (1e3, "mm"),
    "length": (1e3, "mm"),
    "damping": (100.0, "% of critical"),
}
_SHARES = ("mass", "inertia", "friction", "fill", "length", "damping")
_NAMES = {"com": "centre of mass", "position": "place on the tray", "friction_rim": "friction of the rim"}


def pretty(parameter: Parameter) -> str:
    """For people: "cup1.com_x" is "centre of mass x of cup1"."""
    own = _NAMES.get(parameter.name) or f"{_NAMES.get(parameter.kind, parameter.kind)} {parameter.axis}".rstrip()
    return own + ("" if parameter.lone or not parameter.owner else f" of {parameter.owner}")


def quantity(parameter: Parameter, value: float) -> str:
    """A parameter's value in the unit people use for it."""
    factor, unit = _UNITS[parameter.kind]
    text = f"{factor * value:.{3 if parameter.kind == 'inertia' else 4}g}"
    return text + unit if unit == "°" else f"{text} {unit}".rstrip()


def half_range(parameter: Parameter, nominal: float, half: float) -> str:
    """ "25 g (10 %)"; without the share where 0 is no less of it: 3 mm about a centre of mass at 1 mm is not 300 %."""
    share = nominal and parameter.kind in _SHARES
    return quantity(parameter, half) + (f" ({100 * half / abs(nominal):.3g} %)" if share else "")


def ranges(uncertain: UncertainSet) -> list[tuple[str, str, str]]:
    """Name, nominal value and half-width of each uncertain parameter."""
    whole = zip(uncertain.parameters, uncertain.nominal, uncertain.half_range, strict=True)
    return [(pretty(p), quantity(p, nominal), half_range(p, nominal, half)) for p, nominal, half in whole]
