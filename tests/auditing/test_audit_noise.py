"""What of recorded samples is noise, and which curve is the rest."""

from types import SimpleNamespace

import numpy as np
import pytest
from scipy import signal
from scipy.interpolate import BSpline

import salver as sv
from recorded_motions import line
from salver.auditing.motion import _gains
from salver.auditing.noise import NoiseLevel, Spectrum, filtered_at, resolution, standing_out
from salver.auditing.options import DEFAULT
from salver.auditing.recorded import read_motion, sensor_of
from salver.auditing.spline import DEGREE, Fit, fit
from salver.geometry import exp, log, quat_wxyz_from_matrix
from salver.models.arm.arm import load_arm

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


@pytest.mark.parametrize("bandwidth", [8.0, 20.0])
def test_the_stated_error_of_the_acceleration_is_that_of_unit_noise_in_each_sample(bandwidth):
    """A fit is linear in its samples: the deviation is the norm of what one unit in each of them does."""
    t = np.linspace(0, 2, 801)
    at = np.concatenate([[0.0, 0.01, 0.02, 0.04, 1.96, 2.0], np.linspace(0.9, 1.1, 41)])
    curve = fit(t, np.eye(801), np.full(801, bandwidth))
    stated, seen = curve.acceleration_error(at, t[1]), np.linalg.norm(curve(at)[2], axis=1)
    # Never less than it is; at the ends it is that of a curve with all its knots, which is more.
    assert np.all(seen < 1.02 * stated)
    assert seen[6:].max() > 0.98 * stated[6:].max()  # at the knots it is larger than between them


# Noise --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("noise", [1e-6, 1e-4, 1e-3])
@pytest.mark.parametrize("rate", [100, 1000])
def test_noise_is_measured_under_a_motion(noise, rate):
    s = line(2.0, rate)
    p = s.p_SB + noise * np.random.default_rng(2).standard_normal(s.p_SB.shape)
    assert sensor_of(s.t, p, s.quat_SB_wxyz).position.size == pytest.approx(noise, rel=0.05)


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
        sizes += [found.position.size, 1e3 * found.orientation.size]
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
    assert sensor.orientation.size == pytest.approx(1e-3, rel=0.1)
    part = read_motion(t, p, quat, sensor, DEFAULT)
    assert part.bandwidth.max() < 10


def test_between_the_outermost_samples_a_curve_that_moves_bends_as_it_does_two_samples_inside():
    """Nothing is known beyond the end. A sine cut while it swings; the other end begins at rest and is left alone."""
    t = np.arange(0, 1.0, 0.01)
    p = np.stack([0.1 * (1 - np.cos(5 * t)), 0 * t, 0 * t], axis=1)
    p += np.random.default_rng(0).normal(scale=1e-5, size=p.shape)
    quat = np.tile([1.0, 0, 0, 0], (len(t), 1))
    part = read_motion(t, p, quat, sensor_of(t, p, quat), DEFAULT)
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
        assert sensor_of(t, p, quat).position.size < 1e-6 * np.abs(y).max()


def test_white_noise_is_hardly_ever_taken_for_motion():
    alarms = 0
    for seed in range(40):
        y = np.random.default_rng(seed).standard_normal((1000, 3))
        alarms += any(len(found.first) for found in standing_out(y, 500.0, NoiseLevel(1.0), 1e-9, DEFAULT.false_alarm))
    assert alarms <= 12  # the probability is 0.1 each; more than 12 of 40 would come by chance once in 10^4


@pytest.mark.parametrize(
    ("frequency", "cycles"), [(50, 1), (5, 4), *(pytest.param(*x, marks=pytest.mark.slow) for x in ((50, 16), (20, 8)))]
)
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
        hits = [
            np.any((found.first < first + count) & (found.last > first))
            for found in standing_out(y, rate, NoiseLevel(1.0), 1e-9, DEFAULT.false_alarm)
        ]
        missed += not any(hits)
    assert missed <= 2


@pytest.mark.parametrize("frequency", [5.0, 31.25, 120.0])
def test_an_oscillation_of_negligible_acceleration_is_let_be(frequency):
    """Without noise: its amplitude times its angular frequency squared decides, to what windows see of it."""
    t = np.arange(2048) / 500
    for share in (0.8, 1.25):
        y = np.zeros((2048, 3))
        y[:, 1] = share * 0.02 / (2 * np.pi * frequency) ** 2 * np.sin(2 * np.pi * frequency * t)
        long = standing_out(y, 500.0, NoiseLevel(1e-12), 0.02, DEFAULT.false_alarm)[-1]  # over the whole recording
        assert (len(long.frequency) > 0) == (share > 1), share
        assert long.frequency == pytest.approx(np.full(len(long.frequency), frequency), abs=0.3)


def test_noise_of_a_band_is_found_at_the_quietest():
    """One frequency is far above it; the error that is stated is that of its size."""
    t = np.arange(4096) / 100
    y = np.random.default_rng(0).standard_normal((4096, 3)) + 5 * np.sin(2 * np.pi * 31 * t)[:, None]
    found = Spectrum.of(t, y)
    assert found.noise == pytest.approx(1.0, rel=0.05)
    off = np.abs(found.sizes[found.edges < 20] - 1) / found.errors[found.edges < 20, None]
    assert 0.3 < np.sqrt(np.mean(off**2)) < 1.7
    assert off.max() < 4


def test_a_filter_is_where_the_noise_of_an_axis_ends():
    """At 12 Hz, of 4 s with a move along one axis; not in the same noise unfiltered, nor in the move alone."""
    t = np.arange(2001) / 500
    u = t / 4
    y = np.outer(0.5 * u**3 * (10 - 15 * u + 6 * u**2), [1.0, 0.5, 0.2])
    noise = 1e-5 * np.random.default_rng(1).standard_normal(y.shape)
    smooth = signal.sosfiltfilt(signal.butter(2, 12.0, fs=500, output="sos"), noise, axis=0)
    assert 4 < filtered_at(t, y + smooth, DEFAULT.drop, DEFAULT.fewest) < 20
    assert (
        filtered_at(t, y + noise, DEFAULT.drop, DEFAULT.fewest)
        == filtered_at(t, y, DEFAULT.drop, DEFAULT.fewest)
        == np.inf
    )


def test_resolution_is_the_step_of_rounded_values_and_of_nothing_else():
    t = np.linspace(0, 1, 500)
    y = np.sin(3 * t)[:, None]
    assert resolution(np.round(y, 3)) == pytest.approx(1e-3, rel=1e-6)
    assert resolution(y) == 0
    assert resolution(0.002 * np.arange(500.0)[:, None]) == 0  # constant speed
    assert resolution(np.full((500, 3), 0.4)) == 0


def test_the_spacing_of_knots_is_the_least_of_three_intervals():
    """Of the one that holds a time and of its neighbours, at the ends too."""
    knots = np.cumsum([0.0, 1.0, 3.0, 2.0, 5.0, 4.0])
    spline = BSpline(np.pad(knots, DEGREE, mode="edge"), np.zeros((len(knots) + DEGREE - 1, 1)), DEGREE)
    spacing = Fit(spline).spacing(np.array([0.5, 2.0, 5.0, 8.0, 14.9]))
    assert spacing.tolist() == [1.0, 1.0, 2.0, 2.0, 4.0]


def test_a_filter_shows_in_a_recording_of_little_more_than_a_second():
    """Noise filtered at 6 Hz, of which 1.2 s at 100 Hz are saved: it shows in some, and in none without it."""
    t = np.arange(600) / 500
    claimed = []
    for seed in range(20):
        noise = 4e-5 * np.random.default_rng(seed).standard_normal((len(t), 3))
        smooth = signal.sosfiltfilt(signal.butter(4, 6.0, fs=500, output="sos"), noise, axis=0)
        claimed.append(
            [np.isfinite(filtered_at(t[::5], y[::5], DEFAULT.drop, DEFAULT.fewest)) for y in (smooth, noise)]
        )
    assert np.sum(claimed, axis=0)[0] >= 4
    assert np.sum(claimed, axis=0)[1] == 0


def test_noise_of_joints_is_taken_to_move_the_tray_as_it_does():
    """By 2000 postures with noise in all joints, to a tenth: the place along each axis, and half the angle about it."""
    case, noise = sv.load_scenario("ur10-bottle"), 1e-5
    arm, q = load_arm(case.arm, case.tray), np.array([-0.51, -1.2, 2.02, -2.39, 1.571, -1.06])
    p, R = arm.tray_pose(q)
    poses = [arm.tray_pose(each) for each in q + noise * np.random.default_rng(4).standard_normal((2000, 6))]
    aside = np.std([each - p for each, _ in poses]) / noise
    turned = np.std([log(R.T @ each) for _, each in poses]) / noise
    assert _gains(arm, SimpleNamespace(y=q[None])) == pytest.approx((aside, 0.5 * turned), rel=0.1)
