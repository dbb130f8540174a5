"""A step between a policy of LeRobot and its robot that keeps the load on the tray (`pip install lerobot`).

`KeepLoad` is a step for the end of a policy's postprocessor (https://huggingface.co/docs/lerobot, processors), where
actions are joint positions again. It knows the load from a scenario, and bends a verified motion towards the policy's
actions (`salver.live`). Its output is the positions of that motion at the same instants.

The motion between these positions is verified too. A driver that jumps from one action to the next makes another
motion: it must interpolate smoothly, or follow `KeepLoad.live.command(t)` at the rate of its own loop.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from salver.errors import MissingDependencyError, ScenarioError
from salver.geometry import Array
from salver.live.live import Live
from salver.live.replanning.steer import TICK
from salver.live.state import State

try:
    import torch
    from lerobot.processor import PolicyActionProcessorStep, ProcessorStepRegistry
except ImportError as error:
    raise MissingDependencyError(
        f"Steps for policies need LeRobot ({error}); install it with pip install 'salver[lerobot]'."
    ) from None

AHEAD = 3  # actions for which one that comes alone is believed to go on as it does
PERIOD = 1e-3  # s from one command to the next


@ProcessorStepRegistry.register("salver_keep_load")
@dataclass
class KeepLoad(PolicyActionProcessorStep):
    """Joint positions in, joint positions out, by a motion that keeps the load.

    An action is (n,) or (1, n), as `select_action` gives it; a chunk (T, n) or (1, T, n), as `predict_action_chunk`
    does, is known further ahead and so followed better. Values after the arm's joints in a row (a gripper) pass
    unchanged. Values that are not finite, or an action of another shape, raise ValueError in a sentence; positions
    beyond the joints' limits are cut to them.

    scenario: name or path of the scenario with load and arm. fps: actions a second. degrees: whether they are in
    degrees, else rad. execute: how many of a chunk's actions are carried out before the next chunk comes, and so come
    out (all unless given). q: n joint positions, rad, where the arm is at rest when an episode begins (the scenario's
    start unless given). every: s of motion between two steps of planning, at most; each step takes 0.03 to 0.15 s.
    Single actions get one step each.
    """

    scenario: str
    fps: float = 30.0
    degrees: bool = False
    execute: int | None = None
    q: list[float] | None = None
    every: float = 0.1
    live: Live = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        for name in ("fps", "every"):
            if not 0 < getattr(self, name) < np.inf:
                raise ScenarioError(f"{name} = {getattr(self, name)} is no rate or time; it must be positive.")
        if self.execute is not None and self.execute < 1:
            raise ScenarioError(f"execute = {self.execute} carries out nothing; it must be at least 1.")
        self.reset()

    def reset(self) -> None:
        """An episode begins: the arm is at rest at its beginning, with the load in its place."""
        self.live = Live(self.scenario, self.q, lead=TICK)
        self._count, self._planned, self._before = 0, -np.inf, None
        self.live.command(0.0)

    @property
    def state(self) -> State:
        """Outcome of the policy's requests."""
        return self.live.state

    def action(self, action: torch.Tensor) -> torch.Tensor:
        wanted = np.array(action.detach().cpu(), dtype=float)
        alone = wanted.ndim == 1 or (wanted.ndim == 2 and len(wanted) == 1)
        rows = wanted.reshape(-1, wanted.shape[-1]) if wanted.ndim else wanted
        n = self.live.problem.n
        batch = wanted.ndim == 3 and len(wanted) > 1
        if wanted.ndim not in (1, 2, 3) or batch or rows.shape[-1] < n or not len(rows):
            raise ValueError(f"An action has shape {tuple(action.shape)}; it must be ({n},), (T, {n}) or (1, T, {n}).")
        if not np.isfinite(rows).all():
            raise ValueError("An action has values that are not finite.")
        limits, unit = self.live.problem.limits, np.pi / 180 if self.degrees else 1.0
        q = np.clip(rows[:, :n] * unit, limits.q_min, limits.q_max)
        ahead, every = q, self.every
        if alone:
            every = min(every, 1 / self.fps)
            before = q[-1] if self._before is None else self._before
            steps = np.arange(AHEAD + 1)[:, None]
            ahead = np.clip(q[-1] + steps * (q[-1] - before), limits.q_min, limits.q_max)
            self._before = q[-1]
        out = rows[: len(rows) if alone else self.execute].copy()
        self.live.chunk((np.arange(len(ahead)) + 1) / self.fps, joints=ahead, source="policy")
        for row in out:
            row[:n] = self._next(every) / unit
        shape = (1,) * (wanted.ndim == 3) + out.shape if wanted.ndim > 1 else out.shape[1:]
        return torch.from_numpy(out.reshape(shape)).to(action)

    def _next(self, every: float) -> Array:
        """The commanded posture (n,) an action later."""
        begins = self._count / self.fps
        self._count += 1
        ends = self._count / self.fps
        for now in np.linspace(begins, ends, int(np.ceil((ends - begins) / PERIOD)) + 1)[1:]:
            if now - self._planned >= every - 1e-9:
                self._planned = now
                self.live.plan()
            q = self.live.command(now)[0]
        return q

    def get_config(self) -> dict[str, Any]:
        names = ("scenario", "fps", "degrees", "execute", "q", "every")
        return {name: getattr(self, name) for name in names}

    def transform_features(self, features: Any) -> Any:
        return features
