"""How the committed motion is changed at a tick: its programmes, which constraints they have, and step control."""

from dataclasses import dataclass, field, replace
from itertools import pairwise
from types import SimpleNamespace

import numpy as np
import pytest

from live_runs import EVERY, drive, said
from salver.live import Live, Moving
from salver.live.live import EVADE
from salver.live.replanning import steer
from salver.live.replanning.objective import ChunkWanted, TwistWanted, Weights, level
from salver.live.replanning.replan import Sought
from salver.live.replanning.steer import STANDARD, TICK, Steering, StepControl
from salver.planning.fastest import Block
from salver.planning.trajopt.constraints.constraints import ContactConstraint
from salver.sensitivity.arm.terms import motion_terms
from salver.trajectory import JointMotion

HORIZON = STANDARD.horizon


@pytest.mark.parametrize("seconds", [0.1, 0.3, 0.9])
def test_an_increment_is_added_to_what_is_committed_from_the_hand_over_on(cube, seconds):
    """One that has ended before, one that ends before the increment does and one that goes on: at the end it rests."""
    problem, rng = Live(cube).problem, np.random.default_rng(6)
    steering, size = Steering.of(problem, problem, STANDARD, Weights()), (4, problem.n)
    q, dq, ddq = rng.normal(size=(3, *size))
    dq[-1] = ddq[-1] = 0.0
    base = SimpleNamespace(begins=3.0, motion=JointMotion(seconds * np.array([0.0, 0.3, 0.4, 1.0]), q, dq, ddq))
    increment = rng.normal(size=(steering.grid.basis.shape[2], problem.n))
    t = np.linspace(0.0, 0.999 * HORIZON, 200)
    added = steering.spline.matrices(t / HORIZON)[:3] @ increment / HORIZON ** np.arange(3.0)[:, None, None]
    for times in (0.0, 1.0, -2.0):
        found = steering.changed(base, 3.17, times * increment)
        assert found.duration == pytest.approx(max(seconds - 0.17, HORIZON))
        for mine, before, more in zip(found.sample(t), base.motion.sample(0.17 + t), added, strict=True):
            assert mine == pytest.approx(before + times * more, rel=1e-9, abs=1e-7)
        assert not np.any([found.dq[-1], found.ddq[-1]])


def test_a_change_is_evaluated_as_the_motion_that_it_is_but_for_its_moving_start(cube):
    problem, s = Live(cube).problem, np.linspace(0, 1, 21)
    z = np.zeros((4, len(s), problem.n))
    z[0] = problem.start.q + 0.2 * (s - np.sin(2 * np.pi * s) / (2 * np.pi))[:, None]
    z[2] = 0.8 * np.pi / 1.3**2 * np.sin(2 * np.pi * s)[:, None] * np.arange(1.0, 8.0)
    known, sought = (each.at(s, z, 1.3) for each in (problem, Sought.of(problem)))
    (rows,) = problem.contacts
    assert sought.moving
    one, other = (next(ContactConstraint(rows, 0.0).blocks(motion)).values for motion in (known, sought))
    assert np.array_equal(one, other)


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
        found = wanted.residuals(problem.at(s, z, 0.1), t, weight, Weights())
        for order in (0, 1):
            for joint in range(n):
                step = np.zeros_like(z)
                step[order, :, joint] = 1e-6
                up, down = (
                    wanted.residuals(problem.at(s, z + sign * step, 0.1), t, weight, Weights()) for sign in (1, -1)
                )
                difference = (up.value - down.value) / 2e-6
                near = pose is wanted and order == 0
                # The turn's derivative is that at the wanted rotation: exact where it is met.
                kept = np.tile(np.arange(6) < 3, 4) if near else np.ones(24, dtype=bool)
                assert np.abs(difference - found.parts[:, order, joint])[kept].max() < 1e-6


@dataclass
class Tick:
    """What was seen of one tick: along which motions (4, P, n) which constraints were evaluated, as they were and as
    they then stood, which joined, by what they were tightened, and the programmes."""

    given: tuple  # by whom, what is wanted, what is committed, from when on
    z: list = field(default_factory=list)
    raw: list = field(default_factory=list)
    blocks: list = field(default_factory=list)
    joined: list = field(default_factory=list)
    tightened: list = field(default_factory=list)
    posed: list = field(default_factory=list)
    damping: list = field(default_factory=list)


@pytest.fixture(scope="module")
def ticks(cube):
    """Of a hand that pulls harder than the load allows."""
    return ticks_of(cube, lambda t: np.array([1.5, -1.5, 0.5]), 0.2)


def ticks_of(scenario, told, seconds):
    """The ticks of a hand, and what each programme answered."""
    seen, found = [], {}
    increment, evaluate, programme, solve = Steering._increment, steer.evaluate, steer._programme, steer.qp.solve
    margin, joining = StepControl.margin, Block.joining

    def seeking(*given):
        seen.append(Tick(given))
        return increment(*given)

    def evaluating(constraints, motion, *given):
        blocks = evaluate(constraints, motion, *given)
        seen[-1].z.append(motion.z)
        seen[-1].raw.append([block.values.copy() for block in blocks])
        seen[-1].blocks.append(blocks)
        seen[-1].joined.append([])
        return blocks

    def tightening(*given):
        seen[-1].tightened.append(margin(*given))
        return seen[-1].tightened[-1]

    def joined(block, known):
        seen[-1].joined[-1].append(joining(block, known))
        return seen[-1].joined[-1][-1]

    def posing(hessian, cost, matrix, bound, n):
        seen[-1].posed.append((hessian.copy(), matrix, bound, cost, programme(hessian, cost, matrix, bound, n)))
        seen[-1].damping.append(seen[-1].given[0].control.damping)
        return seen[-1].posed[-1][-1]

    def solving(programme, tolerance):
        found[id(programme)] = solve(programme, tolerance)
        return found[id(programme)]

    live = Live(scenario, lead=TICK)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Steering, "_increment", seeking)
        patch.setattr(StepControl, "margin", tightening)
        patch.setattr(Block, "joining", joined)
        patch.setattr(steer, "evaluate", evaluating)
        patch.setattr(steer, "_programme", posing)
        patch.setattr(steer.qp, "solve", solving)
        drive(live, seconds, said(told, seconds), EVERY)
    return seen, found


def in_first(tick):
    """The constraints of the first programme."""
    return [block.near(STANDARD.depth) & np.ones(block.values.shape, dtype=bool) for block in tick.blocks[0]]


def test_where_a_step_led_the_rows_of_the_next_programme_are_exact(ticks):
    """Those that were near there, and those that joined: R x - b is what they are along the increment tried."""
    seen, found = ticks
    looked, new = 0, 0
    for tick in seen:
        if len(tick.posed) < 2:
            continue
        (_, before, *_, first), (_, after, bound, *_) = tick.posed[:2]
        value = np.concatenate([b.values[mask] for b, mask in zip(tick.blocks[1], in_first(tick), strict=True)])
        x = found[id(first)].x
        increment = np.append(np.zeros(before.shape[1] - len(x)), x)
        exact = (value <= 0.0) & (bound[: len(before)] > 0)
        looked += exact.sum()
        assert (before @ increment - bound[: len(before)])[exact] == pytest.approx(value[exact], abs=1e-9)
        value = np.concatenate([b.values[mask] for b, mask in zip(tick.blocks[1], tick.joined[1], strict=True)])
        reached, possible = (after @ increment - bound)[len(before) :], bound[len(before) :] > 0
        assert reached[possible] == pytest.approx(value[possible], abs=1e-9)
        new += possible.sum()
    assert looked > 100
    assert new > 100


def test_rows_of_torque_rate_that_join_change_as_differences_say(ticks):
    """With the torques of both nodes that they couple, where the step led."""
    seen, _ = ticks
    looked = 0
    for tick in seen:
        if len(tick.posed) < 2:
            continue
        steering, before, (_, after, *_) = tick.given[0], tick.posed[0][1], tick.posed[1]
        grid, problem, rows = steering.grid, steering.problem, after[len(before) :]
        sizes = [int(mask.sum()) for mask in tick.joined[1]]
        which = [block.name for block in tick.blocks[1]].index("torque rate")
        rows, (node, column) = rows[sum(sizes[:which]) :][: sizes[which]], np.nonzero(tick.joined[1][which])
        limits, increment = (
            problem.limits.torque_rate,
            np.random.default_rng(3).standard_normal((grid.basis.shape[2], 7)),
        )
        sign, joint = np.where(column < 7, 1.0, -1.0), column % 7

        def rate(by, z=tick.z[1], grid=grid, problem=problem, increment=increment):
            q, dq, ddq = (z + grid.motion(by * increment, HORIZON))[:3, grid.nodes]
            torque = motion_terms(problem.model, problem.arm.tray_id, q, dq, ddq).torque
            return np.diff(torque, axis=0) / np.diff(HORIZON * grid.s[grid.nodes])[:, None]

        difference = sign * ((rate(1e-6) - rate(-1e-6)) / 2e-6 / limits)[node, joint]
        assert rows @ increment.ravel() == pytest.approx(difference, rel=1e-5, abs=1e-3)
        looked += len(node)
    assert looked > 20


def test_a_tick_asks_for_no_margin_that_there_is_not_already(ticks):
    """Constraints as they are posed are what they are when tightened, or zero: so a zero increment is allowed. Along
    one that is tried they are counted from there."""
    seen, _ = ticks
    tightened = 0
    for tick in seen:
        tightened += max(tick.tightened) > 0
        for raw, posed, margin in zip(tick.raw[0], tick.blocks[0], tick.tightened, strict=True):
            assert np.abs(posed.values - np.minimum(raw + margin, 0.0)).max() < 1e-12
        value = np.concatenate([block.values[mask] for block, mask in zip(tick.blocks[0], in_first(tick), strict=True)])
        assert np.abs(tick.posed[0][2] + value).max() < 1e-12
        for then, blocks in zip(tick.raw[1:], tick.blocks[1:], strict=True):
            for raw, trial, was, posed in zip(then, blocks, tick.raw[0], tick.blocks[0], strict=True):
                assert np.abs(trial.values - raw - posed.values + was).max() < 1e-12
    assert tightened


@pytest.mark.parametrize("orientation", ["free", "fixed"])
def test_the_gradient_of_the_objective_is_its_derivative(cube, orientation):
    """Half of the weighed squares of what is wanted and not had, of the tray's lean and of jerk."""
    live = Live(cube.with_changes(motion__orientation=orientation), lead=TICK)
    drive(live, 0.1, said(lambda t: np.array([0.5, -0.3, 0.1]), 0.1), EVERY)
    steering, base, rng = live._planner._steering, live.committed, np.random.default_rng(7)
    begins = base.begins + 2 * TICK
    wanted = TwistWanted(np.array([0.3, 0.2, 0.1, 0.1, 0.0, 0.2]), np.zeros(6), begins)
    motion, grid, weights = steering._along(base, begins), steering.grid, steering.weights
    t = begins + HORIZON * grid.s[grid.nodes]
    dt = np.array([0.5 * (t[min(k + 1, len(t) - 1)] - t[max(k - 1, 0)]) for k in range(len(t))])

    def cost(increment):
        changed = steering.sought.at(grid.s, motion.z + grid.motion(increment, HORIZON), HORIZON, grid.nodes)
        parts = [wanted.residuals(changed, t, dt, weights)]
        parts += [level(changed, (weights.level if orientation == "fixed" else weights.upright) * dt)]
        rough = weights.jerk * np.square(changed.z[3]).sum(axis=1)
        return 0.5 * (sum(part.weight @ part.value**2 for part in parts) + HORIZON * grid.weights @ rough)

    _, gradient = steering._objective(wanted, motion, begins)
    for _ in range(3):
        increment = rng.normal(size=(grid.basis.shape[2], steering.problem.n))
        difference = (cost(1e-5 * increment) - cost(-1e-5 * increment)) / 2e-5
        assert gradient @ increment.ravel() == pytest.approx(difference, rel=1e-4)  # twists are recalled to 1e-5


@pytest.mark.parametrize("off", [0.0, 0.0037])
def test_an_increment_is_sought_along_what_is_committed_from_the_hand_over_on(ticks, off):
    """Also where that did not begin at a tick."""
    steering, _, base, begins = ticks[0][4].given
    base = replace(base, begins=base.begins - off)
    own = begins - base.begins + HORIZON * steering.grid.s
    for mine, before in zip(steering._along(base, begins).z, base.motion.sample(own), strict=False):
        assert np.abs(mine - before).max() < 1e-9
    assert np.any(base.motion.sample(own)[1])


def test_an_increment_is_tried_where_it_leads_and_damped_by_what_it_violates(ticks):
    seen, found = ticks
    tried, violated = 0, 0
    for tick in seen:
        grid, norm = tick.given[0].grid, tick.given[0].norm
        for z, (*_, programme) in zip(tick.z[1:], tick.posed, strict=False):
            n = z.shape[2]
            increment = np.vstack([np.zeros(n), found[id(programme)].x.reshape(-1, n)])
            assert np.abs(z - tick.z[0] - grid.motion(increment, HORIZON)).max() < 1e-9
            tried += 1
        for k, ((first, *_), (second, *_)) in enumerate(pairwise(tick.posed)):
            excess = max(0.0, *(float(block.values.max()) for block in tick.blocks[k + 1]))
            more = (second - first) / tick.damping[k]
            assert np.abs(more - excess * norm).max() < 1e-9 * norm.max()
            assert tick.damping[k + 1] == pytest.approx((1.0 + excess) * tick.damping[k])
            violated += excess > 0.3
    assert tried > 5
    assert violated > 0


@pytest.mark.slow
def test_an_increment_goes_to_the_verdict_when_its_trial_takes_no_more_than_half_of_what_is_kept(bottle):
    """Of the bottle, of which the scenario keeps 2 % of the weight."""
    seen, _ = ticks_of(bottle, lambda t: np.array([1.2, -1.0, 0.3]) * (-1) ** int(t / 0.13), 0.6)
    enough, more = 0, 0
    for tick in seen:
        for k, blocks in enumerate(tick.blocks[1:], 1):
            room = [block.margins[0] + margin for block, margin in zip(tick.blocks[0], tick.tightened, strict=True)]
            fine = all(b.values.max() <= max(STANDARD.tolerance, 0.5 * x) for b, x in zip(blocks, room, strict=True))
            assert len(tick.posed) == k if fine else len(tick.posed) > k
            worst = max(float(block.values.max()) for block in blocks)
            enough, more = enough + (fine and worst > 0.0), more + (not fine)
    assert enough > 0
    assert more > 0


def test_an_increment_that_is_refused_is_shortened_and_the_next_one_more_damped_and_kept_away(cube, monkeypatch):
    live = Live(cube, lead=TICK)
    steering, judged, verdict, what = live._planner._steering, [], Steering._judged, "acceleration of panda_joint1"

    def refusing(self, base, begins, increment):
        judged.append((increment, self.control.damping))
        return replace(verdict(self, base, begins, increment), committed=None, what=what, excess=0.1)

    monkeypatch.setattr(Steering, "_judged", refusing)
    found, status = steering.tick(TwistWanted(0.1 * np.eye(6)[0], np.zeros(6), TICK), live.committed, TICK)
    assert found is None
    assert status.code == "refused"
    (whole, before), (shortened, after) = judged
    assert shortened == pytest.approx(0.5 * whole)
    assert steering.control.damping == after == pytest.approx(2.0 * before)
    assert steering.control.tightened == pytest.approx({what: 0.1})


def test_what_is_learnt_is_forgotten_while_increments_pass():
    def block(name, room=1.0):
        values = np.array([[-0.5], [-room], [-0.1]])
        return Block(name, values, lambda node, row: np.zeros((len(node), 28)), np.arange(3))

    control = StepControl(STANDARD, 40.0)
    control.refused("acceleration of panda_joint1", 0.2)
    assert control.margin(block("acceleration", room=0.0)) == pytest.approx(0.5 * STANDARD.depth)  # some room is left
    assert control.margin(block("acceleration")) == pytest.approx(0.2)
    assert control.margin(block("acceler")) == control.margin(block("jerk")) == 0.0
    control.passed()
    assert control.damping == pytest.approx(0.8 * 80.0)
    assert control.margin(block("acceleration")) == pytest.approx(0.97 * 0.2)
    for _ in range(200):
        control.passed()
    assert control.damping == STANDARD.least_damping
    for _ in range(200):
        control.refused("jerk", 0.0)
    assert control.damping == STANDARD.most_damping


def test_a_gentle_hand_is_followed_soon_after_an_increment_that_went_far_beyond(cube):
    live = Live(cube, lead=TICK)
    live._planner._steering.control.refused("contact of cube", 5.0)
    told = drive(live, 0.4, said(lambda t: np.array([0.1, 0.1, 0.0]), 0.4), EVERY)
    _, R_SE = live.problem.arm.tray_pose(told.q[-1])
    v_S = R_SE @ (live.problem.arm.body_jacobian(told.q[-1]) @ told.dq[-1])[:3]
    assert v_S == pytest.approx([0.1, 0.1, 0.0], abs=0.02)


def test_an_evasion_whose_programmes_are_not_solved_is_given_up(cube, monkeypatch):
    """So that what was requested is planned for."""
    live = Live(cube, lead=TICK)
    live.command(0.0)
    p_S = live.problem.arm.tray_pose(live.committed.motion.q[0])[0]
    live.obstacles([Moving("ball", "sphere", np.add(p_S, [1.0, 0.0, 0.1]), (-1.0, 0.0, 0.0), radius=0.05, lasts=3.0)])
    live.goto(q=live.committed.motion.q[0])
    monkeypatch.setattr(steer.qp, "solve", lambda *about: None)
    for _ in range(60):
        live.plan()
    assert live._resigned[0] is live._running
    assert live._due() is not EVADE
