"""What loggers, sensors and software make of a recording: named with its size, removed where that is sound."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import signal

import salver as sv
from salver import scenario as scenarios
from salver.auditing import AuditOptions, audit
from salver.auditing.defects import channels_of, repaired
from salver.auditing.noise import dead_band, filtered_at
from salver.auditing.options import DEFAULT
from salver.geometry import continuous, quat_wxyz_from_matrix
from salver.models.arm.arm import load_arm
from salver.motion_files.samples import TraySamples

CUBE = scenarios.load("panda-cube")
RATE = 500.0
T = np.arange(1001) / RATE


def truth(t, shake=0.0):
    """Half a metre in 1.6 s, at rest before and after: 1.13 m/s^2 of the 4.905 there are. shake: m, of 18 Hz."""
    u = np.clip((t - 0.2) / 1.6, 0, 1)
    y = 0.5 * u**3 * (10 - 15 * u + 6 * u**2) + shake * np.sin(2 * np.pi * 18 * t)
    return np.stack([0.5 + 0 * t, y, 0.4 + 0 * t], axis=1)


def seen(p, t=T, noise=2e-5):
    p = p + noise * np.random.default_rng(3).standard_normal(p.shape)
    return TraySamples(t, p, np.tile([1.0, 0, 0, 0], (len(t), 1)), "by hand")


def found(p, t=T, noise=2e-5):
    return repaired(channels_of(seen(p, t, noise)), DEFAULT)


def judged(p, t=T, noise=2e-5, case=CUBE):
    s = seen(p, t, noise)
    return audit({"t": t, **dict(zip("xyz", s.p.T, strict=True)), "qw": 1 + 0 * t, "qx": 0 * t, "qy": 0 * t,
                  "qz": 0 * t}, case)  # fmt: skip


def codes(channels):
    return [defect.code for defect in channels.defects]


@pytest.mark.parametrize("noise", [0.0, 1e-6, 2e-5])
def test_nothing_is_found_in_a_clean_recording(noise):
    clean = found(truth(T), noise=noise)
    assert codes(clean) == []
    assert filtered_at(clean.t, clean.y[:, :3], DEFAULT.drop, DEFAULT.fewest) == np.inf
    assert np.array_equal(clean.t, T)


def test_stamps_that_jitter_are_replaced_by_even_ones():
    stamps = T + 3e-4 * np.random.default_rng(1).standard_normal(len(T)).clip(-2, 2)
    even = found(truth(T), stamps)
    (defect,) = even.defects
    assert "time stamps jitter by 0.2" in defect.clause  # 0.26: of a normal distribution that ends at two of its own
    # A grid is known to its phase and period from a thousand stamps: 0.3 ms / sqrt(1000), to four of it.
    assert np.abs(even.t - T).max() < 4e-5
    assert judged(truth(T), stamps).outcome == "holds"


def test_times_that_are_uneven_and_right_are_kept():
    uneven = T + 3e-4 * np.random.default_rng(1).standard_normal(len(T)).clip(-2, 2)
    assert codes(found(truth(uneven), uneven)) == []


def test_samples_that_come_in_pairs_keep_their_times():
    """The median of the steps is then none of them."""
    pairs = np.sort(np.concatenate([T[::10], T[1::10]]))
    assert codes(found(truth(pairs), pairs)) == []


@pytest.mark.parametrize("each", [2, 5])
def test_held_samples_are_taken_once(each):
    p = np.repeat(seen(truth(T[::each])).p, each, axis=0)[: len(T)]
    held = found(p, noise=0.0)
    assert f"{each} at a time are alike, and {RATE / each:.3g} a second are new" in held.defects[0].clause
    assert np.array_equal(held.t, T[::each])
    assert judged(p, noise=0.0).outcome == "holds"


def test_frames_of_another_rate_keep_the_time_that_the_motion_takes():
    """Each is held for two or three samples, and for long ones at rest: with those a motion that needs a third of the
    friction seemed to take half the time, by stamps that jitter by 60 ms."""
    u = np.clip((np.floor(T * 220) / 220 - 0.8) / 0.3, 0, 1)
    p = np.stack([0.5 + 0 * T, 0.03 * u**3 * (10 - 15 * u + 6 * u**2), 0.4 + 0 * T], axis=1)
    seen_once = found(p, noise=0.0)
    assert codes(seen_once) == ["stale", "clock"]
    moving = (u > 0.1) & (u < 0.9)
    late = np.interp(p[moving, 1], seen_once.y[:, 1], seen_once.t) - np.floor(T[moving] * 220) / 220
    assert np.ptp(late) < 5e-3  # of 240 ms; a frame takes 4.5 ms
    assert judged(p, noise=0.0).outcome == "holds"


@pytest.mark.parametrize(("late", "at", "phase"), [(0.012, 0.9, 0.003), (0.02, 0.5, 0.0), (0.03, 1.1, 0.003)])
def test_frames_after_a_late_one_keep_their_times(late, at, phase):
    """A camera's 90 a second in a log of 500, one of them late: those after it were put up to three frames later, and
    a motion that needs a quarter of the friction did not hold."""
    taken = np.arange(181) / 90
    shown = taken + phase
    shown[round(at * 90)] += late
    latest = np.searchsorted(np.maximum.accumulate(shown), T + 1e-12, side="right") - 1
    p = (truth(taken) + 5e-5 * np.random.default_rng(0).standard_normal((181, 3)))[np.maximum(latest, 0)]
    once = found(p, noise=0.0)
    fine = np.linspace(0, 2, 20001)
    moving = (once.y[:, 1] > 0.02) & (once.y[:, 1] < 0.48)
    away = once.t[moving] - np.interp(once.y[moving, 1], truth(fine)[:, 1], fine)
    assert np.ptp(away) < 1.5e-3  # the noise is 0.4 ms of the speed there; a frame takes 11 ms
    assert judged(p, noise=0.0).outcome != "does_not_hold"


def test_samples_that_are_missing_leave_a_gap_where_stamps_are_whole_milliseconds():
    """90 a second of which 15 % are lost: the median step is 11 ms, and a grid of it ends two frames too soon."""
    rng, taken = np.random.default_rng(0), np.arange(181) / 90
    kept = rng.random(181) > 0.15
    p = truth(taken)[kept] + 2e-5 * rng.standard_normal((kept.sum(), 3))
    even = found(p, np.round(taken[kept], 3), noise=0.0)
    assert codes(even) == ["clock"]
    fine = np.linspace(0, 2, 20001)
    moving = (even.y[:, 1] > 0.02) & (even.y[:, 1] < 0.48)
    away = even.t[moving] - np.interp(even.y[moving, 1], truth(fine)[:, 1], fine)
    assert np.ptp(away) < 1e-3


def test_stale_samples_are_left_out():
    p, stale = seen(truth(T)).p, np.array([250, 300, 301, 555, 720])
    for k in stale:
        p[k] = p[k - 1]
    left = found(p, noise=0.0)
    assert "0.5 % of the samples (5) repeat the one before" in left.defects[0].clause
    assert np.array_equal(np.flatnonzero(~np.isin(T, left.t)), stale)
    assert judged(p, noise=0.0).outcome == "holds"


def test_a_spike_is_left_out_also_where_the_clock_is_uneven():
    t = T + 4e-4 * np.random.default_rng(1).uniform(-1, 1, len(T))
    p = truth(t)
    p[437] += [0.0, 0.01, 0.0]
    (defect,) = found(p, t).defects
    assert defect.code == "spike"
    assert f"{t[437]:.3f} s lies 10 mm off" in defect.clause or f"{t[437]:.3f} s lies 9.9" in defect.clause
    assert judged(p, t).nominal.details["reasons"] == ["spike"]


@pytest.mark.parametrize(("spikes", "outcome"), [([437], "does_not_hold"), ([437, 611], "cannot_tell")])
def test_only_a_defect_that_repeats_could_explain_a_violation(spikes, outcome):
    p = truth(T, shake=2e-3)  # 25.6 m/s^2
    p[spikes] += [0.0, 0.05, 0.0]
    assert codes(found(p)) == ["spike"]
    assert judged(p).outcome == outcome


def test_a_jump_is_taken_back_and_said():
    p = truth(T)
    p[500:] += [0.003, 0.0, -0.004]
    mended = found(p)
    assert "the position jumps by 5" in mended.defects[0].clause
    # It is known as well as a cubic through four samples with noise of 0.02 mm.
    assert np.abs(mended.y[:, :3] - truth(T)).max() < 2e-4
    assert judged(p).nominal.details["reasons"] == ["jump"]


def test_many_samples_that_are_missing_are_not_taken_for_a_violation():
    keep = np.random.default_rng(2).random(len(T)) > 0.03
    t = T[: keep.sum()]
    assert "jump" in codes(found(truth(T)[keep], t, noise=1e-6))
    assert judged(truth(T)[keep], t, noise=1e-6).outcome == "cannot_tell"


@pytest.mark.parametrize("cut", [5.0, 12.0])
@pytest.mark.parametrize("causal", [False, True])
def test_a_filter_is_told_from_where_the_noise_ends(cut, causal):
    """A shake of 18 Hz that needs three times the friction there is, and that the filter takes away."""
    sos = signal.butter(4, cut, fs=RATE, output="sos")
    raw = seen(truth(T, shake=3 * 4.905 / (2 * np.pi * 18) ** 2)).p
    p = signal.sosfilt(sos, raw - raw[0], axis=0) + raw[0] if causal else signal.sosfiltfilt(sos, raw, axis=0)
    assert cut / 2 < filtered_at(T, p, DEFAULT.drop, DEFAULT.fewest) < 2 * cut
    verdict = judged(p, noise=0.0)
    assert verdict.outcome == "cannot_tell" or (verdict.outcome == "does_not_hold" and cut > 10)
    if verdict.outcome == "cannot_tell":
        assert verdict.nominal.details["reasons"][0] == "filtered"
        assert "nothing faster is shown" in verdict.nominal.sentence


@pytest.mark.parametrize(("cut", "every"), [(5.0, 1), (6.0, 5)])
def test_a_filter_that_a_motion_in_three_directions_hides_shows_in_the_orientation(cut, every):
    """Motion capture of a level tray, filtered as a pose, and saved with every fifth sample; the shake needs more
    friction than there is."""
    rng, rise = np.random.default_rng(7), truth(T)[:, 1]
    p = truth(T, 1.2e-3) + np.outer(rise, [0.6, 0.0, 0.1]) + 2e-5 * rng.standard_normal((len(T), 3))
    pose = np.hstack([p, [1.0, 0, 0, 0] + 4e-5 * rng.standard_normal((len(T), 4)) * [0, 1, 1, 1]])
    pose = signal.filtfilt(*signal.butter(4, cut / (RATE / 2)), pose, axis=0)[::every]
    columns = dict(zip(("x", "y", "z", "qw", "qx", "qy", "qz"), pose.T, strict=True))
    verdict = audit({"t": T[::every], **columns}, CUBE)
    assert verdict.outcome == "cannot_tell"
    assert verdict.nominal.details["reasons"][0] == "filtered"


@pytest.mark.parametrize("factor", [1e-3, 1e2])
def test_positions_in_another_unit_give_no_verdict(factor):
    p = truth(T)
    verdict = judged(factor * p, noise=0.0)
    assert verdict.outcome == "cannot_tell"
    assert verdict.nominal.details["reasons"][0] == "unit"
    assert "positions must be in m" in verdict.nominal.sentence


def test_a_small_shake_of_a_coarse_encoder_is_not_taken_for_jolts():
    p = truth(T, shake=1e-4)
    p = np.round(p / 5e-4) * 5e-4
    channels = found(p, noise=0.0)
    assert channels.step == pytest.approx(5e-4, rel=0.01)
    assert judged(p, noise=0.0).outcome == "cannot_tell"


@pytest.mark.parametrize(
    ("name", "rest"),
    [("ur5-bottle", 0.3), ("ur3-cup", 0.3), ("ur3-cup", 0.0), ("ur5-bottle", 2.0)],
)
@pytest.mark.slow
def test_a_motion_that_was_computed_was_not_filtered(fastest, name, rest):
    """It is smooth, and where it rests nothing moves at all."""
    plan = fastest(name)
    t = np.arange(-rest, plan.duration + rest, 2e-3)
    q = plan.joint.sample(np.clip(t, 0.0, plan.duration))[0]
    names = load_arm(plan.scenario.arm, plan.scenario.tray).joint_names
    found = sv.audit({"t": t, **{f"q_{joint}": x for joint, x in zip(names, q.T, strict=True)}}, plan.scenario)
    assert "filtered" not in found.nominal.details.get("reasons", ())


@pytest.mark.parametrize(("of", "rate"), [pytest.param("joints", 100.0, marks=pytest.mark.slow), ("tray", 1000.0)])
def test_a_plan_in_four_digits_is_not_said_to_lose_its_load(fastest, of, rate):
    """The plan uses all its margin; where it rests before and after, and moves slowly, rounding is no white noise."""
    plan = fastest("ur5-bottle")
    t = np.arange(-0.3, plan.duration + 0.3, 1 / rate)
    q = plan.joint.sample(np.clip(t, 0.0, plan.duration))[0]
    arm = load_arm(plan.scenario.arm, plan.scenario.tray)
    columns = {f"q_{joint}": x for joint, x in zip(arm.joint_names, q.T, strict=True)}
    if of == "tray":
        p, R = (np.array(x) for x in zip(*map(arm.tray_pose, q), strict=True))
        poses = np.hstack([p, continuous(quat_wxyz_from_matrix(R))])
        columns = dict(zip(("x", "y", "z", "qw", "qx", "qy", "qz"), poses.T, strict=True))
    found = sv.audit({"t": t, **{name: np.round(x, 4) for name, x in columns.items()}}, plan.scenario)
    assert found.outcome == "cannot_tell"


SHAKEN = truth(T, shake=2 * 4.905 / (2 * np.pi * 18) ** 2)  # twice the friction there is


@pytest.mark.parametrize("band", [5e-5, 1.25e-4])
def test_a_dead_band_is_a_resolution(band):
    """Of a safe chirp, 2 to 12 Hz at half of what friction bears, the samples seemed to go as at 15 000 m/s^2."""
    frequency = 2 + 5 * T
    size = 2.5 / (2 * np.pi * frequency) ** 2 * np.clip(T / 0.3, 0, 1) ** 2 * np.clip((2 - T) / 0.2, 0, 1) ** 2
    turn = 2 * np.pi * np.cumsum(frequency) / RATE
    p = np.stack([0.5 + size * np.sin(turn), size * np.cos(turn), 0.4 + 0 * T], axis=1)
    assert dead_band(p) == 0.0
    for column in p.T:
        for k in range(1, len(column)):
            column[k] = column[k] if abs(column[k] - column[k - 1]) > band else column[k - 1]
    assert band < dead_band(p) < 1.6 * band  # a step is the next sample beyond it
    verdict = judged(p, noise=0.0).nominal
    assert "noise" in verdict.details["reasons"]
    assert "no arm" not in verdict.sentence


def test_samples_that_repeat_at_top_speed_are_no_dead_band():
    """The moves after them are of one size; the recording has smaller ones where it turns."""
    sway = 0.1 * np.sin(2 * np.pi * 2 * T + 0.3)
    for k in range(8):
        sway[k * 125 + 114] = sway[k * 125 + 113]  # it passes the middle there
    assert dead_band(sway[:, None]) == 0.0


@pytest.mark.parametrize("side", [1.0, -1.0])
@pytest.mark.parametrize(("share", "outcome"), [(0.5, "cannot_tell"), (2.2, "does_not_hold")])
def test_a_dead_band_is_a_resolution_of_a_fast_motion_too(side, share, outcome):
    """A transfer that needs `share` of the friction there is; the safe one seemed to need more friction than any."""
    t = np.arange(0, 2.2, 0.002)
    u = np.clip((t - 0.3) / 0.7, 0, 1)
    way = side * share * 0.4 * 9.81 * 0.7**2 / (10 / 3**0.5) * u**3 * (10 - 15 * u + 6 * u**2)
    p = np.stack([0.4 + way, 0.1 + 0.7 * way, 0.5 + 0 * t], axis=1)
    for column in p.T:
        for k in range(1, len(column)):
            column[k] = column[k] if abs(column[k] - column[k - 1]) > 1e-4 else column[k - 1]
    case = CUBE.with_changes(objects__0__friction=0.4, objects__0__uncertainty={})
    assert judged(p, t, noise=0.0, case=case).outcome == outcome


def test_a_column_that_ends_at_a_bound_of_the_sensors_range_is_no_jolt():
    """A safe sway, of which the sensor shows no more than 0.15 m to one side; and whole, at rest at its goal."""
    u = np.clip((T - 0.1) / 1.8, 0, 1)
    sway = 0.2 * np.sin(2 * np.pi * u) ** 3
    p = np.stack([0.5 + 0 * T, sway, 0.4 + 0 * T], axis=1) + 2e-5 * np.random.default_rng(5).standard_normal(
        (len(T), 3)
    )
    p[:, 1] = np.minimum(p[:, 1], 0.15)
    seen = judged(p, noise=0.0).nominal
    assert seen.code == "cannot_tell"
    assert "range" in seen.details["reasons"]
    assert "for 1" in seen.sentence  # a hundred and more samples
    for noise in (0.0, 2e-5):
        assert "range" not in codes(found(np.stack([0.5 + 0 * T, sway, 0.4 + 0 * T], axis=1), noise=noise))
    assert "range" not in codes(found(truth(T), noise=0.0))


def test_axes_of_which_another_is_up_give_no_verdict():
    """Motion capture with its second axis up; the load stays, and on a tray that stands on edge it would not."""
    y_up = {"x": truth(T)[:, 0], "y": truth(T)[:, 2], "z": -truth(T)[:, 1]}
    half = {"qw": 0.5**0.5 + 0 * T, "qx": -(0.5**0.5) + 0 * T, "qy": 0 * T, "qz": 0 * T}
    verdict = audit({"t": T, **y_up, **half}, CUBE).nominal
    assert verdict.details["reasons"] == ["leaning"]
    assert "leans by 90 deg at its first sample" in verdict.sentence


@pytest.mark.slow
def test_two_sources_that_take_turns_are_told_from_a_shake():
    p = truth(T)
    p[1::2] = truth(T - 0.008)[1::2]
    assert codes(found(p)) == ["alternating"]
    assert "alternating" in judged(p).nominal.details["reasons"]
    assert "alternating" not in codes(found(SHAKEN))
    for share in (4, 6):
        at_a_share_of_the_rate = truth(T) + 2e-3 * np.sin(2 * np.pi * RATE / share * T + 0.3)[:, None] * [0, 1, 0]
        assert "alternating" not in codes(found(at_a_share_of_the_rate))


@pytest.mark.parametrize("rate", [pytest.param(70.0, marks=pytest.mark.slow), 210.0])
def test_lines_between_samples_of_a_slower_sensor_are_no_jolts(rate):
    slow = np.arange(0.0, 2.01, 1 / rate)
    p = np.stack([np.interp(T, slow, x) for x in truth(slow).T], axis=1)
    assert judged(p, noise=0.0).outcome != "does_not_hold"


@pytest.mark.slow
def test_samples_that_go_on_at_the_last_speed_are_no_jolts():
    p = truth(T, shake=2e-4)
    for k in range(20, 980, 40):
        for i in range(k, k + 5):
            p[i] = 2 * p[i - 1] - p[i - 2]
    assert judged(p, noise=0.0).outcome == "cannot_tell"


def test_constant_speeds_between_pushes_are_no_defect():
    """To and fro, five times, with pushes of 20 ms between constant speeds."""
    push = np.sin(np.pi * (np.arange(10) + 0.5) / 10)
    signs = np.tile([2.0, 0.0, 0.0, -2.0, 0.0, 0.0, -2.0, 0.0, 0.0, 2.0, 0.0, 0.0], 5)
    bend = np.outer(signs, push).ravel()
    y = np.cumsum(np.cumsum(bend)) / RATE**2
    p = np.stack([0.5 + 0 * y, y, 0.4 + 0 * y], axis=1)
    assert codes(found(p, np.arange(len(y)) / RATE, noise=0.0)) == []


def test_a_short_constant_speed_between_accelerations_is_no_defect():
    """There and back by trapezoids of speed, whose constant part has five samples of 125 a second."""
    bend = np.repeat([0.0, 0.8, 0.0, -0.8, 0.0, -0.8, 0.0, 0.8, 0.0], [60, 37, 5, 37, 60, 37, 5, 37, 60])
    y = np.cumsum(np.cumsum(bend)) / 125**2
    p = np.stack([0.5 + 0 * y, y, 0.4 + 0 * y], axis=1)
    assert codes(found(p, np.arange(len(y)) / 125, noise=0.0)) == []


@pytest.mark.parametrize("noise", [0.0, 2e-5])
def test_a_shake_in_one_direction_is_too_much(noise):
    assert judged(SHAKEN, noise=noise).outcome == "does_not_hold"


def test_one_column_in_another_unit_is_noisier():
    """Across the motion, in cm: 100 times the noise, and 2 m to the side that nobody notices."""
    p = seen(truth(T)).p
    p[:, 2] *= 100
    (defect,) = [each for each in found(p, noise=0.0).defects if each.code == "unit" and "noisy" in each.clause]
    assert defect.systematic
    assert judged(p, noise=0.0).outcome == "cannot_tell"


def test_one_column_in_m_where_the_others_are_in_mm_hides_no_motion():
    """Half a metre in 0.5 s, which needs 11.5 m/s^2; read in mm it is half a millimetre, and would hold."""
    p = truth((T - 0.7) * 3.2 + 0.2)
    assert judged(p).outcome == "does_not_hold"
    p = seen(p).p
    p[:, 1] *= 1e-3
    assert judged(p, noise=0.0).outcome == "cannot_tell"


def test_a_hum_in_one_column_is_no_other_unit():
    """3 mm at 3/8 of the rate of the samples: from one sample to the next as alike as white noise, to the third not."""
    p = truth(T)
    p[:, 2] += 3e-3 * np.sin(2 * np.pi * 3 / 8 * RATE * T)
    assert "unit" not in codes(found(p))


def test_a_tray_at_rest_where_only_the_worst_friction_would_not_hold_the_load_is_doubted_in_the_worst_case():
    """It leans by 0.42 rad, which needs a friction of 0.447; it is 0.4 to 0.6."""
    case = CUBE.with_changes(objects__0__uncertainty={"friction": 0.1})
    x, y, z = seen(truth(T)[:1] + 0 * T[:, None]).p.T
    pose = {"x": x, "y": y, "z": z, "qw": np.cos(0.21) + 0 * T, "qx": np.sin(0.21) + 0 * T, "qy": 0 * T, "qz": 0 * T}
    verdict = audit({"t": T, **pose}, case)
    assert "leaning" not in verdict.nominal.details.get("reasons", [])
    assert verdict.worst.details["reasons"] == ["leaning"]


def test_a_recorded_joint_far_below_its_range_gives_no_verdict():
    arm = load_arm(CUBE.arm, CUBE.tray)
    q = np.tile(np.array([0.08, 1.04, -0.78, -1.7, -2.2, arm.limits.q_min[5] - 0.3, 1.12]), (len(T), 1))
    q[:, 3] -= 0.02 * (1 - np.cos(3 * T))
    verdict = audit({"t": T, **dict(zip(arm.joint_names, q.T, strict=True))}, CUBE).nominal
    assert "panda_joint6 is up to 0.3 rad out of its range" in verdict.sentence


@pytest.mark.parametrize(("beyond", "most"), [(0.05, 0.1), (0.5, 0.1), (0.05, 0.02), (0.5, 0.6)])
def test_a_recorded_joint_far_out_of_its_range_gives_no_verdict(beyond, most):
    """Joint 4 of a Panda goes up to -0.07 rad; encoders may have another zero, and not by half a radian."""
    arm = load_arm(CUBE.arm, CUBE.tray)
    q = np.tile(np.array([0.08, 1.04, -0.78, -0.0698 + beyond, -2.2, 0.84, 1.12]), (len(T), 1))
    q[:, 3] -= 0.02 * (1 - np.cos(3 * T))
    options = AuditOptions(beyond=most)
    verdict = audit({"t": T, **dict(zip(arm.joint_names, q.T, strict=True))}, CUBE, options=options).nominal
    assert ("range" in verdict.details.get("reasons", [])) == (beyond > most)
    if beyond > most:
        assert f"panda_joint4 is up to {beyond:g} rad out of its range" in verdict.sentence
