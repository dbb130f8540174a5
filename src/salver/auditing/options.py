"""Options of an audit: its assumptions and its confidence."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from salver.errors import SalverError


@dataclass(frozen=True)
class AuditOptions:
    """Options of an audit: its assumptions and its confidence. The second sentence is the effect of doubling a value.

    highest: Hz, highest frequency of vibration. Twice the sampling rate is needed, and noise hides four times the
        acceleration at the highest frequency.
    noise: standard deviation of the samples, m (rad for joints); None: estimated. Half as sensitive to motion.
    longest_gap: s, longest gap that is interpolated; None: 0.02 s, or 3.5 steps. Longer guesses are judged.
    slowest: time between samples, s, above which times are taken to be in ms. Slower recordings are judged.
    fewest: least number of samples of a verdict. Recordings must be twice as long.
    false_alarm: probability that noise counts as motion, for each kind of window. Slightly higher bandwidths.
    hideable: size of a vibration that is always found, standard deviations over its window. Noise hides twice as much.
    certain: standard deviations in the error of an acceleration. Twice the error; more motions are undecided.
    negligible: m/s^2, amplitude of an oscillation that is ignored. Lower bandwidths.
    usual: Hz, bandwidth at the start of a fit. Higher bandwidths, more noise in accelerations.
    noticed: m, slip that the engine does not count either (`salver.simulation.outcome.Thresholds`).
    hidden: m, largest slip that noise may hide in a verdict "holds". Fewer undecided recordings, more wrong verdicts.
    fiercest: m/s^2, above the acceleration of any arm (the fastest delta robots reach it). Errors of the samples become
        violations.
    nearest, furthest: m, distances from the origin outside which positions are in another unit.
    stopping: share of a column's largest step between samples with which it may come to an extreme at which it stays.
        Fewer ends of a sensor's range are noticed.
    uneven: ratio of the noise of two columns above which their units differ; axes of one sensor differ by less than
        ten. A column in cm may not be noticed.
    drop: factor by which the power of the noise falls at the cut-off of a filter. Weaker filters are not detected.
    break_off: size of a spike or jump over the usual deviation from neighbours. Smaller ones become jolts.
    alternating: correlation over four samples above which two sources take turns; 0 for noise, 1 for such sources. At
        1 they are not noticed.
    beyond: rad or m by which a recorded joint may be out of its range, as with another zero: angles in other units and
        other orders of columns are further out. Fewer of these are noticed.
    apart, turned: m, rad, by which the tray of a file may be from where its joints have it: a lag of 30 ms at 1 m/s and
        3 rad/s, and 20 mm of calibration. Tables of two motions, or of another arm, are further apart; fewer of these
        are noticed.
    softening: c of a sloshing mode whose frequency is f (1 - c (a / R)^2) at height a: 0.07 to 0.3 in cups 0.6 to 1.5 R
        deep, by nonlinear potential flow (potential_flow.py). Resonance is reported at a larger distance.
    runaway: ratio to linear sloshing above which resonance is reported. It is reported later.
    narrow: m, radius or half side of a glass below which sloshing was up to `rise` higher than predicted.
    rise: share of the height, in such a glass.
    """

    highest: float = 50.0
    noise: float | None = None
    longest_gap: float | None = None
    slowest: float = 0.5
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
    stopping: float = 0.2
    uneven: float = 30.0
    drop: float = 30.0
    break_off: float = 5.0
    alternating: float = 0.6
    beyond: float = 0.1
    apart: float = 0.05
    turned: float = 0.1
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
