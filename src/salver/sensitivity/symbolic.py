"""CasADi, which only the engine for loops of your own needs; without it, one sentence that says how to get it."""

from __future__ import annotations

from salver.errors import MissingDependencyError

try:
    import casadi as ca
except ImportError:
    raise MissingDependencyError(
        "Sensitivities of a loop of your own need CasADi; install it with: pip install 'salver[engine]'."
    ) from None

__all__ = ["ca"]
