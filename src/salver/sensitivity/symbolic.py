"""CasADi, which only user-defined loops need; without it, a MissingDependencyError with one sentence."""

from __future__ import annotations

from salver.errors import needs

with needs("own-loop", "A user-defined loop"):
    import casadi as ca

__all__ = ["ca"]
