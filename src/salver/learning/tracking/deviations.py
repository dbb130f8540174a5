"""Causes of joint deviations from a plan, fitted to a deviation, each with its first and second derivatives.

A robot under its own position control answers as a second-order lag z'' + kd z' + rate^2 (z - asked) = 0 with a delay
and friction, each joint its own (nonlinear least squares). Under salver's computed torque with gains kp, kd all joints
together answer what they are asked for and do not get, m(t), by e'' + kd e' + kp e = m(t)
(`salver.sensitivity.arm.tracking`), of which each reason has one size (linear least squares):

- a payload that is set wrongly: M^-1 J^T dF of the load, which is there at rest too; and since the same error of the
  mass matrix acts on what the controller asks for against e, the answer to that is as large as the error squared;
- delay: M^-1 dtau/dt of what is commanded late, and kd dq* + kp q* of what is measured late;
- friction that is not compensated: M^-1 of each joint's direction.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from scipy.optimize import least_squares

from salver.geometry import Array
from salver.linear_filter import LinearFilter, settled
from salver.models.interfaces import needed_at_tray
from salver.scenario import Scenario
from salver.sensitivity.arm.terms import motion_terms
from salver.sensitivity.arm.tracking import late
from salver.trajectory import JointMotion


@dataclass(frozen=True, eq=False)
class DeviationFit:
    """base (3, K, n): a deviation with two derivatives. tangent (3, n, K, m): what it changes by with each of the m
    numbers that were fitted for each joint."""

    base: Array
    tangent: Array

    @cached_property
    def _solve(self) -> Array:
        return np.linalg.pinv(self.tangent[0], rcond=1e-6)

    def to(self, off: Array) -> Array:
        """(3, K, n) fitted, linearised, to another deviation (K, n)."""
        by = np.einsum("jmk,kj->jm", self._solve, off - self.base[0])
        return np.asarray(self.base + np.einsum("djkm,jm->dkj", self.tangent, by))

    @classmethod
    def known(cls, base: Array) -> DeviationFit:
        return cls(base, np.zeros((3, base.shape[2], base.shape[1], 0)))


Fitted = Callable[[Array, JointMotion, Array], list[DeviationFit]]
"""Fits, of times t (K,), a plan and a deviation (K, n)."""
STANDSTILL = 0.02  # rad/s over which Coulomb friction changes its sign
_SAGGED = 2.0  # s that a wrong payload has acted before the log begins


def lag(t: Array, plan: JointMotion, rate: float, damping: float, delay: float, friction: float, joint: int) -> Array:
    """(3, K) the deviation of one joint that lags; late by its delay only, since all joints' lateness is taken off."""
    filter_ = LinearFilter.on_nodes(t, rate**2, 2 * damping * rate, 3)
    here = np.stack(plan.sample(t))[:, :, joint]
    asked = np.stack(plan.sample(t + 2 * damping / rate - delay))[:, :, joint]
    drive = friction * np.tanh(here[1] / STANDSTILL) - asked[2] - filter_.kd * asked[1]
    x, v = filter_.respond(drive)
    return np.asarray(asked - here + np.stack([x, v, filter_.acceleration(drive, x, v)]))


def of_lags(t: Array, plan: JointMotion, off: Array) -> list[DeviationFit]:
    """Lags without and with friction. InitialState at 10 Hz; 2 to 60 Hz are tried."""
    low, high, unit = [12.0, 0.1, -0.05, -100.0], [400.0, 2.0, 0.05, 100.0], np.array([60.0, 0.6, 0.005, 1.0])
    bases, rubbed, tangents = [], [], []
    for j, column in enumerate(off.T):

        def joint(p: Array, j: int = j) -> Array:
            return lag(t, plan, *p, joint=j)  # type: ignore[misc]

        found = least_squares(
            lambda p, c=column, f=joint: f(p)[0] - c, [60.0, 0.6, 0.0, 0.0], bounds=(low, high), x_scale=unit
        ).x
        steps = 1e-4 * np.diag(unit)
        bases.append(joint(np.append(found[:3], 0.0)))
        rubbed.append(joint(found))
        tangents.append(np.stack([(joint(found + x) - joint(found - x)) / 2e-4 for x in steps], axis=2))
    tangent = np.stack(tangents, axis=1)
    return [DeviationFit(np.stack(bases, axis=2), tangent[..., :3]), DeviationFit(np.stack(rubbed, axis=2), tangent)]


def under_torque(scenario: Scenario, model: Any, tray: int) -> Fitted:
    """Payload, delay, both, and both with friction. model, tray: of the arm with its load, and the frame that carries
    it."""
    kp, kd = scenario.control.kp[0], scenario.control.kd[0]
    body = scenario.payload.first

    def fitted(t: Array, plan: JointMotion, off: Array) -> list[DeviationFit]:
        loop = LinearFilter.on_nodes(t, kp, kd, 3)
        q, dq, ddq = plan.sample(t)
        terms = motion_terms(model, tray, q, dq, ddq)

        def answer(drive: Array, seconds: float = 0.0) -> Array:
            x, v = loop.respond(drive, settled(kp, kd, seconds, drive[0]))
            return np.stack([x, v, loop.acceleration(drive, x, v)])

        need, pulled = needed_at_tray(body, body.inertial.phi), terms.mass_inverse @ np.swapaxes(terms.jacobian, 1, 2)
        payload = answer(np.einsum("tij,tj->ti", pulled, terms.w @ need.T), _SAGGED)
        heavier = pulled @ need[:, :6] @ terms.jacobian
        again = answer(-np.einsum("tij,tj->ti", heavier, kp * payload[0] + kd * payload[1]), _SAGGED)
        rates = np.stack([dq, ddq, np.gradient(ddq, t, axis=0)])
        delays = [answer(late(terms, rates, 1.0)), answer(kd * ddq + kp * dq)]
        turned = np.moveaxis(terms.mass_inverse * np.tanh(dq / STANDSTILL)[:, None, :], 2, 0)
        both = [payload, again, *delays]
        reasons = ([payload, again], delays, both, [*both, *(answer(each) for each in turned)])
        return [DeviationFit.known(_sum(np.stack(shapes), off)) for shapes in reasons]

    return fitted


def _sum(shapes: Array, off: Array) -> Array:
    """(3, K, n) the sum of shapes (m, 3, K, n), each of one size, that is nearest to a deviation."""
    columns = shapes[:, 0].reshape(len(shapes), -1).T
    unit = np.linalg.norm(columns, axis=0)
    size = np.linalg.lstsq(columns / unit, off.ravel(), rcond=1e-6)[0] / unit
    return np.asarray(np.einsum("m,mdkj->dkj", size, shapes))
