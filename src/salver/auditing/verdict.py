"""The verdict: it holds, it does not, or it cannot be told; and what it would take.

It holds when every motion that the samples allow keeps everything in its place; it does not when none does. Between the
two it cannot be told, and the verdict says what would tell.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from salver.auditing.motion import HIGHEST, Recording, TrayMotion, tray_motion
from salver.auditing.slip import HIDDEN, NOTICED, Slip, hidden, left_over, slide
from salver.contact_margins import MarginModel, Margins, margin_model
from salver.display import Shown
from salver.errors import Status
from salver.files import provenance
from salver.geometry import Array, invert
from salver.models.tray_motion import at_rest, motion_vector
from salver.motion_files import JointSamples, Samples, of_columns, read
from salver.scenario import Scenario
from salver.sensitivity.sloshing import Liquids
from salver.tables import Table, Tabular

if TYPE_CHECKING:
    from salver.models.arm import ArmModel

EDGES = 16  # of the friction pyramids: at most 2 % short of the round cone

AT_ONCE = 4096  # instants whose margins are in memory together
CANNOT_TELL = "cannot_tell"
SPILLS = ("spills", "unsettled")
SURELY_SPILT = 0.5  # of the room by which waves must be higher, for a recording to say that they are
AT_REST = 1e-3  # m/s or rad/s
PACES = 1.03 ** np.arange(60)  # at which a motion with a liquid is looked at: up to 5.7 times slower
SLOWEST = 100.0  # times the duration: a path that needs more is called impossible
FASTEST = 0.2


@dataclass(frozen=True)
class Pace:
    """Uniform time scaling of the same path, at which it just holds.

    factor: of the duration; above 1 it must be run slower, below 1 it could be run faster. None when no pace
    would do, because gravity alone fails somewhere on the path: status says where.
    """

    factor: float | None
    status: Status


@dataclass(frozen=True, repr=False)
class Audit(Shown, Tabular):
    """A motion and everything that follows from it for the scenario's objects; computed when asked for.

    source: what was read. motion: the tray's, with what had to be repaired or assumed. given: as it was read.
    """

    scenario: Scenario
    source: str
    motion: TrayMotion
    given: Samples | None = None

    @cached_property
    def margins(self) -> Margins:
        """At all instants; of very many at those that decide (`_decisive`)."""
        return self._margins_at(self._decisive)

    @cached_property
    def _liquids(self) -> Liquids | None:
        """Along the whole motion: they remember."""
        return Liquids.along(self._model.payload, self.motion.samples.t, self._w)

    def _margins_at(self, index: npt.NDArray[np.intp]) -> Margins:
        liquids = None if self._liquids is None else self._liquids.at(index)
        return Margins(self._model, self.motion.samples.t[index], self._w[index], None, liquids)

    @cached_property
    def _model(self) -> MarginModel:
        return margin_model(self.scenario, max(EDGES, self.scenario.contact.edges))

    @cached_property
    def _w(self) -> Array:
        s = self.motion.samples
        return motion_vector(s.R_SB, s.a_S, s.omega_B, s.alpha_B)

    @cached_property
    def reserves(self) -> tuple[Array, Array]:
        """(T,) exact margins at all instants, nominal and in the worst case; some at a time."""
        parts = []
        every = np.arange(len(self._w))
        for k in self._starts:  # whose rows are let go before the next are made: a long recording has gigabytes of them
            some = self._margins_at(every[k : k + AT_ONCE])
            parts.append((some.exact, some.exact_worst))
        return np.concatenate([exact for exact, _ in parts]), np.concatenate([worst for _, worst in parts])

    @property
    def _starts(self) -> range:
        return range(0, len(self._w), AT_ONCE)

    @cached_property
    def _decisive(self) -> npt.NDArray[np.intp]:
        """Of more than `AT_ONCE` instants those with the least margins in each stretch, the steepest, and the first
        that fail: the extremes of the whole are among them."""
        if len(self._w) <= AT_ONCE:
            return np.arange(len(self._w))
        s = self.motion.samples
        measures = [*self.reserves, -np.linalg.norm(s.a_S, axis=1), s.R_SB[:, 2, 2]]
        each = max(1, AT_ONCE // (2 * len(self._starts) * len(measures)))
        chosen = [np.array([0, len(self._w) - 1])]
        for measure in measures:
            chosen += [k + np.argsort(measure[k : k + AT_ONCE])[:each] for k in self._starts]
        chosen += [np.flatnonzero(margin < 0)[:1] for margin in self.reserves]
        return np.unique(np.concatenate(chosen)).astype(np.intp)

    @cached_property
    def nominal(self) -> Status:
        return self._verdict(worst=False)

    @cached_property
    def worst(self) -> Status:
        """Over the scenario's uncertain set."""
        return self._verdict(worst=True)

    def reserve(self, worst: bool = False) -> Array:
        """(T,) m/s^2: acceleration, in any direction, that would still be borne beyond the motion's own."""
        return 9.81 * self.reserves[worst]

    def _verdict(self, worst: bool) -> Status:
        reserve = self.reserve(worst)
        error = np.broadcast_to(self.motion.acceleration_error + self.motion.missed, reserve.shape)
        status = self.margins.verdict(worst)
        unsure = (reserve < 0) & (reserve + error > 0)
        clause = ""
        if not status.ok and unsure.any():
            at = self._decisive[~unsure[self._decisive]]
            if not len(at):
                return _cannot_tell([("edge", self._edge(reserve, error))], worst)
            status = self._margins_at(at).verdict(worst)
            if np.isinf(error[unsure]).any() or slide(self.motion.samples.t, reserve) > NOTICED:
                clause = self._edge(reserve, error)
        if status.code in SPILLS and self.motion.recording is not None and self._least_room(worst) > -SURELY_SPILT:
            return _cannot_tell(self._waves(), worst)
        if not status.ok:
            return status
        doubts = [*([("edge", clause)] if clause else []), *self.motion.doubts, *self._unseen(worst), *self._waves()]
        return _cannot_tell(doubts, worst) if doubts else self._limited(status, worst)

    def _limited(self, status: Status, worst: bool) -> Status:
        """The verdict, and before it what it leaves out or takes for granted."""
        seen = self.motion.recording
        if seen is None:
            return status
        first = [f"Not judged: {clause}. " for _, clause in _ends(seen, self._resting(worst))]
        if seen.highest < HIGHEST:
            first.append(f"Taken for granted: nothing shakes the tray faster than {seen.highest:g} Hz. ")
        return replace(status, sentence="".join([*first, status.sentence]))

    def _edge(self, reserve: Array, error: Array) -> str:
        """Where the motion passes what is borne by less than its acceleration is uncertain."""
        k = int(np.argmin(reserve))
        known = (
            "there are no samples"
            if np.isinf(error[k])
            else f"it passes what is borne by {-reserve[k]:.2g} m/s^2, and is known to {error[k]:.2g} m/s^2"
        )
        return f"at {self.motion.samples.t[k]:.3f} s the motion may or may not be too much: {known}"

    def _least_room(self, worst: bool) -> float:
        """Share of its room that is left to the liquid that has the least; negative where it spills."""
        assert self._liquids is not None
        return min(float(spill.slack.min()) for spill in self._liquids.spills(worst))

    def _waves(self) -> list[tuple[str, str]]:
        """What is not known of liquids: how they move at the beginning, and what a recording leaves in the dark."""
        if self._liquids is None:
            return []
        doubts, s = [], self.motion.samples
        if max(np.abs(s.v_S[0]).max(), np.abs(s.omega_B[0]).max()) > AT_REST:
            doubts.append(("begun", "the motion begins moving, and how the liquid moves then is not known"))
        if self.motion.recording is not None:
            clause = (
                "what waves make of the noise of a recording is not judged: a planned motion, without noise, would tell"
            )
            doubts.append(("waves", clause))
        return doubts

    def _unseen(self, worst: bool) -> list[tuple[str, str]]:
        """What a recording does not show, where it could slide a load; (code, clause)."""
        recording, t, reserve = self.motion.recording, self.motion.samples.t, self.reserve(worst)
        rest = self._resting(worst)
        if recording is None:
            return []
        # Where it comes from rest to such a speed within the recording, or from such a speed to rest, it can have done
        # so before or after: that is said (`_limited`), and no doubt.
        doubts = _ends(recording, rest, [_jerked(v, rest) > HIDDEN for v in recording.slowest])
        by_noise, harmless = self.hidden(worst)
        if by_noise.distance > HIDDEN:
            doubts.append(("noise", _noise_clause(by_noise, harmless, recording)))
        short = reserve - self.motion.missed
        if slide(t, short) > NOTICED and slide(t, reserve) <= NOTICED:
            k = int(np.argmin(short))
            doubts.append(
                (
                    "unresolved",
                    f"at {t[k]:.3f} s the motion is so fast that {recording.rate:.3g} samples a second show its "
                    f"acceleration only to {np.broadcast_to(self.motion.missed, t.shape)[k]:.2g} m/s^2: twice as many "
                    "would tell",
                )
            )
        fast = left_over(t, reserve, rest, recording.unseen)
        if fast.distance > NOTICED:
            doubts.append(
                (
                    "unresolved",
                    f"the recording holds {_shake(fast)}, too fast for {recording.rate:.3g} samples a second to show "
                    f"its acceleration: {6 * fast.frequency:.0f} a second would",
                )
            )
        mirrored = left_over(t, reserve, rest, recording.mirrored, recording.rate)
        if mirrored.distance > NOTICED:
            doubts.append(
                (
                    "mirrored",
                    f"what looks like {recording.rate - mirrored.frequency:.2g} Hz may be {_shake(mirrored)}: at "
                    f"{recording.rate:.3g} samples a second the two look alike, at {2.5 * recording.highest:.0f} they "
                    "would not",
                )
            )
        return doubts

    def hidden(self, worst: bool = False) -> tuple[Slip, float]:
        """How far noise and resolution could hide a slide, and up to which frequency (Hz) they hide none."""
        assert self.motion.recording is not None
        return hidden(self.motion.samples.t, self.reserve(worst), self._resting(worst), self.motion.recording)

    def _resting(self, worst: bool) -> float:
        """Reserve at rest on a level tray, m/s^2."""
        margins = Margins(self._model, np.zeros(1), at_rest()[None])
        return 9.81 * float((margins.exact_worst if worst else margins.exact)[0])

    @property
    def ok(self) -> bool:
        """Whether everything holds in the worst case (and so in the nominal one)."""
        return self.nominal.ok and self.worst.ok

    @property
    def outcome(self) -> str:
        """In the worst case: "holds", "does_not_hold" or "cannot_tell"."""
        codes = {self.nominal.code, self.worst.code}
        if codes - {"holds", CANNOT_TELL}:
            return "does_not_hold"
        return CANNOT_TELL if CANNOT_TELL in codes else "holds"

    @cached_property
    def pace(self) -> Pace:
        """At nominal parameters."""
        return self._pace("exact")

    @cached_property
    def pace_worst(self) -> Pace:
        return self._pace("exact_worst")

    def _pace(self, which: str) -> Pace:
        """Run s times slower, accelerations and products of velocities fall by s^2 and gravity stays:
        w = w_rest + (w_1 - w_rest) / s^2. The margin is concave in 1/s^2, so what holds at one pace holds at all
        slower ones that gravity allows."""
        if self._liquids is not None:
            return self._pace_of_liquids(which == "exact_worst")
        w, rest = self.margins.w, self._at_rest
        least = self._margin(rest, which)
        if least.min() < 0:
            k = int(np.argmin(least))
            when = float(self.margins.t[k])
            case = " in the worst case" if which == "exact_worst" else ""
            sentence = f"The tray is tilted too far at {when:.3f} s: even at rest there nothing would hold{case}."
            return Pace(None, Status("tilted", sentence, False, {"time": when}))
        slowest, fastest = 1 / SLOWEST**2, 1 / FASTEST**2  # of 1/s^2

        def margin(share: float, at: slice | npt.NDArray[np.intp] = slice(None)) -> Array:
            return self._margin(rest[at] + share * (w[at] - rest[at]), which)

        if margin(slowest).min() < 0:
            return Pace(None, Status("tilted", f"Even {SLOWEST:g} times slower the path would not hold.", False))
        here = getattr(self.margins, which)
        low, high = (slowest, 1.0) if here.min() < 0 else (1.0, fastest)
        beyond = here if high == 1 else margin(fastest)
        if beyond.min() < 0:
            failing = np.flatnonzero(beyond < 0)  # concave: the others hold at every pace in between
            low = _root(lambda share: float(margin(share, failing).min()), low, high)
        else:
            low = fastest
        factor = float(1 / np.sqrt(low))
        return Pace(
            factor, Status("found", f"It just holds at {factor:.3f} times the duration.", True, {"factor": factor})
        )

    def _pace_of_liquids(self, worst: bool) -> Pace:
        """The least slowing, from the motion's own pace on, at which nothing spills or slides: waves keep time of their
        own, so that slower is not always calmer, and paces are tried one by one."""
        t, at_rest = self.motion.samples.t, self._resting_all
        for factor in PACES:
            w = at_rest + (self._w - at_rest) / factor**2
            slower = factor * (t - t[0])
            liquids = Liquids.along(self._model.payload, slower, w)
            if Margins(self._model, slower, w, None, liquids).verdict(worst).ok:
                sentence = f"It holds at {factor:.3f} times the duration, and at no less that was tried."
                return Pace(float(factor), Status("found", sentence, True, {"factor": float(factor)}))
        sentence = f"Up to {PACES[-1]:.3g} times slower the path would not hold."
        return Pace(None, Status("tilted", sentence, False))

    @property
    def _resting_all(self) -> Array:
        R_SB = self.motion.samples.R_SB
        zero = np.zeros((len(R_SB), 3))
        return motion_vector(R_SB, zero, zero, zero)

    @property
    def _at_rest(self) -> Array:
        R_SB = self.motion.samples.R_SB[self._decisive]
        zero = np.zeros((len(R_SB), 3))
        return motion_vector(R_SB, zero, zero, zero)

    def _margin(self, w: Array, which: str) -> Array:
        margin: Array = getattr(Margins(self.margins.model, np.arange(float(len(w))), w), which)
        return margin

    def _recording(self) -> dict[str, Any] | None:
        seen = self.motion.recording
        if seen is None:
            return None
        slip, _ = self.hidden(worst=True)
        return {
            "rate": seen.rate,
            "highest": seen.highest,
            "position_noise": float(seen.sensor.position.sizes.max()),
            "orientation_noise": 2 * float(seen.sensor.orientation.sizes.max()),
            "resolution": seen.sensor.position.step,
            "bandwidth": list(seen.bandwidth),
            "acceleration_error": float(np.median(self.motion.acceleration_error)),
            "hidden_slip": slip.distance,
            "hidden_frequency": slip.frequency,
        }

    @cached_property
    def costs(self) -> dict[str, float]:
        """What each uncertain parameter alone takes from the least margin, largest first."""
        return dict(sorted(self.margins.costs().items(), key=lambda item: -item[1]))

    def facts(self) -> dict[str, str]:
        """What a notebook shows of it."""
        factor = self.pace_worst.factor
        return {
            "scenario": self.scenario.name,
            "verdict": self.outcome.replace("_", " "),
            "duration": f"{float(np.ptp(self.motion.samples.t)):.4g} s",
            "nominal": self.nominal.sentence,
            "worst case": self.worst.sentence,
            "just holds in the worst case at": self.pace_worst.status.sentence
            if factor is None
            else f"{factor:.3f} of the time",
            **{f"note {k}": note for k, note in enumerate(self.motion.notes, 1)},
        }

    def table(self) -> Table:
        """The tray's motion (frame E) as it was understood, and how far it is from the edge, for pandas and xarray."""
        s, (nominal, worst) = self.motion.samples, self.reserves
        values = {"p_SE": s.p_SB, "v_S": s.v_S, "a_S": s.a_S, "omega_E": s.omega_B, "alpha_E": s.alpha_B}
        curves = {"margin": nominal, "margin_worst_case": worst}
        return Table(
            {
                "t": (("t",), s.t),
                **{name: (("t", "xyz"), array) for name, array in values.items()},
                **{name: (("t",), array) for name, array in curves.items()},
            },
            about={"source": self.source, "verdict": self.outcome},
        )

    def summary(self) -> dict[str, Any]:
        """Everything, for machines."""
        s, margins = self.motion.samples, self.margins
        return {
            "holds": self.ok,
            "verdict": self.outcome,
            "nominal": _status(self.nominal),
            "worst_case": _status(self.worst),
            "margin": {
                "nominal": float(margins.exact.min()),
                "nominal_time": float(margins.t[np.argmin(margins.exact)]),
                "worst_case": float(margins.exact_worst.min()),
                "worst_case_time": float(margins.t[np.argmin(margins.exact_worst)]),
            },
            "interfaces": [
                {
                    "name": m.name,
                    "friction": m.friction,
                    "friction_needed": float(m.friction_needed.max()),
                    "friction_needed_time": float(m.t[np.argmax(m.friction_needed)]),
                    "friction_needed_worst_case": m.friction_needed_worst,
                    "tip_over_margin": float(m.tip_over.min()),
                    "tip_over_margin_worst_case": float(m.tip_over_worst.min()),
                    "cone_coefficient": float(m.cone_coefficient.min()),
                    "cone_coefficient_worst_case": float(m.cone_coefficient_worst.min()),
                }
                for m in margins.interfaces
            ],
            "costs": self.costs,
            "pace": {"nominal": _pace(self.pace), "worst_case": _pace(self.pace_worst)},
            "motion": {
                "source": self.source,
                "duration": float(s.t[-1] - s.t[0]),
                "instants": len(s.t),
                "peak_acceleration": float(np.linalg.norm(s.a_S, axis=1).max()),
                "peak_tilt": float(np.arccos(np.clip(s.R_SB[:, 2, 2], -1, 1)).max()),
                "recording": self._recording(),
                "notes": list(self.motion.notes),
            },
            "provenance": provenance(self.scenario),
        }


def _cannot_tell(doubts: list[tuple[str, str]], worst: bool) -> Status:
    case = " in the worst case of the uncertain parameters" if worst else ""
    reasons = "; ".join(dict.fromkeys(clause for _, clause in doubts))
    codes = list(dict.fromkeys(code for code, _ in doubts))
    return Status(
        CANNOT_TELL, f"It cannot be told whether everything holds{case}: {reasons}.", False, {"reasons": codes}
    )


def _shake(slip: Slip) -> str:
    return f"{1e3 * slip.amplitude:.2g} mm at {slip.frequency:.2g} Hz around {slip.time:.3f} s"


def _jerked(speed: float, rest: float) -> float:
    """How far a load slides whose tray comes to a speed (m/s) at once, m. rest: reserve at rest, m/s^2."""
    return speed**2 / (2 * rest)


def _ends(seen: Recording, rest: float, which: Sequence[bool] = (True, True)) -> list[tuple[str, str]]:
    """Of a recording that begins or ends at speed, that it does not show how the tray comes to it: (code, clause)."""
    words = ("begins", "came before"), ("ends", "comes after")
    fast = [
        (f"{word} at {v:.2g} m/s", missing)
        for (word, missing), v, asked in zip(words, seen.ends, which, strict=True)
        if asked and _jerked(v, rest) > HIDDEN
    ]
    if not fast:
        return []
    speeds, missing = (" and ".join(parts) for parts in zip(*fast, strict=True))
    return [("speed", f"the recording {speeds}, and what {missing} is not in it")]


def _noise_clause(slip: Slip, harmless: float, seen: Recording) -> str:
    """What noise could hide, and what would show it: the slide grows with noise^2 / rate."""
    better = HIDDEN / slip.distance
    noise = 1e3 * seen.sensor.displacement
    known = f", or the knowledge that nothing on the arm is faster than {np.floor(10 * harmless) / 10:g} Hz (--highest)"
    return (
        f"noise of {noise:.2g} mm could hide a shake of {_shake(slip)}, which would slide the load by up to "
        f"{1e3 * slip.distance:.2g} mm; noise below {noise * better**0.5:.2g} mm, {seen.rate / better:.2g} samples a "
        f"second{known if harmless else ''} would tell"
    )


def _root(f: Callable[[float], float], low: float, high: float) -> float:
    """Where f turns negative between low (not negative) and high, to 1e-6, on the side where it has not."""
    from scipy.optimize import brentq

    root = float(brentq(f, low, high, rtol=1e-7))
    return max(low, root * (1 - 1e-6))


def _status(status: Status) -> dict[str, Any]:
    return {"code": status.code, "ok": status.ok, "sentence": status.sentence, **status.details}


def _pace(pace: Pace) -> dict[str, Any]:
    return {"factor": pace.factor, "code": pace.status.code, "sentence": pace.status.sentence}


def audit(
    path: str | Path | Mapping[str, Any],
    scenario: Scenario,
    topic: str | None = None,
    highest: float = HIGHEST,
    noise: float | None = None,
    longest_gap: float | None = None,
) -> Audit:
    """Audit a trajectory file (formats: `salver.motion_files`), or columns of one, for the objects of a scenario.

    topic: of a bag. highest: Hz, above which nothing shakes the tray. noise: standard deviation of the samples, m or
    rad; found in them if None. longest_gap: s without samples that is bridged. Raises SalverError, one sentence for
    each mistake.
    """
    return audit_samples(read_for(scenario, path, topic), scenario, highest, noise, longest_gap)


def read_for(
    scenario: Scenario, path: str | Path | Mapping[str, Any], topic: str | None = None, joints_first: bool = False
) -> Samples:
    """A motion file, or columns by name, where joints go by the names of the scenario's arm.

    joints_first: a file with tray and joints is one of the joints, if there is an arm. Raises FileFormatError.
    """

    def names() -> tuple[str, ...]:
        arm = _arm(scenario)
        return arm.joint_names if arm else ()

    if isinstance(path, str | Path):
        return read(path, names, topic, as_path=joints_first and scenario.arm is not None)
    return of_columns(path, names)


def audit_samples(
    samples: Samples,
    scenario: Scenario,
    highest: float = HIGHEST,
    noise: float | None = None,
    longest_gap: float | None = None,
) -> Audit:
    """`audit` of what was read."""
    first = scenario.payload.first
    joints = _arm(scenario) if isinstance(samples, JointSamples) else None
    motion = tray_motion(samples, joints, *invert(first.p_EB, first.R_EB), highest, noise, longest_gap)
    return Audit(scenario, samples.source, motion, samples)


def _arm(scenario: Scenario) -> ArmModel | None:
    if scenario.arm is None:
        return None
    from salver.models.arm import load_arm

    return load_arm(scenario.arm, scenario.tray)


def audit_motion(motion: TrayMotion, scenario: Scenario, source: str = "motion") -> Audit:
    """Audit a motion of the tray that is known with its accelerations."""
    return Audit(scenario, source, motion)
