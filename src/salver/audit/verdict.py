"""The verdict: holds, slides or tips, and what it would take."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from salver.audit.motion import TrayMotion, tray_motion
from salver.audit.readers import read
from salver.audit.samples import JointSamples
from salver.errors import Status
from salver.files import provenance
from salver.geometry import Array, invert
from salver.margins import Margins, margin_model
from salver.models.tray_motion import motion_vector
from salver.scenario import Scenario

if TYPE_CHECKING:
    from salver.models.arm import ArmModel

EDGES = 16  # of the friction pyramids: at most 2 % short of the round cone
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


@dataclass(frozen=True)
class Audit:
    """A motion and everything that follows from it for the scenario's objects; computed when asked for.

    source: what was read. motion: the tray's, with what had to be repaired or assumed.
    """

    scenario: Scenario
    source: str
    motion: TrayMotion

    @cached_property
    def margins(self) -> Margins:
        s = self.motion.samples
        w = motion_vector(s.R_SB, s.a_S, s.omega_B, s.alpha_B)
        return Margins(margin_model(self.scenario, max(EDGES, self.scenario.contact.edges)), s.t, w)

    @cached_property
    def nominal(self) -> Status:
        return self.margins.verdict()

    @cached_property
    def worst(self) -> Status:
        """Over the scenario's uncertain set."""
        return self.margins.verdict(worst=True)

    @property
    def ok(self) -> bool:
        """Whether everything holds in the worst case (and so in the nominal one)."""
        return self.nominal.ok and self.worst.ok

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

    @property
    def _at_rest(self) -> Array:
        s = self.motion.samples
        zero = np.zeros_like(s.a_S)
        return motion_vector(s.R_SB, zero, zero, zero)

    def _margin(self, w: Array, which: str) -> Array:
        margin: Array = getattr(Margins(self.margins.model, np.arange(float(len(w))), w), which)
        return margin

    @cached_property
    def costs(self) -> dict[str, float]:
        """What each uncertain parameter alone takes from the least margin, largest first."""
        return dict(sorted(self.margins.costs().items(), key=lambda item: -item[1]))

    def summary(self) -> dict[str, Any]:
        """Everything, for machines."""
        s, margins = self.motion.samples, self.margins
        return {
            "holds": self.ok,
            "nominal": _status(self.nominal),
            "worst_case": _status(self.worst),
            "margin": {
                "nominal": float(margins.exact.min()),
                "nominal_time": float(s.t[np.argmin(margins.exact)]),
                "worst_case": float(margins.exact_worst.min()),
                "worst_case_time": float(s.t[np.argmin(margins.exact_worst)]),
            },
            "interfaces": [
                {
                    "name": m.name,
                    "friction": m.friction,
                    "friction_needed": float(m.friction_needed.max()),
                    "friction_needed_time": float(s.t[np.argmax(m.friction_needed)]),
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
                "noise": self.motion.noise,
                "bandwidth": self.motion.bandwidth,
                "acceleration_noise": self.motion.acceleration_noise,
                "notes": list(self.motion.notes),
            },
            "provenance": provenance(self.scenario),
        }


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
    path: str | Path,
    scenario: Scenario,
    topic: str | None = None,
    bandwidth: float | None = None,
    longest_gap: float | None = None,
) -> Audit:
    """Audit a trajectory file (formats: `salver.audit.readers`) for the objects of a scenario.

    topic: of a bag. bandwidth: Hz of the smoothing; found from the data if None. longest_gap: s without samples
    that is bridged. Raises SalverError, one sentence for each mistake.
    """

    @cache
    def arm() -> ArmModel | None:
        if scenario.arm is None:
            return None
        from salver.models.arm import load_arm

        return load_arm(scenario.arm, scenario.tray)

    samples = read(path, lambda: found.joint_names if (found := arm()) else (), topic)
    first = scenario.payload.first
    joints = arm() if isinstance(samples, JointSamples) else None
    motion = tray_motion(samples, joints, *invert(first.p_EB, first.R_EB), bandwidth, longest_gap)
    return Audit(scenario, samples.source, motion)


def audit_motion(motion: TrayMotion, scenario: Scenario, source: str = "motion") -> Audit:
    """Audit a motion of the tray that is known with its accelerations."""
    return Audit(scenario, source, motion)
