"""Bounds of the friction coefficient from runs: a lower one from a run without slip, an upper one from a slip.

A load with centre of mass c on the tray needs the specific force f(c) = f + alpha x c + omega x (omega x c),
independent of its mass. While it does not slide, its friction coefficient, as the mean over its base weighted by
pressure, is at least |f_t| / f_n. If c and the level of the robot's base are known as ranges, it is at least the
smallest such ratio,

    min over c of |f_t(c)| / f_n(c) = max over unit u of min over corners c of u . f_t(c) / f_n(c)

(both are quasi-linear in c and linear in u: Sion 1958). Every u gives a bound, so that few directions are conservative.
The bound holds for this base and this pressure, not for each of its points, and not for torsional friction.

If a load begins to slide on a slowly tilted tray, which exerts no torsional moment, its friction is at most the
friction needed there.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product

import numpy as np

from salver.errors import SalverError, ScenarioError
from salver.geometry import GRAVITY_S, Array
from salver.learning.logs import one_load
from salver.learning.tracking.executed import executed
from salver.models.arm.arm import with_load
from salver.models.bodies import Body
from salver.models.uncertain.parameters import TILT, Parameter
from salver.motion_files import JointSamples
from salver.planning.plan import Plan
from salver.scenario import Scenario
from salver.sensitivity.arm.terms import MotionTerms, motion_terms

GRAVITY = float(np.linalg.norm(GRAVITY_S))
METHOD = "tilt"


@dataclass(frozen=True)
class FrictionOptions:
    """Options of a friction test: its errors, which make the bounds conservative, and its motion.

    Attributes:
        level: largest tilt error of a robot's base, deg; with twice the value a tilt proves a friction that is 0.01
            lower.
        unseen: deg, largest deviation of the tray from the plan, without a log.
        shakes: amplitude of vibration that the joints do not show and that may start a slip, as a share of gravity.
        speed: speed of a tilt, deg/s; with twice the value the test is shorter and vibrates more.
        hold: time at the largest angle of a tilt, s.
        step: time between the instants at which a tilt is computed, s.
        steeper: angle that is added to the one needed for the requested friction, rad.
        most: largest friction that can be tested: a tilt of about 60 deg.
        harder: relative excess of a plan's contact force over the test's up to which the test counts; with half the
            value the test's own tilt is reported as an excess.
        spare: margin of a test to tipping, as a share of the weight, and additional friction that it demands.
    """

    level: float = 0.5
    unseen: float = 0.2
    shakes: float = 0.02
    speed: float = 4.0
    hold: float = 1.0
    step: float = 0.02
    steeper: float = 1e-3
    most: float = 1.5
    harder: float = 0.1
    spare: float = 0.02


OPTIONS = FrictionOptions()


@dataclass(frozen=True)
class Friction:
    """Range of one load's friction from a run.

    low: lower bound, from the instant `low_time` without slip; None without a bound. high: upper bound, from the slip
    at `high_time`; None without a slip. plan: the plan that was run. force: N, by which the load, at its nominal mass,
    was pressed on the tray then.
    """

    plan: Plan
    low: float | None
    low_time: float
    high: float | None
    high_time: float
    force: float

    @property
    def sentences(self) -> tuple[str, ...]:
        """The result in sentences: contact, range, and limitations."""
        where = f"the base of {self.plan.scenario.payload.first.name} on the tray, as a mean weighted by pressure"
        under = "for every centre of mass and place within the ranges"
        found = (("least", self.low, self.low_time), ("most", self.high, self.high_time))
        values = tuple(
            f"Friction is at {which} {value:.3f} ({where}; {under}): needed at t = {time:.2f} s."
            for which, value, time in found
            if value is not None
        )
        return (*values, self.pressed) if values else values

    @property
    def pressed(self) -> str:
        """A sentence on the force and the mean pressure under which the friction was shown."""
        area = _area(self.plan.scenario.payload.first)
        kPa = f", a mean pressure of {1e-3 * self.force / area:.3g} kPa on {1e4 * area:.3g} cm^2" if area else ""
        return f"It was shown under {self.force:.3g} N{kPa}; surfaces that stick to one another have less under more."

    def against(self, plan: Plan) -> str:
        """A sentence on whether a plan presses its load on the tray harder than it was pressed in the run, both at
        their nominal masses. Raises ScenarioError for a plan without one load on an arm."""
        body = one_load(plan.scenario, "a friction test")
        if plan.joint is None:
            raise ScenarioError(f"{plan.scenario.name}: this plan has no motion of an arm.")
        t = np.linspace(0.0, plan.joint.duration, 401)
        force = body.inertial.mass * float(_pressing(_terms(plan, plan.joint.sample(t)).w, body.p_EB).max())
        if force <= (1 + OPTIONS.harder) * self.force:
            return f"The plan presses with up to {force:.3g} N: the friction holds for it."
        heavier = (force - self.force) / GRAVITY
        return (
            f"The plan presses with up to {force:.3g} N, more than the {self.force:.3g} N of the test: make a second "
            f"test with {heavier:.2g} kg more on the load, in the scenario's mass too, and plan with the smaller "
            "friction of both."
        )

    def learnt_scenario(self, scenario: Scenario | None = None) -> Scenario:
        """A scenario of this load (by default the plan's) with its range of friction narrowed.

        Raises SalverError when the range becomes empty, ScenarioError when the scenario's range of the centre of mass
        exceeds that of the plan.
        """
        scenario = self.plan.scenario if scenario is None else scenario
        body, tested = tested_load(scenario), self.plan.scenario.payload.first
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


def tested_load(scenario: Scenario) -> Body:
    """The only object of a scenario. Raises ScenarioError for a scenario whose friction no run shows."""
    body = one_load(scenario, "a friction test")
    if body.walls is not None:
        raise ScenarioError(f"{body.name} is set against the rim, which holds it too; leave out against for a test.")
    return body


def needed(w: Array, com_E: Array, reach: Array, off: float) -> tuple[Array, Array]:
    """Least and largest friction (T,) that a load needs, for any centre of mass in the box com_E +- reach (3,), m.

    w: (T, 12) of the tray frame E. off: m/s^2, error of the specific force in any direction.
    """
    corner = com_E + np.array(list(product((-1.0, 1.0), repeat=3))) * reach
    force = _force(w, corner)
    along, normal = np.linalg.norm(force[..., :2], axis=2), force[..., 2]
    angle = np.linspace(0.0, 2 * np.pi, 72, endpoint=False)
    round_ = np.broadcast_to(np.column_stack([np.cos(angle), np.sin(angle)]), (len(w), len(angle), 2))
    middle = force[..., :2].mean(axis=1)
    own = middle / np.maximum(np.linalg.norm(middle, axis=1), 1e-12)[:, None]
    pushed = np.einsum("tuk,tck->tuc", np.concatenate([round_, own[:, None]], axis=1), force[..., :2]) - off
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
    level: float | None = None,
) -> Friction:
    """The range of the load's friction from a run of a plan.

    Args:
        samples: log of the joints, from rest to rest; None: as planned, to `OPTIONS.unseen`.
        held: time from the start of the motion, s, until which the load certainly did not slide; default: the whole
            motion, unless `slid` is given.
        slid: time from the start of the motion, s, at which the load certainly had begun to slide.
        level: deg, largest tilt error of the robot's base; default: `OPTIONS.level`.

    Raises:
        ScenarioError: the plan or the observations do not allow it.
        FileFormatError: the log is not of the plan.
    """
    scenario = plan.scenario
    body = tested_load(scenario)
    if plan.joint is None:
        raise ScenarioError(f"{scenario.name}: this plan has no motion of an arm, from which friction is identified.")
    _can_be_seen(plan, held, slid)
    level = OPTIONS.level if level is None else level
    if samples is None:
        t = np.linspace(0.0, plan.duration, 1 + int(np.ceil(plan.duration / 0.02)))
        motion, lean = plan.joint.sample(t)[:3], level + OPTIONS.unseen
    else:
        done = executed(plan.joint, samples)
        t, motion, lean = done.t, (done.q, done.dq, done.ddq), level
    terms = _terms(plan, motion)
    lean = leaning(scenario, lean)
    least, most = needed(terms.w, body.p_EB, _reach(scenario, body), GRAVITY * lean)
    high = most + OPTIONS.shakes * (1 + most)
    until = plan.duration if held is None else held
    before = (t >= 0) & (t <= until) & (held is not None or slid is None)
    low_at = int(np.argmax(np.where(before, least, 0.0)))
    high_at = int(np.argmax(np.where(t <= (slid or 0.0), high, 0.0)))
    shown = bool(before.any() and least[low_at] > 0)
    force = body.inertial.mass * float(_pressing(terms.w, body.p_EB)[low_at if shown else high_at])
    return Friction(
        plan,
        float(least[low_at]) if shown else None,
        float(t[low_at]),
        None if slid is None else float(high[high_at]),
        float(t[high_at]),
        force,
    )


def _terms(plan: Plan, motion: tuple[Array, Array, Array]) -> MotionTerms:
    """Dynamics terms of a plan's arm with its load along the motion (q, dq, ddq), each (T, n)."""
    arm = plan.scenario.load_arm()
    return motion_terms(with_load(arm, plan.scenario.payload.bodies).pin_model, arm.tray_id, *motion)


def _pressing(w: Array, com_E: Array) -> Array:
    """Normal specific force (T,), m/s^2, on a load with this centre of mass, at w (T, 12) of the tray."""
    return _force(w, com_E[None])[:, 0, 2]


def _force(w: Array, places: Array) -> Array:
    """Specific force (T, c, 3) that loads at places (c, 3) of E need, at w (T, 12) of E."""
    omega = w[:, [6, 7, 9, 7, 8, 10, 9, 10, 11]].reshape(-1, 3, 3)  # omega omega^T
    spin = omega - np.trace(omega, axis1=1, axis2=2)[:, None, None] * np.eye(3)
    return np.asarray(w[:, None, :3] + np.cross(w[:, None, 3:6], places) + np.einsum("tij,cj->tci", spin, places))


def _can_be_seen(plan: Plan, held: float | None, slid: float | None) -> None:
    """Raise ScenarioError for impossible observations, or for those that prove nothing."""
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


def leaning(scenario: Scenario, level: float) -> float:
    """Largest tilt error of the tray, rad, by a tilt error of the robot's base, deg, and the scenario's ranges."""
    return float(np.deg2rad(level) + np.linalg.norm([_half(scenario, p) for p in TILT]))


def _area(body: Body) -> float:
    """Area of the base, m^2."""
    x, y = body.base_polygon_B[:, :2].T
    return float(0.5 * abs(x @ np.roll(y, 1) - y @ np.roll(x, 1)))


def _half(scenario: Scenario, parameter: Parameter) -> float:
    return scenario.payload.uncertain.ranges.get(parameter, 0.0)


def _reach(scenario: Scenario, body: Body) -> Array:
    """Largest distance (3,) of the centre of mass from the nominal one along each axis of E, m."""
    half = {p.quantity: h for p, h in scenario.payload.uncertain.ranges.items()}
    own = np.abs(body.R_EB) @ np.array([half.get(f"com_{axis}", 0.0) for axis in "xyz"])
    place = np.array([half.get("position_x", 0.0), half.get("position_y", 0.0), 0.0])
    return np.asarray(own + place)
