"""Warnings about a scenario: values that are probably mistakes, or beyond what the arm is rated for."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from salver.geometry import Array
from salver.models.arm.arm_limits import LIMITS
from salver.scenario.model import Scenario
from salver.scenario.objects import assumed

if TYPE_CHECKING:
    from salver.models.arm.arm import ArmModel


@dataclass(frozen=True)
class ExpectedValues:
    """Values beyond which a scenario probably has a mistake.

    Attributes:
        friction: warn above it; about that of dry rubber on a dry tray.
        mass: kg; warn of a lighter object.
        densities: kg/m^3; warn outside them: they are below foam and empty cartons, and above gold.
        tilt: degrees; warn of a smaller bound, which is probably in radians.
    """

    friction: float = 1.2
    mass: float = 1e-3
    densities: tuple[float, float] = (5.0, 20e3)
    tilt: float = 2.0


EXPECTED = ExpectedValues()


def warnings_of(scenario: Scenario) -> tuple[str, ...]:
    """All warnings about a scenario, one sentence each. Raises as `salver.models.arm.arm.load_arm`."""
    found = [*_of_ranges(scenario), *_of_objects(scenario), *_of_angles(scenario.model_dump(exclude_unset=True))]
    if scenario.arm is not None:
        arm = scenario.load_arm()
        found = [*_of_limits(arm), *_of_payload(scenario, arm), *found]
    return tuple(found)


def _of_ranges(scenario: Scenario) -> Iterator[str]:
    """Warnings about ranges that are assumed, and about a scenario without ranges."""
    if not scenario.uncertain.size:
        yield "No parameter is uncertain; a plan is safe for exactly these values only."
    for item in scenario.objects:
        ranges = assumed(item.shape, item.on, item.inner)
        if item.uncertainty == ranges:
            com = ", ".join(f"{1e3 * x:.3g}" for x in ranges.com or ())
            rest = ", place 2 mm" * (item.on == "tray")
            if item.inner is not None:
                rest = f", {item.inner.quantity} {1e3 * item.inner.assumed:.3g} mm"
            yield (
                f"{item.name} has no [objects.uncertainty]; assumed half-ranges are friction 15 %, mass 10 %, centre "
                f"of mass {com} mm{rest}."
            )


def _of_limits(arm: ArmModel) -> Iterator[str]:
    """Warnings about limits above those of the arm's maker or its URDF."""
    for kind in LIMITS:
        for end, sign in (("q_min", -1.0), ("q_max", 1.0)) if kind.key == "position" else ((kind.key, 1.0),):
            given, own = getattr(arm.limits, end), getattr(arm.own_limits, end)
            beyond = np.flatnonzero(sign * given > sign * own + 1e-6 * np.abs(own))
            if len(beyond):
                j = int(beyond[np.argmax(np.abs(given[beyond] / own[beyond]))])
                others = f" and of {len(beyond) - 1} more" if len(beyond) > 1 else ""
                yield (
                    f"The limit of {kind.name} of {arm.joint_names[j]}{others} is above the arm's own: {given[j]:.4g} "
                    f"instead of {own[j]:.4g} {kind.unit_of(arm.linear[j])}."
                )


def _of_payload(scenario: Scenario, arm: ArmModel) -> Iterator[str]:
    carried = max(sum(item.loose().inertial.mass for item in leg.objects) for leg in scenario.each_leg)
    if arm.rated is not None and carried + scenario.tray.mass > arm.rated:
        yield (
            f"The tray and its load weigh {carried + scenario.tray.mass:.3g} kg; the maker rates the {arm.name} for "
            f"{arm.rated:g} kg."
        )


def _of_objects(scenario: Scenario) -> Iterator[str]:
    for item in scenario.objects:
        if item.friction > EXPECTED.friction:
            yield f"friction = {item.friction:g} of {item.name}: few materials have more than {EXPECTED.friction:g}."
        loose = item.loose()
        density = loose.inertial.mass / float(
            np.prod(np.ptp(loose.solid.bounding_points_G, axis=0))
        )  # kg/m^3, from the volume of its bounding box
        if item.mass <= EXPECTED.mass:
            yield f"mass = {item.mass:g} of {item.name} is {1e3 * item.mass:.3g} g; masses are in kg."
        elif not EXPECTED.densities[0] <= density <= EXPECTED.densities[1]:
            like = "lighter than foam" if density < EXPECTED.densities[0] else "heavier than gold"
            yield (
                f"mass = {item.mass:g} of {item.name} makes {density:.3g} kg/m^3 of its shape, {like}; masses are in "
                "kg, lengths in m."
            )


def _of_angles(table: Any, where: str = "") -> Iterator[str]:
    """Warnings about keys in degrees whose values are multiples of pi / 12 to three digits, so probably radians."""
    rows = table.items() if isinstance(table, dict) else enumerate(table) if isinstance(table, list | tuple) else ()
    for key, value in rows:
        name = f"{where}[{key}]" if isinstance(key, int) else f"{where}.{key}".lstrip(".")
        if not str(key).endswith("_deg"):
            yield from _of_angles(value, name)
        elif _in_radians(np.atleast_1d(np.array(value, dtype=float)), str(key)):
            yield f"{name} = {value} looks like radians; keys that end in _deg are in degrees."


def _in_radians(angles: Array, key: str) -> bool:
    if key == "max_tilt_deg":
        return bool(angles[0] < EXPECTED.tilt)
    parts = np.abs(angles) * 12 / np.pi
    near = (np.abs(parts - np.round(parts)) < 0.02) & (np.round(parts) > 0) & (np.abs(angles) < 6.3)
    rounded = np.abs(angles * 10 - np.round(angles * 10)) < 1e-9  # one decimal, as 2.1: probably meant as degrees
    return bool(np.any(near & ~rounded))
