"""Waves along a motion: by theory, by nonlinear flow, and how they change with the motion."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.sparse import diags, identity, kron
from scipy.sparse.linalg import spsolve

from potential_flow import box, cylinder, rectangle, simulate
from salver.dynamics.liquid.sloshing import SloshingResponse
from salver.dynamics.liquid.surface import SurfaceCases, SurfaceMotion
from salver.dynamics.load_cases import LoadCase
from salver.dynamics.modal_changes import changed
from salver.dynamics.modal_motion import ModalMotion
from salver.dynamics.modal_state import ModalState
from salver.dynamics.motion_gradients import Unknowns, wrench_by
from salver.geometry import exp
from salver.models.tray_motion import at_rest
from shaken_loads import BOX, BOX_IN, shaken


def test_a_surface_at_rest_is_level_however_the_tray_is_pushed(coffee):
    """Constant specific force, long enough for waves to die: eta = -R f / f_z, and the liquid's weight hangs aside."""
    case = LoadCase(coffee.payload.first, 0.05, 0.1)
    t = np.linspace(0, 12, 4001)
    w = np.tile(at_rest(), (len(t), 1))
    w[:, 0] = 2 * np.minimum(t / 2, 1) ** 2 * (3 - 2 * np.minimum(t / 2, 1))
    waves = SurfaceMotion.along((case,), t, w)
    np.testing.assert_allclose(waves.eta[0, -1], [-0.04 * 2 / 9.81, 0], atol=1e-7)
    np.testing.assert_allclose(waves.free[0, -1], 0, atol=1e-7)
    assert waves.left()[0] == pytest.approx(0.04 * 2 / 9.81 * (1 + 1.8 * (2 / 9.81) ** 2), rel=2e-2)


@pytest.mark.slow
@pytest.mark.parametrize("yaw", [0.0, 25.0])
def test_filter_agrees_with_the_equations_integrated(coffee, yaw):
    """In axes that do not turn, where the equations of the modes hold, to 1e-6 of the largest displacement."""
    case = LoadCase(coffee.payload.first, 0.05, 0.01)
    which, T = SurfaceCases.of((case,)), 0.9

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
    waves = SurfaceMotion.along((case,), t, shaken(t, yaw))
    assert np.abs(waves.r[0] - exact).max() < 1e-6 * np.abs(exact).max()


def _functions(waves: SurfaceMotion, node, weight):
    case, dry, both = np.arange(len(node)) % 2, SloshingResponse.of(waves), np.arange(2)
    loose = replace(dry, more_left=np.array([3e-3, 1e-3]))  # of the size of the waves that are left
    return {
        "crest": (waves.crest[case, node], lambda by: dry.crest_by(case, node, by)),
        "free": (dry.free_height[case, node], lambda by: dry.free_by(case, node, by)),
        "wrench": (
            np.sum(weight * waves.wrench[case, node], axis=1),
            lambda by: wrench_by(waves, by, case, node, weight),
        ),
        "left": (waves.left(0.2), lambda by: dry.left_by(both, by, 0.2)),
        "free left": (loose.free_left, lambda by: loose.free_left_by(both, by)),
    }


@pytest.mark.parametrize("underway", [False, True], ids=["from rest", "underway"])
@pytest.mark.parametrize("changes", [{}, BOX], ids=["cup", "box"])
def test_derivatives_agree_with_differences(coffee, changes, underway, monkeypatch):
    """By what the tray felt at all times, and by the duration; to what is interpolated between 201 nodes. Where the
    motion goes on from another the waves are as they are, how high and how fast, and so is the container's turn. What
    the walls of a box that turns take along is iterated to the end here."""
    monkeypatch.setattr(ModalMotion, "settled", 1e-9)
    scenario = coffee.with_changes(**changes) if changes else coffee
    both = [LoadCase(scenario.payload.first, fill, 0.01) for fill in (0.05, 0.06)]
    rng, t, step = np.random.default_rng(1), np.linspace(0, 0.9, 201), 1e-6
    w, node, weight = shaken(t), np.array([15, 66, 110, 165, 199]), rng.normal(size=(5, 6))
    move = np.sin(np.pi * t / 0.9)[:, None] ** 2 * np.stack([np.cos(k * t) for k in rng.uniform(2, 12, 12)], 1)
    start = None
    if underway:
        places, speeds, turns = rng.normal(size=(2, 2, 2)), rng.normal(size=(2, 2, 2)), rng.normal(size=(2, 2))
        start = ModalState(1e-3 * places, 0.02 * speeds, 0.2 * turns[0], turns[1], np.zeros(2))
    here = _functions(SurfaceMotion.along(both, t, w, start), node, weight)
    up, down = (
        _functions(SurfaceMotion.along(both, t, w + sign * step * move, start), node, weight) for sign in (1, -1)
    )
    longer, shorter = (
        _functions(SurfaceMotion.along(both, t * (1 + sign * step), w, start), node, weight) for sign in (1, -1)
    )
    both_ways = Unknowns(np.stack([move, np.zeros_like(move)], axis=2), np.array([0.0, 1.0]))
    for name, (_, derivative) in here.items():
        for ends, found in zip(((up, down), (longer, shorter)), derivative(both_ways).T, strict=True):
            difference = (ends[0][name][0] - ends[1][name][0]) / (2 * step)
            np.testing.assert_allclose(found, difference, atol=2e-5 * np.abs(difference).max(), err_msg=name)


def pushed(duration: float, t: np.ndarray) -> np.ndarray:
    """Acceleration of the min-jerk line over 0.48 m."""
    x = np.clip(t / duration, 0, 1)
    return 0.48 / duration**2 * (60 * x - 180 * x**2 + 120 * x**3)


@pytest.mark.slow
@pytest.mark.parametrize(("fill", "duration"), [(0.05, 1.4), (0.05, 1.1), (0.065, 0.95)])
def test_waves_in_a_box_are_those_of_nonlinear_potential_flow(coffee, fill, duration):
    """Peak during the motion within 6 %; after it never higher than said. No pendulum, no small waves there."""
    case = LoadCase(coffee.with_changes(**BOX).payload.first, fill, 0.005)
    assert case.modes.half[0] == pytest.approx(0.045)
    times = np.arange(0, duration + 0.4, 0.0015)
    seen = simulate(
        rectangle(0.09, 10), fill, lambda t: (float(pushed(duration, np.array(t))), 9.81), times, case.damping
    )
    t = np.linspace(0, duration, 201)
    w = np.tile(at_rest(), (len(t), 1))
    w[:, 0] = pushed(duration, t)
    waves, moving = SurfaceMotion.along((case,), t, w), times <= duration
    assert waves.crest.max() == pytest.approx(seen[moving].max(), rel=0.06)
    assert waves.left()[0] > 0.95 * seen[~moving].max()


@pytest.mark.parametrize(("degrees", "within"), [(0, 0.02), (35, 0.03), pytest.param(60, 0.03, marks=pytest.mark.slow)])
def test_waves_across_a_box_are_those_of_nonlinear_potential_flow(coffee, degrees, within):
    """Pushed at an angle to its sides, both of which have waves of their own: they add up in a corner."""
    case, duration, angle = (
        LoadCase(coffee.with_changes(**BOX).payload.first, 0.05, 0.005),
        1.25,
        np.deg2rad(degrees),
    )
    times = np.arange(0, duration + 0.2, 0.004)
    flow = box((0.09, 0.06), angle)
    seen = simulate(flow, 0.05, lambda t: (float(pushed(duration, np.array(t))), 9.81), times, case.damping)
    t = np.linspace(0, duration, 201)
    w = np.tile(at_rest(), (len(t), 1))
    w[:, :2] = np.outer(pushed(duration, t), [np.cos(angle), np.sin(angle)])
    waves = SurfaceMotion.along((case,), t, w)
    assert waves.crest.max() == pytest.approx(seen[times <= duration].max(), rel=within)
    assert waves.left()[0] > 0.95 * seen[times > duration].max()


def test_waves_in_a_cup_are_those_of_nonlinear_potential_flow(coffee):
    case, duration = LoadCase(coffee.payload.first, 0.05, 0.005), 1.4
    times = np.arange(0, duration + 0.2, 0.003)
    seen = simulate(cylinder(0.04), 0.05, lambda t: (float(pushed(duration, np.array(t))), 9.81), times, case.damping)
    t = np.linspace(0, duration, 201)
    w = np.tile(at_rest(), (len(t), 1))
    w[:, 0] = pushed(duration, t)
    assert SurfaceMotion.along((case,), t, w).crest.max() == pytest.approx(seen[times <= duration].max(), rel=0.03)


@pytest.mark.parametrize("shape", [{}, {"box": True}])
def test_changes_are_first_order_differences(coffee, shape, monkeypatch):
    """Of all that the tray feels: pushes, what stiffens the waves, turns about every axis. Central differences, to
    what is interpolated between nodes of a wave times a change."""
    monkeypatch.setattr(ModalMotion, "settled", 1e-9)
    made = coffee.with_changes(**BOX) if shape else coffee
    case, t = LoadCase(made.payload.first, 0.05, 0.01), np.linspace(0, 0.9, 101)
    here, step = SurfaceMotion.along((case,), t, shaken(t)), 1e-5
    dw = np.random.default_rng(2).normal(size=12) * np.cos(3 * t)[:, None]
    dw = np.stack([dw, dw * np.sin(np.pi * t / 0.9)[:, None]], axis=2)
    change = changed(here, dw[None])
    eta, free, thrown = here.changed(change, dw[None])
    by = {"eta": eta, "free": free, "thrown": thrown, "wrench": change.wrench}

    def values(waves):
        linear = waves.cases.highest(waves.eta)
        curved = (waves.cases.peaking[:, None] / waves.cases.half[:, None] * waves.free**2).sum(axis=-1)
        return {"eta": waves.eta, "free": waves.free, "thrown": waves.crest - linear - curved, "wrench": waves.wrench}

    for k in range(2):
        more, less = (SurfaceMotion.along((case,), t, shaken(t) + sign * step * dw[:, :, k]) for sign in (1, -1))
        more, less = values(more), values(less)
        for name in by:
            difference = (more[name] - less[name]) / (2 * step)
            found = by[name][..., k]
            np.testing.assert_allclose(found, difference, atol=1e-4 * np.abs(difference).max(), err_msg=name)
            if k == 1:  # begins with the motion
                shifted = values(here.shifted(step * dw[None, :, :, k]))[name] - values(here)[name]
                atol = 1e-3 * np.abs(difference).max()
                np.testing.assert_allclose(shifted / step, difference, atol=atol, err_msg=name)
    assert (here.raised(np.abs(step * eta).sum(axis=(2, 3)), 0.0) >= here.crest).all()


def test_where_waves_come_to_rest_changes_with_what_the_tray_feels_last(coffee):
    """On a tray that leans and rests, by central differences."""
    case, t = LoadCase(coffee.payload.first, 0.05, 0.01), np.linspace(0, 0.9, 101)
    w = np.tile(at_rest(exp(np.array([0.1, -0.07, 0.0]))), (len(t), 1))
    dw, step = np.random.default_rng(4).normal(size=12) * np.cos(3 * t)[:, None], 1e-5
    here = SurfaceMotion.along((case,), t, w)
    found = here.equilibrium_by(dw[None, :, :, None], here.spun(dw[None, :, :, None]))[..., 0]
    more, less = (SurfaceMotion.along((case,), t, w + sign * step * dw).equilibrium for sign in (1, -1))
    difference = (more - less) / (2 * step)
    np.testing.assert_allclose(found, difference, atol=1e-6 * np.abs(difference).max())  # as the step squared


@pytest.mark.parametrize(
    "size", [(0.09, 0.06), *(pytest.param(x, marks=pytest.mark.slow) for x in ((0.06, 0.06), (0.05, 0.09)))]
)
def test_walls_of_a_box_that_turns_take_waves_along_as_a_flow_without_friction_is_carried(coffee, size):
    """Against the modes integrated with what carries them: the stream function of the flow along the walls, of twice
    the turning rate as vorticity, by finite differences, projected on the first waves and on the second ones."""
    inside = {**BOX_IN, "size": list(size)}
    shape = {"type": "box", "size": [size[0] + 0.01, size[1] + 0.01, 0.085]}
    made = coffee.with_changes(objects__0__shape=shape, objects__0__liquid=inside)
    case = LoadCase(made.payload.first, 0.05, 0.01)
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
    which, omega, gain = SurfaceCases.of((case,)), case.modes.omega, case.modes.gain
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
    whole, largest = SurfaceMotion.along((case,), t, shaken(t)), np.abs(eta).max(axis=(0, 2))
    missed = np.abs(gain * whole.r[0] - eta).max(axis=(0, 2))
    np.testing.assert_array_less(missed, 0.01 * largest)
    lacked = np.abs(gain * SurfaceMotion.along((case,), t, shaken(t, yaw=0.0)).r[0] - eta).max(axis=(0, 2))
    np.testing.assert_array_less(2 * missed, lacked)
    assert lacked[0] > 0.2 * largest[0]
    # Gone on with from where it turns fastest, it is the same.
    later = SurfaceMotion.along((case,), t[150:], shaken(t)[150:], whole.states.at(t, t[150]))
    assert np.abs(later.r - whole.r[:, 150:]).max() < 2e-3 * np.abs(whole.r).max()
