"""The motion that measures friction: the tray tilts slowly at the start pose of the scenario, rests for a second at the
angle that proves the requested friction, and comes back.

A load with less friction slides off the tray unless somebody catches it.
"""

from __future__ import annotations

import numpy as np

from salver.contact_margins.model import tray_motion
from salver.errors import ScenarioError, Status
from salver.geometry import Array, exp
from salver.learning.friction.friction import METHOD, OPTIONS, leaning, tested_load
from salver.models.contact_rows import contact_rows
from salver.planning.make import with_arm
from salver.planning.plan import Plan
from salver.scenario import Scenario
from salver.trajectory import MotionSamples, SampledReference, smooth_step


def tilt_test(scenario: Scenario, shown: float, level: float | None = None) -> Plan:
    """Plan a tilt of the tray at the start pose, and back: a load that does not slide has at least friction
    `shown`.

    No load in the uncertain set tips. The tilt needs the friction `shown`, plus the error of the angle; the plan's
    scenario has that friction. Raises ScenarioError when a load could tip, or the arm cannot make the tilt.
    """
    body = tested_load(scenario)
    if not 0 < shown <= OPTIONS.most:
        raise ScenarioError(f"A friction of {shown:g} was asked for; it must be above 0 and at most {OPTIONS.most:g}.")
    lean = leaning(scenario, (OPTIONS.level if level is None else level) + OPTIONS.unseen)

    a = np.arctan(shown)  # (sin - lean) / (cos + lean) of the angle is `shown`
    angle = float(a + np.arcsin(min(1.0, lean * (1 + shown) * np.cos(a))) + OPTIONS.steeper)
    steepest = _headings(scenario)
    headings = [heading for heading, most in steepest if most >= angle]
    if not headings:
        most = steepest[0][1]
        gentler = most - OPTIONS.steeper
        can = max(0.0, (np.sin(gentler) - lean) / (np.cos(gentler) + lean))
        raise ScenarioError(
            f"{body.name} could tip at {np.rad2deg(most):.1f} deg, and to show a friction of {shown:g} the tray must "
            f"tilt by {np.rad2deg(angle):.1f} deg; at most {np.floor(1000 * can) / 1000:g} can be asked for."
        )
    tested = _tested(scenario, (np.tan(angle) + 2 * lean) * (1 + OPTIONS.spare) + OPTIONS.spare)
    t, *turn = _profile(angle)
    words = (
        f"Tilts by {np.rad2deg(angle):.1f} deg in {0.5 * t[-1]:.1f} s and back; that the load does not slide proves a "
        f"friction of {shown:g}."
    )
    timed, made = tested.with_changes(motion__duration=float(t[-1])), list[Plan]()
    for heading in headings:  # the first that the arm can make
        samples = _motion(tested, heading, t, *turn)
        made.append(with_arm(Plan(timed, METHOD, SampledReference(samples), Status(METHOD, words, True))))
        if made[-1].ok:
            return made[-1]
    arm = made[0].arm_status
    why = arm.sentence if arm is not None and not arm.ok else made[0].verification.sentence
    raise ScenarioError(f"{scenario.name}: no tilt of {np.rad2deg(angle):.1f} deg was found for this arm. {why}")


def _tested(scenario: Scenario, coefficient: float) -> Scenario:
    """The scenario with that friction in every direction of its linearised cone, and with start and goal equal."""
    start = scenario.motion.start.model_dump()
    return scenario.with_changes(
        contact__condition="exact",
        contact__margin=0.0,
        objects__0__friction=float(coefficient / np.cos(np.pi / scenario.contact.edges)),
        objects__0__uncertainty__friction=None,
        motion__goal=start,
        motion__through=[],
        motion__orientation="free",
        motion__goal_yaw="fixed",
        motion__max_tilt_deg=None,
        motion__duration=1.0,
    )


def _headings(scenario: Scenario) -> list[tuple[float, float]]:
    """Headings of a tilt, rad, with the largest angle, rad, at which no load of the set tips; the steepest first."""
    (rows,) = contact_rows(_tested(scenario, 2 * OPTIONS.most).payload)
    rows = rows.only(np.flatnonzero(~rows.label.astype(bool)))
    angles = np.deg2rad(np.arange(0.0, 61.0, 0.25))
    found = []
    for heading in np.arange(0.0, 2 * np.pi, np.pi / 4):
        first, last = 0, len(angles)  # the first is kept, the last is not
        while last - first > 1:
            middle = (first + last) // 2
            w = _felt(scenario, heading, *_profile(float(angles[middle])))
            tips = rows.worst(w).max() > -OPTIONS.spare
            first, last = (first, middle) if tips else (middle, last)
        found.append((float(heading), float(angles[first])))
    return sorted(found, key=lambda item: -item[1])


def _felt(scenario: Scenario, heading: float, t: Array, angle: Array, rate: Array, bend: Array) -> Array:
    """Motion regressor w (T, 12) of the tray frame on a tilt."""
    return tray_motion(scenario, _motion(scenario, heading, t, angle, rate, bend))


def _motion(scenario: Scenario, heading: float, t: Array, angle: Array, rate: Array, bend: Array) -> MotionSamples:
    """Motion of B on a tilt about a horizontal axis towards a heading; the position of B is constant."""
    start, still = scenario.motion.start, np.zeros((len(t), 3))
    axis_S = np.array([-np.sin(heading), np.cos(heading), 0.0])
    R_SB = exp(np.multiply.outer(angle, axis_S)) @ start.rotation
    axis_B = start.rotation.T @ axis_S  # constant, because the rotation is about this axis
    turns = (np.outer(x, axis_B) for x in (rate, bend))
    return MotionSamples(t, still + np.array(start.position), still, still, R_SB, *turns)


def _profile(angle: float) -> tuple[Array, Array, Array, Array]:
    """Times and angle with two derivatives, (T,) each, of a tilt by `angle`, rad, and back."""
    one_way = max(OPTIONS.step, 1.875 * np.rad2deg(angle) / OPTIONS.speed)
    t = np.arange(0.0, 2 * one_way + OPTIONS.hold + OPTIONS.step, OPTIONS.step)
    t *= (2 * one_way + OPTIONS.hold) / t[-1]
    up, down = t / one_way, (t - one_way - OPTIONS.hold) / one_way
    share, rate, bend = ((smooth_step(up, k) - smooth_step(down, k)) / one_way**k for k in range(3))
    return t, angle * share, angle * rate, angle * bend
