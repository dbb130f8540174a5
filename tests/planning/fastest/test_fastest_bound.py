"""What no motion can be faster than."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import linprog

from salver import scenario
from salver.planning.fastest import FastestOptions, plan_fastest, transport_problem
from salver.planning.seeds.starts import (
    ends,
)
from salver.planning.trajopt.bound import least_by_friction, least_time


@pytest.mark.parametrize(
    ("distance", "velocity", "acceleration", "jerk", "time"),
    [
        (4.0, 1.0, 1.0, np.inf, 5.0),  # a trapezium of velocity
        (1.0, 9.0, 1.0, np.inf, 2.0),  # a triangle: 2 sqrt(d / a)
        (1.0, np.inf, np.inf, 32.0, 1.0),  # jerk alone: (32 d / j)^(1/3)
        (3.0, 1.0, 2.0, 4.0, 4.0),  # all of them: 1 s up, 1 s down, 2 s at full speed
        (6.0, np.inf, 2.0, 4.0, 4.0),  # 1/2 s of jerk, 1 s at full acceleration, 1/2 s of jerk, and the same down
        (3.0, 2.0, np.inf, np.inf, 1.5),
        (3.0, np.inf, np.inf, np.inf, 0.0),
        (0.0, 1.0, 1.0, 1.0, 0.0),
    ],
)
def test_least_time_of_a_joint(distance, velocity, acceleration, jerk, time):
    assert least_time(distance, velocity, acceleration, jerk) == pytest.approx(time)


def test_no_force_within_a_cone_carries_a_mass_farther():
    """As a linear programme: pushes (x, z) at 41 instants of 1 s, within a cone about the vertical of slope 1/2, of a
    point mass that begins and ends at rest; how far can it come? The bound's distance, and hardly less."""
    count, slope, g = 41, 0.5, 9.81
    t = np.linspace(0.0, 1.0, count)
    x, z = np.eye(2 * count)[:count], np.eye(2 * count)[count:]  # impulses by mass, m/s
    far = (1 - t) @ x
    at_rest = np.stack([x.sum(axis=0), z.sum(axis=0)])  # both stop, z against gravity
    found = linprog(
        -far,
        A_ub=np.vstack([x - slope * z, -x - slope * z]),
        b_ub=np.zeros(2 * count),
        A_eq=at_rest,
        b_eq=[0.0, g],
        bounds=(None, None),
    )
    assert -found.fun == pytest.approx(slope * g / 2)
    problem = transport_problem(scenario.load("panda-cube").with_changes(objects__0__uncertainty={}))
    pair = ends(problem, np.random.default_rng(0))[0]
    body = problem.items[0]
    p_0, p_1 = (problem.arm.object_pose(q, body.p_EB, body.R_EB)[0] for q in (pair.start, pair.goal))
    distance = np.linalg.norm((p_1 - p_0)[:2])
    time = least_by_friction(problem.arm, problem.payload, 0.0, pair.start, pair.goal)
    assert body.friction * g * time**2 / 2 == pytest.approx(distance)
    leaning = least_by_friction(problem.arm, problem.payload, 0.2, pair.start, pair.goal)
    assert np.tan(np.arctan(body.friction) + 0.2) * g * leaning**2 / 2 == pytest.approx(distance)
    assert least_by_friction(problem.arm, problem.payload, np.inf, pair.start, pair.goal) == 0.0


def test_a_slippery_load_has_its_bound_by_friction():
    case = scenario.load("panda-cube").with_changes(motion__duration=None, motion__orientation="fixed")
    case = case.with_changes(objects__0__friction=0.15, objects__0__uncertainty={"friction": "20%"})
    plan = plan_fastest(case, options=FastestOptions(spans=8))
    assert plan.ok
    assert "friction alone takes" in plan.status.sentence
    distance = np.hypot(*(np.array(case.motion.goal.position) - case.motion.start.position)[:2])
    slope = np.tan(np.arctan(0.12) + np.sqrt(2) * 1e-3)  # level, to a milliradian about each axis
    assert plan.solver["bound"] == pytest.approx(np.sqrt(2 * distance / (slope * 9.81)), rel=1e-6)
    assert plan.solver["bound"] < plan.duration
