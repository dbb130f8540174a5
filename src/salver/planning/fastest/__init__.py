"""The fastest safe motion: least duration within the arm's limits, with contact kept for all uncertain parameters.

How to add constraints, objectives and end conditions: docs/extending.md.
"""

from salver.planning.fastest.optimum import nearby
from salver.planning.fastest.options import EFFORTS, FastestOptions
from salver.planning.fastest.planned import joint_plan, plan_fastest
from salver.planning.fastest.search import fastest
from salver.planning.trajopt.constraints.constraints import Block, Constraint, evaluate, padded, worst_of
from salver.planning.trajopt.ends import Anywhere, AtPose, AtPosture, End
from salver.planning.trajopt.evaluation import MotionEvaluation
from salver.planning.trajopt.found import FastestMotion, object_motion
from salver.planning.trajopt.objectives import Duration, LeastMargin, Objective, Point, QuadraticModel
from salver.planning.trajopt.problem import TransportProblem, transport_problem

__all__ = [
    "EFFORTS",
    "Anywhere",
    "AtPose",
    "AtPosture",
    "Block",
    "Constraint",
    "Duration",
    "End",
    "FastestMotion",
    "FastestOptions",
    "LeastMargin",
    "MotionEvaluation",
    "Objective",
    "Point",
    "QuadraticModel",
    "TransportProblem",
    "evaluate",
    "fastest",
    "joint_plan",
    "nearby",
    "object_motion",
    "padded",
    "plan_fastest",
    "transport_problem",
    "worst_of",
]
