"""How near liquids come to what they may do, at the worst of what is uncertain."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from salver.dynamics.liquid.sloshing import SloshingResponse
from salver.dynamics.liquid.spills import LIGHTEST
from salver.dynamics.liquid.surface import SurfaceMotion
from salver.dynamics.load_cases import VERDICT_APART, LoadCase, load_cases
from salver.dynamics.load_response import slacks
from salver.dynamics.motion_gradients import Unknowns
from salver.dynamics.payload_response import PayloadResponse
from salver.models.tray_motion import at_rest
from salver.models.uncertain.parameters import NOTHING
from salver.planning.trajopt.constraints.load_limits import LoadConstraint
from salver.planning.trajopt.problem import transport_problem, with_missed_cases
from shaken_loads import BOX, shaken


@pytest.mark.parametrize("changes", [{}, BOX], ids=["cylinder", "box"])
def test_what_a_recording_leaves_open_of_each_mode_is_added_to_waves(coffee, changes):
    """Masses that are away by at most so much: the highest surface of all their signs, in a cylinder in one
    direction. A tray that leans by more than is known raises the surface at rest too, and at the wall the free wave."""
    case = LoadCase(coffee.with_changes(**changes).payload.first, 0.05, 0.01)
    waves = SurfaceMotion.along((case,), np.linspace(0, 0.9, 7), shaken(np.linspace(0, 0.9, 7)))
    which, modes = waves.cases, waves.r.shape[2]
    rng = np.random.default_rng(5)
    away = rng.uniform(1e-4, 1e-3, (1, 7, modes, 1 if which.round else 2)) * np.ones(2)
    inclined = rng.uniform(0.0, 1e-2, (1, 7, 1)) * np.ones(2)
    found = SloshingResponse.of(waves).unsure(away, inclined)
    signs = np.array(np.meshgrid(*[[-1, 1]] * (2 * modes + 1))).reshape(2 * modes + 1, -1).T
    if which.round:
        signs = signs * np.append(np.tile([1, 0], modes), 1)  # along x alone
    tilted = signs[:, -1, None, None] * which.rest_rise[0] * inclined * (np.array([1, 0]) if which.round else 1)
    moved = np.einsum("sna,na,tna->sta", signs[:, :-1].reshape(-1, modes, 2), which.gain[0], away[0])
    np.testing.assert_allclose(found.higher[0], which.highest(np.abs(moved) + np.abs(tilted)).max(axis=0))
    np.testing.assert_allclose(found.more_left[0], which.highest(moved[:, -1]).max())
    wall = np.abs(moved).max(axis=0) + np.abs(which.half - which.rest_rise)[0] * inclined[0]
    np.testing.assert_allclose(found.freer[0], wall if not which.round else wall[:, :1] * np.ones(2))


def test_some_of_the_cases_are_what_they_are_among_all(coffee):
    """To the last digit."""
    scenario, t = coffee.with_changes(**BOX), np.linspace(0, 0.9, 31)
    cases = [LoadCase(scenario.payload.first, fill, 0.01) for fill in (0.045, 0.05, 0.055)]
    waves = SurfaceMotion.along(cases, t, shaken(t))
    assert waves.cases.wide.tolist() == [0.045] * 3  # half of its longer side
    dw = 1e-2 * np.random.default_rng(3).normal(size=(1, 31, 12, 2))
    whole = replace(SloshingResponse.compliant(waves, waves, np.zeros(0), dw), reaction=None)
    part = whole.part(slice(1, 3))
    for name in ("higher", "freer", "more_left", "crest", "free_left", "wrench"):
        assert np.array_equal(getattr(part, name), getattr(whole, name)[1:3]), name


@pytest.mark.parametrize(("push", "known"), [(4.3, True), (4.55, False)])
def test_a_surface_that_leans_by_nearly_half_the_radius_is_as_much_as_is_known(coffee, push, known):
    """Pushed ever harder, slowly, no wave runs and the surface leans by push / g; nothing else comes near an edge."""
    deep = coffee.with_changes(objects__0__liquid__fill=0.03, objects__0__uncertainty={})
    t = np.linspace(0, 12, 4001)
    w = np.tile(at_rest(), (len(t), 1))
    w[:, 0] = push * np.minimum(t / 10, 1) ** 2 * (3 - 2 * np.minimum(t / 10, 1))
    (spill,) = PayloadResponse.along(deep.payload, t, w).load_verdicts(worst=False)
    assert spill.steep[:-1].max() == pytest.approx(push / 9.81 / 0.45, rel=5e-3)
    assert (spill.steep[:-1].max() < 1) == known
    assert spill.left.min() > 0.01


def test_worst_case_bounds_waves_at_every_corner(coffee):
    """What is uncertain, as small as first order needs: no corner is higher, and some corner nearly is."""
    case, t = LoadCase(coffee.payload.first, 0.05, 0.01), np.linspace(0, 0.9, 101)
    dw = 1e-3 * np.random.default_rng(3).normal(size=(12, 3)) * np.cos(np.outer(t, [2, 5, 9]))[:, None, :]
    waves = SurfaceMotion.along((case,), t, shaken(t))
    here = SloshingResponse.compliant(waves, waves, np.zeros(0), dw[None])
    corners = np.array(np.meshgrid(*[[-1, 1]] * 3)).reshape(3, -1).T
    crests = np.array([SurfaceMotion.along((case,), t, shaken(t) + dw @ corner).crest[0] for corner in corners]).max(
        axis=0
    )
    assert (crests < here.crest[0] + 2e-6).all()
    assert (here.crest[0] - crests < 0.5 * (here.crest - here.modes.crest) + 1e-6).any()


def test_a_fill_that_was_left_out_is_found_and_added(coffee):
    problem = transport_problem(coffee)
    only = tuple(tuple(case for case in each if case.value < 0.04) for each in problem.cases)
    problem = replace(problem, cases=only)
    s, q = np.linspace(0, 1, 101), problem.start_posture
    swept = np.stack([[0.35, 0.25, 0.0, 0.15, 0.0, 0.1, 0.0]] * 101) * (s**3 * (10 - 15 * s + 6 * s**2))[:, None]
    shares = (s**2 * (30 - 60 * s + 30 * s**2), s * (60 - 180 * s + 120 * s**2), 60 - 360 * s + 360 * s**2)
    duration = 0.7
    rates = [swept[-1] * x[:, None] / duration**k for k, x in enumerate(shares, start=1)]
    motion = problem.at(s, np.stack([q + swept, *rates]), duration, imposed=False)
    more = with_missed_cases(problem, motion)
    assert more is not None
    assert max(case.value for case in more.cases[0]) == pytest.approx(0.065)
    assert with_missed_cases(more, motion) is None
    slowly = replace(motion, z=motion.z / (4.0 ** np.arange(4))[:, None, None], duration=4.0 * duration)
    assert with_missed_cases(problem, slowly) is None
    verdict = load_cases(coffee.payload.first, problem.payload.uncertain, VERDICT_APART)
    near = with_missed_cases(problem, slowly, 1.0)  # no case has more left than the whole of its room
    assert {(case.value, case.damping) for case in near.cases[0]} >= {(case.value, case.damping) for case in verdict}
    assert with_missed_cases(near, slowly, 1.0) is None
    (brim,) = (constraint for constraint in more.constraints if isinstance(constraint, LoadConstraint))
    for block in brim.blocks(motion):
        assert block.points.tolist() == ([100] if "left" in block.name or "settled" in block.name else [*range(101)])


def test_every_fill_in_the_range_is_covered_by_the_cases(coffee):
    """61 fills, the waves at none more than 3 % of the room above the highest of the cases that a verdict looks at."""
    payload, t = coffee.payload, np.linspace(0, 0.8, 301)
    w = 0.6 * (shaken(t) - at_rest()) + at_rest()
    body = payload.first
    whole = PayloadResponse.along(payload, t, w)
    assert whole is not None
    least = SloshingResponse.verdict(body.name, whole.worst[body.name]).slack.min()
    for fill in np.linspace(0.035, 0.065, 31):
        for damping in np.linspace(*body.inner.damping, 3):
            waves = SurfaceMotion.along((LoadCase(body, float(fill), float(damping)),), t, w)
            assert 1 - waves.crest.max() / waves.cases.room[0] > least - 0.03


def test_a_wave_that_must_have_settled_takes_what_is_missing_of_the_last_slack(coffee):
    """A twentieth more is allowed than is left after half a second: of that, less than a twentieth is to spare."""
    t, name = np.linspace(0, 0.8, 301), coffee.payload.first.name
    w = 0.3 * (shaken(t) - at_rest()) + at_rest()

    def spill(**demand):
        case = coffee.with_changes(**{f"objects__0__liquid__{key}": value for key, value in demand.items()})
        parts = PayloadResponse.along(case.payload, t, w).worst[name]
        return SloshingResponse.verdict(name, parts), max(float(part.left(0.5).max()) for part in parts)

    free, left = spill()
    found, _ = spill(settled_wave=1.05 * left, settled_within=0.5)
    assert free.slack[-1] > 0.1
    assert found.settled == pytest.approx(0.05 * left, rel=1e-6)
    assert found.slack[-1] == pytest.approx(0.05 / 1.05, rel=1e-6)


def test_on_a_tray_that_leans_the_surface_stands_higher_and_that_is_no_wave_that_must_settle(coffee):
    """At 10 degrees by tan(10) of the radius; of that a little is allowed for waves that drift, in proportion to its
    cube."""
    body, lean, t = coffee.payload.first, np.deg2rad(10.0), np.linspace(0, 0.5, 101)
    w = np.tile(at_rest(), (len(t), 1))
    w[:, 0], w[:, 2] = 9.81 * np.sin(lean), 9.81 * np.cos(lean)
    found = SloshingResponse.of(SurfaceMotion.along((LoadCase(body, 0.05, 0.02),), t, w))
    stands, over = body.inner.inside.half(0.05)[0] * np.tan(lean), found.left(0.0)[0]
    assert over < 0.1 * stands
    assert found.left()[0] - over == pytest.approx(stands, rel=1e-3)


@pytest.mark.parametrize("wanted", [{}, {"settled_wave": 0.05, "settled_within": 0.5}])
def test_the_last_slack_is_that_of_what_comes_afterwards(coffee, wanted):
    """At two seconds on a tray at rest. At the low fill waves are too steep first, at the high one they spill first."""
    body = coffee.with_changes(**{f"objects__0__liquid__{key}": value for key, value in wanted.items()}).payload.first
    t = np.linspace(0, 2.8, 1051)
    moving = t < 0.8 + 1e-9
    w = np.tile(at_rest(), (len(t), 1))
    w[moving] += 0.8 * (shaken(t[moving]) - at_rest())
    pair = (LoadCase(body, 0.035, 0.01), LoadCase(body, 0.07, 0.01))
    during, all_along = (
        SloshingResponse.of(SurfaceMotion.along(pair, t[moving], w[moving])),
        SloshingResponse.of(SurfaceMotion.along(pair, t, w)),
    )
    slack, room = slacks(during), np.array([0.044, 0.009])[:, None]  # to 1 mm below the brim
    shares = np.array([all_along.crest / room, all_along.free_height / 0.012, all_along.lightness / LIGHTEST])
    assert slack[:, :-1] == pytest.approx(1 - shares.max(axis=0)[:, : moving.sum() - 1])
    later = shares[:, :, moving.sum() :].max(axis=2)
    assert later[1, 0] > later[0, 0]
    assert later[0, 1] > later[1, 1]
    assert np.all(slack[:, -1] <= 1 - later.max(axis=0))
    assert 1 - slack[0, -1] < 1.1 * later[1, 0]  # of one mode mostly, and of damping by 0.01
    assert slack[1, -2] - slack[1, -1] > 0.1


def test_a_lid_keeps_the_liquid_in_and_its_force(coffee):
    sealed = coffee.with_changes(objects__0__liquid__sealed=True)
    t = np.linspace(0, 0.8, 201)
    whole = PayloadResponse.along(sealed.payload, t, shaken(t))
    assert whole is not None
    spill = whole.load_verdicts(True)[0]
    assert np.isinf(spill.left).all()
    assert np.abs(whole.nominal["cup"][0].wrench).max() > 0.1


def test_instants_of_some_instants_are_those_of_the_motion(coffee):
    t = np.linspace(0, 0.9, 31)
    liquids = PayloadResponse.along(coffee.payload, t, shaken(t))
    twice = liquids.at(np.arange(10, 20)).at(np.array([2, 5]))
    for (found,), (whole,) in zip(twice.nominal.values(), liquids.nominal.values(), strict=True):
        np.testing.assert_array_equal(found.wrench, whole.wrench[:, [12, 15]])
    for (known,) in twice.only(coffee.payload.nominal).worst.values():  # with nothing uncertain, one case
        assert len(known.wrench) == 1 < len(twice.worst[coffee.payload.first.name][0].wrench)


def test_the_slope_of_a_wave_that_must_settle_is_of_when_it_must(coffee):
    still = coffee.with_changes(objects__0__liquid__settled_wave=2e-3, objects__0__liquid__settled_within=4.0)
    t, case = np.linspace(0, 0.9, 101), load_cases(still.payload.dynamic[0], NOTHING)
    dw = np.zeros((101, 12))
    dw[:, 0] = np.sin(2 * np.pi * t / 0.9)  # nothing at the end, whose posture is taken as given
    part, less, more = (
        SloshingResponse.of(SurfaceMotion.along(case, t, shaken(t) + step * dw)) for step in (0.0, -1e-4, 1e-4)
    )
    (limit,) = (each for each in part.limits() if each.name == "settled waves")
    slope = limit.by(np.array([0]), np.array([100]), Unknowns(dw[:, :, None]))[0, 0]
    assert slope == pytest.approx((more.left(4.0) - less.left(4.0))[0] / 2e-4, rel=1e-2)


def test_room_of_a_verdict_is_what_is_left_under_the_brim(coffee) -> None:
    """In mm in `salver plan`: of a cup at rest all of it, the brim less the fill."""
    t = np.linspace(0, 1, 21)
    waves = SurfaceMotion.along((LoadCase(coffee.payload.first, 0.05, 0.01),), t, np.tile(at_rest(), (len(t), 1)))
    inner = coffee.payload.first.inner
    assert SloshingResponse.verdict("cup", (SloshingResponse.of(waves),)).room == pytest.approx(inner.room(0.05))
