"""A hand or a policy in command of a live motion: followed as nearly as safety allows, and never further."""

import re

import numpy as np
import pytest

from live_runs import EVERY, LEAD, drive, in_turn, jolts, rows_of, said
from salver.geometry import exp, log
from salver.live import Live
from salver.live.replanning.objective import TwistWanted
from salver.live.replanning.steer import TICK
from salver.live.replanning.wishes import stream_wish


def check(live, states):
    worst = rows_of(live.problem, states)
    assert max(worst.values()) <= 0.0, worst
    assert jolts(states)[0] < 1e-5  # rad; see live_runs
    assert not np.any(states[1][-1])


def velocities(live, states, every):
    """(K, 3) of the tray in S."""
    found = []
    for q, dq in zip(states[0][::every], states[1][::every], strict=True):
        _, R_SE = live.problem.arm.tray_pose(q)
        found.append(R_SE @ (live.problem.arm.body_jacobian(q) @ dq)[:3])
    return np.array(found)


@pytest.mark.slow
def test_a_gentle_hand_is_followed_as_if_nothing_stood_between(cube):
    def gentle(t):
        return 0.15 * np.array([np.sin(2 * t), 1 - np.cos(3 * t), 0.3 * np.sin(t)])

    live = Live(cube, lead=TICK)
    states = drive(live, 0.6, said(gentle, 0.6), EVERY)
    wanted = np.array([gentle(t) for t in np.arange(0.2, 0.6, 0.01)])
    error = velocities(live, states, 10)[20:] - wanted
    assert np.sqrt(np.mean(error**2)) < 0.03 * np.sqrt(np.mean(wanted**2))
    check(live, in_turn(states, drive(live, 0.9, every=None, begins=0.6)))


def test_how_a_hand_changes_is_told_from_what_it_said_last():
    """A kink is known two samples later; a slow stream has the slope from the last one; after silence there is none."""

    def slope(times, velocity):
        said = [(t, np.append(velocity(t), np.zeros(3))) for t in times]
        return stream_wish(said[:-1], said[-1][1], times[-1], TwistWanted).wanted.slope[:3]

    def kinked(t):
        return np.array([max(t, 0.0), 0.2, -2 * t])

    assert np.allclose(slope(np.arange(-0.1, 0.0, 0.01), kinked), [0, 0, -2])
    assert np.allclose(slope(np.arange(-0.1, 0.021, 0.01), kinked), [1, 0, -2])
    assert np.allclose(slope(np.array([0.1, 0.15]), kinked), [1, 0, -2])
    assert not slope(np.array([0.0, 0.07]), kinked).any()
    assert not slope(np.array([0.1, 0.101]), kinked).any()  # too near to one another to say anything


def test_a_hand_is_followed_from_the_first_ticks_on(cube):
    """A tenth of a second after it has stopped pulling harder, while what is committed has long been a bent motion."""

    def pull(t):
        return 0.1 * np.array([1.0, -0.5, 0.2]) * min(t / 0.1, 1.0)

    live = Live(cube, lead=TICK)
    states = drive(live, 0.24, said(pull, 0.24), EVERY)
    error = velocities(live, states, 10)[22:] - pull(1.0)
    assert np.abs(error).max() < 0.01  # m/s


def test_a_hand_may_speak_in_the_frame_of_the_tray(cube):
    """Which the last joint has turned by 52 degrees: forwards there is not forwards in the world."""

    def pull(t):
        return 0.1 * np.array([1.0, -0.5, 0.2]) * min(t / 0.1, 1.0)

    turned = Live(cube).committed.motion.q[0] + np.array([0, 0, 0, 0, 0, 0, 0.9])
    live = Live(cube, turned, lead=TICK)
    wishes = [(t, lambda live, t=t: live.twist(pull(t), frame="tray")) for t in np.arange(0.0, 0.24, 0.01)]
    states = drive(live, 0.24, wishes, EVERY)
    _, R_SE = live.problem.arm.tray_pose(states[0][-1])
    assert np.abs(R_SE - np.eye(3)).max() > 0.5
    assert np.abs(velocities(live, states, 10)[22:] @ R_SE - pull(1.0)).max() < 0.01  # m/s


@pytest.mark.parametrize("factor", [1.0, 0.5])
def test_joints_are_jogged_and_come_to_rest_in_silence(cube, factor):
    """About the vertical, which keeps the tray level; an override slows it."""
    live = Live(cube, lead=TICK)
    live.override(factor)
    rates = np.array([0.2, 0, 0, 0, 0, 0, 0])
    wishes = [(t, lambda live, t=t: live.jog(min(t / 0.1, 1.0) * rates)) for t in np.arange(0.0, 0.26, 0.01)]
    states = drive(live, 0.26, wishes, EVERY)
    assert np.abs(states[1][240:] - factor * rates).max() < 0.02
    assert [str(x) for x in live.state.requests] == ["Request 1 (joint velocities): followed."]
    check(live, in_turn(states, drive(live, 0.9, every=None, begins=0.26)))


@pytest.mark.slow
def test_what_will_limit_the_motion_is_named_before_it_slows(cube):
    """A hand that pulls the tray outwards until the arm is nearly stretched, where the elbow turns ever faster."""
    live, heard = Live(cube, lead=TICK), []

    def pull(t):
        live.twist([0.2 * min(t / 0.3, 1.0), 0.0, 0.0])
        heard.append(live.state)

    states = drive(live, 0.9, [(t, lambda _, t=t: pull(t)) for t in np.arange(0.0, 0.9, 0.02)], EVERY)
    speed = velocities(live, states, EVERY)[:, 0]
    assert speed[20:30].min() > 0.19  # what is asked for
    assert speed[-1] < 0.18
    elbow = [k for k, state in enumerate(heard) if state.nearest == "limited by velocity of panda_joint4"]
    assert 20 < elbow[0] < np.flatnonzero(speed[20:] < 0.19)[0] + 20
    before = heard[15]
    assert re.fullmatch(r"\d+ % from its nearest limit, clearance of panda_link5 from panda_link7", before.nearest)
    assert str(before) == f"It is following, {before.nearest}."


@pytest.mark.slow
def test_a_hostile_hand_and_then_silence(cube):
    """Reversals that would lose the cube if they were followed; then nothing, and the arm comes to rest."""

    def hostile(t):
        return np.array([0.8, 1.2, 0.4]) * np.sign(np.sin(2 * np.pi * 2.7 * t))

    live = Live(cube, lead=TICK)
    states = drive(live, 0.5, said(hostile, 0.5), EVERY)
    assert np.abs(velocities(live, states, 10)).max() > 0.1
    check(live, in_turn(states, drive(live, 1.4, every=EVERY, begins=0.5)))
    assert live.idle


@pytest.mark.slow
def test_a_chunk_of_postures_is_followed_and_its_last_one_held(cube):
    live = Live(cube, lead=TICK)
    start = live.problem.start.q
    turn = np.eye(7)[6]
    times = np.linspace(0.1, 0.4, 3)
    assert live.chunk(times, joints=start + 0.1 * np.linspace(0, 1, 3)[:, None] * turn).ok
    states = drive(live, 1.6, every=EVERY)
    check(live, states)
    assert np.abs(states[0][-1] - start - 0.1 * turn).max() < 0.02
    assert live.idle


@pytest.mark.slow
def test_what_a_chunk_asked_too_much_of_is_reached_after_it(cube):
    live = Live(cube, lead=TICK)
    first = live.problem.items[0]
    goal = live.problem.arm.object_pose(live.problem.start.q, first.p_EB, first.R_EB)[0] + [0.0, 0.3, 0.0]
    assert live.chunk([0.1], [goal]).sentence == "Accepted."
    states = drive(live, 2.2, every=EVERY)
    check(live, states)
    assert np.abs(live.problem.arm.object_pose(states[0][-1], first.p_EB, first.R_EB)[0] - goal).max() < 1e-6
    assert live.idle


@pytest.mark.slow
def test_contact_lasts_while_the_arm_settles_where_the_tray_leans(bottle):
    """A chunk through the arm's base ends early, the tray leaning at the edge of contact: what the arm strays by then
    dies away, and by that contact broke by .0033 of the weight within .12 s."""
    live = Live(bottle, lead=LEAD)
    first = live.problem.items[0]
    here = live.problem.arm.object_pose(live.problem.start.q, first.p_EB, first.R_EB)[0]
    way = here + np.linspace(0, 1, 20)[:, None] * ([0.0, 0.0, 0.2] - here)
    states = drive(live, 1.6, [(0.1, lambda live: live.chunk(np.linspace(0, 1, 20), way))], EVERY)
    worst = rows_of(live.problem, states)
    assert max(worst.values()) <= 0.0, worst


def test_a_chunk_says_what_of_its_end_cannot_be(cube):
    live = Live(cube, lead=TICK)
    first = live.problem.items[0]
    here = live.problem.arm.object_pose(live.problem.start.q, first.p_EB, first.R_EB)[0]
    leaning = exp([[0.0, 0.0, 0.0], [0.0, 0.3, 0.0]])
    said = live.chunk([0.0, 0.1], (np.tile(here, (2, 1)), leaning)).sentence
    assert re.search(
        r"^Accepted, but for its end: the goal leans the tray by 17.2 deg; it may lean by 0.0573 deg\.$", said
    )
    assert live.chunk([0.0], [(3.0, 0.0, 0.5)]).ok
    drive(live, 1.2, every=EVERY)
    assert "no posture of the arm within its limits reaches it" in live.refused


@pytest.mark.slow
def test_between_its_poses_a_chunk_turns_evenly(cube):
    """A turn by 0.4 rad about the vertical within a second, told by its two ends."""
    live = Live(cube, lead=TICK)
    first = live.problem.items[0]
    here, R = live.problem.arm.object_pose(live.problem.start.q, first.p_EB, first.R_EB)
    live.chunk([0.0, 1.0], (np.tile(here, (2, 1)), np.stack([R, exp([0.0, 0.0, 0.4]) @ R])))
    states = drive(live, 0.9, every=EVERY)
    turned = np.array([log(live.problem.arm.tray_pose(q)[1] @ first.R_EB @ R.T)[2] for q in states[0][300:800:50]])
    assert np.abs(turned - 0.4 * states.t[300:800:50]).max() < 0.02


@pytest.mark.slow
def test_twists_are_followed_however_long_before_it_is_done_planning_begins(cube):
    """0.1 s of silence is counted when planning begins, not when it is done: where ticks take longer nothing moved."""
    live = Live(cube, lead=0.15)
    states = drive(live, 0.6, said(lambda t: np.array([0.0, 0.1, 0.0]), 0.6), EVERY)
    assert velocities(live, states, EVERY)[-5:, 1] == pytest.approx(0.1, abs=0.01)
    check(live, in_turn(states, drive(live, 1.3, every=EVERY, begins=0.6)))


def test_what_cannot_be_followed_is_refused_in_a_sentence(cube):
    live = Live(cube, lead=TICK)
    for wish, sentence in (
        (lambda: live.twist((np.nan, 0, 0)), "v has values that are not finite"),
        (lambda: live.twist((300.0, 0, 0)), "v is 300; it must be at most 5 m/s"),
        (lambda: live.twist((0, 0, 0), (0, 0, 90.0)), "omega is 90; it must be at most 20 rad/s"),
        (lambda: live.twist((0.1, 0, 0), frame="tool"), "frame is 'tool'; it must be world or tray"),
        (lambda: live.jog((0.1, 0, 0)), r"dq has shape \(3,\); it must be \(7,\)"),
        (
            lambda: live.jog(np.rad2deg([0, 0, 0, 0.5, 0, 0, 0])),
            "dq of panda_joint4 is 28.6; it must be at most 20 rad/s",
        ),
        (lambda: live.jog([0, -28.6, 0, 0, 0, 0, 0]), "dq of panda_joint2 is -28.6; it must be at most 20 rad/s"),
        (lambda: live.twist((0, 0)), r"v has shape \(2,\)"),
        (lambda: live.chunk([0.2, 0.1], joints=np.zeros((2, 7))), "each later than the one before"),
        (lambda: live.chunk([0.1, 0.2], joints=np.zeros((3, 7))), r"joints has shape \(3, 7\)"),
        (lambda: live.chunk([0.1], joints=np.full((1, 7), 9.0)), "panda_joint1 would be at 9 in posture 0"),
        (lambda: live.chunk([0.1]), "a chunk is of poses or of joints"),
        (lambda: live.chunk("soon", joints=np.zeros((1, 7))), "times"),
        (lambda: live.chunk([0.0], [(500.0, 0.0, 400.0)]), "a position is 500 m away in S; it must be at most 100 m"),
    ):
        status = wish()
        assert not status.ok
        assert re.search(sentence, status.sentence), status.sentence
    assert live.idle


@pytest.mark.slow
def test_a_hand_that_becomes_gentle_is_followed_soon_after(cube):
    """What was learnt of wild steps is forgotten within .2 s of calm: 1 cm/s and less is left of what is wanted."""
    live = Live(cube, lead=TICK)

    def told(t):
        return np.array([1.2, -1.0, 0.3]) * (-1) ** int(t / 0.13) if t < 0.65 else np.array([0.0, 0.1, 0.0])

    states = drive(live, 1.3, said(told, 1.3), EVERY)
    arm = live.problem.arm
    late = range(1150, 1300, 10)
    twists = [arm.body_jacobian(q) @ dq for q, dq in ((states[0][k], states[1][k]) for k in late)]
    speeds = [arm.tray_pose(states[0][k])[1] @ v[:3] for k, v in zip(late, twists, strict=True)]
    assert np.abs(np.array(speeds) - [0.0, 0.1, 0.0]).max() < 0.01


@pytest.mark.slow
def test_a_level_tray_that_leaned_in_a_trial_is_steered_on(cube):
    """An overshoot by more than the tolerance of level, 0.06 deg, tightened it until no step was left, for ever."""
    live, begins = Live(cube, lead=TICK), 0.0
    for v, omega, seconds in (
        ((0.0, 0.1, 0.0), (0.0, 0.0, -1.5), 0.4),
        ((0.0, -0.03, 0.0), np.zeros(3), 0.4),
        ((1.5, 0.0, 0.0), np.zeros(3), 0.6),
        ((0.0, 0.1, 0.0), np.zeros(3), 0.6),
        ((-0.1, 0.0, 0.0), np.zeros(3), 0.6),
    ):
        times = np.arange(0.0, seconds, TICK)
        drive(live, seconds, [(t, lambda live, v=v, w=omega: live.twist(v, w)) for t in times], EVERY, begins=begins)
        begins += seconds
    assert live.state.granted > 0.95


def test_the_state_says_what_share_of_a_twist_is_executed_and_why_no_more(cube):
    live = Live(cube, lead=TICK)
    assert live.state.granted == 1.0  # nothing is requested
    asked = np.array([2.5, 1.0, 0.0])  # faster than the load allows so soon
    states = drive(live, 0.2, said(lambda t: asked, 0.2), EVERY)
    state, v = live.state, velocities(live, states, 1)[-1]
    assert state.granted == pytest.approx(v @ asked / (asked @ asked), abs=1e-6)
    assert 0.05 < state.granted < 0.9
    assert state.withheld.startswith(f"{100 * state.granted:.0f} % of the requested velocity: ")
    assert state.withheld in str(state)
    live.hold()
    drive(live, 0.6, [(t, lambda live: live.twist(asked)) for t in np.arange(0.0, 0.6, 0.01)], EVERY, begins=0.2)
    assert live.state.granted == 0.0
    assert live.state.withheld == "0 % of the requested velocity: Held by the operator."
    live.release()
    drive(live, 0.3, [(t, lambda live: live.twist(0.05 * asked)) for t in np.arange(0.0, 0.3, 0.01)], EVERY, begins=0.8)
    live.stop()
    drive(live, 0.08, every=EVERY, begins=1.1)
    assert live.state.granted == 1.0  # a stop drops what was requested


def test_the_share_of_joint_velocities_is_theirs(cube):
    live, rates = Live(cube, lead=TICK), np.array([0.2, 0.0, 0.0, 0.0, 0.0, 0.0, -0.1])  # level
    states = drive(live, 0.5, [(t, lambda live: live.jog(rates)) for t in np.arange(0.0, 0.5, 0.01)], EVERY)
    assert live.state.granted == pytest.approx(min(1.0, states.dq[-1] @ rates / (rates @ rates)), abs=1e-6)
    assert live.state.granted > 0.95
