"""A step between a policy of LeRobot and its robot that keeps the load on the tray: python examples/lerobot_step.py

Needs LeRobot (https://huggingface.co/docs/lerobot; `pip install lerobot`). `KeepLoad` is the last step of a policy's
postprocessor, where actions are joint positions again: they come in, and the positions of a verified motion that
follows them come out. The motion between them is verified too, so a driver must interpolate smoothly, or ask
`KeepLoad.live.command(t)` at its own rate.

    preprocessor, postprocessor = make_pre_post_processors(policy.config, pretrained_path=path)
    postprocessor.steps = [*postprocessor.steps, KeepLoad("bottle.toml", fps=30, degrees=True, execute=10)]
    chunk = postprocessor(policy.predict_action_chunk(preprocessor(observation)))  # the 10 actions to send
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from lerobot.processor import PolicyActionProcessorStep, ProcessorStepRegistry

import salver as sv

PERIOD = 1e-3  # s from one command to the next


@ProcessorStepRegistry.register("salver_keep_load")
@dataclass
class KeepLoad(PolicyActionProcessorStep):
    """Joint positions in, joint positions out, by a motion that keeps the load.

    An action is (n,), a chunk (T, n) or (1, T, n); a chunk is known further ahead and so followed better. Values after
    the arm's joints in a row (a gripper) pass unchanged.

    scenario: name or path of the scenario with load and arm, which rests at its start when an episode begins. fps:
    actions a second. degrees: whether they are in degrees, else rad. execute: how many of a chunk's actions are carried
    out before the next chunk comes, and so come out (all unless given). every: s of motion between two steps of
    planning, at most; each takes 0.03 to 0.15 s.
    """

    scenario: str
    fps: float = 30.0
    degrees: bool = False
    execute: int | None = None
    every: float = 0.1
    live: sv.Live = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        self.reset()

    def reset(self) -> None:
        """An episode begins: the arm is at rest at its beginning, with the load in its place."""
        self.live = sv.Live(self.scenario)
        self._count, self._planned = 0, -np.inf
        self.live.command(0.0)

    def action(self, action: torch.Tensor) -> torch.Tensor:
        wanted = action.detach().cpu().numpy().astype(float)
        n, unit = self.live.problem.n, np.pi / 180 if self.degrees else 1.0
        rows = wanted.reshape(-1, wanted.shape[-1])
        limits = self.live.problem.limits
        ahead = np.clip(rows[:, :n] * unit, limits.q_min, limits.q_max)
        self.live.chunk((np.arange(len(ahead)) + 1) / self.fps, joints=ahead, source="policy")
        out = rows[: self.execute].copy()
        for row in out:
            row[:n] = self._next() / unit
        shape = (1,) * (wanted.ndim == 3) + out.shape if wanted.ndim > 1 else out.shape[1:]
        return torch.from_numpy(out.reshape(shape)).to(action)

    def _next(self) -> np.ndarray:
        """The commanded posture (n,), rad, an action later."""
        begins, ends = self._count / self.fps, (self._count + 1) / self.fps
        self._count += 1
        for now in np.linspace(begins, ends, int(np.ceil((ends - begins) / PERIOD)) + 1)[1:]:
            if now - self._planned >= self.every - 1e-9:
                self._planned = now
                self.live.plan()
            q = self.live.command(now)[0]
        return q

    def get_config(self) -> dict[str, Any]:
        return {name: getattr(self, name) for name in ("scenario", "fps", "degrees", "execute", "every")}

    def transform_features(self, features: Any) -> Any:
        return features


def main() -> None:
    """0.4 rad to and fro three times in two seconds would lose the cube; what comes out keeps it."""
    step = KeepLoad("panda-cube", fps=30.0)
    start, t = step.live.problem.start.q, np.arange(1, 61) / 30.0
    wild = start + 0.2 * (1 - np.cos(3 * np.pi * t))[:, None] * np.eye(len(start))[0]
    rest = np.repeat(wild[-1:], 40, axis=0)
    out = np.concatenate([step.action(torch.tensor(chunk)).numpy() for chunk in (wild, rest)])
    for name, q in (("the policy's actions", np.vstack([wild, rest])), ("after KeepLoad", out)):
        times = np.arange(len(q) + 1) / 30.0
        columns = dict(zip(step.live.problem.arm.joint_names, np.vstack([start, q]).T, strict=True))
        print(f"{name}: {sv.simulate({'t': times, **columns}, step.scenario).summary['outcome']}")


if __name__ == "__main__":
    main()
