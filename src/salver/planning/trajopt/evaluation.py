"""A joint motion at the points of a grid, and the quantities along it that constraints and objectives read."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import Any

import numpy as np

from salver.dynamics.load_response import LoadResponse
from salver.dynamics.load_rows import given_way
from salver.dynamics.modal_history import CaseGroups, Past
from salver.geometry import Array, Indices
from salver.models.uncertain.worst_case import Drift
from salver.sensitivity.arm.compliance import LoadResponses
from salver.sensitivity.arm.terms import MotionTerms, motion_terms
from salver.sensitivity.arm.tracking import Deviation, JointLoop

# Instants of the rest after a motion that a programme, and a check, looks at: the peak of a swing between two is missed
# by 2 %, which is within what its nodes keep, and by 0.3 %.
RESTS = 16, 40
EASING = 0.25  # of a motion that begins moving: over this share of it margins grow from nothing


@dataclass(frozen=True, eq=False)
class Known:
    """Parts of an evaluation that are known already, or taken from a similar motion; None is computed.

    See `MotionEvaluation` for what they are. like: the motion to which the arm and its loads give way in the same way.
    """

    terms: MotionTerms | None = None
    response: Deviation | None = None
    sag: Drift | None = None
    loads: LoadResponses | None = None
    like: MotionEvaluation | None = None


NOTHING = Known()


@dataclass(frozen=True, eq=False)
class MotionEvaluation:
    """A motion at points s (P,) in [0, 1] of its duration (s): z (4, P, n) is q and its three time derivatives there.

    model: Pinocchio's, with all objects bolted on at nominal parameters; frame_id: of the tray in it. tracking: what a
    parameter error does to the arm, or None. nodes: (N,) indices of the points at which dynamics and distances are
    checked; the joints' own motion costs little and is checked at all points. imposed: whether the rows are conditions
    of a programme; otherwise they are checked between its nodes. moving: whether it begins moving. cases: of what
    moves inside each load; past: what they come from, if not from rest. coarsely: whether of rows that are far from
    their edge a bound is enough. resting: s, how long the rest after it is looked at. known: quantities that need not
    be computed.

    All further quantities are computed when they are first read, and once.
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
    coarsely: bool = False
    resting: float = 0.0
    known: Known = NOTHING

    def __post_init__(self) -> None:
        if self.known.terms is not None and not np.array_equal(self.known.terms.q, self.z[0, self.nodes]):
            raise ValueError("the terms that are known are another motion's")

    @property
    def n(self) -> int:
        """Number of joints."""
        return self.z.shape[2]

    @cached_property
    def at_nodes(self) -> Array:
        """(4, N, n) q and its time derivatives at the nodes."""
        return self.z[:, self.nodes]

    @cached_property
    def shares(self) -> Array:
        """(N,) of the motion's time, at which the nodes are."""
        return self.s[self.nodes]

    @cached_property
    def terms(self) -> MotionTerms:
        """The tray's motion regressor and the joints' torque at the nodes; derivatives when they are read."""
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
        """w (N, 12) at the nodes, at a speed factor that changes by a rate, 1/s, and how a parameter error and the
        zero-order hold change it; nothing, where the arm follows exactly."""
        if not factor:
            return self.terms.w_at(0.0, rate), None if exactly else self.sag
        at = self.at_factor(factor)
        w, drift = (at.terms.w, None) if exactly or at.response is None else at.response.felt()
        if rate:
            w = w.copy()
            w[:, :6] += rate * self.terms.twist
        return w, drift

    def at_factor(self, factor: float) -> MotionEvaluation:
        """This motion at a speed factor above 0."""
        if factor == 1.0:
            return self
        known: dict[float, MotionEvaluation] = self._at_factors
        if factor not in known:
            powers = factor ** np.arange(4.0)[:, None, None]
            z = self.z * powers
            known[factor] = replace(self, z=z, duration=self.duration / factor, known=NOTHING)
        return known[factor]

    @cached_property
    def _at_factors(self) -> dict[float, MotionEvaluation]:
        return {}

    @cached_property
    def sag(self) -> Drift | None:
        """The arm's response to parameter errors at rest in the postures of the nodes."""
        if self.tracking is None or self.known.sag is not None:
            return self.known.sag
        return self.tracking.sag(self.terms)

    def knowing(self, **known: Any) -> MotionEvaluation:
        """This motion, with some of the fields of `Known`."""
        return replace(self, known=replace(self.known, **known))

    def straying_as(self, other: MotionEvaluation) -> MotionEvaluation:
        """This motion, with an arm that strays from it as from a motion like it, at the same instants."""
        like = other.response
        if like is None:
            return self
        return self.knowing(terms=self.terms, response=like.along(self.terms), sag=other.sag)

    def giving_way_as(self, other: MotionEvaluation) -> MotionEvaluation:
        """This motion, with an arm that gives way to its load and to what moves in it as along a motion like it, at the
        same shares of its time."""
        straying = self.straying_as(other)
        loads = other.load_responses.along(self.shares * self.duration, straying.terms.w)
        return straying.knowing(loads=loads, like=other)

    @cached_property
    def rest(self) -> MotionEvaluation:
        """The rest after its end, from the deviation and the modal states that there are then."""
        count = RESTS[0 if self.imposed else 1]
        z = np.zeros((4, count, self.n))
        z[0] = self.z[0, -1]
        s, nodes, like = np.linspace(0.0, 1.0, count), np.arange(count), self.known.like
        basic = self.model, self.frame_id, self.tracking, s, self.resting, z, nodes, self.imposed, False, self.cases
        terms = MotionTerms.deriving(self.model, self.frame_id, z[:3], s, nodes[[0, -1]])  # at all of them the same
        if like is not None:
            still = MotionEvaluation(*basic, like.rest.past, self.coarsely).knowing(terms=terms).straying_as(like.rest)
            loads = like.rest.load_responses.along(self.resting * s, terms.w, self.load_responses)
            return still.knowing(loads=loads)
        t, tracking = self.shares * self.duration, self.tracking
        if tracking is not None and self.response is not None:
            tracking = tracking.begun(self.response.state_at(t, t[-1]))
        still = MotionEvaluation(*basic, replace(self.left, now=t[-1]), self.coarsely)
        return replace(still, tracking=tracking).knowing(terms=terms)

    @cached_property
    def loads(self) -> dict[str, tuple[LoadResponse, ...]]:
        """What moves inside each body, by the body's name: its cases."""
        return self.load_responses.each

    @cached_property
    def load_responses(self) -> LoadResponses:
        """What moves inside its loads, all cases."""
        return self.known.loads or LoadResponses.of(
            self.cases, self.shares * self.duration, self.terms.w, self.response, self.past
        )

    @property
    def left(self) -> Past:
        """The modal states along it, for a motion that goes on from it: at instants of its own time, s."""
        return self.load_responses.past(self.shares * self.duration)

    def rested(self, seconds: float) -> Past:
        """The evaluation after so many seconds at rest at the end."""
        return self.load_responses.rested(seconds + np.array([0.0, self.steps[-1]]))

    def joint_radius(self, order: int) -> Array:
        """(N, n) most by which the joints' position (order 0) or velocity (1) can differ from the plan's at the nodes:
        for a parameter error, the zero-order hold and what loads push."""
        assert self.response is not None
        name = ("q", "dq")[order]
        return self._wider(self.response.joint_radius(order), lambda reaction: getattr(reaction.joints, name))

    def torque_radius(self) -> Array:
        """(N, n) the same for the commanded torque, N m."""
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
        """A radius (N, m), and what loads add to it."""
        return np.asarray(radius + given_way(self.loads, what)) if self.cases else radius

    @cached_property
    def steps(self) -> Array:
        """(N - 1,) s from node to node."""
        return np.asarray((self.shares[1:] - self.shares[:-1]) * self.duration)

    def between_nodes(self, values: Array) -> Array:
        """(P, m) at all points, linear between the nodes, of values (N, m) there."""
        if len(self.nodes) == len(self.s):
            return values
        before, share = _between(self.s.tobytes(), self.nodes.tobytes())
        at = values[before]
        return np.asarray(at + share * (values[before + 1] - at))

    def eased(self, points: Indices) -> Array:
        """(N,) share of a margin that is asked for at points: all, but less soon after a moving start."""
        if not self.moving:
            return np.ones(len(points))
        return np.minimum(self.s[points] / EASING, 1.0)


@lru_cache(maxsize=16)
def _between(points: bytes, nodes: bytes) -> tuple[Indices, Array]:
    """(P,) the node before each point, and (P, 1) its share of the way to the next one; of points (P,) and the indices
    of those that are nodes."""
    s = np.frombuffer(points)
    at = s[np.frombuffer(nodes, dtype=np.intp)]
    before = np.clip(np.searchsorted(at, s, side="right") - 1, 0, len(at) - 2)
    return before, ((s - at[before]) / (at[before + 1] - at[before]))[:, None]
