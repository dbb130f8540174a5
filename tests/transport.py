"""Tasks for the fastest motion: the paper's cube, a tall bottle, and a line to begin with."""

from __future__ import annotations

import numpy as np

from salver.geometry import Array
from salver.planning.fastest.problem import TransportProblem
from salver.planning.fastest.spline import RestSpline, min_jerk_blend
from salver.scenario import Scenario, load


def cube(friction: float = 0.4, **changes: object) -> Scenario:
    return load("panda-cube").with_changes(
        **{"objects__0__friction": friction, "motion__goal_yaw": "free", "motion__duration": None, **changes}
    )


def bottle(**uncertainty: object) -> Scenario:
    item = {
        "name": "bottle",
        "shape": {"type": "cylinder", "radius": 0.03, "height": 0.24, "support_points": 8},
        "mass": 0.256,
        "friction": 0.4,
        "uncertainty": uncertainty,
    }
    start, goal = [0.54237, -0.370574, 0.5], [0.444272, 0.100574, 0.5]
    return cube(objects=[item], motion__start__position=start, motion__goal__position=goal, motion__orientation="free")


def line(problem: TransportProblem, spline: RestSpline) -> Array:
    """Coefficients of the min-jerk line between the start posture and the nearest goal posture."""
    assert problem.start_posture is not None
    goal = problem.goal.nearest(problem.arm, problem.limits, problem.start_posture)
    assert goal is not None
    s = np.linspace(0, 1, 101)
    return spline.fit(s, problem.start_posture + min_jerk_blend(s)[:, None] * (goal - problem.start_posture))
