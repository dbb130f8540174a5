"""Evaluation of a joint motion at the points of a grid: the quantities that constraints and objectives need.

    w(q, dq, ddq), tau(q, dq, ddq)                      the tray's motion regressor, joint torques (`terms`)
    e'' + kd e' + kp e = M^-1 J^T dF(p),   dF = (d load / dp) w      the arm's deviation e (`response`)
    x'' + 2 zeta omega x' + (omega^2 + ...) x = drive(w + dw)         modal states x of load dynamics (`loads`)

dw is the change of w by e and by the reaction of x on the arm. At a speed factor s that changes at a rate r, with w_0 =
(-g in E, 0) at rest, w becomes w_0 + s^2 (w - w_0) + r (twist, 0) (`felt`).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import Any, Self

import numpy as np

from salver.dynamics.load_response import LoadResponse
from salver.dynamics.load_rows import given_way
from salver.dynamics.modal_history import CaseGroups, Past
from salver.geometry import Array, Indices
from salver.models.uncertain.worst_case import Drift
from salver.sensitivity.arm.compliance import LoadResponses
from salver.sensitivity.arm.terms import MotionTerms, motion_terms
from salver.sensitivity.arm.tracking import Deviation, JointLoop

# Instants of the rest after a motion, in a programme and in a check. Peaks of a swing between them are up to 2 % higher
# (less than the margin at the nodes), and 0.3 %.
RESTS = 16, 40
EASING = 0.25  # share of a motion with a moving start over which margins grow from zero


@dataclass(frozen=True, eq=False)
class Known:
    """Quantities of `MotionEvaluation` that are known already, or taken from a similar motion; None: to be computed.

    like: the motion whose response of arm and load dynamics is used.
    """

    terms: MotionTerms | None = None
    response: Deviation | None = None
    sag: Drift | None = None
    loads: LoadResponses | None = None
    like: MotionEvaluation | None = None


NOTHING = Known()


@dataclass(frozen=True, eq=False)
class MotionEvaluation:
    """A motion at points s (P,) in [0, 1] of its duration (s), with z (4, P, n): q, dq, ddq, dddq there. Derived
    quantities are computed when they are first read.

    model: Pinocchio model with all objects fixed to the tray at nominal parameters; frame_id: of the tray in it.
    tracking: closed loop that determines the tracking error under parameter errors, or None. nodes: (N,) indices of the
    points at which dynamics and distances are evaluated; limits of the joints' own motion are cheap and evaluated at
    all points. imposed: whether the rows are constraints of a programme; else they are checked between its nodes.
    moving: whether the motion begins moving. cases: of each load's dynamics; past: their initial states, if not at
    rest. resting: duration of the rest after the
    motion that is evaluated, s. compliant: whether load dynamics move the arm; to first order, as here, that grows with
    the periods that a slow motion lasts and not with the arm's response, so at other speeds it is left out. known:
    quantities that need not be computed.
    """

    model: Any
    frame_id: int
    tracking: JointLoop | None
    s: Array
    duration: float
    z: Array
    nodes: Indices
    imposed: bool
    moving: bool
    cases: CaseGroups = ()
    past: Past | None = None
    resting: float = 0.0
    compliant: bool = True
    known: Known = NOTHING

    def __post_init__(self) -> None:
        if self.known.terms is not None and not np.array_equal(self.known.terms.q, self.z[0, self.nodes]):
            raise ValueError("the known terms belong to another motion")

    @property
    def n(self) -> int:
        """Number of joints."""
        return self.z.shape[2]

    @cached_property
    def at_nodes(self) -> Array:
        """q, dq, ddq, dddq at the nodes, (4, N, n)."""
        return self.z[:, self.nodes]

    @cached_property
    def shares(self) -> Array:
        """Instants (N,) of the nodes as shares of the duration."""
        return self.s[self.nodes]

    @cached_property
    def terms(self) -> MotionTerms:
        """The tray's motion regressor and the joint torques at the nodes, with derivatives on demand."""
        if self.known.terms is not None:
            return self.known.terms
        q, dq, ddq = self.at_nodes[:3]
        return motion_terms(self.model, self.frame_id, q, dq, ddq, deriving=self.tracking is not None)

    @cached_property
    def response(self) -> Deviation | None:
        """The arm's response to parameter errors and to the zero-order hold at the nodes."""
        if self.tracking is None or self.known.response is not None:
            return self.known.response
        shares = self.shares
        return self.tracking.along(shares * self.duration, self.terms, self.at_nodes[1:], shares=shares)

    def felt(self, factor: float = 1.0, rate: float = 0.0, exactly: bool = False) -> tuple[Array, Drift | None]:
        """The motion regressor w (N, 12) at the nodes, at a speed factor that changes at a rate, 1/s; and its change by
        parameter errors and the zero-order hold, None for an arm that follows exactly."""
        if not factor:
            return self.terms.w_at(0.0, rate), None if exactly else self.sag
        at = self.at_factor(factor)
        w, drift = (at.terms.w, None) if exactly or at.response is None else at.response.felt()
        if rate:
            w = w.copy()
            w[:, :6] += rate * self.terms.twist
        return w, drift

    def at_factor(self, factor: float) -> MotionEvaluation:
        """The evaluation at a speed factor above 0."""
        if factor == 1.0:
            return self
        known: dict[float, MotionEvaluation] = self._at_factors
        if factor not in known:
            known[factor] = self._slowed(factor)
        return known[factor]

    def _slowed(self, factor: float) -> Self:
        z = self.z * factor ** np.arange(4.0)[:, None, None]
        return replace(self, z=z, duration=self.duration / factor, compliant=False, known=NOTHING)

    @cached_property
    def _at_factors(self) -> dict[float, MotionEvaluation]:
        return {}

    @cached_property
    def sag(self) -> Drift | None:
        """The arm's static response to parameter errors in the postures of the nodes."""
        if self.tracking is None or self.known.sag is not None:
            return self.known.sag
        return self.tracking.sag(self.terms)

    def knowing(self, **known: Any) -> MotionEvaluation:
        """A copy with some fields of `Known` set."""
        return replace(self, known=replace(self.known, **known))

    def straying_as(self, other: MotionEvaluation) -> MotionEvaluation:
        """A copy with the tracking error of a similar motion at the same instants."""
        like = other.response
        if like is None:
            return self
        return self.knowing(terms=self.terms, response=like.along(self.terms), sag=other.sag)

    def giving_way_as(self, other: MotionEvaluation) -> MotionEvaluation:
        """A copy with the response of the arm, and of the load dynamics, of a similar motion at the same shares of the
        duration."""
        straying = self.straying_as(other)
        loads = other.load_responses.along(self.shares * self.duration, straying.terms.w)
        return straying.knowing(loads=loads, like=other)

    @cached_property
    def rest(self) -> MotionEvaluation:
        """Evaluation of the rest after the end, from the final deviation and modal states."""
        count = RESTS[0 if self.imposed else 1]
        z = np.zeros((4, count, self.n))
        z[0] = self.z[0, -1]
        s, nodes, like = np.linspace(0.0, 1.0, count), np.arange(count), self.known.like
        basic = self.model, self.frame_id, self.tracking, s, self.resting, z, nodes, self.imposed, False, self.cases
        terms = MotionTerms.deriving(self.model, self.frame_id, z[:3], s, nodes[[0, -1]])  # at all of them the same
        if like is not None:
            still = MotionEvaluation(*basic, like.rest.past).knowing(terms=terms).straying_as(like.rest)
            loads = like.rest.load_responses.along(self.resting * s, terms.w, self.load_responses)
            return still.knowing(loads=loads)
        t, tracking = self.shares * self.duration, self.tracking
        if tracking is not None and self.response is not None:
            tracking = tracking.begun(self.response.state_at(t, t[-1]))
        still = MotionEvaluation(*basic, replace(self.left, now=t[-1]))
        return replace(still, tracking=tracking, compliant=self.compliant).knowing(terms=terms)

    @cached_property
    def loads(self) -> dict[str, tuple[LoadResponse, ...]]:
        """Responses of the load dynamics by body name, one for each case."""
        return self.load_responses.each

    @cached_property
    def load_responses(self) -> LoadResponses:
        """Responses of all load dynamics, in all cases."""
        response = self.response if self.compliant else None
        return self.known.loads or LoadResponses.of(
            self.cases, self.shares * self.duration, self.terms.w, response, self.past
        )

    @property
    def left(self) -> Past:
        """Modal states along the motion, at instants of its own time, s, from which another motion can go on."""
        return self.load_responses.past(self.shares * self.duration)

    def rested(self, seconds: float) -> Past:
        """The modal states after a number of seconds at rest at the end."""
        return self.load_responses.rested(seconds + np.array([0.0, self.steps[-1]]))

    def joint_radius(self, order: int) -> Array:
        """Largest deviation (N, n) of the joints' position (order 0) or velocity (order 1) from the plan at the nodes,
        by parameter errors, the zero-order hold and load dynamics."""
        assert self.response is not None
        name = ("q", "dq")[order]
        return self._wider(self.response.joint_radius(order), lambda reaction: getattr(reaction.joints, name))

    def torque_radius(self) -> Array:
        """Largest deviation (N, n) of the commanded torque, N m, as `joint_radius`."""
        assert self.response is not None
        return self._wider(self.response.torque_radius(), lambda reaction: reaction.torque)

    def tray_radius(self) -> tuple[Array, Array]:
        """Largest deviation of the tray's position (N, 3) in S, m, and orientation (N, 3) in E, rad, as
        `joint_radius`."""
        assert self.response is not None
        position, turn = self.response.tray_radius()
        moved = self._wider(position, lambda reaction: reaction.tray.state[:, :3])
        return moved, self._wider(turn, lambda reaction: reaction.tray.state[:, 3:6])

    def _wider(self, radius: Array, what: Callable[[Any], Array]) -> Array:
        """A radius (N, m) plus the contribution of load dynamics."""
        return np.asarray(radius + given_way(self.loads, what)) if self.cases else radius

    @cached_property
    def steps(self) -> Array:
        """Time steps (N - 1,) between nodes, s."""
        return np.asarray((self.shares[1:] - self.shares[:-1]) * self.duration)

    def between_nodes(self, values: Array) -> Array:
        """Values (P, m) at all points, interpolated linearly between those at the nodes (N, m)."""
        if len(self.nodes) == len(self.s):
            return values
        before, share = _between(self.s.tobytes(), self.nodes.tobytes())
        at = values[before]
        return np.asarray(at + share * (values[before + 1] - at))

    def eased(self, points: Indices) -> Array:
        """Share of a margin that is required at points: 1, but less just after a moving start."""
        if not self.moving:
            return np.ones(len(points))
        return np.minimum(self.s[points] / EASING, 1.0)


@lru_cache(maxsize=16)
def _between(points: bytes, nodes: bytes) -> tuple[Indices, Array]:
    """For points (P,) and the indices of nodes among them: the node before each point (P,), and the point's position
    (P, 1) between it and the next node, from 0 to 1."""
    s = np.frombuffer(points)
    at = s[np.frombuffer(nodes, dtype=np.intp)]
    before = np.clip(np.searchsorted(at, s, side="right") - 1, 0, len(at) - 2)
    return before, ((s - at[before]) / (at[before + 1] - at[before]))[:, None]
