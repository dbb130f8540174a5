"""The module mujoco, or a MissingDependencyError with one sentence if it is not installed."""

from __future__ import annotations

import os

from salver.errors import MissingDependencyError, needs

try:
    with needs("engine", "The physics engine"):
        import mujoco
except MissingDependencyError:
    raise
except Exception:
    # MUJOCO_GL names a backend that is not available. Physics needs none; render.py chooses its own.
    _wanted = os.environ.pop("MUJOCO_GL", None)
    os.environ["MUJOCO_GL"] = "disable"
    try:
        import mujoco
    finally:
        os.environ.pop("MUJOCO_GL")
        if _wanted is not None:
            os.environ["MUJOCO_GL"] = _wanted

__all__ = ["mujoco"]
