"""The rivals of the audit's survey: motions that the same samples allow."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parents[2] / "benchmarks"))

import audit_recordings
import audit_rivals


def drawn(arm: bool, seed: int = 3):
    for index in range(40):
        rng = np.random.default_rng([seed, index])
        scenario, motion, *_ = audit_recordings.draw(rng)
        if (motion.arm is not None) == arm:
            return scenario, motion
    raise AssertionError("no such motion was drawn")


@pytest.mark.slow
@pytest.mark.parametrize("arm", [False, True], ids=["tray", "joints"])
def test_a_hidden_shake_has_the_energy_that_noise_hides(arm):
    scenario, motion = drawn(arm)
    rate, noise = 250.0, 1e-4
    sampled = np.arange(0, motion.duration, 1 / rate)
    (other,) = audit_rivals.rivals(scenario, motion, rate, noise)
    added = other.coordinates(sampled) - motion.coordinates(sampled)
    energy = np.sum(added**2) / motion.deviation(noise) ** 2
    assert np.sqrt(energy) == pytest.approx(audit_rivals.SNR, rel=0.02)


@pytest.mark.slow
def test_what_is_mirrored_differs_nowhere_that_it_was_sampled():
    rate = 60.0
    scenario, motion = drawn(arm=False)
    sampled = np.arange(int(motion.duration * rate) + 1) / rate
    (other,) = audit_rivals.rivals(scenario, motion, rate, 0.0)
    between = sampled[:-1] + 0.5 / rate
    seen, unseen = (np.abs(other.tray(t).p_SB - motion.tray(t).p_SB).max() for t in (sampled, between))
    assert seen < 1e-3 * unseen
    assert unseen > 0
