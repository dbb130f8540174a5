"""Motions from files: retime them, or run them in the physics engine.

`read_waypoints` reads the path for `salver.planning.fastest.retiming.plan_retimed`. `at_pace` stretches a motion in
time until its audit holds. `simulate_given` moves the tray along a motion in the physics engine.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from salver.auditing import Audit, AuditOptions, audit_samples
from salver.auditing.motion import check_radians
from salver.auditing.options import DEFAULT
from salver.errors import FileFormatError, SalverError, ScenarioError
from salver.geometry import Array
from salver.models.arm.arm import load_arm
from salver.motion_files import JointSamples, Samples, read_path
from salver.motion_files.readers import TABLES
from salver.motion_files.samples import AT_REST, MOST_SAMPLES
from salver.motion_files.units import Units
from salver.motion_files.verdict import SPEED, UNSAFE, one_line
from salver.planning.plan import Plan, load_plan
from salver.run_directory import SCENARIO
from salver.scenario import Scenario
from salver.simulation.physics import simulate_tray
from salver.simulation.record import SimulationRecord
from salver.trajectory import SampledReference

FACTORS = (0.05, 20.0)  # least and largest time factor that is accepted


def read_waypoints(path: Path, scenario: Scenario, topic: str | None = None, units: str | None = None) -> Array:
    """Joint waypoints (K, n) in rad (m for prismatic joints), from a file or a run directory.

    Args:
        path: a motion file (`salver.motion_files`), a table of postures without times, or a run directory.
        units: units of a table, such as "deg,mm".

    Raises:
        FileFormatError: the file cannot be read.
        ScenarioError: the scenario has no arm.
    """
    if (path / SCENARIO).is_file() and units is None:
        return waypoints_of(load_plan(path), str(path))
    if scenario.arm is None:
        raise ScenarioError(f"{scenario.name} has no arm; a path of the joints needs one ([arm] in the scenario).")
    arm = load_arm(scenario.arm, scenario.tray)
    waypoints = read_path(path, arm.joint_names, topic, Units.parse(units, arm.linear))
    if path.suffix.lower() in TABLES:
        check_radians(waypoints, arm, str(path))
    if len(waypoints) > MOST_SAMPLES:
        raise FileFormatError(f"{path} has {len(waypoints)} waypoints; at most {MOST_SAMPLES} are accepted.")
    return waypoints


def waypoints_of(plan: Plan, source: str = "A directory of it") -> Array:
    """Joint path (2001, n) of a plan. Raises FileFormatError, naming `source`, for a plan without an arm."""
    if plan.joint is None:
        raise FileFormatError(f"{source} holds a plan without a joint motion; it must be one made with an arm.")
    return plan.joint.sample(np.linspace(0.0, plan.joint.duration, 2001))[0]


@dataclass(frozen=True)
class Paced:
    """A motion stretched in time, with its audit.

    factor: new duration over old. samples: the stretched motion. audit: its audit. too_fast: the joint that exceeds its
    velocity limit, in words, or None. unchecked: the limits that were not checked, in words.
    """

    factor: float
    samples: Samples
    audit: Audit
    too_fast: str | None
    unchecked: str

    @property
    def ok(self) -> bool:
        """Whether everything holds in the worst case and no joint is too fast."""
        return self.audit.ok and self.too_fast is None

    @property
    def verdict(self) -> str:
        """The verdict that its file carries, in one line.

        A motion that was marked unsafe stays so, because an audit checks neither torques nor obstacles.
        """
        if self.ok:
            speeds = self.audit.speeds_worst
            only = "" if speeds.every else f"{SPEED}: {speeds.verdict} "
            found = one_line(f"{only}Not checked: {self.unchecked}. {self.audit.worst.sentence}")
            return self.samples.verdict if self.samples.verdict.startswith(UNSAFE) else found
        fast = "" if self.too_fast is None else f" The arm cannot follow: {self.too_fast}."
        return one_line(f"{UNSAFE}: {self.audit.worst.sentence}{fast}")


def at_pace(
    samples: Samples,
    scenario: Scenario,
    factor: float | None = None,
    options: AuditOptions = DEFAULT,
    *,
    step: float = 1.02,
    tries: int = 40,
) -> Paced:
    """The motion stretched in time by `factor`.

    factor: new duration over old; if None, the least one (to 2 %) at which the audit holds. If the audit holds at none
    of those tried, the result is that of the first. step, tries: ratio and number of the factors that are tried.

    Raises SalverError for a factor outside `FACTORS`, and for a path on which the load cannot hold at any speed.
    """
    least, most = FACTORS
    if factor is not None:
        if not least <= factor <= most:
            raise SalverError(f"The time factor is {factor:g}; it must be {least:g} to {most:g}.")
        return _paced(samples, scenario, factor, options)
    pace = audit_samples(samples, scenario, options).speeds_worst.pace
    if not pace.ok:
        raise SalverError(f"{samples.source}: {pace.sentence}")
    factor = max(least, np.ceil(1000 * pace.details["factor"]) / 1000, _slowest_joint(samples, scenario)[0])
    first = found = _paced(samples, scenario, factor, options)
    for _ in range(tries):
        if found.ok or factor * step > most:
            break
        factor *= step
        found = _paced(samples, scenario, factor, options)
    return found if found.ok else first


def _paced(samples: Samples, scenario: Scenario, factor: float, options: AuditOptions) -> Paced:
    changed = samples.paced(factor)
    share, joint = _slowest_joint(changed, scenario)
    too_fast = f"{joint} moves at {100 * share:.0f} % of the speed that plans allow it" if share > 1 else None
    speeds = "acceleration, torque and collisions" if joint else "any limit of an arm"
    return Paced(factor, changed, audit_samples(changed, scenario, options), too_fast, speeds)


def _slowest_joint(samples: Samples, scenario: Scenario) -> tuple[float, str]:
    """Largest joint speed as a share of the velocity limit for plans, and the joint's name; (0, "") without joints."""
    if not isinstance(samples, JointSamples) or scenario.arm is None:
        return 0.0, ""
    arm = load_arm(scenario.arm, scenario.tray)
    known = [name for name in arm.joint_names if name in samples.names]
    order = [samples.names.index(name) for name in known] or list(range(len(samples.names)))
    if len(order) != arm.n:
        raise ScenarioError(f"{samples.source} has {len(order)} joints of {arm.name}, which has {arm.n}.")
    q = samples.q[:, order]
    at, speed = 0.5 * (q[1:] + q[:-1]), np.diff(q, axis=0) / np.diff(samples.t)[:, None]
    if samples.dq is not None:
        at, speed = np.concatenate([q, at]), np.concatenate([samples.dq[:, order], speed])
    share = np.abs(speed / arm.planning_limits.velocity_at(at, speed)[0]).max(axis=0)
    return float(share.max()), arm.joint_names[int(np.argmax(share))]


def simulate_given(
    samples: Samples,
    scenario: Scenario,
    parameters: Mapping[str, float] | None = None,
    options: AuditOptions = DEFAULT,
) -> SimulationRecord:
    """Run a motion in the physics engine: the tray follows it exactly, without an arm.

    parameters: true values by name, in SI units; the others are nominal. options: how the samples are interpreted, as
    in an audit. Raises SalverError for a motion that does not begin at rest, because the engine does.
    """
    motion = audit_samples(samples, scenario, options).motion.samples.distinct()
    speed = float(np.linalg.norm(motion.v_S[0]))
    if speed > AT_REST:
        raise SalverError(
            f"{samples.source} begins at {speed:.2g} m/s; a run in the engine begins at rest, so the motion must."
        )
    first = scenario.payload.first
    record = simulate_tray(SampledReference(motion.of_frame(first.p_EB, first.R_EB)), scenario, parameters)
    record.summary["source"] = samples.source  # type: ignore[index]
    return record
