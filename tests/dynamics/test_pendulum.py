"""A pendulum in a body, a second kind of load dynamics: plans, stops, live motions, audits, the engine and pages."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import cumulative_trapezoid, solve_ivp
from scipy.interpolate import CubicSpline

import salver as sv
from salver.contact_margins import margins
from salver.dynamics.load_cases import LoadCase
from salver.dynamics.load_limits import LIGHTEST
from salver.dynamics.modal_motion import ModalMotion
from salver.dynamics.motion_gradients import Unknowns, wrench_by
from salver.dynamics.pendulum import PendulumResponse
from salver.errors import ScenarioError
from salver.live import Live
from salver.models.rigid_body import PAIRS, RigidBody
from salver.models.tray_motion import at_rest, frame_map, wrench_map
from salver.planning.fastest import plan_fastest
from salver.simulation.physics import Experiment, simulate_tray
from salver.trajectory import min_jerk_line
from shaken_loads import LAMP, shaken
from transport_problems import ROUGH

G, LENGTH, BOB, WIDEST = 9.81, 0.10, 0.15, np.deg2rad(15.0)


@pytest.fixture(scope="module")
def lamp(coffee):
    return coffee.with_changes(objects=[LAMP], arm={"model": "panda"}, motion__speeds="full")


@pytest.fixture(scope="module")
def body(lamp):
    return lamp.payload.first


@pytest.fixture(scope="module")
def plan(lamp):
    return plan_fastest(lamp, options=ROUGH)


def swing(body, t, w, damping=0.0, start=None):
    return ModalMotion.along((LoadCase(body, LENGTH, damping),), t, w, start)


def test_a_free_swing_has_the_frequency_of_its_length(body):
    """One that is let go 1 cm aside on a tray that stands still: cos(sqrt(g / L) t)."""
    t = np.linspace(0.0, 1.3, 261)
    w = np.tile(at_rest(), (len(t), 1))
    begun = swing(body, t, w).states.at(t, 0.0)
    let_go = replace(begun, r=begun.r + 0.01 * np.eye(2)[0])
    found = swing(body, t, w, start=let_go)
    np.testing.assert_allclose(found.r[0, :, 0, 0], 0.01 * np.cos(np.sqrt(G / LENGTH) * t), atol=1e-9)
    np.testing.assert_allclose(found.r[0, :, 0, 1], 0.0, atol=1e-12)
    # Its body feels what holds the mass at the pivot: sideways force as of m g / L, no moment about the pivot.
    pivot = body.p_EB + body.R_EB @ body.inner_origin_B(LENGTH)
    push, moment = found.wrench[0, :, :3], found.wrench[0, :, 3:] - np.cross(pivot, found.wrench[0, :, :3])
    np.testing.assert_allclose(push[:, 0], -BOB * G / LENGTH * found.r[0, :, 0, 0], atol=1e-7)
    np.testing.assert_allclose(moment, 0.0, atol=1e-9)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_one_that_is_held_aside_pulls_at_its_pivot_with_its_weight(body, sign):
    """On a tray that accelerates steadily it hangs along the force: all that the body gives it goes through the
    pivot."""
    t = np.linspace(0.0, 1.0, 11)
    w = np.tile(at_rest(), (len(t), 1))
    w[:, 0], w[:, 1] = sign * 1.5, -sign * 0.7
    found = swing(body, t, w)
    np.testing.assert_allclose(found.r[0, :, 0], np.tile([-sign * 1.5, sign * 0.7], (11, 1)) * LENGTH / G, atol=1e-12)
    pivot = body.p_EB + body.R_EB @ body.inner_origin_B(LENGTH)
    frozen = RigidBody(BOB, pivot - [0.0, 0.0, LENGTH], np.zeros((3, 3)))
    whole = w @ wrench_map(frozen.phi).T + found.wrench[0]
    np.testing.assert_allclose(whole[:, :3], BOB * w[:, :3], atol=1e-12)
    np.testing.assert_allclose(whole[:, 3:], np.cross(pivot, BOB * w[:, :3]), atol=1e-12)


def turning(t, w):
    """(T, 3) rad/s of a tray with these angular accelerations, and w with the products of it that it then feels."""
    omega = cumulative_trapezoid(w[:, 3:6], t, axis=0, initial=0.0)
    felt = w.copy()
    felt[:, 6:] = np.stack([omega[:, i] * omega[:, j] for i, j in PAIRS], axis=1)
    return omega, felt


def rod(body, t, w, omega):
    """Places (T, 3) of the mass from the pivot, by the nonlinear equations in the body's frame."""
    to_pivot = frame_map(body.p_EB + body.R_EB @ body.inner_origin_B(LENGTH), body.R_EB)
    along = CubicSpline(t, np.hstack([(w @ to_pivot.T)[:, :6], omega]))

    def rates(now, state):
        (p, v), (f, alpha, turn) = state.reshape(2, 3), along(now).reshape(3, 3)
        free = -f - np.cross(alpha, p) - np.cross(turn, np.cross(turn, p)) - 2 * np.cross(turn, v)
        way = p / LENGTH
        return np.concatenate([v, free - way * (way @ free + v @ v / LENGTH)])

    begin = [0.0, 0.0, -LENGTH, 0.0, 0.0, 0.0]
    return solve_ivp(rates, (t[0], t[-1]), begin, method="DOP853", rtol=1e-8, atol=1e-10, t_eval=t).y.T[:, :3]


@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize("yaw", [0.0, 9.0], ids=["straight", "turning"])
def test_the_mode_is_the_nonlinear_pendulum_to_first_order(body, sign, yaw):
    """On a tray that tilts and turns about its vertical, in the body's own axes: at half of what pushes it aside it is
    off by less than half as much."""
    t = np.linspace(0.0, 1.2, 241)
    off = []
    for size in (0.3 * sign, 0.15 * sign):
        w = np.tile(at_rest(), (len(t), 1))
        w[:, [0, 1, 3, 4]] = size * shaken(t)[:, [0, 1, 3, 4]]
        w[:, 5] = yaw * np.sin(2 * np.pi * t / t[-1])
        omega, felt = turning(t, w)
        exact = rod(body, t, felt, omega)[:, :2]
        assert np.abs(exact).max() > 0.003
        off.append(np.abs(swing(body, t, felt).seen[0, :, :2] - exact).max() / np.abs(exact).max())
    assert off[0] < 0.03
    assert off[1] < 0.5 * off[0] or off[1] < 2e-3


def test_derivatives_agree_with_differences(body):
    """Of its limits and its reaction, by ways in which the motion may change."""
    t, rng = np.linspace(0, 0.9, 101), np.random.default_rng(4)
    w, s = shaken(t), t / t[-1]
    move = rng.normal(size=(12, 3)) * np.sin(np.pi * s)[:, None, None] ** 2
    both = tuple(LoadCase(body, length, damping) for length, damping in ((0.1, 0.0), (0.09, 0.02)))
    case, node, weight, step = np.arange(8) % 2, np.linspace(20, 100, 8).astype(int), rng.normal(size=(8, 6)), 1e-6
    here, unknowns = ModalMotion.along(both, t, w), Unknowns(move)

    def moved(sign, k):
        return ModalMotion.along(both, t, w + sign * step * move[:, :, k])

    by = wrench_by(here, unknowns, case, node, weight)
    parts = PendulumResponse.of(here).limits()
    for k in range(3):
        more, less = moved(1, k), moved(-1, k)
        difference = (weight * (more.wrench - less.wrench)[case, node]).sum(axis=1) / (2 * step)
        np.testing.assert_allclose(by[:, k], difference, atol=1e-5 * np.abs(difference).max())
        pairs = zip(parts, PendulumResponse.of(more).limits(), PendulumResponse.of(less).limits(), strict=True)
        for limit, up, down in pairs:
            at = (case, node) if limit.values.shape[1] > 1 else (case, 0)
            slope = (up.values - down.values)[at] / (2 * step)
            found = limit.by(case, node, unknowns)[:, k]
            np.testing.assert_allclose(found, slope, atol=2e-4 * np.abs(slope).max() + 1e-9, err_msg=limit.name)


def test_what_it_must_keep_is_its_room_and_its_weight(body):
    t = np.linspace(0.0, 1.0, 101)
    w = np.tile(at_rest(), (len(t), 1))
    w[30:, 0] = 1.2  # at once: it swings to twice of what it hangs at
    part = PendulumResponse.of(swing(body, t, w))
    light, far, left = part.limits()
    assert light.most[0] == LIGHTEST
    hung = LENGTH * 1.2 / G
    assert far.values.max() == pytest.approx(2 * hung, rel=0.03)
    assert far.most[0] == pytest.approx(LENGTH * np.sin(WIDEST))
    assert left.values[0, 0] == pytest.approx(2 * hung, rel=0.03)  # aside, and as much around that


def test_its_verdict_names_what_is_exceeded_and_when_first(body):
    """Pushed at 0.3 s so that it swings to 31 of 25.9 mm: beyond its room from where it passes that."""
    t = np.linspace(0.0, 1.0, 201)
    w = np.tile(at_rest(), (len(t), 1))
    w[60:, 0] = 1.5
    gentle = np.where(np.arange(12) < 1, 0.5, 1.0) * w
    part, other = PendulumResponse.of(swing(body, t, w)), PendulumResponse.of(swing(body, t, gentle))
    found = PendulumResponse.verdict("lamp", (other, part))
    np.testing.assert_allclose(found.size, part.modes.height[0])
    assert found.room == pytest.approx(LENGTH * np.sin(WIDEST) - part.modes.height.max())
    assert found.slack.min() == pytest.approx(1 - part.modes.height.max() / (LENGTH * np.sin(WIDEST)), abs=1e-3)
    assert min(found.kept, key=found.kept.get) == "the room there is"
    said, first = found.status("at its longest "), t[np.argmax(part.modes.height[0] > LENGTH * np.sin(WIDEST))]
    assert (said.ok, said.code) == (False, "swings")
    assert said.details["time"] == pytest.approx(first)
    assert said.sentence.startswith("The pendulum in lamp at its longest exceeds the room there is by 1")
    assert said.sentence.endswith(f"the first time at {first:.3f} s.")
    kept = PendulumResponse.verdict("lamp", (other,)).status()
    assert (kept.ok, kept.code) == (True, "holds")
    assert kept.details["left"] == pytest.approx(other.limits()[1].left(201).min(), abs=0.01)


def test_what_a_recording_leaves_open_is_added_to_its_swing_and_to_what_is_left(body):
    t = np.linspace(0.0, 1.0, 101)
    part = PendulumResponse.of(swing(body, t, np.tile(at_rest(), (len(t), 1))))
    away = np.linspace(0.0, 4e-3, 101)[None, :, None, None] * np.ones((1, 101, 1, 2))
    _, far, left = part.unsure(away, np.zeros((1, 101, 1))).limits()
    np.testing.assert_allclose(far.values[0], away[0, :, 0, 0], atol=1e-12)
    assert left.values[0, 0] == pytest.approx(4e-3)


def test_what_is_uncertain_of_the_motion_is_added_to_its_swing(body):
    """Two pushes of unknown sign, of which each lasts: as far as it swings with both."""
    t = np.linspace(0.0, 1.0, 201)
    w, dw = np.tile(at_rest(), (len(t), 1)), np.zeros((1, len(t), 12, 2))
    w[40:, 0] = 0.4
    dw[0, 60:, 0, 0], dw[0, 90:, 0, 1] = 0.2, -0.3
    planned = swing(body, t, w)
    part = PendulumResponse.compliant(planned, planned, np.zeros(0), dw)
    each = [swing(body, t, w + a * dw[0, :, :, 0] + b * dw[0, :, :, 1]) for a in (-1, 1) for b in (-1, 1)]
    furthest = np.max([other.height[0] for other in each], axis=0)
    np.testing.assert_allclose(part.modes.height[0] + part.higher[0], furthest, atol=2e-4)
    left = np.max([np.hypot(*other.ending).max() for other in each])
    assert left <= np.hypot(*planned.ending).max() + part.more_left[0] < 1.2 * left


def test_its_mass_is_drawn_on_its_rod_within_its_ring(body):
    places = np.array([[0.02, 0.0], [0.0, -0.01], [0.0, 0.0]])
    drawn, pivot = body.inner.drawn(body, LENGTH, places, 0.3), body.inner_origin_B(LENGTH)
    for k, place in enumerate(places):
        corners = drawn.triangles_B(k)
        middle = corners.reshape(-1, 3).mean(axis=0)
        np.testing.assert_allclose((middle - pivot)[:2], place, atol=1e-12)
        assert np.linalg.norm(middle - pivot) == pytest.approx(LENGTH)
        np.testing.assert_allclose(np.linalg.norm(corners - middle, axis=2), 0.1 * LENGTH)
        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        assert np.all(np.sum(normals * (corners.mean(axis=1) - middle), axis=1) > 0)  # outwards
    ring = drawn.edge_B - pivot
    np.testing.assert_allclose(np.linalg.norm(ring[:, :2], axis=1), LENGTH * np.sin(WIDEST))
    assert ring[:, 2] == pytest.approx(-np.sqrt(LENGTH**2 - 0.02**2))
    assert drawn.edge_colour(0.2) != drawn.edge_colour(0.3)
    page = drawn.page(np.array([1]))
    np.testing.assert_allclose(page["triangles"] + page["moves"][0], drawn.triangles_B(1))


def test_at_rest_it_hangs_along_gravity(body):
    """On a tray that leans by 10 degrees: L sin(10 deg) aside, downhill."""
    lean = np.tan(np.deg2rad(10.0)) * np.array([[0.6, -0.8]])
    place = body.inner.at_rest(LENGTH, lean)
    np.testing.assert_allclose(place, -LENGTH * np.sin(np.deg2rad(10.0)) * np.array([[0.6, -0.8]]), atol=1e-12)
    assert body.inner.away(LENGTH, place, lean) == pytest.approx(0.0, abs=1e-12)
    assert body.inner.away(LENGTH, np.zeros((1, 2)), lean) == pytest.approx(LENGTH * np.sin(np.deg2rad(10.0)))


def test_a_tray_that_leans_further_than_it_may_swing_is_refused(lamp):
    with pytest.raises(ScenarioError, match=r"moves the pendulum in lamp by .* mm even at rest"):
        lamp.with_changes(motion__goal__rpy_deg=[17.0, 0.0, 0.0])


@pytest.mark.parametrize(("size", "yaw"), [(1.0, 70.0), pytest.param(-1.0, 0.0, marks=pytest.mark.slow)])
def test_the_engine_swings_as_plans_say(lamp, size, yaw):
    """A rod on two hinges in the engine, the body standing turned on the tray or not: 2 % of the largest swing."""
    still = {**LAMP, "uncertainty": {}, "friction": 3.0, "yaw_deg": yaw}
    scenario = lamp.with_changes(objects=[still], arm=None)
    start = np.array(scenario.motion.start.position)
    turn = scenario.payload.first.R_EB
    line = min_jerk_line(0.8, start, start + size * np.array([0.06, -0.045, 0.02]), turn, turn)
    record = simulate_tray(line, scenario)
    assert max(record.summary["objects"][0][key] for key in ("peak_slip", "peak_lift")) < 1e-4
    found, moving = margins(scenario, line.sample(np.linspace(0, 0.8, 201))), (record.t >= 0) & (record.t <= 0.8)
    told = found.loads.nominal["lamp"][0].modes.seen[0, :, :2]
    told = np.stack([np.interp(record.t[moving], found.t, x) for x in told.T], axis=1)
    seen, largest = record.surface[moving, 0, :2], np.abs(told).max(axis=0)
    assert largest.min() > 2e-3
    np.testing.assert_array_less(np.abs(seen - told).max(axis=0), 0.02 * largest)


@pytest.mark.slow
def test_a_plan_holds_in_the_engine_and_one_that_takes_it_for_a_solid_does_not(lamp, plan):
    """At the ends of its ranges; the same motion is too much for it where its mass is taken as fixed."""
    assert plan.ok
    assert plan.margins.load_verdicts(True)[0].slack.min() > 0
    for values in ({"length": 0.102, "damping": 0.0}, {"length": 0.098, "damping": 0.02}):
        run = Experiment(plan).run(values)
        assert run.outcome == "holds"
        assert 0.5 < run.summary["objects"][0]["peak_swing"] / run.summary["objects"][0]["room"] < 1.0
    solid = {key: LAMP[key] for key in ("name", "shape", "friction")}
    fixed = lamp.payload.first.inertial
    solid |= {"mass": fixed.mass, "com": [0, 0, float(lamp.payload.first.com_G[2])], "uncertainty": {"friction": "5%"}}
    rigid = plan_fastest(lamp.with_changes(objects=[solid]), options=ROUGH)
    assert rigid.ok
    assert rigid.duration < plan.duration
    told = replace(plan, joint=rigid.joint, reference=rigid.reference)
    assert Experiment(told).run({}).outcome in ("swings", "slides", "tips")


@pytest.mark.slow
def test_a_cup_of_coffee_and_a_lamp_are_carried_together(coffee):
    """Two kinds side by side: each keeps its own limits, and the engine holds both at the ends of their ranges."""
    cup = coffee.objects[0].model_dump(exclude_unset=True) | {"at": [-0.045, 0.0]}
    both = coffee.with_changes(
        objects=[cup, {**LAMP, "at": [0.05, 0.0]}], arm={"model": "panda"}, motion__speeds="full"
    )
    found = plan_fastest(both, options=ROUGH)
    assert found.ok, found.verification.sentence
    told = found.margins.verdict(True).sentence
    assert "The liquid in cup stays" in told
    assert "The pendulum in lamp keeps" in told
    run = Experiment(found).run({"cup.fill": 0.065, "lamp.length": 0.102})
    cup_seen, lamp_seen = run.summary["objects"]
    assert run.outcome == "holds"
    assert 0.5 < cup_seen["peak_wave"] / cup_seen["room"] < 1.0
    assert 0.5 < lamp_seen["peak_swing"] / lamp_seen["room"] < 1.0


@pytest.mark.slow
def test_live_motions_go_on_with_its_swing(lamp):
    live = Live(lamp, lead=0.3)
    for k in range(500):
        if k % 50 == 0:
            live.twist([0.15, 0.1, 0.0], [0.0, 0.0, 0.2])
        live.command(1e-3 * k)
        if k % 50 == 0:
            live.plan(60.0)
    base = live.committed
    assert base.motion.duration > 0.1
    now = base.begins + 0.5 * base.motion.duration
    state = base.left(now, live.problem).past.begun(live.problem.every_case).planned
    assert np.abs(state.rate).max() > 1e-3  # m/s
    with pytest.raises(ScenarioError, match="the pendulum in lamp"):
        replace(live.problem, past=None).check_still("a motion that goes on from another")


@pytest.mark.slow
def test_an_audit_says_when_it_strikes(lamp, plan):
    """On a tray that holds it by any friction: a little quicker it goes beyond its room, and says so."""
    t = np.arange(-0.3, plan.duration + 0.3, 2e-3)
    columns = {f"q_panda_joint{j}": x for j, x in enumerate(plan.joint.sample(np.clip(t, 0, plan.duration))[0].T, 1)}
    sticky = lamp.with_changes(objects=[{**LAMP, "friction": 3.0}])
    quick, planned = (sv.audit({"t": factor * t, **columns}, sticky) for factor in (0.95, 1.0))
    assert quick.nominal.sentence.startswith("The pendulum in lamp exceeds the room there is by")
    assert quick.nominal.code == "swings"
    assert planned.worst.code == "holds"
    assert "The pendulum in lamp keeps" in planned.worst.sentence


@pytest.mark.parametrize(
    ("pendulum", "words"),
    [
        ({"pivot": 0.2}, "is only 0.16 m high"),
        ({"length": 0.145}, "at most its pivot"),
        ({"widest_deg": 28.0, "length": 0.13}, "it leaves lamp"),
        ({"damping": [0.1, 0.0]}, "give the smaller share of critical first"),
    ],
)
def test_what_cannot_be_is_told_in_one_sentence(lamp, pendulum, words):
    with pytest.raises(ScenarioError, match=words):
        lamp.with_changes(objects=[{**LAMP, "pendulum": {**LAMP["pendulum"], **pendulum}}])


@pytest.mark.slow
def test_page_and_film_show_it(lamp, plan, tmp_path):
    from salver.reports.pages.replay import inside
    from salver.simulation.record import drawn_inside
    from salver.simulation.scene.loads import true_world

    run = Experiment(plan).run({})
    (drawn,) = drawn_inside(true_world(lamp).loads, run.surface, run.summary)
    page = inside(drawn, np.arange(3))
    assert len(page["triangles"]) == 8
    assert drawn.triangles_B(0).shape == (8, 3, 3)
    away = drawn.places - lamp.payload.first.inner_origin_B(LENGTH)
    np.testing.assert_allclose(np.linalg.norm(away, axis=1), LENGTH, atol=1e-9)
