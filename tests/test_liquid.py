"""The liquid in a container: modes, waves along a motion and their derivatives, what a scenario may ask."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.sparse import diags, identity, kron
from scipy.sparse.linalg import spsolve

import salver as sv
from potential_flow import cylinder, rectangle, simulate
from salver.contact_margins import margins
from salver.errors import ScenarioError
from salver.models.liquid import Liquid, damping_of
from salver.models.parameters import Parameter
from salver.models.tray_motion import at_rest
from salver.models.wrench_cone import facets
from salver.planning.fastest.brim import Brim
from salver.planning.fastest.evaluation import Sloshing, of_cases
from salver.planning.fastest.found import EFFORTS, object_motion
from salver.planning.fastest.problem import transport_problem, with_missed_cases
from salver.planning.fastest.retiming import plan_retimed
from salver.planning.fastest.safest import plan_safest
from salver.planning.object.problem import Problem
from salver.sensitivity.sloshing import Liquids, Slosh, Spill
from salver.sensitivity.wave_gradients import Unknowns, wrench_by
from salver.sensitivity.waves import Case, Cases, Waves, along, cases
from salver.simulation import outcome
from salver.simulation.physics import simulate_tray
from salver.trajectory import SampledReference, min_jerk_line

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
    waves = case.along(t, w)
    np.testing.assert_allclose(waves.eta[0, -1], [-0.04 * 2 / 9.81, 0], atol=1e-7)
    np.testing.assert_allclose(waves.free[0, -1], 0, atol=1e-7)
    assert waves.left()[0] == pytest.approx(0.04 * 2 / 9.81 * (1 + 1.8 * (2 / 9.81) ** 2), rel=2e-2)


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
    waves = case.along(t, shaken(t, yaw))
    assert np.abs(waves.r[0] - exact).max() < 1e-6 * np.abs(exact).max()


def _functions(waves: Waves, node, weight):
    case, dry, both = np.arange(len(node)) % 2, Slosh.of(waves), np.arange(2)
    return {
        "crest": (waves.crest[case, node], lambda by: dry.crest_by(case, node, by)),
        "free": (waves.free_height[case, node], lambda by: dry.free_by(case, node, by)),
        "wrench": (
            np.sum(weight * waves.wrench[case, node], axis=1),
            lambda by: wrench_by(waves, by, case, node, weight),
        ),
        "left": (waves.left(0.2), lambda by: dry.left_by(both, by, 0.2)),
    }


@pytest.mark.parametrize("changes", [{}, BOX], ids=["cup", "box"])
def test_derivatives_agree_with_differences(coffee, changes):
    """By what the tray felt at all times, and by the duration; to what is interpolated between 201 nodes."""
    scenario = coffee.with_changes(**changes) if changes else coffee
    both = [Case(scenario.payload.first, fill, 0.01) for fill in (0.05, 0.06)]
    rng, t, step = np.random.default_rng(1), np.linspace(0, 0.9, 201), 1e-6
    w, node, weight = shaken(t), np.array([15, 66, 110, 165, 199]), rng.normal(size=(5, 6))
    move = np.sin(np.pi * t / 0.9)[:, None] ** 2 * np.stack([np.cos(k * t) for k in rng.uniform(2, 12, 12)], 1)
    here = _functions(along(both, t, w), node, weight)
    up, down = (_functions(along(both, t, w + sign * step * move), node, weight) for sign in (1, -1))
    longer, shorter = (_functions(along(both, t * (1 + sign * step), w), node, weight) for sign in (1, -1))
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
        "free": lambda x: x.free_height[case, node],
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
    waves, moving = case.along(t, w), times <= duration
    assert waves.crest.max() == pytest.approx(seen[moving].max(), rel=0.06)
    assert waves.left()[0] > 0.95 * seen[~moving].max()


def test_waves_in_a_cup_are_those_of_nonlinear_potential_flow(coffee):
    case, duration = Case(coffee.payload.first, 0.05, 0.005), 1.4
    times = np.arange(0, duration + 0.2, 0.003)
    seen = simulate(cylinder(0.04), 0.05, lambda t: (float(pushed(duration, np.array(t))), 9.81), times, case.damping)
    t = np.linspace(0, duration, 201)
    w = np.tile(at_rest(), (len(t), 1))
    w[:, 0] = pushed(duration, t)
    assert case.along(t, w).crest.max() == pytest.approx(seen[times <= duration].max(), rel=0.03)


@pytest.mark.parametrize("shape", [{}, {"box": True}])
def test_changes_are_first_order_differences(coffee, shape):
    """Of all that the tray feels: pushes, what stiffens the waves, turns about every axis. Central differences, to
    what is interpolated between nodes of a wave times a change."""
    made = coffee.with_changes(**BOX) if shape else coffee
    case, t = Case(made.payload.first, 0.05, 0.01), np.linspace(0, 0.9, 101)
    here, step = case.along(t, shaken(t)), 1e-5
    dw = np.random.default_rng(2).normal(size=12) * np.cos(3 * t)[:, None]
    dw = np.stack([dw, dw * np.sin(np.pi * t / 0.9)[:, None]], axis=2)
    change = here.changed(dw[None])
    for k in range(2):
        more, less = (case.along(t, shaken(t) + sign * step * dw[:, :, k]) for sign in (1, -1))
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
    waves = case.along(t, shaken(t))
    here = Slosh.given_way(waves, waves, np.zeros(0), dw[None])
    corners = np.array(np.meshgrid(*[[-1, 1]] * 3)).reshape(3, -1).T
    crests = np.array([case.along(t, shaken(t) + dw @ corner).crest[0] for corner in corners]).max(axis=0)
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
            waves = Case(body, float(fill), float(damping)).along(t, w)
            assert 1 - waves.crest.max() / waves.cases.room[0] > least - 0.03


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
        (liquid(damping=[0.0, 0.9]), "waves are known to"),
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


LEVEL = {"motion__orientation": "fixed", "motion__goal_yaw": "fixed"}


@pytest.mark.slow
def test_a_level_plan_of_a_given_duration_keeps_the_coffee(coffee):
    """In 1 s, in which the straight line does not: over all fills and dampings, on the finer grid of the check."""
    made = coffee.with_changes(motion__duration=1.0, motion__degree=12, **LEVEL)
    line, plan = sv.plan(made, "baseline", arm=False), sv.plan(made, arm=False)
    assert not line.verification.ok
    assert plan.status.ok, plan.status.sentence
    assert plan.verification.ok, plan.verification.sentence
    assert plan.margins.verdict(worst=True).ok


@pytest.mark.slow
def test_a_given_path_is_run_so_slowly_that_nothing_spills(coffee):
    """Straight in joint space by a quarter radian: alone as fast as the joints go; with the coffee slower, and the
    engine agrees at the fullest. Faster than that, the verdict says, it spills."""
    q = np.array(coffee.arm.start_posture) + np.outer(np.linspace(0, 1, 9), [0.9, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0])
    plan = plan_retimed(coffee, q)
    assert plan.status.ok, plan.status.sentence
    assert plan.duration > 1.1 * plan.solver["lower_bound"]
    assert plan.margins.verdict(worst=True).ok
    record = sv.simulate(plan, parameters={"fill": 0.065, "damping": 0.002, "mass": 0.275, "friction": 0.36})
    assert record.outcome == "holds"
    quick = replace(plan.joint, t=0.8 * plan.joint.t, dq=plan.joint.dq / 0.8, ddq=plan.joint.ddq / 0.8**2)
    problem = transport_problem(coffee)
    hasty = SampledReference(object_motion(problem, quick.t, quick.q, quick.dq, quick.ddq))
    assert not margins(plan.scenario, hasty.sample(quick.t)).verdict(worst=True).ok


@pytest.mark.slow
def test_the_safest_motion_of_a_coffee_keeps_as_much_of_its_room_as_of_its_weight(coffee):
    """At every fill and damping that a verdict looks at, in the given time."""
    plan = plan_safest(coffee.with_changes(motion__duration=1.0), options=replace(EFFORTS["quick"], spans=8))
    assert plan.status.ok, plan.status.sentence
    kept = plan.solver["margin"]
    assert kept > 0.1
    assert f"{100 * kept:.2g} % of its room" in plan.status.sentence
    assert plan.verification.slack > kept - 5e-3
    assert min(spill.slack.min() for spill in plan.margins.spills(worst=True)) > kept - 5e-3


def test_tangents_of_a_level_plan_agree_with_differences(coffee):
    """Of the room that waves leave, of their steepness, of what is left at the end, and of contact with the slosh."""
    problem = Problem(coffee.with_changes(motion__duration=1.1, **LEVEL), 61)
    rows = problem.linearise(np.zeros(problem.size)).rows
    rng = np.random.default_rng(5)
    residual, jacobian = problem.smoothness  # near the straight line: z = 0 is a wild motion
    step = np.linalg.lstsq(jacobian, -residual, rcond=None)[0] + 1e-3 * rng.normal(size=problem.size)
    move = rng.normal(size=problem.size)
    for part, columns in ((rows[0], [0, 7, 30]), (rows[1], [0, 3, 5, 7, 9])):
        slack, terms = part.slack(step)
        instant, row = np.repeat([20, 41, 60], len(columns)), np.tile(columns, 3)
        known = (row < 8) | (instant == 60) | (part is rows[0])  # what is left after it, at the end alone
        instant, row = instant[known], row[known]
        offset, slope = part.cuts(instant, row, terms[instant, row])
        np.testing.assert_allclose(offset + slope @ step, slack[instant, row], atol=1e-12)
        up, down = (part.slack(step + sign * 1e-6 * move)[0][instant, row] for sign in (1, -1))
        np.testing.assert_allclose(slope @ move, (up - down) / 2e-6, atol=1e-4 * np.abs(slope @ move).max())


def test_what_does_not_know_liquids_says_so(coffee):
    from salver.planning.fastest import Anywhere, AtPosture

    with pytest.raises(ScenarioError, match="plan with --fastest"):
        sv.plan(coffee.with_changes(motion__duration=2.0))
    with pytest.raises(ScenarioError, match="knows no liquids"):
        sv.plan(coffee.with_changes(motion__duration=2.0, contact__condition="paper"), "baseline").verify()
    problem = transport_problem(coffee)
    q = problem.start_posture
    moving = replace(problem, start=AtPosture(q, 0.1 * np.ones(7), np.zeros(7)), goal=Anywhere())
    with pytest.raises(ScenarioError, match="begins moving"):
        moving.constraints  # noqa: B018


def test_rows_of_a_liquid_are_its_crest_what_is_left_and_what_settles_in_units_of_their_room(coffee):
    """Against the waves themselves; under a lid there is no room to keep, and nothing settles that was not asked to."""
    s, swing = np.linspace(0, 1, 41), 0.3 * np.array([1.0, 0.7, 0.0, 0.4, 0.0, 0.3, 0.0])
    u = s[:, None]
    blend = (u**3 * (10 - 15 * u + 6 * u**2), 30 * u**2 * (1 - u) ** 2, 60 * u * (1 - u) * (1 - 2 * u), 0 * u)

    def rows(case):
        problem = transport_problem(case)
        z = np.stack([x * swing for x in blend])
        z[0] += problem.start_posture
        motion = problem.at(s, z, 1.0)
        (brim,) = (x for x in problem.constraints if isinstance(x, Brim))
        return motion, {block.name.removesuffix(f" in {brim.body.name}"): block.values for block in brim.blocks(motion)}

    settling = {"objects__0__liquid__settled_wave": 0.006, "objects__0__liquid__settled_within": 0.5}
    motion, found = rows(coffee.with_changes(**settling))
    assert set(found) == {"steepness", "waves", "waves left", "settled waves"}
    parts = motion.sloshing["cup"]
    room = np.concatenate([part.waves.cases.room for part in parts])
    crest = np.concatenate([part.crest for part in parts])
    now, later = (np.concatenate([part.left(wait) for part in parts]) for wait in (0.0, 0.5))
    assert found["waves"] == pytest.approx((crest / room[:, None] - 1).T, abs=1e-12)
    assert found["waves left"] == pytest.approx((now / room - 1)[None], abs=1e-12)
    assert found["settled waves"] == pytest.approx((later / 0.006 - 1)[None], abs=1e-12)
    assert np.all(later < now)
    assert set(rows(coffee)[1]) == {"steepness", "waves", "waves left"}
    lid = coffee.with_changes(objects__0__liquid__sealed=True)
    assert not {"waves", "waves left"} & set(rows(lid)[1])


@pytest.mark.slow
def test_fastest_plan_keeps_the_coffee_and_the_engine_agrees(coffee, tmp_path):
    from salver.planning.fastest import plan_fastest
    from salver.reports.page import write_report

    plan = plan_fastest(coffee)
    assert plan.ok, plan.verification.sentence
    assert plan.duration < 0.80
    full = {"mass": 0.275, "com_x": -0.002, "com_y": -0.002, "com_z": -0.00224, "fill": 0.065}
    for parameters in (
        {"fill": 0.065, "damping": 0.002},
        {"fill": 0.035, "damping": 0.03},
        {**full, "friction": 0.44, "damping": 0.03},
        {**full, "com_x": 0.002, "friction": 0.36, "damping": 0.0017},
    ):
        record = sv.simulate(plan, parameters=parameters)
        assert record.outcome == "holds"
        room = coffee.payload.first.liquid.brim - parameters["fill"]
        assert 0.3 * room < np.nanmax(record.surface[:, 0, 2]) < room
    plan.save(tmp_path)
    record.save(tmp_path)
    page = write_report(tmp_path).read_text(encoding="utf-8")
    assert "Highest point of the liquid in cup" in page
    assert "Fastest, in the engine" in page


@pytest.mark.slow
def test_a_beaker_is_still_when_it_should_be():
    """Half a second after the arm stands no wave of the engine is higher than was asked for, at either end of the
    fill; two kinds of condition, of the motion and of what comes after it, on another arm."""
    made = sv.load_scenario("ur10-beaker", physics__settle_after=0.9)
    plan, liquid = sv.fastest(made), made.payload.first.liquid
    assert plan.ok, plan.verification.sentence
    for fill in (0.0385, 0.0715):
        record = sv.simulate(plan, parameters={"fill": fill, "damping": liquid.damping[0], "mass": 0.09})
        assert record.outcome == "holds"
        after = record.surface[record.t > plan.duration + liquid.within, 0, 2]
        assert len(after) > 10
        assert np.nanmax(after) < liquid.settled


def test_a_thin_glass_of_oil_stands_in_the_engine_with_all_its_weight(coffee):
    """What moves of its second mode is under a gram on millimetres: an inertia that is nothing to the engine."""
    shape = {"type": "cylinder", "radius": 0.022, "height": 0.11}
    oil = {"kind": "oil", "radius": 0.018, "fill": 0.07, "brim": 0.105}
    glass = {"objects__0__shape": shape, "objects__0__liquid": oil, "objects__0__mass": 0.1}
    made = coffee.with_changes(arm=None, physics__settle_before=0.3, physics__settle_after=0.0, **glass)
    at = np.array(made.motion.start.position)
    record = simulate_tray(min_jerk_line(0.3, at, at, np.eye(3), np.eye(3)), made)
    weight = 9.81 * (0.1 + made.payload.first.liquid.density * np.pi * 0.018**2 * 0.07)
    assert record.outcome == "holds"
    np.testing.assert_allclose(record.contact_force_E[-1, 0], [0, 0, weight], atol=2e-3 * weight)


def test_audit_knows_that_a_line_spills(coffee):
    """The straight line in 0.9 s slides and spills; with enough friction it spills; in 2.5 s it does neither."""
    sticky = coffee.with_changes(objects__0__friction=2.0)
    for duration, word in ((0.95, "spills"), (2.5, "holds")):
        plan = sv.plan(sticky.with_changes(motion__duration=duration), "baseline", arm=False)
        assert plan.margins.verdict(worst=True).code == word
        assert plan.verification.ok == (word == "holds")


def test_what_is_not_known_of_a_liquid_is_said_first(coffee):
    """By the plan and by every verdict that calls it dry; a box says more of itself than a cup."""
    made = coffee.with_changes(motion__duration=2.5, objects__0__friction=2.0)
    plan = sv.plan(made, "baseline", arm=False)
    said = "swirling or breaking waves in cup"
    assert plan.unchecked[0] == said
    assert plan.margins.verdict(worst=True).sentence.startswith(f"Not checked: {said}. Everything holds")
    assert sv.plan(made, "baseline").unchecked[0] == said
    boxed = made.with_changes(**BOX).payload.unmodelled
    assert boxed[0].endswith("when it turns about its upright axis")
    assert not sv.load_scenario("panda-cube").payload.unmodelled


def test_a_case_knows_what_its_fill_weighs(coffee):
    """Mass and fill away from nominal at once: what is sure of a fill, with what a mass still may do, is all of both,
    but for the square of the mass."""
    problem, rng = transport_problem(coffee), np.random.default_rng(4)
    assert problem.tracking is not None
    load, body = problem.tracking.load, problem.items[0]
    dw, mass, fill = rng.normal(size=(5, 12, len(load.terms))), Parameter("cup", "mass"), Parameter("cup", "fill")
    for share in (-1.0, 0.3, 1.0):
        case = Case(body, 0.05 + share * 0.015, 0.01)
        sure, unsure = of_cases([case], load, dw)
        others = [p for p in load.uncertain.parameters if p != fill]
        assert unsure.shape == (1, 5, 12, len(others))
        values = {mass: -0.7, fill: share}
        whole = sum(
            dw[:, :, k] * np.prod([values.get(p, 0.0) for p in factors])
            for k, factors in enumerate(load.terms)
            if factors != (mass, mass)
        )
        np.testing.assert_allclose(sure[0] - 0.7 * unsure[0, ..., others.index(mass)], whole, atol=1e-12)


def test_what_the_support_gives_holds_the_waves_as_contact_rows_count_them(coffee):
    """The facets of the cup's cone, applied to the wrench that friction and tip-over are told from."""
    line = sv.plan(coffee.with_changes(motion__duration=2.0), "baseline", arm=False)
    (cup,) = line.margins.interfaces
    waves = line.margins.liquids.nominal["cup"][0].wrench[0]
    assert np.abs(waves[:, :2]).max() > 0.01  # N
    rows = facets(cup.interface.contacts)
    share = cup.exact / (-cup.wrench_B @ rows.T).min(axis=1)  # rows of one length there, of another here
    assert np.ptp(share) < 1e-6 * share.mean()


def test_waves_that_an_arm_with_a_known_load_feels_are_nearly_those_that_were_planned(coffee):
    """It gives way to the waves alone, by less than a sixth of them; gravity would be a hundred times as much."""
    problem = transport_problem(coffee)
    problem = replace(problem, tracking=replace(problem.tracking, delay=0.0))
    s = np.linspace(0, 1, 101)[:, None]
    swing = np.array([0.35, 0.25, 0.0, 0.15, 0.0, 0.1, 0.0])
    blend = (s**3 * (10 - 15 * s + 6 * s**2), 30 * s**2 * (1 - s) ** 2, 60 * s * (1 - s) * (1 - 2 * s))
    rates = [x * swing for x in blend]
    motion = problem.at(s[:, 0], np.stack([problem.start_posture + rates[0], *rates[1:], 0 * rates[0]]), 1.0)
    response = motion.response
    planned, given = Sloshing.of(problem.liquids[:1], s[:, 0], motion.terms.w, response).each["cup"]
    assert np.abs(planned.waves.eta).max() > 1e-3  # m
    np.testing.assert_allclose(given.waves.eta, planned.waves.eta, atol=0.15 * np.abs(planned.waves.eta).max())
    # What waves and arm do to each other goes round and round, less each time.
    once, thrice = (response.reaction(x.wrench) for x in (planned, given.waves))
    assert np.abs(thrice - given.reaction).max() < 0.8 * np.abs(given.reaction - once).max()
