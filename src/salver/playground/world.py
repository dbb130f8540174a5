"""The arm with its load in the physics engine, moved by a live motion or by jogging without protection.

Time is that of the engine. If the engine is stepped late, planning has more time than in reality, never less.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Generator, Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from salver.control.arm import controller_for
from salver.errors import SalverError, Status
from salver.geometry import Array, quat_wxyz_from_matrix
from salver.live import Live, LiveCourse
from salver.live.replanning.wishes import Refused, numbers
from salver.playground.ball import Ball, Throw
from salver.playground.plant import Plant
from salver.playground.unprotected import Unprotected
from salver.scenario import Scenario
from salver.simulation.scene.engine import mujoco


class World:
    """The world of a scenario; one thread steps it, other threads may send requests."""

    def __init__(
        self,
        scenario: Scenario,
        parameters: Mapping[str, float] | None = None,
        *,
        protected: bool = True,
        lead: float | None = None,
    ) -> None:
        """parameters: true values by name, where not nominal. protected: whether `sv.Live` decides what the hand may
        do; else the arm is jogged. lead: see `Live`.

        Raises ScenarioError when there is no arm, or the load is not safe at rest where the motion begins.
        """
        self.scenario, self.live = scenario, Live(scenario, lead=lead)
        self.arm = scenario.load_arm()
        self.plant = Plant(scenario, self.arm, parameters)
        self.period = self.plant.period
        self.ball = Ball(self.arm, scenario.payload, Throw())
        self._lock = threading.RLock()
        self._course = LiveCourse(self.live)
        self.protected = protected
        # Unprotected, as a robot that is jogged: what limits the rate of a torque is its interface for torques.
        jogged = replace(self.arm, limits=replace(self.arm.limits, torque_rate=np.full(self.arm.n, np.inf)))
        self._controller = controller_for(scenario, self, None, arm=self.arm if protected else jogged, space="joint")
        self.begin = self.live.command(0.0)[0].copy()
        self._free: Unprotected | None = None
        self._goal: Array | None = None  # p_SB
        self._hand = (-np.inf, np.zeros(3), np.zeros(3))  # when it spoke last, v_S, omega_S
        self.t = 0.0
        self.note = ""
        self._placed()

    # --- what the controller follows: `salver.control.arm.Course`

    def instant(self, t: float) -> tuple[int, float]:
        index, offset = self._course.instant(t)  # its clock goes on, also when nobody listens
        if self._free is not None:
            self._moved_freely(self._free)
        return index, offset

    def at(self, index: int, offset: float) -> tuple[Array, Array, Array]:
        free = self._free
        return self._course.at(index, offset) if free is None else (free.q, free.dq, free.ddq)

    def _moved_freely(self, free: Unprotected) -> None:
        heard, v, omega = self._hand
        if self.t - heard > 0.1:  # s of silence after a twist
            v = omega = np.zeros(3)
            if self._goal is not None:
                first = self.scenario.payload.bodies[0]
                v = free.towards(self._goal - self.arm.tray_pose(free.q)[1] @ first.p_EB)
        free.step(v, omega, self.period)

    # --- the loop

    def paced(self, behind: float = 0.05) -> Generator[float]:
        """Advance as fast as the clock; slower where the machine does not keep up. Yields 30 times a second the share
        of real time at which it runs; ends where the arm can no longer be controlled, which `note` then says.

        behind: s behind the clock, from where on the world is slowed instead of catching up.
        """
        now = due = time.perf_counter()
        begun, pace, marks = now - self.t, 1.0, [(now, self.t)]
        while True:
            now = time.perf_counter()
            begun = max(begun, now - self.t - behind)
            try:
                while self.t <= now - begun and time.perf_counter() - now <= behind:
                    self.advance()
            except SalverError as error:
                self.note = str(error)
                yield pace
                return
            if now >= due:
                due = now + 1 / 30
                marks = [mark for mark in marks if now - mark[0] < 1.0] + [(now, self.t)]
                spent = now - marks[0][0]
                pace = (self.t - marks[0][1]) / spent if spent > 0.2 else pace
                yield pace
            time.sleep(2e-3)

    def advance(self) -> None:
        """Advance by one control period."""
        with self._lock:
            self.plant.step(self._controller, self.t)
            self.t += self.period
            seen = self.ball.step(self.t, self.plant.q)
            if seen is not None:
                self.live.obstacles(seen)

    # --- who speaks to it

    def say(self, message: Any) -> Status:
        """Handle a message of the page, as JSON: {"goto": [x, y, z]} of the first object, m; {"twist": [vx, vy, vz,
        turn]}, m/s and rad/s about the vertical; {"stop": true}, which latches until {"resume": true}; {"again": true};
        {"throw": true}."""
        if not isinstance(message, dict) or len(message) != 1:
            return Status("refused", "A message has one key.", False)
        ((key, value),) = message.items()
        with self._lock:
            match key:
                case "goto":
                    return self._goto(value)
                case "twist":
                    return self._twist(value)
                case "stop":
                    self._goal, self._hand = None, (-np.inf, np.zeros(3), np.zeros(3))
                    return self.live.stop()
                case "resume":
                    return self.live.resume()
                case "throw" if value is True:
                    self.ball.throw(self.t, self.plant.scene.tray_pose(self.plant.data)[0])
                    return Status("accepted", "", True)
                case "again":
                    return self._again()
        return Status("refused", f'There is no message "{str(key)[:40]}".', False)

    def _goto(self, value: Any) -> Status:
        try:
            p = numbers(value, (3,), "the goal")
        except Refused as reason:
            return reason.status
        status = self.live.goto(p) if self.protected else Status("accepted", "", True)
        self._goal = p if status.ok else None
        return status

    def _twist(self, value: Any) -> Status:
        try:
            twist = numbers(value, (4,), "the twist")
        except Refused as reason:
            return reason.status
        v, omega = twist[:3], np.array([0.0, 0.0, twist[3]])
        self._goal = None
        self._hand = (self.t, v, omega)
        return self.live.twist(v, omega) if self.protected else Status("accepted", "", True)

    def _again(self) -> Status:
        """The arm where it began, everything in its place."""
        while not self.live.committed.at_rest and self.live.now < self.live.committed.ends:
            self.t += self.period
            self.live.command(self.t)
        status = self.live.restart(self.begin, calm=True)  # the scene begins anew
        self.live.resume()
        self._goal, self._hand = None, (-np.inf, np.zeros(3), np.zeros(3))
        self._placed()
        return status

    def _placed(self) -> None:
        self._free = None if self.protected else Unprotected(self.arm, self.begin, np.zeros(self.arm.n))
        self.plant.place(self.begin)
        self._controller.reset()
        self._course.instant(self.t)
        for _ in range(50):  # until it bears its weight
            self.advance()
        self._rest = self.plant.on_tray()[0]

    # --- what is seen

    def _became(self) -> list[str]:
        """Of each object: nothing, or what became of it."""
        slid = np.linalg.norm((self.plant.on_tray()[0] - self._rest)[:, :2], axis=1) > 5e-3  # m
        return [word or ("slid" if k else "") for word, k in zip(self.plant.became(), slid, strict=True)]

    def friction_used(self) -> list[float]:
        """Friction in use of each object: tangential force on its feet over the largest friction force of its support;
        1 when it slides, infinite when it does not stand there."""
        scene, data = self.plant.scene, self.plant.data
        pull = np.zeros((len(scene.loads), 3))
        held = np.zeros(len(scene.loads))
        force = np.empty(6)
        for i in range(data.ncon):
            contact = data.contact[i]
            foot = max(contact.geom, key=lambda geom: scene.foot_object[geom])
            k = scene.foot_object[foot]
            if k < 0:
                continue
            mujoco.mj_contactForce(scene.model, data, i, force)
            tangents = contact.frame.reshape(3, 3)[1:]
            sign = 1.0 if foot == contact.geom[1] else -1.0
            pull[k] += sign * force[1:3] @ tangents
            held[k] += contact.friction[0] * force[0]
        return [float(np.linalg.norm(x) / y) if y > 0 else np.inf for x, y in zip(pull, held, strict=True)]

    def frame(self) -> dict[str, Any]:
        """The content of the page at this instant, ready for JSON."""
        from salver.reports.pages.replay import joint_poses

        with self._lock:
            data, scene, q = self.plant.data, self.plant.scene, self.plant.q
            p_SE, R_SE = scene.tray_pose(data)
            v_E = (self.arm.body_jacobian(q) @ self.plant.dq)[:3]
            state, words = self.live.state, self._became()
            live = (state.stopped, state.passing, state.refused) if self.protected else ()
            p_ball, r_ball = np.round(self.ball.at(self.t)[0], 4).tolist(), self.ball.radius
            return {
                "t": round(self.t, 3),
                "joints": np.round(joint_poses(q[None], self.arm)[0], 5).ravel().tolist(),
                "tray": np.round([*p_SE, *quat_wxyz_from_matrix(R_SE)], 5).tolist(),
                "objects": [np.round(data.qpos[i : i + 7], 5).tolist() for i in scene.qpos_ids],
                "inside": [
                    x and {"moves": np.round(x.page(np.array([0]))["moves"][0], 4).tolist(), "beyond": x.beyond}
                    for x in self.plant.inner.shown
                ],
                "speed": round(float(np.linalg.norm(v_E)), 4),
                "friction": [round(min(x, 9.99), 4) for x in self.friction_used()],
                "load": [{"name": load.name, "became": word} for load, word in zip(scene.loads, words, strict=True)],
                "goal": None if self._goal is None else self._goal.tolist(),
                "protected": self.protected,
                "stopped": bool(state.stopped) and self.protected,
                "doing": state.doing if self.protected else "unprotected",
                "planning": self.protected and not self.live.settled,
                "restsIn": round(state.rests_in, 3),
                "limit": state.limit,
                "nearest": state.nearest,
                "margin": round(state.margin, 4),
                "said": " ".join(filter(None, (*live, self.ball.sentence, self.note))),
                "lead": round(state.lead, 3),
                "path": self._path(),
                "balls": [{"p": p_ball, "r": r_ball}] if self.ball.flies else [],
            }

    def _path(self) -> list[list[float]]:
        """Where the tray's centre goes by what is committed, until it rests."""
        committed, now = self.live.committed, self.live.now
        if not self.protected or now >= committed.ends:
            return []
        t = np.linspace(max(now - committed.begins, 0.0), committed.motion.duration, 40)
        return [np.round(self.arm.tray_pose(q)[0], 4).tolist() for q in committed.motion.sample(t)[0]]
