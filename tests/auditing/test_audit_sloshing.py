"""What a recording does not say of waves, and what an audit then says."""

from dataclasses import fields, replace

import numpy as np
import pytest
from scipy.integrate import cumulative_trapezoid

import recorded_motions
import salver as sv
from potential_flow import cylinder, simulate
from recorded_motions import HEADER, write_csv
from salver.auditing import Audit, audit
from salver.auditing.motion import AuditedMotion, tray_motion
from salver.auditing.sloshing import _gain, softened, unseen
from salver.dynamics.liquid.sloshing import SloshingResponse
from salver.dynamics.liquid.surface import SurfaceMotion
from salver.dynamics.load_cases import LoadCase
from salver.geometry import quat_wxyz_from_matrix
from salver.models.tray_motion import at_rest
from salver.motion_files.samples import TraySamples
from salver.trajectory import MotionSamples


@pytest.fixture(scope="module")
def cup():
    return sv.load_scenario("panda-coffee").with_changes(objects__0__friction=2.0)


def line(duration, noise=0.0, rate=800.0):
    """A level line over 0.48 m, with rest before and after."""
    t = np.arange(round((duration + 0.4) * rate) + 1) / rate
    u = np.clip((t - 0.2) / duration, 0, 1)
    p = np.array([0.5, 0.0, 0.4]) + np.outer(0.48 * u**3 * (10 - 15 * u + 6 * u**2), [0.0, 1.0, 0.0])
    p += noise * np.random.default_rng(0).standard_normal(p.shape)
    return t, p, np.tile(quat_wxyz_from_matrix(np.eye(3)), (len(t), 1))


@pytest.mark.parametrize(
    ("duration", "noise", "outcome"),
    [
        pytest.param(2.2, 0.0, "holds", marks=pytest.mark.slow),
        (1.0, 0.0, "does_not_hold"),
        (2.2, 1e-6, "holds"),
        pytest.param(2.2, 2e-3, "cannot_tell", marks=pytest.mark.slow),
    ],
)
def test_a_recorded_line_is_dry_or_spills_or_is_seen_too_badly(cup, tmp_path, duration, noise, outcome):
    found = audit(write_csv(tmp_path / "line.csv", HEADER, *line(duration, noise)), cup)
    assert found.outcome == outcome, (found.nominal.sentence, found.worst.sentence)
    if noise == 2e-3:
        assert "sloshing" in found.worst.details["reasons"] or "noise" in found.worst.details["reasons"]


@pytest.mark.parametrize("square", [False, True])
def test_a_shake_that_noise_hides_raises_no_wave_by_more_than_is_allowed_for(cup, square):
    """Shakes of every frequency, as large as would just be found, begun anywhere: against the filters themselves. In a
    box waves along both sides add up."""
    t, p, quat = line(1.2, noise=1e-4)
    motion = tray_motion(TraySamples(t, p, quat, "line", ()), None)
    box = {"objects__0__shape": {"type": "box", "size": [0.09, 0.07, 0.085]}}
    box |= {"objects__0__liquid": {"kind": "water", "size": [0.08, 0.06], "fill": 0.05, "brim": 0.08}}
    body = (cup.with_changes(**box) if square else cup).payload.first
    case, t = LoadCase(body, 0.05, 0.0), motion.samples.t
    w = np.tile(at_rest(), (len(t), 1))
    part = SloshingResponse.of(SurfaceMotion.along((case,), t, w))
    most, _ = unseen("cup", (part,), motion)
    noise = motion.recording.sensor.displacement
    for frequency in (1.0, 3.0, 3.35, 4.0, 5.76, 8.0):
        shaken = w.copy()
        amplitude = 7 * noise * np.sqrt(2 * frequency / (800 * frequency * np.ptp(t)))
        shake = amplitude * (2 * np.pi * frequency) ** 2 * np.sin(2 * np.pi * frequency * t)
        shaken[:, :2] += np.outer(shake, [1.0, float(square)])
        waves = SurfaceMotion.along((case,), t, shaken)
        assert np.all(waves.crest <= most.size), frequency
    assert np.median(most.size) < 0.5 * case.dynamics.room(case.value)  # and it is no empty statement


@pytest.mark.parametrize(("first", "last"), [(0, None), (0, -60), (60, None)])
def test_how_a_liquid_moves_where_the_motion_begins_moving_is_not_known(cup, first, last):
    """What moves at its end alone says all that came before."""
    s = recorded_motions.line(3.0, 100.0)
    cut = MotionSamples(*(getattr(s, field.name)[first:last] for field in fields(s)))
    found = Audit(cup, "motion", AuditedMotion(cut))
    begun = first > 0
    for status in (found.nominal, found.worst):
        assert status.details.get("reasons", []) == ["begun"] * begun
        assert ("how what is inside moves then is not known" in status.sentence) == begun
    assert found.outcome == ("cannot_tell" if begun else "holds")


def test_what_is_missed_of_a_jolt_is_as_fast_as_the_jolt(cup):
    """Acceleration that goes up and down by 3 m/s^2 within 40 ms, read at 1 kHz: a spline as fast as that falls short
    of it by a quarter. At the 12 Hz with which the rest is read that would move a mass by millimetres."""
    t, p, quat = line(1.2, rate=1000.0)
    fine = np.arange(0, t[-1], 1e-5)
    ramps = [np.clip(1 - np.abs(fine - at) / 0.01, 0, None) for at in (0.7, 0.72)]
    speed = cumulative_trapezoid(3.0 * (ramps[0] - ramps[1]), fine, initial=0.0)
    p[:, 0] += np.interp(t, fine, cumulative_trapezoid(speed, fine, initial=0.0))
    motion = tray_motion(TraySamples(t, p, quat, "line", ()), None)
    assert motion.missed.max() > 0.5
    t = motion.samples.t
    part = SloshingResponse.of(
        SurfaceMotion.along((LoadCase(cup.payload.first, 0.05, 0.0),), t, np.tile(at_rest(), (len(t), 1)))
    )
    most, _ = unseen("cup", (part,), motion)
    assert 0.0 < (most.size - part.crest).max() < 1e-4  # m


@pytest.mark.parametrize("ratio", [0.3, 0.9, 1.0, 1.1, 4.0])
@pytest.mark.parametrize("cycles", [1, 5, 20])
def test_a_mass_moves_by_no_more_than_its_gain(ratio, cycles):
    """A shake that swells and fades, x'' + x = -a'': x + a is the convolution of sin with a."""
    t = np.linspace(0, 2 * np.pi * cycles / ratio, 20000)
    a = np.sin(np.pi * t / t[-1]) ** 2 * np.sin(ratio * t)
    sine, cosine = (cumulative_trapezoid(f(t) * a, t, initial=0.0) for f in (np.sin, np.cos))
    x = np.sin(t) * cosine - np.cos(t) * sine - a
    assert np.abs(x).max() <= _gain(ratio, np.array(1.0), cycles)


def test_what_is_kept_is_told_of_each_thing_that_is_allowed(cup):
    """Of a wave that is far from the brim but nearly too steep, of one that is not, and of a cup that falls."""
    t, body = np.linspace(0, 0.9, 301), cup.payload.first
    shaken = np.tile(at_rest(), (len(t), 1))
    shaken[:, 0] = np.sin(20.0 * t) * np.sin(np.pi * t / 0.9) ** 2
    falling = np.tile(at_rest(), (len(t), 1))
    falling[:, 2] -= 7.0 * np.sin(np.pi * t / 0.9) ** 2
    for fill, w, least in (
        (0.035, shaken, "the steepness to which they are known"),
        (0.075, shaken, "what they may reach"),
        (0.05, falling, "the weight that may be taken away"),
    ):
        spill = SloshingResponse.verdict(
            "cup", (SloshingResponse.of(SurfaceMotion.along((LoadCase(body, fill, 0.01),), t, w)),)
        )
        kept = spill.kept
        assert min(kept, key=kept.get) == least
        assert min(kept.values()) == spill.slack.min()


@pytest.mark.parametrize(
    ("share", "code"),
    [
        (0.95, "cannot_tell"),
        *(pytest.param(*x, marks=pytest.mark.slow) for x in ((1.05, "holds"), (0.93, "cannot_tell"))),
    ],
)
def test_a_cup_that_is_shaken_near_its_frequency_gives_no_verdict(cup, share, code):
    """Linear waves of 12 to 17 mm of 20. Above resonance what is softer is further from it; below it runs away."""
    cup = cup.with_changes(objects__0__liquid__fill=0.06)
    omega = float(cup.payload.first.inner.modes(cup.payload.first.inner.fill).omega[0, 0])
    t = np.arange(2000) / 400
    size = 0.25 * abs(1 / share**2 - 1) * np.clip(np.minimum(t, t[-1] - t) / 1.5, 0, 1)  # of g
    a = 9.81 * size * np.sin(share * omega * t)
    speed = cumulative_trapezoid(a, t, initial=0.0)
    zero, still = np.zeros((len(t), 3)), np.tile(np.eye(3), (len(t), 1, 1))
    along_x = np.outer(a, [1.0, 0.0, 0.0])
    samples = MotionSamples(t, zero, np.outer(speed, [1.0, 0.0, 0.0]), along_x, still, zero, zero)
    said = Audit(cup, "motion", AuditedMotion(samples)).nominal
    assert said.code == code, said.sentence
    if code == "cannot_tell":
        assert said.details["reasons"] == ["resonance"]
        assert "swirl" in said.sentence


@pytest.mark.parametrize(
    ("push", "duration", "most"),
    [
        (lambda t, omega: 2.2 * np.sin(2 * np.pi * t / 0.8) * (t < 0.8), 0.8, 1.12),
        (lambda t, omega: 0.5 * np.clip(np.minimum(t, 2.0 - t), 0.0, 0.5) * np.sin(0.93 * omega * t), 2.0, 1.15),
    ],
    ids=["quick line", "shake"],
)
def test_waves_that_are_slower_as_they_are_high_cover_nonlinear_potential_flow(cup, push, duration, most):
    """Crests of 13 and 14 mm in a cup of 40 mm radius: neither lower than the flow nor far above it."""
    case, t = LoadCase(cup.payload.first, 0.05, 0.01), np.arange(0.0, duration, 0.00125)
    omega, w = float(case.modes.omega[0, 0]), np.tile(at_rest(), (len(t), 1))
    w[:, 0] = push(t, omega)
    waves = SurfaceMotion.along((case,), t, w)
    at = np.arange(0.0, duration, 0.003)
    flow = simulate(cylinder(0.04), 0.05, lambda x: (float(push(np.array(x), omega)), 9.81), at, case.damping).max()
    assert 0.98 * flow < waves.crest.max() * softened(waves, 0.3)[0] < most * flow


def shaken(cup, step, size):
    """The waves of a shake just below resonance that swells to a share of g and fades."""
    case, t = LoadCase(cup.payload.first, 0.05, 0.01), np.arange(0.0, 2.0, step)
    w = np.tile(at_rest(), (len(t), 1))
    w[:, 0] = size * np.clip(np.minimum(t, 2.0 - t), 0.0, 0.5) * np.sin(0.93 * float(case.modes.omega[0, 0]) * t)
    return SurfaceMotion.along((case,), t, w)


@pytest.mark.parametrize("step", [0.02, 0.03])
def test_how_much_slower_a_high_wave_is_does_not_depend_on_the_instants_that_are_recorded(cup, step):
    fine, coarse = (softened(shaken(cup, dt, 0.5), 0.3)[0] for dt in (3e-4, step))
    assert coarse == pytest.approx(fine, rel=4e-3)  # it is 1.05


def test_a_wave_that_is_so_high_that_its_frequency_would_be_negative_has_a_height(cup):
    assert 1.0 < softened(shaken(cup, 0.01, 50.0), 0.3)[0] < 2.0


def jolted(rate, peak=0.9, half=0.5):
    """A level line that accelerates at once, for half of its time, and brakes at once; without rest before or after."""
    t = np.arange(round(2 * half * rate) + 1) / rate
    late = np.maximum(t - half, 0.0)
    way = 0.5 * peak * t**2 - peak * late**2
    p = np.array([0.5, 0.0, 0.4]) + np.outer(way, [0.0, 1.0, 0.0])
    return t, p, np.tile(quat_wxyz_from_matrix(np.eye(3)), (len(t), 1))


@pytest.mark.parametrize("rate", [100.0, 200.0, 1000.0])
def test_of_a_recording_that_begins_and_ends_in_a_jolt_the_truth_is_within_what_is_said(cup, rate):
    """Against the waves of the acceleration that it had, which its outermost samples do not show."""
    t, p, quat = jolted(rate)
    found = audit(
        {
            "t": t,
            **dict(zip(("x", "y", "z"), p.T, strict=True)),
            **dict(zip(("qw", "qx", "qy", "qz"), quat.T, strict=True)),
        },
        cup,
    )
    read, (most, _) = found._loads.nominal["cup"], found._inner[False]["cup"]
    known, fine = SloshingResponse.verdict("cup", read), np.linspace(0.0, t[-1], 2001)
    w = np.tile(at_rest(), (len(fine), 1))
    w[1:, 1] += np.where(fine[1:] < 0.5, 0.9, -0.9)  # until then the surface is level
    truth = SurfaceMotion.along(read[0].modes.cases.each, fine, w).crest.max(axis=0)
    said, allowed = (np.interp(fine, x.t, x.size) for x in (known, most))
    inner = np.min(np.abs(fine[:, None] - [0.0, 0.5, t[-1]]), axis=1) > 5 / rate
    assert np.all(np.abs(truth - said)[inner] <= (allowed - said)[inner] + 1e-4)
    assert np.median(allowed - said) < 0.1 * known.size.max() or rate == 100.0  # and it is no empty statement


def test_what_a_liquid_does_after_a_recording_that_ends_moving_is_not_known(cup):
    """It would spill only if the tray stopped as the last sample has it."""
    t, p, quat = jolted(500.0)
    keep = slice(0, -12)
    columns = {"t": t[keep], **dict(zip(("x", "y", "z"), p[keep].T, strict=True))}
    columns |= dict(zip(("qw", "qx", "qy", "qz"), quat[keep].T, strict=True))
    found = audit(columns, cup)
    told = SloshingResponse.verdict("cup", found._loads.nominal["cup"]).slack
    assert told[:-1].min() > 0
    assert found.outcome == "cannot_tell"
    assert "ended" in found.worst.details["reasons"]


@pytest.mark.parametrize("which", ["v_S", "omega_B"])
@pytest.mark.parametrize(
    ("moving", "rests"), [(0, [False, True]), (1, [True, True]), (-2, [True, True]), (-1, [True, False])]
)
def test_whether_the_tray_rests_at_an_end_is_told_by_its_outermost_sample(cup, which, moving, rests):
    t = np.linspace(0.0, 1.0, 101)
    found = audit(
        {"t": t, "x": 0 * t, "y": 0 * t, "z": 0.4 + 0 * t, "qw": 1 + 0 * t} | dict.fromkeys(("qx", "qy", "qz"), 0 * t),
        cup,
    )
    speed = np.zeros((len(found.motion.samples.t), 3))
    speed[moving, 1] = -2e-3
    motion = replace(found.motion, samples=replace(found.motion.samples, **{which: speed}))
    assert list(replace(found, motion=motion)._resting()) == rests


@pytest.mark.slow
def test_where_waves_may_push_otherwise_too_much_friction_by_a_little_is_not_certain(cup):
    """What they push is known no better than they are."""
    t, p, quat = jolted(100.0)
    columns = {"t": t, **dict(zip(("x", "y", "z"), p.T, strict=True))}
    columns |= dict(zip(("qw", "qx", "qy", "qz"), quat.T, strict=True))
    needed = float(audit(columns, cup).margins.interfaces[0].friction_needed.max())
    for share, code in ((0.98, "cannot_tell"), (0.5, "slides")):
        found = audit(columns, cup.with_changes(objects__0__friction=share * needed))
        assert found.nominal.code == code, found.nominal.sentence


def test_acceleration_that_grows_from_rest_within_the_outermost_samples_raises_no_wave_that_was_not_there(cup):
    """At 90 m/s^3, for the two samples in which a recording does not show it."""
    fine = np.arange(20001) / 20000
    force = 0.9 * np.clip(fine / 0.01, 0, 1) * np.cos(np.pi * fine)
    way = cumulative_trapezoid(cumulative_trapezoid(force, fine, initial=0), fine, initial=0)
    t, y = fine[::100], way[::100]
    pose = {"x": 0.5 + 0 * t, "y": y, "z": 0.4 + 0 * t, "qw": 1 + 0 * t, "qx": 0 * t, "qy": 0 * t, "qz": 0 * t}
    read = audit({"t": t, **pose}, cup)._loads.nominal["cup"]
    w = np.tile(at_rest(), (len(fine), 1))
    w[:, 1] += force
    truth = SurfaceMotion.along(read[0].modes.cases.each, fine[::20], w[::20]).crest.max(axis=0)
    some = (fine[::20] > 0.02) & (fine[::20] < 0.4)
    known = SloshingResponse.verdict("cup", read)
    assert np.abs(truth - np.interp(fine[::20], known.t, known.size))[some].max() < 1.5e-4


@pytest.mark.parametrize(("noise", "code"), [(0.0, "spills"), (1e-6, "cannot_tell")])
def test_waves_that_come_too_high_after_a_recording_that_ends_at_rest_are_known_up_to_its_noise(cup, noise, code):
    """It speeds up gently and brakes in 0.15 s; the waves are highest when the tray stands still again."""
    brake, peak, rate = 0.15, 2.48, 400.0
    turn = 0.2 + 6 * brake
    t = np.arange(0.0, turn + brake + 0.004, 1 / rate)
    gentle = np.where((t > 0.2) & (t < turn), peak / 6 * np.sin(np.pi * (t - 0.2) / (6 * brake)) ** 2, 0.0)
    hard = np.where((t >= turn) & (t < turn + brake), peak * np.sin(np.pi * (t - turn) / brake) ** 2, 0.0)
    y = np.cumsum(np.cumsum(gentle - hard)) / rate**2 + noise * np.random.default_rng(0).standard_normal(len(t))
    still = 0 * t
    columns = {"t": t, "x": 0.5 + still, "y": y, "z": 0.4 + still, "qw": 1 + still}
    found = audit(columns | dict.fromkeys(("qx", "qy", "qz"), still), cup)
    slack = SloshingResponse.verdict("cup", found._loads.nominal["cup"]).slack
    assert slack[:-1].min() > 0 > slack[-1]
    assert found.nominal.code == code, found.nominal.sentence
    assert "ended" not in found.nominal.details.get("reasons", {})
