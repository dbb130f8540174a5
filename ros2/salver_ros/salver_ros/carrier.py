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
from salver.live.committed.motion import resting
from salver.motion_files.samples import joint_samples, reordered
from salver.motion_files.verdict import UNSAFE
from salver.planning.fastest import AtPosture, FastestOptions, transport_problem
from salver.planning.fastest.planned import plan_problem
from salver.planning.stop_library import StopLibrary
from salver.scenario import Scenario
from salver.trajectory import JointMotion

# Keys of a scenario that a plan and the node must share: the verdict on the plan holds for these only.
CELL = ("arm", "tray", "objects", "uncertainty", "contact", "obstacles", "surroundings")


@dataclass(frozen=True)
class Options:
    """What a user chooses.

    world: name of the scenario's frame S. streams: commands are streamed as positions; False: each committed motion is
    handed over whole, so that the controller comes to rest by itself when nothing more comes. heartbeat: s of silence
    on the topic heartbeat after which the arm is stopped; 0: none is expected. silence: s without joint states after
    which it is stopped. old: s after which a twist is not followed any more. at_rest: rad/s and rad, of an arm that may
    start. ahead: s from the request of a plan or of its stop to its beginning, so that the message comes before it.
    """

    world: str = "world"
    streams: bool = False
    heartbeat: float = 0.0
    silence: float = 0.2
    old: float = 0.1
    at_rest: float = 0.01
    ahead: float = 0.03


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


@dataclass
class Run:
    """A plan that is carried out from time `begins` of the clock on. stops: those that it carries. sent: whether the
    controller has the motion; stopping: whether it is one to a stop."""

    motion: JointMotion
    begins: float
    stops: StopLibrary | None
    sent: bool = False
    stopping: bool = False


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
        self._measured, self._seen, self._speed = q, -np.inf, 0.0  # rad, when, and rad/s since the time before
        self._run: Run | None = None
        self._beat = -np.inf
        self._last: float | None = None
        self._sent = self.live.committed
        self._lost = ""  # why the controller does not follow what is committed any more

    # --- in

    def measured(self, names: Sequence[str], positions: Sequence[float], t: float) -> str:
        """A message of joint states; empty, or why it tells nothing or the arm is stopped."""
        try:
            q = ordered(names, positions, self.joints)
        except ScenarioError as error:
            return str(error)
        if t > self._seen:
            self._speed = float(np.abs(q - self._measured).max()) / (t - self._seen)
        self._measured, self._seen = q, t
        if self._lost:  # it is somewhere else, and that is told already
            return ""
        if self._run is not None:
            away = np.abs(q - self.command)
            if away.max() > self.live.options.strayed:
                self.lost(f"{self.joints[int(away.argmax())]} is {away.max():.3f} rad from where the plan has it")
            return ""
        status = self.live.measured(q)
        return "" if status.ok else status.sentence

    def beat(self, t: float) -> None:
        """A heartbeat of whoever watches."""
        self._beat = t

    def twist(self, frame: str, stamp: float, v: Sequence[float], omega: Sequence[float], t: float) -> str:
        """A twist of the tray, m/s and rad/s, wished at time `stamp`; empty, or why it is refused."""
        wrong = self._in_world(frame, "The twist") or self._busy
        if not wrong and not abs(t - stamp) <= self.options.old:
            wrong = f"The twist is {t - stamp:.2f} s old; it must be at most {self.options.old:g} s: set header.stamp."
        if wrong:
            return wrong
        status = self.live.twist(v, omega)
        return "" if status.ok else status.sentence

    def goto(self, frame: str, p: Sequence[float], quat_xyzw: Sequence[float] | None) -> tuple[bool, str]:
        """A pose of the first object's frame B, m; without a quaternion with any heading."""
        if wrong := self._in_world(frame, "The goal") or self._busy:
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
        if self._busy:
            return False, self._busy
        try:
            status = self.live.goto(q=ordered(names, positions, self.joints))
        except ScenarioError as error:
            return False, str(error)
        return status.ok, status.sentence

    def run(self, directory: str, t: float) -> tuple[bool, str]:
        """Carry out the plan of a run directory, which begins where the arm rests; `stop` takes one of its stops."""
        live, options = self.live, self.options
        try:
            plan = sv.load_plan(directory)
        except SalverError as error:
            return False, str(error)
        here, of = self.scenario, plan.scenario
        if plan.verdict.startswith(UNSAFE):
            return False, f"{directory} is not carried out: {plan.verdict}"
        if other := [key for key in CELL if getattr(of, key) != getattr(here, key)]:
            return (
                False,
                f"{directory} was planned for other values of {', '.join(other)}; start with "
                f"scenario:={directory}/scenario.toml.",
            )
        if plan.joint is None:
            return False, f"{directory} has no joint motion; plan it with an arm."
        if options.streams:
            return False, 'A plan is not streamed; start the node with output:=action or "topic".'
        if self._busy or live.stopped or self._lost or not live.settled:
            return False, self._busy or live.stopped or "The arm still moves, or has a goal; a plan begins at rest."
        away = np.abs(self._measured - plan.joint.q[0])
        if away.max() > options.at_rest:
            k = int(away.argmax())
            return (
                False,
                f"{self.joints[k]} is at {self._measured[k]:.3f} rad; the plan begins at {plan.joint.q[0, k]:.3f}.",
            )
        stops = plan.stops
        self._run = Run(plan.joint, t + options.ahead, stops)
        return (
            True,
            plan.verdict if stops else f"It has no stops (salver plan --stops): a stop finishes it. {plan.verdict}",
        )

    def stop(self, reason: str = "") -> tuple[bool, str]:
        """The stop that keeps the load; it latches until `resume`."""
        status = self.live.stop(reason)
        return status.ok, "Stopping as soon as the load allows."

    def resume(self) -> tuple[bool, str]:
        """Lift the stop. An arm that rests elsewhere goes on from there; its load must stand still, liquids too."""
        if self._run is not None or self._speed > self.options.at_rest:
            return False, "The arm still moves."
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
            self._lost, self._run = reason, None
            self.live.stop(reason, source="monitor")

    # --- out

    def step(self, t: float) -> Trajectory | None:
        """One period. The motion that the controller is to follow from now on, if it is another one than before."""
        self._watch(t)
        live, self._last = self.live, t
        self.command = live.command(t)[0].copy()
        if self._run is not None:
            return self._step_run(self._run, t)
        if live.committed is self._sent or self._lost:
            return None
        self._sent = live.committed
        path, since = live.path
        first = max(int(np.searchsorted(path.t, live.now - since, side="right")) - 1, 0)
        return of_motion(self.joints, path, t - (live.now - since), first)

    def _step_run(self, run: Run, t: float) -> Trajectory | None:
        now, first, new = t - run.begins, 0, not run.sent
        if self.live.stopped and not run.stopping:
            run.stopping = True
            if now < 0.0:  # it has not begun; what was sent is replaced by rest
                run.motion = resting(run.motion.q[0])
                new = run.sent
            elif run.stops is not None:
                run.motion = run.stops.stopped(run.motion, now + self.options.ahead)
                first, new = max(int(np.searchsorted(run.motion.t, now, side="right")) - 1, 0), True
        self.command = run.motion.sample(now)[0][0]
        if now > run.motion.duration:
            self._run = None
            status = self.live.restart(run.motion.q[-1])
            self._sent = self.live.committed
            if not status.ok:  # an open liquid may still move: `resume` says that it does not
                self.lost(status.sentence)
            return None
        run.sent = run.sent or new
        return of_motion(self.joints, run.motion, run.begins, first) if new else None

    @property
    def _busy(self) -> str:
        """Why nothing else can be requested, or nothing."""
        return "" if self._run is None else "A plan is carried out; stop, or wait for its end."

    def _watch(self, t: float) -> None:
        """Stop when somebody or something is not heard any more while the arm moves."""
        rests = self.live.committed.at_rest or self.live.now >= self.live.committed.ends
        if rests and self._run is None:
            return
        options, gap = self.options, 0.0 if self._last is None else t - self._last
        if self._run is None and (gap > self.live.options.longest_gap or gap < 0):
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
        return level, " ".join(filter(None, (self._busy, str(state)))), state.facts()

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
