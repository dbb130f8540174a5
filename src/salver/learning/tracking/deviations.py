"""Models of joint deviations from a plan, fitted to a measured deviation, with first and second derivatives.

A joint of a robot under position control follows its command as a second-order lag
z'' + kd z' + rate^2 (z - commanded) = 0 with a delay and friction, fitted by nonlinear least squares. Under salver's
computed torque with gains kp, kd all joints have the error e'' + kd e' + kp e = m(t) with the missing acceleration m(t)
(`salver.sensitivity.arm.tracking`), a sum of causes with one size each (linear least squares):

- a wrong payload setting: M^-1 J^T dF of the load, also at rest; and, because the error of the mass matrix also acts on
  the controller's response to e, a second-order part with the square of that size;
- delay: M^-1 dtau/dt for late commands, and kd dq* + kp q* for late measurements;
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
    """A fitted deviation. base (3, K, n): the deviation with two derivatives. tangent (3, n, K, m): its derivatives by
    the m fitted parameters of each joint."""

    base: Array
    tangent: Array

    @cached_property
    def _solve(self) -> Array:
        return np.linalg.pinv(self.tangent[0], rcond=1e-6)

    def to(self, off: Array) -> Array:
        """The linearised fit (3, K, n) to another deviation (K, n)."""
        by = np.einsum("jmk,kj->jm", self._solve, off - self.base[0])
        return np.asarray(self.base + np.einsum("djkm,jm->dkj", self.tangent, by))

    @classmethod
    def known(cls, base: Array) -> DeviationFit:
        return cls(base, np.zeros((3, base.shape[2], base.shape[1], 0)))


Fitted = Callable[[Array, JointMotion, Array], list[DeviationFit]]
"""A function of times t (K,), a plan and a deviation (K, n), with several fits."""
STANDSTILL = 0.02  # rad/s, velocity over which Coulomb friction changes its sign


def lag(t: Array, plan: JointMotion, rate: float, damping: float, delay: float, friction: float, joint: int) -> Array:
    """Deviation (3, K) of one joint with a second-order lag, delay and friction; the common delay of all joints is
    removed."""
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


def under_torque(scenario: Scenario, model: Any, tray: int, sagged: float = 2.0) -> Fitted:
    """Fits of payload, delay, both, and both with friction, under salver's computed torque.

    model: of the arm with its load. tray: frame of the tray in it. sagged: s before the log during
    which a wrong payload setting has acted.
    """
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
        payload = answer(np.einsum("tij,tj->ti", pulled, terms.w @ need.T), sagged)
        heavier = pulled @ need[:, :6] @ terms.jacobian
        again = answer(-np.einsum("tij,tj->ti", heavier, kp * payload[0] + kd * payload[1]), sagged)
        rates = np.stack([dq, ddq, np.gradient(ddq, t, axis=0)])
        delays = [answer(late(terms, rates, 1.0)), answer(kd * ddq + kp * dq)]
        turned = np.moveaxis(terms.mass_inverse * np.tanh(dq / STANDSTILL)[:, None, :], 2, 0)
        both = [payload, again, *delays]
        reasons = ([payload, again], delays, both, [*both, *(answer(each) for each in turned)])
        return [DeviationFit.known(_sum(np.stack(shapes), off)) for shapes in reasons]

    return fitted


def _sum(shapes: Array, off: Array) -> Array:
    """The linear combination (3, K, n) of shapes (m, 3, K, n) nearest to a deviation."""
    columns = shapes[:, 0].reshape(len(shapes), -1).T
    unit = np.linalg.norm(columns, axis=0)
    size = np.linalg.lstsq(columns / unit, off.ravel(), rcond=1e-6)[0] / unit
    return np.asarray(np.einsum("m,mdkj->dkj", size, shapes))
