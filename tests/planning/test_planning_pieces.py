"""What plans are put together from, but for the search for the fastest: each piece by hand."""

from __future__ import annotations

import re
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose

from salver import scenario
from salver.errors import ScenarioError, Status
from salver.geometry import Array, exp
from salver.models.arm.arm import ArmModel, load_arm
from salver.models.arm.arm_geometry import arm_geometry
from salver.models.arm.arm_limits import LIMITS, POSITION, JointLimits
from salver.planning import make, postures, qp
from salver.planning.follow import redundancy
from salver.planning.follow.limits import _room
from salver.planning.follow.motion import _unreachable
from salver.planning.follow.redundancy import TrayPath, first_choice, improved, tray_path
from salver.planning.object.problem import Problem
from salver.planning.object.solvers import SEARCH, Solution
from salver.planning.plan import FINER
from salver.planning.postures import INSIDE, PoseTarget, posture_at, postures_along
from salver.planning.seeds import blocked
from salver.planning.trajopt import bound
from salver.planning.trajopt.ends import AtPose
from salver.planning.trajopt.problem import _level_enough
from salver.trajectory import min_jerk_line

CUBE = scenario.load("panda-cube")
POSTURE = np.array(CUBE.arm.start_posture)


@pytest.fixture(scope="module")
def panda() -> ArmModel:
    return load_arm(CUBE.arm, CUBE.tray)


def test_what_is_out_of_reach_is_so_far_from_the_base_of_the_arm() -> None:
    arm: Any = SimpleNamespace(name="arm", n=6, base_position=np.array([1.0, -2.0, 0.5]))
    path: Any = SimpleNamespace(p_SE=np.array([[1.0, 1.0, 4.5], [4.0, -2.0, 0.5]]), t=np.array([0.0, 0.7]))
    first, second = (_unreachable(arm, path, k) for k in (0, 1))
    assert first.details["distance_from_base"] == pytest.approx(5.0)  # 3 and 4
    assert "where the motion starts; that is 5.00 m from its base" in first.sentence
    assert "at t = 0.70 s; that is 3.00 m from its base" in second.sentence


def test_a_part_of_a_limit_may_be_overstepped_between_points_and_the_makers_limit_may_not() -> None:
    """Of parts of 80, 99.5 and 100 %, by 1 %; nothing where nobody gave a limit."""
    kind = next(kind for kind in LIMITS if kind.key == "velocity")
    whole = np.array([2.0, 2.0, 2.0, np.inf])
    limits = [JointLimits(*[x] * 7) for x in (np.array([0.8, 0.995, 1.0, 1.0]) * whole, whole)]
    arm: Any = SimpleNamespace(planning_limits=limits[0], limits=limits[1])
    assert _room(arm, kind, 0.01) == pytest.approx([1.01, 1 / 0.995, 1.0, 1.0])


@pytest.mark.parametrize("side", [-1, 1])
def test_no_posture_is_beyond_the_limits_less_a_little(panda: ArmModel, side: int) -> None:
    """Not even for a pose that is far out of reach, at which several joints end at a limit."""
    p, R = panda.tray_pose(POSTURE)
    low, high = POSTURE - 0.3, POSTURE + 0.3
    limits = replace(panda.limits, q_min=low, q_max=high)
    q, missed = posture_at(panda, PoseTarget(p + np.array([0.0, 2.0 * side, 1.0]), R), POSTURE, limits=limits)
    assert missed > 1.0
    assert np.all(q >= low + INSIDE)
    assert np.all(q <= high - INSIDE)
    at_ends = [np.isclose(q, end, rtol=0, atol=1e-12).any() for end in (low + INSIDE, high - INSIDE)]
    assert all(at_ends)


def test_where_an_end_is_out_of_reach_the_heading_is_told_in_which_it_is_not(panda: ArmModel, monkeypatch) -> None:
    """Of an arm that stands in a posture and could stand in no other: asked for its pose turned away by 40 degrees."""
    p, R = panda.tray_pose(POSTURE)
    for turn in (40.0, -70.0):
        away = AtPose(PoseTarget(p, R @ exp(np.array([0.0, 0.0, -np.deg2rad(turn)]))))
        problem: Any = SimpleNamespace(arm=panda, limits=None, n=7, start=away, goal=away)
        monkeypatch.setattr(blocked, "_sought", lambda problem, target: [(POSTURE, 0.0 if target.yaw_free else 1.0)])
        told = blocked.why_unreached(problem).sentence
        assert told.endswith(
            f"reaches the start: the nearest found misses it by {0:.3g} mm and {abs(turn):.3g} deg. "
            f"Turned by {turn:.0f} deg about its vertical it is reached."
        ), told


def test_friction_carries_the_centre_of_a_load_wherever_it_is_on_the_tray(monkeypatch) -> None:
    """By hand, of a tray that goes by (0.3, 0.1) m and turns by 90 degrees: its load goes by (0.23, 0.13)."""
    quarter = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    poses = [(np.zeros(3), np.eye(3)), (np.array([0.3, 0.1, 0.2]), quarter)]
    arm: Any = SimpleNamespace(tray_pose=lambda q: poses[int(q[0])])
    monkeypatch.setattr(bound, "_stacks", lambda payload: iter([(0.4, np.array([0.05, 0.02, 0.1]))]))
    time = bound.least_by_friction(arm, CUBE.payload, 0.0, np.zeros(1), np.ones(1))
    assert 0.5 * 0.4 * 9.81 * time**2 == pytest.approx(np.hypot(0.23, 0.13))


def test_a_pose_may_lean_as_far_as_the_motion_and_no_further() -> None:
    """Whichever of start, goal and poses on the way it is."""
    level, leaning = (SimpleNamespace(rotation=exp(np.array([np.deg2rad(x), 0.0, 0.0]))) for x in (0.0, 10.0))
    for name in ("start", "goal", "through[1]"):
        poses = {"start": level, "goal": level, "through[0]": level, "through[1]": level, name: leaning}
        motion: Any = SimpleNamespace(
            start=poses["start"], goal=poses["goal"], through=[poses["through[0]"], poses["through[1]"]]
        )
        _level_enough(motion, np.deg2rad(10.1))
        with pytest.raises(ScenarioError, match=re.escape(f"motion.{name} tilts the tray by 10 deg")):
            _level_enough(motion, np.deg2rad(9.9))


def test_a_plan_keeps_the_lowest_that_its_tube_reaches() -> None:
    plan = make.plan_baseline(CUBE.with_changes(arm=None, motion__nodes=11))
    told = plan.summary()["verification"] | plan.summary()
    assert told["least_cone_coefficient_in_tube"] < plan.cone_coefficients.min() - 1e-3


def test_a_joint_that_can_turn_more_than_once_is_as_near_to_its_middle_as_may_be(monkeypatch) -> None:
    limits = JointLimits(np.array([-1.0]), np.array([7.0]), *[np.ones(1)] * 5)
    arm: Any = SimpleNamespace(n=1, limits=limits)
    for found, kept in ((6.5, 6.5 - 2 * np.pi), (-0.3, 2 * np.pi - 0.3), (2.0, 2.0)):  # to 3 rad
        monkeypatch.setattr(postures, "posture_at", lambda *_, found=found, **__: (np.array([found]), 0.0))
        assert postures.candidate_postures(arm, None, seeds=2) == [pytest.approx(kept)]  # type: ignore[arg-type]


def crossing(duration: float) -> TrayPath:
    start, goal = (np.array(pose.position) for pose in (CUBE.motion.start, CUBE.motion.goal))
    line = min_jerk_line(duration, start, goal, np.eye(3), np.eye(3))
    return tray_path(line, np.array([0.0, 0.0, 0.02]), np.eye(3), np.linspace(0, duration, 13))


@pytest.mark.parametrize("weak", [0.8, 0.1])
def test_a_swivel_of_the_elbow_is_improved_along_the_slope_that_differences_give(weak, monkeypatch) -> None:
    """By where it starts and by its coefficients, to what is left out as faint; so fast that speed and acceleration are
    what matters most, and of an arm so weak that torque is."""
    path, seen = crossing(0.3), []
    arm = load_arm(CUBE.arm.model_copy(update={"torque_scale": weak}), CUBE.tray)

    def looked(at: Any, x: Array, **_: Any) -> None:
        x = x + 0.05 * np.random.default_rng(0).normal(size=len(x))
        for step in (np.eye(len(x))[0], np.random.default_rng(1).normal(size=len(x))):
            behind, ahead = (at(x + h * step)[0] for h in (-1e-5, 1e-5))
            seen.append((at(x)[1] @ step, (ahead - behind) / 2e-5))

    monkeypatch.setattr(redundancy, "descend", looked)
    followed, reached = postures_along(arm, path.p_SE, path.R_SE, POSTURE)
    assert reached == len(path.t)
    choice = first_choice(arm, arm_geometry(arm), path, followed)
    assert choice is not None
    improved(arm, arm_geometry(arm), path, choice, True)
    assert len(seen) == 2
    for claimed, found in seen:
        assert claimed == pytest.approx(found, rel=1e-2)


def test_a_plan_that_fails_between_its_nodes_is_made_at_all_instants_that_are_checked(monkeypatch) -> None:
    """What is solved for stays where it is, the straight line, too fast for the cube."""
    case, asked = CUBE.with_changes(motion__duration=0.5, motion__nodes=11), []

    def solve(problem: Problem, start: Array | None) -> Solution:
        asked.append((problem.nodes, None if start is None else start[0]))
        found = Status("optimal", "Found.", True)
        return Solution(np.full(problem.size, 1e-9), 1.0, None, 0.0, 1, "none", found)

    monkeypatch.setattr(make, "solve", solve)
    plan = make.plan_object(case)
    assert plan.status.code == "unsafe"
    assert asked == [(11, None), (FINER * (11 - 1) + 1, 1e-9)]  # the second begins where the first ended


@pytest.mark.parametrize("orientation", ["fixed", "free"])
def test_a_plan_without_a_margin_is_safe_as_well(orientation: str) -> None:
    """Where the condition binds, what a solver may miss it by is kept from it, and no more."""
    case = CUBE.with_changes(arm=None, contact__margin=0.0, motion__orientation=orientation, contact__condition="exact")
    plan = make.plan_object(case.with_changes(motion__duration=0.8, objects__0__friction=0.3))
    assert plan.ok, plan.status
    assert plan.verification.slack < (1e-6 if orientation == "fixed" else SEARCH.violation)


@pytest.mark.parametrize("degree", [9, 12])
def test_unknowns_of_a_plan_are_what_its_polynomials_have_beyond_rest_at_both_ends(degree: int) -> None:
    """Eq (26): positions of degree n have n + 1 coefficients and six conditions for each axis; the body's angular
    velocity is of degree n - 1, with n coefficients and four conditions."""
    problem = Problem(CUBE.with_changes(motion__degree=degree, motion__orientation="free"), 11)
    assert problem.size == 3 * (degree + 1 - 6) + 3 * (degree - 4)
    reference = problem.reference(np.random.default_rng(0).normal(size=problem.size))
    assert reference.angular_velocity.shape == (degree, 3)


def test_the_middle_of_joints_is_between_their_ends(panda: ArmModel) -> None:
    middle, half = panda.limits.range(POSITION)
    assert middle + half == pytest.approx(panda.limits.q_max)
    assert middle - half == pytest.approx(panda.limits.q_min)


def test_each_solver_of_quadratic_programmes_answers_what_the_optimum_is() -> None:
    """Kept rows, multipliers of the right sign, and forces in balance: no other point is one (Karush, Kuhn, Tucker)."""
    rng = np.random.default_rng(0)
    for _ in range(10):
        root, inside = rng.normal(size=(8, 8)), rng.normal(size=8)
        equal, rows = rng.normal(size=(3, 8)), rng.normal(size=(20, 8))
        programme = qp.Quadratic(
            root @ root.T + 0.1 * np.eye(8),
            rng.normal(size=8),
            rows,
            rows @ inside + rng.uniform(0, 1, 20),
            equal,
            equal @ inside,
            inside - rng.uniform(0, 0.5, 8),
            np.where(np.arange(8) < 4, inside + 0.2, np.inf),
        )
        for solver in qp.SOLVERS:
            found = solver(programme, 1e-9)
            assert found is not None
            x, left = found.x, programme.bound - rows @ found.x
            assert min(left.min(), (x - programme.low).min(), (programme.high - x).min()) > -1e-7
            assert_allclose(equal @ x, programme.target, atol=1e-7)
            assert min(found.rows.min(), found.low.min(), found.high.min()) >= 0.0
            pushed = found.rows @ rows + found.equal @ equal - found.low + found.high
            assert_allclose(programme.hessian @ x + programme.cost + pushed, 0.0, atol=1e-6)
            assert found.rows @ left + found.low @ (x - programme.low) == pytest.approx(0.0, abs=1e-6)
