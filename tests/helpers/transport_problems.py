"""Tasks for the fastest motion: the paper's cube, a tall bottle, a line to begin with, and an objective of a user."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from salver.geometry import Array
from salver.planning.fastest import EFFORTS, FastestOptions, Objective, Point, QuadraticModel
from salver.planning.seeds.starts import ends, straight
from salver.planning.trajopt.curves import Curve
from salver.planning.trajopt.problem import TransportProblem
from salver.planning.trajopt.spline import RestSpline, SplineMotion
from salver.scenario import Scenario, load, parse
from salver.trajectory import smooth_step

ROUGH = replace(EFFORTS["quick"], spans=10)  # half the time, where a claim is not that no motion is faster


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
    return spline.fit(s, problem.start_posture + smooth_step(s)[:, None] * (goal - problem.start_posture))


def cup_and_jar() -> Scenario:
    """A cup that slides where a stop of nothing but its way leaves the tray leaning, and a jar."""
    cup = {
        "name": "cup",
        "shape": {"type": "cylinder", "radius": 0.0297, "height": 0.0571},
        "mass": 0.0681,
        "friction": 0.3,
        "at": [-0.055, 0.0],
        "support_inset": 0.002,
        "liquid": {"kind": "coffee", "radius": 0.0267, "fill": 0.023, "brim": 0.0531},
        "uncertainty": {"mass": "10%", "friction": "10%", "fill": "10%", "com": [0.001, 0.001, 0.002]},
    }
    jar = {
        "name": "jar",
        "shape": {"type": "cylinder", "radius": 0.0322, "height": 0.0613},
        "mass": 0.1337,
        "friction": 0.3,
        "at": [0.055, 0.0],
        "support_inset": 0.002,
        "liquid": {"kind": "water", "radius": 0.0292, "fill": 0.0452, "brim": 0.0573, "sealed": True},
        "uncertainty": "none",
    }
    task = {
        "name": "cup-and-jar",
        "motion": {
            "start": {"position": [0.199, -0.396, 0.359]},
            "goal": {"position": [0.464, -0.303, 0.305]},
            "goal_yaw": "free",
        },
        "objects": [cup, jar],
        "contact": {"condition": "exact"},
        "tray": {"size": [0.26, 0.22], "height": 0.03, "mass": 0.4002},
        "arm": {"model": "panda"},
        "uncertainty": {"set": "ellipsoid"},
    }
    return parse(task, "cup-and-jar")


def straight_start(problem: TransportProblem, spline: RestSpline) -> SplineMotion:
    """The straight line in joint space between the most promising postures."""
    return straight(ends(problem, np.random.default_rng(FastestOptions().seed))[0]).motion(problem, spline)


@dataclass(frozen=True, eq=False)
class Distance(Objective):
    """Mean square over time of the distance to a wanted motion, half of it; T is given.

    wanted: (4, P, n) q and its time derivatives at the points of the grid. weights: (4,) of the squares of their
    differences.
    """

    wanted: Array
    weights: tuple[float, float, float, float] = (1.0, 0.0, 0.0, 0.0)

    def value(self, curve: Curve, at: Point) -> float:
        away = self._away(curve, at)
        return 0.5 * float(self.weights @ np.square(away).sum(axis=2) @ curve.grid.weights)

    def model(self, curve: Curve, at: Point) -> QuadraticModel:
        away, (_, count, n) = self._away(curve, at), self.wanted.shape
        size = at.coefficients.size
        slope, curvature = np.zeros(size), np.zeros((size, size))
        point = np.arange(count)
        for order, weight in enumerate(self.weights):
            for joint in range(n) if weight else ():
                parts = np.zeros((count, 4, n))
                parts[:, order, joint] = 1.0
                rows = curve.columns(at.coefficients, at.duration, parts, point)
                weighted = weight * rows * curve.grid.weights[:, None]
                slope += weighted.T @ away[order, :, joint]
                curvature += weighted.T @ rows
        return QuadraticModel(slope, 0.0, curvature)

    def _away(self, curve: Curve, at: Point) -> Array:
        return np.asarray(curve.motion(at.coefficients, at.duration) - self.wanted)
