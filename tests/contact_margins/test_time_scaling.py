"""At which constant speed factors a motion keeps its load: by hand, by the laws that margins obey, and for plans."""

from dataclasses import replace

import numpy as np
import pytest

from recorded_motions import GOAL, START, line
from salver import scenario as scenarios
from salver.contact_margins import Braking, BrakingOptions, Margins, braking, margin_model, safe_speeds
from salver.contact_margins.time_scaling import TimeScaled, _edge, lacking_of_few
from salver.geometry import exp, log
from salver.models.tray_motion import FULL_SPEED, Speed, motion_vector
from salver.planning.fastest.speeds import _with
from salver.planning.trajopt.constraints.load_limits import LoadConstraint
from salver.planning.trajopt.problem import transport_problem
from salver.trajectory import MotionSamples, min_jerk_line

FRICTION = 0.3
PEAK = 10 / np.sqrt(3) * 0.5  # of the min-jerk acceleration over 0.5 m, times T^2


def model_of(friction=FRICTION, height=0.04, uncertainty=None):
    data = scenarios.load("panda-cube").model_dump(mode="json", exclude_none=True)
    data["objects"][0] |= {"friction": friction, "uncertainty": uncertainty or {}}
    data["objects"][0]["shape"] = {"type": "box", "size": [0.04, 0.04, height]}
    data["objects"][0].pop("inertia")
    return margin_model(scenarios.parse(data, "test"), 16)


def tilted(degrees, accelerations=0.0, count=21):
    """Along y, tilted about x by an angle, with accelerations along y (as many instants)."""
    t, zero = np.linspace(0.0, 1.0, count), np.zeros((count, 3))
    a = zero + np.outer(np.broadcast_to(accelerations, count), [0.0, 1.0, 0.0])
    R = np.broadcast_to(exp(np.array([np.deg2rad(degrees), 0.0, 0.0])), (count, 3, 3))
    return MotionSamples(t, zero, 0.4 * np.ones((count, 3)), a, R, zero, zero)


def turning(rng, count=40):
    """A random motion of the tray, that turns about all axes and leans by up to some degrees."""
    t = np.linspace(0.0, 1.0, count)
    angles = rng.uniform(0.02, 0.12, 3) * np.sin(np.outer(t, rng.uniform(2, 7, 3)) + rng.uniform(0, 6, 3))
    a, omega, alpha = (size * rng.standard_normal((count, 3)) for size in (1.2, 0.6, 2.0))
    return MotionSamples(t, 0 * a, rng.standard_normal((count, 3)), a, exp(angles), omega, alpha)


# By hand ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("degrees", "static"), [(16.5, True), (-16.5, True), (17.0, False), (-17.0, False)])
def test_standing_still_it_slides_exactly_where_the_tangent_of_the_tilt_is_above_friction(degrees, static):
    """atan 0.3 is 16.7 degrees."""
    found = safe_speeds(model_of(), tilted(degrees), worst=False)
    assert found.every is static
    if not static:
        assert found.fails_at == 0
        assert "Holds at no speed from 0 to 100 %: standing still" in found.sentence
        assert not found.pace.ok


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_tray_that_leans_into_its_acceleration_holds_only_near_full_speed(sign):
    """On a slope of 20 degrees with acceleration a along y the cube needs (g sin - s^2 a cos) / (g cos + s^2 a sin)."""
    angle, a = np.deg2rad(20.0), 3.2
    found = safe_speeds(model_of(), tilted(sign * 20.0, -sign * a), worst=False)
    mu, g = FRICTION, 9.81

    def factor(friction):
        return np.sqrt(
            g * (np.sin(angle) - friction * np.cos(angle)) / (a * (np.cos(angle) + friction * np.sin(angle)))
        )

    ((low, high),) = found.intervals
    assert low == pytest.approx(factor(mu), rel=1e-5)
    assert found.fastest == pytest.approx(factor(-mu), rel=1e-5)
    assert high == 1.0
    assert 100 * found.fails_at == np.ceil(100 * low) - 1
    assert found.sentence.startswith(f"Only at {np.ceil(100 * low):g} to 100 % of full speed: at ")
    assert "slides" in found.sentence


def test_a_level_load_that_holds_at_a_twentieth_of_its_speed_fails_at_the_next_hundredth():
    found = safe_speeds(model_of(), tilted(0.0, FRICTION * 9.80665 / 0.0505**2), worst=False)
    assert found.fastest == pytest.approx(0.0505, rel=1e-3)
    assert found.intervals == ((0.0, found.fastest),)
    assert found.fails_at == pytest.approx(0.06)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_what_holds_only_faster_than_planned_holds_at_no_speed_up_to_that(sign):
    """A tray that leans by 20 degrees, more than friction holds, needs an acceleration above g tan(20 - 16.7)."""
    least = 9.80665 * np.tan(np.deg2rad(20.0) - np.arctan(FRICTION))
    found = safe_speeds(model_of(), tilted(20.0 * sign, -sign * least / 1.5**2), worst=False)
    assert found.intervals == ()
    assert found.fastest > 1.5


def test_what_is_too_fast_holds_when_it_is_run_slower():
    duration = 0.9
    found = safe_speeds(model_of(), line(duration), worst=False)
    limit = np.sqrt(FRICTION * 9.81 * duration**2 / PEAK)
    ((low, high),) = found.intervals
    assert low == 0
    assert high == pytest.approx(limit, rel=1e-4)
    assert found.pace.details["factor"] == pytest.approx(1 / limit, rel=1e-4)
    assert found.sentence.startswith(f"Holds at 0 to {np.floor(100 * high):g} % of full speed: at ")


@pytest.mark.parametrize("factor", [0.5, 0.8])
def test_a_liquid_at_a_part_of_the_speed_is_that_of_the_slower_motion(coffee, factor):
    """Of a motion that turns: the same instants of the one that takes 1 / factor times as long, from its own 0 s."""
    model, count = margin_model(coffee, 16), 201

    def motion(duration):
        t = np.linspace(0.0, duration, count)
        return min_jerk_line(duration, START, GOAL, exp([0.0, 0.0, 0.4]), exp([0.03, -0.05, -0.2])).sample(t)

    fast = motion(1.0)
    scaled = TimeScaled(model, replace(fast, t=fast.t + 0.3), True)
    slower = TimeScaled(model, motion(1.0 / factor), True)
    at_part, whole = scaled.margins(factor), slower.margins(1.0)
    np.testing.assert_allclose(at_part.t, whole.t, atol=1e-12)
    (spill,), (expected,) = (margins.load_verdicts(True) for margins in (at_part, whole))
    np.testing.assert_allclose(spill.slack, expected.slack, rtol=1e-9)
    assert scaled.slack(factor) == pytest.approx(slower.slack(1.0), rel=1e-9)
    assert scaled.slack(factor) != pytest.approx(scaled.slack(1.0), rel=0.05)


@pytest.mark.slow
def test_of_few_speeds_the_worst_is_found_and_each_resonance_that_fails(coffee_plan, coffee):
    """Of a plan for full speed only; at other speeds with contact as at rest and at full speed, or less."""
    tray, model = coffee_plan._tray, margin_model(coffee_plan.scenario)
    scaled, found = TimeScaled(model, tray, True), lacking_of_few(model, tray)
    assert len(found) > 1
    slacks = {factor: scaled.slack(factor) for factor in found}
    assert max(slacks.values()) < 0
    assert min(slacks, key=slacks.__getitem__) in coffee_plan.speeds.lacking
    for factor in found:
        beside = [scaled.slack(factor * change) for change in (1 / 1.04, 1.04)]
        assert slacks[factor] < min(scaled.slack(0.0), *beside)
    level = min_jerk_line(3.0, START, GOAL, np.eye(3), np.eye(3)).sample(np.linspace(0.0, 3.0, 101))
    assert lacking_of_few(margin_model(coffee), level) == ()


def test_where_a_plan_fails_at_a_speed_that_it_was_to_keep_it_is_looked_at_more_closely(coffee):
    problem = transport_problem(coffee)
    once = _with(problem, (Speed(0.3),))
    assert once.speeds == (*problem.speeds, Speed(0.3))
    assert once.nodes == ()
    again = _with(_with(once, (Speed(0.4), Speed(0.3))), (Speed(0.3),))
    assert again.speeds == (*once.speeds, Speed(0.4))
    assert len(again.nodes) == 201
    assert len(_with(again, (Speed(0.3),)).nodes) > 400


def test_below_full_speed_a_load_keeps_a_little_of_its_room_for_the_speeds_between(coffee):
    problem = transport_problem(coffee)
    s = np.linspace(0, 1, 21)
    z = np.zeros((4, 21, 7))
    z[0] = problem.start_posture
    motion, body = problem.at(s, z, 1.0), coffee.payload.first
    plain, spared = (LoadConstraint(body, Speed(0.5), spare) for spare in (0.0, 0.1))
    for one, other in zip(plain.blocks(motion), spared.blocks(motion), strict=True):
        np.testing.assert_allclose(other.values + 1, (one.values + 1) / 0.9, atol=1e-12)
    full = LoadConstraint(body, FULL_SPEED, 0.1).blocks(motion)
    for one, other in zip(LoadConstraint(body).blocks(motion), full, strict=True):
        np.testing.assert_array_equal(one.values, other.values)


def test_a_slow_motion_of_a_liquid_can_be_run_faster_until_it_fails(coffee):
    """The level line in 3 s: it keeps the coffee at the largest factor that is found, and not at the next."""
    level = min_jerk_line(3.0, START, GOAL, np.eye(3), np.eye(3)).sample(np.linspace(0.0, 3.0, 41))
    scaled = TimeScaled(margin_model(coffee, 16), level, True)
    found = safe_speeds(scaled.model, level, worst=True)
    assert 1.2 < found.fastest < 5.0
    assert scaled.slack(found.fastest) >= 0 > scaled.slack(found.fastest + 1e-3)
    assert found.pace.details["factor"] == pytest.approx(1 / found.fastest)


def test_factors_between_which_alone_it_holds_are_found():
    """Neither standing still nor at full speed: half the instants need acceleration, the others bear little."""
    angle, count = np.deg2rad(20.0), 21
    a = np.where(np.arange(count) < 10, 9.0, 8.0)
    found = safe_speeds(model_of(), tilted(20.0, -a, count), worst=False)

    def factor(friction, a):
        return np.sqrt(
            9.81 * (np.sin(angle) - friction * np.cos(angle)) / (a * (np.cos(angle) + friction * np.sin(angle)))
        )

    ((low, high),) = found.intervals
    assert low == pytest.approx(factor(FRICTION, 8.0), rel=1e-5)
    assert high == pytest.approx(factor(-FRICTION, 9.0), rel=1e-5)
    assert high < 1


# Laws ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("at_safe", "at_failing", "edge"), [(-1e-17, -1.0, 0.25), (1.0, 1e-3, 1.0)])
def test_an_edge_is_found_where_margins_of_fewer_instants_are_rounded_to_the_other_sign(at_safe, at_failing, edge):
    class Rounded(TimeScaled):
        def margin(self, squared, rate=0.0, at=slice(None)):
            alone = at_safe + (squared - 0.25) / 0.75 * (at_failing - at_safe)
            return np.array([1.0, alone if not isinstance(at, slice) else -1e-17 if squared == 1.0 else 0.0])[at]

    assert _edge(Rounded(None, None, worst=True), 0.25, 1.0) == pytest.approx(edge)


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize(
    "uncertainty", [{}, {"friction": "10%", "mass": "10%", "com": [0.004, 0.003, 0.005]}, {"contents": "any"}]
)
def test_what_holds_at_rest_and_at_full_speed_holds_at_every_factor_and_rate_between(seed, uncertainty):
    """Margins are concave in (s^2, s'): between the corners they lie above the plane through them."""
    rng = np.random.default_rng(seed)
    scaled = TimeScaled(model_of(0.5, 0.1, uncertainty), turning(rng), bool(uncertainty))
    rate = 0.3
    still, full = (np.minimum(scaled.margin(squared, rate), scaled.margin(squared, -rate)) for squared in (0.0, 1.0))
    for factor, share in rng.uniform([0.0, -1.0], 1.0, (8, 2)):
        between = scaled.margin(factor**2, share * rate)
        assert (between >= (1 - factor**2) * still + factor**2 * full - 1e-9).all()


@pytest.mark.parametrize("seed", range(6))
def test_the_margin_is_zero_at_the_edges_that_are_told_and_below_it_just_beyond(seed):
    rng = np.random.default_rng(seed)
    scaled = TimeScaled(model_of(friction=0.25), turning(rng), False)
    found = safe_speeds(scaled.model, scaled.tray, worst=False)
    for factor in rng.uniform(0, 1, 30):
        inside = any(low <= factor <= high for low, high in found.intervals)
        assert (scaled.margin(factor**2).min() >= 0) == inside


@pytest.mark.parametrize(
    ("duration", "contents"),
    [
        *((x, {}) for x in (0.5, 0.8, 2.0)),
        pytest.param(0.8, {"contents": "any", "com": [0.004, 0.003, 0.005]}, marks=pytest.mark.slow),
    ],
)
def test_few_instants_decide_the_edges_as_all_do(duration, contents):
    """Of the whole motion, which turns as well, the least margin is 0 there."""
    s = line(duration, 20 if contents else 151)
    R = exp(np.outer(np.sin(3 * s.t / duration), [0.05, 0.03, 0.2]))
    model = model_of(0.4, uncertainty={"friction": "10%", "mass": "10%", **contents})
    motion = MotionSamples(**(vars(s) | {"R_SB": R, "omega_B": s.v_S * 0.7, "alpha_B": s.a_S * 0.7}))
    share = safe_speeds(model, motion, worst=True).fastest ** 2
    scaled = TimeScaled(model, motion, True)
    assert scaled.margin(share).min() >= 0 > scaled.margin(share * (1 + 4e-6)).min()


# Stops on the path: by hand, and against the motion that such a stop makes --------------------------------------

OPTIONS = BrakingOptions(instants=6, durations=40, steps=12)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_at_constant_speed_a_level_load_needs_speed_over_friction_and_gravity_to_stop(sign):
    """0.5 m/s along y, friction 0.3: it slides if it stops in less than v / (mu g) = 0.170 s."""
    t, zero = np.linspace(0.0, 4.0, 81), np.zeros((81, 3))
    v = sign * np.array([0.0, 0.5, 0.0]) + zero
    tray = MotionSamples(
        t, np.outer(t, [0.0, 0.5 * sign, 0.0]), v, zero, np.broadcast_to(np.eye(3), (81, 3, 3)), zero, zero
    )
    found = braking(model_of(), tray, False, OPTIONS)
    needed = 0.5 / (0.3 * 9.81)
    first = found.durations[found.durations >= needed * (1 - 1e-9)][0]
    np.testing.assert_allclose(found.durations[found.margin[0] >= 0].min(), first)
    assert np.all(found.kept == (found.durations >= needed))


def test_margins_along_a_stop_are_those_of_the_motion_that_it_makes():
    """The tray begins turned, at 0.4 s, turns about all axes and speeds up, so that the worst of some stops is not
    their first instant; the stop's motion is made and differentiated."""
    turn, rates = np.array([0.3, -0.2, 0.5]), np.array([0.2, 0.3, -0.4])

    def pose(u):
        R = exp(turn) @ exp(np.outer(0.3 * np.sin(2 * u), rates))
        return np.stack([0.1 * u**5, -0.1 * u + 0.1 * np.sin(u), 0.05 * np.cos(u)], axis=1), R

    def motion(t, clock):
        h = 1e-4
        p, R = zip(*(pose(clock(t + k * h)) for k in (-1, 0, 1)), strict=True)
        one, two = log(np.swapaxes(R[0], 1, 2) @ R[1]) / h, log(np.swapaxes(R[1], 1, 2) @ R[2]) / h
        a = (p[2] - 2 * p[1] + p[0]) / h**2
        return MotionSamples(t, p[1], (p[2] - p[0]) / (2 * h), a, R[1], 0.5 * (one + two), (two - one) / h)

    tray, model = (
        motion(np.linspace(0.4, 1.9, 1501), lambda t: t - 0.4),
        model_of(0.35, 0.06, {"friction": 0.02, "com": [0.002] * 3}),
    )
    found = braking(model, tray, True, OPTIONS)
    for k, m in ((0, 25), (0, 38), (2, 30), (4, 5)):
        begin, T = 1.5 * k / OPTIONS.instants, found.durations[m]
        s = motion(np.linspace(0.0, T, OPTIONS.steps), lambda t, begin=begin, T=T: begin + t - t**2 / (2 * T))
        least = Margins(model, s.t, motion_vector(s.R_SB, s.a_S, s.omega_B, s.alpha_B)).exact_worst.min()
        assert abs(found.margin[k, m] - least) < 2e-4
    assert np.isnan(found.margin[-1, -1])
    assert np.ptp(found.margin[np.isfinite(found.margin)]) > 0.2


def test_instants_from_which_a_stop_would_outlast_the_motion_do_not_count() -> None:
    durations, none = np.array([0.1, 0.2, 0.4]), np.nan
    margin = np.array([[-0.2, 0.1, -0.1], [0.0, 0.3, none], [-0.1, none, none], [none, none, none]])
    found = Braking(durations, margin)
    np.testing.assert_allclose(found.kept, [1 / 3, 1.0, 0.0])
