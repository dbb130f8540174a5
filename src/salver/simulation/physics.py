"""Runs in the physics engine: a plan executed by its arm, or a tray that follows a reference exactly.

`simulate` runs the whole experiment: the arm in MuJoCo under the controller that a robot driver would step, with the
true parameters of the objects; `Experiment` repeats it with other parameters. `simulate_tray` moves the tray without
an arm. All return a SimulationRecord.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from salver.control.arm import ArmController, ArmState, Relay, Saturation
from salver.errors import SalverError, ScenarioError, UnreachableError
from salver.geometry import Array, matrix_from_quat_wxyz
from salver.models.arm.arm import ArmModel
from salver.models.arm.arm_limits import JointLimits
from salver.scenario import Scenario
from salver.simulation import tray_frame
from salver.simulation.closed_loop import tube_scalars
from salver.simulation.record import SimulationRecord
from salver.simulation.run import Options, Run, at_commands, measure, of_tray, prepare
from salver.simulation.scene.engine import mujoco
from salver.simulation.scene.loads import outside, true_world
from salver.simulation.scene.robots import robot_for
from salver.simulation.scene.scene import build
from salver.simulation.trace import Recorder, Trace, step
from salver.trajectory import JointMotion, MotionSamples, Reference

if TYPE_CHECKING:
    from salver.planning.plan import Plan


@dataclass(frozen=True, eq=False)
class Experiment:
    """A plan that is run many times, with what does not depend on the true parameters computed once.

    stop_at: s of the plan's time, when a stop is requested; None: never.
    Runs must not overlap, because they share the controller and the work space of the arm model.
    """

    plan: Plan
    options: Options = field(default_factory=Options)
    stop_at: float | None = None

    @cached_property
    def arm(self) -> ArmModel:
        return self.plan.scenario.load_arm()

    @cached_property
    def moved(self) -> Plan:
        """The plan, or its motion with the stop. Raises ScenarioError when the requested stop is impossible."""
        if self.stop_at is None:
            return self.plan
        from salver.planning.stops import stopped

        return stopped(self.plan, self.stop_at)

    @cached_property
    def joint(self) -> JointMotion:
        """The arm's motion. Raises UnreachableError when the plan has none."""
        if self.moved.joint is None:
            why = self.plan.no_arm_motion
            raise UnreachableError(f"{self.plan.scenario.name} has no joint motion to simulate: {why}")
        return self.moved.joint

    @cached_property
    def controller(self) -> ArmController | Relay:
        plan, stops = self.plan, self.plan.stops
        course = None if stops is None or self.stop_at is None else stops.course(self.stop_at)
        if stops is None or course is None or course.stop is None:
            return robot_for(plan.scenario, self.joint, plan.reference, self.arm, plan.space)
        assert plan.joint is not None
        first = robot_for(plan.scenario, plan.joint, plan.reference, self.arm, plan.space)
        stop = robot_for(plan.scenario, stops.motion(course.stop), None, self.arm, "joint")
        return Relay(first, stop, course.leaves)

    @cached_property
    def wanted(self) -> MotionSamples:
        """The reference at the instants of the commands."""
        return at_commands(self.plan.scenario, self.moved.reference)

    def run(self, parameters: Mapping[str, float] | None = None, seed: int = 0) -> SimulationRecord:
        """One run, as `simulate` makes it."""
        plan, scenario, options = self.plan, self.plan.scenario, self.options
        if scenario.arm is None:
            if self.stop_at is not None:
                raise ScenarioError(f"{scenario.name} has no arm; stops are motions of an arm.")
            return simulate_tray(plan.reference, scenario, parameters, options, seed)
        began = time.perf_counter()
        run, trace = self._carried(parameters, seed)
        summary = {
            "method": plan.method,
            "with_arm": True,
            "seed": seed,
            "arm": _arm_summary(self.arm.limits, trace, self.controller.saturation),
            "stand_ins": list(self.arm.weightless),
        }
        record = measure(run, trace, summary, began)
        if self.stop_at is None:
            found = tube_scalars(plan, record.t, record.cone_coefficients)
            record.summary["tube"] = {"excess": found.get("tube_excess")}  # type: ignore[index]
        else:
            assert plan.stops is not None
            course = plan.stops.course(self.stop_at)
            stop = {"stop_at": self.stop_at, "stop_takes": course.rests - self.stop_at, "finishes": course.stop is None}
            record.summary.update(stop)  # type: ignore[attr-defined]
        return record

    def strapped(self, parameters: Mapping[str, float] | None = None, seed: int = 0) -> Trace:
        """The trace of a run with the load fixed to the tray, without the reaction of loose contacts on the arm."""
        return self._carried(parameters, seed, strapped=True)[1]

    def _carried(self, parameters: Mapping[str, float] | None, seed: int, strapped: bool = False) -> tuple[Run, Trace]:
        scenario = self.plan.scenario
        scene = build(scenario, true_world(scenario, parameters), self.arm, strapped=strapped, seed=seed)
        run = Run(scenario, dict(parameters or {}), self.options, self.moved.reference, scene, self.wanted)
        self.controller.reset()
        q_start = self.joint.sample(0.0)[0][0]
        return run, _run_arm(run, self.controller, q_start, np.random.default_rng(seed))


def simulate(
    plan: Plan,
    *,
    parameters: Mapping[str, float] | None = None,
    seed: int = 0,
    options: Options | None = None,
    stop_at: float | None = None,
) -> SimulationRecord:
    """Run a plan in the physics engine, with its arm or, if the scenario has none, with a tray that moves exactly.

    Args:
        parameters: true values by name, in SI units (docs/conventions.md); the others are nominal.
        seed: seed of the sensor noise and of the vibration of the tray, 0 or more.
        stop_at: s of the plan's time, when a stop is requested; the plan must have stops (`salver.planning.stops`).

    Raises:
        ScenarioError: impossible parameters, or an impossible stop.
        UnreachableError: the plan has no joint motion.
        SalverError: the engine diverges.
    """
    record = Experiment(plan, options or Options(), stop_at).run(parameters, seed)
    return record.what_if(outside(plan.scenario.uncertain, parameters or {}))


def _run_arm(run: Run, controller: ArmController | Relay, q_start: Array, rng: np.random.Generator) -> Trace:
    """For each command: read the sensors, step the controller, apply its torque, step the engine."""
    scene, physics = run.scene, run.scenario.physics
    data, n = mujoco.MjData(scene.model), scene.n
    scene.place(data, q_start)
    recorder = Recorder(scene, len(run.t))
    steps = _steps_per_command(run.scenario)
    sensed: deque[ArmState] = deque(maxlen=physics.delay_steps + 1)
    qpos, qvel = data.qpos, data.qvel
    i, j = int(scene.qpos_ids[0]), int(scene.qvel_ids[0])
    noisy = physics.position_noise > 0 or physics.velocity_noise > 0
    for now in run.t.tolist():
        state = ArmState(qpos[:n].copy(), qvel[:n].copy())
        if noisy:
            state.q = state.q + physics.position_noise * rng.standard_normal(n)
            state.dq = state.dq + physics.velocity_noise * rng.standard_normal(n)
        if physics.feedback == "object":
            state.p_SB, state.R_SB = qpos[i : i + 3].copy(), matrix_from_quat_wxyz(qpos[i + 3 : i + 7])
            state.v_S, state.omega_B = qvel[j : j + 3].copy(), qvel[j + 3 : j + 6].copy()
        sensed.append(state)
        step(scene, data, now, controller.step(sensed[0], now), steps, recorder.take)
    _check_engine(data, run.scenario)
    return recorder.trace()


def _arm_summary(limits: JointLimits, trace: Trace, saturation: Saturation) -> dict[str, Any]:
    """Peak torque and velocity as shares of the joints' limits. cut: share of the commands that were saturated."""
    outside = np.maximum(limits.q_min - trace.q, trace.q - limits.q_max).max(axis=0)
    speed = np.abs(limits.shares({"position": trace.q, "velocity": trace.dq})["velocity"])
    return {
        "torque_share_peak": saturation.peak_share,
        "torque_cut": saturation.torque / max(1, saturation.steps),
        "torque_rate_cut": saturation.torque_rate / max(1, saturation.steps),
        "velocity_share_peak": float(speed.max()),
        "position_margin": float(-outside.max()),
        "limits_kept": bool(saturation.torque == 0 and speed.max() <= 1 and outside.max() <= 0),
    }


def simulate_tray(
    reference: Reference,
    scenario: Scenario,
    parameters: Mapping[str, float] | None = None,
    options: Options | None = None,
    seed: int = 0,
) -> SimulationRecord:
    """Run a motion of the tray in the physics engine, without arm and controller.

    Args:
        reference: motion of frame B of the first object, if it were fixed to the tray; the tray's tilt is added.
        parameters: true values by name, in SI units (docs/conventions.md); the others are nominal.
        seed: seed of the vibration of the tray.

    Raises:
        ScenarioError: impossible parameters.
        SalverError: the engine diverges.
    """
    began = time.perf_counter()
    run = prepare(scenario, parameters, options, reference, None, seed)
    scene, steps = run.scene, _steps_per_command(scenario)
    fine = run.t[0] + scenario.physics.timestep * np.arange(len(run.t) * steps)
    real = of_tray(reference.sample(fine), scene).of_frame(np.zeros(3), scene.world.R_tilt)
    if scene.shaking is not None:
        a, alpha = scene.shaking.at(fine)
        real = replace(real, a_S=real.a_S + a, alpha_B=real.alpha_B + np.einsum("tji,tj->ti", real.R_SB, alpha))
    motion = tray_frame.TrayMotion.of(real)
    model, data = scene.model, mujoco.MjData(scene.model)
    scene.place(data, down=motion.specific[0])
    recorder = Recorder(scene, len(run.t))
    none = np.empty(0)
    for k, now in enumerate(run.t):
        for i in range(steps):
            scene.slide(data)
            mujoco.mj_step1(model, data)
            tray_frame.apply(motion, k * steps + i, model, data, scene.object_ids, scene.qvel_ids, scene.point_ids)
            mujoco.mj_step2(model, data)
            if i == 0:
                recorder.take(now, none, none, none, data)
                recorder.seen_from_rest(motion, k * steps)
    _check_engine(data, scenario)
    return measure(run, recorder.trace(), {"method": "reference", "with_arm": False}, began)


def _steps_per_command(scenario: Scenario) -> int:
    ratio = scenario.physics.command_period / scenario.physics.timestep
    if abs(ratio - round(ratio)) > 1e-6 or round(ratio) < 1:
        raise ScenarioError(
            f"physics.command_period = {scenario.physics.command_period:g} s must be a multiple of physics.timestep = "
            f"{scenario.physics.timestep:g} s."
        )
    return round(ratio)


def _check_engine(data: Any, scenario: Scenario) -> None:
    bad = [mujoco.mjtWarning.mjWARN_BADQPOS, mujoco.mjtWarning.mjWARN_BADQVEL, mujoco.mjtWarning.mjWARN_BADQACC]
    if any(data.warning[int(w)].number for w in bad) or not np.all(np.isfinite(data.qpos)):
        raise SalverError(
            f"The physics engine diverged {data.time:.3f} s into the run; give physics.timestep a smaller value than "
            f"{scenario.physics.timestep:g} s."
        )
