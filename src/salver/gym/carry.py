"""The Gymnasium environment `salver/Carry-v0`: an arm carries loose objects to a goal, in the physics engine.

    import gymnasium
    import salver.gym

    env = gymnasium.make("salver/Carry-v0", scenario="panda-cube", shield=True)

What stands on the tray is drawn anew in each episode, from the ranges of the scenario. With `shield` actions are
requests to `salver.Live`, which follows them as closely as keeps the load; without, they are jogging within the arm's
own limits (`salver.playground.unprotected`).
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal

import numpy as np

from salver.control.arm import ArmState, controller_for
from salver.driver.live import NO_HURRY
from salver.errors import MissingDependencyError, ScenarioError
from salver.geometry import Array, matrix_from_quat_wxyz, quat_wxyz_from_matrix
from salver.live import Live, LiveCourse
from salver.live.replanning.steer import TICK
from salver.models.arm.arm import load_arm
from salver.playground.inner_motions import InnerMotions
from salver.playground.unprotected import Unprotected
from salver.sampling import draw
from salver.scenario import Scenario, load
from salver.simulation.scene.engine import mujoco
from salver.simulation.scene.loads import true_world
from salver.simulation.scene.scene import build

try:
    import gymnasium
    from gymnasium import spaces
except ImportError:
    raise MissingDependencyError(
        "The environment salver/Carry-v0 needs Gymnasium; install it with: pip install 'salver[gym]'."
    ) from None

STEP = TICK  # s of an action
Actions = Literal["twist", "joints"]


class Carry(gymnasium.Env[Array, Array]):
    """See `docs/howto/gym.md` for actions, observation, reward and ends of an episode."""

    metadata: dict[str, Any] = {"render_modes": []}  # noqa: RUF012

    def __init__(
        self,
        scenario: Scenario | str | Path = "panda-cube",
        actions: Actions = "twist",
        shield: bool = False,
        speed: float = 1.0,
        turn: float = 2.0,
        near: float = 0.01,
        still: float = 0.05,
        fallen: float = 0.175,
        render_mode: str | None = None,
    ) -> None:
        """scenario: with an arm, of one leg. actions: "twist" of the tray or "joints". speed, turn: m/s and rad/s of a
        twist's largest action. near: m from the goal, and still: rad/s of each joint, where it has arrived. fallen: rad
        by which an object has tipped over.

        Raises ScenarioError for a scenario without an arm, or one that is not known.
        """
        self.scenario = scenario if isinstance(scenario, Scenario) else load(scenario)
        if self.scenario.arm is None or self.scenario.legs:
            raise ScenarioError(f"{self.scenario.name} has no arm, or several legs; salver/Carry-v0 wants one of each.")
        if actions not in ("twist", "joints"):
            raise ScenarioError(f'actions is "{actions}"; it must be twist or joints.')
        self.arm = load_arm(self.scenario.arm, self.scenario.tray)
        self.actions, self.shield, self.render_mode = actions, shield, render_mode
        self.near, self.still, self.fallen = near, still, fallen
        n, bodies = self.arm.n, self.scenario.payload.bodies
        self.most = np.array([speed] * 3 + [turn]) if actions == "twist" else self.arm.limits.velocity
        self.action_space = spaces.Box(-1.0, 1.0, (len(self.most),), np.float32)
        sizes = {
            "q": n,
            "dq": n,
            "p_SE": 3,
            "quat_SE": 4,
            "to_goal": 3,
            "p_EB": 3 * len(bodies),
            "quat_EB": 4 * len(bodies),
        }
        ends = np.cumsum(list(sizes.values())).tolist()
        self.parts = {name: slice(end - size, end) for (name, size), end in zip(sizes.items(), ends, strict=True)}
        self.observation_space = spaces.Box(-np.inf, np.inf, (ends[-1],), np.float32)
        self.goal = np.array(self.scenario.motion.goal.position)
        self._period = self.scenario.physics.command_period
        self._steps = round(self._period / self.scenario.physics.timestep)
        self._begin = Live(self.scenario).command(0.0)[0].copy()

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Array, dict[str, Any]]:
        """Begin at the scenario's start with a load drawn from its ranges. options: {"parameters": {name: true value}}
        instead of those."""
        super().reset(seed=seed)
        uncertain, bodies = self.scenario.payload.uncertain, self.scenario.payload.bodies
        drawn = draw(uncertain, 1, int(self.np_random.integers(2**31)), bodies=bodies)[0]
        self.parameters = dict(zip(uncertain.names, drawn.tolist(), strict=True))
        if options and "parameters" in options:
            self.parameters = dict(options["parameters"])
        self._scene = build(self.scenario, true_world(self.scenario, self.parameters), self.arm, seed=0)
        self._data = mujoco.MjData(self._scene.model)
        self._scene.place(self._data, self._begin)
        self._inner, self._t, self._ended = InnerMotions(self._scene, self._period), 0.0, False
        self._live = Live(self.scenario, self._begin, lead=STEP) if self.shield else None
        self._servo = Unprotected(self.arm, self._begin, np.zeros(self.arm.n))
        course = self if self._live is None else LiveCourse(self._live)
        self._controller = controller_for(self.scenario, course, None, arm=self.arm, space="joint")
        self._wanted = np.zeros(len(self.most))
        for _ in range(round(self.scenario.physics.settle_before / self._period)):
            self._advance()
        self._distance = self._away()
        return self._seen(), self._told()

    def step(self, action: Array) -> tuple[Array, float, bool, bool, dict[str, Any]]:
        """Do an action for 0.02 s."""
        self._wanted = np.clip(np.asarray(action, dtype=float), -1.0, 1.0) * self.most
        if self._live is not None:
            if self.actions == "twist":
                self._live.twist(self._wanted[:3], (0.0, 0.0, self._wanted[3]))
            else:
                t = STEP * np.arange(1, 11)
                limits, q = self.arm.limits, self._data.qpos[: self.arm.n]
                self._live.chunk(t, joints=np.clip(q + t[:, None] * self._wanted, limits.q_min, limits.q_max))
            self._live.plan(NO_HURRY)  # time waits for it
        for _ in range(round(STEP / self._period)):
            self._advance()
        became, before, self._distance = self._became(), self._distance, self._away()
        lost = any(word in ("lost", "fallen", "spilt") for word in became)
        dq = self._data.qvel[: self.arm.n]
        arrived = not lost and self._distance <= self.near and bool(np.abs(dq).max() <= self.still)
        reward = before - self._distance + (1.0 if arrived else -1.0 if lost else 0.0)
        return self._seen(), float(reward), lost or arrived, False, {**self._told(), "arrived": arrived}

    # --- what the controller follows without a shield: `salver.control.arm.Course`

    def instant(self, t: float) -> tuple[int, float]:
        if self.actions == "twist":
            self._servo.step(self._wanted[:3], np.array([0.0, 0.0, self._wanted[3]]), self._period)
        else:
            self._servo.turn(self._wanted, self._period)
        return 0, 0.0

    def at(self, index: int, offset: float) -> tuple[Array, Array, Array]:
        return self._servo.q, self._servo.dq, self._servo.ddq

    # --- the engine

    def _advance(self) -> None:
        """One control period."""
        data, scene, n = self._data, self._scene, self.arm.n
        state = ArmState(data.qpos[:n].copy(), data.qvel[:n].copy())
        torque = self._controller.step(state, self._t)
        data.qfrc_applied[:n] = torque
        scene.shake(data, self._t)
        mujoco.mj_step(scene.model, data)
        self._inner.took(self._t, state.q, state.dq, torque, data)
        if self._steps > 1:
            mujoco.mj_step(scene.model, data, nstep=self._steps - 1)
        self._t += self._period

    def _on_tray(self) -> tuple[Array, Array]:
        """(m, 3) m and (m, 3, 3): poses of the objects in the tray's frame E."""
        (p_SE, R_SE), qpos = self._scene.tray_pose(self._data), self._data.qpos
        p = np.array([qpos[i : i + 3] for i in self._scene.qpos_ids])
        R = np.array([matrix_from_quat_wxyz(qpos[i + 3 : i + 7]) for i in self._scene.qpos_ids])
        return (p - p_SE) @ R_SE, R_SE.T @ R

    def _away(self) -> float:
        """m from the first object to its goal."""
        i = self._scene.qpos_ids[0]
        return float(np.linalg.norm(self._data.qpos[i : i + 3] - self.goal))

    def _became(self) -> list[str]:
        """Of each object: "", "fallen", "lost" or "spilt"."""
        p, R = self._on_tray()
        half, words = 0.5 * np.array(self.scenario.tray.size), []
        _ = self._inner.shown  # up to now
        for k, one in enumerate(self._scene.loads):
            tip = float(np.arccos(np.clip((one.R_EB.T @ R[k])[2, 2], -1.0, 1.0)))
            off = p[k, 2] < 0 or bool(np.any(np.abs(p[k, :2]) > half))
            words.append("lost" if off else "fallen" if tip > self.fallen else "spilt" if self._inner.beyond(k) else "")
        return words

    def _seen(self) -> Array:
        p_SE, R_SE = self._scene.tray_pose(self._data)
        (p, R), i, n = self._on_tray(), self._scene.qpos_ids[0], self.arm.n
        parts = (
            self._data.qpos[:n], self._data.qvel[:n], p_SE, quat_wxyz_from_matrix(R_SE),
            self.goal - self._data.qpos[i : i + 3], p.ravel(), quat_wxyz_from_matrix(R).ravel(),
        )  # fmt: skip
        return np.concatenate(parts).astype(np.float32)

    def _told(self) -> dict[str, Any]:
        """Beside the observation: what nobody could measure."""
        became = dict(zip((one.name for one in self._scene.loads), self._became(), strict=True))
        refused = "" if self._live is None else self._live.refused
        return {"became": became, "parameters": dict(self.parameters), "t": self._t, "refused": refused}
