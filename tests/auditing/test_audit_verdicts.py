"""Audits that must not be fooled: violent, coarse, noisy and damaged recordings, with accelerations by hand."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from salver import scenario as scenarios
from salver.auditing import Audit, AuditOptions, audit
from salver.auditing.commanded import commanded_motion, open_questions
from salver.cli import app
from salver.errors import SalverError
from salver.models.arm.arm import load_arm
from salver.motion_files import JointSamples

JOINTS = tuple(f"panda_joint{i}" for i in range(1, 8))
Q0 = np.array([0.082565, 1.039634, -0.777333, -1.678140, -2.197384, 0.842888, 1.123073])
CUBE = scenarios.load("panda-cube")  # friction 0.5: it slides at 4.905 m/s^2


def written(path: Path, t: np.ndarray, y: np.ndarray, noise: float = 0.0, digits: int = 9) -> Path:
    p = np.stack([0.5 + 0 * t, y, 0.4 + 0 * t], axis=1)
    p = p + noise * np.random.default_rng(5).standard_normal(p.shape)
    rows = np.column_stack([t, p, np.tile([1.0, 0, 0, 0], (len(t), 1))])
    np.savetxt(
        path, rows, delimiter=",", header="t,x,y,z,qw,qx,qy,qz", comments="", fmt=["%.9g", *[f"%.{digits}f"] * 7]
    )
    return path


def of(folder: Path, t: np.ndarray, y: np.ndarray, noise: float = 0.0, **options: float) -> Audit:
    return audit(written(folder / "motion.csv", t, y, noise), CUBE, options=AuditOptions(**options))


def move(t: np.ndarray, duration: float = 2.5) -> np.ndarray:
    """Half a metre, minimum jerk: it needs 0.462 m/s^2."""
    u = np.clip(t / duration, 0, 1)
    return np.asarray(0.5 * (10 * u**3 - 15 * u**4 + 6 * u**5))


def twice(t: np.ndarray, a: np.ndarray) -> np.ndarray:
    step = t[1] - t[0]
    return np.asarray(np.cumsum(np.cumsum(a)) * step**2)


# Violent motions ----------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_the_shaken_tray(tmp_path):
    # 50 mm at 6 Hz, 71 m/s^2, coming up over 0.4 s as sin^2.
    t, fine = np.arange(2001) / 1000, np.linspace(0, 0.1, 10_001)
    y, before = (0.05 * np.sin(12 * np.pi * x) * np.sin(1.2 * np.pi * np.minimum(x, 5 / 12)) ** 2 for x in (t, fine))
    when = fine[np.argmax(np.abs(np.gradient(np.gradient(before, fine), fine)) > 4.905)]
    path = written(tmp_path / "shaken.csv", t, y)
    said = CliRunner().invoke(app, ["audit", str(path), "--scenario", "panda-cube"])
    assert said.exit_code == 3
    slides = float(said.stdout.split("Nominal: Cube on tray slides at ")[1].split(" s")[0])
    assert slides == pytest.approx(when, abs=2e-3)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(12))
def test_no_shake_above_the_friction_limit_holds(tmp_path, seed):
    rng = np.random.default_rng(seed)
    frequency, rate = np.exp(rng.uniform(0, np.log(25))), np.exp(rng.uniform(np.log(100), np.log(1000)))
    t = np.arange(int(2 * rate) + 1) / rate
    size = rng.uniform(1.5, 3) * 4.905 / (2 * np.pi * frequency) ** 2
    y = size * np.sin(2 * np.pi * frequency * t + rng.uniform(0, 6.28))
    assert of(tmp_path, t, y).outcome == "does_not_hold"


@pytest.mark.slow
@pytest.mark.parametrize("noise", [0.0, 1e-4])
def test_a_bump_of_50_ms(tmp_path, noise):
    t = np.arange(2501) / 1000
    bump = np.where((t > 1) & (t < 1.05), 10.0, 0) - np.where((t > 1.05) & (t < 1.1), 10.0, 0)
    found = of(tmp_path, t, move(t) + twice(t, bump), noise)
    assert found.outcome == "does_not_hold"
    assert found.nominal.details["time"] == pytest.approx(1.0, abs=0.02)


@pytest.mark.slow
def test_a_jolt_in_a_long_recording(tmp_path):
    # 0.12 s of 8 m/s^2 in 60 s, across the border of two of the stretches that are fitted (at 30 s of 15 000 samples).
    t = np.arange(15_001) / 250
    jolt = 8.0 * (((t > 29.94) & (t < 30)).astype(float) - ((t > 30) & (t < 30.06)))
    found = of(tmp_path, t, 0.2 * np.sin(0.2 * np.pi * t) + twice(t, jolt), 1e-5)
    assert found.outcome == "does_not_hold"
    assert found.nominal.details["time"] == pytest.approx(29.95, abs=0.03)


@pytest.mark.slow
def test_a_jump_between_two_samples(tmp_path):
    for rate in (10, 100, 1000):
        t = np.arange(2 * rate + 1) / rate
        found = of(tmp_path, t, np.where(t > 1, 0.1, 0.0))
        assert found.outcome == "cannot_tell"  # no tray does that: it is an error of the data
        assert f"the position jumps by 100 mm from 1.000 s to {1 + 1 / rate:.3f} s" in found.nominal.sentence


@pytest.mark.slow
def test_joints_are_judged_as_poses_are(tmp_path):
    # The first joint, upright, swings by a sin: the tray at distance r needs r a omega^2.
    arm = load_arm(CUBE.arm, CUBE.tray)
    radius = float(np.hypot(*arm.tray_pose(Q0)[0][:2]))
    t = np.arange(1001) / 500
    for share, outcome in ((0.5, "holds"), (1.5, "does_not_hold")):
        q = np.tile(Q0, (len(t), 1))
        q[:, 0] += share * 4.905 / radius / (2 * np.pi * 4) ** 2 * np.sin(2 * np.pi * 4 * t)
        np.savetxt(
            tmp_path / "a.csv", np.column_stack([t, q]), delimiter=",", header="t," + ",".join(JOINTS), comments=""
        )
        found = audit(tmp_path / "a.csv", CUBE)
        assert found.outcome == outcome
        assert found.margins.interfaces[0].friction_needed.max() == pytest.approx(0.5 * share, rel=0.03)


# What sampling and noise do not show --------------------------------------------------------------------------


@pytest.mark.slow
def test_a_gentle_motion_holds_at_any_usual_rate(tmp_path):
    for rate, highest in ((60, 25.0), (100, 50.0), (500, 50.0), (2000, 50.0)):
        t = np.arange(int(2.5 * rate) + 1) / rate
        found = of(tmp_path, t, move(t), highest=highest)
        assert found.outcome == "holds", found.nominal
        assert found.margins.interfaces[0].friction_needed.max() == pytest.approx(0.462 / 9.81, rel=0.02)


@pytest.mark.slow
@pytest.mark.parametrize(("frequency", "rate"), [(40, 50), (48, 50), (45, 60), (49, 98), (30, 62)])
def test_what_the_sampling_cannot_resolve_never_holds(tmp_path, frequency, rate):
    t = np.arange(3 * rate + 1) / rate
    size = 8 * 4.905 / (2 * np.pi * frequency) ** 2
    assert not of(tmp_path, t, size * np.sin(2 * np.pi * frequency * t + 0.7)).ok
    t = np.arange(1500 + 1) / 500
    assert of(tmp_path, t, size * np.sin(2 * np.pi * frequency * t + 0.7)).outcome == "does_not_hold"


def test_what_may_be_mirrored_at_the_sampling_rate_is_said_and_what_would_tell(tmp_path):
    """0.2 mm at 15 Hz, 1.8 m/s^2, would not slide the cube; at 60 samples a second 45 Hz, 16 m/s^2, looks like it."""
    t = np.arange(181) / 60
    y = move(t) + 2e-4 * np.sin(30 * np.pi * t + 0.7)
    found = of(tmp_path, t, y)
    for status in (found.nominal, found.worst):
        assert status.details["reasons"] == ["sampling"]
        assert "60 samples a second do not show a shake of up to 50 Hz: 125 a second would" in status.sentence
    assert of(tmp_path, t, y, highest=20.0).outcome == "holds"


def test_too_few_samples_a_second_are_said_and_what_would_tell(tmp_path):
    t = np.arange(51) / 10
    found = of(tmp_path, t, move(t, 5.0))
    assert found.outcome == "cannot_tell"
    assert "10 samples a second do not show a shake of up to 50 Hz: 125 a second would" in found.nominal.sentence
    assert of(tmp_path, t, move(t, 5.0), highest=3.0).outcome == "holds"


def test_too_few_samples_tell_no_noise_from_motion(tmp_path):
    for count in (31, 32):
        t = np.arange(count) / 250
        reasons = of(tmp_path, t, 0 * t).nominal.details.get("reasons", [])
        assert ("short" in reasons) == (count < 32)


def test_noise_that_could_hide_a_slide_is_said_and_what_would_tell(tmp_path):
    t = np.arange(626) / 250
    assert of(tmp_path, t, move(t), 1e-5).outcome == "holds"
    found = of(tmp_path, t, move(t), 5e-4)
    assert found.nominal.details["reasons"] == ["noise"]
    assert "would slide the load by up to" in found.nominal.sentence
    needed = float(found.nominal.sentence.split("is faster than ")[1].split(" Hz")[0])
    assert of(tmp_path, t, move(t), 5e-4, highest=needed).outcome == "holds"
    # A sensor that is said to be as noisy may hide as much, whatever the samples seem to say.
    stated = AuditOptions(noise=5e-4)
    assert audit(written(tmp_path / "motion.csv", t, move(t)), CUBE, options=stated).outcome == "cannot_tell"


def test_a_coarse_resolution_hides_what_is_smaller(tmp_path):
    t = np.arange(2501) / 1000
    assert audit(written(tmp_path / "a.csv", t, move(t), digits=5), CUBE).outcome == "holds"
    assert audit(written(tmp_path / "b.csv", t, move(t), digits=3), CUBE).outcome == "cannot_tell"


# Damaged recordings -------------------------------------------------------------------------------------------


@pytest.mark.parametrize("size", [0.5, 0.005])
def test_a_spike_is_found_and_said(tmp_path, size):
    t = np.arange(2501) / 1000
    y = move(t)
    y[1000] += size
    found = of(tmp_path, t, y)
    assert found.outcome == "cannot_tell"
    assert f"the sample at 1.000 s lies {1e3 * size:.3g} mm off its neighbours" in found.nominal.sentence


def test_a_gap_is_found_and_said_and_bridged_when_asked(tmp_path):
    t = np.arange(2501) / 1000
    t = t[(t < 1.0) | (t > 1.08)]
    found = of(tmp_path, t, move(t))
    assert found.nominal.details["reasons"] == ["gap"]
    assert "no samples for 0.082 s after t = 0.999 s" in found.nominal.sentence
    assert of(tmp_path, t, move(t), longest_gap=0.09).outcome == "holds"


def test_beginning_and_ending_at_speed_is_said(tmp_path):
    t = np.arange(1001) / 500
    steady = of(tmp_path, t, 0.5 * t)
    assert steady.nominal.details["reasons"] == ["speed"]
    assert "begins at 0.5 m/s and ends at 0.5 m/s" in steady.nominal.sentence
    # A sway passes through rest: what it does in the recording it can have done before. But that is not judged, and
    # said before the verdict.
    sway = of(tmp_path, t, 0.05 * np.sin(2 * np.pi * t))
    assert sway.outcome == "holds"
    assert sway.nominal.sentence.startswith(
        "Not judged: the recording begins at 0.31 m/s and ends at 0.31 m/s, and what came before and comes "
        "after is not in it. Everything holds;"
    )
    # One that only speeds up does not show that it can be stopped.
    cut = of(tmp_path, t, 0.1 * t**2)
    assert cut.nominal.details["reasons"] == ["speed"]
    assert "the recording ends at 0.4 m/s, and what comes after is not in it" in cut.nominal.sentence
    # A speed that a load bears to be brought to at once is none: v^2 / (2 x 4.905 m/s^2) is 0.9 mm.
    slow = of(tmp_path, t, 0.015 * np.sin(2 * np.pi * t))
    assert slow.nominal.sentence.startswith("Everything holds;")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("option", "value"),
    [("highest", np.nan), ("highest", np.inf), ("highest", 0.0), ("noise", -1.0), ("noise", 1e300), ("gap", -1.0)],
)
def test_what_cannot_be_asked_is_refused(option, value):
    with pytest.raises(SalverError, match=f"--{option} .* was asked for; it must be from "):
        AuditOptions(**{option.replace("gap", "longest_gap"): value})


def test_what_is_taken_for_granted_is_said_first(tmp_path):
    t = np.arange(626) / 250
    assert of(tmp_path, t, move(t), highest=20.0).worst.sentence.startswith(
        "Taken for granted: nothing shakes the tray faster than 20 Hz. Everything holds"
    )
    # A shake of 50 Hz, seen at its zeros only, is there in none of 100 samples a second.
    t = np.arange(251) / 100
    shaken = of(tmp_path, t, move(t) + 1e-3 * np.sin(2 * np.pi * 50 * t))
    assert shaken.nominal.sentence.startswith(
        "Taken for granted: nothing shakes the tray in step with the samples, at 50 Hz; 110 a second would show it. "
    )


@pytest.mark.slow
def test_odd_but_harmless_recordings_hold(tmp_path):
    rng = np.random.default_rng(0)
    t = np.arange(2501) / 1000
    assert of(tmp_path, t, 0 * t).outcome == "holds"
    uneven = t + 2e-4 * rng.uniform(-1, 1, len(t))
    assert of(tmp_path, uneven, move(uneven)).outcome == "holds"
    doubled = np.repeat(t, 2)
    assert of(tmp_path, doubled, move(doubled)).outcome == "holds"
    few = of(tmp_path, t[:20], 0 * t[:20])
    assert few.nominal.details["reasons"] == ["short"]


# Commands -----------------------------------------------------------------------------------------------------


def commanded(path: Path, t: list[float], turn: list[float], speed: list[float]) -> Path:
    points = [
        {"positions": [Q0[0] + a, *Q0[1:]], "velocities": [v, 0, 0, 0, 0, 0, 0], "time_from_start": now}
        for now, a, v in zip(t, turn, speed, strict=True)
    ]
    path.write_text(json.dumps({"joint_names": JOINTS, "points": points}))
    return path


def test_waypoints_with_velocities_bend_as_cubics_do(tmp_path):
    # A cubic from rest to rest over d in T begins at 6 d / T^2, at radius r of the first joint.
    arm = load_arm(CUBE.arm, CUBE.tray)
    radius = float(np.hypot(*arm.tray_pose(Q0)[0][:2]))
    found = audit(commanded(tmp_path / "a.json", [0, 1, 2], [0, 0.4, 0.4], [0, 0, 0]), CUBE)
    assert found.outcome == "holds"
    assert found.margins.interfaces[0].friction_needed.max() == pytest.approx(radius * 6 * 0.4 / 9.81, rel=0.02)
    assert "3 waypoints with velocities, joined by cubics as ros2_control's" in found.motion.notes[0]


def test_waypoints_without_velocities_are_no_command(tmp_path):
    path = commanded(tmp_path / "a.json", np.arange(40) * 0.1, [0.0] * 40, [0.0] * 40)
    message = json.loads(path.read_text())
    for point in message["points"]:
        del point["velocities"]
    path.write_text(json.dumps(message))
    assert audit(path, CUBE).outcome == "cannot_tell"


@pytest.mark.slow
def test_commands_that_leave_something_open(tmp_path):
    t = np.linspace(0, 2, 41)
    u = t / 2
    turn, speed = 0.2 * (3 * u**2 - 2 * u**3), 0.1 * (6 * u - 6 * u**2)
    assert audit(commanded(tmp_path / "a.json", t, turn, speed), CUBE).outcome == "holds"
    milliseconds = audit(commanded(tmp_path / "b.json", 1000 * t, turn, speed), CUBE)
    assert milliseconds.nominal.details["reasons"] == ["clock"]
    running = audit(commanded(tmp_path / "c.json", t[:30], turn[:30], speed[:30]), CUBE)
    assert running.nominal.details["reasons"] == ["speed"]


def test_velocities_in_degrees_are_told_from_those_that_are_only_large():
    t = np.linspace(0, 2, 41)
    q = np.outer(3 * (t / 2) ** 2 - 2 * (t / 2) ** 3, [0.1, -0.2])  # 0.3 rad in all
    dq = np.outer(3 * t / 2 - 3 * t**2 / 4, [0.1, -0.2])
    none, twenty, degrees = (
        open_questions(JointSamples(t, ("a", "b"), q, factor * dq, None, "a file")) for factor in (1, 20, 180 / np.pi)
    )
    assert none == twenty == []  # no unit is 20 others
    ((code, sentence),) = degrees
    assert code == "clock"
    assert "would move the joints by 17.2 rad in all, the positions by 0.3 rad" in sentence  # 180 / pi times 0.3


def test_the_peak_acceleration_of_a_long_quintic_between_two_waypoints_is_seen():
    """A minimum-jerk motion of 2 s: its peak is 10 / sqrt(3) / 2^2 of the way, to 0.1 %."""
    way, still = np.array([0.7, -1.2]), np.zeros((2, 2))
    q = 0.3 + np.outer([0, 1], way)
    ddq = commanded_motion(JointSamples(np.array([1.0, 3.0]), ("a", "b"), q, still, still, "by hand", commanded=True))[
        3
    ]
    assert ddq.max(axis=0) == pytest.approx(10 / np.sqrt(3) / 4 * np.abs(way), rel=1e-3)


def test_between_waypoints_are_instants_every_two_milliseconds_but_neither_few_nor_many():
    """50 ms are 25 intervals, 1 ms is no less than 3, and 1 s no more than 64."""
    t, q = np.array([0.2, 0.25, 0.251, 1.251]), np.outer([0.0, 0.1, 0.1, 0.3], [1.0, -2.0])
    samples = JointSamples(t, ("a", "b"), q, np.zeros_like(q), None, "by hand", commanded=True)
    found = commanded_motion(samples)[0]
    for begin, end, count in zip(t[:-1], t[1:], (25, 3, 64), strict=True):
        inside = found[(found > begin) & (found < end)]
        assert np.diff(inside) == pytest.approx((end - begin) / count, rel=1e-4)  # the ends are 1e-9 of it inside
        assert len(inside) == count + 1
