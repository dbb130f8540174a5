"""A swinging arm with a load that is not what it was taken for: full forward dynamics under the real controller."""

from dataclasses import replace
from functools import cache

import numpy as np
import pinocchio as pin

from salver import scenario
from salver.control.arm import ArmController, ArmState
from salver.control.object import Gains
from salver.geometry import exp
from salver.models.arm.arm import with_load
from salver.models.rigid_body import RigidBody, inertia_matrix
from salver.models.uncertain.parameters import INERTIAL, inertial_vector
from salver.sensitivity.arm import chain_model
from salver.sensitivity.arm.terms import motion_terms
from salver.trajectory import JointMotion, MotionSamples, SampledReference

DURATION, STEP = 1.0, 2.5e-3
T = np.linspace(0.0, DURATION, round(DURATION / STEP) + 1)
UNCERTAIN = {
    "mass": "10%",
    "com": [0.003, 0.002, 0.004],
    "inertia": [4e-5, 1e-5, 4e-5, 1e-5, 1e-5, 4e-5],
    "friction": "10%",
    "position": [0.002, 0.003],
}
CUBE = scenario.load("panda-cube").with_changes(
    motion__duration=DURATION, objects__0__uncertainty=UNCERTAIN, uncertainty__tilt_deg=[0.5, 0.5]
)
# A turned object beside the tray's centre, so that no lever vanishes.
CUBE = CUBE.with_changes(objects__0__at=[0.03, -0.02], objects__0__yaw_deg=20)
UR10 = scenario.load("ur10-bottle").with_changes(motion__duration=DURATION)


class Case:
    """A scenario with a quintic joint motion that swings and turns the tray, and the object's motion along it."""

    def __init__(self, name: str) -> None:
        self.scenario = {"panda": CUBE, "ur10": UR10}[name]
        start, swing = {
            "panda": (np.array(CUBE.arm.start_posture), np.array([0.7, -0.2, 0.3, 0.2, 0.4, 0.3, -0.5])),
            "ur10": (np.array([0.1, -1.6, 1.5, -1.4, -1.5, 0.3]), np.array([0.6, 0.2, -0.3, 0.3, 0.4, -0.5])),
        }[name]
        ends = np.stack([start, start + swing])
        self.joint = JointMotion(np.array([0.0, DURATION]), ends, np.zeros_like(ends), np.zeros_like(ends))
        model = chain_model(self.scenario)
        self.model = replace(model, loop=replace(model.loop, delay=0.0))
        self.body = self.model.items[0]
        fine = np.linspace(0.0, DURATION, 401)
        self.terms = motion_terms(self.model.loaded.pin_model, self.model.loaded.tray_id, *self.joint.sample(fine))
        force, omega, alpha = self.terms.w[:, :3], self.terms.twist[:, 3:], self.terms.w[:, 3:6]
        R, gravity = self.terms.R_SE, np.array([0.0, 0.0, -9.81])
        a_S = np.einsum("tij,tj->ti", R, force) + gravity
        v_S = np.einsum("tij,tj->ti", R, self.terms.twist[:, :3])
        tray = MotionSamples(fine, self.terms.p_SE, v_S, a_S, R, omega, alpha)
        self.reference = SampledReference(tray.of_frame(self.body.p_EB, self.body.R_EB))

    def carried(self, change: dict[str, float]) -> list:
        """The bodies as they are when parameters differ from nominal."""
        tilt = exp(np.array([change.get("tilt_x", 0.0), change.get("tilt_y", 0.0), 0.0]))
        shift = np.array([change.get("position_x", 0.0), change.get("position_y", 0.0), 0.0])
        inertial = inertial_vector(self.body.inertial) + [change.get(name, 0.0) for name in INERTIAL]
        true = RigidBody(inertial[0], inertial[1:4], inertia_matrix(inertial[4:]))
        moved = replace(self.body, inertial=true, p_EB=tilt @ (self.body.p_EB + shift), R_EB=tilt @ self.body.R_EB)
        return [moved, *self.model.items[1:]]

    def rollout(self, space: str, change: dict[str, float], hold: int = 0) -> dict[str, np.ndarray]:
        """Full forward dynamics with the true load stuck to the tray, under the real controller in every stage.

        hold: so many steps each torque is held instead.
        """
        control = self.scenario.control
        controller = ArmController(
            self.model.arm,
            list(self.model.items),
            self.joint,
            self.reference,
            Gains(control.kp, control.kd),
            space=space,
            limit_torque=False,
        )
        plant = with_load(self.model.arm, self.carried(change))
        model, data = plant.pin_model, plant.data

        def rate(t, x):
            q, dq = x
            now = controller.step(ArmState(q, dq), t) if held is None else held
            return np.stack([dq, pin.aba(model, data, q, dq, now)])

        held = None

        x = np.stack([self.joint.q[0], np.zeros(len(self.joint.q[0]))])
        out: dict[str, list] = {key: [] for key in ("q", "dq", "ddq", "torque")}
        for k in range(-round(self.model.loop.settle / STEP), len(T)):
            t = k * STEP
            if hold and k % hold == 0:
                held = controller.step(ArmState(*x), t)
            if k >= 0:
                torque = controller.step(ArmState(*x), t) if held is None else held
                for key, value in zip(out, (*x, pin.aba(model, data, *x, torque).copy(), torque), strict=True):
                    out[key].append(value)
            k1 = rate(t, x)
            k2 = rate(t + STEP / 2, x + STEP / 2 * k1)
            k3 = rate(t + STEP / 2, x + STEP / 2 * k2)
            x = x + STEP / 6 * (k1 + 2 * k2 + 2 * k3 + rate(t + STEP, x + STEP * k3))
        return {key: np.array(value) for key, value in out.items()}

    def slope(self, space: str, change: dict[str, float]) -> dict[str, np.ndarray]:
        """Central difference of the rollout along a direction, for a step of one."""
        up, down = (self.rollout(space, {k: s * v for k, v in change.items()}) for s in (1.0, -1.0))
        return {key: 0.5 * (up[key] - down[key]) for key in up}

    def felt(self, run: dict[str, np.ndarray]) -> np.ndarray:
        """w (T, 12) of E along a rollout."""
        return motion_terms(self.model.loaded.pin_model, self.model.loaded.tray_id, run["q"], run["dq"], run["ddq"]).w


@cache
def case_of(name: str) -> Case:
    """One of them, made once."""
    return Case(name)


def relative(found, expected):
    """Largest difference, as a share of the largest expected value."""
    return float(np.abs(found - expected).max() / np.abs(expected).max())
