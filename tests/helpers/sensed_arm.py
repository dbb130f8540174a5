"""Simulated logs of an arm's sensors, for a plan or an executed motion with any load or with the empty tray.

Their errors differ from the model of `salver.learning.load.noise`: noise through a second-order filter, a bias, a
random-walk drift, links that are heavier than in the model, joint friction that changes from run to run.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.signal import lfilter

from salver.geometry import Array
from salver.learning.load.sensors import at_flange, heavier, tray_wrench
from salver.learning.logs import Log
from salver.models.interfaces import needed_at_tray
from salver.models.uncertain.parameters import inertial_vector, phi_of
from salver.planning.plan import Plan
from salver.sensitivity.arm.terms import motion_terms

RESTS = 0.2  # s of rest in a log before and after the motion
COLOURED = 10.0  # Hz, cut-off of the second-order filter of coloured noise; its correlation time is 34 ms
Done = tuple[Array, Array, Array, Array]  # t (K,), q, dq, ddq (K, n)


@dataclass(frozen=True)
class Sensors:
    """Sizes of random errors, in N, N m, rad; standard deviations unless stated otherwise.

    torque, force, moment: of noise, of which a share of the variance (`coloured`, `wrist_coloured`) is coloured.
    torque_bias, force_bias, moment_bias: largest bias of a channel in a run. torque_drift: in a second; the drift of a
    wrist sensor equals its bias. links: relative error of each link's mass, in all runs. friction: (low, high) N m of
    joints, of which a share `friction_change` changes in each run. rate: samples per second. times: factor of all
    noise.
    """

    torque: float = 0.08
    torque_bias: float = 0.075
    torque_drift: float = 0.03
    force: float = 0.05
    force_bias: float = 0.01
    moment: float = 0.002
    moment_bias: float = 0.0004
    encoder: float = 2e-5
    links: float = 0.02
    friction: tuple[float, float] = (0.1, 0.5)
    friction_change: float = 0.1
    rate: float = 200.0
    times: float = 1.0
    coloured: float = 0.5
    wrist_coloured: float = 0.5

    def errors(
        self, count: int, noise: Array, bias: Array, drift: Array, share: float, rng: np.random.Generator
    ) -> Array:
        """Errors (count, m) of m channels: white noise, coloured noise (`share` of the variance), a bias, and a random
        walk with the standard deviation `drift` after a second."""
        m = len(noise)
        white = rng.standard_normal((count, m))
        pole = np.exp(-2 * np.pi * COLOURED / self.rate)
        driven = rng.standard_normal((count + round(self.rate), m))
        coloured = lfilter([1.0], [1.0, -2 * pole, pole**2], driven, axis=0)[-count:]
        coloured *= np.sqrt((1 - pole**2) ** 3 / (1 + pole**2))
        walk = np.cumsum(rng.standard_normal((count, m)), axis=0) / np.sqrt(self.rate)
        out = (
            noise * (np.sqrt(1 - share) * white + np.sqrt(share) * coloured)
            + bias * rng.uniform(-1, 1, m)
            + drift * walk
        )
        return np.asarray(self.times * out)

    def torque_errors(self, count: int, joints: int, rng: np.random.Generator) -> Array:
        """Errors (count, joints) of joint torques, N m."""
        noise, bias, drift = (np.full(joints, x) for x in (self.torque, self.torque_bias, self.torque_drift))
        return self.errors(count, noise, bias, drift, self.coloured, rng)


class SensedArm:
    """A simulated arm with errors of its own, which carries loads. wrist, joints: whether it has these sensors."""

    def __init__(
        self,
        plan: Plan,
        seed: int,
        sensors: Sensors | None = None,
        *,
        wrist: bool = True,
        joints: bool = True,
    ) -> None:
        assert plan.joint is not None
        self.plan, self.joint, self.sensors = plan, plan.joint, sensors or Sensors()
        self.wrist, self.joints = wrist, joints
        self.rng = np.random.default_rng(seed)
        self.arm = plan.scenario.load_arm()
        low, high = self.sensors.friction
        self.friction = self.rng.uniform(low, high, self.arm.n)
        self.model = self.arm.pin_model.copy()
        links = range(1, self.model.njoints - 1)  # the last carries the tray, whose mass is known
        heavier(self.model, {k: 1 + self.sensors.links * self.rng.standard_normal() for k in links})
        self.other = self.model  # model of the arm in runs with a load

    def log(self, inertial: Array | None, source: str = "log", done: Done | None = None) -> Log:
        """Log of a run with a load with values (10,) of `parameters.INERTIAL` in B, or with the empty tray (None).

        done: the executed motion; default: the plan, with `RESTS` before and after, at `Sensors.rate`.
        """
        s, rng, n = self.sensors, self.rng, self.arm.n
        if done is None:
            t = np.arange(-RESTS, self.plan.duration + RESTS, 1 / s.rate)
            done = (t, *self.joint.sample(t)[:3])
        t, q, dq, ddq = done
        model = self.model if inertial is None else self.other
        terms = motion_terms(model, self.arm.tray_id, q, dq, ddq)
        tau, wrench = terms.torque.copy(), tray_wrench(self.plan.scenario.tray, self.arm, terms.w)
        if inertial is not None:
            load_E = needed_at_tray(self.plan.scenario.payload.first, phi_of(inertial)) @ terms.w[:, :, None]
            tau += (np.swapaxes(terms.jacobian, 1, 2) @ load_E)[:, :, 0]
            wrench += at_flange(self.arm, load_E)[:, :, 0]
        change = 1 + s.friction_change * rng.standard_normal(n)
        tau += self.friction * change * np.tanh(dq / 0.02) + 0.1 * s.friction_change * rng.standard_normal(n) * dq
        tau, wrench = self.sensed(t, q, tau, wrench, inertial is not None)
        each = np.array([s.force] * 3 + [s.moment] * 3)
        bias = np.array([s.force_bias] * 3 + [s.moment_bias] * 3)
        tau += s.torque_errors(len(t), n, rng)
        wrench += s.errors(len(t), each, bias, bias, s.wrist_coloured, rng)
        seen = q + s.times * s.encoder * rng.standard_normal(q.shape)
        return Log(source, t, seen, tau if self.joints else None, wrench if self.wrist else None)

    def sensed(self, t: Array, q: Array, tau: Array, wrench: Array, loaded: bool) -> tuple[Array, Array]:
        """Joint torques (K, n) and wrenches (K, 6) at the flange as the sensors show them, without random errors; a
        subclass may add systematic ones. t (K,), q (K, n): the motion. loaded: whether a load is on the tray."""
        return tau, wrench


def nominal_load(plan: Plan) -> Array:
    """Values (10,) of `INERTIAL` for the plan's nominal load."""
    return inertial_vector(plan.scenario.payload.first.inertial)
