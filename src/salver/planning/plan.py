"""A plan: a reference trajectory, everything that is derived from it, and its check."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from salver.display import Shown
from salver.errors import FileFormatError, ScenarioError, Status
from salver.files import provenance
from salver.geometry import Array, invert, matrix_from_quat_wxyz
from salver.models.uncertain.parameters import unshaken
from salver.motion_files.verdict import SPEED, UNSAFE, one_line
from salver.planning.extent import Extent, extent
from salver.planning.object.cost import sensitivity_cost
from salver.planning.object.evaluation import Evaluation, evaluate
from salver.planning.plan_files import NEEDED, PlanFiles, read_plan, save_files
from salver.planning.stop_library import StopLibrary
from salver.planning.verification import Verification
from salver.plots import Curves, Plotted
from salver.scenario import Cone, Cylinder, Scenario
from salver.scenario.warnings import warnings_of
from salver.tables import Table, Tabular, dimensioned
from salver.trajectory import (
    JointMotion,
    MotionSamples,
    PolynomialReference,
    Reference,
    SampledReference,
)

if TYPE_CHECKING:
    from salver.contact_margins import InterfaceMargins, Margins, SafeSpeeds
    from salver.models.uncertain.parameters import UncertainSet
    from salver.sensitivity.arm import ArmChain

FINER = 10  # ratio of the planner's time step to that of the check
STEERED = (
    1e-2,
    2e-3,
)  # s, time step of the arrays and of the check for a motion whose jerk may jump at any time


@dataclass(frozen=True, repr=False)
class Plan(Shown, Tabular, Plotted):
    """A motion of the carried object, and of the arm if there is one, with its verdict. Arrays have the time axis
    first.

    Attributes:
        scenario: the task.
        method: "robust" (eqs 13-17), "baseline" (straight min-jerk line), "fastest", "safest", "least-sensitive",
            "live" (steered by hand, as it was commanded), "excite" or "tilt" (motions that identify the load).
        reference: motion of the first object's frame B in S.
        status: how planning ended.
        joint: the arm's motion, or None.
        arm_status: whether the arm can follow; None without an arm.
        tau: (T, n) feed-forward torques at `t`, N m; None without them, as for an arm without masses.
        solver: method, cost, duality gap, iterations, times.
        stops: stops that keep the load in place (`salver.planning.stops`), or None.
    """

    scenario: Scenario
    method: str
    reference: Reference
    status: Status
    joint: JointMotion | None = None
    arm_status: Status | None = None
    tau: Array | None = None
    solver: Mapping[str, Any] = field(default_factory=dict)
    stops: StopLibrary | None = None

    @cached_property
    def evaluation(self) -> Evaluation:
        return evaluate(self.scenario, self.reference, len(self.t))

    @cached_property
    def _checked(self) -> Evaluation:
        """The evaluation on the grid of the check."""
        count = self._instants(STEERED[1])
        return self.evaluation if count == len(self.t) else evaluate(self.scenario, self.reference, count)

    @property
    def duration(self) -> float:
        return self.reference.duration

    @property
    def space(self) -> Literal["object", "joint"]:
        """Space in which the controller closes its loop: "joint" for motions planned in joint space, whose tracking
        errors were computed there."""
        return "joint" if self.method in ("fastest", "safest", "least-sensitive", "live", "excite") else "object"

    @cached_property
    def t(self) -> Array:
        """Instants (T,) of the arrays, s."""
        return np.linspace(0.0, self.duration, self._instants(STEERED[0]))

    def _instants(self, step: float) -> int:
        """Number of instants: at least the planner's nodes and, for steered motions, a time step of at most `step`,
        s."""
        planned = FINER * (self.scenario.motion.nodes - 1) + 1
        return planned if self.method != "live" else max(planned, int(np.ceil(self.duration / step)) + 1)

    @property
    def cone_coefficients(self) -> Array:
        return self.evaluation.cone_coefficients

    @property
    def cone_radius(self) -> Array:
        return self.evaluation.cone_radius

    @property
    def state_sensitivity(self) -> Array:
        return self.evaluation.state_sensitivity

    @property
    def input_sensitivity(self) -> Array:
        return self.evaluation.input_sensitivity

    @property
    def uncertain(self) -> UncertainSet:
        return self.scenario.payload.uncertain

    @cached_property
    def cost(self) -> float:
        """The integral (13) with the scenario's weighting."""
        return sensitivity_cost(self.scenario, self.t, self.evaluation.sensitivity())

    @property
    def ok(self) -> bool:
        """Whether the plan meets the request: safe in its own model, and the arm can follow."""
        return not self._failures

    @property
    def _failures(self) -> tuple[str, ...]:
        """The requirements that the plan does not meet, a sentence each."""
        verdicts: tuple[Status | Verification | None, ...] = (self.status, self.verification, self.arm_status)
        failed = dict.fromkeys(found.sentence for found in verdicts if found is not None and not found.ok)
        if not failed and self.scenario.motion.speeds == "any" and not self.speeds.every:
            failed[f"{self.speeds.verdict} motion.speeds asks for every speed."] = None
        return tuple(one for one in failed if not any(one != other and one in other for other in failed))

    @property
    def verdict(self) -> str:
        """The verdict in one line: "UNSAFE: " and what fails; or the only speeds at which the plan is safe; or what was
        not checked, and the result of the check."""
        if self._failures:
            return one_line(f"{UNSAFE}: {' '.join(self._failures)}")
        blind = f"Not checked: {'; '.join(self.unchecked)}. " if self.unchecked else ""
        if not self.speeds.every:
            return one_line(f"{SPEED}: {self.speeds.verdict} {blind}{self.verification.sentence}")
        return one_line(f"{blind}{self.verification.sentence} {self.speeds.sentence}")

    @property
    def unchecked(self) -> tuple[str, ...]:
        """What the verdict does not cover, in words; state it before any claim of safety."""
        load, shake = self.scenario.payload.unmodelled, self.unshaken
        if self.arm_status is not None:
            return (*load, *self.arm_status.details.get("unchecked", ()), *shake)
        out = [] if self.scenario.arm is None else ["whether the arm can follow (planned without it)"]
        if self.scenario.around:
            out.append("whether anything hits an obstacle (planned without an arm)")
        return (*load, *out, *shake)

    @property
    def unshaken(self) -> tuple[str, ...]:
        """Effects of a shaking tray that the plan ignores, in words."""
        if self.uncertain.shake is None:
            return (unshaken(),)
        return ("how loads swing inside on a tray that shakes",) if self.scenario.payload.dynamic else ()

    @cached_property
    def warnings(self) -> tuple[str, ...]:
        """Warnings, a sentence each: probable mistakes in the scenario, and loads beyond what the arm is made for."""
        return warnings_of(self.scenario)

    @property
    def no_arm_motion(self) -> str:
        """The reason why `joint` is None, in one sentence."""
        if self.arm_status is not None:
            return self.arm_status.sentence
        return "The plan was made without the arm." if self.status.ok else self.status.sentence

    @cached_property
    def verification(self) -> Verification:
        """Boundary conditions, contact and via poses, checked on a fine grid."""
        return Verification.of(self.scenario, self.reference, self._checked)

    @cached_property
    def margins(self) -> Margins:
        """Exact margins of all objects on the tray along the reference (`salver.contact_margins`)."""
        from salver.contact_margins import margins

        return margins(self.scenario, self._checked.samples)

    @cached_property
    def speeds(self) -> SafeSpeeds:
        """The constant speed factors at which contact is kept in the worst case."""
        from salver.contact_margins import margin_model, safe_speeds

        found = safe_speeds(margin_model(self.scenario), self._tray, worst=True)
        return found if self.joint is None else replace(found, unchecked=self._unchecked_at_other_speeds)

    @property
    def lacking_speeds(self) -> tuple[float, ...]:
        """Shares of full speed at which most is missing of a load with inner dynamics: of few, then of all of
        `speeds`."""
        from salver.contact_margins import margin_model
        from salver.contact_margins.time_scaling import lacking_of_few

        return lacking_of_few(margin_model(self.scenario), self._tray) or self.speeds.lacking

    @property
    def _tray(self) -> MotionSamples:
        """The motion of the tray's frame, at the verdict's instants."""
        first = self.scenario.payload.first
        return self._checked.samples.of_frame(*invert(first.p_EB, first.R_EB))

    @property
    def _unchecked_at_other_speeds(self) -> str:
        """What was not checked at other speed factors, by the plan or by its planner (`planning.fastest.speeds`)."""
        planned = self.method in ("fastest", "safest", "least-sensitive") and self.solver.get("robust", False)
        if self.scenario.payload.dynamic:
            return "how far the arm strays from the motion; how loads swing inside while the speed changes"
        return "" if planned and self.scenario.motion.speeds == "any" else "how far the arm strays from the motion"

    def at_speed(self, factor: float) -> Plan:
        """The same motion at a constant speed factor, 0 < factor <= 1, without torques and stops.

        Raises ScenarioError for another factor.
        """
        if not 0 < factor <= 1:
            raise ScenarioError(f"A speed of {factor:g} was asked for; it must be above 0 and at most 1 (full speed).")
        s, joint = self.evaluation.samples, self.joint
        rates = s.v_S * factor, s.a_S * factor**2, s.R_SB, s.omega_B * factor, s.alpha_B * factor**2
        if joint is not None:
            joint = JointMotion(joint.t / factor, joint.q, joint.dq * factor, joint.ddq * factor**2)
        reference = SampledReference(MotionSamples(s.t / factor, s.p_SB, *rates))
        return replace(self, reference=reference, joint=joint, tau=None, stops=None)

    @cached_property
    def chain(self) -> ArmChain | None:
        """Response of the arm to parameter errors along this plan; None without an arm or without uncertainty."""
        if self.joint is None or self.uncertain.size == 0:
            return None
        from salver.sensitivity.arm import arm_chain, chain_model

        try:
            model = chain_model(self.scenario)
        except ScenarioError:  # the chain of this scenario has no such sensitivity
            return None
        return arm_chain(model, self.joint, space=self.space)

    @property
    def extent(self) -> Extent:
        """Extremes of the motion: the tray's tilt, heading and height, its speed, and the least distance to
        obstacles."""
        solid = [o.shape for o in self.scenario.objects if o.liquid is None and o.pendulum is None]
        cups = [shape for shape in solid if isinstance(shape, Cylinder | Cone)]
        radius = max((float(cup.outside.half(cup.height)[0]) for cup in cups), default=None)
        return extent(self._checked.samples, self.scenario.payload.first.R_EB, self.arm_status, radius)

    @property
    def left(self) -> float:
        """Worst-case contact margin as a share of the weight: the checked slack of a plan with the exact condition;
        with the paper's condition, which is in N, the exact margin along the reference."""
        if self.scenario.contact.condition == "paper":
            return float(self.margins.exact_worst.min())
        return float(self.evaluation.contacts.min())

    def facts(self) -> dict[str, str]:
        """The facts that a notebook shows."""
        arm = {} if self.arm_status is None else {"arm": self.arm_status.sentence}
        return {
            "scenario": self.scenario.name,
            "method": self.method,
            "duration": f"{self.duration:.4g} s",
            "ok": "yes" if self.ok else "no",
            "status": self.status.sentence,
            "check": self.verification.sentence,
            "motion": self.extent.sentence,
            **arm,
            **({} if self.stops is None else {"stops": self.stops.sentence}),
            "left in the worst case": f"{100 * self.left:.3g} % of the weight",
            "speeds": self.speeds.sentence,
        }

    def verify(self) -> Verification:
        """The check of boundary conditions, contact and via poses, on a fine grid."""
        return self.verification

    def summary(self) -> dict[str, Any]:
        """Content of `plan.json`."""
        lowest = self.cone_coefficients - self.cone_radius
        out: dict[str, Any] = {
            "verdict": self.verdict,
            "method": self.method,
            "ok": self.ok,
            "warnings": list(self.warnings),
            "unchecked": list(self.unchecked),
            "status": status_record(self.status),
            "duration": self.duration,
            "extent": self.extent.record(),
            "condition": self.scenario.contact.condition,
            "weighting": self.scenario.objective.weighting,
            "cost": self.cost,
            "verification": self.verification.record(),
            "margins": {m.name: _margin_record(m) for m in self.margins.interfaces},
            "speeds": self.speeds.summary(),
            "least_cone_coefficient": float(self.cone_coefficients.min()),
            "least_cone_coefficient_in_tube": float(lowest.min()),
            "solver": dict(self.solver),
            "provenance": provenance(self.scenario),
        }
        if self.arm_status is not None:
            out["arm"] = status_record(self.arm_status)
        if self.chain is not None:
            out["arm_chain"] = self.chain.summary()
        if self.stops is not None:
            out["stops"] = {"count": len(self.stops.t), "longest": self.stops.longest, "sentence": self.stops.sentence}
        return out

    def arrays(self) -> dict[str, Array]:
        """Content of `plan.npz`."""
        e, uncertain = self.evaluation, self.uncertain
        s = e.samples

        out: dict[str, Any] = {
            "verdict": np.array(self.verdict),
            "t": s.t,
            "p_SB": s.p_SB,
            "v_S": s.v_S,
            "a_S": s.a_S,
            "quat_SB_wxyz": s.quat_SB_wxyz,
            "omega_B": s.omega_B,
            "alpha_B": s.alpha_B,
            "wrench_B": e.wrench_B,
            "grasp_map": self.scenario.payload.first.contacts.grasp_map,
            "cone_coefficients": e.cone_coefficients,
            "cone_radius": e.cone_radius,
            "state_sensitivity": e.state_sensitivity,
            "input_sensitivity": e.input_sensitivity,
            "contact_slack": e.slack,
            "parameter_names": np.array(uncertain.names, dtype=np.str_),
            "parameter_half_range": uncertain.half_range,
        }
        if isinstance(self.reference, PolynomialReference):
            out["position_coefficients"] = self.reference.position
            out["R_start"] = self.reference.R_start
            if self.reference.angular_velocity is not None:
                out["angular_velocity_coefficients"] = self.reference.angular_velocity
        elif isinstance(self.reference, SampledReference):
            # Its own samples, so that it is read back unchanged.
            out |= {f"reference_{name}": value for name, value in vars(self.reference.samples).items()}
        if self.joint is not None:
            out["q"], out["dq"], out["ddq"] = self.joint.sample(s.t)
            out["joint_t"], out["joint_q"] = self.joint.t, self.joint.q
            out["joint_dq"], out["joint_ddq"] = self.joint.dq, self.joint.ddq
        if self.tau is not None:
            out["tau"] = self.tau
        if self.stops is not None:
            out |= self.stops.arrays()
        return out

    def table(self) -> Table:
        """The motion of the object, of the arm if there is one, contact quantities with their tubes, and the
        sensitivities Pi and Theta, for pandas and xarray."""
        about = {"scenario": self.scenario.name, "method": self.method, "ok": self.ok}
        state = [f"{block}_{axis}" for block in ("p", "theta", "v", "omega") for axis in "xyz"]
        labels = {"state": state, "parameter": self.uncertain.names}
        if self.joint is not None:
            labels["joint"] = self._joint_names
        own = {"state_sensitivity": ("state", "parameter"), "input_sensitivity": ("edge", "parameter")}
        return Table(dimensioned(self.arrays(), own), labels, about)

    @property
    def _joint_names(self) -> tuple[str, ...]:
        from salver.models.arm.arm import load_arm

        arm = self.scenario.arm
        return () if arm is None else load_arm(arm, self.scenario.tray).joint_names

    def curves(self) -> tuple[Array, Curves]:
        """Curves over time: motion of the first object, joint velocities, and the margins of all contacts."""
        samples = self._checked.samples
        way = (samples.p_SB - samples.p_SB[0]).T
        panels: dict[str, Mapping[str, Array]] = {"way, m": dict(zip("xyz", way, strict=True))}
        if self.joint is not None:
            dq = self.joint.sample(samples.t)[1].T
            panels["joint velocity,\nrad/s or m/s"] = dict(zip(self._joint_names, dq, strict=True))
        return samples.t, {**panels, **self.margins.curves()[1]}

    def save(self, directory: str | Path, stem: str = "plan") -> Path:
        """Write `<stem>.npz`, `<stem>.json` and `scenario.toml` into a run directory, each atomically.

        The record has the certificate of all three (`salver.planning.certificate`). An existing plan is moved with its
        results to DIRECTORY/earlier/N. Raises ScenarioError when the directory belongs to another scenario, SalverError
        when it has other files under these names.
        """
        return save_files(self.scenario, self.arrays(), self.summary(), Path(directory), stem)


def load_plan(directory: str | Path, stem: str = "plan") -> Plan:
    """Read a plan, or one leg of a plan of several ("leg2"). Raises FileFormatError or ScenarioError. No code from the
    files is executed."""
    return plan_of(read_plan(directory, stem), Path(directory) / stem)


def plan_of(files: PlanFiles, path: Path) -> Plan:
    """The plan in the files of a run directory. Raises FileFormatError, which names `path`."""
    arrays, record = files.arrays, files.record
    try:
        return Plan(
            files.scenario,
            record["method"],
            _reference(arrays),
            status_from(record["status"]),
            JointMotion(*(arrays[key] for key in _JOINT)) if "joint_t" in arrays else None,
            status_from(record["arm"]) if "arm" in record else None,
            arrays.get("tau"),
            record["solver"],
            StopLibrary.of_arrays(arrays, float(arrays["t"][-1])),
        )
    except (KeyError, TypeError, ValueError, IndexError):
        raise FileFormatError(f"{path}.npz and .json are not those of a plan; plan again.") from None


_JOINT = ("joint_t", "joint_q", "joint_dq", "joint_ddq")


def _reference(arrays: Mapping[str, Array]) -> Reference:
    if "position_coefficients" in arrays:
        return PolynomialReference(
            float(arrays["t"][-1]),
            arrays["R_start"],
            arrays["position_coefficients"],
            arrays.get("angular_velocity_coefficients"),
        )
    if "reference_t" in arrays:
        return SampledReference(MotionSamples(**{f.name: arrays[f"reference_{f.name}"] for f in fields(MotionSamples)}))
    t, p_SB, v_S, a_S, quat_SB_wxyz, omega_B, alpha_B = (arrays[key] for key in NEEDED)
    return SampledReference(MotionSamples(t, p_SB, v_S, a_S, matrix_from_quat_wxyz(quat_SB_wxyz), omega_B, alpha_B))


def _margin_record(m: InterfaceMargins) -> dict[str, float]:
    """Least margins of one interface over time; exact ones as a share of the normal force at rest."""
    return {
        "friction": m.friction,
        "friction_needed": float(m.friction_needed.max()),
        "friction_needed_worst": m.friction_needed_worst,
        "tip_over": float(m.tip_over.min()),
        "tip_over_worst": float(m.tip_over_worst.min()),
        "exact": float(m.exact.min()),
        "exact_worst": float(m.exact_worst.min()),
    }


def status_record(status: Status) -> dict[str, Any]:
    """The record of a status in plan.json."""
    return {"code": status.code, "ok": status.ok, "sentence": status.sentence, "details": dict(status.details)}


def status_from(record: Mapping[str, Any]) -> Status:
    """The status of a record in plan.json."""
    return Status(record["code"], record["sentence"], record["ok"], record["details"])
