"""Motions from files: retime them, or run them in the physics engine.

`read_waypoints` reads the path for `salver.planning.fastest.retiming.plan_retimed`.
`simulate_given` moves the tray along a motion in the physics engine.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from salver.auditing import AuditOptions, audit_samples
from salver.auditing.motion import check_radians
from salver.auditing.options import DEFAULT
from salver.errors import FileFormatError, SalverError
from salver.geometry import Array
from salver.motion_files import Samples, read_path
from salver.motion_files.readers import TABLES
from salver.motion_files.samples import AT_REST, MOST_SAMPLES
from salver.motion_files.units import Units
from salver.planning.plan import Plan, load_plan
from salver.run_directory import SCENARIO
from salver.scenario import Scenario
from salver.simulation.record import SimulationRecord
from salver.trajectory import SampledReference


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
    arm = scenario.load_arm()
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
    from salver.simulation.physics import simulate_tray

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
