"""Comparison of an executed motion with its plan, judged for every load in the ranges.

Worst-case contact constraints of a plan are at most 0 (`salver.models.uncertain.worst_case`). Along the executed motion
they may be larger: that violation is the *excess*, as a share of the weight. A common delay of all joints costs
nothing; unequal delays, friction or a wrong payload setting do. A plan with an additional margin of the excess
(`contact.margin`) compensates for it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from salver.errors import ScenarioError
from salver.geometry import Array
from salver.learning.tracking.deviations import STANDSTILL, of_lags, under_torque
from salver.learning.tracking.executed import Executed, executed
from salver.models.arm.arm import ArmModel, load_arm, with_load
from salver.models.contact_rows import ContactRows, contact_rows
from salver.models.uncertain.worst_case import Drift, WorstCase
from salver.motion_files import JointSamples
from salver.planning.plan import Plan
from salver.scenario import Scenario
from salver.sensitivity.arm.terms import MotionTerms, motion_terms
from salver.sensitivity.arm.tracking import JointLoop, joint_loop
from salver.trajectory import JointMotion


@dataclass(frozen=True, eq=False)
class Judge:
    """Judges a motion of an arm with its load: contact constraints of every network, with the arm's response to
    parameter errors."""

    scenario: Scenario
    arm: ArmModel
    model: Any
    contacts: tuple[ContactRows, ...]
    loop: JointLoop | None

    @classmethod
    def of(cls, scenario: Scenario) -> Judge:
        """The judge of a scenario. Raises ScenarioError without an arm, or with a liquid or pendulum."""
        if scenario.arm is None:
            raise ScenarioError(f"{scenario.name} has no arm; what is compared are its joints.")
        payload = scenario.payload
        if payload.dynamic:
            raise ScenarioError(
                f"{scenario.name}: what an executed motion does to {payload.dynamic[0].inside} is not "
                "judged yet; leave it away."
            )
        arm = load_arm(scenario.arm, scenario.tray)
        loop, robot = None, scenario.physics.robot
        if payload.uncertain.size and not arm.weightless:
            loop = joint_loop(scenario, payload.with_only([p for p in payload.uncertain.parameters if p.loads]))
            if robot.control == "position":  # of such a robot, the slowest joint deviates most under a parameter error
                rate = 2 * np.pi * float(np.min(robot.bandwidth))
                loop = replace(loop, kp=rate**2, kd=2 * float(np.min(robot.damping)) * rate)
        return cls(scenario, arm, with_load(arm, payload.bodies).pin_model, contact_rows(payload), loop)

    def terms(self, q: Array, dq: Array, ddq: Array) -> MotionTerms:
        return motion_terms(self.model, self.arm.tray_id, q, dq, ddq)

    def drift(self, t: Array, terms: MotionTerms) -> Drift | None:
        """Tracking perturbation along a motion."""
        if self.loop is None:
            return None
        rates = np.stack([terms.dq, terms.ddq, np.gradient(terms.ddq, t, axis=0)])
        return self.loop.along(t, terms, rates).felt(held=False)[1]

    def rows(self, w: Array, drift: Drift | None) -> tuple[Array, Array]:
        """Largest constraint (K,) of all networks at w (K, 12), and the index (K,) of its interface."""
        best, of, before = np.full(len(w), -np.inf), np.zeros(len(w), dtype=int), 0
        for rows in self.contacts:
            values = WorstCase.of(rows, w, drift).values
            k = np.argmax(values, axis=1)
            top = values[np.arange(len(w)), k]
            of = np.where(top > best, before + rows.interface[k], of)
            best, before = np.maximum(best, top), before + len(rows.network.interfaces)
        return best, of


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

    row: largest worst-case constraint along the executed motion, as a share of the weight, at `time`. planned: that of
    the plan. noise: standard deviation of row by the noise of the log. joints: the one that causes most first.
    """

    plan: Plan
    done: Executed
    row: float
    planned: float
    time: float
    interface: str
    noise: float
    joints: tuple[JointError, ...]

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
        """The `contact.margin` that compensates for the excess: the scenario's plus 1.1 times the largest constraint
        violation plus its uncertainty, or plus the excess if that is larger."""
        lacking = max(self.excess, 1.1 * max(0.0, self.row) + self.uncertainty)
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
    judge = judge or Judge.of(plan.scenario)
    torque = judge.scenario.physics.robot.control == "torque"
    fitted = under_torque(judge.scenario, judge.model, judge.arm.tray_id) if torque else of_lags
    done = executed(plan.joint, samples, fitted)
    t = done.t
    terms = judge.terms(done.q, done.dq, done.ddq)
    drift = judge.drift(t, terms)
    over, of = judge.rows(terms.w, drift)
    k, wanted = int(np.argmax(over)), judge.terms(*plan.joint.sample(t))
    planned = judge.rows(wanted.w, judge.drift(t, wanted))[0].max()
    row, noise = _without_noise(judge, done, drift)
    names = [face.name for rows in judge.contacts for face in rows.network.interfaces]
    joints = tuple(sorted(_joints(judge, plan.joint, done, drift), key=lambda joint: -joint.row))
    return Tracking(plan, done, row, float(planned), float(t[k]), names[of[k]], noise, joints)


def _without_noise(judge: Judge, done: Executed, drift: Drift | None) -> tuple[float, float]:
    """Largest constraint along the executed motion without the bias by noise, and its standard deviation.

    Both come from adding simulated noise: its effect on the smoothed result equals that of the noise in the log.
    """

    def largest(seen: Executed) -> float:
        return float(judge.rows(judge.terms(seen.q, seen.dq, seen.ddq).w, drift)[0].max())

    rng = np.random.default_rng(0)
    drawn = [largest(done.again(done.off + done.noise * rng.standard_normal(done.off.shape))) for _ in range(8)]
    return 2 * largest(done) - float(np.mean(drawn)), float(np.std(drawn))


def _joints(judge: Judge, plan: JointMotion, done: Executed, drift: Drift | None) -> list[JointError]:
    q, dq, ddq = plan.sample(done.t)
    found = []
    for j, name in enumerate(judge.arm.joint_names):
        alone = [x.copy() for x in (q, dq, ddq)]
        for x, real in zip(alone, (done.q, done.dq, done.ddq), strict=True):
            x[:, j] = real[:, j]
        row = float(judge.rows(judge.terms(*alone).w, drift)[0].max())
        speed = dq[:, j]
        scale = np.column_stack([speed, ddq[:, j], np.tanh(speed / STANDSTILL)])
        lag, _, friction = np.linalg.lstsq(scale, done.off[:, j], rcond=1e-9)[0]
        peak = float(np.abs(done.off[:, j]).max())
        noise = float(done.noise[j] * np.sqrt(done.each))
        found.append(JointError(name, peak, -float(lag), abs(float(friction)), noise, row, judge.arm.unit(j)))
    return found
