"""The creep of MuJoCo's contacts, which is subtracted from displacements so that it does not count as slip.

A sticking contact in MuJoCo obeys J qacc = -b v_rel: the constraint includes the acceleration J qacc but not
J-dot qdot, which is not zero on a curved joint motion. So the velocity between object and tray settles at
(J-dot qdot of the object - J-dot qdot of the tray) / b instead of zero, whatever the friction, and an object that is
carried around a bend is permanently displaced. With b = 2 / (d_max timeconst) of the friction rows, and half a step
less because velocity is updated before position (semi-implicit integration), the law is

    d(slip)/dt = -(d_max timeconst / 2 - timestep / 2) P (bias of the tray's point - bias of the object's point)

with P the projection onto the contact plane. The bias of a free body at a point r from its origin is
omega x (omega x r). No number is fitted; test_physics_calibration.py compares the law with the engine.

A load against the rim cannot creep into the wall. Its friction, which tries to, is then missing in other directions: a
box slid along its wall by 2 mm. With such a load the creep is therefore prevented, in the steps of the engine
(salver.simulation.trace), and not subtracted.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from salver.geometry import Array, hat
from salver.models.arm.arm import ArmModel


@dataclass(frozen=True)
class TrayBias:
    """The velocity-dependent acceleration J-dot qdot of the tray at N instants, in E.

    linear (N, 3): of the origin of E, m/s^2. angular (N, 3): rad/s^2. omega (N, 3): the tray's angular velocity, rad/s.
    """

    linear: Array
    angular: Array
    omega: Array

    @cached_property
    def centripetal(self) -> Array:
        """hat(omega)^2 (N, 3, 3): times r, the bias at a point r from the origin of a body that turns with the tray."""
        spin = hat(self.omega)
        return spin @ spin

    @cached_property
    def by_place(self) -> Array:
        """(N, 3, 3): times r, what the bias has more at a point r from the origin of E that is fixed to the tray."""
        return hat(self.angular) + self.centripetal


def tray_bias(arm: ArmModel, q: Array, dq: Array, R_tilt: Array) -> TrayBias:
    """J-dot qdot of the real tray along (q, dq), each (N, n); R_tilt (3, 3): its axes in the assumed E."""
    twist, drift = np.empty((2, len(q), 6))
    for k, (position, velocity) in enumerate(zip(q, dq, strict=True)):
        twist[k], drift[k] = arm.twist_and_drift(position, velocity)
    linear = drift[:, :3] + np.cross(twist[:, 3:], twist[:, :3])
    return TrayBias(linear @ R_tilt, drift[:, 3:] @ R_tilt, twist[:, 3:] @ R_tilt)


def still_bias(count: int) -> TrayBias:
    """The zero bias of a tray that is fixed to the engine's world."""
    zero = np.zeros((count, 3))
    return TrayBias(zero, zero, zero)


def gain(contact_time: float, timestep: float, damping_width: float) -> float:
    """Creep speed per unit of bias acceleration, s."""
    return 0.5 * damping_width * contact_time - 0.5 * timestep


def creep(t: Array, bias: TrayBias, p_EP: Array, p_EB: Array, p_below: Array | None, gain_s: float) -> Array:
    """Creep (N, 3) in E since t[0] of a point of an object at p_EP (3,), relative to its support. p_EB: of the object;
    p_below: of the object that it stands on; None on the tray."""
    own = bias.centripetal @ (p_EP - p_EB)
    support = bias.linear + bias.by_place @ p_EP if p_below is None else bias.centripetal @ (p_EP - p_below)
    rate = -gain_s * (support - own) * [1.0, 1.0, 0.0]
    step = 0.5 * (rate[1:] + rate[:-1]) * np.diff(t)[:, None]
    return np.vstack([np.zeros(3), np.cumsum(step, axis=0)])
