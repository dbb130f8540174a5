"""How far a load could slide by what noise hides: against a block integrated by hand and the engine."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from salver import scenario as scenarios
from salver.auditing import AuditOptions, audit
from salver.auditing.doubts import Borne
from salver.auditing.motion import AuditedMotion, RecordingQuality
from salver.auditing.noise import NoiseLevel
from salver.auditing.options import DEFAULT
from salver.auditing.recorded import Sensor
from salver.auditing.slip import hidden, per_cycle
from salver.simulation.physics import simulate_tray
from salver.trajectory import MotionSamples

CUBE = scenarios.load("panda-cube")  # friction 0.5: it slides at 4.905 m/s^2


@pytest.mark.parametrize("share", [0.02, 0.1, 0.3, 0.5, 0.8, 0.95])
def test_the_slide_of_a_cycle_is_that_of_newmarks_block(share):
    amplitude, frequency = 1e-3, 5.0
    size = amplitude * (2 * np.pi * frequency) ** 2
    steps = 20_000
    h, v, moved = 1 / frequency / steps, 0.0, [0.0]
    for _ in range(4):
        x = 0.0
        for k in range(steps):
            v = max(0.0, v + h * size * (np.sin(2 * np.pi * k / steps) - share))
            x += h * v
        moved.append(x)
    bound = float(per_cycle(np.array(amplitude), np.array(frequency), np.array(share * size)))
    assert 0.7 * bound < moved[-1] < 1.001 * bound


def test_the_engine_slides_no_further_than_the_bound(tmp_path):
    # Ten cycles of 50 Hz, 0.06 mm, at the peak of a sway that needs half of the friction.
    case = CUBE.with_changes(objects__0__uncertainty={}, physics__settle_after=0.1)
    frequency, cycles, sway = 50.0, 10, 0.5 * 4.905
    size = 3 * 0.5 * 4.905
    begin = 0.25 - 0.5 * cycles / frequency

    class Shaken:
        duration = 0.5

        def sample(self, t):
            t = np.atleast_1d(np.asarray(t, dtype=float))
            inside = (t >= 0) & (t <= self.duration)
            shake = (t > begin) & (t < begin + cycles / frequency)
            a = np.where(inside, sway * np.sin(2 * np.pi * t), 0.0)
            a = a + np.where(shake, size * np.sin(2 * np.pi * frequency * (t - begin)), 0.0)
            zero, still = np.zeros((len(t), 3)), np.tile(np.eye(3), (len(t), 1, 1))
            return MotionSamples(t, zero, zero, np.stack([0 * t, a, 0 * t], axis=1), still, zero, zero)

    slip = float(simulate_tray(Shaken(), case).slip.max())
    u = np.linspace(begin, begin + cycles / frequency, 1001)
    amplitude = np.full(1001, size / (2 * np.pi * frequency) ** 2)
    each = per_cycle(amplitude, np.array(frequency), 4.905 - sway * np.sin(2 * np.pi * u))
    bound = cycles * float(each.mean())
    assert 0.6 * bound < slip < bound


def standing(noise, rate):
    """A recording of 4 s of a tray that stands."""
    t = np.arange(round(4 * rate) + 1) / rate
    zero, level = np.zeros((len(t), 3)), np.tile(np.eye(3), (len(t), 1, 1))
    quality = RecordingQuality(
        Sensor(NoiseLevel(noise), NoiseLevel(0.0)), rate, np.full(len(t), 5.0), (0.0, 0.0), (0.0, 0.0)
    )
    return AuditedMotion(MotionSamples(t, zero, zero, zero, level, zero, zero), recording=quality)


def test_a_motion_is_unsure_where_it_is_too_much_by_less_than_its_error():
    """0.5 m/s^2 by noise, 0.1 between samples and 0.2 by what swings in the load."""
    motion = replace(standing(1e-9, 1.0), acceleration_error=0.5, missed=0.1)
    borne = Borne(motion, np.array([-0.9, -0.7, -1e-9, 0.0, 0.3]), 5.0, pushed=0.2)
    assert borne.unsure.tolist() == [False, True, True, False, False]


def test_what_samples_are_too_few_to_show_is_said_where_most_is_missing():
    """Of 5 m/s^2 of reserve, samples leave open 6 from 1 s on, for 0.1 s: a block would move by 5 mm."""
    motion = standing(1e-9, 500.0)
    t = motion.samples.t
    missed = np.where(np.abs(t - 1.05) < 0.05, 6.0, np.where(t > 3, 2.0, 0.1))
    (doubt,) = Borne(replace(motion, missed=missed), np.full(len(t), 5.0), 5.0).unseen()
    assert doubt[0] == "unresolved"
    assert doubt[1].startswith("at 1.002 s the motion is so fast that 500 samples a second show its acceleration only")
    assert "only to 6 m/s^2: twice as many would tell" in doubt[1]
    assert Borne(replace(motion, missed=0.5 * missed), np.full(len(t), 5.0), 5.0).unseen() == []


def test_a_hidden_shake_slides_only_where_the_reserve_is_small():
    """0.1 mm of noise at 500 Hz, and a reserve of 0.5 m/s^2 at t = 2 s alone: a cycle of 50 Hz has an amplitude of
    7 sigma sqrt(2 f / rate), and in 0.04 s there are two of them."""
    noise, rate = 1e-4, 500.0
    motion = standing(noise, rate)
    t = motion.samples.t
    found = []
    for long in (0.04, 0.2, 1.0, 9.0):
        found.append(hidden(motion, np.where(np.abs(t - 2) < long / 2, 0.5, 50.0), 5.0)[0])
        assert found[-1].time == pytest.approx(2, abs=0.5 * long + 0.02)
    amplitude = DEFAULT.hideable * noise * np.sqrt(2 * DEFAULT.highest / rate)
    one = float(per_cycle(amplitude, DEFAULT.highest, np.array(0.5)))
    assert one < found[0].distance < 2.5 * one
    assert np.all(np.diff([slip.distance for slip in found]) > 0)
    worst, harmless = hidden(motion, np.full(len(t), 0.5), 5.0)
    assert 1.0 <= harmless < DEFAULT.highest
    slower = replace(motion, options=replace(DEFAULT, highest=harmless))
    assert hidden(slower, np.full(len(t), 0.5), 5.0)[0].distance <= DEFAULT.hidden < worst.distance


@pytest.mark.parametrize(("kinetic", "outcome"), [(1.0, "holds"), (0.5, "cannot_tell")])
def test_a_slide_that_noise_could_hide_is_only_accepted_if_it_stops(kinetic, outcome):
    """The tray leans by 0.4 rad, which friction 0.5 bears and 0.25 does not. With a shake of 0.085 mm at 25 Hz under
    this noise the engine slides the cube by 0.5 mm under friction 0.5 throughout, and by metres if it then halves."""
    t = np.arange(0, 6, 0.001)
    up, down = (np.polyval([6, -15, 10, 0, 0, 0], np.clip((t - begin) / 2, 0, 1)) for begin in (0.3, 3.7))
    half = 0.2 * (up - down)
    x, y, z = (np.array([0.5, 0.0, 0.4]) + 8e-5 * np.random.default_rng(3).standard_normal((len(t), 3))).T
    columns = {"t": t, "x": x, "y": y, "z": z, "qw": np.cos(half), "qx": np.sin(half), "qy": 0 * t, "qz": 0 * t}
    case = CUBE.with_changes(physics__kinetic_friction=kinetic)
    found = audit(columns, case, options=AuditOptions(highest=30.0))
    assert found.outcome == outcome
    assert ("kinetic" in found.worst.details.get("reasons", [])) == (kinetic < 1)
