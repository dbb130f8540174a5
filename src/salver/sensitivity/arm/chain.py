"""First-order sensitivity of the real chain: arm, computed torque with a nominal load, objects held by friction.

The paper closes its loop around a free object on which the controller's forces act directly: there a wrong mass
first makes an error, then the input reacts. An object that stands on a tray gets what it needs at once, because it
moves with the tray, and what is wrong is the arm's torque. With M the mass matrix of the arm and its nominal load,

    M (ddq_cmd - ddq) = J_E^T dF(t),        dF = (d load / dp) w(t)

to first order, whatever the law for ddq_cmd; `salver.sensitivity.arm.tracking` and `.arm_task` solve it for the two
laws of `salver.control.arm`. From the deviation of the joints follow the tray's, what the objects feel, the torque
and the contact rows.

A command is held for a period, so it acts half a period late: what is missing then is M^-1 dtau/dt times that delay,
the same in every run. It is told apart (`ArmChain.held`), because it is known.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from salver.control.arm import POSTURE_GAINS
from salver.control.object import Gains
from salver.errors import ScenarioError
from salver.geometry import Array
from salver.models.arm import ArmModel, load_arm, with_load
from salver.models.bodies import Body
from salver.models.contact_rows import ContactRows, contact_rows
from salver.models.parameters import UncertainSet
from salver.models.worst_case import Drift
from salver.sensitivity import tubes
from salver.sensitivity.arm.contact import ContactChange, contact_change
from salver.sensitivity.arm.filter import node_filter
from salver.sensitivity.arm.load import LoadChange, load_change
from salver.sensitivity.arm.task import TrayDeviation, joints_of_task, tray_of_joints, tray_of_task
from salver.sensitivity.arm.terms import MotionTerms, motion_terms
from salver.sensitivity.arm.tracking import (
    JointDeviation,
    missing_acceleration,
    tracking_error,
    tracking_wrench_motion,
)

if TYPE_CHECKING:
    from salver.scenario import Scenario
    from salver.trajectory import JointMotion

__all__ = ["ArmChain", "ChainModel", "arm_chain", "chain_model", "tracking_wrench_motion"]

Space = Literal["object", "joint"]
_GRID_STEP = 0.0125  # s at most between instants; the filter is exact on cubics between them


@dataclass(frozen=True, eq=False)
class ChainModel:
    """What is constant for a scenario: make it once, use it for many motions.

    arm, loaded: without and with the nominal objects. contact: rows at nominal parameters; worst_rows: over the
    uncertain set. settle: s that the arm holds its load before the motion. delay: s by which a command acts late.
    """

    scenario: Scenario
    arm: ArmModel
    loaded: ArmModel
    items: tuple[Body, ...]
    gains: Gains
    load: LoadChange
    contact: ContactChange
    worst_rows: tuple[ContactRows, ...]
    settle: float
    delay: float

    @property
    def uncertain(self) -> UncertainSet:
        return self.load.uncertain


def chain_model(scenario: Scenario, arm: ArmModel | None = None) -> ChainModel:
    """The constants of a scenario's chain. arm: the scenario's, when it is loaded already.

    Raises ScenarioError when the scenario has no arm, or when the controller sees objects that may stand elsewhere.
    """
    if scenario.arm is None:
        raise ScenarioError(f"The scenario {scenario.name} has no arm; give it a table [arm].")
    payload = scenario.payload
    load = load_change(payload)
    if scenario.physics.feedback == "object":
        for parameter in payload.uncertain.parameters:
            if parameter.places:
                raise ScenarioError(
                    f'{scenario.name}: physics.feedback = "object" and an uncertain {parameter.name} together have no '
                    'sensitivity here; use feedback = "joints".'
                )
    arm = load_arm(scenario.arm, scenario.tray) if arm is None else arm
    gains = Gains(scenario.control.kp, scenario.control.kd)
    settle = scenario.physics.settle_before
    return ChainModel(
        scenario,
        arm,
        with_load(arm, payload.bodies),
        payload.bodies,
        gains,
        load,
        contact_change(payload),
        contact_rows(payload),
        settle,
        0.5 * scenario.physics.command_period,
    )


@dataclass(frozen=True)
class Held:
    """How far commands that are held put the nominal motion off: q, torque (T, n), tray, w (T, 12) as in ArmChain.

    These are means over a period. swing: (T, 12) by which w is ahead of its mean when a command begins, and behind when
    it ends.
    """

    q: Array
    torque: Array
    tray: Array
    w: Array
    swing: Array


@dataclass(frozen=True, eq=False)
class ArmChain:
    """The chain along a motion at T instants, and what n_c terms change (last axis), per unit of each.

    The first n_p terms are the uncertain parameters, so `[..., :n_p]` are the derivatives; the others are products of
    two parameters (`salver.sensitivity.arm.load`), which `radius` adds. They hold what is of second order in the load,
    and what the wrong load makes of the deviation that it causes.

    t: (T,) s. space: where the controller closes its loop. nominal: poses, w, torque along the motion.
    joints: deviation of q, dq, ddq. tray: (T, 12, n_c) of the assumed frame E, rows dp in S, dtheta in E, dv in S,
    domega in E. torque: (T, n, n_c) commanded, N m. w: (T, 12, n_c) of what the tray feels at E, through its motion
    alone. wrench: (T, 6, n_c) contact wrench of the first object at its B, N and N m; direct_wrench: the part of it
    that the object needs on an unchanged motion, Y dphi.
    slack: (T, n_rows) of the contact rows, safe above 0, as a share of the normal force at rest. slack_p: (T, n_rows,
    n_p) its derivatives, without products.
    held: where the nominal motion itself is, off the plan.
    """

    t: Array
    space: Space
    model: ChainModel
    nominal: MotionTerms
    joints: JointDeviation
    tray: Array
    torque: Array
    w: Array
    wrench: Array
    direct_wrench: Array
    slack: Array
    slack_p: Array
    held: Held

    @property
    def uncertain(self) -> UncertainSet:
        return self.model.load.uncertain

    @property
    def joint_state(self) -> Array:
        """(T, 2 n, n_c): deviation of q, then of dq."""
        return np.concatenate([self.joints.q, self.joints.dq], axis=1)

    def radius(self, sensitivity: Array) -> Array:
        """Half-width (T, ...) of the tube of one of these quantities over the scenario's uncertain set: eq (11)."""
        if sensitivity.shape[-1] == self.uncertain.size:
            return tubes.radius(sensitivity, self.uncertain)
        return self.model.load.radius(sensitivity)

    def cone_sensitivity(self, grasp_map: Array) -> Array:
        """(T, n_lambda, n_c) of the first object's Lambda = pinv(grasp_map) wrench: what the paper calls Theta."""
        return np.asarray(np.linalg.pinv(grasp_map) @ self.wrench)

    def least_slack(self, tracking: bool = True, held: bool = True) -> Array:
        """(T,) least contact slack over all rows and the whole uncertain set; safe above 0.

        tracking: with the arm's tracking error; otherwise for a tray that moves as planned, which is what a plan
        checks with contact.condition = "exact". held: and with what commands that are held do to the nominal motion;
        without, it is what the fastest plan allows for.
        """
        load, rows = self.model.load, self.model.worst_rows
        w, drift = self.nominal.w, None
        if tracking:
            drift = Drift(load.terms, self.w * load.half_range, self.held.swing if held else None)
            w = w + self.held.w if held else w
        return -np.max([part.worst(w, drift).max(axis=1) for part in rows], axis=0)

    def summary(self) -> dict[str, Any]:
        """Figures for a report: largest tube radii along the motion, least contact slack with and without tracking."""
        tray, torque = self.radius(self.tray), self.radius(self.torque)
        limits = self.model.arm.limits.torque
        least, planned = self.least_slack(), self.least_slack(tracking=False)
        k = int(np.argmin(least))
        return {
            "space": self.space,
            "tray_position_radius": float(np.linalg.norm(tray[:, :3], axis=1).max()),
            "tray_rotation_radius": float(np.linalg.norm(tray[:, 3:6], axis=1).max()),
            "torque_radius": torque.max(axis=0).tolist(),
            "torque_share": float(((np.abs(self.nominal.torque + self.held.torque) + torque) / limits).max()),
            "contact_slack": float(least[k]),
            "contact_slack_time": float(self.t[k]),
            "contact_slack_planned": float(planned.min()),
        }


def arm_chain(model: ChainModel, joint: JointMotion, *, space: Space = "object", t: Array | None = None) -> ArmChain:
    """The chain's sensitivity along a joint motion.

    space: "object" for plans of the object's motion, "joint" for fastest plans, as `salver.simulation` runs them.
    t: (T,) evenly spaced instants from 0 to the duration; at most 12.5 ms apart unless given.
    """
    if t is None:
        t = np.linspace(0.0, joint.duration, max(81, int(np.ceil(joint.duration / _GRID_STEP)) + 1))
    terms = motion_terms(model.loaded.pin_model, model.loaded.tray_id, *joint.sample(t))
    load = model.load
    lost = missing_acceleration(terms.w, terms.jacobian, terms.mass_matrix, load)
    rate = np.gradient(terms.torque, t, axis=0, edge_order=2)[:, :, None]
    late = model.delay * np.linalg.solve(terms.mass_matrix, rate)
    settled = np.append(
        np.ones(len(load.half_range)), 0.0
    )  # a wrong load is there before the motion, a late command not
    whole, tray_whole = _response(model, t, terms, np.concatenate([lost, late], axis=2), space, settled)
    n_p = load.uncertain.size
    # The wrong load also feels the deviation that it makes: of second order, with the products.
    wrench = np.swapaxes(terms.jacobian, 1, 2) @ load.products(load.load_p, tray_whole.w)
    extra = np.asarray(np.linalg.solve(terms.mass_matrix, wrench), dtype=float)
    more, tray_more = _response(model, t, terms, extra, space, settled[n_p:-1])
    direct_wrench = np.einsum("pij,tj->tip", load.wrench_p, terms.w)
    direct_wrench[:, :, n_p:] += load.products(load.wrench_p, tray_whole.w)
    products = slice(n_p, -1)
    for first, second in ((whole, more), (tray_whole, tray_more)):
        for name, value in vars(second).items():
            getattr(first, name)[:, :, products] += value
    torque = terms.torque_z @ whole.state + terms.mass_matrix @ whole.missing
    joints = JointDeviation(*(x[:, :, :-1] for x in (whole.q, whole.dq, whole.ddq, whole.missing)))
    tray, w = tray_whole.state[:, :, :-1], tray_whole.w[:, :, :-1]
    swing = terms.w_z[:, :, -terms.torque.shape[1] :] @ late
    held = (whole.q, torque, tray_whole.state, tray_whole.w, swing)
    contact = model.contact
    direct_slack = -np.einsum("pri,ti->trp", contact.rows_p, terms.w)
    return ArmChain(
        t=t,
        space=space,
        model=model,
        nominal=terms,
        joints=joints,
        tray=tray,
        torque=torque[:, :, :-1],
        w=w,
        wrench=direct_wrench + load.wrench @ w,
        direct_wrench=direct_wrench,
        slack=-terms.w @ contact.rows.T,
        slack_p=direct_slack - contact.rows @ w[:, :, :n_p],
        held=Held(*(x[:, :, -1] for x in held)),
    )


def _response(
    model: ChainModel, t: Array, terms: MotionTerms, missing: Array, space: Space, settled: Array
) -> tuple[JointDeviation, TrayDeviation]:
    """Deviation of joints and tray when the acceleration `missing` (T, n, n_c) is missing, under either law."""
    gains, settle = model.gains, model.settle
    if space == "joint":
        joints = tracking_error(missing, node_filter(t, gains.kp[0], gains.kd[0], settle), settled)
        return joints, tray_of_joints(terms, joints)
    tray = tray_of_task(t, terms, missing, model.items[0], gains, settle, settled)
    return joints_of_task(t, terms, tray, missing, POSTURE_GAINS, settle, settled), tray
