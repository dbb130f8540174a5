"""Motions that measure friction: the tray tilts at the start pose of the scenario, and back.

A *slow* tilt (`tilt_test`) rests for a second at the angle that proves the requested friction. A load with less
friction slides off the tray unless somebody catches it. A *short* tilt (`short_tilt`) only touches its steepest angle,
with the angular acceleration a: if the friction is less than needed by e, the load moves by about 4.5 g e^2 / a, and
stays. So a known lower bound of friction allows a tilt that moves the load by no more than a limit, whatever its true
friction. The tilt then proves a larger bound, and the next one may be steeper.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from salver.contact_margins.motion import tray_motion
from salver.errors import ScenarioError, Status
from salver.geometry import Array, exp
from salver.learning.friction.friction import METHOD, SHORT, USUAL, FrictionOptions, leaning, lone_load, proves, ways
from salver.models.contact_rows import contact_rows
from salver.planning.make import with_arm
from salver.planning.plan import Plan
from salver.scenario import Scenario
from salver.trajectory import MotionSamples, SampledReference, smooth_step

STEP = 0.02  # s
STEEPER = 1e-3  # rad, added to the angle that is needed
MOST = 1.5  # largest friction that can be tested: a tilt of about 60 deg
NEAREST = 1e-3  # m, least displacement that a short tilt must allow

Profile = Callable[[float], tuple[Array, Array, Array, Array]]  # angle, rad, to t, angle, rate, acceleration, (T,) each
_Tilt = tuple[float, float, Profile]  # heading and angle, rad


def tilt_test(scenario: Scenario, shown: float, level: float | None = None, options: FrictionOptions = USUAL) -> Plan:
    """Plan a slow tilt of the tray at the start pose, and back: a load that does not slide has at least friction
    `shown`.

    No load in the uncertain set tips. The tilt needs the friction `shown`, plus the error of the angle; the plan's
    scenario has that friction. Raises ScenarioError when a load could tip, or the arm cannot make the tilt.
    """
    body = lone_load(scenario)
    if not 0 < shown <= MOST:
        raise ScenarioError(f"A friction of {shown:g} was asked for; it must be above 0 and at most {MOST:g}.")
    lean = leaning(scenario, (options.level if level is None else level) + options.unseen)

    def slowly(angle: float) -> tuple[Array, Array, Array, Array]:
        return _slowly(angle, options)

    a = np.arctan(shown)  # (sin - lean) / (cos + lean) of the angle is `shown`
    angle = float(a + np.arcsin(min(1.0, lean * (1 + shown) * np.cos(a))) + STEEPER)
    steepest = _headings(scenario, slowly, options)
    headings: list[_Tilt] = [(heading, angle, slowly) for heading, most in steepest if most >= angle]
    if not headings:
        most = steepest[0][1]
        gentler = most - STEEPER
        can = max(0.0, (np.sin(gentler) - lean) / (np.cos(gentler) + lean))
        raise ScenarioError(
            f"{body.name} could tip at {np.rad2deg(most):.1f} deg, and to show a friction of {shown:g} the tray must "
            f"tilt by {np.rad2deg(angle):.1f} deg; at most {np.floor(1000 * can) / 1000:g} can be asked for."
        )
    told = f"that the load does not slide proves a friction of {shown:g}."
    return _first_that_can(scenario, METHOD, headings, lean, told, options)


def short_tilt(scenario: Scenario, level: float | None = None, options: FrictionOptions = USUAL) -> Plan:
    """Plan the steepest short tilt on which a load with the least friction in the ranges moves by at most
    `options.farthest`.

    No load in the uncertain set tips, and the whole base stays on the tray. Raises ScenarioError when a load could tip
    or has no room, or the arm cannot make the tilt.
    """
    body, payload = lone_load(scenario), scenario.payload
    farthest = options.farthest
    if not NEAREST <= farthest <= 0.1:
        raise ScenarioError(f"A load may be moved by {NEAREST:g} m to 0.1 m by a short tilt, not by {farthest:g} m.")
    farthest = min(farthest, room(scenario))
    if farthest < NEAREST:
        raise ScenarioError(
            f"{body.name} may stand {1e3 * farthest:.1f} mm from the edge of the tray; a short tilt needs "
            f"{1e3 * NEAREST:g} mm."
        )
    lean = leaning(scenario, (options.levelled if level is None else level) + options.unseen)
    least = payload.least_friction(body)
    found: list[tuple[float, _Tilt]] = []
    for bend in options.bends:
        profile, low, high = _shortly(bend), 0.0, min(1.0, float(np.arctan(least)) + 0.5)
        for _ in range(16):
            middle = 0.5 * (low + high)
            t, *turn = profile(middle)
            slides = ways(t, _felt(scenario, 0.0, t, *turn), scenario, lean)
            low, high = (middle, high) if slides(least)[1] <= farthest else (low, middle)
        for heading, most in [each for each in _headings(scenario, profile, options)[:3] if each[1] > 0]:
            t, *turn = profile(min(low, most))
            proven = proves(t, _felt(scenario, heading, t, *turn), scenario, lean, options.unnoticed)
            found.append((proven, (heading, min(low, most), profile)))
    if not found:
        raise ScenarioError(f"{body.name} could tip at rest within its ranges; no tilt shows its friction.")
    told = f"a load with a friction of {least:.3f} or more moves by {1e3 * farthest:g} mm at most."
    best = [tilt for _, tilt in sorted(found, key=lambda item: -item[0])]
    return _first_that_can(scenario, SHORT, best, lean, told, options)


def room(scenario: Scenario) -> float:
    """Distance, m, that the load can move in any direction with its whole base on the tray, for all its positions."""
    body, place = scenario.payload.first, np.zeros(2)
    for p, half in scenario.payload.uncertain.ranges.items():
        if p.quantity in ("position_x", "position_y"):
            place["xy".index(p.quantity[-1])] = half
    base = np.abs((body.p_EB + body.base_polygon_B @ body.R_EB.T)[:, :2]) + place
    return float((0.5 * np.array(scenario.tray.size) - base).min())


def _first_that_can(
    scenario: Scenario, method: str, tilts: list[_Tilt], lean: float, told: str, options: FrictionOptions
) -> Plan:
    """The first of several tilts that the arm can make."""
    made: list[Plan] = []
    for heading, angle, profile in tilts:
        tested = _tested(scenario, (np.tan(angle) + 2 * lean) * (1 + options.spare) + options.spare)
        t, *turn = profile(angle)
        samples = _motion(tested, heading, t, *turn)
        words = f"Tilts by {np.rad2deg(angle):.1f} deg in {0.5 * t[-1]:.1f} s and back; {told}"
        timed = tested.with_changes(motion__duration=float(t[-1]))
        made.append(with_arm(Plan(timed, method, SampledReference(samples), Status(method, words, True))))
        if made[-1].ok:
            return made[-1]
    arm = made[0].arm_status
    why = arm.sentence if arm is not None and not arm.ok else made[0].verification.sentence
    raise ScenarioError(f"{scenario.name}: no tilt of {np.rad2deg(tilts[0][1]):.1f} deg was found for this arm. {why}")


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


def _headings(scenario: Scenario, profile: Profile, options: FrictionOptions) -> list[tuple[float, float]]:
    """Headings of a tilt, rad, with the largest angle, rad, at which no load of the set tips; the steepest first."""
    rows = [
        each.only(np.flatnonzero(~each.label.astype(bool)))
        for each in contact_rows(_tested(scenario, 2 * MOST).payload)
    ]
    angles = np.deg2rad(np.arange(0.0, 61.0, 0.25))
    found = []
    for heading in np.arange(0.0, 2 * np.pi, np.pi / 4):
        first, last = 0, len(angles)  # the first is kept, the last is not
        while last - first > 1:
            middle = (first + last) // 2
            w = _felt(scenario, heading, *profile(float(angles[middle])))
            tips = max(float(each.worst(w).max()) for each in rows) > -options.spare
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


def _slowly(angle: float, options: FrictionOptions) -> tuple[Array, Array, Array, Array]:
    one_way = max(STEP, 1.875 * np.rad2deg(angle) / options.speed)
    t = np.arange(0.0, 2 * one_way + options.hold + STEP, STEP)
    t *= (2 * one_way + options.hold) / t[-1]
    up, down = t / one_way, (t - one_way - options.hold) / one_way
    share, rate, bend = ((smooth_step(up, k) - smooth_step(down, k)) / one_way**k for k in range(3))
    return t, angle * share, angle * rate, angle * bend


def _shortly(bend: float) -> Profile:
    """The profile angle (1 - u^2)^3, u from -1 to 1: at rest at both ends, with acceleration `bend` at its steepest."""

    def profile(angle: float) -> tuple[Array, Array, Array, Array]:
        one_way = max(STEP, np.sqrt(6 * angle / bend))
        u = np.linspace(-1.0, 1.0, 2 * int(np.ceil(one_way / (0.5 * STEP))) + 1)
        left = 1 - u**2
        share, rate, again = left**3, -6 * u * left**2 / one_way, left * (30 * u**2 - 6) / one_way**2
        return one_way * (u + 1), angle * share, angle * rate, angle * again

    return profile
