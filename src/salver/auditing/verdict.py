"""The verdict of an audit: the load holds, does not hold, or the samples cannot tell.

It holds if every motion that the samples allow keeps the load in place, and does not hold if none of them does.
Otherwise the verdict says which samples or knowledge would decide.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from salver.auditing.arm import NOT_CHECKED, arm_status
from salver.auditing.doubts import CANNOT_TELL, Borne, cannot_tell
from salver.auditing.motion import AuditedMotion, Doubt, check_radians, tray_motion
from salver.auditing.options import DEFAULT, AuditOptions
from salver.auditing.recorded import OUTER
from salver.auditing.slip import Slip, slide
from salver.auditing.sloshing import unmodelled, unseen
from salver.contact_margins import MarginModel, Margins, SafeSpeeds, margin_model, safe_speeds
from salver.display import Shown
from salver.dynamics.load_limits import LoadVerdict
from salver.dynamics.payload_response import PayloadResponse
from salver.errors import SalverError, Status
from salver.files import provenance
from salver.geometry import Array, Indices, lean
from salver.models.tray_motion import at_rest, motion_vector
from salver.models.uncertain.parameters import unshaken
from salver.motion_files import JointSamples, Samples, of_columns, read
from salver.motion_files.samples import cuts_at_rests, part, reordered
from salver.motion_files.units import Units
from salver.scenario import Scenario
from salver.tables import Table, Tabular

if TYPE_CHECKING:
    from salver.models.arm.arm import ArmModel
    from salver.trajectory import MotionSamples

EDGES = 16  # of the friction pyramids, which are at most 2 % inside the round cone

AT_ONCE = 4096  # instants whose margins are computed at once
SPILLS = ("spills", "unsettled")
AT_REST = 1e-3  # m/s or rad/s, below which the tray is at rest


@dataclass(frozen=True, repr=False)
class Audit(Shown, Tabular):
    """A motion and its consequences for the scenario's objects; each is computed when it is first read.

    source: name of the file. motion: motion of the tray, with repairs and assumptions. joints: those of the arm along
    it, where they are known.
    """

    scenario: Scenario
    source: str
    motion: AuditedMotion
    joints: JointSamples | None = None

    @cached_property
    def margins(self) -> Margins:
        """The margins at all instants, or at the decisive ones of very many (`_decisive`)."""
        return self._margins_at(self._decisive)

    @cached_property
    def _loads(self) -> PayloadResponse | None:
        """Responses of liquids and pendulums along the whole motion, because they depend on its history.

        If the tray rests at an end, the acceleration there is taken as zero, whatever the noise of the samples.
        """
        s, w, seen = self.motion.samples, self._w.copy(), self.motion.recording
        still, zero = self._resting(), np.zeros((1, 3))
        outside = 0.0 if seen is None else OUTER / seen.rate  # s at each end, with unknown acceleration
        for k, away in ((0, s.t - s.t[0]), (-1, s.t[-1] - s.t)):
            if still[k]:
                rest, near = motion_vector(s.R_SB[[k]], zero, zero, zero)[0], np.flatnonzero(away < outside)
                w[near] = rest + (w[near] - rest) * (away[near] / outside)[:, None]
                w[k] = rest
        return PayloadResponse.along(self._model.payload, s.t, w)

    def _resting(self) -> tuple[bool, bool]:
        """Whether the tray is at rest at the beginning, and at the end."""
        s = self.motion.samples
        speed = np.maximum(np.abs(s.v_S).max(axis=1), np.abs(s.omega_B).max(axis=1))
        return bool(speed[0] <= AT_REST), bool(speed[-1] <= AT_REST)

    def _margins_at(self, index: Indices) -> Margins:
        loads = None if self._loads is None else self._loads.at(index)
        return Margins(self._model, self.motion.samples.t[index], self._w[index], loads)

    @cached_property
    def _model(self) -> MarginModel:
        return margin_model(self.scenario, max(EDGES, self.scenario.contact.edges))

    @cached_property
    def _w(self) -> Array:
        s = self.motion.samples
        return motion_vector(s.R_SB, s.a_S, s.omega_B, s.alpha_B)

    @cached_property
    def reserves(self) -> tuple[Array, Array]:
        """Exact margins (T,) at all instants, nominal and in the worst case, computed in pieces."""
        parts = []
        every = np.arange(len(self._w))
        for k in every[::AT_ONCE]:  # in pieces: the rows of long recordings take gigabytes
            some = self._margins_at(every[k : k + AT_ONCE])
            parts.append((some.exact, some.exact_worst))
        return np.concatenate([exact for exact, _ in parts]), np.concatenate([worst for _, worst in parts])

    @cached_property
    def _decisive(self) -> Indices:
        """At most `AT_ONCE` decisive instants: those with the least margins, the most tilted, the first violations, and
        others spread over the motion."""
        n, s = len(self._w), self.motion.samples
        if n <= AT_ONCE:
            return np.arange(n)
        measures = [*self.reserves, -np.linalg.norm(s.a_S, axis=1), s.R_SB[:, 2, 2]]
        chosen = [np.argsort(measure)[: AT_ONCE // 8] for measure in measures]
        chosen += [np.flatnonzero(margin < 0)[:1] for margin in self.reserves]
        return np.unique(np.concatenate([*chosen, np.linspace(0, n - 1, AT_ONCE // 4)]).astype(np.intp))

    @cached_property
    def nominal(self) -> Status:
        return self._verdict(worst=False)

    @cached_property
    def worst(self) -> Status:
        """The verdict in the worst case of the scenario's uncertain set."""
        return self._verdict(worst=True)

    @cached_property
    def _borne(self) -> tuple[Borne, Borne]:
        """The motion with its reserve, nominal and in the worst case."""
        zero = np.zeros((1, 3))
        begun = motion_vector(self.motion.samples.R_SB[:1], zero, zero, zero)
        still = Margins(self._model, np.zeros(2), np.concatenate([at_rest()[None], begun]))
        kinetic = self.scenario.physics.kinetic_friction
        pushed = [max((most for _, most in inner.values()), default=0.0) for inner in self._inner]
        nominal, worst = (
            Borne(self.motion, 9.81 * margin, 9.81 * resting[0], push, 9.81 * resting[1], kinetic)
            for margin, resting, push in zip(self.reserves, (still.exact, still.exact_worst), pushed, strict=True)
        )
        return nominal, worst

    @cached_property
    def _inner(self) -> tuple[dict[str, tuple[LoadVerdict, float]], dict[str, tuple[LoadVerdict, float]]]:
        """For each body with a liquid or pendulum its verdict with bounds of what the recording does not show, and the
        unknown acceleration of the body, m/s^2; nominal, and in the worst case. Empty for a motion that is known
        exactly."""
        if self._loads is None or self.motion.recording is None:
            return {}, {}
        nominal, worst = (
            {name: unseen(name, parts, self.motion) for name, parts in which.items()}
            for which in (self._loads.nominal, self._loads.worst)
        )
        return nominal, worst

    def _verdict(self, worst: bool) -> Status:
        borne = self._borne[worst]
        status = self.margins.verdict(worst)
        doubts: list[Doubt] = []
        if not status.ok and borne.unsure.any():
            at = self._decisive[~borne.unsure[self._decisive]]
            if not len(at):
                return cannot_tell([borne.edge()], worst)
            status = self._margins_at(at).verdict(worst)
            if (
                np.isinf(borne.error[borne.unsure]).any()
                or slide(self.motion.samples.t, borne.reserve) > self.motion.options.noticed
            ):
                doubts = [borne.edge()]
        if status.code in SPILLS and self.motion.recording is not None and (unsure := self._unsure(worst)):
            return cannot_tell(unsure, worst)
        if not status.ok:
            errors = borne.errors()
            return cannot_tell(errors, worst) if errors else status
        doubts += [*self.motion.doubts, *borne.unseen(), *self._begun(), *self._unsure(worst)]
        if doubts:
            return cannot_tell(doubts, worst)
        first = borne.left_out()
        if worst and self.motion.recording is None and self.scenario.payload.uncertain.shake is None:
            first = f"Not checked: {unshaken()}. "  # a recording shows the vibration of the tray
        return replace(status, sentence=first + status.sentence)

    def _begun(self) -> list[Doubt]:
        """The doubt about the state of liquids and pendulums at the beginning."""
        if self._loads is None or self._resting()[0]:
            return []
        return [("begun", "the motion begins moving, and how what is inside moves then is not known")]

    def _unsure(self, worst: bool) -> list[Doubt]:
        """Doubts whether liquids and pendulums exceed their limits."""
        if self._loads is None:
            return []
        doubts = []
        for name, parts in (self._loads.worst if worst else self._loads.nominal).items():
            known = type(parts[0]).verdict(name, parts)
            if known.slack.min() >= 0:
                doubts += unmodelled(name, parts, known, self.motion.options)
            if self.motion.recording is None:
                continue
            (most, pushed), swings = self._inner[worst][name], f"{known.inner.measure}s in {name}"
            if known.slack[:-1].min() >= 0 > known.slack[-1] and not self._resting()[1]:
                clause = f"the recording ends moving, and what {name} does after it is not in it"
                doubts.append(("ended", clause))
                continue
            told, lost = known.slack.min(), known.slack.min() - most.slack.min()
            if not (told - lost >= 0 or told + lost < 0):
                higher = 1e3 * float((most.size - known.size).max())
                of = min(most.kept, key=most.kept.__getitem__)
                share = 100 * known.kept[of]
                kept = f"keep {share:.2g} % of {of}" if share >= 0 else f"exceed {of} by {-share:.2g} %"
                clause = (
                    f"{swings} may be {higher:.2g} mm higher or lower than what is recorded "
                    f"says, and as recorded they {kept}: a finer recording, or the planned motion with its velocities "
                    "(salver export --format moveit), would tell"
                )
                doubts.append(("sloshing", clause))
            elif told >= 0 and pushed > self._borne[worst].reserve.min():
                clause = (
                    f"{swings} may push it by {pushed:.2g} m/s^2 more than what is recorded says, "
                    f"and {self._borne[worst].reserve.min():.2g} are left"
                )
                doubts.append(("sloshing", clause))
        return doubts

    def hidden(self, worst: bool = False) -> tuple[Slip, float]:
        """Bound of the slip that noise and resolution could hide, and the frequency, Hz, up to which they hide none."""
        return self._borne[worst].hidden()

    @cached_property
    def arm(self) -> Status:
        """Whether the joints stay in their ranges and the arm collides with nothing, where its joints are known."""
        arm = _arm(self.scenario)
        return NOT_CHECKED if self.joints is None or arm is None else arm_status(self.joints, arm, self.scenario)

    @property
    def ok(self) -> bool:
        """Whether the load holds in the worst case (and so at nominal values), and the arm's check is good."""
        return self.nominal.ok and self.worst.ok and self.arm.ok

    @property
    def outcome(self) -> str:
        """Outcome in the worst case: "holds", "does_not_hold" or "cannot_tell"."""
        codes = {self.nominal.code, self.worst.code}
        if codes - {"holds", CANNOT_TELL}:
            return "does_not_hold"
        return CANNOT_TELL if CANNOT_TELL in codes else "holds"

    @cached_property
    def speeds(self) -> SafeSpeeds:
        """Constant speed factors at which the load is kept, at nominal parameters; for very many instants, from those
        that are decisive at full speed and at rest."""
        return self._speeds(worst=False)

    @cached_property
    def speeds_worst(self) -> SafeSpeeds:
        return self._speeds(worst=True)

    def _speeds(self, worst: bool) -> SafeSpeeds:
        few = len(self._w) <= AT_ONCE or self._loads is not None
        return safe_speeds(self._model, self.motion.samples.only(slice(None) if few else self._decisive), worst)

    def _recording(self) -> dict[str, Any] | None:
        seen = self.motion.recording
        if seen is None:
            return None
        slip, _ = self.hidden(worst=True)
        return {
            "rate": seen.rate,
            "highest": self.motion.options.highest,
            "position_noise": seen.sensor.position.size,
            "orientation_noise": 2 * seen.sensor.orientation.size,
            "resolution": seen.sensor.position.step,
            "bandwidth": [float(seen.bandwidth.min()), float(seen.bandwidth.max())],
            "acceleration_error": float(np.median(self.motion.acceleration_error)),
            "hidden_slip": slip.distance,
            "hidden_frequency": slip.frequency,
        }

    @cached_property
    def costs(self) -> dict[str, float]:
        """Loss of the least margin by each uncertain parameter alone, largest first."""
        return dict(sorted(self.margins.costs().items(), key=lambda item: -item[1]))

    def facts(self) -> dict[str, str]:
        """Facts that a notebook shows."""
        return {
            "scenario": self.scenario.name,
            "verdict": self.outcome.replace("_", " "),
            "duration": f"{float(np.ptp(self.motion.samples.t)):.4g} s",
            "arm": self.arm.sentence,
            "nominal": self.nominal.sentence,
            "worst case": self.worst.sentence,
            "speeds in the worst case": self.speeds_worst.sentence,
            **{f"note {k}": note for k, note in enumerate(self.motion.notes, 1)},
        }

    def table(self) -> Table:
        """The estimated motion of the tray frame E, with its margins, for pandas and xarray."""
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
        """The whole audit as a JSON object."""
        s, margins = self.motion.samples, self.margins
        return {
            "holds": self.nominal.ok and self.worst.ok,
            "verdict": self.outcome,
            "arm": {"code": self.arm.code, "ok": self.arm.ok, "sentence": self.arm.sentence},
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
                }
                for m in margins.interfaces
            ],
            "costs": self.costs,
            "speeds": {"nominal": self.speeds.summary(), "worst_case": self.speeds_worst.summary()},
            "pace": {"nominal": _status(self.speeds.pace), "worst_case": _status(self.speeds_worst.pace)},
            "motion": {
                "source": self.source,
                "duration": float(s.t[-1] - s.t[0]),
                "instants": len(s.t),
                "peak_acceleration": float(np.linalg.norm(s.a_S, axis=1).max()),
                "peak_tilt": float(lean(s.R_SB).max()),
                "recording": self._recording(),
                "notes": list(self.motion.notes),
            },
            "provenance": provenance(self.scenario),
        }


def _status(status: Status) -> dict[str, Any]:
    return {"code": status.code, "ok": status.ok, "sentence": status.sentence, **status.details}


def audit(
    path: str | Path | Mapping[str, Any],
    scenario: Scenario,
    topic: str | None = None,
    options: AuditOptions = DEFAULT,
    units: str | None = None,
) -> Audit:
    """Audit a trajectory file (formats: `salver.motion_files`), or columns of one, for the objects of a scenario.

    If a file has the tray and the joints, the tray decides about the load, and the joints about the arm. If the two
    disagree, the verdict is not "holds". If the joints cannot decide about the arm, a note says why.

    topic: topic of a bag. units: of a table, as in "deg,mm,ms". Raises SalverError, one sentence for each mistake.
    """
    samples = read_for(scenario, path, topic, units=units)
    return _with_joints(audit_samples(samples, scenario, options), _beside(samples, scenario, path, units))


def _beside(
    samples: Samples, scenario: Scenario, path: str | Path | Mapping[str, Any], units: str | None
) -> JointSamples | str | None:
    """The arm's joints beside the tray motion `samples` of a file, a note why they are not used, or None."""
    arm = _arm(scenario)
    if arm is None or isinstance(samples, JointSamples) or samples.form == "ros2":  # a topic has one of both
        return None
    try:
        beside = read_for(scenario, path, joints_first=True, units=units)
        if not isinstance(beside, JointSamples):
            return next((note for note in beside.notes if note not in samples.notes), None)
        if not np.array_equal(beside.t, samples.t):
            raise SalverError(f"{beside.source} repeats times, with other joints but the same tray, or the reverse.")
        beside = reordered(beside, arm.joint_names)
        check_radians(beside.q, arm, beside.source, beside.form)
    except SalverError as error:  # joints of another arm, or damaged
        return f"The joints in the file are not used: {error}"
    return beside


def _with_joints(found: Audit, beside: JointSamples | str | None) -> Audit:
    """An audit of a tray motion, completed with the joints that `_beside` found, or its note why there are none."""
    motion, arm = found.motion, _arm(found.scenario)
    if isinstance(beside, str):
        return replace(found, motion=replace(motion, notes=(*motion.notes, beside)))
    if beside is None or arm is None:
        return found
    doubts = (*motion.doubts, *_disagreement(motion.samples, beside, arm, motion.options))
    return replace(found, joints=beside, motion=replace(motion, doubts=doubts))


def _disagreement(tray: MotionSamples, joints: JointSamples, arm: ArmModel, options: AuditOptions) -> list[Doubt]:
    """A doubt, if the joints do not carry the tray frame E where the tray's own samples have it."""
    some = np.unique(np.linspace(0, len(tray.t) - 1, 500).astype(int))
    q = np.column_stack([np.interp(tray.t[some], joints.t, each) for each in joints.q.T])
    p_SE, R_SE = (np.array(each) for each in zip(*map(arm.tray_pose, q), strict=True))
    apart = np.linalg.norm(p_SE - tray.p_SB[some], axis=1)
    cosine = (np.einsum("tij,tij->t", R_SE, tray.R_SB[some]) - 1) / 2
    turned = np.arccos(np.clip(cosine, -1, 1))
    off = np.maximum(apart / options.apart, turned / options.turned)
    worst = int(np.argmax(off))
    if off[worst] <= 1:
        return []
    clause = (
        f"at {tray.t[some[worst]]:.2f} s the joints have the tray {1e3 * apart[worst]:.0f} mm and "
        f"{np.rad2deg(turned[worst]):.1f} deg from where the file's tray is: leave out the columns that are wrong, or "
        "correct the arm's base or the tray in the scenario"
    )
    return [("disagreement", clause)]


def audit_legs(
    path: str | Path | Mapping[str, Any],
    scenario: Scenario,
    topic: str | None = None,
    options: AuditOptions = DEFAULT,
    units: str | None = None,
) -> tuple[Audit, ...]:
    """`audit` of a motion of several legs, which rests between them: each leg with its own load."""
    samples = read_for(scenario, path, topic, units=units)
    beside, found = _beside(samples, scenario, path, units), []
    for some, leg in zip(cuts_at_rests(samples, len(scenario.legs)), scenario.each_leg, strict=True):
        joints = part(beside, some) if isinstance(beside, JointSamples) else beside
        found.append(_with_joints(audit_samples(part(samples, some), leg, options), joints))
    return tuple(found)


def read_for(
    scenario: Scenario,
    path: str | Path | Mapping[str, Any],
    topic: str | None = None,
    joints_first: bool = False,
    units: str | None = None,
) -> Samples:
    """Read a motion file, or columns by name, with the joint names of the scenario's arm.

    joints_first: if a file has tray and joints, read the joints, if there is an arm. units: of a table, as in
    "deg,mm,ms". Raises FileFormatError; SalverError for unknown units.
    """

    def names() -> tuple[str, ...]:
        arm = _arm(scenario)
        return arm.joint_names if arm else ()

    joints_first = joints_first and scenario.arm is not None
    arm = _arm(scenario) if units else None
    known = Units.parse(units, arm.linear if arm else ())
    if isinstance(path, str | Path):
        return read(path, names, topic, as_path=joints_first, units=known)
    return of_columns(path, names, joints_first, known)


def audit_samples(samples: Samples, scenario: Scenario, options: AuditOptions = DEFAULT) -> Audit:
    """`audit` of samples. Raises ScenarioError for a task of several legs."""
    if scenario.legs:
        scenario.check_one_leg("this audit")
    joints = samples if isinstance(samples, JointSamples) else None
    arm = None if joints is None else _arm(scenario)
    motion = tray_motion(samples, arm, options)
    return Audit(scenario, samples.source, motion, joints)


def _arm(scenario: Scenario) -> ArmModel | None:
    return None if scenario.arm is None else scenario.load_arm()
