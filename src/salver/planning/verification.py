"""The check of a plan's reference: boundary conditions, contact conditions and via poses."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np

from salver.geometry import Array, log
from salver.planning.object.conditions import TILT, apart, unit_of
from salver.planning.object.evaluation import Evaluation, evaluate
from salver.planning.trajopt.constraints.constraints import REACH_BEYOND_TRAY
from salver.scenario import Scenario
from salver.trajectory import Reference

NEAR_ENOUGH = 1e-3  # m: largest distance at which a pose counts as passed; orientation by `REACH_BEYOND_TRAY`
BOUNDARY_TOLERANCE = 1e-9  # m, rad and their rates


@dataclass(frozen=True)
class Verification:
    """Result of the check of a plan's reference, on a grid finer than the planner's.

    instants: number of instants checked. boundary_error: largest error of pose, twist and acceleration at both ends (SI
    units). slack: least contact condition minus its tube, in `unit`, at `time` (s), of the object or interface `body`.
    passes: largest distance at which a via pose is passed, m (`passed`); infinite when they are passed in another
    order, None without one. exactly: whether nothing is uncertain. shake: of the tray, in words; "" for none.
    """

    instants: int
    boundary_error: float
    slack: float
    time: float
    body: str
    unit: str
    passes: float | None = None
    exactly: bool = False
    shake: str = ""

    @property
    def violation(self) -> float:
        return max(0.0, -self.slack)

    @property
    def ok(self) -> bool:
        return self.violation == 0 and self.boundary_error <= BOUNDARY_TOLERANCE and (self.passes or 0.0) <= NEAR_ENOUGH

    @property
    def sentence(self) -> str:
        where = f"{self.body}, at t = {self.time:.3f} s"
        if self.violation > 0:
            what = {TILT: "limit on tilt"}.get(
                self.body, "room of what moves inside" if apart(self.body) else "contact condition"
            )
            return f"The {what} is missed by {self.violation:.3g} {self.unit} ({where})."
        if self.boundary_error > BOUNDARY_TOLERANCE:
            return f"The motion misses its start or goal by {self.boundary_error:.2g} (SI units)."
        if self.passes is not None and self.passes > NEAR_ENOUGH:
            return f"The motion misses a pose to pass by {1e3 * self.passes:.2g} mm, or passes them in another order."
        kept = f"the contact condition keeps {self.slack:.3g} {self.unit} over its tube"
        passed = f" Every pose to pass is passed within {1e3 * self.passes:.2g} mm." if self.passes is not None else ""
        exactly = ", for exactly these values" if self.exactly else ""
        shaken = f" There is margin for a tray that shakes by {self.shake}." if self.shake else ""
        return f"Checked at {self.instants} instants{exactly}: {kept} (least for {where}).{shaken}{passed}"

    @classmethod
    def of(cls, scenario: Scenario, reference: Reference, checked: Evaluation) -> Verification:
        """The check of a reference by its evaluation on a fine grid."""
        slack, when, body = _worst(scenario, reference, checked)
        uncertain, unit = scenario.payload.uncertain, unit_of(scenario, body)
        shake, exactly = "" if uncertain.shake is None else uncertain.shake.words, uncertain.size == 0
        error, passes = _boundary_error(scenario, checked), _passes(scenario, reference)
        return cls(len(checked.t), error, slack, when, body, unit, passes, exactly, shake)

    def record(self) -> dict[str, Any]:
        """Content of `plan.json`."""
        return {
            "ok": self.ok,
            "sentence": self.sentence,
            "instants": self.instants,
            "boundary_error": self.boundary_error,
            "least_slack": self.slack,
            "time": self.time,
            "unit": self.unit,
            "object": self.body,
            **({} if self.passes is None else {"passes": self.passes}),
        }


def _boundary_error(scenario: Scenario, checked: Evaluation) -> float:
    """Largest error of pose, twist and acceleration at both ends, SI units."""
    motion, samples, ends = scenario.motion, checked.samples, [0, -1]
    goals = np.array([motion.start.position, motion.goal.position])
    rotations = np.stack([motion.start.rotation, motion.goal.rotation])
    turn = log(np.swapaxes(rotations, 1, 2) @ samples.R_SB[ends])
    for end, yaw in enumerate((motion.start_yaw, motion.goal_yaw)):
        if yaw == "free":
            turn[end] = np.cross(rotations[end, :, 2], samples.R_SB[ends[end], :, 2])
    still = [x[ends] for x in (samples.v_S, samples.a_S, samples.omega_B, samples.alpha_B)]
    return max(float(np.abs(x).max()) for x in (samples.p_SB[ends] - goals, turn, *still))


def _worst(scenario: Scenario, reference: Reference, checked: Evaluation) -> tuple[float, float, str]:
    """Least slack of the check, its time (s) and its owner. With load dynamics the rest after the motion counts too,
    for one period: on a tilted tray a load that has swung back pushes more."""
    found, period = checked.worst(), scenario.payload.slowest_period
    if period == 0.0 or found[0] < 0.0:
        return found
    count = int(np.ceil(len(checked.t) * (1 + period / reference.duration)))
    return min(found, evaluate(scenario, reference, count, period).worst(since=reference.duration))


def _passes(scenario: Scenario, reference: Reference) -> float | None:
    """Largest distance at which a via pose is passed, m; infinite when they are passed in another order; None without
    one."""
    motion = scenario.motion
    if not motion.through:
        return None
    poses = [(np.array(pose.position), pose.rotation) for pose in motion.through]
    found = passed(reference, poses, motion.goal_yaw == "free")
    in_order = all(one < other for (one, _), (other, _) in pairwise(found))
    return max(away for _, away in found) if in_order else float("inf")


def passed(reference: Reference, poses: Sequence[tuple[Array, Array]], yaw_free: bool) -> list[tuple[float, float]]:
    """The instant, s, and the distance, m (orientation by `REACH_BEYOND_TRAY`), of the closest approach to each
    pose (p_SB, R_SB)."""
    found = []
    for pose in poses:
        low, high = 0.0, reference.duration
        for _ in range(4):  # each in an interval 200 times shorter
            t = np.linspace(low, high, 401)
            samples = reference.sample(t)
            away = _distance(pose, samples.p_SB, samples.R_SB, yaw_free)
            best, step = int(np.argmin(away)), t[1] - t[0]
            low, high = max(0.0, t[best] - step), min(reference.duration, t[best] + step)
        found.append((float(t[best]), float(away[best])))
    return found


def _distance(pose: tuple[Array, Array], p_SB: Array, R_SB: Array, yaw_free: bool) -> Array:
    """Distances (T,), m, of a pose from the poses of a motion."""
    wanted, R_wanted = pose
    turn = log(np.swapaxes(R_SB, 1, 2) @ R_wanted)
    if yaw_free:
        turn = np.cross(R_SB[:, :, 2], R_wanted[:, 2])
    return np.hypot(np.linalg.norm(wanted - p_SB, axis=1), REACH_BEYOND_TRAY * np.linalg.norm(turn, axis=1))
