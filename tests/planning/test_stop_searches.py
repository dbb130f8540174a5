"""Where a search for a stop begins, the curves on which it looks, and which stop is taken when."""

from dataclasses import replace
from itertools import product
from types import SimpleNamespace

import numpy as np
import pytest

import salver as sv
from salver.errors import SalverError
from salver.planning import stops
from salver.planning.fastest import Anywhere, AtPosture, transport_problem
from salver.planning.stop_library import StopLibrary
from salver.planning.stops import (
    LEAST,
    SPLINE,
    STORED,
    FoundStop,
    _braking,
    _fitted,
    _going_on,
    plan_stops,
    stop_from,
    stop_problem,
)
from salver.planning.trajopt.constraints.obstacles import CLEARANCE
from salver.planning.trajopt.curves import FreeCurve, Grid
from salver.planning.trajopt.spline import RestSpline
from salver.trajectory import JointMotion

PAPER = sv.load_scenario("panda-cube")


def swaying(duration):
    """A motion of seven joints from rest to rest."""
    t = np.linspace(0, duration, 201)
    u, size = (t / duration)[:, None], np.linspace(-0.3, 0.5, 7)
    rates = (u**3 * (10 - 15 * u + 6 * u**2), 30 * u**2 * (1 - u) ** 2, 60 * u * (1 - u) * (1 - 2 * u))
    return JointMotion(t, *(x * size / duration**k for k, x in enumerate(rates)))


def test_a_search_for_a_stop_may_begin_with_going_on_a_while():
    """What is ahead begins where the plan is then: together they are the rest of the plan itself, from time 0."""
    whole, now, begin = swaying(1.4), 0.33, 0.77
    tail = whole.t[whole.t >= begin - 1e-9]
    begin = float(tail[0])
    ahead = JointMotion(tail, *whole.sample(tail))
    guess = _going_on(whole, now, begin, ahead)
    assert guess.t[0] == 0.0
    assert guess.duration == pytest.approx(1.4 - now, abs=1e-12)
    beside = _going_on(whole, float(whole.t[47]) + 1e-12, begin, ahead)  # of two instants that differ by rounding one
    assert min(np.diff(guess.t).min(), np.diff(beside.t).min()) > 1e-3
    t = np.linspace(0, 1.4 - now, 57)
    for found, true in zip(guess.sample(t), whole.sample(now + t), strict=True):
        np.testing.assert_allclose(found, true, atol=1e-6)


def test_a_search_for_a_stop_begins_with_the_very_motion_that_it_is_given():
    """One that its splines can do from the state in which the arm is, to posture and acceleration."""
    problem = transport_problem(PAPER)
    rng = np.random.default_rng(3)
    state = AtPosture(problem.start_posture, *rng.normal(size=(2, 7)))
    problem = replace(problem, start=state, goal=Anywhere())
    s, true = np.linspace(0, 1, 121), state.q + rng.normal(scale=0.1, size=(SPLINE.size, 7))
    true[0] = state.q
    z = FreeCurve(problem, Grid.of(SPLINE, s)).motion(true, 0.8)
    assert z[1, 0] == pytest.approx(state.rates[0])
    np.testing.assert_allclose(_fitted(problem, JointMotion(0.8 * s, *z[:3]), 0.8), true, atol=1e-8)


def test_a_search_without_a_guess_begins_with_every_joint_braking_along_a_smooth_step():
    """By hand: from v the joint turns at v (1 - 3 s^2 + 2 s^3), and goes half as far as it would at v."""
    problem = transport_problem(PAPER)
    v, s = np.linspace(-1.0, 2.0, 7), np.linspace(0, 1, 21)
    state = AtPosture(problem.start_posture, v, np.zeros(7))
    curve = FreeCurve(replace(problem, start=state, goal=Anywhere()), Grid.of(SPLINE, s))
    z = curve.motion(_braking(SPLINE, state, 0.6).coefficients, 0.6)
    np.testing.assert_allclose(z[0, -1], state.q + 0.3 * v, atol=1e-6)
    np.testing.assert_allclose(z[1], np.outer(1 - 3 * s**2 + 2 * s**3, v), atol=0.02)


def test_what_is_moved_is_the_plan_until_the_stop_begins_and_then_the_stop():
    plan, stop = swaying(1.0), swaying(0.2)
    state = np.array([stop.q, stop.dq, stop.ddq])[:, None]
    library = StopLibrary(plan.t[[80]], np.array([0.2]), stop.t / 0.2, *state, np.zeros((2, 7)), 1.0)
    moved = library.stopped(plan, 0.3)
    assert moved.duration == pytest.approx(plan.t[80] + 0.2)
    assert np.all(np.diff(moved.t) > 0)
    t = np.array([0.1, 0.33, 0.39])
    for found, true in zip(moved.sample(t), plan.sample(t), strict=True):
        np.testing.assert_allclose(found, true, atol=1e-9)
    for found, true in zip(moved.sample(plan.t[80] + stop.t), stop.sample(stop.t), strict=True):
        np.testing.assert_allclose(found, true, atol=1e-9)
    assert library.stopped(plan, 0.5) is plan


def test_the_longest_stop_is_asked_for_just_after_an_instant_from_which_one_begins():
    """Of stops at 0.1, 0.2 and 0.5 s that take 0.3, 0.25 and 0.1 s, in a plan of 1 s: by hand."""
    none = np.zeros((3, 2, 7))
    library = StopLibrary(
        np.array([0.1, 0.2, 0.5]), np.array([0.3, 0.25, 0.1]), np.array([0.0, 1.0]), none, none, none, none[:, 0], 1.0
    )
    assert [library.course(now).stop for now in (0.05, 0.1, 0.15, 0.3, 0.5, 0.6)] == [0, 0, 1, 2, 2, None]
    assert library.longest == pytest.approx(0.5, abs=1e-6)  # after 0.5 s it can only be finished
    assert library.finishing == pytest.approx(0.5, abs=1e-6)
    assert replace(library, end=0.8).longest == pytest.approx(0.4, abs=1e-6)  # from 0.2 s on, to 0.6 s


def test_the_stop_that_is_sooner_at_rest_is_taken_though_it_begins_later():
    none = np.zeros((2, 2, 7))
    ends = np.array([0.0, 1.0])
    library = StopLibrary(np.array([0.1, 0.2]), np.array([0.4, 0.05]), ends, none, none, none, none[:, 0], 1.0)
    assert [library.course(now).stop for now in (0.05, 0.15, 0.25)] == [1, 1, None]
    assert "from 0.20 s on only by finishing, within 0.80 s." in library.sentence
    always = replace(library, t=np.array([0.1, 1.0 - 1e-12]), duration=np.array([0.4, 0.0]))
    assert "finishing" not in always.sentence


def test_stops_are_planned_backwards_each_to_be_at_rest_before_what_is_ahead(monkeypatch):
    """Of a motion of 1 s, every tenth of a second, with the durations that are found here: those that are no sooner at
    rest than going on are left out, and so is one by less than is worth it."""
    found = {0.9: 0.2, 0.8: 0.1, 0.7: None, 0.6: 0.3 - 0.5 * LEAST, 0.5: 0.39, 0.4: 0.5, 0.3: 0.1, 0.2: 0.3, 0.1: 0.25}
    asked, told = [], []

    def stop(now, most):
        asked.append((now, most))
        duration = found[round(now, 6)]
        rest = JointMotion(np.linspace(0, duration or 1.0, STORED.size), *np.zeros((3, STORED.size, 7)))
        return None if duration is None else FoundStop(rest, np.zeros(7))

    whole = swaying(1.0)
    nowhere = SimpleNamespace(n=7, cases=())
    monkeypatch.setattr(stops, "along", lambda problem, motion, space: (np.linspace(0, 1, 11), None, None))
    monkeypatch.setattr(stops, "stop_from", lambda problem, state, begun, now, beat: stop(now, beat + LEAST))
    monkeypatch.setattr(stops, "_going_on", lambda motion, now, begin, ahead: now)
    monkeypatch.setattr(stops, "_late", lambda problem, state: np.inf)  # none is sought from another beginning
    progress, soon = (lambda *done: told.append(done)), 0.0  # none is too late to be worth it
    library = plan_stops(nowhere, whole, 0.1, progress=progress, soon=soon)
    assert told == [(100 * k, 1000) for k in range(2, 11)]
    assert [now for now, _ in asked] == pytest.approx(np.arange(9, 0, -1) / 10)
    # Until 0.8 s nothing is sooner than the end; then each has to be at rest before the one that was kept.
    rests = [1.0, 1.0, 0.9, 0.9, 0.9, 0.89, 0.89, 0.4, 0.4]
    assert [now + most for now, most in asked] == pytest.approx(rests)
    assert library.t == pytest.approx([0.1, 0.3, 0.5, 0.8])
    assert library.duration == pytest.approx([0.25, 0.1, 0.39, 0.1])
    states = whole.t, whole.q, whole.dq, whole.ddq
    for part, joint in product((slice(0, 100), slice(100, 201)), ([0], [6])):  # which turn backwards and forwards
        moving = JointMotion(whole.t[part] - whole.t[part][0], *(x[part][:, joint] for x in states[1:]))
        with pytest.raises(SalverError, match="begins or ends moving"):
            plan_stops(nowhere, moving, 0.1)


def test_where_a_stop_is_late_it_is_sought_anew_and_instants_are_half_as_far_apart(monkeypatch):
    """Of a motion of 1 s with stops of .3 s, from .7 s on backwards the next tenth of a second would be .4 s before
    there is rest, and halfway there it is .35 s: late, or not. What is sought anew in vain is found as elsewhere."""
    anew = []

    def stop(duration):
        return FoundStop(
            JointMotion(np.linspace(0, duration, STORED.size), *np.zeros((3, STORED.size, 7))), np.zeros(7)
        )

    def otherwise(problem, state, begun, beat):
        anew.append(beat + LEAST)
        return stop(0.3) if finds else None

    nowhere = SimpleNamespace(n=7, cases=())
    monkeypatch.setattr(stops, "along", lambda problem, motion, space: (np.linspace(0, 1, 11), None, None))
    monkeypatch.setattr(stops, "stop_from", lambda *state, beat, **begin: stop(0.3) if beat > 0.3 else None)
    monkeypatch.setattr(stops, "_anew", otherwise)
    finds = True
    for late, apart, last in ((0.36, 0.05, 0.65), (0.34, 0.05, 0.65), (0.5, 0.1, 0.6)):
        told, anew[:] = [], []
        monkeypatch.setattr(stops, "_late", lambda problem, state, late=late: late)
        library = plan_stops(nowhere, swaying(1.0), 0.1, progress=lambda *done: told.append(done))  # noqa: B023
        assert library.t == pytest.approx(np.arange(apart, last + 1e-9, apart))
        assert library.duration == pytest.approx(0.3)
        assert anew == pytest.approx([0.35] * 13 if late == 0.34 else [])  # at every instant from .65 s on
        done = [200, 300, *range(350, 1001, 50)] if apart == 0.05 else range(200, 1001, 100)
        assert told == [(ms, 1000) for ms in done]
    finds, anew[:] = False, []
    monkeypatch.setattr(stops, "_late", lambda problem, state: 0.0)
    library = plan_stops(nowhere, swaying(1.0), 0.1)
    assert library.t == pytest.approx(np.arange(0.05, 0.66, 0.05))
    assert len(anew) > len(library.t)


def test_no_stop_is_sought_where_going_on_is_at_rest_soon_anyway(monkeypatch):
    """Of a motion of 1 s with stops of 25 ms, every 40 ms: from .88 s the end is .12 s ahead; the rest after that stop
    is at .905 s, 65 ms after .84 s and .105 s after .80 s; and so on."""
    asked = []

    def stop(problem, state, begun, guess, beat):
        asked.append(beat)
        return FoundStop(JointMotion(np.linspace(0, 0.025, STORED.size), *np.zeros((3, STORED.size, 7))), np.zeros(7))

    nowhere = SimpleNamespace(n=7, cases=())
    radius = np.full((11, 7), 0.01)
    radius[5] = 0.02  # rad by which the arm may be off the motion at .5 s
    strayed = SimpleNamespace(joint_radius=lambda order: radius, state_at=lambda t, now: None)
    monkeypatch.setattr(stops, "along", lambda problem, motion, space: (np.linspace(0, 1, 11), None, strayed))
    monkeypatch.setattr(stops, "stop_from", stop)
    monkeypatch.setattr(stops, "_late", lambda problem, state: np.inf)
    told = []
    library = plan_stops(nowhere, swaying(1.0), 0.04, progress=lambda *done: told.append(done))
    assert library.t == pytest.approx(np.arange(0.08, 0.9, 0.08))
    assert library.stray[:, 0] == pytest.approx([*np.where(library.t < 0.5, 0.01, 0.02), 0.02])
    assert len(asked) == len(library.t)
    assert told == [(40 * k, 1000) for k in range(2, 26)]


def test_a_stop_may_lean_as_far_as_its_plan_does_and_need_not_pass_its_poses():
    """A wrist that leans by 5 degrees on the way, where the scenario keeps its tray level."""
    level = PAPER.with_changes(motion__orientation="fixed")
    case = level.with_changes(motion__through=[{"position": [0.45, 0.0, 0.5]}])
    problem = transport_problem(level)
    t = np.linspace(0, 1, 41)
    q = problem.start_posture + np.outer(np.sin(np.pi * t) ** 2, np.deg2rad(5) * np.eye(7)[5])
    plan = SimpleNamespace(joint=JointMotion(t, q, 0 * q, 0 * q), scenario=case)
    found = stop_problem(plan)
    assert found.max_tilt == pytest.approx(1.01 * np.deg2rad(5), rel=1e-3)
    assert not found.through


def test_a_stop_may_pass_as_close_as_its_plan_does():
    """A ball 2 mm over the cube of 4 cm where the plan begins: half of that is kept."""
    over = np.add(PAPER.motion.start.position, [0.0, 0.0, 0.02 + 2e-3 + 0.05])
    case = PAPER.with_changes(obstacles=[{"name": "ball", "type": "sphere", "radius": 0.05, "position": over.tolist()}])
    q = np.tile(transport_problem(PAPER).start_posture, (2, 1))
    plan = SimpleNamespace(joint=JointMotion(np.array([0.0, 1.0]), q, 0 * q, 0 * q), scenario=case)
    least, *others = np.sort(stop_problem(plan).keep_out.required)
    assert least == pytest.approx(1e-3, rel=0.05)
    assert min(others) == CLEARANCE.safety


def test_a_motion_that_begins_moving_has_the_derivatives_that_differences_give():
    """Of free joints, from any speed and acceleration: by every coefficient and by the duration."""
    problem, spline, rng = transport_problem(PAPER), RestSpline(degree=5, spans=4), np.random.default_rng(6)
    state = AtPosture(problem.start_posture, *rng.normal(size=(2, 7)))
    curve = FreeCurve(replace(problem, start=state, goal=Anywhere()), Grid.of(spline, np.linspace(0, 1, 9)))
    coefficients, step = state.q + 0.1 * rng.normal(size=(spline.size, 7)), 1e-6
    z, direction = curve.motion(coefficients, 0.7), rng.normal(size=coefficients.shape)
    assert np.allclose(z[:3, 0], [coefficients[0], *state.rates])
    ahead, behind = (curve.motion(coefficients, 0.7 * np.exp(sign * step)) for sign in (1, -1))
    by_duration = curve.by_duration(coefficients, 0.7, z)
    assert np.allclose(by_duration, (ahead - behind) / (2 * step), rtol=1e-5, atol=1e-7 * np.abs(by_duration).max())
    ahead, behind = (curve.motion(coefficients + sign * step * direction, 0.7) for sign in (1, -1))
    parts = rng.normal(size=(9, 4, 7))
    found = curve.columns(coefficients, 0.7, parts, np.arange(9)) @ direction.ravel()
    expected = np.einsum("pkn,kpn->p", parts, (ahead - behind) / (2 * step))
    assert np.allclose(found, expected, rtol=1e-5, atol=1e-7 * np.abs(expected).max())


def test_a_stop_of_a_moving_arm_begins_with_its_speed_and_is_told_to_its_end():
    """What is told of speeds is how the joints move, from where they are to rest."""
    problem = replace(transport_problem(PAPER), keep_out=None)
    dq = 0.1 * np.array([1.0, -1.0, 1.0, 0.0, 1.0, 0.0, 1.0])
    motion = stop_from(problem, AtPosture(problem.start_posture, dq, 0.0 * dq)).motion
    assert motion.t[-1] == motion.duration
    np.testing.assert_allclose(motion.t / motion.duration, STORED, atol=1e-12)
    np.testing.assert_allclose(motion.dq[[0, -1]], [dq, 0.0 * dq], atol=1e-9)
    np.testing.assert_allclose(motion.ddq[[0, -1]], 0.0, atol=1e-9)
    step = np.diff(motion.t)[:, None]  # Hermite's rule, exact to the fourth order
    gone = step / 2 * (motion.dq[1:] + motion.dq[:-1]) - step**2 / 12 * np.diff(motion.ddq, axis=0)
    np.testing.assert_allclose(np.diff(motion.q, axis=0), gone, atol=1e-6)


def test_stops_come_back_from_files_with_the_end_of_their_plan(tmp_path):
    """From an instant whose stop would take longer than the plan, finishing it is the soonest rest."""
    plan = sv.plan(PAPER)
    moved = swaying(plan.duration)
    instants, s = np.array([0.4, 0.8]), np.array([0.0, 1.0])
    begun = np.stack([np.stack([x, x], axis=1) for x in moved.sample(instants)])
    library = StopLibrary(instants, np.array([0.3, 9.0]), s, *begun, np.zeros((3, 7)), plan.duration)
    replace(plan, joint=moved, stops=library).save(tmp_path)
    again = sv.load_plan(tmp_path).stops
    for now in (0.1, 0.5, 0.9):
        assert again.course(now) == library.course(now)
    assert again.course(0.5).rests == again.end == plan.duration
