"""Comparison of an executed motion with its plan, judged for every load in the ranges.

Worst-case contact constraints of a plan are at most 0 (`salver.models.uncertain.worst_case`). Along the executed motion
they may be larger: that violation is the *excess*, as a share of the weight. A common delay of all joints costs
nothing; unequal delays, friction or a wrong payload setting do. A plan with an additional margin of the excess
(`contact.margin`) compensates for it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from salver.errors import ScenarioError
from salver.geometry import Array
from salver.learning.tracking.deviations import STANDSTILL, of_lags, under_torque
from salver.learning.tracking.executed import Executed, executed
from salver.learning.tracking.vibration import vibration_of
from salver.models.arm.arm import ArmModel
from salver.models.tray_motion import FULL_SPEED
from salver.models.uncertain.parameters import Vibration
from salver.motion_files import JointSamples
from salver.planning.plan import Plan
from salver.planning.stops import Space
from salver.planning.trajopt.constraints.constraints import ContactConstraint
from salver.planning.trajopt.evaluation import MotionEvaluation
from salver.planning.trajopt.problem import TransportProblem, transport_problem
from salver.scenario import Scenario
from salver.trajectory import JointMotion


@dataclass(frozen=True, eq=False)
class Judge:
    """Judges a motion of an arm with its load by the contact constraints of a plan's own verdict: at all speeds that
    the scenario asks for, with an arm that follows exactly, and with one that deviates under parameter errors.

    constraints: those of every network of touching objects, without margins.
    """

    problem: TransportProblem
    constraints: tuple[ContactConstraint, ...]

    @classmethod
    def of(cls, scenario: Scenario, space: Space = "joint") -> Judge:
        """The judge of a scenario, for plans in a space (`Plan.space`): the verdict on a plan in object space takes the
        arm to follow exactly. Raises ScenarioError without an arm, or with a liquid or pendulum."""
        if scenario.arm is None:
            raise ScenarioError(f"{scenario.name} has no arm; track compares joints.")
        payload = scenario.payload
        if payload.dynamic:
            raise ScenarioError(
                f"{scenario.name}: what an executed motion does to {payload.dynamic[0].inside} is not "
                "judged yet; leave it away."
            )
        problem = transport_problem(scenario.with_changes(arm__start_posture=None, motion__through=[]))
        loop = None if space == "object" else problem.tracking
        # A log has the delay of held commands in it.
        problem = replace(problem, tracking=loop and replace(loop, delay=0.0))
        speeds = (FULL_SPEED,) if scenario.contact.condition == "paper" else problem.speeds
        found = (
            ContactConstraint(rows, 0.0, speed, exactly=exactly, coarsely=True)
            for rows in problem.contacts
            for speed in speeds
            for exactly in ((True,) if loop is None else (True, False))
        )
        return cls(problem, tuple(found))

    @property
    def arm(self) -> ArmModel:
        return self.problem.arm

    def along(self, t: Array, states: Sequence[Array], like: MotionEvaluation | None = None) -> MotionEvaluation:
        """A motion of q, dq, ddq (K, n) at t (K,), s. like: a similar one, whose deviation under parameter errors is
        used."""
        z = np.stack([*states, np.gradient(states[2], t, axis=0)])
        found = self.problem.at((t - t[0]) / np.ptp(t), z, float(np.ptp(t)), imposed=False)
        return found if like is None else found.straying_as(like)

    def largest(self, motion: MotionEvaluation) -> tuple[float, int, str]:
        """The largest constraint along a motion, the index of its instant, and the name of its interface."""
        best = -np.inf, 0, ""
        for constraint in self.constraints:
            (block,) = constraint.blocks(motion)
            k, i = np.unravel_index(int(np.argmax(block.values)), block.values.shape)
            if block.values[k, i] > best[0]:
                interface = constraint.rows.network.interfaces[int(constraint.rows.interface[i])]
                best = float(block.values[k, i]), int(k), interface.name + constraint.speed.words
        return best


@dataclass(frozen=True)
class JointError:
    """Deviation of one joint.

    peak: largest deviation. lag: s, delay beyond the common one. friction: part of the deviation that changes its sign
    with the velocity. noise: standard deviation of a sample of the log. row: largest constraint if this joint alone had
    deviated. unit: of peak, friction and noise, rad or m.
    """

    name: str
    peak: float
    lag: float
    friction: float
    noise: float
    row: float
    unit: str


@dataclass(frozen=True, eq=False)
class Tracking:
    """Result of the comparison.

    row: largest worst-case constraint along the executed motion, as a share of the weight, at `time`. noise: its
    standard deviation by the noise of the log. calm: both without the tray's vibration. planned: that of the plan.
    joints: the one that causes most first. shake: vibration of the tray that the commanded motion does not explain;
    None if there is none beside noise.
    """

    plan: Plan
    done: Executed
    row: float
    calm: tuple[float, float]
    planned: float
    time: float
    interface: str
    noise: float
    joints: tuple[JointError, ...]
    shake: Vibration | None

    @property
    def excess(self) -> float:
        """The excess: missing margin of the executed motion, as a share of the weight; 0 if none is missing.

        It includes two standard deviations of the effect of noise, to be conservative.
        """
        return max(0.0, self.row + 2 * self.noise)

    @property
    def uncertainty(self) -> float:
        """Uncertainty of the excess, doubled, because smoothing also removes real deviation."""
        return 4 * self.noise

    @property
    def ok(self) -> bool:
        """Whether the constraints are satisfied by more than their uncertainty."""
        return self.row + self.uncertainty <= 0

    @property
    def margin(self) -> float:
        """The `contact.margin` that, beside `shake`, compensates for the excess: the scenario's plus 1.1 times the
        largest constraint violation plus its uncertainty."""
        row, noise = self.calm
        lacking = max(0.0, row + 2 * noise, 1.1 * max(0.0, row) + 4 * noise)
        return self.plan.scenario.contact.margin + lacking

    @cached_property
    def cause(self) -> str:
        """The joint that causes most of the excess, with its kind of deviation, in words."""
        joint = self.joints[0]
        kind = "lags by" if joint.lag > 0 else "leads by"
        what = f"{kind} {abs(1e3 * joint.lag):.2f} ms against all together"
        if joint.friction * 2 > joint.peak:
            what = "strays against its velocity, as with friction that is not compensated"
        return f"{joint.name} {what} ({1e3 * joint.peak:.2f} m{joint.unit} off at most)"


def track(plan: Plan, samples: JointSamples, judge: Judge | None = None) -> Tracking:
    """Compare the executed motion with a plan of an arm. samples: log with joints in the arm's order (`read_joints`).

    Raises ScenarioError for a plan without a joint motion, FileFormatError for a log that is not of it.
    """
    if plan.joint is None:
        raise ScenarioError(f"{plan.scenario.name}: this plan has no motion of an arm; tracking compares joints.")
    judge = judge or Judge.of(plan.scenario, plan.space)
    torque = plan.scenario.physics.robot.control == "torque"
    fitted = under_torque(plan.scenario, judge.problem.model, judge.arm.tray_id) if torque else of_lags
    done = executed(plan.joint, samples, fitted)
    motion = judge.along(done.t, done.states)
    shake, steady = vibration_of(done, motion.terms), done
    if shake is not None:
        steady = done.without_vibration()
        known = plan.uncertain.shake
        if known is not None and known.covers(shake):  # the constraints count it
            done, motion = steady, judge.along(steady.t, steady.states)
    worst, k, interface = judge.largest(motion)
    row, noise = _without_noise(judge, done, motion, worst)
    calm = row, noise
    if steady is not done:
        calm = _without_noise(judge, steady, motion, judge.largest(judge.along(steady.t, steady.states, motion))[0])
    planned = judge.largest(judge.along(done.t, plan.joint.sample(done.t)))[0]
    joints = tuple(sorted(_joints(judge, plan.joint, done, motion), key=lambda joint: -joint.row))
    return Tracking(plan, done, row, calm, planned, float(done.t[k]), interface, noise, joints, shake)


def _without_noise(judge: Judge, done: Executed, motion: MotionEvaluation, row: float) -> tuple[float, float]:
    """Largest constraint along the executed motion without the bias by noise, and its standard deviation.

    Both come from adding simulated noise: its effect on the smoothed result equals that of the noise in the log.
    """
    rng, drawn = np.random.default_rng(0), []
    for _ in range(8):
        seen = done.again(done.off + done.noise * rng.standard_normal(done.off.shape))
        drawn.append(judge.largest(judge.along(seen.t, seen.states, motion))[0])
    return 2 * row - float(np.mean(drawn)), float(np.std(drawn))


def _joints(judge: Judge, plan: JointMotion, done: Executed, motion: MotionEvaluation) -> list[JointError]:
    q, dq, ddq = plan.sample(done.t)
    found = []
    for j, name in enumerate(judge.arm.joint_names):
        alone = [x.copy() for x in (q, dq, ddq)]
        for x, real in zip(alone, done.states, strict=True):
            x[:, j] = real[:, j]
        row = judge.largest(judge.along(done.t, alone, motion))[0]
        speed = dq[:, j]
        scale = np.column_stack([speed, ddq[:, j], np.tanh(speed / STANDSTILL)])
        lag, _, friction = np.linalg.lstsq(scale, done.off[:, j], rcond=1e-9)[0]
        peak = float(np.abs(done.off[:, j]).max())
        noise = float(done.noise[j] * np.sqrt(done.each))
        found.append(JointError(name, peak, -float(lag), abs(float(friction)), noise, row, judge.arm.unit(j)))
    return found
