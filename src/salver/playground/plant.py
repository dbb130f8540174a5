"""The plant of a controller, one period at a time: arm, tray and loose objects in the physics engine."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from salver.control.arm import ArmController, ArmState
from salver.geometry import Array, lean, matrix_from_quat_wxyz
from salver.models.arm.arm import ArmModel
from salver.playground.inner_motions import InnerMotions
from salver.scenario import Scenario
from salver.simulation.scene.engine import mujoco
from salver.simulation.scene.loads import true_world
from salver.simulation.scene.scene import build
from salver.simulation.trace import step


class Plant:
    """The arm with its load in the engine. scene, data: of MuJoCo. inner: liquids and pendulums. period: control
    period, s."""

    def __init__(
        self,
        scenario: Scenario,
        arm: ArmModel,
        parameters: Mapping[str, float] | None = None,
    ) -> None:
        """parameters: true values by name, where not nominal.

        Raises ScenarioError for a parameter that is not known or cannot be.
        """
        self.scene = build(scenario, true_world(scenario, parameters), arm)
        self.data = mujoco.MjData(self.scene.model)
        self.period = scenario.physics.command_period
        self.inner = InnerMotions(self.scene, self.period)
        self._steps = round(self.period / scenario.physics.timestep)
        self._half = 0.5 * np.array(scenario.tray.size)

    @property
    def q(self) -> Array:
        return np.array(self.data.qpos[: self.scene.n])

    @property
    def dq(self) -> Array:
        return np.array(self.data.qvel[: self.scene.n])

    def place(self, q: Array) -> None:
        """Put the arm at q (n,), rad, and all objects at their places, at rest."""
        self.scene.place(self.data, q)
        self.inner.begin()
        self.data.qacc_warmstart[:] = 0

    def step(self, controller: ArmController, t: float) -> None:
        """Advance by one control period from time t, s."""
        torque = controller.step(ArmState(self.q, self.dq), t)
        step(self.scene, self.data, t, torque, self._steps, self.inner.took)

    def p_SB(self, k: int = 0) -> Array:
        """Position (3,) of object k in S, m."""
        i = self.scene.qpos_ids[k]
        return np.array(self.data.qpos[i : i + 3])

    def on_tray(self) -> tuple[Array, Array]:
        """(m, 3) m and (m, 3, 3): poses of the objects in the tray's frame E."""
        (p_SE, R_SE), qpos = self.scene.tray_pose(self.data), self.data.qpos
        p = np.array([qpos[i : i + 3] for i in self.scene.qpos_ids])
        R = np.array([matrix_from_quat_wxyz(qpos[i + 3 : i + 7]) for i in self.scene.qpos_ids])
        return (p - p_SE) @ R_SE, R_SE.T @ R

    def became(self, fallen: float = 0.175) -> list[str]:
        """The outcome of each object: "" on the tray, "lost" off it or at no finite position, "fallen" (leaning by more
        than a limit, rad) or "spilt"."""
        p, R = self.on_tray()
        words = []
        for k, load in enumerate(self.scene.loads):
            on = p[k, 2] >= 0 and bool(np.all(np.abs(p[k, :2]) <= self._half))  # not so for NaN
            tip = float(lean(load.R_EB.T @ R[k]))
            words.append("lost" if not on else "fallen" if tip > fallen else "spilt" if self.inner.beyond(k) else "")
        return words
