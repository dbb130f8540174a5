"""The contact conditions (eq 16) of an object that moves by itself, as constraints of the optimiser.

"paper": Lambda = pinv(G F-hat) wrench >= 0 with the tube of the closed loop's input sensitivity (eqs 11, 12), in N:
`CoefficientConstraint`. It requires one particular distribution of the contact forces, so it is sufficient.
Uncertainties that the paper does not treat count too: the least friction, the contact area common to all placements,
and, to first order, placement and tilt, as for an object that follows its tray.
"exact": the wrench that the motion needs lies in the contact wrench cone of every interface, in the worst case over the
uncertain set: the constraints of `planning.trajopt`, along a tray that no arm carries (`tray_evaluation`).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from salver.dynamics.load_cases import VERDICT_APART, load_cases
from salver.dynamics.load_response import slacks
from salver.dynamics.modal_history import CaseGroups
from salver.errors import ScenarioError
from salver.geometry import Array, Indices, invert
from salver.models.bodies import TRAY, Body
from salver.models.contact_rows import contact_rows
from salver.models.interfaces import sure_contacts
from salver.models.payload import Payload
from salver.models.tray_motion import FULL_SPEED, at_rest, corners
from salver.models.uncertain.parameters import UncertainSet
from salver.planning.trajopt.constraints.constraints import (
    Block,
    Constraint,
    ContactConstraint,
    TiltConstraint,
    evaluate,
    padded,
)
from salver.planning.trajopt.constraints.load_limits import LoadConstraint
from salver.planning.trajopt.evaluation import Known, MotionEvaluation
from salver.scenario import Scenario
from salver.sensitivity.arm.load import wrench_of
from salver.sensitivity.arm.terms import MotionTerms
from salver.sensitivity.dual import Dual
from salver.sensitivity.tray import BodyMotion, TraySensitivity
from salver.sensitivity.tubes import radius

UNITS = {"paper": "N", "exact": "of the weight"}
TILT = "tilt limit"


def constraints_of(scenario: Scenario) -> tuple[Constraint, ...]:
    """The contact conditions of all objects of a scenario, and its limit on tilt.

    Raises:
        ScenarioError: contact.condition = "paper" with load dynamics, objects on each other or a shaking tray.
    """
    payload, largest = scenario.payload, scenario.motion.max_tilt_deg
    payload.check_places()
    tilt = () if largest is None else (TiltConstraint(float(np.deg2rad(largest))),)
    if scenario.contact.condition == "paper":
        _check_known_to_paper(scenario)
        return (*(CoefficientConstraint.of(payload, body) for body in payload.bodies), *tilt)
    # Load dynamics at other speed factors are checked along whole motions, not by rows of instants.
    speeds = (FULL_SPEED,) if payload.dynamic else corners(scenario.motion.speeds, scenario.motion.speed_rate)
    contacts = (ContactConstraint(rows, speed=speed) for rows in contact_rows(payload) for speed in speeds)
    return (*contacts, *(LoadConstraint(body) for body in payload.dynamic), *tilt)


def unit_of(scenario: Scenario, owner: str) -> str:
    """Unit of the slack of a row with this owner."""
    if of_load(owner):
        return "of the room"
    return "rad" if owner == TILT else UNITS[scenario.contact.condition]


def of_load(owner: str) -> bool:
    """Whether the owner of a row is a load's inner dynamics ("liquid in cup"); names of bodies have no spaces."""
    return " in " in owner


def apart(owner: str) -> bool:
    """Whether a row is no contact condition and so has another unit."""
    return owner == TILT or of_load(owner)


def size_of(constraint: Constraint | None) -> float:
    """Slack, in the unit of `unit_of`, of a row of a constraint with the value -1; near the limit on tilt it is the
    angle that is left."""
    if isinstance(constraint, TiltConstraint):
        return float(np.tan(0.5 * constraint.largest))
    return constraint.size if isinstance(constraint, CoefficientConstraint) else 1.0


def slack_along(constraints: Sequence[Constraint], motion: MotionEvaluation) -> tuple[Array, tuple[str, ...]]:
    """Slacks (T, n) of all rows along a motion, in the unit of `unit_of`, and the owner (n,) of each. Of a load's inner
    dynamics it is the least share left of all its limits, at the last instant also of limits after the motion."""
    slack, owner = list[Array](), list[str]()
    for constraint in constraints:
        if isinstance(constraint, LoadConstraint):
            (part,) = motion.loads[constraint.body.name]
            slack.append(slacks(part).min(axis=0)[:, None])
            owner.append(constraint.body.inside.removeprefix("the "))
            continue
        (block,) = evaluate((constraint,), motion, margins=False)
        slack.append(-size_of(constraint) * block.values)
        if isinstance(constraint, ContactConstraint):
            interfaces = constraint.rows.network.interfaces
            owner += [interfaces[int(e)].name + constraint.speed.words for e in constraint.rows.interface]
        else:
            tilt = isinstance(constraint, TiltConstraint)
            owner += [TILT if tilt else block.name] * block.values.shape[1]
    return np.concatenate(slack, axis=1), tuple(owner)


# A tray that no arm carries ----------------------------------------------------------------------------------

ClosedLoop = Callable[[bool], TraySensitivity]


@dataclass(frozen=True, eq=False)
class TrayEvaluation(MotionEvaluation):
    """Evaluation of a tray that no arm carries. closed_loop: returns the sensitivity of the first object's closed loop,
    with derivatives by the variables or without."""

    closed_loop: ClosedLoop | None = None


def cases_of(payload: Payload) -> CaseGroups:
    """All cases of the load dynamics of a payload."""
    return tuple(load_cases(body, payload.uncertain, VERDICT_APART) for body in payload.dynamic)


def tray_evaluation(
    payload: Payload, t: Array, motion: BodyMotion, cases: CaseGroups, closed_loop: ClosedLoop
) -> TrayEvaluation:
    """The tray's motion at t (T,), s, under the first object, which moves as given."""
    v, omega, a, alpha = (_spread(part.value, len(t)) for part in tray_parts(payload, motion))
    rotation = motion.rotation.matrix[:, 0] @ payload.first.R_EB.T
    terms = MotionTerms.of_tray(_spread(rotation[:, None], len(t)), np.hstack([v, omega]), np.hstack([a, alpha]))
    z = np.stack([terms.q, terms.dq, terms.ddq, terms.q])
    grid = t / t[-1], float(t[-1]), z, np.arange(len(t))
    known = Known(terms=terms)
    return TrayEvaluation(None, 0, None, *grid, True, False, cases, known=known, closed_loop=closed_loop)


def tray_parts(payload: Payload, motion: BodyMotion) -> tuple[Dual, ...]:
    """Velocity, angular velocity, and the linear and angular part of the spatial acceleration of the tray's E, in E."""
    tray = motion.of_frame(*invert(payload.first.p_EB, payload.first.R_EB))
    return tray.velocity, tray.omega, tray.force - tray.weight - tray.omega.cross(tray.velocity), tray.alpha


def _spread(x: Array, count: int) -> Array:
    """(T, ...) from (T, 1, ...), or from one instant (1, 1, ...) of a motion without rotation."""
    return np.broadcast_to(x[:, 0], (count, *x.shape[2:]))


# The paper's condition ---------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class CoefficientConstraint(Constraint):
    """Lambda = distribution @ wrench of one body, minus the tube (eq 12), at least 0.

    distribution: (n, 6). wrench: (6, 12), from the motion regressor w to the body's wrench; by_parameter: (n_p, 6, 12),
    its derivatives. looped: whether the closed loop's response to the parameters is added, as for the first object.
    size: mean coefficient at rest, N, of which rows are shares.
    """

    body: Body
    distribution: Array
    wrench: Array
    by_parameter: Array
    uncertain: UncertainSet
    looped: bool
    size: float

    @classmethod
    def of(cls, payload: Payload, body: Body) -> CoefficientConstraint:
        """With the closed loop's tube for the first body, and that of a body fixed to its tray for others."""
        uncertain, looped = payload.uncertain, body is payload.first
        (network,) = (one for one in payload.networks if one.bodies[0] is body)  # nothing else touches it
        contacts = sure_contacts(network, payload.tray_half, uncertain)[0].base
        distribution: Array = np.linalg.pinv(contacts.grasp_map).astype(float)
        wrench, by_parameter = wrench_of(body, uncertain)
        if looped:  # its inertial parameters act through the closed loop
            by_parameter = by_parameter * np.array([p.places for p in uncertain.parameters])[:, None, None]
        size = float(np.abs(distribution @ wrench @ at_rest()).mean())
        return cls(body, distribution, wrench, by_parameter, uncertain, looped, size)

    def blocks(self, motion: MotionEvaluation) -> Iterator[Block]:
        assert isinstance(motion, TrayEvaluation)
        w = motion.terms.w
        loop = motion.closed_loop if self.looped else None
        spread = np.einsum("pik,tk->tip", self.by_parameter, w)
        if loop is not None:
            spread = spread + loop(False).wrench
        terms = self.distribution @ spread
        values = (radius(terms, self.uncertain) - w @ (self.distribution @ self.wrench).T) / self.size

        def by_wrench(i: Indices, f: Indices) -> Array:
            """Derivative (r, n_p, 6) of the radius by the wrench's sensitivity to each parameter."""
            each, box = terms[i, f] @ self.uncertain.factor, self.uncertain.kind == "box"
            size = np.maximum(np.linalg.norm(each, axis=-1, keepdims=True), 1e-300)
            worst = (np.sign(each) if box else each / size) @ self.uncertain.factor.T
            return np.asarray(worst[:, :, None] * self.distribution[f][:, None])

        def gradient(i: Indices, f: Indices) -> Array:
            by_w = np.tensordot(by_wrench(i, f), self.by_parameter) - self.distribution[f] @ self.wrench
            return padded((by_w[:, None] @ motion.terms.w_z[i])[:, 0] / self.size, motion.n)

        def tube(i: Indices, f: Indices) -> Array:
            found = np.zeros((len(i), 1))
            for part, begin in () if loop is None else ((loop(True).df, 0), (loop(True).dtau, 3)):
                if part.tangent is not None:
                    weight = by_wrench(i, f)[:, :, begin : begin + 3].reshape(len(i), 1, -1)
                    found = found + (weight @ part.tangent[i].reshape(len(i), weight.shape[2], -1))[:, 0]
            return found / self.size

        yield Block(self.body.name, values, gradient, motion.nodes, whole=tube)


def _check_known_to_paper(scenario: Scenario) -> None:
    payload, unsupported = scenario.payload, f'{scenario.name}: contact.condition = "paper" does not support'
    if payload.uncertain.shake is not None:
        raise ScenarioError(f'{unsupported} a shaking tray (uncertainty.shake); use "exact".')
    if payload.dynamic:
        raise ScenarioError(f'{unsupported} {payload.dynamic[0].inside}; use "exact".')
    for body in payload.bodies:
        if body.on != (TRAY,):
            below = " and ".join(body.on)
            raise ScenarioError(f'{unsupported} objects on each other ({body.name} stands on {below}); use "exact".')
