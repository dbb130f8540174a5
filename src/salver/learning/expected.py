"""What strays an arm under computed torque, as its controller's gains tell: deviations known but for their size.

With gains kp, kd the joints answer what they are asked for and do not get, m(t), by e'' + kd e' + kp e = m(t)
(`salver.sensitivity.arm.tracking`). Three things are missing on many arms:

- a payload that is set wrongly: M^-1 J^T dF of the load, which is there at rest too; and since the same error of the
  mass matrix acts on what the controller asks for against e, the answer to that is as large as the error squared;
- delay: M^-1 dtau/dt of what is commanded late, and kd dq* + kp q* of what is measured late;
- friction that is not compensated: M^-1 of each joint's direction.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from salver.geometry import Array
from salver.learning.executed import STILL, Shapes
from salver.models.bodies import Body
from salver.models.interfaces import to_tray
from salver.models.tray_motion import frame_map, wrench_map
from salver.scenario import Scenario
from salver.sensitivity.arm.terms import motion_terms
from salver.sensitivity.arm.tracking import late
from salver.sensitivity.filter import LinearFilter, settled
from salver.trajectory import JointMotion

RESTED = 2.0  # s that a wrong payload has acted before the log begins


def expected(scenario: Scenario, model: Any, tray: int, t: Array, plan: JointMotion) -> Shapes:
    """Sets of shapes (3, K, n) along a plan at t (K,), of one size for all joints and of one for each; none for a robot
    under its own position control. model, tray: of the arm with its load, and the frame that carries it."""
    if scenario.physics.robot.control != "torque":
        return [], []
    kp, kd = scenario.control.kp[0], scenario.control.kd[0]
    loop = LinearFilter.on_nodes(t, kp, kd, 3)
    q, dq, ddq = plan.sample(t)
    terms = motion_terms(model, tray, q, dq, ddq)

    def answer(drive: Array, seconds: float = 0.0) -> Array:
        x, v = loop.respond(drive, settled(kp, kd, seconds, drive[0]))
        return np.stack([x, v, loop.acceleration(drive, x, v)])

    need = _need(scenario.payload.first)
    pulled = terms.mass_inverse @ np.swapaxes(terms.jacobian, 1, 2)
    payload = answer(np.einsum("tij,tj->ti", pulled, terms.w @ need.T), RESTED)
    heavier = pulled @ need[:, :6] @ terms.jacobian
    again = answer(-np.einsum("tij,tj->ti", heavier, kp * payload[0] + kd * payload[1]), RESTED)
    rates = np.stack([dq, ddq, np.gradient(ddq, t, axis=0)])
    delays = [answer(late(terms, rates, 1.0)), answer(kd * ddq + kp * dq)]
    turned = np.moveaxis(terms.mass_inverse * np.tanh(dq / STILL)[:, None, :], 2, 0)
    friction = [answer(each) for each in turned]
    shared = [[payload, again], delays, [payload, again, *delays]]
    return shared, [[payload], delays, friction, [payload, *friction], [payload, again, *delays, *friction]]


def _need(body: Body) -> Array:
    """(6, 12) w of E to the wrench at E that a load needs."""
    return to_tray(body.p_EB, body.R_EB) @ wrench_map(body.inertial.phi) @ frame_map(body.p_EB, body.R_EB)
