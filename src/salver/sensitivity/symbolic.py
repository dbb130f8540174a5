"""CasADi, which only user-defined loops need; without it, a MissingDependencyError with one sentence."""

from __future__ import annotations

from salver.errors import MissingDependencyError

try:
    import casadi as ca
except ImportError:
    raise MissingDependencyError(
        "Sensitivities of a user-defined loop need CasADi; install it with: pip install 'salver[engine]'."
    ) from None

__all__ = ["ca"]
