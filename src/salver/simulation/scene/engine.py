"""MuJoCo, or one sentence when it is not there."""

from __future__ import annotations

import os

from salver.errors import MissingDependencyError

try:
    import mujoco
except ImportError:
    raise MissingDependencyError(
        "The physics engine is not installed; install the package mujoco (pip install mujoco) to simulate."
    ) from None
except Exception:
    # MUJOCO_GL asks for an OpenGL that this machine lacks. Physics needs none; render.py makes its own choice.
    _wanted = os.environ.pop("MUJOCO_GL", None)
    os.environ["MUJOCO_GL"] = "disable"
    try:
        import mujoco
    finally:
        os.environ.pop("MUJOCO_GL")
        if _wanted is not None:
            os.environ["MUJOCO_GL"] = _wanted

__all__ = ["mujoco"]
