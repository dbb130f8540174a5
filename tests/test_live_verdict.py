"""What the verdict on live motions leaves out of its work must not change it: compared with all of the work."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

import salver as sv
from live_runs import JUST, Linear
from salver.live.verify import COARSE, STEADY, UNHURRIED, _at_rest, seen, told
from salver.models.arm_limits import LIMITS
from salver.models.worst_case import Drift, WorstCase
from salver.planning.fastest import fastest, transport_problem
from salver.planning.fastest.constraints import FINEST, Block, Clearance, JointLimit, TorqueRateLimit, evaluate, strayed
from salver.sensitivity.arm.finer import _cubic, some_of
from salver.trajectory import JointMotion


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


def looked_at(problem, motion):
    """`seen`, with what the arm strays worked out."""
    found, straying, knots = seen(problem, motion)
    return found, straying(), knots


@pytest.fixture(scope="module")
def both(motion):
    """What the verdict sees at its nodes, and what there is."""
    problem, whole = motion
    found, known, _ = looked_at(problem, whole)
    t = found.s[found.nodes] * whole.duration
    assert len(known.t) < 0.6 * len(t)
    return found, np.searchsorted(t, known.t - 1e-9), t, along(problem, whole, t, found.at_nodes)


def test_what_is_felt_and_the_torque_known_at_some_instants_are_those_of_all_of_them(both):
    found, _, t, full = both
    assert np.abs(found.terms.w - full.terms.w).max() < 1e-4 * 9.81
    assert np.abs(found.terms.R_SE - full.terms.R_SE).max() < 2.5e-6  # rad: half of what a check keeps of a level tray
    off = found.terms.torque - full.terms.torque
    assert np.abs(off).max() < 1e-3  # N m
    assert np.abs(np.diff(off, axis=0) / np.diff(t)[:, None]).max() < 3e-4 * 950.0  # N m/s, of which UNHURRIED is kept


def test_a_deviation_known_at_some_instants_is_that_of_all_of_them(motion, both):
    problem, whole = motion
    found, _, t, _ = both
    full, finer = linearly(problem, whole, t, found.at_nodes), found.response
    (w, drift), (w_full, drift_full) = finer.felt(), full.felt()
    assert np.abs(w - w_full).max() < 2e-3 * 9.81
    assert np.abs(drift.dw - drift_full.dw).max() < 5e-4 * 9.81
    for order, kind in enumerate(LIMITS[:2]):  # of which a check keeps FINEST of the limit
        off = np.abs(finer.joint_radius(order) - full.joint_radius(order)) / problem.limits.range(kind)[1]
        assert off.max() < FINEST
    rows = problem.contacts[0]
    exact = WorstCase.of(rows, w_full, drift_full).values
    near = exact > -0.1
    assert near.any()
    assert np.abs(WorstCase.of(rows, w, drift).values - exact)[near].max() < 0.2 * STEADY


def distances(problem, along, row):
    """Rows of one pair that are the same at all nodes."""
    of = Clearance(transport_problem(problem.scenario).keep_out)
    return Block("clearance", np.full((len(along.nodes), 1), row), None, along.nodes, of=of)


def test_a_motion_is_as_clear_of_things_at_its_end_as_while_it_rests_there(motion):
    """Stopped in a fifth of a second, the tray then strays by up to twice as much as at the motion's end."""
    problem, given = motion
    q = np.stack([given.q[0], given.q[0] + [0.1, -0.05, 0.05, 0.05, 0.1, 0.05, -0.1]])
    quick = JointMotion(np.array([0.0, 0.2]), q, np.zeros((2, 7)), np.zeros((2, 7)))
    resting = JointMotion(np.array([0.0, 0.2, 0.7]), q[[0, 1, 1]], np.zeros((3, 7)), np.zeros((3, 7)))
    ended, gone_on = (looked_at(problem, each)[0] for each in (quick, resting))
    after = gone_on.s[gone_on.nodes] * 0.7 > 0.2 - 1e-9
    told, seen = np.concatenate(ended.response.resting), np.concatenate(gone_on.tray_radius(), axis=1)[after]
    assert seen.max(axis=0) == pytest.approx(told, rel=0.03, abs=1e-6)
    assert (told > 1.3 * seen[0]).any()
    near, far = (_at_rest(distances(problem, ended, row), ended.response) for row in (-0.02, -0.2))  # 2 and 20 mm free
    more = 10 * (strayed(*ended.response.resting) - strayed(*ended.tray_radius())[-1])  # in units of 0.1 m
    assert more > 1e-3
    assert near.values[:, 0] == pytest.approx(np.append(np.full(len(near.values) - 1, -0.02), -0.02 + more))
    assert np.all(far.values == -0.2)


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
    found, _, knots = looked_at(problem, whole)
    full = linearly(problem, whole, found.s[found.nodes] * whole.duration, found.at_nodes)
    (w, drift), (w_full, drift_full) = found.response.felt(), full.felt()
    assert np.abs(w - w_full).max() < 2e-5 * 9.81
    assert np.abs(drift.swing - drift_full.swing).max() < 2e-5 * 9.81
    assert np.abs(drift_full.swing[knots]).max() > 5e-3 * 9.81


def test_what_goes_on_from_a_deviation_strays_as_the_whole(motion, both):
    """From a knot in the middle: of what a wrong load does, and of what late commands did before."""
    problem, whole = motion
    at = 20
    cut = whole.t[at]
    rest = JointMotion(whole.t[at:] - cut, whole.q[at:], whole.dq[at:], whole.ddq[at:])
    found, _, t, _ = both
    _, known, _ = looked_at(problem, whole)
    start = known.response.known.state_at(known.t, cut)
    begun = replace(problem, tracking=problem.tracking.begun(start))
    later, _, _ = looked_at(begun, rest)
    first = np.searchsorted(t, cut - 1e-9)
    assert np.abs(later.s[later.nodes] * rest.duration + cut - t[first:]).max() < 1e-9
    (w, drift), (w_whole, drift_whole) = later.response.felt(), found.response.felt()
    assert np.abs(w - w_whole[first:]).max() < 1e-4 * 9.81
    assert np.abs(drift.dw - drift_whole.dw[first:]).max() < 1e-4 * 9.81
    assert np.abs(start[:, :, -1]).max() > 1e-3  # rad/s


def test_the_margin_of_contact_is_more_than_the_verdict_may_miss(motion, both):
    """Against four times as many instants, at each of which everything is worked out."""
    problem, whole = motion
    found, _, t, _ = both
    judged = WorstCase.of(problem.contacts[0], *found.response.felt()).values.max(axis=1)
    dense = np.append(np.concatenate([np.linspace(a, b, 4, endpoint=False) for a, b in pairwise(t)]), t[-1])
    z = np.stack([*whole.sample(dense), whole.jerk(dense + 1e-9)])
    truth = along(problem, whole, dense, z).response
    rows = WorstCase.of(problem.contacts[0], *truth.felt()).values.max(axis=1)
    missed = [rows[4 * k : 4 * k + 5].max() - judged[k : k + 2].max() for k in range(len(t) - 1)]
    assert 0 < max(missed) < 0.6 * STEADY


def test_the_margin_of_torque_rate_is_more_than_the_verdict_may_miss(motion):
    """Against what a loop is told from one period to the next, wherever these fall; in a hurry and backwards too."""
    problem, whole = motion
    rates = TorqueRateLimit(problem.limits)
    missed = []
    for share, way in ((1.0, 1), (0.8, 1), (0.6, 1), (1.0, -1)):
        hurried = JointMotion(
            share * whole.t, whole.q[::way], way * whole.dq[::way] / share, whole.ddq[::way] / share**2
        )
        at, _, knots = seen(problem, hurried)
        t = at.s[at.nodes] * hurried.duration
        (block,) = evaluate([rates], at)
        found = (told(block, t, knots).values + 1.0 - block.margins[1]).max()
        fine = np.arange(0.0, hurried.duration, 1e-4)
        z = np.stack([*hurried.sample(fine), hurried.jerk(fine)])
        tau = problem.at(fine / hurried.duration, z, hurried.duration).terms.torque
        executed = np.abs(tau[10:] - tau[:-10]).max(initial=0.0, axis=0) / 1e-3 / problem.limits.torque_rate
        missed.append(executed.max() / found - 1.0)
    assert np.abs(missed).max() < 0.5 * UNHURRIED, missed  # the most is over a period that a knot is in


def test_where_it_is_known_it_is_what_was_worked_out(both):
    found, some, _, _ = both
    finer = found.response
    (w, drift), (w_known, drift_known) = finer.felt(), finer.known.felt()
    # The jerk is taken 1e-9 s beside a knot: by that of snap, 1e5 rad/s^4, times the delay, felt 1 m away.
    assert np.abs(w[some] - w_known).max() < 1e-6
    assert np.abs(drift.dw[some] - drift_known.dw).max() < 1e-12
    assert np.abs(drift.swing[some] - drift_known.swing).max() < 1e-6
    assert np.abs(finer.torque_radius()[some] - finer.known.torque_radius()).max() < 1e-12


def test_what_a_verdict_worked_out_is_known_at_other_instants_of_the_motion(motion, both):
    """And after its end, where the arm rests: against everything worked out at all of them."""
    problem, whole = motion
    known = looked_at(problem, whole)[1]
    t = np.append(np.linspace(0.0, whole.duration, 57)[:-1] + 1e-3, whole.duration + np.array([0.01, 0.05]))
    z = np.stack([*whole.sample(t), whole.jerk(t) * (t < whole.duration)[:, None]])
    recalled = known.along(along(problem, whole, t, z), t)
    moving = t < whole.duration
    full = along(problem, whole, t, z).terms
    assert np.abs(recalled.terms.w - full.w).max() < 2e-4 * 9.81
    assert np.abs(recalled.terms.w_z - full.w_z).max() < 2e-3 * np.abs(full.w_z).max()
    assert np.abs(recalled.terms.torque_z - full.torque_z).max() < 2e-3 * np.abs(full.torque_z).max()
    dense = np.unique(np.concatenate([t[moving], both[2]]))
    z = np.stack([*whole.sample(dense), whole.jerk(dense)])
    w, drift = recalled.response.felt()
    w_full, drift_full = along(problem, whole, dense, z).response.felt()
    there = np.searchsorted(dense, t[moving])
    assert np.abs(drift.dw[moving] - drift_full.dw[there]).max() < 1e-3 * 9.81
    assert np.abs((w + drift.swing)[moving] - (w_full + drift_full.swing)[there]).max() < 2e-3 * 9.81
    assert not drift.swing[~moving].any()


def test_cubics_within_a_piece_know_nothing_of_the_next_one():
    """A cubic that jumps to another one at a knot is met everywhere, to rounding; pieces of few instants too."""
    t = np.unique(np.concatenate([np.linspace(0, 0.1, 51), np.linspace(0.1, 0.102, 2), np.linspace(0.102, 0.2, 50)]))
    knots = np.isin(t, [0.0, 0.1, 0.102, 0.2])
    some = some_of(t, knots, COARSE)
    nearest, weights, _ = _cubic(t[some], knots[some], t)
    values = np.where(t < 0.1, 1 + t**3, np.where(t < 0.102, 1.001 + 40 * (t - 0.1), 1.081 - (t - 0.102) ** 3))
    assert np.abs((weights * values[some][nearest]).sum(axis=1) - values)[t != 0.1].max() < 1e-9


@pytest.mark.parametrize(("name", "share"), [("panda-cube", -1.0), ("panda-tall-bottle", 0.1)])
def test_a_bound_stands_only_for_rows_that_are_surely_far(name, share):
    """Further than 2 % of the weight, so that the sign of every row is right. share: that is bounded at least; the cube
    has few facets, all of them near."""
    problem = transport_problem(sv.load_scenario(name))
    rows, rng = problem.contacts[0], np.random.default_rng(3)
    t = np.linspace(0.0, 2.0, 400)[:, None]
    w = np.zeros((400, 12))
    w[:, 2] = 9.81
    w[:, :6] += np.array([1.5, 1.5, 1.5, 2.0, 2.0, 2.0]) * np.sin(rng.uniform(1, 5, 6) * t + rng.uniform(0, 6, 6))
    terms = tuple((p,) for p in problem.tracking.load.uncertain.parameters)
    drift = Drift(terms, 0.05 * rng.normal(size=(400, 12, len(terms))), 0.05 * rng.normal(size=(400, 12)))
    for known in (None, drift, replace(drift, swing=None)):
        exact, coarse = (WorstCase.of(rows, w, known, coarsely=x).values for x in (False, True))
        assert np.all(coarse >= exact - 1e-12)
        bounded = np.abs(coarse - exact) > 1e-12
        assert np.all(coarse[bounded] <= -0.02)
        assert np.array_equal(coarse > 0, exact > 0)
        assert bounded.mean() > share


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


def test_an_acceleration_that_rises_and_falls_between_two_instants_is_seen():
    """The peak of a parabola, wherever the instants fall on it, beside a knot too; the knot, a kink, is left alone."""
    limits = JointLimit(transport_problem(sv.load_scenario("panda-cube")).limits)
    nodes, knots = np.arange(9), np.arange(9) % 4 == 0
    for peak in (0.003, 0.0039, 0.0041, 0.0043, 0.0049):
        t = 5e-4 * np.arange(17)
        values = (1e-3 - 400.0 * (t - peak) ** 2)[:, None]
        block = Block("acceleration", values.copy(), lambda i, f: np.zeros((0, 28)), np.arange(17), of=limits)
        seen_at = told(block, 1e-3 * nodes, knots).values
        assert np.isclose(seen_at.max(), 1e-3, rtol=1e-9)
        assert np.array_equal(seen_at[::8], values[::8])
