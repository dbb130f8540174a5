"""The environment `salver/Carry-v0` of Gymnasium; this import registers it (docs/howto/gym.md)."""

import gymnasium

from salver.gym.carry import STEP, Carry

__all__ = ["STEP", "Carry"]

gymnasium.register(id="salver/Carry-v0", entry_point="salver.gym.carry:Carry", max_episode_steps=500)
