"""Narrowing of a scenario's ranges by an estimate of its load; they are never widened, and respect the shape."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from salver.errors import SalverError
from salver.geometry import Array, Mask
from salver.learning.load.ranges import LIKELY, NAMES, WIDTH, Estimate, Range, consistent, intervals, slid
from salver.models.uncertain.contents import inertia_ranges
from salver.models.uncertain.parameters import INERTIAL, inertial_vector, phi_of

if TYPE_CHECKING:
    from salver.scenario import Scenario

Ends = tuple[Array, Array]  # least and largest values (10,) of `INERTIAL`


def prior(scenario: Scenario) -> tuple[Array, Array]:
    """Prior of phi (10,): the middle of the scenario's ranges, with the half-ranges as standard deviations; for
    inertias without a range, everything that a mass inside the shape can have."""
    payload, body = scenario.payload, scenario.payload.first
    half = half_ranges(scenario)
    nominal = inertial_vector(body.inertial)
    heaviest = nominal[0] + half[0]
    moment = heaviest * np.maximum(half[1:4], 1e-4)
    inertia = inertia_ranges(body.points_B, half[1:4], heaviest, nominal[4:])
    if payload.uncertain.size and not body.any_contents:
        inertia = np.where(half[4:] > 0, half[4:], inertia)
    return phi_of(nominal), np.concatenate([[max(half[0], 1e-3 * nominal[0])], moment, inertia])


def half_ranges(scenario: Scenario) -> Array:
    """Half-ranges (10,) of `INERTIAL`; 0 without a range."""
    ranges = {p.quantity: h for p, h in scenario.payload.uncertain.ranges.items()}
    return np.array([ranges.get(name, 0.0) for name in INERTIAL])


def narrowed(scenario: Scenario, estimate: Estimate, inside: bool, denied_from: float = 4.5) -> dict[str, Range]:
    """Ranges of mass, centre of mass and inertia in the scenario's B, within its own. inside: whether a mass inside the
    shape can have the scenario's inertia. denied_from: standard deviations from which on the logs contradict an inertia
    without a range."""
    body, half = scenario.payload.first, half_ranges(scenario)
    nominal = inertial_vector(body.inertial)
    off = slid(estimate)
    sure, likely, denied = (
        (low - off, high + off) for low, high in (intervals(estimate, width) for width in (WIDTH, LIKELY, denied_from))
    )
    before = nominal - half, nominal + half
    found = {name: _within(k, sure, before, likely) for k, name in enumerate(NAMES)}
    if inside:
        points = body.points_B
        low, high = np.array([(found[name].low, found[name].high) for name in NAMES[1:]]).T
        away = np.clip(0.5 * (points.min(axis=0) + points.max(axis=0)), low, high)
        most = found["mass"].high * (points.max(axis=0) - away) * (away - points.min(axis=0))  # Bhatia and Davis 2000
        reach = np.full(6, 2 * most.sum())
        allowed = consistent(-reach, reach, most)
    else:
        most, spread = np.full(3, np.inf), prior(scenario)[1][4:]
        allowed = nominal[4:] - spread, nominal[4:] + spread
    ranged = np.asarray(half[4:] > 0) & (not body.any_contents)
    for old, new in zip(before, allowed, strict=True):
        old[4:] = np.where(ranged, old[4:], new)
    sure[0][4:], sure[1][4:] = consistent(np.maximum(sure[0], before[0])[4:], np.minimum(sure[1], before[1])[4:], most)
    found |= {name: _within(k, sure, before, likely) for k, name in enumerate(INERTIAL) if k > 3}
    if not body.any_contents:
        _not_denied(found["mass"], nominal, ranged, denied)
    return found


def _within(k: int, sure: Ends, before: Ends, likely: Ends) -> Range:
    """The range of entry k of `INERTIAL`, within the range before. Raises SalverError when the new range is empty."""
    (a, b), known, probable = ((float(low[k]), float(high[k])) for low, high in (sure, before, likely))
    low, high = max(a, known[0]), min(b, known[1])
    if low > high:
        unit = "kg" if k == 0 else "m" if k < 4 else "kg m^2"
        turned = " (wrist forces are those that the arm exerts: f_z > 0 at rest)" if k == 0 and b < 0 else ""
        raise SalverError(
            f"The logs put {INERTIAL[k]} between {a:.4g} and {b:.4g} {unit}, the scenario between {known[0]:.4g} and "
            f"{known[1]:.4g}: one of them is wrong{turned}; the scenario's range is not widened."
        )
    inside = np.clip(probable, low, high)
    return Range(low, high, known, (float(inside[0]), float(inside[1])))


def _not_denied(mass: Range, nominal: Array, ranged: Mask, denied: Ends) -> None:
    """Raise SalverError when the logs contradict an inertia for which the scenario has no range."""
    times = np.array([mass.low, mass.high]) / nominal[0]
    for k, (low, high) in enumerate(zip(*denied, strict=True)):
        taken = np.sort(nominal[k] * times)
        if k > 3 and not ranged[k - 4] and (taken[1] < low or taken[0] > high):
            raise SalverError(
                f"The logs put {INERTIAL[k]} between {low:.4g} and {high:.4g} kg m^2, the scenario at {nominal[k]:.4g} "
                f'for {nominal[0]:.4g} kg, with no range: give uncertainty.inertia a range, or contents = "any".'
            )


def not_shown(ranges: dict[str, Range], sensors: set[str]) -> list[str]:
    """Sentences about parameters that this motion does not identify, and about a motion that would."""
    told, open_ = [], [name for name, r in ranges.items() if r.before[1] > r.before[0] and not r.learnt]
    lacking = [name for name in open_ if name in NAMES]
    if lacking:
        if sensors == {"joint torques"} and any(name.startswith("com") for name in lacking):
            way = "joint torques weigh a light load and do not locate it; a wrist force-torque sensor would"
        elif "com_z" in lacking:
            way = "a motion that tilts the tray would"
        else:
            way = "a longer or faster motion, or several logs of it, would"
        told.append(f"This does not show {', '.join(lacking)}: {way}.")
    turning = [name for name in open_ if name not in NAMES]
    if turning:
        way = "a wrist force-torque sensor" if sensors == {"joint torques"} else "a motion that turns the tray faster"
        told.append(f"This does not show {', '.join(turning)}: {way} would.")
    return told
