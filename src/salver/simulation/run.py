"""One run in the physics engine: its scene, the measurement of its trace, its record."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np

from salver.files import provenance
from salver.geometry import Array, invert, log, quat_wxyz_from_matrix
from salver.models.arm.arm import ArmModel
from salver.scenario import Scenario
from salver.simulation import creep
from salver.simulation.outcome import Behaviour, Thresholds, behaviour, inner_motions, judge
from salver.simulation.record import SimulationRecord
from salver.simulation.scene.loads import true_world
from salver.simulation.scene.scene import Scene, build
from salver.simulation.trace import Trace, net_contact_wrench
from salver.trajectory import MotionSamples, Reference


@dataclass(frozen=True)
class Options:
    """Options of a run.

    record_rate: samples per second in the record; outcomes are judged at every command. thresholds: of the outcomes.
    """

    record_rate: float = 200.0
    thresholds: Thresholds = field(default_factory=Thresholds)


@dataclass(frozen=True)
class Run:
    """One run: the scene and its settings. wanted: the reference at the instants of the commands."""

    scenario: Scenario
    parameters: Mapping[str, float]
    options: Options
    reference: Reference
    scene: Scene
    wanted: MotionSamples

    @property
    def t(self) -> Array:
        """Times (N,) of the commands, s."""
        return self.wanted.t

    @cached_property
    def wanted_E(self) -> MotionSamples:
        """Reference motion of the assumed tray frame E at the instants of the commands."""
        return of_tray(self.wanted, self.scene)


def prepare(
    scenario: Scenario,
    parameters: Mapping[str, float] | None,
    options: Options | None,
    reference: Reference,
    arm: ArmModel | None,
    seed: int = 0,
) -> Run:
    """Build the scene with its true parameters, and sample the reference. seed: of the vibration of the tray."""
    scene = build(scenario, true_world(scenario, parameters), arm, seed=seed)
    wanted = at_commands(scenario, reference)
    return Run(scenario, dict(parameters or {}), options or Options(), reference, scene, wanted)


def at_commands(scenario: Scenario, reference: Reference) -> MotionSamples:
    """The reference at the commands of a run, from rest before the motion to rest after it, including t = 0."""
    period, physics = scenario.physics.command_period, scenario.physics
    before = round(physics.settle_before / period)
    after = int(np.ceil((reference.duration + physics.settle_after) / period - 1e-9))
    return reference.sample(period * np.arange(-before, after + 1, dtype=np.float64))


def of_tray(wanted: MotionSamples, scene: Scene) -> MotionSamples:
    """Motion of the assumed frame E for which the first object, fixed to the tray, moves as `wanted`."""
    first = scene.loads[0].nominal
    return wanted.of_frame(*invert(first.p_EB, first.R_EB))


def measure(
    run: Run,
    trace: Trace,
    summary: dict[str, Any],
    began: float,
) -> SimulationRecord:
    """Make the record of a run: measure, judge the outcome, keep samples at the record rate.

    summary: entries to add. began: `time.perf_counter()` before the run.
    """
    scene, scenario = run.scene, run.scenario
    if scene.arm is None:  # the tray is the engine's world, and follows the reference exactly
        bias, p_SE, R_SE = creep.still_bias(len(trace.t)), run.wanted_E.p_SB, run.wanted_E.R_SB @ scene.world.R_tilt
    else:
        bias, p_SE, R_SE = creep.tray_bias(scene.arm, trace.q, trace.dq, scene.world.R_tilt), trace.p_XE, trace.R_XE
        bias = creep.still_bias(len(trace.t)) if scene.beside_walls else bias
    seen, inner = behaviour(scene, trace, bias, scenario.tray.size), inner_motions(scene, trace)
    p_SB = p_SE[:, None] + np.einsum("tij,tmj->tmi", R_SE, seen.p_EB)
    R_SB = R_SE[:, None] @ seen.R_EB
    e_p, e_o = _pose_error(run.wanted, p_SB[:, 0], R_SB[:, 0])
    tray_e_p, tray_e_o = _pose_error(run.wanted_E, p_SE, R_SE)
    first = scene.loads[0]
    points = first.outline_B
    cone = net_contact_wrench(scene, trace) @ np.linalg.pinv(first.nominal.contacts.grasp_map).T
    moving = trace.t >= -1e-9
    counted = moving & ~np.logical_or.accumulate(seen.lost[:, 0])  # a lost object has no reference
    counted[np.argmax(moving)] = True
    every = max(1, round(1 / (run.options.record_rate * scenario.physics.command_period)))
    keep = np.arange(int(np.argmax(moving)), len(trace.t), every)
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
        surface=inner[keep],
        contact_force_E=np.einsum("tji,tmj->tmi", trace.R_XE, trace.force_X)[keep],
        contact_points_B=points,
        contact_forces_B=trace.foot_force_B[keep, : len(points)],
        cone_coefficients=cone[keep],
        e_p=e_p[keep],
        e_o=e_o[keep],
        tray_e_p=tray_e_p[keep],
        tray_e_o=tray_e_o[keep],
        object_names=tuple(load.name for load in scene.loads),
        parameters=run.parameters,
        summary={
            **_judged(run, trace, seen, inner, summary),
            **summary,
            "duration": run.reference.duration,
            "collides_at": float(trace.t[np.argmax(trace.collides)]) if trace.collides.any() else None,
            "e_p_peak": float(e_p[counted].max()),
            "e_o_peak": float(e_o[counted].max()),
            "tray_e_p_peak": float(tray_e_p[moving].max()),
            "tray_e_o_peak": float(tray_e_o[moving].max()),
            "cone_coefficient_min": float(cone[counted].min()),
            "wall_time": time.perf_counter() - began,
            "provenance": provenance(scenario),
        },
    )


def _judged(run: Run, trace: Trace, seen: Behaviour, inner: Array, summary: Mapping[str, Any]) -> dict[str, Any]:
    """The outcome of the loads; "limit" if all of them hold but the arm exceeded its limits."""
    judged = judge(trace.t, seen, trace.touches, run.options.thresholds, run.scene.loads, inner)
    if judged["outcome"] == "holds" and not summary.get("arm", {}).get("limits_kept", True):
        judged["outcome"] = "limit"
    return judged


def _pose_error(wanted: MotionSamples, p: Array, rotation: Array) -> tuple[Array, Array]:
    turn = log(np.swapaxes(rotation, -1, -2) @ wanted.R_SB)
    return np.linalg.norm(wanted.p_SB - p, axis=-1), np.linalg.norm(turn, axis=-1)
