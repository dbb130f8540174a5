"""What the verdict on live motions may miss between its instants is less than what it keeps for that."""

from dataclasses import replace
from functools import cached_property
from itertools import pairwise, product

import numpy as np
import pytest

import salver as sv
from live_runs import JUST, Linear
from salver.control.arm import with_load
from salver.live.committed.commit import committed_of, verified
from salver.live.committed.motion import resting
from salver.models.arm.arm_limits import LIMITS
from salver.models.tray_motion import Speed
from salver.models.uncertain.worst_case import Drift, WorstCase
from salver.planning.fastest import fastest, plan_fastest, transport_problem
from salver.planning.trajopt.constraints.constraints import (
    FINEST,
    Block,
    Clearance,
    ContactConstraint,
    JointLimit,
    strayed,
)
from salver.planning.trajopt.constraints.load_limits import AtRest
from salver.planning.trajopt.problem import TransportProblem
from salver.planning.verdict.judged import PLANNED, STANDARD, Judged, no_gradient, peaks
from salver.planning.verdict.margins import ConstraintMargins
from salver.planning.verdict.verify import Verdict, clearance, torque_rate, verify
from salver.scenario import parse
from salver.trajectory import JointMotion, Quintics, extremes, smooth_step


@pytest.fixture(scope="module")
def motion():
    """The fastest motion of the bottle, with the jerk's jumps of a spline and of what was cut."""
    problem = transport_problem(sv.load_scenario("panda-tall-bottle"))
    found = fastest(problem)
    t = np.linspace(0, found.duration, 41)
    q, dq, ddq = found.sample(t)[:3]
    return replace(problem, keep_out=None), JointMotion(t, q, dq, ddq)


def along(problem, motion, t, z, **given):
    """Everything worked out at all of the instants."""
    return problem.at(t / motion.duration, z, motion.duration, imposed=False, **given)


class Full:
    """A deviation at some of the instants at which it was worked out."""

    def __init__(self, deviation, some):
        self.deviation, self.some = deviation, some

    def joint_radius(self, order):
        return self.deviation.joint_radius(order)[self.some]

    def felt(self):
        w, drift = self.deviation.felt()
        return w[self.some], replace(drift, dw=drift.dw[self.some], swing=drift.swing[self.some])


def linearly(problem, motion, t, z):
    """The deviation at instants t (T,) of a motion z (4, T, n), linear from one to the next, or to just before a knot,
    where the jerk jumps, and with it what a late command is short of."""
    just = motion.t[1:] - JUST
    z = np.concatenate([z, np.stack([*motion.sample(just), motion.jerk(just)])], axis=1)
    dense = np.concatenate([t, just])
    order = np.argsort(dense)
    linear = replace(problem, tracking=Linear(**vars(problem.tracking)))
    full = along(linear, motion, dense[order], z[:, order]).response
    return Full(full, np.searchsorted(dense[order], t))


def during(judged):
    """Indices of the instants of a motion, of those that are judged, and these, s."""
    some = np.flatnonzero(judged.t <= judged.motion.duration + 1e-9)
    return some, judged.t[some]


@pytest.fixture(scope="module")
def judged(motion):
    return Judged.of(*motion)


@pytest.mark.parametrize(("lacking", "at_first"), [(0.15, 0.0), (0.25, 0.25), (1.1, 1.1)])
def test_a_fifth_of_a_margin_may_be_missing_for_twenty_milliseconds(cube, lacking, at_first):
    """Of a constraint that the state inherits: what is missing later counts, and so does a row that is violated."""
    problem = transport_problem(cube)
    judged = Judged.of(
        problem, JointMotion(np.array([0.0, 0.2]), np.tile(problem.start_posture, (2, 1)), *np.zeros((2, 2, 7)))
    )
    constraint = next(x for x in problem.constraints if isinstance(x, ContactConstraint))
    block = next(x for x in constraint.blocks(judged.along) if x.inherits)
    margin = STANDARD.margin(block, constraint)
    rows = block.having(values=np.full(block.values.shape, (lacking - 1.0) * margin))
    (found,) = judged.rows(constraint, [rows])
    early = judged.t[block.points] < 0.02
    assert early.any()
    np.testing.assert_allclose(found.values[early], at_first * margin, atol=1e-12)
    np.testing.assert_allclose(found.values[~early], lacking * margin)


@pytest.mark.slow
def test_a_deviation_is_that_of_a_drive_that_is_linear_between_three_times_as_many_instants(motion, judged):
    """With derivatives of the dynamics at each of these."""
    problem, whole = motion
    some, t = during(judged)
    dense = np.append(np.concatenate([np.linspace(a, b, 3, endpoint=False) for a, b in pairwise(t)]), whole.duration)
    z = np.stack([*whole.sample(dense), whole.jerk(dense + 1e-9)])
    z[3, -1] = 0.0  # it rests
    full, found = linearly(problem, whole, dense, z), Full(judged.along.response, some)
    full = Full(full.deviation, full.some[::3])
    (w, drift), (w_full, drift_full) = found.felt(), full.felt()
    assert np.abs(w - w_full).max() < 2e-3 * 9.81
    assert np.abs(drift.dw - drift_full.dw).max() < 5e-4 * 9.81
    for order, kind in enumerate(LIMITS[:2]):  # of which a check keeps FINEST of the limit
        off = np.abs(found.joint_radius(order) - full.joint_radius(order)) / problem.limits.range(kind)[1]
        assert off.max() < FINEST
    rows = problem.contacts[0]
    exact = WorstCase.of(rows, w_full, drift_full).values
    near = exact > -0.1
    assert near.any()
    assert np.abs(WorstCase.of(rows, w, drift).values - exact)[near].max() < 0.2 * STANDARD.contact


def test_a_plan_keeps_what_its_scenario_asks_for_and_a_live_motion_more(motion):
    """Of a margin of 5 %, of one thousandth, of a limit, and of a distance, with a margin for what lies between."""
    problem, _ = motion
    asked = Block("", np.zeros((1, 1)), no_gradient, np.zeros(1, dtype=int), (0.0, 0.05))
    contact, limit, near = (ContactConstraint(problem.contacts[0]), JointLimit(problem.limits), Clearance(None))
    finest = asked.having(margins=(0.0, FINEST))
    assert [options.margin(asked, contact) for options in (STANDARD, PLANNED)] == pytest.approx([0.05, 0.05 - FINEST])
    assert [options.margin(finest, contact) for options in (STANDARD, PLANNED)] == pytest.approx([1e-3, 0.0], abs=1e-12)
    assert [options.margin(finest, limit) for options in (STANDARD, PLANNED)] == pytest.approx([FINEST, 0.0], abs=1e-12)
    bare = asked.having(margins=(0.0, 0.0))
    assert [options.margin(bare, near) for options in (STANDARD, PLANNED)] == [0.0, -FINEST]
    assert [options.margin(bare, limit) for options in (STANDARD, PLANNED)] == [0.0, 0.0]


def quick(given):
    """A motion of a fifth of a second, and the same with half a second of rest after it."""
    q = np.stack([given.q[0], given.q[0] + [0.1, -0.05, 0.05, 0.05, 0.1, 0.05, -0.1]])
    return (
        JointMotion(np.array([0.0, 0.2]), q, np.zeros((2, 7)), np.zeros((2, 7))),
        JointMotion(np.array([0.0, 0.2, 0.7]), q[[0, 1, 1]], np.zeros((3, 7)), np.zeros((3, 7))),
    )


def test_the_rest_after_a_motion_is_judged_with_it(motion):
    """Stopped in a fifth of a second, the tray then strays by up to twice as much as at the motion's end."""
    problem, given = motion
    ended, gone_on = (Judged.of(problem, each) for each in quick(given))
    after = (ended.t > 0.2 - 1e-9, (gone_on.t > 0.2 - 1e-9) & (gone_on.t < ended.t[-1] + 1e-9))
    both = [
        np.concatenate(judged.along.tray_radius(), axis=1)[t] for judged, t in zip((ended, gone_on), after, strict=True)
    ]
    assert both[0].max(axis=0) == pytest.approx(both[1].max(axis=0), rel=0.03, abs=1e-6)
    assert (both[0].max(axis=0) > 1.3 * both[0][0]).any()
    contacts = [
        WorstCase.of(problem.contacts[0], *x.along.response.felt()).values[t].max()
        for x, t in zip((ended, gone_on), after, strict=True)
    ]
    assert contacts[0] == pytest.approx(contacts[1], abs=0.2 * STANDARD.contact)


def test_a_motion_keeps_as_clear_of_things_while_it_rests_as_before(motion):
    """By what the tray strays then, which is more than at the motion's end."""
    problem, given = motion
    whole = transport_problem(problem.scenario)
    judged = Judged.of(whole, quick(given)[0])
    (block,) = clearance(judged)
    off = strayed(*judged.along.tray_radius())
    at_rest = judged.t > 0.2 - 1e-9
    assert at_rest[block.points].sum() == at_rest.sum()
    change = np.diff(block.values[at_rest[block.points]], axis=0)
    assert change == pytest.approx(np.repeat(10.0 * np.diff(off[at_rest])[:, None], change.shape[1], axis=1), abs=1e-9)
    assert np.ptp(off[at_rest]) > 1e-4  # m
    assert judged.off[-1] == off[at_rest].max() > off[at_rest][0]


def test_what_late_commands_do_is_known_where_the_jerk_jumps(motion):
    """Pieces of constant jerk, 7 to 20 ms long, between which it jumps by up to 1600 rad/s^3. Across a jump what is
    missing is no cubic: one through the instants on either side felt 4e-3 g wrong, four times what contact keeps."""
    problem, given = motion
    times = np.append(0.0, np.cumsum(np.tile([0.02, 0.011, 0.009, 0.02, 0.013, 0.007], 5)))
    ddq = np.random.default_rng(5).uniform(-5.0, 5.0, (len(times), 7))
    ddq[[0, -1]] = 0.0
    q, dq = [given.q[0]], [np.zeros(7)]
    for h, before, after in zip(np.diff(times), ddq, ddq[1:], strict=False):
        q.append(q[-1] + h * dq[-1] + h**2 * (2 * before + after) / 6)
        dq.append(dq[-1] + 0.5 * h * (before + after))
    whole = JointMotion(times, np.array(q), np.array(dq), ddq)
    judged = Judged.of(problem, whole)
    some, t = during(judged)
    full = linearly(problem, whole, t, judged.along.z[:, some])
    knots = np.isin(np.round(t, 9), np.round(times, 9))
    (w, drift), (w_full, drift_full) = Full(judged.along.response, some).felt(), full.felt()
    assert np.abs(w - w_full).max() < 2e-5 * 9.81
    assert np.abs(drift.swing - drift_full.swing).max() < 2e-5 * 9.81
    assert np.abs(drift_full.swing[knots]).max() > 5e-3 * 9.81


@pytest.mark.parametrize("factor", [0.8, 0.5, 0.1])
def test_late_commands_at_another_speed_are_those_of_the_slower_motion(motion, factor):
    problem, full = motion
    slower = JointMotion(full.t / factor, full.q, full.dq * factor, full.ddq * factor**2)
    direct = Judged.of(problem, slower, replace(PLANNED, step=PLANNED.step / factor))
    judged = Judged.of(problem, full, PLANNED)
    found, expected = judged.along.at_factor(factor).response, direct.along.response
    assert judged.last == direct.last
    for order in ("q", "dq"):
        x, y = (getattr(each.held, order)[: judged.last + 1] for each in (found, expected))
        assert np.abs(x - y).max() < 0.02 * np.abs(y).max() > 0.0


def test_what_goes_on_from_a_deviation_strays_as_the_whole(motion, judged):
    """From a knot in the middle: of what a wrong load does, and of what late commands did before."""
    problem, whole = motion
    at = 20
    cut = whole.t[at]
    rest = JointMotion(whole.t[at:] - cut, whole.q[at:], whole.dq[at:], whole.ddq[at:])
    found = Verdict("", judged=judged, margins=ConstraintMargins.of([], judged.t, problem))
    start = committed_of(found, 0.0).deviation_at(cut, problem)
    later = Judged.of(replace(problem, tracking=problem.tracking.begun(start)), rest)
    first = int(np.searchsorted(judged.t, cut - 1e-9))
    assert np.abs(later.t + cut - judged.t[first:]).max() < 1e-9
    (w, drift), (w_whole, drift_whole) = later.along.response.felt(), judged.along.response.felt()
    assert np.abs(w - w_whole[first:]).max() < 1e-4 * 9.81
    assert np.abs(drift.dw - drift_whole.dw[first:]).max() < 1e-4 * 9.81
    assert np.abs(start[:, :, -1]).max() > 1e-3  # rad/s


def test_the_margin_of_contact_is_more_than_the_verdict_may_miss(motion, judged):
    """Against four times as many instants; the peaks between instants are most of what they alone would miss."""
    problem, whole = motion
    some, t = during(judged)
    rows = WorstCase.of(problem.contacts[0], *judged.along.response.felt()).values[some]
    dense = np.append(np.concatenate([np.linspace(a, b, 4, endpoint=False) for a, b in pairwise(t)]), t[-1])
    z = np.stack([*whole.sample(dense), whole.jerk(dense + 1e-9)])
    truth = along(problem, whole, dense, z).response
    true = WorstCase.of(problem.contacts[0], *truth.felt()).values.max(axis=1)
    true = np.array([true[4 * k : 4 * k + 5].max() for k in range(len(t) - 1)])
    at_instants = rows.max(axis=1)
    assert 0 < (true - np.maximum(at_instants[1:], at_instants[:-1])).max() < 0.6 * STANDARD.contact
    assert (true - peaks(t, rows).max(axis=1)).max() < 0.2 * STANDARD.contact


def test_a_row_that_rises_between_two_instants_is_judged_at_its_peak(motion):
    """Parabolas, at uneven instants: 1 + 2 t - 3 t^2 has its peak, 4/3, at 1/3; rising and falling ones at an end."""
    t = np.array([0.0, 0.3, 0.5, 1.1])
    rows = np.stack([1 + 2 * t - 3 * t**2, t**2, 1 - t], axis=1)
    assert peaks(t, rows) == pytest.approx(np.array([[1.33, 0.09, 1.0], [4 / 3, 0.25, 0.7], [1.25, 1.21, 0.5]]))
    bent = np.array([[0.0, 1.0, 1.0, 1.0], [1.0, 1.0, 1.0, 0.0]]).T  # at one end of the middle step only
    assert peaks(np.arange(4.0), bent)[1] == pytest.approx([1.125, 1.125])
    problem, whole = motion
    judged, constraint = Judged.of(problem, whole), ContactConstraint(problem.contacts[0])
    middle, half = 0.5 * (judged.t[41] + judged.t[40]), 0.5 * (judged.t[41] - judged.t[40])
    values = -2e-4 - STANDARD.contact * ((judged.t[:, None] - middle) / half) ** 2  # no instant needs the margin
    block = Block("contact", values, no_gradient, judged.along.nodes)
    live = judged.at_peaks(next(judged.rows(constraint, [block])))
    assert live.values.max() == pytest.approx(STANDARD.contact - 2e-4)
    assert live.values.argmax() == 40


def test_the_margin_of_torque_rate_is_more_than_the_verdict_may_miss(motion):
    """Against what a loop is told from one period to the next, wherever these fall; in a hurry and backwards too."""
    problem, whole = motion
    missed = []
    for share, way in ((1.0, 1), (0.8, 1), (0.6, 1), (1.0, -1)):
        hurried = JointMotion(
            share * whole.t, whole.q[::way], way * whole.dq[::way] / share, whole.ddq[::way] / share**2
        )
        judged = Judged.of(problem, hurried)
        (block,) = torque_rate(judged)
        found = (block.values + 1.0 - STANDARD.torque_rate).max()
        fine = np.arange(0.0, hurried.duration, 1e-4)
        z = np.stack([*hurried.sample(fine), hurried.jerk(fine)])
        tau = problem.at(fine / hurried.duration, z, hurried.duration).terms.torque
        executed = np.abs(tau[10:] - tau[:-10]).max(initial=0.0, axis=0) / 1e-3 / problem.limits.torque_rate
        missed.append(executed.max() / found - 1.0)
    assert np.max(missed) < 0.5 * STANDARD.torque_rate, missed
    assert np.min(missed) > -0.1, missed  # the jerk's jump is not so large that the most is elsewhere


def test_a_torque_rate_that_rises_and_falls_between_two_near_knots_is_seen():
    """About the vertical, with a jerk that is zero at two knots 2.4 ms apart and a parabola between: at its top the
    torque changes half as fast again as it may."""
    problem = replace(transport_problem(sv.load_scenario("panda-cube")), keep_out=None)
    q = problem.start.q
    mass, limit = problem.arm.mass_matrix(q)[0, 0], problem.limits.torque_rate[0]

    def with_top(share):
        h, jerk = 2.4e-3, share * limit / mass
        knots = [(0.0, 0.0, 0.0, 0.0), (0.2, 0.02, 0.2, 0.0)]
        knots.append((0.2 + h, 0.02 + 0.2 * h + 0.1 * jerk * h**3, 0.2 + jerk * h**2 / 3, 2 * jerk * h / 3))
        t, *states = np.array([*knots, (0.6, 0.1, 0.0, 0.0)]).T
        turned = [np.outer(x, np.eye(7)[0]) for x in states]
        return JointMotion(t, q + turned[0], *turned[1:])

    assert with_top(1.5).jerk(np.array([0.2012]))[0, 0] == pytest.approx(1.5 * limit / mass)
    assert verify(problem, with_top(0.8)).ok
    assert verify(problem, with_top(1.5)).what == "torque rate of panda_joint1"


def test_a_torque_rate_is_largest_over_the_period_that_has_its_peak_in_the_middle():
    """About the vertical, with a jerk that rises to J at a knot and falls, as lines of 2 ms each: its mean over 1 ms
    about it is 7/8 J, and 3/4 J over 1 ms that begins or ends there."""
    problem = replace(transport_problem(sv.load_scenario("panda-cube")), keep_out=None)
    q, h = problem.start.q, 2e-3
    mass = with_load(problem.arm, problem.items).mass_matrix(q)[0, 0]
    limit = problem.limits.torque_rate[0]

    def with_peak(share):
        jerk = share * limit / mass
        knots = [(0.0, 0.0, 0.0, 0.0), (0.2, 0.02, 0.2, 0.0)]
        knots.append((0.2 + h, 0.02 + 0.2 * h + jerk * h**3 / 24, 0.2 + jerk * h**2 / 6, jerk * h / 2))
        knots.append((0.2 + 2 * h, 0.02 + 0.4 * h + jerk * h**3 * 7 / 12, 0.2 + jerk * h**2, jerk * h))
        t, *states = np.array([*knots, (0.6, 0.1, 0.0, 0.0)]).T
        turned = [np.outer(x, -np.eye(7)[0]) for x in states]
        return JointMotion(t, q + turned[0], *turned[1:])

    judged = Judged.of(problem, with_peak(1.0))
    (block,) = torque_rate(judged)
    about = np.abs(judged.t[block.points] - 0.2 - h) < 0.9 * h
    assert block.values[about].max() + 1.0 - STANDARD.torque_rate == pytest.approx(7 / 8, rel=1e-3)
    assert verify(problem, with_peak(1.1)).ok
    assert verify(problem, with_peak(1.15)).what == "torque rate of panda_joint1"


@pytest.mark.parametrize(("name", "share"), [("panda-cube", -1.0), ("panda-tall-bottle", 0.1)])
def test_a_bound_stands_only_for_rows_that_are_surely_far(name, share):
    """Further than 2 % of the weight and than twice a margin, so that the sign of every row is right. share: that is
    bounded at least; the cube has few facets, all of them near."""
    problem = transport_problem(sv.load_scenario(name))
    rows, rng = problem.contacts[0], np.random.default_rng(3)
    t = np.linspace(0.0, 2.0, 400)[:, None]
    w = np.zeros((400, 12))
    w[:, 2] = 9.81
    w[:, :6] += np.array([1.5, 1.5, 1.5, 2.0, 2.0, 2.0]) * np.sin(rng.uniform(1, 5, 6) * t + rng.uniform(0, 6, 6))
    terms = tuple((p,) for p in problem.tracking.load.uncertain.parameters)
    drift = Drift(terms, 0.05 * rng.normal(size=(400, 12, len(terms))), 0.05 * rng.normal(size=(400, 12)))
    for known, margin in product((None, drift, replace(drift, swing=None)), (0.0, 0.1)):
        exact, coarse = (WorstCase.of(rows, w, known, x, margin).values for x in (False, True))
        assert np.all(coarse >= exact - 1e-12)
        bounded = np.abs(coarse - exact) > 1e-12
        assert np.all(coarse[bounded] <= -max(0.02, 2.0 * margin))
        assert np.array_equal(coarse + margin > 0, exact + margin > 0)
        assert margin or bounded.mean() > share


def test_a_bound_stands_for_no_row_that_is_within_the_margin_of_the_scenario(motion, judged):
    exact, coarse = (
        next(judged.rows(ContactConstraint(motion[0].contacts[0], 0.1, coarsely=x))).values for x in (False, True)
    )
    assert np.array_equal(coarse > 0, exact > 0)
    assert 0.0 < np.mean(exact > 0) < 0.5


def test_a_swing_counts_on_either_side():
    """Of a drift that is nothing but a swing: the worse of the two ends, row by row."""
    problem = transport_problem(sv.load_scenario("panda-tall-bottle"))
    rows, rng = problem.contacts[0], np.random.default_rng(5)
    w = np.zeros((30, 12))
    w[:, 2] = 9.81
    w[:, :6] += rng.normal(size=(30, 6))
    swing = 0.3 * rng.normal(size=(30, 12))
    terms = tuple((p,) for p in problem.tracking.load.uncertain.parameters)
    found = WorstCase.of(rows, w, Drift(terms, np.zeros((30, 12, len(terms))), swing)).values
    sides = [WorstCase.of(rows, side).values for side in (w + swing, w - swing)]
    assert found == pytest.approx(np.maximum(*sides), abs=1e-12)
    assert all(np.any(found > side + 1e-3) for side in sides)


def test_extremes_are_those_of_a_fine_scan():
    """Of cubics that turn twice, once or not at all, and of lines and constants; and of quadratics."""
    cubics = np.random.default_rng(2).normal(size=(4, 300))
    cubics[:, :3] = np.array([[0, 1, 2, 3], [1, 1, 1, 1], [0, 1, 1, 0]]).T
    u = np.linspace(0.0, 1.0, 4001)[:, None, None]
    weights = np.concatenate([(1 - u) ** 3, 3 * u * (1 - u) ** 2, 3 * u**2 * (1 - u), u**3], axis=1)
    values = (weights * cubics).sum(axis=1)
    assert extremes(cubics) == pytest.approx(np.array([values.min(axis=0), values.max(axis=0)]), abs=1e-6)
    assert np.mean(values.max(axis=0) > cubics[[0, 3]].max(axis=0) + 1e-2) > 0.1
    quadratics = cubics[:3]
    values = (np.concatenate([(1 - u) ** 2, 2 * u * (1 - u), u**2], axis=1) * quadratics).sum(axis=1)
    assert extremes(quadratics) == pytest.approx(np.array([values.min(axis=0), values.max(axis=0)]), abs=1e-6)
    assert np.mean(values.max(axis=0) > quadratics[[0, 2]].max(axis=0) + 1e-2) > 0.1


def test_what_limits_a_motion_is_what_is_ahead_of_it():
    margins = ConstraintMargins(
        np.array([0.0, 1.0, 2.0]), np.array([-0.1, -0.4, -0.3]), np.array([0, 1, 1]), ("a", "b")
    )
    assert margins.from_(0.0) == (0.1, "a")
    assert margins.from_(0.5) == margins.from_(1.5) == (0.3, "b")


@pytest.mark.parametrize(("order", "off"), [(0, 1e-7), (1, 1e-6), (2, 1e-4)])
def test_a_motion_begins_in_the_state_of_the_arm(motion, order, off):
    problem, whole = motion
    whole = JointMotion(1.2 * whole.t, whole.q, whole.dq / 1.2, whole.ddq / 1.2**2)
    state = np.zeros((3, problem.n))
    state[0] = whole.q[0]
    found = verify(problem, whole, tuple(state), PLANNED)
    assert found.ok, found.sentence
    assert found.margins.t[-1] == found.judged.t[-1]
    state[order, 2] += off
    assert verify(problem, whole, tuple(state), PLANNED).sentence == "it does not begin where the arm is then"


def test_an_acceleration_that_rises_and_falls_between_two_instants_is_seen():
    """From rest to rest within one step of the verdict."""
    problem = transport_problem(sv.load_scenario("panda-cube"))
    q = problem.start.q
    step = 0.9 * STANDARD.step
    still = np.zeros((2, 7))
    pulse = JointMotion(np.array([0.0, step]), np.stack([q, q + 1e-5]), still, still)
    peak = np.abs(pulse.sample(np.linspace(0.0, step, 10001))[2]).max()
    for count in (1, 4):
        t, z = pulse.evenly(np.array([count]))
        assert np.abs(extremes(Quintics.through(t, z[:3]).hulls[2])).max() == pytest.approx(peak, rel=1e-6)
    refused = verified(problem, pulse, 0.0, None)
    assert refused.committed is None
    assert refused.what.startswith(("acceleration", "jerk"))


@pytest.mark.parametrize("kind", LIMITS, ids=lambda kind: kind.key)
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_each_limit_alone_refuses_a_motion(motion, kind, sign):
    """To position, velocity and torque what is uncertain is added. Of the joint that needs that side of it most."""
    problem, whole = motion
    slow = JointMotion(1.2 * whole.t, whole.q, whole.dq / 1.2, whole.ddq / 1.2**2)
    assert verified(problem, slow, 0.0, None).committed is not None
    along = Judged.of(problem, slow).along
    radius = np.zeros((1, problem.n))
    if kind.key == "torque":
        value, radius = along.terms.torque, along.torque_radius()
    elif kind.key == "torque_rate":
        t = np.arange(0.0, slow.duration, 1e-4)
        tau = problem.at(t / slow.duration, np.stack([*slow.sample(t), slow.jerk(t)]), slow.duration).terms.torque
        value = (tau[10:] - tau[:-10]) / 1e-3
    else:
        value = along.z[kind.order] if kind.order < 3 else np.concatenate([along.z[3], along.jerk_before])
        radius = along.joint_radius(kind.order) if kind.order < 2 else radius
    alone, other = (sign * value).max(axis=0), (-sign * value).max(axis=0)
    j = int(np.argmax(alone if kind.key == "position" else alone - other))
    most, this = float((sign * value + radius)[:, j].max()), np.arange(problem.n) == j
    name = kind.key if kind.key != "position" else "q_max" if sign > 0 else "q_min"
    within = 0.5 * (alone[j] + most) if radius.any() else 0.98 * most
    for limit, held in ((within, False), (most + 0.02 * abs(most), True)):
        given = np.where(this, limit, np.inf) if name == kind.key else sign * np.where(this, limit, 9.0)
        found = verified(replace(problem, limits=replace(problem.limits, **{name: given})), slow, 0.0, None)
        assert (found.committed is not None) == held, found.sentence
        assert held or found.what == f"{kind.name} of {problem.arm.joint_names[j]}"
        if not held and kind.of == "position" and kind.order:
            assert found.slower == pytest.approx((1 / kind.order + 0.02) * found.excess)
        assert held or np.isfinite(found.slower) == (kind.key != "position")  # where the joint goes, time mends nothing


@pytest.mark.parametrize("speed", [Speed(1.0), Speed(0.6), Speed(0.0), Speed(0.0, 0.25)], ids=str)
def test_contact_at_each_speed_alone_refuses_a_motion(motion, speed):
    """Of a tray that leans so far that the bottle would slide, at rest already."""
    problem, given = motion
    leaning = resting(given.q[0] + [0.0, 0.0, 0.0, 0.0, 0.0, 0.5, 0.0])
    assert verified(replace(problem, speeds=()), leaning, 0.0, None).committed is not None
    found = verified(replace(problem, speeds=(speed,)), leaning, 0.0, None)
    assert found.what == f"contact of bottle{speed.words}"


@pytest.mark.parametrize("most", [0.0, 0.1])
def test_the_tilt_alone_refuses_a_motion(motion, most):
    problem, given = motion
    problem = replace(problem, max_tilt=most, speeds=())
    for leans, held in ((0.9 * most, True), (1.1 * most + 0.002, False)):
        level = given.q[0].copy()
        level[5] += leans - _leaning(problem, level)
        found = verified(problem, resting(level), 0.0, None)
        assert (found.committed is not None) == held, found.sentence
        assert held or found.what == "tilt"


def _leaning(problem, q):
    """rad"""
    return float(np.arccos(np.clip(problem.arm.tray_pose(q)[1][2, 2], -1.0, 1.0)))


def test_the_room_of_a_liquid_alone_refuses_a_motion(coffee):
    """A turn of the first joint by 0.4 rad, without any other limit."""
    problem = transport_problem(coffee)
    free = {kind.key: np.full(problem.n, np.inf) for kind in LIMITS if kind.key != "position"}
    problem = replace(problem, contacts=(), keep_out=None, limits=replace(problem.limits, **free))
    s, turn = np.linspace(0.0, 1.0, 41), 0.4 * np.eye(problem.n)[0]
    for duration, held in ((1.2, True), (0.8, False)):
        rates = [30 * s**2 * (1 - s) ** 2 / duration, 60 * s * (1 - s) * (1 - 2 * s) / duration**2]
        swung = problem.start_posture + np.outer(smooth_step(s), turn)
        motion = JointMotion(s * duration, swung, *(np.outer(rate, turn) for rate in rates))
        found = verified(problem, motion, 0.0, None)
        assert (found.committed is not None) == held
        assert held or found.what.startswith("waves")


class Hasty(TransportProblem):
    """One whose motions may leave whatever they like behind."""

    @cached_property
    def constraints(self):
        return tuple(each for each in super().constraints if not isinstance(each, AtRest))


@pytest.mark.slow
def test_what_happens_in_a_load_while_the_arm_settles_is_judged_and_planned_for():
    """A cup of oil, at the end of a motion as fast as an xarm7 may stop: the arm that gives way makes waves steeper
    than those that are left."""
    liquid = {"kind": "oil", "radius": 0.0345, "fill": 0.0218, "brim": 0.0466}
    cup = {"name": "cup", "mass": 0.09, "friction": 0.516, "support_inset": 0.002, "liquid": liquid}
    cup["shape"] = {"type": "cylinder", "radius": 0.0387, "height": 0.0508}
    cup["uncertainty"] = {"mass": "10%", "com": [0.002, 0.002, 0.003], "friction": "10%"}
    ends = {"start": {"position": [0.313, 0.260, 0.296]}, "goal": {"position": [0.422, -0.004, 0.313]}}
    motion = {**ends, "goal_yaw": "free", "speeds": "full"}
    contact, arm = {"condition": "exact"}, {"model": "xarm7"}
    case = parse({"name": "oil", "motion": motion, "objects": [cup], "contact": contact, "arm": arm}, "oil")
    problem = transport_problem(case)
    found = fastest(Hasty(**vars(problem)))
    refused = verify(problem, found.joint_motion(), None, PLANNED, thoroughly=True)
    assert refused.what == "steepness in cup after the motion"
    assert refused.excess > 0.01
    plan = plan_fastest(case)
    assert plan.ok, plan.told
    assert plan.duration < 1.04 * found.duration


@pytest.mark.parametrize("more", [10.0, np.nan])
def test_distances_of_a_kind_of_ones_own_are_looked_at_too(motion, more):
    """Of the very pairs that are looked at anyway, with another metre, or with what is no number."""

    class Wide(Clearance):
        def blocks(self, motion):
            for block in super().blocks(motion):
                yield block.having(values=block.values + more)

    problem, given = motion
    whole = transport_problem(problem.scenario)
    still = resting(given.q[0])
    assert verified(whole, still, 0.0, None).committed is not None
    found = verified(replace(whole, extra=(Wide(whole.keep_out),)), still, 0.0, None)
    assert found.what.startswith("clearance of ")
