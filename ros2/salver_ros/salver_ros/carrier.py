"""The node's logic without middleware: what comes in by topics and services, and what goes out to the controller.

Times are seconds of the node's clock; frames, units and names are those of salver. No method raises but the
constructor; what cannot be done is answered in one sentence. All but `plan` and `audit` belong to one thread.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

import salver as sv
from salver.auditing.verdict import audit_samples
from salver.errors import SalverError, ScenarioError
from salver.geometry import matrix_from_quat_wxyz, quat_wxyz_from_matrix
from salver.live.live import LONGEST_GAP
from salver.motion_files.samples import joint_samples, reordered
from salver.planning.fastest import AtPosture, FastestOptions, transport_problem
from salver.planning.fastest.planned import plan_problem
from salver.scenario import Scenario
from salver.trajectory import JointMotion


@dataclass(frozen=True)
class Options:
    """What a user chooses.

    world: name of the scenario's frame S. streams: commands are streamed as positions; False: each committed motion is
    handed over whole, so that the controller comes to rest by itself when nothing more comes. heartbeat: s of silence
    on the topic heartbeat after which the arm is stopped; 0: none is expected. silence: s without joint states after
    which it is stopped. old: s after which a twist is not followed any more. at_rest: rad/s, of an arm that may start.
    """

    world: str = "world"
    streams: bool = False
    heartbeat: float = 0.0
    silence: float = 0.2
    old: float = 0.1
    at_rest: float = 0.01


@dataclass(frozen=True)
class Trajectory:
    """A joint motion for a controller: t (K,), s from `begins` on, and q, dq, ddq (K, n) in rad. Between its points it
    is quintic, as splines of joint_trajectory_controller are."""

    names: tuple[str, ...]
    begins: float
    t: np.ndarray
    q: np.ndarray
    dq: np.ndarray
    ddq: np.ndarray


def ordered(names: Sequence[str], values: Sequence[float], wanted: Sequence[str]) -> np.ndarray:
    """The values of the wanted joints. Raises ScenarioError, one sentence."""
    missing = [name for name in wanted if name not in names]
    if missing:
        raise ScenarioError(f"There is no joint {missing[0]}; the message has {', '.join(names) or 'none'}.")
    if len(values) != len(names):
        raise ScenarioError(f"The message has {len(names)} joints and {len(values)} values; it must have one for each.")
    q = np.array([values[list(names).index(name)] for name in wanted], dtype=float)
    if not np.isfinite(q).all():
        raise ScenarioError(f"{wanted[int(np.argmin(np.isfinite(q)))]} is not finite; positions must be numbers.")
    return q


def of_motion(names: tuple[str, ...], motion: JointMotion, begins: float, first: int = 0) -> Trajectory:
    """A motion from its knot `first` on; of knots that a message cannot tell apart, the last."""
    kept = first + np.flatnonzero(np.diff(np.round(motion.t[first:] * 1e9), append=np.inf) > 0)
    return Trajectory(names, begins, motion.t[kept], motion.q[kept], motion.dq[kept], motion.ddq[kept])


class Carrier:
    """A load on a tray, carried by a controller that follows what is committed."""

    def __init__(
        self,
        scenario: str | Scenario,
        names: Sequence[str],
        positions: Sequence[float],
        velocities: Sequence[float] = (),
        options: Options = Options(),
        lead: float | None = None,
    ) -> None:
        """Start where the arm rests. lead: as of `salver.Live`. Raises SalverError, one sentence."""
        self.options = options
        self.scenario = scenario if isinstance(scenario, Scenario) else sv.load_scenario(scenario)
        if self.scenario.arm is None:
            raise ScenarioError(f"{self.scenario.name} has no arm; give a scenario with one.")
        from salver.models.arm.arm import load_arm

        self.joints = load_arm(self.scenario.arm, self.scenario.tray).joint_names
        q = ordered(names, positions, self.joints)
        for name, speed in zip(names, velocities, strict=False):  # some robots tell none
            if name in self.joints and abs(speed) > options.at_rest:
                raise ScenarioError(f"{name} moves at {speed:.3f} rad/s; the arm must rest at first.")
        self.live = sv.Live(self.scenario, q, lead=lead)
        self.command = q  # (n,) rad, for a controller of positions
        self._measured, self._seen = q, -np.inf  # and when
        self._beat = -np.inf
        self._last: float | None = None
        self._sent = self.live.committed
        self._lost = ""  # why the controller does not follow what is committed any more

    # --- in

    def measured(self, names: Sequence[str], positions: Sequence[float], t: float) -> str:
        """A message of joint states; empty, or why it tells nothing or the arm is stopped."""
        try:
            self._measured, self._seen = ordered(names, positions, self.joints), t
        except ScenarioError as error:
            return str(error)
        if self._lost:  # it is somewhere else, and that is told already
            return ""
        status = self.live.measured(self._measured)
        return "" if status.ok else status.sentence

    def beat(self, t: float) -> None:
        """A heartbeat of whoever watches."""
        self._beat = t

    def twist(self, frame: str, stamp: float, v: Sequence[float], omega: Sequence[float], t: float) -> str:
        """A twist of the tray, m/s and rad/s, wished at time `stamp`; empty, or why it is refused."""
        wrong = self._in_world(frame, "The twist")
        if not wrong and not abs(t - stamp) <= self.options.old:
            wrong = f"The twist is {t - stamp:.2f} s old; it must be at most {self.options.old:g} s: set header.stamp."
        if wrong:
            return wrong
        status = self.live.twist(v, omega)
        return "" if status.ok else status.sentence

    def goto(self, frame: str, p: Sequence[float], quat_xyzw: Sequence[float] | None) -> tuple[bool, str]:
        """A pose of the first object's frame B, m; without a quaternion with any heading."""
        if wrong := self._in_world(frame, "The goal"):
            return False, wrong
        if quat_xyzw is None:
            status = self.live.goto(p)
        else:
            quat = np.asarray(quat_xyzw, dtype=float)[[3, 0, 1, 2]]
            length = float(np.linalg.norm(quat))
            if not abs(length - 1.0) <= 1e-3:
                return False, f"The goal's quaternion has the length {length:.3g}; it must be 1."
            status = self.live.goto((p, matrix_from_quat_wxyz(quat / length)))
        return status.ok, status.sentence

    def goto_posture(self, names: Sequence[str], positions: Sequence[float]) -> tuple[bool, str]:
        """A posture as the goal."""
        try:
            status = self.live.goto(q=ordered(names, positions, self.joints))
        except ScenarioError as error:
            return False, str(error)
        return status.ok, status.sentence

    def stop(self, reason: str = "") -> tuple[bool, str]:
        """The stop that keeps the load; it latches until `resume`."""
        status = self.live.stop(reason)
        return status.ok, f"Stopping; at rest in {self.live.state.rests_in:.2f} s at the latest."

    def resume(self) -> tuple[bool, str]:
        """Lift the stop. An arm that rests elsewhere goes on from there; its load must stand still, liquids too."""
        near = not self._lost and np.abs(self._measured - self.command).max() <= self.options.at_rest
        status = self.live.resume() if near else None
        if status is None or not status.ok:
            status = self.live.restart(self._measured, calm=True)
            if status.ok:
                self._sent, self._lost, self.command = self.live.committed, "", self._measured
                status = self.live.resume()
        return status.ok, status.sentence

    def lost(self, reason: str) -> None:
        """The controller does not follow what is committed: stop, and hand nothing over until `resume`."""
        if not self._lost:
            self._lost = reason
            self.live.stop(reason, source="monitor")

    # --- out

    def step(self, t: float) -> Trajectory | None:
        """One period. The motion that the controller is to follow from now on, if it is another one than before."""
        self._watch(t)
        live, self._last = self.live, t
        self.command = live.command(t)[0].copy()
        if live.committed is self._sent or self._lost:
            return None
        self._sent = live.committed
        path, since = live.path
        first = max(int(np.searchsorted(path.t, live.now - since, side="right")) - 1, 0)
        return of_motion(self.joints, path, t - (live.now - since), first)

    def _watch(self, t: float) -> None:
        """Stop when somebody or something is not heard any more while the arm moves."""
        if self.live.committed.at_rest or self.live.now >= self.live.committed.ends:
            return
        options, gap = self.options, 0.0 if self._last is None else t - self._last
        if gap > LONGEST_GAP or gap < 0:
            reason = f"the node was {gap:.2f} s late" if gap > 0 else "the node's clock went back"
            self.live.stop(reason, source="monitor") if options.streams else self.lost(reason)
        elif self.live.stopped:
            return
        elif options.heartbeat and not t - self._beat <= options.heartbeat:
            self.live.stop(f"no heartbeat for {options.heartbeat:g} s", source="monitor")
        elif not t - self._seen <= options.silence:
            self.live.stop(f"no joint states for {options.silence:g} s", source="monitor")

    def state(self) -> tuple[int, str, dict[str, str]]:
        """Level (0 as wished, 1 something was refused or passes, 2 stopped), sentence, facts."""
        state = self.live.state
        level = 2 if state.stopped else 1 if state.refused or state.passing else 0
        return level, str(state), state.facts()

    def markers(self) -> list[dict[str, Any]]:
        """The tray and what stands on it as triangles in the flange's frame: name, points (3 k, 3) m, colour."""
        from salver.models.shapes import shapes
        from salver.models.shapes.hulls import triangles

        arm, tray = self.live.problem.arm, self.scenario.tray
        plate = shapes.box((*tray.size, tray.thickness)).bounding_points_G - [0.0, 0.0, 0.5 * tray.thickness]
        parts = [("tray", plate, None, (0.6, 0.6, 0.6))]
        for body in self.scenario.payload.bodies:
            points, faces = body.points_B, None
            if body.solid.surface is not None:
                points, faces = body.solid.surface[0] - body.com_G, body.solid.surface[1]
            parts.append((body.name, body.p_EB + points @ body.R_EB.T, faces, (0.9, 0.5, 0.1)))
        found = []
        for name, points, faces, colour in parts:
            corners = points[triangles(points) if faces is None else faces].reshape(-1, 3)
            found.append({"name": name, "points": arm.p_FE + corners @ arm.R_FE.T, "colour": colour})
        return found

    def _in_world(self, frame: str, what: str) -> str:
        world = self.options.world
        return (
            "" if frame == world else f'{what} is in the frame "{frame}"; it must be in "{world}", the scenario\'s S.'
        )


def plan(
    scenario: Scenario, start: np.ndarray, goal: np.ndarray, upright: bool, speed: float, seconds: float
) -> tuple[bool, str, Trajectory | None]:
    """The fastest motion that keeps the load from one posture (n,), rad, to another: whether there is one, the verdict.

    upright: with the tray level. speed: share of the arm's full speed, of which accelerations are the square and jerks
    the cube; 0 means 1. seconds: that the search may take. For a process of its own.
    """
    from salver.models.arm.arm import load_arm

    try:
        assert scenario.arm is not None
        arm, first = load_arm(scenario.arm, scenario.tray), scenario.payload.first
        changes: dict[str, Any] = {"motion__duration": None, "arm__start_posture": start.tolist()}
        if upright:
            changes["motion__orientation"] = "fixed"
        if not 0.0 <= speed <= 1.0:
            return False, f"speed is {speed:g}; it must be from 0 to 1.", None
        for power, name in enumerate(("velocity_scale", "acceleration_scale", "jerk_scale"), 1):
            changes[f"arm__{name}"] = getattr(scenario.arm, name) * (speed or 1.0) ** power
        for name, q in (("start", start), ("goal", goal)):
            p, R = arm.object_pose(q, first.p_EB, first.R_EB)
            changes[f"motion__{name}"] = {"position": p.tolist(), "quat_wxyz": quat_wxyz_from_matrix(R).tolist()}
        between = transport_problem(scenario.with_changes(**changes))
        problem = replace(between, start=AtPosture(start), goal=AtPosture(goal))
        found = plan_problem(problem, options=FastestOptions(time_limit=seconds))
    except SalverError as error:
        return False, str(error), None
    if not found.ok or found.joint is None:
        return False, str(found.status), None
    return True, str(found.status), of_motion(arm.joint_names, found.joint, 0.0)


def audit(scenario: Scenario, motion: Trajectory) -> tuple[bool, str]:
    """Whether the load stays along a motion, and the verdict. For a process of its own."""
    from salver.models.arm.arm import load_arm

    try:
        assert scenario.arm is not None
        names, told = load_arm(scenario.arm, scenario.tray).joint_names, "The trajectory"
        dq, ddq = (x if x.size else None for x in (motion.dq, motion.ddq))
        samples = joint_samples(motion.t, motion.names, motion.q, dq, ddq, told, commanded=dq is not None)
        found = audit_samples(reordered(samples, names), scenario)
        return found.ok, f"{found.worst.sentence} {found.arm.sentence}"
    except SalverError as error:
        return False, str(error)
