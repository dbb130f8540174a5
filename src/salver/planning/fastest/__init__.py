"""The fastest motion that stays safe: shortest duration within the arm's limits, contact kept for all parameters."""

from salver.planning.fastest.problem import TransportProblem, transport_problem
from salver.planning.fastest.search import (
    FastestMotion,
    FastestOptions,
    fastest,
    joint_plan,
    object_motion,
    plan_fastest,
)

__all__ = [
    "FastestMotion",
    "FastestOptions",
    "TransportProblem",
    "fastest",
    "joint_plan",
    "object_motion",
    "plan_fastest",
    "transport_problem",
]
