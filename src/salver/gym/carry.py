"""The Gymnasium environment `salver/Carry-v0`: an arm carries loose objects to a goal, in the physics engine.

    import gymnasium
    import salver.gym

    env = gymnasium.make("salver/Carry-v0", scenario="panda-cube", shield=True)

The load is drawn anew in each episode, from the ranges of the scenario. With `shield` actions are requests to
`salver.Live`, which follows them as closely as keeps the load; without, they are jogging within the arm's own limits
(`salver.playground.unprotected`).
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

import numpy as np

from salver.control.arm import controller_for
from salver.driver.live import STANDARD
from salver.errors import SalverError, ScenarioError, needs
from salver.geometry import Array, quat_wxyz_from_matrix
from salver.live import Live, LiveCourse
from salver.live.replanning.steer import TICK
from salver.playground.plant import Plant
from salver.playground.unprotected import Unprotected
from salver.sampling import draw
from salver.scenario import Scenario, load

with needs("gym", "The environment salver/Carry-v0"):
    import gymnasium
    from gymnasium import spaces

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
        self.arm = self.scenario.load_arm()
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
        self._begin = Live(self.scenario).command(0.0)[0].copy()

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Array, dict[str, Any]]:
        """Begin at the scenario's start with a load drawn from its ranges. options: {"parameters": {name: true value}}
        instead of those.

        Raises ScenarioError for an unknown parameter or an impossible value.
        """
        super().reset(seed=seed)
        uncertain, bodies = self.scenario.payload.uncertain, self.scenario.payload.bodies
        drawn = draw(uncertain, 1, int(self.np_random.integers(2**31)), bodies=bodies)[0]
        self.parameters = dict(zip(uncertain.names, drawn.tolist(), strict=True))
        if options and "parameters" in options:
            if not isinstance(options["parameters"], Mapping):
                raise ScenarioError(f"parameters = {options['parameters']!r}; they are a table of names and values.")
            self.parameters = dict(options["parameters"])
        self.plant, self._t = Plant(self.scenario, self.arm, self.parameters), 0.0
        self.plant.place(self._begin)
        self._live = Live(self.scenario, self._begin, lead=STEP) if self.shield else None
        self._servo = Unprotected(self.arm, self._begin, np.zeros(self.arm.n))
        course = self if self._live is None else LiveCourse(self._live)
        self._controller = controller_for(self.scenario, course, None, arm=self.arm, space="joint")
        self._wanted = np.zeros(len(self.most))
        self._advance(self.scenario.physics.settle_before)
        self._distance = self._away()
        return self._seen(), self._told()

    def step(self, action: Array) -> tuple[Array, float, bool, bool, dict[str, Any]]:
        """Do an action for 0.02 s.

        Raises SalverError for an action that is not a vector with the shape of the action space.
        """
        try:
            asked = np.asarray(action, dtype=float)
        except (TypeError, ValueError):
            asked = np.zeros(0)
        if asked.shape != self.most.shape or not np.isfinite(asked).all():
            raise SalverError(f"The action is {action!r}; it must be {len(self.most)} finite numbers from -1 to 1.")
        self._wanted = np.clip(asked, -1.0, 1.0) * self.most
        if self._live is not None:
            if self.actions == "twist":
                self._live.twist(self._wanted[:3], (0.0, 0.0, self._wanted[3]))
            else:
                t = STEP * np.arange(1, 11)
                limits, q = self.arm.limits, self.plant.q
                self._live.chunk(t, joints=np.clip(q + t[:, None] * self._wanted, limits.q_min, limits.q_max))
            self._live.plan(STANDARD.planning)  # time waits for it
        self._advance(STEP)
        lost, before, self._distance = any(self.plant.became(self.fallen)), self._distance, self._away()
        arrived = not lost and self._distance <= self.near and bool(np.abs(self.plant.dq).max() <= self.still)
        reward = before - self._distance + (1.0 if arrived else -1.0 if lost else 0.0)
        return self._seen(), float(reward), lost or arrived, False, {**self._told(), "arrived": arrived}

    # --- what the controller follows without a shield: `salver.control.arm.Course`

    def instant(self, t: float) -> tuple[int, float]:
        if self.actions == "twist":
            self._servo.step(self._wanted[:3], np.array([0.0, 0.0, self._wanted[3]]), self.plant.period)
        else:
            self._servo.turn(self._wanted, self.plant.period)
        return 0, 0.0

    def at(self, index: int, offset: float) -> tuple[Array, Array, Array]:
        return self._servo.q, self._servo.dq, self._servo.ddq

    # --- the engine

    def _advance(self, seconds: float) -> None:
        for _ in range(round(seconds / self.plant.period)):
            self.plant.step(self._controller, self._t)
            self._t += self.plant.period

    def _away(self) -> float:
        """m from the first object to its goal."""
        return float(np.linalg.norm(self.plant.p_SB() - self.goal))

    def _seen(self) -> Array:
        p_SE, R_SE = self.plant.scene.tray_pose(self.plant.data)
        p, R = self.plant.on_tray()
        parts = (
            self.plant.q, self.plant.dq, p_SE, quat_wxyz_from_matrix(R_SE), self.goal - self.plant.p_SB(), p.ravel(),
            quat_wxyz_from_matrix(R).ravel(),
        )  # fmt: skip
        return np.concatenate(parts).astype(np.float32)

    def _told(self) -> dict[str, Any]:
        """Beside the observation: what nobody could measure."""
        names = (load.name for load in self.plant.scene.loads)
        became = dict(zip(names, self.plant.became(self.fallen), strict=True))
        refused = "" if self._live is None else self._live.refused
        return {"became": became, "parameters": dict(self.parameters), "t": self._t, "refused": refused}
