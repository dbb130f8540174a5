"""How what is committed is bent: a tick's programmes, which rows they have, and what one tick learns for the next."""

from dataclasses import dataclass, field, replace
from itertools import pairwise
from types import SimpleNamespace

import numpy as np
import pytest

from live_runs import EVERY, drive, said
from salver.live import Live
from salver.live.replanning import steer
from salver.live.replanning.steer import HORIZON, TICK, ChunkWanted, TwistWanted
from salver.planning.fastest import Block
from salver.sensitivity.arm.terms import motion_terms
from salver.trajectory import JointMotion


@pytest.mark.parametrize("seconds", [0.1, 0.3, 0.9])
def test_a_bend_is_added_to_what_is_committed_from_the_hand_over_on(cube, seconds):
    """One that has ended before, one that ends before the bend does and one that goes on: at the end it rests."""
    problem, rng = Live(cube).problem, np.random.default_rng(6)
    steering, size = steer.Steering.of(problem, problem), (4, problem.n)
    q, dq, ddq = rng.normal(size=(3, *size))
    dq[-1] = ddq[-1] = 0.0
    base = SimpleNamespace(begins=3.0, motion=JointMotion(seconds * np.array([0.0, 0.3, 0.4, 1.0]), q, dq, ddq))
    bend = rng.normal(size=(steering.grid.basis.shape[2], problem.n))
    t = np.linspace(0.0, 0.999 * HORIZON, 200)
    added = steering.spline.matrices(t / HORIZON)[:3] @ bend / HORIZON ** np.arange(3.0)[:, None, None]
    for times in (0.0, 1.0, -2.0):
        found = steering.bent(base, 3.17, times * bend)
        assert found.duration == pytest.approx(max(seconds - 0.17, HORIZON))
        for mine, before, more in zip(found.sample(t), base.motion.sample(0.17 + t), added, strict=True):
            assert mine == pytest.approx(before + times * more, rel=1e-9, abs=1e-7)
        assert not np.any([found.dq[-1], found.ddq[-1]])


def test_derivatives_of_what_is_wanted_match_differences(cube):
    """Twist and pose residuals by the joints' motion, against central differences of the residuals themselves."""
    problem = Live(cube).problem
    rng = np.random.default_rng(4)
    s, n = np.linspace(0, 1, 4), problem.n
    z = 0.4 * rng.standard_normal((4, 4, n))
    z[0] += problem.start.q
    p, R = problem.arm.tray_pose(problem.start.q)
    t, weight = 0.1 * s, np.ones(4)
    pose = ChunkWanted(np.array([0.0, 1.0]), np.array([p, p + 0.1]), np.array([R, R]), None)
    for wanted in (TwistWanted(rng.standard_normal(6), np.zeros(6), 0.0, window=1.0), pose):
        found = wanted.residuals(problem.at(s, z, 0.1), t, weight)
        for order in (0, 1):
            for joint in range(n):
                step = np.zeros_like(z)
                step[order, :, joint] = 1e-6
                up, down = (wanted.residuals(problem.at(s, z + sign * step, 0.1), t, weight) for sign in (1, -1))
                difference = (up.value - down.value) / 2e-6
                near = pose is wanted and order == 0
                # The turn's derivative is that at the wanted rotation: exact where it is met.
                kept = np.tile(np.arange(6) < 3, 4) if near else np.ones(24, dtype=bool)
                assert np.abs(difference - found.parts[:, order, joint])[kept].max() < 1e-6


@dataclass
class Bending:
    """What was seen of one tick: along which motions (4, P, n) which rows were evaluated, as they were and as they then
    stood, which joined, what was kept from their edges, and the programmes; how many evaluations each bend took that
    went to the verdict."""

    given: tuple  # by whom, what is wanted, what is committed, from when on
    z: list = field(default_factory=list)
    raw: list = field(default_factory=list)
    blocks: list = field(default_factory=list)
    joined: list = field(default_factory=list)
    more: list = field(default_factory=list)
    posed: list = field(default_factory=list)
    kept: list = field(default_factory=list)
    judged: list = field(default_factory=list)


@pytest.fixture(scope="module")
def bendings(cube):
    """Of one that pulls harder than the load allows."""
    return bent_by(cube, lambda t: np.array([1.5, -1.5, 0.5]), 0.2)


def bent_by(scenario, told, seconds):
    """The ticks of a hand, each with what its programmes answered."""
    seen, found = [], {}
    bend, evaluate, programme, solve = steer.Steering._bends, steer.evaluate, steer._programme, steer.qp.solve
    margins, joining = steer.Caution.margins, Block.joining

    def bending(*given):
        seen.append(Bending(given))
        for found in bend(*given):
            seen[-1].kept.append(found[1])
            seen[-1].judged.append(len(seen[-1].blocks))
            yield found

    def evaluating(constraints, motion, *given):
        blocks = evaluate(constraints, motion, *given)
        seen[-1].z.append(motion.z)
        seen[-1].raw.append([block.values.copy() for block in blocks])
        seen[-1].blocks.append(blocks)
        seen[-1].joined.append([])
        return blocks

    def keeping(*given):
        seen[-1].more.append(margins(*given))
        return seen[-1].more[-1]

    def joined(block, known):
        seen[-1].joined[-1].append(joining(block, known))
        return seen[-1].joined[-1][-1]

    def posing(hessian, cost, matrix, bound, n):
        seen[-1].posed.append((hessian.copy(), matrix, bound, cost, programme(hessian, cost, matrix, bound, n)))
        return seen[-1].posed[-1][-1]

    def solving(programme, tolerance):
        found[id(programme)] = solve(programme, tolerance)
        return found[id(programme)]

    live = Live(scenario, lead=TICK)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(steer.Steering, "_bends", bending)
        patch.setattr(steer.Caution, "margins", keeping)
        patch.setattr(Block, "joining", joined)
        patch.setattr(steer, "evaluate", evaluating)
        patch.setattr(steer, "_programme", posing)
        patch.setattr(steer.qp, "solve", solving)
        drive(live, seconds, said(told, seconds), EVERY)
    return seen, found


def test_where_a_step_led_the_rows_of_the_next_programme_are_exact(bendings):
    """Those that were near there, and those that joined: R x - b is what they are along the bend that was tried."""
    seen, found = bendings
    looked, new = 0, 0
    for tick in seen:
        if len(tick.posed) < 2:
            continue
        (_, before, *_, first), (_, after, bound, *_) = tick.posed[:2]
        masks = [block.near(steer.DEPTH) & np.ones(block.values.shape, dtype=bool) for block in tick.blocks[0]]
        value = np.concatenate([block.values[mask] for block, mask in zip(tick.blocks[1], masks, strict=True)])
        x = found[id(first)].x
        bent = np.append(np.zeros(before.shape[1] - len(x)), x)
        exact = (value <= steer.BENT) & (bound[: len(before)] > 0)
        looked += exact.sum()
        assert (before @ bent - bound[: len(before)])[exact] == pytest.approx(value[exact], abs=1e-9)
        value = np.concatenate([b.values[mask] for b, mask in zip(tick.blocks[1], tick.joined[1], strict=True)])
        reached, possible = (after @ bent - bound)[len(before) :], bound[len(before) :] > 0
        assert reached[possible] == pytest.approx(value[possible], abs=1e-9)
        new += possible.sum()
    assert looked > 100
    assert new > 100


def test_rows_of_torque_rate_that_join_change_as_differences_say(bendings):
    """With the torques of both nodes that they couple, where the step led."""
    seen, _ = bendings
    looked = 0
    for tick in seen:
        if len(tick.posed) < 2:
            continue
        steering, before, (_, after, *_) = tick.given[0], tick.posed[0][1], tick.posed[1]
        grid, problem, rows = steering.grid, steering.problem, after[len(before) :]
        sizes = [int(mask.sum()) for mask in tick.joined[1]]
        which = [block.name for block in tick.blocks[1]].index("torque rate")
        rows, (node, column) = rows[sum(sizes[:which]) :][: sizes[which]], np.nonzero(tick.joined[1][which])
        limits, bend = problem.limits.torque_rate, np.random.default_rng(3).standard_normal((grid.basis.shape[2], 7))
        sign, joint = np.where(column < 7, 1.0, -1.0), column % 7

        def rate(by, z=tick.z[1], grid=grid, problem=problem, bend=bend):
            q, dq, ddq = (z + grid.motion(by * bend, HORIZON))[:3, grid.nodes]
            torque = motion_terms(problem.model, problem.arm.tray_id, q, dq, ddq).torque
            return np.diff(torque, axis=0) / np.diff(HORIZON * grid.s[grid.nodes])[:, None]

        difference = sign * ((rate(1e-6) - rate(-1e-6)) / 2e-6 / limits)[node, joint]
        assert rows @ bend.ravel() == pytest.approx(difference, rel=1e-5, abs=1e-3)
        looked += len(node)
    assert looked > 20


def test_a_tick_asks_for_no_margin_that_there_is_not_already(bendings):
    """Rows as they are posed are what they are with what is kept from their edge, or zero: so no bend is allowed. Along
    a bend that is tried they are counted from there."""
    seen, _ = bendings
    kept = 0
    for tick in seen:
        (more,) = tick.more
        kept += max(more) > 0
        for names in tick.kept:
            assert names == [(b.name, b.margins[0] + margin) for b, margin in zip(tick.blocks[0], more, strict=True)]
        masks = [block.near(steer.DEPTH) & np.ones(block.values.shape, dtype=bool) for block in tick.blocks[0]]
        for raw, posed, margin in zip(tick.raw[0], tick.blocks[0], more, strict=True):
            assert np.abs(posed.values - np.minimum(raw + margin, 0.0)).max() < 1e-12
        value = np.concatenate([block.values[mask] for block, mask in zip(tick.blocks[0], masks, strict=True)])
        assert np.abs(tick.posed[0][2] + value).max() < 1e-12
        for then, blocks in zip(tick.raw[1:], tick.blocks[1:], strict=True):
            for raw, trial, was, posed in zip(then, blocks, tick.raw[0], tick.blocks[0], strict=True):
                assert np.abs(trial.values - raw - posed.values + was).max() < 1e-12
    assert kept


def test_the_slope_of_what_a_tick_makes_small_is_its_derivative(bendings):
    """Half of what is wanted and not had, of leaning, and of acceleration and jerk, each squared."""
    tick = bendings[0][4]
    steering, wanted, _, begins = tick.given
    grid, z, rng = steering.grid, tick.z[0], np.random.default_rng(7)
    t = begins + HORIZON * grid.s[grid.nodes]
    weight = np.array([0.5 * (t[min(k + 1, len(t) - 1)] - t[max(k - 1, 0)]) for k in range(len(t))])
    upright = steer.STRAIGHT if steering.problem.level else steer.UPRIGHT

    def cost(bend):
        _, _, ddq, dddq = bent = z + grid.motion(bend, HORIZON)
        motion = steering.sought.at(grid.s, bent, HORIZON, grid.nodes)
        parts = wanted.residuals(motion, t, weight), steer._level(motion, upright * weight)
        rough = steer.ACCELERATION * np.square(ddq).sum(axis=1) + steer.JERK * np.square(dddq).sum(axis=1)
        return 0.5 * (sum(part.weight @ part.value**2 for part in parts) + HORIZON * grid.weights @ rough)

    *_, slope, _ = tick.posed[0]
    for _ in range(3):
        bend = rng.normal(size=(grid.basis.shape[2], steering.problem.n))
        difference = (cost(1e-5 * bend) - cost(-1e-5 * bend)) / 2e-5
        assert slope @ bend.ravel() == pytest.approx(difference, rel=1e-4)  # twists are recalled to 1e-5


@pytest.mark.parametrize("off", [0.0, 0.0037])
def test_a_bend_is_sought_along_what_is_committed_from_the_hand_over_on(bendings, monkeypatch, off):
    """Also where that did not begin at a tick."""
    steering, wanted, base, begins = bendings[0][4].given
    base = replace(base, begins=base.begins - off)

    class EnoughError(Exception):
        pass

    def along(_, motion):
        raise EnoughError(motion.z)

    monkeypatch.setattr(steer, "evaluate", along)
    with pytest.raises(EnoughError) as looked:
        next(steering._bends(wanted, base, begins))
    own = begins - base.begins + HORIZON * steering.grid.s
    for mine, before in zip(looked.value.args[0], base.motion.sample(own), strict=False):
        assert np.abs(mine - before).max() < 1e-9
    assert np.any(base.motion.sample(own)[1])


def test_a_bend_is_tried_where_it_leads_and_after_a_wild_one_the_next_is_smaller(bendings):
    seen, found = bendings
    spline, tried, wild = steer.Bends(5, len(steer.BREAKS) - 1), 0, 0
    grid = steer.Grid.of(spline, spline.nodes(steer.NODES_PER_SPAN), steer.POINTS)
    for tick in seen:
        for z, (*_, programme) in zip(tick.z[1:], tick.posed, strict=False):
            n = z.shape[2]
            bend = np.vstack([np.zeros(n), found[id(programme)].x.reshape(-1, n)])
            assert np.abs(z - tick.z[0] - grid.motion(bend, HORIZON)).max() < 1e-9
            tried += 1
        for k, ((first, *_), (second, *_)) in enumerate(pairwise(tick.posed)):
            excess = max(float(block.values.max()) for block in tick.blocks[k + 1])
            least = np.linalg.eigvalsh(second - first)[0]
            assert (least > 0) == (excess > steer.WILD)
            wild += excess > steer.WILD
    assert tried > 5
    assert wild > 0


def test_a_bend_goes_to_the_verdict_when_its_trial_takes_no_more_than_half_of_what_is_kept(bottle):
    """Of the bottle, of which the scenario keeps 2 % of the weight: a tenth of that was asked for before."""
    seen, _ = bent_by(bottle, lambda t: np.array([1.2, -1.0, 0.3]) * (-1) ** int(t / 0.13), 0.6)
    enough, more = 0, 0
    for tick in seen:
        (margins,) = tick.more
        for k, blocks in enumerate(tick.blocks[1:], 1):
            kept = [block.margins[0] + margin for block, margin in zip(tick.blocks[0], margins, strict=True)]
            fine = all(
                block.values.max() <= max(steer.BENT, 0.5 * room) for block, room in zip(blocks, kept, strict=True)
            )
            assert len(tick.posed) == k if fine else len(tick.posed) > k
            worst = max(float(block.values.max()) for block in blocks)
            enough, more = enough + (fine and worst > steer.BENT), more + (not fine)
    assert enough > 0
    assert more > 0


def test_a_small_bend_is_judged_without_a_trial_until_one_would_have_told_that_it_fails(bottle):
    seen, found = bent_by(bottle, lambda t: np.array([1.2, -1.0, 0.3]) * (-1) ** int(t / 0.13), 0.6)
    spline, trusting, how = steer.Bends(5, len(steer.BREAKS) - 1), True, set()
    grid = steer.Grid.of(spline, spline.nodes(steer.NODES_PER_SPAN), steer.POINTS)
    for tick in seen:
        bend = found[id(tick.posed[0][-1])].x.reshape(-1, 7)
        small = np.abs(grid.motion(np.vstack([np.zeros(7), bend]), HORIZON)[3]).max() < steer.SMALL
        assert (tick.judged[0] == 1) == (small and trusting)
        how.add((small, trusting))
        if small and len(tick.blocks) > 1:
            trusting = len(tick.posed) == 1  # nothing was found wrong with it
    assert {(True, True), (True, False)} <= how


@pytest.mark.parametrize("way", [1.0, -1.0])
def test_the_jerk_that_a_bend_is_priced_by_is_by_how_much_that_of_the_motion_changes(cube, monkeypatch, way):
    """What is committed, less what was, differs by the bend: also a share of it, of which the jerk does not matter."""
    told, passed, tick = [], steer.Caution.passed, steer.Steering.tick

    def ticking(steering, wanted, base, begins):
        found, status = tick(steering, wanted, base, begins)
        if found is not None:
            t = HORIZON * steering.grid.s[:-1] + 1e-7
            own = begins - base.begins + t
            changed = found.motion.jerk(t) - base.motion.jerk(own) * (own < base.motion.duration)[:, None]
            whole, jerk = told[-1]
            if whole:
                compared.append((jerk, np.abs(changed).max()))
        return found, status

    compared: list = []
    monkeypatch.setattr(steer.Caution, "passed", lambda *given: told.append(given[1:]) or passed(*given))
    monkeypatch.setattr(steer.Steering, "tick", ticking)
    drive(Live(cube, lead=TICK), 0.4, said(lambda t: way * np.array([1.0, -0.5, 0.2]), 0.4), EVERY)
    assert len(compared) > 5
    for jerk, largest in compared:
        assert jerk == pytest.approx(largest, rel=1e-2)


@pytest.mark.parametrize(("jerk", "times"), [(10.0, 0.5), (1000.0, 0.9)])
def test_what_a_bend_costs_goes_down_quickly_only_while_bends_are_calm(jerk, times):
    """And never below what it costs at the least; one that passed in part only makes the next one dearer."""
    caution = steer.Caution(40.0)
    caution.passed(True, jerk)
    assert caution.weight == pytest.approx(40.0 * times)
    caution.passed(False, jerk)
    assert caution.weight == pytest.approx(60.0 * times)
    for _ in range(200):
        caution.passed(True, jerk)
    assert caution.weight == steer.LEAST_CAUTION


def test_of_two_conditions_of_one_name_neither_takes_from_the_other_what_is_kept():
    """Of one that keeps nothing from its edge, nothing more is kept; the other one's is kept all the same."""

    def block(margin):
        return Block("pace", np.zeros((3, 1)), lambda node, row: np.zeros((len(node), 28)), np.arange(3), (margin, 0.0))

    for margins, kept in (((0.0, 1e-3), [0.0, 2.4e-3]), ((1e-3, 0.0), [2.4e-3, 0.0])):
        caution = steer.Caution()
        caution.broken("pace", 2e-3)
        for _ in range(2):
            assert caution.margins([block(margin) for margin in margins]) == pytest.approx(kept)
    caution.broken("pace", 1.0)  # and of neither more than ten times a planner's margin
    assert caution.margins([block(margin) for margin in (1e-3, 1e-4)]) == pytest.approx([1e-2, 1e-3])
    assert caution.kept == pytest.approx({"pace": 1e-2})
