"""From recorded poses to accelerations, how certain they are, and what of a motion the samples do not say."""

import numpy as np
import pytest

from recorded_motions import GOAL, HEADER, JOINTS, START, joint_motion, line, write_csv
from salver import scenario as scenarios
from salver.auditing.motion import _slowest, tray_motion
from salver.auditing.options import DEFAULT, AuditOptions
from salver.auditing.recorded import LEVER, read_motion, sensor_of
from salver.auditing.spline import fit
from salver.errors import FileFormatError
from salver.geometry import exp, log, quat_wxyz_from_matrix
from salver.models.arm.arm import load_arm
from salver.motion_files.readers import read
from salver.motion_files.samples import JointSamples, TraySamples, tray_samples
from salver.planning.follow import forward
from salver.trajectory import JointMotion, min_jerk_line

GIBBS = 0.135  # of a step of the acceleration, by which a least-squares quintic overshoots it: tested below


@pytest.fixture(scope="module")
def arm():
    case = scenarios.load("panda-cube")
    return load_arm(case.arm, case.tray)


def one(t, y, noise=0.0):
    p = np.stack([0 * t, y, 0 * t], axis=1) + noise * np.random.default_rng(7).standard_normal((len(t), 3))
    quat = np.tile([1.0, 0, 0, 0], (len(t), 1))
    return read_motion(t, p, quat, sensor_of(t, p, quat), DEFAULT)


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


@pytest.mark.parametrize("axis", [[1.0, 0.0, 0.0], [-0.6, 0.0, 0.8]])
def test_a_shake_in_turning_counts_as_one_of_place_at_the_lever_and_by_the_tilt_of_gravity(axis):
    """By an angle a at angular frequency w: (lever + g / w^2) a; the same windows find the same amplitudes."""
    t, omega, angle = np.arange(401) / 200, 2 * np.pi * 93, 2e-3
    shake, still = np.sin(omega * t), np.zeros((len(t), 3))
    level, turned = np.tile([1.0, 0, 0, 0], (len(t), 1)), quat_wxyz_from_matrix(exp(angle * np.outer(shake, axis)))
    moved = np.outer((LEVER + 9.81 / omega**2) * angle * shake, [0.0, 1.0, 0.0])
    turning, moving = (read_motion(t, p, q, sensor_of(t, p, q), DEFAULT) for p, q in ((still, turned), (moved, level)))
    each, same = (np.concatenate([cells.amplitude for cells in part.unseen]) for part in (turning, moving))
    assert len(each) == len(same) > 10
    np.testing.assert_allclose(each, same, rtol=2e-3)


@pytest.mark.parametrize("turns", [False, True])
def test_what_a_curve_misses_near_the_samplings_limit_is_told_of_what_is_fast(turns):
    """A quarter of the acceleration at the limit; whether it is the place or the turning that is so fast."""
    t = np.arange(801) / 400
    shake, slow = np.sin(2 * np.pi * 75 * t), np.sin(2 * np.pi * t)
    y, angle = (0.05 * slow, 1e-2 * shake) if turns else (1e-3 * shake, 0.1 * slow)
    p = np.stack([0 * t, y, 0 * t], axis=1)
    quat = quat_wxyz_from_matrix(exp(np.outer(angle, [0.0, 0.0, 1.0])))
    part = read_motion(t, p, quat, sensor_of(t, p, quat), DEFAULT)
    share = part.missed / np.maximum(np.linalg.norm(part.motion.a_S, axis=1), 1e-9)
    assert np.median(share) > 0.05
    assert share.max() < 0.26


@pytest.mark.slow
def test_where_two_parts_of_a_long_recording_meet_there_is_one_instant():
    """Of two at once waves would be no numbers."""
    t = np.arange(20 * 1000 + 1) / 1000.0
    p = np.stack([0 * t, 0.2 * np.sin(2 * np.pi * 0.4 * t), 0 * t], axis=1)
    seen = TraySamples(t, p, np.tile([1.0, 0, 0, 0], (len(t), 1)), "seen.csv")
    motion = tray_motion(seen, None).samples
    assert np.diff(motion.t).min() > 1e-5
    assert (motion.t[0], motion.t[-1]) == (t[0], t[-1])
    expected = -0.2 * (2 * np.pi * 0.4) ** 2 * np.sin(2 * np.pi * 0.4 * motion.t)
    assert np.abs(motion.a_S[:, 1] - expected)[50:-50].max() < 1e-4


@pytest.mark.parametrize("rate", [20, 100, 1000])
def test_a_step_between_two_samples_is_told_whatever_it_does_to_the_load(rate):
    t = np.arange(2 * rate + 1) / rate
    p = np.zeros((len(t), 3))
    p[t > 1, 1] = 0.02
    seen = TraySamples(t, p, np.tile([1.0, 0, 0, 0], (len(t), 1)), "seen.csv")
    doubts = dict(tray_motion(seen, None).doubts)
    assert doubts["jump"] == f"the position jumps by 20 mm from 1.000 s to {1 + 1 / rate:.3f} s"


def test_noise_that_is_stated_of_joints_reaches_the_tray_through_the_jacobian(arm):
    """Independent noise s in all joints has the covariance s^2 J J^T at the tray: s |J| / sqrt(3) of each component; a
    quaternion's components move by half the angle. J by differences of the tray's pose."""
    q, h, noise = np.array([0.4, 1.2, -0.7, -1.9, -2.1, 1.1, 1.3]), 1e-6, 2e-4
    ends = [(arm.tray_pose(q + h * unit), arm.tray_pose(q - h * unit)) for unit in np.eye(7)]
    moved = np.array([(a[0] - b[0]) / (2 * h) for a, b in ends])
    turned = np.array([log(b[1].T @ a[1]) / (2 * h) for a, b in ends])
    samples = JointSamples(np.arange(200) / 100, JOINTS, np.tile(q, (200, 1)), None, None, "by hand")
    sensor = tray_motion(samples, arm, AuditOptions(noise=noise)).recording.sensor
    assert sensor.position.size == pytest.approx(noise * np.linalg.norm(moved) / np.sqrt(3), rel=1e-6)
    assert sensor.orientation.size == pytest.approx(0.5 * noise * np.linalg.norm(turned) / np.sqrt(3), rel=1e-6)


def test_the_bandwidths_that_are_told_are_the_least_and_the_most():
    """A slow line with a jolt of 30 Hz in it, without noise."""
    t = np.arange(3001) / 1000
    jolt = 1e-3 * np.sin(2 * np.pi * 30 * (t - 1.4)) * np.exp(-(((t - 1.5) / 0.05) ** 2))
    truth = min_jerk_line(3.0, START, GOAL, np.eye(3), np.eye(3)).sample(t)
    seen = TraySamples(t, truth.p_SB + jolt[:, None], truth.quat_SB_wxyz, "by hand")
    bandwidth = tray_motion(seen, None, AuditOptions(noise=1e-6)).recording.bandwidth
    least, most = bandwidth.min(), bandwidth.max()
    assert least < 30 < 55 < most


@pytest.mark.parametrize(
    ("speed", "least"),
    [
        ([1.0, 0.2, 0.97, 0.5, 0.05, 0.31], (0.2, 0.05)),
        ([1.0, 0.5, 0.2], (1.0, 0.2)),
        ([0.3, 0.1, 0.6, 0.4, 0.5], (0.1, 0.4)),
    ],
)
def test_the_least_speed_is_looked_for_between_an_end_and_where_it_is_last_as_fast(speed, least):
    assert _slowest(np.array(speed)) == least
    assert _slowest(np.array(speed[::-1])) == least[::-1]


def test_quaternions_of_nearly_unit_norm_are_made_unit_and_others_refused():
    t, p = np.arange(40) / 100, np.zeros((40, 3))
    quat = quat_wxyz_from_matrix(exp(np.outer(t, [0.1, 0.2, 0.3])))
    for norm in (0.985, 1.015):
        assert tray_samples(t, p, norm * quat, "by hand").quat_wxyz == pytest.approx(quat, abs=1e-12)
    for norm in (0.975, 1.025, 0.5, 2.0, 0.0):
        wrong = quat.copy()
        wrong[7] *= norm
        with pytest.raises(FileFormatError, match=rf"the quaternion of sample 8 has norm {norm:.4g};"):
            tray_samples(t, p, wrong, "by hand")


def test_four_digits_of_quaternions_are_a_resolution(tmp_path):
    t = np.arange(500) / 500
    quat = quat_wxyz_from_matrix(exp(np.outer(t**2, [0.1, 0.2, 0.3])))
    path = write_csv(tmp_path / "a.csv", HEADER, t, np.tile(START, (len(t), 1)), np.round(quat, 4))
    s = read(path)
    assert sensor_of(s.t, s.p, s.quat_wxyz).orientation.step == pytest.approx(1e-4, rel=1e-4)


def test_steps_of_a_resolution_hide_as_much_of_the_acceleration_all_along():
    t = np.arange(400) / 100
    found = one(t, np.round(0.3 * np.sin(np.pi * t), 3))
    inside = (found.motion.t > 1.5) & (found.motion.t < 2.5)
    assert np.ptp(found.bandwidth) == 0
    assert found.acceleration_error[inside] == pytest.approx(0.5, abs=0.05)
    assert np.ptp(found.acceleration_error[inside]) < 1e-9


def test_uneven_times_are_no_noise(tmp_path):
    rng = np.random.default_rng(3)
    t = np.arange(1501) / 1000 + 2e-4 * rng.uniform(-1, 1, 1501)
    truth = min_jerk_line(1.5, START, GOAL, np.eye(3), np.eye(3)).sample(t)
    sensor = sensor_of(t, truth.p_SB, truth.quat_SB_wxyz)
    assert sensor.position.size < 1e-9


def test_turning_about_a_fixed_axis(tmp_path):
    t = np.arange(0, 2.0005, 1e-3)
    u = t / 2
    angle = 1.2 * (10 * u**3 - 15 * u**4 + 6 * u**5)
    axis = np.array([1.0, 2.0, 2.0]) / 3
    quat = quat_wxyz_from_matrix(exp(np.outer(angle, axis)))
    samples = read(write_csv(tmp_path / "a.csv", HEADER, t, np.tile(START, (len(t), 1)), quat))
    motion = tray_motion(samples, None).samples
    v = motion.t / 2
    assert np.allclose(motion.omega_B, np.outer(0.6 * (30 * v**2 - 60 * v**3 + 30 * v**4), axis), atol=1e-5)
    inner = slice(1, -1)  # at the ends it turns as two samples inside
    assert np.allclose(
        motion.alpha_B[inner], np.outer(0.3 * (60 * v - 180 * v**2 + 120 * v**3), axis)[inner], atol=1e-3
    )


def test_the_tray_of_a_moving_arm_against_differences_of_its_pose(arm):
    t, q = joint_motion()
    h, k = 1e-4, 700
    u = t / 2
    direction = np.array([0.5, 0.1, -0.1, 0.1, 0.1, 0.0, 0.2])
    dq = np.outer((30 * u**2 - 60 * u**3 + 30 * u**4) / 2, direction)
    ddq = np.outer((60 * u - 180 * u**2 + 120 * u**3) / 4, direction)
    motion = forward.tray_motion(arm, JointMotion(t[k : k + 1], q[k : k + 1], dq[k : k + 1], ddq[k : k + 1]))

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


def test_inside_a_gap_nothing_is_known_and_outside_of_it_all_that_was():
    t = np.arange(0, 1.0005, 0.005)
    there = (t < 0.42) | (t > 0.58)
    p = np.stack([0.2 * t**3 * (10 - 15 * t + 6 * t**2), 0 * t, 0 * t], axis=1)
    quat = np.tile([1.0, 0, 0, 0], (len(t), 1))
    found = tray_motion(TraySamples(t[there], p[there], quat[there], "seen.csv"), None)
    begin, end = t[there][t[there] < 0.5].max(), t[there][t[there] > 0.5].min()
    inside = (found.samples.t > begin) & (found.samples.t < end)
    assert inside.any()
    assert np.isinf(found.acceleration_error[inside]).all()
    assert np.isfinite(found.acceleration_error[~inside]).all()


@pytest.mark.parametrize("seed", range(4))
def test_place_and_turn_end_alike(seed):
    """A tray that turns sharply, 0.13 m below a point that moves gently, by a sensor that knows places better than
    turns. At the ends the point bends as two samples inside, 0.2 to 0.3 m/s^2 off the truth, and not by as much as the
    tray alone; that is so where one of the two is taken to be at rest there and the other is not (seeds 0 and 2)."""
    rng, duration, arm = np.random.default_rng(seed), 0.5, np.array([0.0, 0.0, 0.13])
    t = np.linspace(0, duration, 501)
    u = t / duration
    turned = exp((0.4 * 64 * u**3 * (1 - u) ** 3)[:, None] * np.array([0.0, 1.0, 0.0]))
    p = (0.2 * u**3 * (10 - 15 * u + 6 * u**2))[:, None] * np.array([1.0, 0.0, 0.0]) - turned @ arm
    quat = np.array([quat_wxyz_from_matrix(rotation) for rotation in turned])
    p, quat = p + 1e-9 * rng.standard_normal(p.shape), quat + 3e-6 * rng.standard_normal(quat.shape)
    motion = read_motion(t, p, quat, sensor_of(t, p, quat), DEFAULT).motion
    omega, alpha = (np.einsum("tij,tj->ti", motion.R_SB, x) for x in (motion.omega_B, motion.alpha_B))
    r = motion.R_SB @ arm
    a = motion.a_S + np.cross(alpha, r) + np.cross(omega, np.cross(omega, r))
    v = motion.t / duration
    true = 0.2 / duration**2 * (60 * v - 180 * v**2 + 120 * v**3)
    assert np.abs(a[:, 0] - true).max() < 0.5
