"""Constraints in the rest after a motion: values are those of the whole, derivatives those of differences."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from salver.planning.seeds.starts import ends, straight
from salver.planning.trajopt.constraints.constraints import PER_METRE, Clearance, strayed
from salver.planning.trajopt.constraints.load_limits import AtRest
from salver.planning.trajopt.curves import FreeCurve
from salver.planning.trajopt.exchange import programme_of
from salver.planning.trajopt.objectives import Point
from salver.planning.trajopt.problem import transport_problem
from salver.planning.trajopt.spline import RestSpline
from salver.planning.verdict.judged import PLANNED, Judged
from salver.planning.verdict.verify import clearance
from salver.sensitivity.arm import compliance
from salver.trajectory import JointMotion, smooth_step
from shaken_loads import LAMP


@pytest.fixture(params=["cup", "box", "lamp"])
def problem(request, coffee):
    """At a goal that leans: a round body of which the axes turn, a box of water, and a pendulum."""
    leans = coffee.with_changes(motion__speeds="full", motion__goal__rpy_deg=[8.0, 0.0, 0.0])
    if request.param == "lamp":
        return transport_problem(leans.with_changes(objects=[LAMP], arm={"model": "panda"}))
    if request.param == "box":
        water = {"kind": "water", "size": [0.08, 0.06], "fill": 0.05, "brim": 0.08}
        shape = {"type": "box", "size": [0.09, 0.07, 0.09]}
        return transport_problem(leans.with_changes(objects__0__shape=shape, objects__0__liquid=water))
    return transport_problem(leans)


def begun(problem):
    return straight(ends(problem, np.random.default_rng(0))[0]).motion(problem, RestSpline(5, 8))


def test_the_rest_after_a_motion_is_that_of_the_motion_with_a_rest_at_its_end(problem, monkeypatch):
    """Of a turn that ends without jerk; how the arm gives way is known to half a hundredth."""
    monkeypatch.setattr(compliance, "ROUNDS", compliance.MORE_ROUNDS)
    s, duration = np.linspace(0.0, 1.0, 121), 0.7
    blend = np.polynomial.Polynomial([0, 0, 0, 0, 35, -84, 70, -20])
    turn = np.array([0.5, 0.1, 0.2, 0.0, 0.0, 0.1, 0.3])
    z = np.stack([np.outer(blend.deriv(k)(s) if k else blend(s), turn) / duration**k for k in range(4)])
    z[0] += begun(problem).coefficients[0]
    rest = problem.at(s, z, duration, imposed=False).rest
    t = np.append(s * duration, duration + rest.s[1:] * rest.duration)
    whole = problem.at(t / t[-1], np.concatenate([z, rest.z[:, 1:]], axis=1), t[-1], imposed=False)
    for name, parts in rest.loads.items():
        for part, all_along in zip(parts, whole.loads[name], strict=True):
            swung = all_along.modes.r[:, len(s) - 1 :]
            np.testing.assert_allclose(part.modes.r, swung, atol=8e-3 * np.abs(swung).max())
            np.testing.assert_allclose(part.wrench, all_along.wrench[:, len(s) - 1 :], atol=0.02)
    radius = whole.response.joint_radius(0)[len(s) - 1 :]
    np.testing.assert_allclose(rest.response.joint_radius(0), radius, atol=5e-3 * radius.max())


def test_after_a_slow_motion_nothing_swings(problem):
    """A hundred seconds in 161 nodes. With the arm's compliance to first order a cup's swung
    a thousand times more."""
    s, duration = np.linspace(0.0, 1.0, 161), 1.0
    turn, start = np.array([0.5, 0.1, 0.2, 0.0, 0.0, 0.1, 0.3]), begun(problem).coefficients[0]
    z = np.zeros((4, len(s), 7))
    z[0] = start + np.outer(smooth_step(s), turn)
    z[1], z[2] = np.outer(30 * s**2 * (1 - s) ** 2, turn), np.outer(60 * s * (1 - s) * (1 - 2 * s), turn)
    slow = problem.at(s, z, duration, imposed=False).at_factor(0.01)
    (left,) = slow.rest.loads[problem.payload.first.name]
    assert np.ptp(left.modes.r, axis=1).max() < 1e-7


def test_how_far_an_arm_may_stray_while_it_settles_counts_at_the_end(problem):
    s, duration = np.linspace(0.0, 1.0, 41), 0.6
    turn, start = np.array([0.5, 0.1, 0.2, 0.0, 0.0, 0.1, 0.3]), begun(problem).coefficients[0]
    rates = 30 * s**2 * (1 - s) ** 2 / duration, 60 * s * (1 - s) * (1 - 2 * s) / duration**2
    q, dq, ddq = (np.outer(x, turn) for x in (smooth_step(s), *rates))
    judged = Judged.of(problem, JointMotion(s * duration, start + q, dq, ddq), PLANNED)
    last = strayed(*judged.along.tray_radius())[-1]
    assert judged.off[-1] == pytest.approx(strayed(*judged.along.rest.tray_radius()).max(), rel=0.02)
    assert (judged.off[-1] > 1.02 * last) == (problem.payload.first.name == "lamp")  # the others stray most at the end
    near = Clearance(problem.keep_out.near(judged.along.at_nodes[0]))
    (rows,), (plain,) = clearance(judged), near.blocks(judged.along)
    more = rows.values - plain.values - (rows.values[:1] - plain.values[:1])
    np.testing.assert_allclose(more[:-1], 0.0, atol=1e-9)
    np.testing.assert_allclose(more[-1], PER_METRE * (judged.off[-1] - last), atol=1e-9)


def test_derivatives_in_the_rest_agree_with_differences(problem):
    """Of an arm that follows exactly: how it gives way is taken as given."""
    rng, problem = np.random.default_rng(0), replace(problem, tracking=None)
    start = begun(problem)
    programme = programme_of(problem, FreeCurve, start, np.linspace(0.0, 1.0, 61))
    resting = tuple(each for each in problem.constraints if isinstance(each, AtRest))
    programme = replace(programme, constraints=resting)
    inner = np.zeros_like(start.coefficients)
    inner[3:-3] = 1.0
    coefficients = start.coefficients + 0.05 * inner * rng.normal(size=inner.shape)
    step, longer, duration = 1e-6 * inner * rng.normal(size=inner.shape), 2e-6, 0.6 * start.duration
    here = programme.begin(coefficients, duration)
    there, back = (
        programme.at(Point(coefficients + k * step, duration * np.sqrt(1 + k * longer))) for k in (1.0, -1.0)
    )
    for block, ahead, behind in zip(here.blocks, there.blocks, back.blocks, strict=True):
        node, column = np.nonzero(block.values > block.values.max() - 0.3)
        by = programme.derivatives(here, replace(block, remembers=np.inf), node, column) @ np.append(step, longer)
        change = (1 + longer) * ahead.values[node, column] - (1 - longer) * behind.values[node, column]
        np.testing.assert_allclose(by, 0.5 * change, atol=0.01 * np.abs(change).max(), err_msg=block.name)
    assert len(here.blocks) >= 3 * len(resting) / 2
