"""Friction, never as a point: what a run without a slip proves of it, what a slip does, and a test that tilts slowly.

A load whose centre of mass stands at c on the tray needs, of each kilogram, f(c) = f + alpha x c + omega x (omega x c),
whatever its mass. While it does not slide, the friction coefficient, as the mean over its base weighted by pressure, is
at least |f_t| / f_n; where c and the level of the robot's base are known as ranges, at least the smallest such ratio,

    min over c of |f_t(c)| / f_n(c) = max over unit u of min over corners c of u . f_t(c) / f_n(c)

(both are quasi-linear in c and linear in u: Sion 1958). Any u gives a bound, so few directions are never optimistic. It
is said of that base and that pressure, not of each of its points, nor of how it resists being turned.

A load that begins to slide on a slowly tilted tray, where nothing twists it, has no more than what is needed there.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product

import numpy as np

from salver.errors import SalverError, ScenarioError, Status
from salver.geometry import GRAVITY_S, Array, exp
from salver.learning.executed import executed
from salver.models.arm import load_arm, with_load
from salver.models.bodies import Body
from salver.models.contact_rows import contact_rows
from salver.models.parameters import TILT, Parameter
from salver.models.tray_motion import at_rest
from salver.motion_files import JointSamples
from salver.planning.make import with_arm
from salver.planning.plan import Plan
from salver.scenario import Scenario
from salver.sensitivity.arm.terms import motion_terms
from salver.trajectory import MotionSamples, SampledReference

GRAVITY = float(np.linalg.norm(GRAVITY_S))
LEVEL = 0.5  # deg by which a robot's base may lean
UNSEEN = 0.2  # deg by which a tray may be off what was planned, when there is no log
SHAKES = 0.02  # of gravity: what may shake a tray beyond what the joints tell, and start a slip
SPEED = 4.0  # deg/s at which a tray is tilted, at most
REST = 1.0  # s that it stays
STEP = 0.02  # s
STEEPER = 1e-3  # rad than need be
DIRECTIONS = 72
MOST = 1.5  # friction that can be asked for: a tilt of some 60 deg
SPARE = 0.02  # of the weight: how far from tipping a test stays, and of friction that it asks for beyond
METHOD = "tilt"


@dataclass(frozen=True)
class Friction:
    """What a run shows of one load's friction. low: proven by not having slid, at `low_time`; None when nothing is.
    high: by having slid, at `high_time`, or None. plan: what was carried out.
    """

    plan: Plan
    low: float | None
    low_time: float
    high: float | None
    high_time: float

    @property
    def sentences(self) -> tuple[str, ...]:
        """What was found, of which contact, and under which unknowns."""
        where = f"the base of {self.plan.scenario.payload.first.name} on the tray, as a mean weighted by pressure"
        under = "for every centre of mass and place within the ranges"
        found = (("least", self.low, self.low_time), ("most", self.high, self.high_time))
        return tuple(
            f"Friction is at {which} {value:.3f} ({where}; {under}): needed at t = {time:.2f} s."
            for which, value, time in found
            if value is not None
        )

    def learnt_scenario(self, scenario: Scenario | None = None) -> Scenario:
        """A scenario of this load (the plan's own, unless given) with what is left of its range of friction.

        Raises SalverError when nothing is, ScenarioError when its centre of mass may be where it was not in the plan.
        """
        scenario = self.plan.scenario if scenario is None else scenario
        body, tested = _lone(scenario), self.plan.scenario.payload.first
        further = np.abs(body.p_EB - tested.p_EB) + _reach(scenario, body) - _reach(self.plan.scenario, tested)
        if (further > 1e-9).any():
            raise ScenarioError(
                f"In {scenario.name} the centre of mass may be {1e3 * further.max():.2g} mm from where it is in the "
                "plan of the test; test with the wider ranges."
            )
        half = _half(scenario, Parameter(body.name, "friction", lone=True))
        before = body.friction - half, body.friction + half
        low, high = max(before[0], self.low or 0.0), min(before[1], np.inf if self.high is None else self.high)
        if low > high:
            shown = (
                f"at least {self.low:.3f}" if self.low is not None and self.low > before[1] else f"at most {high:.3f}"
            )
            raise SalverError(
                f"The run shows a friction of {shown}, and {scenario.name} says {before[0]:.3f} to {before[1]:.3f}: "
                "one of them is wrong; no range is widened."
            )
        changes = {"objects__0__friction": 0.5 * (low + high), "objects__0__uncertainty__friction": 0.5 * (high - low)}
        return scenario.with_changes(**changes)


def needed(w: Array, com_E: Array, reach: Array, off: float) -> tuple[Array, Array]:
    """(T,) friction that a load needs at least, and at most, for any centre of mass in a box com_E +- reach (3,), m.

    w: (T, 12) of the tray frame E. off: m/s^2 by which the specific force may be another, in any direction.
    """
    corner = com_E + np.array(list(product((-1.0, 1.0), repeat=3))) * reach
    omega = w[:, [6, 7, 9, 7, 8, 10, 9, 10, 11]].reshape(-1, 3, 3)  # omega omega^T
    spin = omega - np.trace(omega, axis1=1, axis2=2)[:, None, None] * np.eye(3)
    force = w[:, None, :3] + np.cross(w[:, None, 3:6], corner) + np.einsum("tij,cj->tci", spin, corner)
    along, normal = np.linalg.norm(force[..., :2], axis=2), force[..., 2]
    angle = np.linspace(0.0, 2 * np.pi, DIRECTIONS, endpoint=False)
    ways = np.broadcast_to(np.column_stack([np.cos(angle), np.sin(angle)]), (len(w), DIRECTIONS, 2))
    middle = force[..., :2].mean(axis=1)
    own = middle / np.maximum(np.linalg.norm(middle, axis=1), 1e-12)[:, None]
    pushed = np.einsum("tuk,tck->tuc", np.concatenate([ways, own[:, None]], axis=1), force[..., :2]) - off
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = np.where((pushed > 0) & (normal > off)[:, None], pushed / (normal + off)[:, None], 0.0)
        most = np.where(normal > off, (along + off) / (normal - off), np.inf)
    return ratio.min(axis=2).max(axis=1), most.max(axis=1)


def friction(
    plan: Plan,
    samples: JointSamples | None = None,
    *,
    held: float | None = None,
    slid: float | None = None,
    level: float = LEVEL,
) -> Friction:
    """What a run of a plan shows of the load's friction.

    samples: what the joints did, from rest to rest; None: what was planned, within `UNSEEN`. held: s after the motion
    began until which the load surely did not slide; unless given, to the end when `slid` is not given either. slid: by
    when it surely had begun to. level: deg by which the robot's base may lean.

    Raises ScenarioError for what this cannot be asked of, FileFormatError for a log that is not of the plan.
    """
    scenario = plan.scenario
    body = _lone(scenario)
    if plan.joint is None:
        raise ScenarioError(f"{scenario.name}: this plan has no arm that moves; friction is shown by the arm's motion.")
    if slid is not None and plan.method != METHOD:
        raise ScenarioError(
            f"slid = {slid:g} s: a slip shows friction only where nothing twists the load; make the test with salver "
            "calibrate friction."
        )
    for name, value in (("held", held), ("slid", slid)):
        if value is not None and not 0 <= value <= plan.duration:
            raise ScenarioError(f"{name} = {value:g} s is not within the {plan.duration:.3g} s of the motion.")
    if held is not None and slid is not None and held >= slid:
        raise ScenarioError(f"held = {held:g} s must be before slid = {slid:g} s.")
    arm = load_arm(plan.scenario.arm, scenario.tray)  # type: ignore[arg-type]
    if samples is None:
        t = np.linspace(0.0, plan.duration, 1 + int(np.ceil(plan.duration / STEP)))
        motion, lean = plan.joint.sample(t)[:3], level + UNSEEN
    else:
        done = executed(plan.joint, samples)
        t, motion, lean = done.t, (done.q, done.dq, done.ddq), level
    terms = motion_terms(with_load(arm, scenario.payload.bodies).pin_model, arm.tray_id, *motion)
    off = GRAVITY * float(np.deg2rad(lean) + np.linalg.norm([_half(scenario, p) for p in TILT]))
    least, most = needed(terms.w, body.p_EB, _reach(scenario, body), off)
    high = most + SHAKES * (1 + most)
    until = plan.duration if held is None else held
    before = (t >= 0) & (t <= until) & (held is not None or slid is None)
    low_at = int(np.argmax(np.where(before, least, 0.0)))
    high_at = int(np.argmax(np.where(t <= (slid or 0.0), high, 0.0)))
    return Friction(
        plan,
        float(least[low_at]) if before.any() and least[low_at] > 0 else None,
        float(t[low_at]),
        None if slid is None else float(high[high_at]),
        float(t[high_at]),
    )


def tilt_test(scenario: Scenario, shown: float, level: float = LEVEL) -> Plan:
    """A slow tilt of the tray where the motion starts, and back: that the load does not slide proves `shown`.

    It is safe from tipping for the whole set; of friction it asks for `shown` and what may be wrong about the angle.
    The plan's scenario is one of that friction. Raises ScenarioError when it would tip, or the arm cannot.
    """
    body = _lone(scenario)
    if not 0 < shown <= MOST:
        raise ScenarioError(f"A friction of {shown:g} was asked for; it must be above 0 and at most {MOST:g}.")
    lean = np.deg2rad(level + UNSEEN) + float(np.linalg.norm([_half(scenario, p) for p in TILT]))
    angle = _angle(shown, float(lean))
    rough = _tested(scenario, 2 * MOST)
    steepest = {heading: _steepest(rough, heading) for heading in np.arange(0.0, 2 * np.pi, np.pi / 4)}
    headings = [h for h, most in sorted(steepest.items(), key=lambda item: -item[1]) if most >= angle]
    if not headings:
        most = max(steepest.values())
        gentler = most - STEEPER
        can = max(0.0, (np.sin(gentler) - lean) / (np.cos(gentler) + lean))
        raise ScenarioError(
            f"{body.name} could tip at {np.rad2deg(most):.1f} deg, and to show a friction of {shown:g} the tray must "
            f"tilt by {np.rad2deg(angle):.1f} deg; at most {np.floor(1000 * can) / 1000:g} can be asked for."
        )
    tested = _tested(scenario, (np.tan(angle) + 2 * lean) * (1 + SPARE) + SPARE)
    plans = (_tilted(tested, heading, angle, shown) for heading in headings)
    made = [next(plans)]
    while not made[-1].ok and (another := next(plans, None)) is not None:
        made.append(another)
    if not made[-1].ok:
        arm = made[0].arm_status
        why = arm.sentence if arm is not None and not arm.ok else made[0].verification.sentence
        raise ScenarioError(f"{scenario.name}: no tilt of {np.rad2deg(angle):.1f} deg was found for this arm. {why}")
    return made[-1]


def _lone(scenario: Scenario) -> Body:
    """The one load, which stands on the tray."""
    if scenario.arm is None:
        raise ScenarioError(f"{scenario.name} has no arm; friction is shown by an arm that carries the load.")
    if len(scenario.objects) > 1 or scenario.payload.liquids:
        raise ScenarioError(
            f"{scenario.name} carries several objects or a liquid, and what one contact needs is known for one rigid "
            "load on the tray; calibrate each alone."
        )
    return scenario.payload.first


def _half(scenario: Scenario, parameter: Parameter) -> float:
    return scenario.payload.uncertain.ranges.get(parameter, 0.0)


def _reach(scenario: Scenario, body: Body) -> Array:
    """(3,) m: how far the centre of mass may be from the nominal one, in E, along each axis."""
    half = {p.quantity: h for p, h in scenario.payload.uncertain.ranges.items()}
    own = np.abs(body.R_EB) @ np.array([half.get(f"com_{axis}", 0.0) for axis in "xyz"])
    place = np.array([half.get("position_x", 0.0), half.get("position_y", 0.0), 0.0])
    return np.asarray(own + place)


def _angle(shown: float, lean: float) -> float:
    """rad to tilt by, so that (sin - lean) / (cos + lean) is `shown`."""
    a = np.arctan(shown)
    return float(a + np.arcsin(min(1.0, lean * (1 + shown) * np.cos(a))) + STEEPER)


def _tested(scenario: Scenario, coefficient: float) -> Scenario:
    """The scenario with so much friction, in every direction of its linearised cone, and no way to go."""
    motion = scenario.motion
    start = motion.start.model_dump()
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


def _turn(heading: float, angle: Array) -> Array:
    """(..., 3, 3) turns of the tray about a level axis, so that it falls towards a heading."""
    axis = np.array([-np.sin(heading), np.cos(heading), 0.0])
    return exp(np.multiply.outer(angle, axis))


def _steepest(scenario: Scenario, heading: float) -> float:
    """rad by which a tray at rest may tilt until a load of the set could tip."""
    R_SE = scenario.motion.start.rotation @ scenario.payload.first.R_EB.T
    rows = contact_rows(scenario.payload)
    angles = np.deg2rad(np.arange(0.0, 61.0, 0.25))
    w = np.array([at_rest(turned @ R_SE) for turned in _turn(heading, angles)])
    worst = np.full(len(angles), -np.inf)
    for each in rows:
        tips = each.only(np.flatnonzero(~each.label.astype(bool)))
        worst = np.maximum(worst, tips.worst(w).max(axis=1))
    over = np.flatnonzero(worst > -SPARE)
    return float(angles[over[0] - 1]) if len(over) and over[0] else 0.0 if len(over) else float(angles[-1])


def _tilted(scenario: Scenario, heading: float, angle: float, shown: float) -> Plan:
    start = scenario.motion.start
    one_way = 1.875 * np.rad2deg(angle) / SPEED
    t = np.arange(0.0, 2 * one_way + REST + STEP, STEP)
    t *= (2 * one_way + REST) / t[-1]
    up = np.clip(t / one_way, 0, 1)
    down = np.clip((t - one_way - REST) / one_way, 0, 1)
    share, rate, bend = (_min_jerk(up, k) / one_way**k - _min_jerk(down, k) / one_way**k for k in range(3))
    axis_S = np.array([-np.sin(heading), np.cos(heading), 0.0])
    R_SB = _turn(heading, angle * share) @ start.rotation
    axis_B = start.rotation.T @ axis_S  # the turn leaves its axis where it is
    still = np.zeros((len(t), 3))
    place = still + np.array(start.position)
    turns = (np.outer(angle * x, axis_B) for x in (rate, bend))
    samples = MotionSamples(t, place, still, still, R_SB, *turns)
    timed = scenario.with_changes(motion__duration=float(t[-1]))
    told = f"Tilts by {np.rad2deg(angle):.1f} deg in {one_way:.1f} s and back"
    status = Status(METHOD, f"{told}; that the load does not slide proves a friction of {shown:g}.", True)
    return with_arm(Plan(timed, METHOD, SampledReference(samples), status))


def _min_jerk(u: Array, order: int) -> Array:
    """u^3 (10 - 15 u + 6 u^2) and its derivatives, 0 of these outside."""
    inside = (u > 0) & (u < 1)
    values = (u**3 * (10 - 15 * u + 6 * u**2), 30 * u**2 * (1 - u) ** 2, 60 * u * (1 - u) * (1 - 2 * u))
    return np.asarray(values[order] if order == 0 else values[order] * inside)
