"""Runs in the physics engine: a plan carried by its arm, or a tray moved exactly as a reference says.

`simulate` is the whole experiment: MuJoCo's arm under the controller that a robot driver would step, command by
command, with the objects as they truly are. `simulate_tray` leaves the arm out. Both return a SimulationRecord.
"""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from salver.errors import SalverError, ScenarioError
from salver.files import provenance
from salver.geometry import Array, invert, log, quat_wxyz_from_matrix
from salver.scenario import Scenario
from salver.simulation import creep, tray_frame
from salver.simulation.engine import mujoco
from salver.simulation.loads import true_world
from salver.simulation.outcome import Thresholds, behaviour, judge
from salver.simulation.record import SimulationRecord
from salver.simulation.scene import Scene, build
from salver.simulation.trace import Recorder, Trace
from salver.trajectory import MotionSamples, Reference

if TYPE_CHECKING:
    pass


@dataclass(frozen=True)
class Options:
    """record_rate: samples per second kept in the record (measured at every command). thresholds: see there.
    torque_rate_limit: hold the applied torque to the maker's rate, as the robot's own interface does.
    """

    record_rate: float = 200.0
    thresholds: Thresholds = field(default_factory=Thresholds)
    torque_rate_limit: bool = True


def simulate_tray(
    reference: Reference,
    scenario: Scenario,
    parameters: Mapping[str, float] | None = None,
    options: Options | None = None,
) -> SimulationRecord:
    """Move the tray so that frame B of the first object, were it glued on, follows `reference`. No arm, no controller.

    parameters: true values by name, where not nominal (docs/conventions.md). The tray's tilt adds to its motion.
    Raises ScenarioError for parameters that cannot be, SalverError when the engine diverges.
    """
    options = options or Options()
    began = time.perf_counter()
    scene = build(scenario, true_world(scenario, parameters))
    steps = _steps_per_command(scenario)
    t = _command_times(scenario, reference.duration)
    first = scene.loads[0].nominal
    tray_of_B = invert(first.p_EB, first.R_EB)
    h = scenario.physics.timestep
    fine = t[0] + h * np.arange(len(t) * steps)
    assumed = reference.sample(fine).of_frame(*tray_of_B)
    motion = tray_frame.TrayMotion.of(assumed.of_frame(np.zeros(3), scene.world.R_tilt))
    data = mujoco.MjData(scene.model)
    scene.place(data)
    recorder = Recorder(scene, len(t))
    none = np.empty(0)
    for k, now in enumerate(t):
        recorder.joints(now, none, none, none)
        for i in range(steps):
            mujoco.mj_step1(scene.model, data)
            tray_frame.apply(motion, k * steps + i, scene.model, data, scene.object_ids, scene.qvel_ids)
            mujoco.mj_step2(scene.model, data)
            if i == 0:
                recorder.take(data)
    _check_engine(data, scenario)
    trace = recorder.trace()
    at_command = assumed_at(assumed, slice(None, None, steps))
    summary = {"method": "reference", "with_arm": False, "duration": reference.duration}
    world = at_command.p_SB, at_command.R_SB @ scene.world.R_tilt
    return _record(
        scene,
        trace,
        creep.still_bias(len(t)),
        world,
        at_command,
        reference,
        scenario,
        parameters,
        options,
        summary,
        began,
    )


def assumed_at(motion: MotionSamples, keep: slice | Array) -> MotionSamples:
    """Some of the instants."""
    m = motion
    return MotionSamples(
        m.t[keep], m.p_SB[keep], m.v_S[keep], m.a_S[keep], m.R_SB[keep], m.omega_B[keep], m.alpha_B[keep]
    )


def _steps_per_command(scenario: Scenario) -> int:
    ratio = scenario.physics.command_period / scenario.physics.timestep
    if abs(ratio - round(ratio)) > 1e-6 or round(ratio) < 1:
        raise ScenarioError(
            f"physics.command_period = {scenario.physics.command_period:g} s is no multiple of physics.timestep = "
            f"{scenario.physics.timestep:g} s; it must be."
        )
    return round(ratio)


def _command_times(scenario: Scenario, duration: float) -> Array:
    """From rest before the motion to rest after it, with t = 0 among them."""
    period = scenario.physics.command_period
    before = round(scenario.physics.settle_before / period)
    after = int(np.ceil((duration + scenario.physics.settle_after) / period - 1e-9))
    return period * np.arange(-before, after + 1)


def _check_engine(data: Any, scenario: Scenario) -> None:
    bad = [mujoco.mjtWarning.mjWARN_BADQPOS, mujoco.mjtWarning.mjWARN_BADQVEL, mujoco.mjtWarning.mjWARN_BADQACC]
    if any(data.warning[int(w)].number for w in bad) or not np.all(np.isfinite(data.qpos)):
        raise SalverError(
            f"The physics engine diverged {data.time:.3f} s into the run; give physics.timestep a smaller value than "
            f"{scenario.physics.timestep:g} s."
        )


def _record(
    scene: Scene,
    trace: Trace,
    bias: creep.TrayBias,
    tray_S: tuple[Array, Array],
    assumed: MotionSamples,
    reference: Reference,
    scenario: Scenario,
    parameters: Mapping[str, float] | None,
    options: Options,
    summary: dict[str, Any],
    began: float,
) -> SimulationRecord:
    """Measure, judge and thin out. tray_S: pose of the real tray in S; assumed: motion of E that was wanted."""
    seen = behaviour(scene, trace, bias, scenario.tray.size)
    p_SE, R_SE = tray_S
    p_SB = p_SE[:, None] + np.einsum("tij,tmj->tmi", R_SE, seen.p_EB)
    R_SB = np.einsum("tij,tmjk->tmik", R_SE, seen.R_EB)
    wanted = reference.sample(trace.t)
    e_p, e_o = _pose_error(wanted, p_SB[:, 0], R_SB[:, 0])
    tray_e_p, tray_e_o = _pose_error(assumed, p_SE, R_SE)
    first = scene.loads[0]
    points = first.outline_B
    forces = trace.foot_force_B[:, : len(points)]
    wrench = np.concatenate([forces.sum(axis=1), np.cross(points, forces).sum(axis=1)], axis=1)
    cone = wrench @ np.linalg.pinv(first.nominal.contacts.grasp_map).T
    names = tuple(load.name for load in scene.loads)
    judged = judge(trace.t, seen, trace.touches, options.thresholds, names)
    moving = trace.t >= -1e-9
    every = max(1, round(1 / (options.record_rate * scenario.physics.command_period)))
    start = int(np.argmax(moving))
    keep = np.arange(start, len(trace.t), every)
    force_E = np.einsum("tji,tmj->tmi", trace.R_XE, trace.force_X)
    summary = {
        **judged,
        **summary,
        "e_p_peak": float(e_p[moving].max()),
        "e_o_peak": float(e_o[moving].max()),
        "tray_e_p_peak": float(tray_e_p[moving].max()),
        "tray_e_o_peak": float(tray_e_o[moving].max()),
        "cone_coefficient_min": float(cone[moving].min()),
        "wall_time": time.perf_counter() - began,
        "provenance": provenance(scenario),
    }
    return SimulationRecord(
        t=trace.t[keep],
        q=trace.q[keep],
        dq=trace.dq[keep],
        tau=trace.tau[keep],
        p_SE=p_SE[keep],
        quat_SE_wxyz=quat_wxyz_from_matrix(R_SE[keep]),
        p_SB=p_SB[keep],
        quat_SB_wxyz=quat_wxyz_from_matrix(R_SB[keep]),
        slip_E=seen.slip_E[keep],
        creep_E=seen.creep_E[keep],
        slip=seen.slip[keep],
        lift=seen.lift[keep],
        tip_angle=seen.tip_angle[keep],
        in_contact=trace.touches[keep],
        contact_force_E=force_E[keep],
        contact_points_B=points,
        contact_forces_B=forces[keep],
        cone_coefficients=cone[keep],
        e_p=e_p[keep],
        e_o=e_o[keep],
        tray_e_p=tray_e_p[keep],
        tray_e_o=tray_e_o[keep],
        object_names=names,
        parameters=dict(parameters or {}),
        summary=summary,
    )


def _pose_error(wanted: MotionSamples, p: Array, rotation: Array) -> tuple[Array, Array]:
    turn = log(np.swapaxes(rotation, -1, -2) @ wanted.R_SB)
    return np.linalg.norm(wanted.p_SB - p, axis=-1), np.linalg.norm(turn, axis=-1)
