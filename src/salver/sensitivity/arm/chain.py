"""First-order sensitivity of the chain: arm, computed torque with the nominal load, objects held by friction.

The paper closes its loop around a free object on which the controller's forces act directly: there a mass error causes
a tracking error first, to which the input reacts. An object on a tray moves with the tray and gets the force that it
needs at once; the error is in the arm's torque. With M the mass matrix of the arm and its nominal load,

    M (ddq_cmd - ddq) = J_E^T dF(t),        dF = (d load / dp) w(t)

to first order, for any law of ddq_cmd. `salver.sensitivity.arm.tracking` solves it for the loop on the joints (fastest
plans), `salver.sensitivity.arm.task` for the loop on the object's pose. The deviation of the joints determines those of
the tray, its motion regressor, the torque and the contact constraints.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from salver.control.object import Gains
from salver.display import Outlined
from salver.errors import ScenarioError
from salver.geometry import Array
from salver.models.arm.arm import ArmModel, load_arm, with_load
from salver.models.bodies import Body
from salver.models.contact_rows import ContactRows, contact_rows
from salver.models.uncertain.parameters import UncertainSet
from salver.sensitivity import tubes
from salver.sensitivity.arm.load import LoadChange
from salver.sensitivity.arm.task import task_law
from salver.sensitivity.arm.terms import motion_terms
from salver.sensitivity.arm.tracking import (
    Deviation,
    JointLoop,
    deviation,
    joint_loop,
    late,
)
from salver.wording import listed

if TYPE_CHECKING:
    from salver.scenario import Scenario
    from salver.trajectory import JointMotion

Space = Literal["object", "joint"]
_GRID_STEP = 0.0125  # s, largest distance of instants; the missing acceleration is cubic between them
_FINE_STEP = 0.005  # s, largest distance of instants for a motion with jerk jumps
_JOLT = 5e-4  # rad/s^2, least change of the hold's missing acceleration at a jerk jump; 5e-5 of the weight at 1 m
_JUST = 1e-3  # distance of the instant before a jerk jump, as a share of a step


@dataclass(frozen=True, eq=False)
class ChainModel:
    """The part of a scenario's chain that does not depend on the motion.

    arm, loaded: without and with the nominal objects. worst_rows: contact constraints over the uncertain set. loop: the
    control loop on the joints.
    """

    scenario: Scenario
    arm: ArmModel
    loaded: ArmModel
    items: tuple[Body, ...]
    gains: Gains
    loop: JointLoop
    worst_rows: tuple[ContactRows, ...]

    @property
    def load(self) -> LoadChange:
        return self.loop.load

    @property
    def uncertain(self) -> UncertainSet:
        return self.load.uncertain


def chain_model(scenario: Scenario, arm: ArmModel | None = None) -> ChainModel:
    """The chain model of a scenario. arm: the scenario's, if it is loaded already.

    Raises ScenarioError when the scenario has no arm, its URDF has no masses, or the controller measures the object and
    its position or the tray's tilt is uncertain.
    """
    if scenario.arm is None:
        raise ScenarioError(f"The scenario {scenario.name} has no arm; give it a table [arm].")
    payload = scenario.payload
    if scenario.physics.feedback == "object":
        for parameter in payload.uncertain.parameters:
            if parameter.places:
                raise ScenarioError(
                    f'{scenario.name}: physics.feedback = "object" and an uncertain {parameter.name} together have no '
                    'sensitivity here; use feedback = "joints".'
                )
    arm = load_arm(scenario.arm, scenario.tray) if arm is None else arm
    if arm.weightless:
        raise ScenarioError(
            f"{scenario.name}: the URDF gives {listed(arm.weightless)} no mass, so what a wrong load does to the arm "
            "is not known; give every link that a joint moves an <inertial> with a mass above 0."
        )
    gains = Gains(scenario.control.kp, scenario.control.kd)
    return ChainModel(
        scenario,
        arm,
        with_load(arm, payload.bodies),
        payload.bodies,
        gains,
        joint_loop(scenario, payload),
        contact_rows(payload),
    )


@dataclass(frozen=True, eq=False, repr=False, kw_only=True)
class ArmChain(Outlined, Deviation):
    """Sensitivity of the chain along a motion at T instants, per unit of each of n_c terms (last axis).

    These are the deviation of the arm and the contact wrench of the first object.

    The first n_p terms are the uncertain parameters, so that `[..., :n_p]` are the derivatives; the others are products
    of two parameters (`salver.sensitivity.arm.load`), for second-order effects of the load and of the deviation that it
    causes; `radius` adds them.

    t: (T,) s. space: "object" or "joint", where the loop is closed. wrench: (T, 6, n_c) at B of the first object, N and
    N m.
    """

    t: Array
    space: Space
    model: ChainModel
    wrench: Array

    @property
    def uncertain(self) -> UncertainSet:
        return self.model.load.uncertain

    def radius(self, sensitivity: Array) -> Array:
        """Half-width (T, ...) of the tube of one of these quantities over the scenario's uncertain set: eq (11)."""
        if sensitivity.shape[-1] == self.uncertain.size:
            return tubes.radius(sensitivity, self.uncertain)
        return self.model.load.radius(sensitivity)

    def least_slack(self, tracking: bool = True, held: bool = True) -> Array:
        """Least contact slack (T,) over all constraints and the whole uncertain set; safe above 0.

        tracking: include the arm's tracking error; otherwise the tray moves as planned, as a plan with
        contact.condition = "exact" assumes. held: include the zero-order hold.
        """
        w, drift = self.felt(held) if tracking else (self.terms.w, None)
        return -np.max([part.worst(w, drift).max(axis=1) for part in self.model.worst_rows], axis=0)

    def summary(self) -> dict[str, Any]:
        """Figures for a report: largest tube radii, least contact slack with and without tracking; without the slack
        for liquids and pendulums, which the chain does not model."""
        tray, torque = self.radius(self.tray.state), self.radius(self.torque)
        limits = self.model.arm.limits.torque
        found = {
            "space": self.space,
            "tray_position_radius": float(np.linalg.norm(tray[:, :3], axis=1).max()),
            "tray_rotation_radius": float(np.linalg.norm(tray[:, 3:6], axis=1).max()),
            "torque_radius": torque.max(axis=0).tolist(),
            "torque_share": float(((np.abs(self.terms.torque + self.held.torque) + torque) / limits).max()),
        }
        if self.model.scenario.payload.dynamic:
            return found
        least, planned = self.least_slack(), self.least_slack(tracking=False)
        k = int(np.argmin(least))
        return found | {
            "contact_slack": float(least[k]),
            "contact_slack_time": float(self.t[k]),
            "contact_slack_planned": float(planned.min()),
        }


def arm_chain(model: ChainModel, joint: JointMotion, *, space: Space = "object", t: Array | None = None) -> ArmChain:
    """The chain's sensitivity along a joint motion.

    space: "object" for plans of the object's motion, "joint" for fastest plans, as `salver.simulation` runs them.
    t: (T,) evenly spaced instants from 0 to the duration; default: at most 12.5 ms apart, and in joint space also at
    and just before jerk jumps, which live motions have at every change.
    """
    jumps: Array = np.zeros(0)
    if t is None:
        if space == "joint":
            jumps = _jumps(joint, model.loop.delay)
        t = _instants(joint.duration, jumps)
    states = joint.sample(t)
    terms = motion_terms(model.loaded.pin_model, model.loaded.tray_id, *states)
    rates = np.stack([*states[1:], joint.jerk(t)])
    if space == "joint":
        before = None
        if len(jumps):
            before = rates[2].copy()
            before[np.searchsorted(t, jumps)] = joint.jerk_before[np.searchsorted(joint.t, jumps)]
        found = model.loop.along(t, terms, rates, before=before)
    else:
        law = task_law(t, terms, model.items[0], model.gains, model.loop.settle)
        found = deviation(model.load, terms, late(terms, rates, model.loop.delay), law)
    load = model.load
    wrench = np.einsum("pij,tj->tip", load.wrench_p, terms.w)  # at once, on an unchanged motion: Y dphi
    wrench[:, :, load.uncertain.size :] += load.products(load.wrench_p, found.tray.w)
    return ArmChain(**vars(found), t=t, space=space, model=model, wrench=wrench + load.wrench @ found.tray.w)


def _jumps(joint: JointMotion, delay: float) -> Array:
    """Instants of jerk jumps that change the effect of the hold delay, s."""
    jump = np.abs(joint.jerk(joint.t) - joint.jerk_before).max(axis=1)
    return joint.t[1:-1][delay * jump[1:-1] > _JOLT]


def _instants(duration: float, jumps: Array) -> Array:
    """Instants (T,), s, evenly spaced between jerk jumps, with an instant at and just before each jump."""
    ends = np.concatenate([[0.0], jumps, [duration]])
    step = min(_FINE_STEP if len(jumps) else _GRID_STEP, duration / 80)
    counts = np.ceil(np.diff(ends) / step - 1e-9).astype(int)
    pieces = [np.linspace(a, b, count + 1) for a, b, count in zip(ends, ends[1:], counts, strict=False)]
    for piece in pieces[:-1]:
        piece[-1] -= _JUST * (piece[-1] - piece[-2])
    return np.concatenate(pieces)
