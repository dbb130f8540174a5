"""MuJoCo, or one sentence when it is not there."""

from __future__ import annotations

from salver.errors import MissingDependencyError

try:
    import mujoco
except ImportError:
    raise MissingDependencyError(
        "The physics engine is not installed; install the package mujoco (pip install mujoco) to simulate."
    ) from None

__all__ = ["mujoco"]
