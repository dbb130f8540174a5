"""The liquid in a container: modes, waves along a motion and their derivatives, what a scenario may ask."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.sparse import diags, identity, kron
from scipy.sparse.linalg import spsolve

import salver as sv
import salver.sensitivity.waves as waves_module
from potential_flow import box, cylinder, rectangle, simulate
from salver.errors import ScenarioError
from salver.models.liquid import Liquid, damping_of
from salver.models.tray_motion import at_rest
from salver.planning.fastest.brim import Brim
from salver.planning.fastest.problem import transport_problem, with_missed_cases
from salver.sensitivity.sloshing import LIGHTEST, Slosh
from salver.sensitivity.spills import Liquids, Spill, slacks
from salver.sensitivity.underway import Underway
from salver.sensitivity.wave_cases import VERDICT_APART, Case, Cases, cases
from salver.sensitivity.wave_changes import changed
from salver.sensitivity.wave_gradients import Unknowns, wrench_by
from salver.sensitivity.waves import Waves, along
from salver.simulation import outcome

CUP = Liquid((0.04,), 0.005, 0.06, 0.075, 1000.0, (0.0, 0.03))
BOX_IN = {"kind": "water", "size": [0.09, 0.06], "fill": 0.05, "brim": 0.08}
BOX = {"objects__0__shape": {"type": "box", "size": [0.1, 0.07, 0.085]}, "objects__0__liquid": BOX_IN}


@pytest.fixture(scope="module")
def coffee():
    return sv.load_scenario("panda-coffee")


def shaken(t: np.ndarray, yaw: float = 25.0) -> np.ndarray:
    """What a tray feels that lifts, tilts and turns, from rest to rest."""
    s = t / t[-1]
    w = np.tile(at_rest(), (len(t), 1))
    w[:, 0], w[:, 1] = 3 * np.sin(2 * np.pi * s), 1.5 * np.sin(3 * np.pi * s) ** 3
    w[:, 2] += 2 * np.sin(9 * t) * np.sin(np.pi * s) ** 2
    w[:, 3], w[:, 4], w[:, 5] = 4 * np.sin(2 * np.pi * s), -5 * np.sin(4 * np.pi * s), yaw * np.sin(2 * np.pi * s)
    w[:, 6] = np.sin(np.pi * s) ** 2
    w[:, 8] = 0.3 * w[:, 6]
    return w


def test_modes_of_a_cup_are_those_of_the_literature():
    modes = CUP.modes(0.06)
    # f_11 = sqrt(1.8412 g / R tanh(1.8412 h / R)) / 2 pi: by hand for R = 40, h = 60 mm.
    by_hand = np.sqrt(1.8411838 * 9.81 / 0.04 * np.tanh(1.8411838 * 1.5)) / (2 * np.pi)
    np.testing.assert_allclose(modes.omega[0, 0] / (2 * np.pi), by_hand, rtol=1e-6)
    total = 1000 * np.pi * 0.04**2 * 0.06
    np.testing.assert_allclose(
        modes.mass[0, 0] / total, 2 * np.tanh(1.8411838 * 1.5) / (1.8411838 * 1.5 * 2.3899577), rtol=1e-6
    )
    assert modes.frozen.mass == pytest.approx(total)


@pytest.mark.parametrize("round_", [True, False], ids=["cup", "box"])
def test_under_a_lid_the_liquid_turns_as_laplace_says(round_):
    """Kinetic energy of liquid in a closed container turned at 1 rad/s about its centre, by finite volumes.

    In a cylinder phi = u(r, z) cos(theta); in a box u(x, z), r standing for x.
    """
    liquid = CUP if round_ else Liquid((0.09, 0.06), 0.005, 0.05, 0.08, 1000.0, (0.0, 0.0))
    R, h, n = float(liquid.half[0]), liquid.fill, 90
    dr, dz = R / n, h / n
    r, z = (np.arange(n) + 0.5) * dr, (np.arange(n) + 0.5) * dz - h / 2
    weight, edge = (r, np.arange(n + 1) * dr) if round_ else (np.ones(n), np.ones(n + 1))
    across = diags([edge[1:-1], -edge[1:] - edge[:-1], edge[1:-1]], [-1, 0, 1]).tolil()
    across[-1, -1] += edge[-1]  # no flux but what the wall pushes
    across[0, 0] -= edge[0]  # odd about the middle
    along = diags([np.ones(n - 1), np.r_[-1, -2 * np.ones(n - 2), -1], np.ones(n - 1)], [-1, 0, 1])
    own = diags(-1 / r if round_ else np.zeros(n))
    laplace = kron(across / dr**2 + own, identity(n)) + kron(diags(weight), along / dz**2)
    pushed = np.zeros((n, n))  # velocity of the walls: (z, -x)
    pushed[-1] += edge[-1] * z / dr
    pushed[:, -1] += weight * -r / dz
    pushed[:, 0] -= weight * -r / dz
    phi = spsolve(laplace.tocsc(), -pushed.ravel()).reshape(n, n)
    at_wall = phi[-1] + 0.5 * dr * z
    top, bottom = phi[:, -1] - 0.5 * dz * r, phi[:, 0] + 0.5 * dz * r
    energy = edge[-1] * at_wall @ z * dz + weight * (top - bottom) @ -r * dr
    per_volume = energy / (R**2 * h if round_ else R * h)  # over the circle as cos^2: half of it; over x: both halves
    frozen = liquid.modes(h).frozen
    assert frozen.inertia_com[1, 1] / frozen.mass == pytest.approx(per_volume, rel=5e-3)


@pytest.mark.parametrize("fill", [0.03, 0.06])
def test_moving_masses_and_the_rest_weigh_what_the_liquid_weighs(fill):
    modes = CUP.modes(fill)
    frozen, still, mass, z = modes.frozen, modes.still, modes.mass[:, 0], modes.height[:, 0]
    assert still.mass + mass.sum() == pytest.approx(frozen.mass)
    assert still.mass * still.com_B[2] + mass @ z == pytest.approx(frozen.mass * frozen.com_B[2])
    about = still.inertia_com[0, 0] + still.mass * still.com_B[2] ** 2 + mass @ z**2
    assert about == pytest.approx(frozen.inertia_com[0, 0] + frozen.mass * frozen.com_B[2] ** 2)


def test_a_surface_at_rest_is_level_however_the_tray_is_pushed(coffee):
    """Constant specific force, long enough for waves to die: eta = -R f / f_z, and the liquid's weight hangs aside."""
    case = Case(coffee.payload.first, 0.05, 0.1)
    t = np.linspace(0, 12, 4001)
    w = np.tile(at_rest(), (len(t), 1))
    w[:, 0] = 2 * np.minimum(t / 2, 1) ** 2 * (3 - 2 * np.minimum(t / 2, 1))
    waves = along((case,), t, w)
    np.testing.assert_allclose(waves.eta[0, -1], [-0.04 * 2 / 9.81, 0], atol=1e-7)
    np.testing.assert_allclose(waves.free[0, -1], 0, atol=1e-7)
    assert waves.left()[0] == pytest.approx(0.04 * 2 / 9.81 * (1 + 1.8 * (2 / 9.81) ** 2), rel=2e-2)


@pytest.mark.parametrize(("push", "known"), [(4.3, True), (4.55, False)])
def test_a_surface_that_leans_by_nearly_half_the_radius_is_as_much_as_is_known(coffee, push, known):
    """Pushed ever harder, slowly, no wave runs and the surface leans by push / g; nothing else comes near an edge."""
    deep = coffee.with_changes(objects__0__liquid__fill=0.03, objects__0__uncertainty={})
    t = np.linspace(0, 12, 4001)
    w = np.tile(at_rest(), (len(t), 1))
    w[:, 0] = push * np.minimum(t / 10, 1) ** 2 * (3 - 2 * np.minimum(t / 10, 1))
    (spill,) = Liquids.along(deep.payload, t, w).spills(worst=False)
    assert spill.steep[:-1].max() == pytest.approx(push / 9.81 / 0.45, rel=5e-3)
    assert (spill.steep[:-1].max() < 1) == known
    assert spill.left.min() > 0.01


@pytest.mark.slow
@pytest.mark.parametrize("yaw", [0.0, 25.0])
def test_filter_agrees_with_the_equations_integrated(coffee, yaw):
    """In axes that do not turn, where the equations of the modes hold, to 1e-6 of the largest displacement."""
    case = Case(coffee.payload.first, 0.05, 0.01)
    which, T = Cases.of((case,)), 0.9

    def rates(t, state):
        w = shaken(np.array([t, T]), yaw)[0]
        r, rate, angle, spin = state[:4].reshape(2, 2), state[4:8].reshape(2, 2), state[8], state[9]
        c, s = np.cos(angle), np.sin(angle)
        force = (which.at_mode[0] @ w) @ np.array([[c, s], [-s, c]])
        omega = case.modes.omega
        second = -force - 2 * case.damping * omega * rate - omega**2 / 9.81 * (which.at_O[0, 2] @ w) * r
        return np.concatenate([rate.ravel(), second.ravel(), [spin, w[5]]])

    t = np.linspace(0, T, 301)
    exact = solve_ivp(rates, (0, T), np.zeros(10), rtol=1e-11, atol=1e-14, t_eval=t).y.T[:, :4].reshape(-1, 2, 2)
    waves = along((case,), t, shaken(t, yaw))
    assert np.abs(waves.r[0] - exact).max() < 1e-6 * np.abs(exact).max()


def _functions(waves: Waves, node, weight):
    case, dry, both = np.arange(len(node)) % 2, Slosh.of(waves), np.arange(2)
    return {
        "crest": (waves.crest[case, node], lambda by: dry.crest_by(case, node, by)),
        "free": (dry.free_height[case, node], lambda by: dry.free_by(case, node, by)),
        "wrench": (
            np.sum(weight * waves.wrench[case, node], axis=1),
            lambda by: wrench_by(waves, by, case, node, weight),
        ),
        "left": (waves.left(0.2), lambda by: dry.left_by(both, by, 0.2)),
    }


@pytest.mark.parametrize("underway", [False, True], ids=["from rest", "underway"])
@pytest.mark.parametrize("changes", [{}, BOX], ids=["cup", "box"])
def test_derivatives_agree_with_differences(coffee, changes, underway, monkeypatch):
    """By what the tray felt at all times, and by the duration; to what is interpolated between 201 nodes. Where the
    motion goes on from another the waves are as they are, how high and how fast, and so is the container's turn. What
    the walls of a box that turns take along is iterated to the end here."""
    monkeypatch.setattr(waves_module, "SETTLED", 1e-9)
    scenario = coffee.with_changes(**changes) if changes else coffee
    both = [Case(scenario.payload.first, fill, 0.01) for fill in (0.05, 0.06)]
    rng, t, step = np.random.default_rng(1), np.linspace(0, 0.9, 201), 1e-6
    w, node, weight = shaken(t), np.array([15, 66, 110, 165, 199]), rng.normal(size=(5, 6))
    move = np.sin(np.pi * t / 0.9)[:, None] ** 2 * np.stack([np.cos(k * t) for k in rng.uniform(2, 12, 12)], 1)
    start = None
    if underway:
        places, speeds, turns = rng.normal(size=(2, 2, 2)), rng.normal(size=(2, 2, 2)), rng.normal(size=(2, 2))
        start = Underway(1e-3 * places, 0.02 * speeds, 0.2 * turns[0], turns[1], np.zeros(2))
    here = _functions(along(both, t, w, start), node, weight)
    up, down = (_functions(along(both, t, w + sign * step * move, start), node, weight) for sign in (1, -1))
    longer, shorter = (_functions(along(both, t * (1 + sign * step), w, start), node, weight) for sign in (1, -1))
    both_ways = Unknowns(np.stack([move, np.zeros_like(move)], axis=2), np.array([0.0, 1.0]))
    for name, (_, derivative) in here.items():
        for ends, found in zip(((up, down), (longer, shorter)), derivative(both_ways).T, strict=True):
            difference = (ends[0][name][0] - ends[1][name][0]) / (2 * step)
            np.testing.assert_allclose(found, difference, atol=2e-5 * np.abs(difference).max(), err_msg=name)


@pytest.mark.parametrize("changes", [{}, BOX], ids=["cup", "box"])
def test_second_derivatives_of_waves_agree_with_differences(coffee, changes):
    """On a tray that is pushed along the ground waves are linear in the push; what is read of them is not."""
    scenario = coffee.with_changes(**changes) if changes else coffee
    both = [Case(scenario.payload.first, fill, 0.01) for fill in (0.05, 0.06)]
    rng, t, step = np.random.default_rng(2), np.linspace(0, 0.9, 101), 0.02
    w, node = np.tile(at_rest(), (len(t), 1)), np.array([15, 33, 55, 82, 99])
    w[:, :2] = shaken(t)[:, :2]
    move = np.zeros_like(w)
    move[:, :2] = np.sin(np.pi * t / 0.9)[:, None] ** 2 * np.stack([np.cos(k * t) for k in rng.uniform(2, 12, 2)], 1)
    case, dry, way = np.arange(5) % 2, Slosh.of(along(both, t, w)), Unknowns(move[:, :, None])
    values = {
        "crest": lambda x: x.crest[case, node],
        "free": lambda x: Slosh.of(x).free_height[case, node],
        "left": lambda x: x.left(0.2),
    }
    factors = {
        "crest": dry.crest_bends(case, node, way),
        "free": dry.free_bends(case, node, way),
        "left": dry.left_bends(np.arange(2), way, 0.2),
    }
    less, same, more = (along(both, t, w + k * step * move) for k in (-1, 0, 1))
    for name, of in values.items():
        difference = (of(less) - 2 * of(same) + of(more)) / step**2
        found = (factors[name] ** 2).sum(axis=(1, 2))
        np.testing.assert_allclose(found, difference, atol=2e-3 * np.abs(difference).max() + 1e-9, err_msg=name)


def pushed(duration: float, t: np.ndarray) -> np.ndarray:
    """Acceleration of the min-jerk line over 0.48 m."""
    x = np.clip(t / duration, 0, 1)
    return 0.48 / duration**2 * (60 * x - 180 * x**2 + 120 * x**3)


@pytest.mark.slow
@pytest.mark.parametrize(("fill", "duration"), [(0.05, 1.4), (0.05, 1.1), (0.065, 0.95)])
def test_waves_in_a_box_are_those_of_nonlinear_potential_flow(coffee, fill, duration):
    """Peak during the motion within 6 %; after it never higher than said. No pendulum, no small waves there."""
    case = Case(coffee.with_changes(**BOX).payload.first, fill, 0.005)
    assert case.modes.half[0] == pytest.approx(0.045)
    times = np.arange(0, duration + 0.4, 0.0015)
    seen = simulate(
        rectangle(0.09, 10), fill, lambda t: (float(pushed(duration, np.array(t))), 9.81), times, case.damping
    )
    t = np.linspace(0, duration, 201)
    w = np.tile(at_rest(), (len(t), 1))
    w[:, 0] = pushed(duration, t)
    waves, moving = along((case,), t, w), times <= duration
    assert waves.crest.max() == pytest.approx(seen[moving].max(), rel=0.06)
    assert waves.left()[0] > 0.95 * seen[~moving].max()


@pytest.mark.parametrize(("degrees", "within"), [(0, 0.02), (35, 0.03), (60, 0.03)])
def test_waves_across_a_box_are_those_of_nonlinear_potential_flow(coffee, degrees, within):
    """Pushed at an angle to its sides, both of which have waves of their own: they add up in a corner."""
    case, duration, angle = Case(coffee.with_changes(**BOX).payload.first, 0.05, 0.005), 1.25, np.deg2rad(degrees)
    times = np.arange(0, duration + 0.2, 0.004)
    flow = box((0.09, 0.06), angle)
    seen = simulate(flow, 0.05, lambda t: (float(pushed(duration, np.array(t))), 9.81), times, case.damping)
    t = np.linspace(0, duration, 201)
    w = np.tile(at_rest(), (len(t), 1))
    w[:, :2] = np.outer(pushed(duration, t), [np.cos(angle), np.sin(angle)])
    waves = along((case,), t, w)
    assert waves.crest.max() == pytest.approx(seen[times <= duration].max(), rel=within)
    assert waves.left()[0] > 0.95 * seen[times > duration].max()


def test_waves_in_a_cup_are_those_of_nonlinear_potential_flow(coffee):
    case, duration = Case(coffee.payload.first, 0.05, 0.005), 1.4
    times = np.arange(0, duration + 0.2, 0.003)
    seen = simulate(cylinder(0.04), 0.05, lambda t: (float(pushed(duration, np.array(t))), 9.81), times, case.damping)
    t = np.linspace(0, duration, 201)
    w = np.tile(at_rest(), (len(t), 1))
    w[:, 0] = pushed(duration, t)
    assert along((case,), t, w).crest.max() == pytest.approx(seen[times <= duration].max(), rel=0.03)


@pytest.mark.parametrize("shape", [{}, {"box": True}])
def test_changes_are_first_order_differences(coffee, shape, monkeypatch):
    """Of all that the tray feels: pushes, what stiffens the waves, turns about every axis. Central differences, to
    what is interpolated between nodes of a wave times a change."""
    monkeypatch.setattr(waves_module, "SETTLED", 1e-9)
    made = coffee.with_changes(**BOX) if shape else coffee
    case, t = Case(made.payload.first, 0.05, 0.01), np.linspace(0, 0.9, 101)
    here, step = along((case,), t, shaken(t)), 1e-5
    dw = np.random.default_rng(2).normal(size=12) * np.cos(3 * t)[:, None]
    dw = np.stack([dw, dw * np.sin(np.pi * t / 0.9)[:, None]], axis=2)
    change = changed(here, dw[None])
    for k in range(2):
        more, less = (along((case,), t, shaken(t) + sign * step * dw[:, :, k]) for sign in (1, -1))
        for name in ("eta", "free", "wrench"):
            difference = (getattr(more, name) - getattr(less, name)) / (2 * step)
            found = getattr(change, name)[..., k]
            np.testing.assert_allclose(found, difference, atol=1e-4 * np.abs(difference).max(), err_msg=name)
            if k == 1:  # begins with the motion
                shifted = getattr(here.shifted(step * dw[None, :, :, k]), name) - getattr(here, name)
                atol = 1e-3 * np.abs(difference).max()
                np.testing.assert_allclose(shifted / step, difference, atol=atol, err_msg=name)
    assert (here.raised(np.abs(step * change.eta).sum(axis=(2, 3)), 0.0) >= here.crest).all()


def test_worst_case_bounds_waves_at_every_corner(coffee):
    """What is uncertain, as small as first order needs: no corner is higher, and some corner nearly is."""
    case, t = Case(coffee.payload.first, 0.05, 0.01), np.linspace(0, 0.9, 101)
    dw = 1e-3 * np.random.default_rng(3).normal(size=(12, 3)) * np.cos(np.outer(t, [2, 5, 9]))[:, None, :]
    waves = along((case,), t, shaken(t))
    here = Slosh.given_way(waves, waves, np.zeros(0), dw[None])
    corners = np.array(np.meshgrid(*[[-1, 1]] * 3)).reshape(3, -1).T
    crests = np.array([along((case,), t, shaken(t) + dw @ corner).crest[0] for corner in corners]).max(axis=0)
    assert (crests < here.crest[0] + 2e-6).all()
    assert (here.crest[0] - crests < 0.5 * (here.crest - here.waves.crest) + 1e-6).any()


def test_a_fill_that_was_left_out_is_found_and_added(coffee):
    problem = transport_problem(coffee)
    only = tuple(tuple(case for case in each if case.fill < 0.04) for each in problem.liquids)
    problem = replace(problem, liquids=only)
    s, q = np.linspace(0, 1, 101), problem.start_posture
    swept = np.stack([[0.35, 0.25, 0.0, 0.15, 0.0, 0.1, 0.0]] * 101) * (s**3 * (10 - 15 * s + 6 * s**2))[:, None]
    shares = (s**2 * (30 - 60 * s + 30 * s**2), s * (60 - 180 * s + 120 * s**2), 60 - 360 * s + 360 * s**2)
    duration = 0.7
    rates = [swept[-1] * x[:, None] / duration**k for k, x in enumerate(shares, start=1)]
    motion = problem.at(s, np.stack([q + swept, *rates]), duration, imposed=False)
    more = with_missed_cases(problem, motion)
    assert more is not None
    assert max(case.fill for case in more.liquids[0]) == pytest.approx(0.065)
    assert with_missed_cases(more, motion) is None
    slowly = replace(motion, z=motion.z / (4.0 ** np.arange(4))[:, None, None], duration=4.0 * duration)
    assert with_missed_cases(problem, slowly) is None
    verdict = cases(coffee.payload.first, problem.payload.uncertain, VERDICT_APART)
    near = with_missed_cases(problem, slowly, 1.0)  # no case has more left than the whole of its room
    assert {(case.fill, case.damping) for case in near.liquids[0]} >= {(case.fill, case.damping) for case in verdict}
    assert with_missed_cases(near, slowly, 1.0) is None
    (brim,) = (constraint for constraint in more.constraints if isinstance(constraint, Brim))
    for block in brim.blocks(motion):
        assert block.points.tolist() == ([100] if "left" in block.name or "settled" in block.name else [*range(101)])


def test_contacts_that_chatter_are_not_waves():
    """A mean over an interval: exact for a steady push; a jolt of speed counts as spread over it."""
    t = np.arange(0, 0.2, 0.001)
    steady = outcome._rate(t, np.outer(t, [3.0, -1.0]), 0.02)
    np.testing.assert_allclose(steady, np.tile([3.0, -1.0], (len(t), 1)), atol=1e-12)
    jolt = outcome._rate(t, 0.01 * (t[:, None] > 0.1), 0.02)
    assert jolt.max() == pytest.approx(0.01 / 0.02)
    assert np.count_nonzero(jolt) == 20


def test_every_fill_in_the_range_is_covered_by_the_cases(coffee):
    """61 fills, the waves at none more than 3 % of the room above the highest of the cases that a verdict looks at."""
    payload, t = coffee.payload, np.linspace(0, 0.8, 301)
    w = 0.6 * (shaken(t) - at_rest()) + at_rest()
    body = payload.first
    whole = Liquids.along(payload, t, w)
    assert whole is not None
    least = Spill.of(body.name, whole.worst[body.name]).slack.min()
    for fill in np.linspace(0.035, 0.065, 31):
        for damping in np.linspace(*body.liquid.damping, 3):
            waves = along((Case(body, float(fill), float(damping)),), t, w)
            assert 1 - waves.crest.max() / waves.cases.room[0] > least - 0.03


def test_a_wave_that_must_have_settled_takes_what_is_missing_of_the_last_slack(coffee):
    """A twentieth more is allowed than is left after half a second: of that, less than a twentieth is to spare."""
    t, name = np.linspace(0, 0.8, 301), coffee.payload.first.name
    w = 0.3 * (shaken(t) - at_rest()) + at_rest()

    def spill(**demand):
        case = coffee.with_changes(**{f"objects__0__liquid__{key}": value for key, value in demand.items()})
        parts = Liquids.along(case.payload, t, w).worst[name]
        return Spill.of(name, parts), max(float(part.left(0.5).max()) for part in parts)

    free, left = spill()
    found, _ = spill(settled_wave=1.05 * left, settled_within=0.5)
    assert free.slack[-1] > 0.1
    assert found.settled == pytest.approx(0.05 * left, rel=1e-6)
    assert found.slack[-1] == pytest.approx(0.05 / 1.05, rel=1e-6)


@pytest.mark.parametrize("wanted", [{}, {"settled_wave": 0.05, "settled_within": 0.5}])
def test_the_last_slack_is_that_of_what_comes_afterwards(coffee, wanted):
    """At two seconds on a tray at rest. At the low fill waves are too steep first, at the high one they spill first."""
    body = coffee.with_changes(**{f"objects__0__liquid__{key}": value for key, value in wanted.items()}).payload.first
    t = np.linspace(0, 2.8, 1051)
    moving = t < 0.8 + 1e-9
    w = np.tile(at_rest(), (len(t), 1))
    w[moving] += 0.8 * (shaken(t[moving]) - at_rest())
    pair = (Case(body, 0.035, 0.01), Case(body, 0.07, 0.01))
    during, all_along = Slosh.of(along(pair, t[moving], w[moving])), Slosh.of(along(pair, t, w))
    slack, room = slacks(during), np.array([0.044, 0.009])[:, None]  # to 1 mm below the brim
    shares = np.array([all_along.crest / room, all_along.free_height / 0.012, all_along.lightness / LIGHTEST])
    assert slack[:, :-1] == pytest.approx(1 - shares.max(axis=0)[:, : moving.sum() - 1])
    later = shares[:, :, moving.sum() :].max(axis=2)
    assert later[1, 0] > later[0, 0]
    assert later[0, 1] > later[1, 1]
    assert np.all(slack[:, -1] <= 1 - later.max(axis=0))
    assert 1 - slack[0, -1] < 1.1 * later[1, 0]  # of one mode mostly, and of damping by 0.01
    assert slack[1, -2] - slack[1, -1] > 0.1


@pytest.mark.parametrize("size", [(0.06, 0.06), (0.09, 0.06), (0.05, 0.09)])
def test_walls_of_a_box_that_turns_take_waves_along_as_a_flow_without_friction_is_carried(coffee, size):
    """Against the modes integrated with what carries them: the stream function of the flow along the walls, of twice
    the turning rate as vorticity, by finite differences, projected on the first waves and on the second ones."""
    inside = {**BOX_IN, "size": list(size)}
    shape = {"type": "box", "size": [size[0] + 0.01, size[1] + 0.01, 0.085]}
    made = coffee.with_changes(objects__0__shape=shape, objects__0__liquid=inside)
    case = Case(made.payload.first, 0.05, 0.01)
    (a, b), n, T = size, 120, 0.9
    inner = [diags([1.0, -2.0, 1.0], [-1, 0, 1], shape=(n - 1, n - 1)) / (side / n) ** 2 for side in size]
    laplace = kron(inner[0], identity(n - 1)) + kron(identity(n - 1), inner[1])
    stream = np.zeros((n + 1, n + 1))
    stream[1:-1, 1:-1] = spsolve(laplace.tocsc(), 2 * np.ones((n - 1) ** 2)).reshape(n - 1, n - 1)
    along_x = -np.gradient(stream, b / n, axis=1)  # of unit turning
    x, y = (np.linspace(-0.5, 0.5, n + 1) * np.pi for _ in range(2))
    carried = []
    for k in (1, 3):
        slope = k * np.pi / a * np.cos(k * x)[:, None] * along_x
        pushed = np.trapezoid(np.trapezoid(slope * np.sin(k * y), y, axis=1), x)
        carried.append(abs(pushed) / (np.pi**2 / 2))
    which, omega, gain = Cases.of((case,)), case.modes.omega, case.modes.gain
    stiff, C = omega**2, np.array(carried)

    def rates(t, state):
        w = shaken(np.array([t, T]))[0]
        eta, rate, turning = state[:4].reshape(2, 2), state[4:8].reshape(2, 2), state[8]
        second = -gain * (which.at_mode[0] @ w) - 2 * case.damping * omega * rate
        second -= stiff / 9.81 * (which.at_O[0, 2] @ w) * eta
        ratio, faster = stiff[:, 0] / stiff[:, 1], C * w[5]
        second[:, 0] += C * turning * (1 + ratio) * rate[:, 1] + faster * eta[:, 1]
        second[:, 1] -= C * turning * (1 + 1 / ratio) * rate[:, 0] + faster * eta[:, 0]
        second += (C * turning)[:, None] ** 2 * eta * np.stack([ratio, 1 / ratio], axis=1)
        return np.concatenate([rate.ravel(), second.ravel(), [w[5]]])

    t = np.linspace(0, T, 301)
    eta = solve_ivp(rates, (0, T), np.zeros(9), rtol=1e-10, atol=1e-13, t_eval=t).y.T[:, :4].reshape(-1, 2, 2)
    whole, largest = along((case,), t, shaken(t)), np.abs(eta).max(axis=(0, 2))
    missed = np.abs(gain * whole.r[0] - eta).max(axis=(0, 2))
    np.testing.assert_array_less(missed, 0.01 * largest)
    lacked = np.abs(gain * along((case,), t, shaken(t, yaw=0.0)).r[0] - eta).max(axis=(0, 2))
    np.testing.assert_array_less(2 * missed, lacked)
    assert lacked[0] > 0.2 * largest[0]
    # Gone on with from where it turns fastest, it is the same.
    later = along((case,), t[150:], shaken(t)[150:], whole.underway().at(t, t[150]))
    assert np.abs(later.r - whole.r[:, 150:]).max() < 2e-3 * np.abs(whole.r).max()


def test_cases_span_fill_and_damping(coffee):
    found = cases(coffee.payload.first, coffee.payload.uncertain)
    assert {round(case.fill, 6) for case in found} >= {0.035, 0.065}
    assert len({case.damping for case in found}) == 2
    assert len(cases(coffee.payload.first, coffee.payload.nominal.uncertain)) == 1


def test_viscosity_damps_as_boundary_layers_do():
    assert damping_of((0.04,), 0.06, 1e-6) == pytest.approx(0.79 * np.sqrt(1e-6 / np.sqrt(9.81 * 0.04**3)), rel=0.05)


def liquid(**changes):
    return {"objects__0__liquid": {"kind": "water", "radius": 0.04, "fill": 0.05, "brim": 0.08, **changes}}


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        (liquid(fill=0.07), "stands above the brim"),
        (liquid(fill=0.085, brim=0.08), "stands above the brim"),
        (liquid(fill=0.02), "too shallow for this model"),
        (liquid(viscosity=0.01), "to this model it is a solid"),
        (liquid(radius=0.05), "the inside must be smaller"),
        (liquid(brim=0.09), "is only 0.085 m high"),
        (liquid(size=[0.05, 0.05]), "radius of a cylinder, or size of a box"),
        (liquid(damping=[0.02, 0.01]), "the least comes first"),
        (liquid(damping=[0.0, 0.9]), r"liquid.damping = \[0.0, 0.9\] of critical; waves are known to 0.2"),
        (liquid(damping=[0.15, 0.18]), "to this model it is a solid"),
        (
            liquid(viscosity=4e-4),
            "0.0004 m.2/s, damping 0.[0-9]+ to 0.[0-9]+ of critical; waves are known",
        ),
        (liquid(settled_within=0.5), "say with settled_wave"),
        ({"objects__0__uncertainty__fill": 0.06}, "reaches down to nothing"),
        ({"objects__0__uncertainty__position": [0.01, 0.0]}, "how waves change with it is not known"),
        ({"uncertainty__tilt_deg": [1.0, 0.0]}, "how waves change with it is not known"),
        ({"motion__goal": {"position": [0.44, 0.1, 0.411], "rpy_deg": [19.7, 0, 0]}}, "mm below its brim"),
        ({"objects__0__liquid": None}, "needs a liquid"),
    ],
)
def test_what_cannot_be_is_told_in_one_sentence(coffee, changes, words):
    with pytest.raises(ScenarioError, match=words) as caught:
        coffee.with_changes(**changes)
    assert str(caught.value).count("\n") == 0


def test_a_lid_keeps_the_liquid_in_and_its_force(coffee):
    sealed = coffee.with_changes(**liquid(sealed=True))
    t = np.linspace(0, 0.8, 201)
    whole = Liquids.along(sealed.payload, t, shaken(t))
    assert whole is not None
    spill = whole.spills(True)[0]
    assert np.isinf(spill.left).all()
    assert np.abs(whole.nominal["cup"][0].wrench).max() > 0.1
