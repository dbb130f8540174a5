"""Audits: accelerations found in noise, verdicts derived by hand."""

import json

import numpy as np
import pytest
from typer.testing import CliRunner

from recordings import AT_B, GOAL, HEADER, JOINTS, NO_TURN, START, joint_motion, line, tray_csv, write_csv
from salver import scenario as scenarios
from salver.auditing import audit, audit_motion
from salver.auditing.motion import TrayMotion, forward, tray_motion
from salver.auditing.noise import Level, found, level, resolution, spikes
from salver.auditing.recorded import sensor_of, stretches
from salver.auditing.spline import fit
from salver.cli import app
from salver.errors import FileFormatError
from salver.geometry import exp, log, quat_wxyz_from_matrix
from salver.models.arm import load_arm
from salver.motion_files.readers import read
from salver.motion_files.samples import JointSamples, TraySamples, tray_samples
from salver.trajectory import MotionSamples, min_jerk_line

GIBBS = 0.135  # of a step of the acceleration, by which a least-squares quintic overshoots it: tested below
PEAK = 10 / np.sqrt(3) * 0.5  # of the min-jerk acceleration over 0.5 m, times T^2


@pytest.fixture(scope="module")
def arm():
    case = scenarios.load("panda-cube")
    return load_arm(case.arm, case.tray)


# Curves -------------------------------------------------------------------------------------------------------


def test_a_quintic_is_met_exactly_however_it_is_sampled():
    t = np.sort(np.random.default_rng(1).random(300)) * 2
    y = np.stack([t**5 - 3 * t**2, 2 * t**3 - t], axis=1)
    curve = fit(t, y, np.full(300, 5.0))
    value, rate, bend = curve(t)
    assert np.abs(value - y).max() < 1e-9
    assert np.abs(rate - np.stack([5 * t**4 - 6 * t, 6 * t**2 - 1], axis=1)).max() < 1e-6
    assert np.abs(bend - np.stack([20 * t**3 - 6, 12 * t], axis=1)).max() < 1e-4


def test_what_keeps_the_equations_solvable_does_not_bend_the_curve():
    """As many knots as the sampling allows, some with hardly a sample: a quintic is met to rounding all the same."""
    t = np.sort(np.concatenate([[0, 1], np.random.default_rng(0).random(400)]))
    curve = fit(t, (t**5 - 0.3 * t**3)[:, None], np.full(len(t), 160.0))
    at = np.linspace(0, 1, 1001)
    value, _, bend = curve(at)
    assert np.abs(value[:, 0] - (at**5 - 0.3 * at**3)).max() < 1e-13
    assert np.abs(bend[:, 0] - (20 * at**3 - 1.8 * at)).max() < 1e-7  # by knots 3 ms apart: 1e-16 / 0.003^2 and more


@pytest.mark.parametrize("count", [6, 7, 13, 100])
def test_a_curve_has_no_more_unknowns_than_there_are_samples(count):
    """However much is to be let through; a quintic alone has six."""
    t = np.linspace(0, 1, count) ** 1.1
    curve = fit(t, np.cos(3 * t)[:, None], np.full(count, 1e4))
    assert len(curve.spline.c) <= count
    assert np.abs(curve.spline(t)[:, 0] - np.cos(3 * t)).max() < 1e-3


def test_a_curve_at_rest_has_no_velocity_and_no_acceleration_at_its_end():
    t = np.linspace(0, 2, 401)
    curve = fit(t, np.cos(3 * t)[:, None], np.full(401, 8.0), (True, False))
    value, rate, bend = curve(np.array([0.0, 2.0]))
    assert np.abs([rate[0], bend[0]]).max() < 1e-9
    assert np.allclose([value[1, 0], bend[1, 0]], [np.cos(6), -9 * np.cos(6)], atol=2e-2)


@pytest.mark.parametrize("bandwidth", [8.0, 20.0])
def test_the_stated_error_of_the_acceleration_is_that_of_unit_noise_in_each_sample(bandwidth):
    """A fit is linear in its samples: the deviation is the norm of what one unit in each of them does."""
    t = np.linspace(0, 2, 801)
    at = np.concatenate([[0.0, 0.01, 0.02, 0.04, 1.96, 2.0], np.linspace(0.9, 1.1, 41)])
    curve = fit(t, np.eye(801), np.full(801, bandwidth))
    stated, seen = curve.acceleration_error(at, t[1]), np.linalg.norm(curve(at)[2], axis=1)
    # Never less than it is; at the ends, where the profile is that of a long curve, some more.
    assert np.all(seen < 1.02 * stated)
    assert np.all(seen[[0, 1, 5]] > 0.85 * stated[[0, 1, 5]])
    assert seen[6:].max() > 0.98 * stated[6:].max()  # at the knots it is larger than between them


# Noise --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("noise", [1e-6, 1e-4, 1e-3])
@pytest.mark.parametrize("rate", [100, 1000])
def test_noise_is_measured_under_a_motion(noise, rate):
    s = line(2.0, rate)
    p = s.p_SB + noise * np.random.default_rng(2).standard_normal(s.p_SB.shape)
    assert sensor_of(s.t, p, s.quat_SB_wxyz).position.sizes.max() == pytest.approx(noise, rel=0.05)


@pytest.mark.slow
@pytest.mark.parametrize("count", [60, 200, 2000])
def test_the_level_of_noise_is_not_the_least_of_many_guesses(count):
    # What is taken for noise must not be less than it is, or noise becomes motion; nor more, or motion becomes noise.
    t, sizes = np.arange(count) / 300, []
    for seed in range(20 if count < 1000 else 5):
        rng = np.random.default_rng(seed)
        quat = np.tile([1.0, 0, 0, 0], (count, 1))
        quat[:, 1:] += 1e-3 * rng.standard_normal((count, 3))
        found = sensor_of(t, rng.standard_normal((count, 3)), quat / np.linalg.norm(quat, axis=1, keepdims=True))
        sizes += [*found.position.sizes, *(1e3 * found.orientation.sizes)]
    # The mean of guesses that are each off by some 1.3 / sqrt(count), to four standard deviations.
    assert np.mean(sizes) == pytest.approx(1, abs=4 * 1.3 / np.sqrt(count * len(sizes)) + 0.01)
    assert np.std(sizes) < 1.8 / np.sqrt(count)


def test_noise_of_a_turning_frame_is_no_motion():
    # White in the frame that turns: in the components of the quaternion it wanders from one to the other.
    t = np.arange(2001) / 1000
    rng = np.random.default_rng(4)
    turn = np.column_stack([0 * t, 0.8 * np.sin(2 * np.pi * t), 0.5 * t])
    quat = quat_wxyz_from_matrix(exp(turn) @ exp(2e-3 * rng.standard_normal((len(t), 3))))
    p = 1e-3 * rng.standard_normal((len(t), 3))
    sensor = sensor_of(t, p, quat)
    assert sensor.orientation.sizes == pytest.approx(np.full(3, 1e-3), rel=0.1)
    (part,) = stretches(t, p, quat, sensor, 50.0)
    assert part.bandwidth.max() < 10


def test_between_the_outermost_samples_a_curve_that_moves_bends_as_it_does_two_samples_inside():
    """Nothing is known beyond the end. A sine cut while it swings; the other end begins at rest and is left alone."""
    t = np.arange(0, 1.0, 0.01)
    p = np.stack([0.1 * (1 - np.cos(5 * t)), 0 * t, 0 * t], axis=1)
    p += np.random.default_rng(0).normal(scale=1e-5, size=p.shape)
    quat = np.tile([1.0, 0, 0, 0], (len(t), 1))
    (part,) = stretches(t, p, quat, sensor_of(t, p, quat), 50.0)
    bend = part.motion.a_S[:, 0]
    last = part.motion.t > t[-3]
    assert last.sum() > 2
    assert np.ptp(bend[last]) == 0
    assert bend[last][0] == bend[~last][-1] != 0


def test_a_violent_motion_is_not_taken_for_noise():
    # 71 m/s^2 at 6 Hz, at 25 Hz and as a chirp from 1 to 40 Hz: noise-free, so next to nothing is noise.
    t = np.arange(2001) / 1000
    for y in (
        0.05 * np.sin(12 * np.pi * t),
        0.003 * np.sin(50 * np.pi * t),
        1e-3 * np.sin(2 * np.pi * (t + 39 / 4 * t**2)),
    ):
        p = np.stack([y, 0 * t, 0 * t], axis=1)
        quat = np.tile([1.0, 0, 0, 0], (len(t), 1))
        assert sensor_of(t, p, quat).position.sizes.max() < 1e-6 * np.abs(y).max()


def test_white_noise_is_hardly_ever_taken_for_motion():
    alarms = 0
    for seed in range(40):
        y = np.random.default_rng(seed).standard_normal((1000, 3))
        alarms += any(len(cells.first) for cells in found(y, 500.0, Level.even(1.0), 1e-9))
    assert alarms <= 12  # the probability is 0.1 each; more than 12 of 40 would come by chance once in 10^4


@pytest.mark.parametrize(("frequency", "cycles"), [(50, 1), (50, 16), (20, 8), (5, 4)])
def test_a_shake_is_found_in_noise_by_its_energy(frequency, cycles):
    # Nine standard deviations over its own window, wherever it begins.
    rate, missed = 1000, 0
    for seed in range(20):
        rng = np.random.default_rng(seed)
        y = rng.standard_normal((2000, 3))
        count = cycles * rate // frequency
        first = rng.integers(0, 2001 - count)
        size = 9 * np.sqrt(2 / count)
        y[first : first + count, 0] += size * np.sin(2 * np.pi * frequency * np.arange(count) / rate)
        hits = [k for cells in found(y, rate, Level.even(1.0), 1e-9) for k in range(len(cells.first))
                if cells.first[k] < first + count and cells.last[k] > first]  # fmt: skip
        missed += not hits
    assert missed <= 2


@pytest.mark.parametrize("frequency", [5.0, 31.25, 120.0])
def test_an_oscillation_of_negligible_acceleration_is_let_be(frequency):
    """Without noise: its amplitude times its angular frequency squared decides, to what windows see of it."""
    t = np.arange(2048) / 500
    for share in (0.8, 1.25):
        y = np.zeros((2048, 3))
        y[:, 1] = share * 0.02 / (2 * np.pi * frequency) ** 2 * np.sin(2 * np.pi * frequency * t)
        long = found(y, 500.0, Level.even(1e-12), 0.02)[-1]  # over the whole recording
        assert (len(long.frequency) > 0) == (share > 1), share
        assert long.frequency == pytest.approx(np.full(len(long.frequency), frequency), abs=0.3)


def test_noise_of_a_band_is_found_at_the_quietest():
    rng = np.random.default_rng(0)
    t = np.arange(4096)
    y = rng.standard_normal((4096, 3)) + 5 * np.sin(2 * np.pi * 0.31 * t)[:, None]  # one frequency far above it
    sizes, error = level(y, 0.25)
    assert error < 0.05
    assert sizes == pytest.approx(np.ones(3), rel=4 * error)


def test_resolution_is_the_step_of_rounded_values_and_of_nothing_else():
    t = np.linspace(0, 1, 500)
    y = np.sin(3 * t)[:, None]
    assert resolution(np.round(y, 3)) == pytest.approx(1e-3, rel=1e-6)
    assert resolution(y) == 0
    assert resolution(0.002 * np.arange(500.0)[:, None]) == 0  # constant speed
    assert resolution(np.full((500, 3), 0.4)) == 0


def test_a_spike_is_one_sample_that_is_off_its_neighbours():
    t = np.arange(400) / 100
    y = np.stack([np.sin(t), np.cos(t), t**2], axis=1)
    assert len(spikes(t, y, 0.0)) == 0
    y[123, 1] += 0.01
    assert list(spikes(t, y, 0.0)) == [123]


# From poses to accelerations ----------------------------------------------------------------------------------


def one(t, y, noise=0.0, highest=50.0):
    p = np.stack([0 * t, y, 0 * t], axis=1) + noise * np.random.default_rng(7).standard_normal((len(t), 3))
    quat = np.tile([1.0, 0, 0, 0], (len(t), 1))
    (part,) = stretches(t, p, quat, sensor_of(t, p, quat), highest)
    return part


@pytest.mark.slow
@pytest.mark.parametrize(("frequency", "rate"), [(1, 100), (6, 1000), (15, 100), (20, 200), (45, 400), (80, 1000)])
def test_the_acceleration_of_a_shake_is_met_at_any_frequency(frequency, rate):
    t = np.arange(2 * rate + 1) / rate
    omega = 2 * np.pi * frequency
    part = one(t, 2.0 / omega**2 * np.sin(omega * t + 0.3))
    error = np.abs(part.motion.a_S[:, 1] + 2.0 * np.sin(omega * part.motion.t + 0.3))
    edge = max(3 / rate, 0.02)  # what is one-sided is less certain
    inner = (part.motion.t > edge) & (part.motion.t < 2 - edge)
    assert np.all(error[inner] < 0.06 + part.acceleration_error[inner] + part.missed[inner])
    assert part.missed.max() < 0.55


@pytest.mark.slow
@pytest.mark.parametrize("noise", [1e-6, 1e-5, 1e-4, 1e-3])
def test_noise_does_not_become_acceleration(noise):
    s = line(2.0)
    part = one(s.t, s.p_SB[:, 1], noise)
    truth = min_jerk_line(2.0, START, GOAL, np.eye(3), np.eye(3)).sample(part.motion.t)
    error = np.abs(part.motion.a_S - truth.a_S).max(axis=1)
    # Twice differenced, noise n at 1 kHz would be sqrt(6) n * 10^6; what is stated is 4.5 standard deviations.
    assert np.all(error < part.acceleration_error + 0.02)
    assert np.median(part.acceleration_error) < 0.2


@pytest.mark.slow
@pytest.mark.parametrize(("noise", "frequency", "length"), [(7e-4, 2.5, 1.0), (1e-4, 3.0, 1.0)])
def test_an_end_that_is_bent_or_not_at_rest_is_within_the_stated_error(noise, frequency, length):
    # 2.5 m/s^2 that are cut off while they last; noise hides that a curve at rest, or one polynomial, is none of them.
    t, swing = np.arange(round(length * 362) + 1) / 362, 2 * np.pi * frequency
    for k in range(12):
        phase = np.pi * k / 6
        part = one(t, 2.5 / swing**2 * np.sin(swing * t + phase), noise)
        truth = -2.5 * np.sin(swing * part.motion.t + phase)
        assert np.all(np.abs(part.motion.a_S[:, 1] - truth) < part.acceleration_error + 0.02)


@pytest.mark.slow
def test_a_short_jolt_is_followed_where_it_is_and_nowhere_else():
    t = np.arange(6001) / 1000
    inside = (t > 3) & (t < 3.1)
    smooth = np.where(inside, 10 * np.sin(20 * np.pi * (t - 3)), 0)
    square = np.where(inside, np.where(t < 3.05, 10.0, -10.0), 0)
    for a, least, most in ((smooth, 9.5, 10.5), (square, 10.0, 10 + GIBBS * (10 + 20 + 10))):
        part = one(t, np.cumsum(np.cumsum(a)) * 1e-6, 1e-4)
        near = np.abs(part.motion.t - 3.05) < 0.5
        assert least <= np.abs(part.motion.a_S[:, 1]).max() <= most
        assert part.bandwidth[near].max() > 20
        assert part.bandwidth[~near].max() < 15


def test_a_step_of_the_acceleration_is_overshot_by_no_more_than_gibbs():
    t, at = np.linspace(0, 2, 4001), np.linspace(0.5, 1.5, 2001)
    for phase in np.linspace(0, 1, 5):  # of a knot interval
        u = t - 1 - phase / 20
        bend = fit(t, (0.5 * u * np.abs(u))[:, None], np.full(len(t), 10.0))(at)[2]
        assert 0 < np.abs(bend).max() - 1 < 2 * GIBBS


def test_what_the_samples_are_too_few_for_is_left_over_and_told():
    t = np.arange(401) / 200
    part = one(t, 1e-4 * np.sin(2 * np.pi * 93 * t))
    assert max(cells.amplitude.max() for cells in part.unseen if len(cells.first)) == pytest.approx(1e-4, rel=0.4)
    assert any(np.any(np.abs(cells.frequency - 93) < 4) for cells in part.unseen)


def test_what_may_be_mirrored_at_the_sampling_rate_is_told():
    # At 60 samples a second 45 Hz looks like 15 Hz; what is below 60 - 50 Hz is what it seems.
    t = np.arange(181) / 60
    seen = one(t, 1e-3 * np.sin(2 * np.pi * 45 * t))
    assert any(np.any(np.abs(cells.frequency - 15) < 3) for cells in seen.mirrored)
    slow = one(t, 1e-2 * np.sin(2 * np.pi * 2 * t))
    assert not any(np.any(cells.amplitude > 3e-5) for cells in slow.mirrored)


@pytest.mark.parametrize("turns", [False, True])
def test_what_a_curve_misses_near_the_samplings_limit_is_told_of_what_is_fast(turns):
    """A quarter of the acceleration at the limit; whether it is the place or the turning that is so fast."""
    t = np.arange(801) / 400
    shake, slow = np.sin(2 * np.pi * 75 * t), np.sin(2 * np.pi * t)
    y, angle = (0.05 * slow, 1e-2 * shake) if turns else (1e-3 * shake, 0.1 * slow)
    p = np.stack([0 * t, y, 0 * t], axis=1)
    quat = quat_wxyz_from_matrix(exp(np.outer(angle, [0.0, 0.0, 1.0])))
    (part,) = stretches(t, p, quat, sensor_of(t, p, quat), 50.0)
    share = part.missed / np.maximum(np.linalg.norm(part.motion.a_S, axis=1), 1e-9)
    assert np.median(share) > 0.05
    assert share.max() < 0.26


def test_what_is_mirrored_into_the_slow_of_a_long_recording_is_told():
    # At 72 Hz a shake of 67 Hz and one of 5 Hz have the same samples, and up to 70 Hz it may shake.
    t = np.arange(20 * 72 + 1) / 72.0
    seen = one(t, 1e-3 * np.sin(2 * np.pi * 67 * t), highest=70.0)
    assert any(np.any((np.abs(cells.frequency - 5) < 1) & (cells.amplitude > 5e-4)) for cells in seen.mirrored)
    slow = one(t, 1e-3 * np.sin(2 * np.pi * 1.0 * t), highest=70.0)
    assert not any(np.any(cells.amplitude > 3e-5) for cells in slow.mirrored)


@pytest.mark.parametrize("rate", [20, 100, 1000])
def test_a_step_between_two_samples_is_told_whatever_it_does_to_the_load(rate):
    t = np.arange(2 * rate + 1) / rate
    p = np.zeros((len(t), 3))
    p[t > 1, 1] = 0.02
    seen = TraySamples(t, p, np.tile([1.0, 0, 0, 0], (len(t), 1)), "E", "seen.csv")
    doubts = dict(tray_motion(seen, None, AT_B, NO_TURN).doubts)
    assert doubts["jump"] == f"the position jumps by 20 mm from 1.000 s to {1 + 1 / rate:.3f} s"


def test_noise_that_is_stated_of_joints_reaches_the_tray_through_the_jacobian(arm):
    """Independent noise s in all joints has the covariance s^2 J J^T at the tray: s |J| / sqrt(3) of each component; a
    quaternion's components move by half the angle. J by differences of the tray's pose."""
    q, h, noise = np.array([0.4, 1.2, -0.7, -1.9, -2.1, 1.1, 1.3]), 1e-6, 2e-4
    ends = [(arm.tray_pose(q + h * unit), arm.tray_pose(q - h * unit)) for unit in np.eye(7)]
    moved = np.array([(a[0] - b[0]) / (2 * h) for a, b in ends])
    turned = np.array([log(b[1].T @ a[1]) / (2 * h) for a, b in ends])
    samples = JointSamples(np.arange(200) / 100, JOINTS, np.tile(q, (200, 1)), None, None, "by hand")
    sensor = tray_motion(samples, arm, AT_B, NO_TURN, noise=noise).recording.sensor
    assert sensor.position.sizes == pytest.approx(noise * np.linalg.norm(moved) / np.sqrt(3), rel=1e-6)
    assert sensor.orientation.sizes == pytest.approx(0.5 * noise * np.linalg.norm(turned) / np.sqrt(3), rel=1e-6)


def test_the_bandwidths_that_are_told_are_the_least_and_the_most():
    """A slow line with a jolt of 30 Hz in it, without noise."""
    t = np.arange(3001) / 1000
    jolt = 1e-3 * np.sin(2 * np.pi * 30 * (t - 1.4)) * np.exp(-(((t - 1.5) / 0.05) ** 2))
    truth = min_jerk_line(3.0, START, GOAL, np.eye(3), np.eye(3)).sample(t)
    seen = TraySamples(t, truth.p_SB + jolt[:, None], truth.quat_SB_wxyz, "E", "by hand")
    least, most = tray_motion(seen, None, AT_B, NO_TURN, noise=1e-6).recording.bandwidth
    assert least < 30 < 55 < most


def test_quaternions_of_nearly_unit_norm_are_made_unit_and_others_refused():
    t, p = np.arange(40) / 100, np.zeros((40, 3))
    quat = quat_wxyz_from_matrix(exp(np.outer(t, [0.1, 0.2, 0.3])))
    for norm in (0.985, 1.015):
        assert tray_samples(t, p, norm * quat, "E", "by hand").quat_wxyz == pytest.approx(quat, abs=1e-12)
    for norm in (0.975, 1.025, 0.5, 2.0, 0.0):
        wrong = quat.copy()
        wrong[7] *= norm
        with pytest.raises(FileFormatError, match=rf"the quaternion of sample 8 has norm {norm:.4g};"):
            tray_samples(t, p, wrong, "E", "by hand")


def test_uneven_times_are_no_noise(tmp_path):
    rng = np.random.default_rng(3)
    t = np.arange(1501) / 1000 + 2e-4 * rng.uniform(-1, 1, 1501)
    truth = min_jerk_line(1.5, START, GOAL, np.eye(3), np.eye(3)).sample(t)
    sensor = sensor_of(t, truth.p_SB, truth.quat_SB_wxyz)
    assert sensor.position.sizes.max() < 1e-9


def test_turning_about_a_fixed_axis(tmp_path):
    t = np.arange(0, 2.0005, 1e-3)
    u = t / 2
    angle = 1.2 * (10 * u**3 - 15 * u**4 + 6 * u**5)
    axis = np.array([1.0, 2.0, 2.0]) / 3
    quat = quat_wxyz_from_matrix(exp(np.outer(angle, axis)))
    samples = read(write_csv(tmp_path / "a.csv", HEADER, t, np.tile(START, (len(t), 1)), quat))
    motion = tray_motion(samples, None, AT_B, NO_TURN).samples
    v = motion.t / 2
    assert np.allclose(motion.omega_B, np.outer(0.6 * (30 * v**2 - 60 * v**3 + 30 * v**4), axis), atol=1e-5)
    assert np.allclose(motion.alpha_B, np.outer(0.3 * (60 * v - 180 * v**2 + 120 * v**3), axis), atol=1e-3)


def test_the_tray_of_a_moving_arm_against_differences_of_its_pose(arm):
    t, q = joint_motion()
    h, k = 1e-4, 700
    u = t / 2
    direction = np.array([0.5, 0.1, -0.1, 0.1, 0.1, 0.0, 0.2])
    dq = np.outer((30 * u**2 - 60 * u**3 + 30 * u**4) / 2, direction)
    ddq = np.outer((60 * u - 180 * u**2 + 120 * u**3) / 4, direction)
    motion = forward(arm, t[k : k + 1], q[k : k + 1], dq[k : k + 1], ddq[k : k + 1])

    def pose(step):
        return arm.tray_pose(q[k] + step * dq[k] + 0.5 * step**2 * ddq[k])

    before, now, after = (pose(step) for step in (-h, 0.0, h))
    assert np.allclose(motion.p_SB[0], now[0])
    assert np.allclose(motion.R_SB[0], now[1])
    assert np.allclose(motion.v_S[0], (after[0] - before[0]) / (2 * h), atol=1e-7)
    assert np.allclose(motion.a_S[0], (after[0] - 2 * now[0] + before[0]) / h**2, atol=1e-5)
    rate = (after[1] - before[1]) / (2 * h)
    spin = now[1].T @ rate
    assert np.allclose(motion.omega_B[0], [spin[2, 1], spin[0, 2], spin[1, 0]], atol=1e-7)
    bend = now[1].T @ (after[1] - 2 * now[1] + before[1]) / h**2 - spin @ spin
    assert np.allclose(motion.alpha_B[0], [bend[2, 1], bend[0, 2], bend[1, 0]], atol=1e-5)


# Verdicts -----------------------------------------------------------------------------------------------------


def case(friction=0.3, height=0.04, friction_range=None):
    data = scenarios.load("panda-cube").model_dump(mode="json", exclude_none=True)
    data["objects"][0] |= {
        "friction": friction,
        "uncertainty": {"friction": friction_range} if friction_range else {},
    }
    data["objects"][0]["shape"] = {"type": "box", "size": [0.04, 0.04, height]}
    data["objects"][0].pop("inertia")
    return scenarios.parse(data, "test")


def of_line(duration):
    return TrayMotion(line(duration))


def test_the_friction_that_a_level_move_needs_is_its_peak_acceleration_over_gravity():
    duration = 1.2
    result = audit_motion(of_line(duration), case(friction=0.3))
    needed = PEAK / duration**2 / 9.81
    assert result.nominal.code == "holds"
    assert result.margins.interfaces[0].friction_needed.max() == pytest.approx(needed, rel=1e-4)
    assert result.margins.interfaces[0].friction_needed_worst == pytest.approx(needed, rel=1e-3)


def test_it_slides_when_the_acceleration_passes_friction_times_gravity():
    duration = 0.9
    result = audit_motion(of_line(duration), case(friction=0.3))
    s = line(duration)
    first = s.t[np.argmax(np.abs(s.a_S[:, 1]) > 0.3 * 9.81)]
    assert result.nominal.code == "slides"
    assert result.nominal.details["time"] == pytest.approx(first, abs=1e-3)
    assert result.pace.factor == pytest.approx(np.sqrt(PEAK / duration**2 / (0.3 * 9.81)), rel=1e-4)
    assert not result.ok


def test_a_tall_box_tips_where_its_base_ends():
    # Base half-width 2 cm, centre of mass 10 cm up: it tips at a = g / 5, well below friction 0.8.
    duration = 1.0
    result = audit_motion(of_line(duration), case(friction=0.8, height=0.2))
    s = line(duration)
    first = s.t[np.argmax(np.abs(s.a_S[:, 1]) > 9.81 / 5)]
    assert result.nominal.code == "tips"
    assert result.nominal.details["time"] == pytest.approx(first, abs=1e-3)
    assert result.pace.factor == pytest.approx(np.sqrt(PEAK * 5 / 9.81), rel=1e-4)
    assert result.margins.interfaces[0].tip_over.min() == pytest.approx(0.02 - 0.1 * PEAK / 9.81, rel=1e-3)


def test_run_at_its_pace_the_path_just_holds():
    uncertain = case(0.3, friction_range="10%")
    slow = audit_motion(of_line(0.9), uncertain).pace_worst.factor
    assert audit_motion(of_line(0.9 * slow * 1.001), uncertain).worst.code == "holds"
    assert audit_motion(of_line(0.9 * slow * 0.999), uncertain).worst.code == "slides"


def test_what_holds_nominally_may_not_hold_in_the_worst_case():
    duration = np.sqrt(PEAK / (0.28 * 9.81))  # needs friction 0.28
    result = audit_motion(of_line(duration), case(0.3, friction_range="10%"))
    assert result.nominal.ok
    assert not result.worst.ok
    assert not result.ok
    assert result.pace_worst.factor == pytest.approx(np.sqrt(0.28 / 0.27), rel=1e-3)
    assert next(iter(result.costs)) == "friction"


@pytest.mark.slow
def test_what_passes_the_edge_by_less_than_its_acceleration_is_known_cannot_be_told():
    """Half a m/s^2 beyond friction times gravity at two peaks: known to 0.2 m/s^2 it slides, to 1 not."""
    duration = np.sqrt(PEAK / (0.3 * 9.81 + 0.5))
    for error, code in ((0.0, "slides"), (0.2, "slides"), (1.0, "cannot_tell")):
        assert audit_motion(TrayMotion(line(duration), acceleration_error=error), case(0.3)).nominal.code == code
        missed = TrayMotion(line(duration), acceleration_error=0.0, missed=np.full(len(line(duration).t), error))
        assert audit_motion(missed, case(0.3)).nominal.code == code


def test_a_tray_tilted_beyond_the_friction_angle_has_no_pace():
    s = line(2.0)
    tilt = np.deg2rad(20) * np.sin(np.pi * s.t / 2) ** 2
    R = exp(np.column_stack([tilt, 0 * tilt, 0 * tilt]))
    zero = np.zeros_like(s.a_S)
    motion = TrayMotion(MotionSamples(s.t, s.p_SB, s.v_S, s.a_S, R, zero, zero))
    result = audit_motion(motion, case(friction=0.3))  # 16.7 degrees
    assert result.pace.factor is None
    assert "tilted too far at 1.000 s" in result.pace.status.sentence


# The command --------------------------------------------------------------------------------------------------


def run(*arguments):
    return CliRunner().invoke(app, ["audit", *map(str, arguments)])


@pytest.mark.slow
def test_the_exit_code_tells(tmp_path):
    held = run(tray_csv(tmp_path / "slow.csv", 2.5), "--scenario", "panda-cube")
    assert held.exit_code == 0
    assert "Everything holds" in held.stdout
    slid = run(tray_csv(tmp_path / "fast.csv", 0.6), "--scenario", "panda-cube")
    assert slid.exit_code == 3
    assert "slides at" in slid.stdout
    assert "times as long" in slid.stdout
    wrong = run(tmp_path / "none.csv", "--scenario", "panda-cube")
    assert wrong.exit_code == 2
    assert "does not exist" in wrong.stderr


def test_json_has_every_figure(tmp_path):
    result = run(tray_csv(tmp_path / "a.csv", 0.9, noise=1e-5), "--scenario", "panda-cube", "--json")
    found = json.loads(result.stdout)
    # 5.77 * 0.5 / 0.81 m/s^2; the cube has friction 0.5, and noise adds a little to the peak.
    assert found["interfaces"][0]["friction_needed"] == pytest.approx(PEAK / 0.81 / 9.81, rel=0.03)
    assert found["motion"]["recording"]["position_noise"] == pytest.approx(1e-5, rel=0.1)
    assert found["holds"] is True
    assert found["pace"]["nominal"]["factor"] == pytest.approx(np.sqrt(PEAK / 0.81 / 9.81 / 0.5), rel=0.03)


def test_a_joint_file_of_the_scenarios_arm(tmp_path):
    t, q = joint_motion(duration=4.0)
    path = write_csv(tmp_path / "a.csv", "t," + ",".join(JOINTS), t, q)
    result = audit(path, scenarios.load("panda-cube"))
    assert result.nominal.ok
    assert result.summary()["motion"]["peak_tilt"] > 0.05


def test_inside_a_gap_nothing_is_known_and_outside_of_it_all_that_was():
    t = np.arange(0, 1.0005, 0.005)
    there = (t < 0.42) | (t > 0.58)
    p = np.stack([0.2 * t**3 * (10 - 15 * t + 6 * t**2), 0 * t, 0 * t], axis=1)
    quat = np.tile([1.0, 0, 0, 0], (len(t), 1))
    found = tray_motion(TraySamples(t[there], p[there], quat[there], "E", "seen.csv"), None, AT_B, NO_TURN)
    begin, end = t[there][t[there] < 0.5].max(), t[there][t[there] > 0.5].min()
    inside = (found.samples.t > begin) & (found.samples.t < end)
    assert inside.any()
    assert np.isinf(found.acceleration_error[inside]).all()
    assert np.isfinite(found.acceleration_error[~inside]).all()
