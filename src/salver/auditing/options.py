"""Options of an audit: its assumptions and its confidence."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from salver.errors import SalverError


@dataclass(frozen=True)
class AuditOptions:
    """Options of an audit: its assumptions and confidence, each with the effect of doubling it.

    highest: Hz, above which nothing shakes the tray. Twice the sampling rate is asked for, and noise hides four times
        the acceleration at the highest frequency.
    noise: standard deviation of the samples, m (rad of joints); None: found in them. Half as sensitive to motion.
    longest_gap: s without samples that a curve bridges; None: 0.02 s, or 3.5 steps. Longer guesses are judged.
    fewest: samples, below which noise is not told from motion. Recordings must be twice as long.
    false_alarm: probability that noise alone is taken for motion, for each kind of window. Slightly faster curves.
    hideable: standard deviations, over its window, of a shake that is always found. Doubled, noise hides twice as much.
    certain: standard deviations in the error of an acceleration. Twice the error; more motions are on the edge.
    negligible: m/s^2, amplitude of an oscillation that is let be. Slower curves.
    usual: Hz, bandwidth of a curve that follows no more than it must. Faster curves, more noise in accelerations.
    noticed: m, slide that the engine does not count either (`salver.simulation.outcome.Thresholds`).
    hidden: m, slide that noise may hide at the worst. Fewer recordings cannot be told, and some are wrong.
    fiercest: m/s^2 that no arm reaches (the fastest delta robots do). Errors of the samples become violations.
    nearest, furthest: m from the origin, beyond which positions are in another unit.
    drop: factor of power over which noise ends at a filter. Weaker filters are not seen.
    break_off: size of a break over what usual samples are off their neighbours. Smaller breaks become jolts.
    softening: c of a sloshing mode whose frequency is f (1 - c (a / R)^2) at height a: 0.07 to 0.3 in cups 0.6 to 1.5 R
        deep, by nonlinear potential flow (tests/potential_flow.py). Resonance is said further from it.
    runaway: height over that of linear sloshing, above which it is said to be near resonance. Said later.
    narrow: m, radius or half side, below which sloshing was seen up to `rise` higher than predicted.
    rise: share of the height, in such a glass.
    """

    highest: float = 50.0
    noise: float | None = None
    longest_gap: float | None = None
    fewest: int = 32
    false_alarm: float = 0.005
    hideable: float = 7.0
    certain: float = 4.5
    negligible: float = 0.02
    usual: float = 12.0
    noticed: float = 5e-4
    hidden: float = 2e-3
    fiercest: float = 150.0
    nearest: float = 2e-3
    furthest: float = 20.0
    drop: float = 30.0
    break_off: float = 8.0
    softening: float = 0.3
    runaway: float = 1.25
    narrow: float = 0.025
    rise: float = 0.2

    _ASKED: ClassVar = (("highest", 1e-3, 1e4), ("noise", 0.0, 1.0), ("longest_gap", 0.0, 3600.0))

    def __post_init__(self) -> None:
        for name, least, most in self._ASKED:
            value = getattr(self, name)
            if value is not None and not least <= value <= most:
                option = name.removeprefix("longest_")
                raise SalverError(f"--{option} {value:g} was asked for; it must be from {least:g} to {most:g}.")


DEFAULT = AuditOptions()
