"""What searches for motions are put together from, each piece by hand."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.interpolate import CubicHermiteSpline

from salver import scenario
from salver.geometry import Array
from salver.models.arm.arm import load_arm
from salver.models.arm.arm_limits import JointLimits
from salver.planning.fastest import transport_problem
from salver.planning.fastest.retiming import PATH_TOLERANCE, SplinePath
from salver.planning.postures import INSIDE, PoseTarget
from salver.planning.stops import along
from salver.planning.trajopt.constraints.constraints import PER_METRE, REACH_BEYOND_TRAY, UNSEEN, Block, Clearance
from salver.planning.trajopt.constraints.obstacles import CLEARANCE, KeepOut
from salver.planning.trajopt.constraints.via_poses import Closest, PassPose, _blend
from salver.planning.trajopt.curves import launch_basis
from salver.planning.trajopt.ends import Anywhere
from salver.planning.trajopt.evaluation import MotionEvaluation
from salver.planning.trajopt.objectives import Duration, LeastMargin, Point
from salver.trajectory import JointMotion

POSTURE = np.array([0.0, -0.6, 0.1, -2.2, 0.0, 1.6, 0.8])


def test_between_nodes_values_are_joined_by_straight_lines() -> None:
    s, rng = np.linspace(0.0, 1.0, 21) ** 1.3, np.random.default_rng(0)
    nodes = np.array([0, 3, 4, 9, 15, 20])
    motion = MotionEvaluation(None, 0, None, s, 0.8, np.zeros((4, 21, 1)), nodes, True, False)
    values = rng.normal(size=(6, 2))
    expected = np.column_stack([np.interp(s, s[nodes], column) for column in values.T])
    assert motion.between_nodes(values) == pytest.approx(expected)
    assert motion.steps == pytest.approx(0.8 * np.diff(s[nodes]))


def test_rows_have_their_peaks_at_the_ends_too_and_of_many_the_foremost_are_looked_at() -> None:
    values = np.random.default_rng(3).normal(size=(9, 40))
    block = Block("rows", values, lambda i, f: np.zeros((len(i), 4)), np.arange(9), most=3)
    for row, told in zip(values.T, block.peaks.T, strict=True):
        assert told[0] == (row[0] >= row[1])
        assert told[-1] == (row[-1] >= row[-2])
        assert told[1:-1].tolist() == [row[k] >= max(row[k - 1], row[k + 1]) for k in range(1, 8)]
    many = np.random.default_rng(3).normal(size=(50, 300))
    wide = Block("many", many, lambda i, f: np.zeros((len(i), 4)), np.arange(50), most=7)
    for row, near, joining in zip(many, wide.near(np.inf), wide.joining(np.zeros(many.shape, dtype=bool)), strict=True):
        order = np.argsort(-row)
        assert np.flatnonzero(near).tolist() == sorted(order[:7])
        assert np.flatnonzero(joining).tolist() == sorted(k for k in order[:21] if row[k] > UNSEEN)
    assert block.near(np.inf).sum(axis=1).tolist() == [3] * 9


def test_a_launch_begins_with_a_speed_or_an_acceleration_and_ends_with_nothing() -> None:
    velocity, acceleration = launch_basis(np.array([0.0, 1.0]))[:, :3]
    assert velocity == pytest.approx(np.array([[0, 0], [1, 0], [0, 0]]), abs=1e-12)
    assert acceleration == pytest.approx(np.array([[0, 0], [0, 0], [1, 0]]), abs=1e-12)


def test_anywhere_is_a_little_within_the_limits() -> None:
    low, high = np.full(7, -1.0), np.full(7, 1.5)
    limits = JointLimits(low, high, *(np.full(7, np.inf) for _ in range(5)))
    arm = load_arm(scenario.Arm(model="panda"), scenario.Tray())
    q = np.array([-2.0, -1.0, -0.995, 0.3, 1.495, 1.5, 2.0])
    found = Anywhere().nearest(arm, limits, q)
    assert found == pytest.approx(
        [-1 + INSIDE, -1 + INSIDE, -1 + INSIDE, 0.3, 1.5 - INSIDE, 1.5 - INSIDE, 1.5 - INSIDE]
    )


def test_what_a_step_is_expected_to_give() -> None:
    """The scalar of a shortest motion is the share by which the square of the duration grows, that of a safest one the
    margin that is gained."""
    at, step = Point(np.zeros((4, 1)), 0.8, 0.05), np.array([0.0, -0.5, 0.0, 0.0, 0.21])
    assert Duration().expected(None, at, 0.8, step) == pytest.approx(0.88)  # type: ignore[arg-type]
    assert LeastMargin().expected(None, at, -0.05, step) == pytest.approx(-0.26)  # type: ignore[arg-type]


@pytest.mark.parametrize("step", [0.02, 0.3])
def test_between_two_states_a_motion_is_hermites_cubic(step: float) -> None:
    states = np.random.default_rng(1).normal(size=4)
    cubic = CubicHermiteSpline([0.0, step], states[[0, 2]], states[[1, 3]])
    for u in (0.0, 0.3, 0.8, 1.0):
        value, slope = _blend(u, step)
        assert value @ states == pytest.approx(cubic(u * step))
        assert slope @ states == pytest.approx(step * cubic(u * step, 1))


@pytest.mark.parametrize("passes", [0.12, 0.3, 0.42, 0.55, 0.7, 0.97])
def test_where_a_motion_is_nearest_to_a_pose_is_found_in_whichever_piece_it_is(passes: float) -> None:
    arm, t = load_arm(scenario.Arm(model="panda"), scenario.Tray()), np.array([0.0, 0.2, 0.4, 0.6, 0.8, 1.0])
    q = POSTURE + np.outer(t, [0.8, 0.1, 0.0, -0.2, 0.0, 0.1, 0.0])
    dq = np.tile((q[-1] - q[0]) / 1.0, (6, 1))
    there = POSTURE + passes * (q[-1] - q[0])
    found = Closest.of(arm, PoseTarget(*arm.tray_pose(there)), t, q, dq)
    assert found.node == int(passes / 0.2)
    assert np.abs(found.error).max() < 1e-6
    z = np.stack([q, dq, 0 * q, 0 * q])
    motion = MotionEvaluation(None, 0, None, t, 1.0, z, np.arange(6), True, False)
    (rows,) = PassPose(arm, PoseTarget(*arm.tray_pose(there)), "a pose").blocks(motion)
    assert rows.values == pytest.approx(np.full((1, 12), -0.04), abs=1e-4)  # as far within as can be


def test_what_is_known_at_nodes_is_linear_between_them() -> None:
    s, nodes, rng = np.array([0.0, 0.1, 0.25, 0.3, 0.6, 0.8, 1.0]), np.array([0, 2, 4, 6]), np.random.default_rng(2)
    motion = MotionEvaluation(None, 0, None, s, 2.0, np.zeros((4, 7, 1)), nodes, True, False)
    assert motion.steps == pytest.approx([0.5, 0.7, 0.8])  # s, of two
    values = rng.normal(size=(4, 3))
    expected = np.stack([np.interp(s, s[nodes], column) for column in values.T], axis=1)
    assert motion.between_nodes(values) == pytest.approx(expected)


def test_a_pair_that_is_too_near_at_an_end_keeps_a_share_of_that_less_what_nodes_keep() -> None:
    """A tenth of it; half of it where a posture that was given is nearer than others need to be; never more than it had
    to keep, and nothing is touched where it was touched already. By hand, in mm."""
    there = np.array([[9.0, 6.0, 4.0, 4.0, -2.0], [20.0, 7.0, 6.0, 4.5, 3.0]]) * 1e-3
    required = np.array([5.0, 5.0, 5.0, 3.0, 5.0]) * 1e-3
    asked: list[Array] = []

    def clearance(q: Array, most: Array | None = None) -> Array:
        asked.append(most)
        return there

    parts: Any = SimpleNamespace(clearance=clearance, of_floor=np.zeros(5, dtype=bool))
    keep_out = KeepOut(parts, required)
    kept = keep_out.kept_by(np.zeros((2, 7)), np.zeros(2))
    assert 1e3 * kept.required == pytest.approx([5.0, -0.4, -0.6, 1.0, -1.0])
    # A verdict ends where an arm goes 0.1 mm at most, half of it from either end, and distances are good to 0.01 mm.
    assert 1e3 * kept.least == pytest.approx([5.0, 0.07, 0.07, 1.0, 0.0])
    assert 1e3 * keep_out.distances(np.zeros((2, 7)), 0.002) == pytest.approx(1e3 * (there - required))
    far = CLEARANCE.reach + CLEARANCE.at_nodes + 0.002  # exact as far as the arm may stray into reach
    assert np.all(asked[-1] >= required + far)


def test_a_pair_keeps_no_more_than_the_tracking_error_leaves_of_its_distance_at_the_ends() -> None:
    """By hand, in mm: at the first end 2 mm of 7 are used up, at the second 0.5 mm of 6.8 and 6; 1 mm is for nodes."""
    there = np.array([[7.0, 20.0, 20.0, 7.0], [9.0, 6.8, 6.0, 30.0]]) * 1e-3
    required = np.array([5.0, 5.0, 5.0, 5.0]) * 1e-3
    parts: Any = SimpleNamespace(clearance=lambda q, most=None: there, of_floor=np.zeros(4, dtype=bool))
    kept = KeepOut(parts, required).kept_by(np.zeros((2, 7)), np.array([2.0, 0.5]) * 1e-3)
    assert 1e3 * kept.required == pytest.approx([4.0, 5.0, -0.4, 4.0])
    kept = KeepOut(parts, required).kept_by(np.zeros((2, 7)), np.array([6.9, 0.0]) * 1e-3)  # nearly all of it
    assert 1e3 * kept.required == pytest.approx([-0.3, 5.0, -0.4, -0.3])  # as of a pair that is too near


def straight_to(path: SplinePath, corners: Array) -> float:
    """The most that a path is off the straight lines between corners."""
    points = path.derivatives(np.linspace(0, 1, 501), 0)[0]
    lines = [(a, b - a) for a, b in pairwise(corners)]
    shares = [np.clip((points - a) @ d / (d @ d), 0, 1) for a, d in lines]
    away = [np.linalg.norm(points - a - s[:, None] * d, axis=1) for (a, d), s in zip(lines, shares, strict=True)]
    return float(np.min(away, axis=0).max())


def test_a_path_through_few_waypoints_goes_nearly_straight_between_them() -> None:
    corners = np.array([[0.0, 0.0], [0.1, 0.0], [0.1, 1.0]])
    assert straight_to(SplinePath.through(corners), corners) < 0.05
    assert straight_to(SplinePath.through(corners[::-1]), corners) < 0.05


def test_a_dense_path_is_thinned_out_and_what_it_misses_is_said() -> None:
    u = np.linspace(0.0, 1.0, 2001)
    smooth = np.column_stack([np.sin(2 * u), 0.3 * u**2])
    path = SplinePath.through(smooth)
    assert path.missed < PATH_TOLERANCE
    assert straight_to(path, smooth) <= path.missed + 1e-6
    corner = np.column_stack([np.minimum(u, 0.4), np.maximum(u - 0.4, 0.0)])
    few, many = SplinePath.through(corner), SplinePath.through(corner[::2])
    assert 0 < few.missed < 2 * PATH_TOLERANCE  # with the most points there are
    assert 0 < many.missed < 2 * PATH_TOLERANCE


def test_a_last_waypoint_beside_the_one_before_is_kept_in_its_place() -> None:
    q = np.array([[0.0], [1.0], [1.0 + 0.5 * PATH_TOLERANCE]])
    path = SplinePath.through(q)
    assert path.derivatives(np.array([0.0, 1.0]), 0)[0] == pytest.approx(q[[0, 2]], abs=1e-12)


def test_along_a_long_plan_the_deviation_is_known_often_enough() -> None:
    problem = transport_problem(scenario.load("panda-cube"), robust=False)
    ends = np.stack([POSTURE, POSTURE + 0.2])
    for duration in (0.5, 2.4, 10.0):
        motion = JointMotion(np.array([0.0, duration]), ends, np.zeros_like(ends), np.zeros_like(ends))
        t, *_ = along(problem, motion, "joint")
        assert t[0] == 0.0
        assert t[-1] == pytest.approx(duration)
        assert np.diff(t).max() <= 4e-3 * (1 + 1e-9)


def test_what_the_arm_strays_comes_off_its_distance_from_what_is_around() -> None:
    """With the turn of the tray at the lever at which its load stands."""
    post = {"type": "sphere", "name": "post", "radius": 0.05, "position": [0.5917, -0.2854, 0.465]}
    problem = transport_problem(scenario.load("panda-cube").with_changes(obstacles=[post]))
    s = np.linspace(0.0, 1.0, 7)
    z = np.zeros((4, 7, 7))
    z[0] = np.array(scenario.load("panda-cube").arm.start_posture) + np.outer(s, [0.3, 0, 0, 0, 0, 0, 0])
    z[1], z[2] = np.eye(7)[0] * 0.4, np.outer(np.sin(6 * s), np.eye(7)[0])
    motion = problem.at(s, z, 0.75)
    assert motion.response is not None
    position, turn = motion.response.tray_radius()
    stray = np.linalg.norm(position, axis=1) + REACH_BEYOND_TRAY * np.linalg.norm(turn, axis=1)
    assert stray.max() > 1e-4
    assert problem.keep_out is not None
    asked = []

    class Watched(KeepOut):
        def distances(self, q: Array, stray: float = 0.0) -> Array:
            asked.append(stray)
            return super().distances(q, stray)

    watched = Clearance(Watched(problem.keep_out.parts, problem.keep_out.required))
    (rows,), (sure,) = (list(watched.blocks(x)) for x in (motion, replace(motion, tracking=None)))
    assert asked == pytest.approx([stray.max(), 0.0])  # as far beyond they must be exact
    exact = problem.keep_out.parts.clearance(z[0]) - problem.keep_out.required
    near = exact < CLEARANCE.exact  # further away a bound is enough
    assert near.any()
    assert rows.values[near] == pytest.approx(-PER_METRE * (exact - stray[:, None])[near], abs=1e-4)
    assert sure.values[near] == pytest.approx(-PER_METRE * exact[near], abs=1e-4)
