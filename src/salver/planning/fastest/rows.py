"""All conditions on a joint motion, as families of rows g <= 0 sampled at nodes, with derivatives.

Each family has values (N, m) and gives, for the rows that are asked for, derivatives with respect to
z = (q, dq, ddq, dddq), 4n numbers at the row's node. Rows are scaled so that 0 is the edge and 1 the size of the
quantity: the limit itself, the weight of what stands there.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from salver.geometry import Array
from salver.models.arm_limits import LIMITS
from salver.planning.fastest.contact import WorstCase, worst_case
from salver.planning.fastest.obstacles import KeepOut
from salver.planning.fastest.problem import LEVEL_TOLERANCE, TransportProblem
from salver.planning.fastest.tracking import Response
from salver.sensitivity.arm.terms import MotionTerms, motion_terms

Indices = npt.NDArray[np.intp]
Gradient = Callable[[Indices, Indices], Array]


@dataclass(frozen=True)
class Family:
    """Rows of one kind along a motion.

    scales: whether the rows depend on time, and so become nearly linear in T^2 when multiplied by it.

    following: derivative rows of the next node, for rows that couple two neighbours.
    edge: what was subtracted to make a limit the zero of its row.
    kinked: whether derivatives jump, as those of distances do where the nearest edge becomes another one. Such rows
    depend on postures alone.
    points: (N,) the points of the grid at which the rows are taken.
    reach: rows further than this from their edge are never considered, because their derivatives are expensive.
    """

    name: str
    values: Array
    gradient: Gradient
    points: Indices
    scales: bool = True
    following: Gradient | None = None
    reach: float = np.inf
    edge: float = 1.0
    kinked: bool = False

    @property
    def peaks(self) -> np.ndarray:
        """(N, m) True where a row is not smaller than at its neighbours in time."""
        padded = np.pad(self.values, ((1, 1), (0, 0)), constant_values=-np.inf)
        return np.asarray((self.values >= padded[:-2]) & (self.values >= padded[2:]))


@dataclass(frozen=True)
class Margins:
    """How far inside the edge the nodes are kept, for what may happen between them (shares of the scale of a row)."""

    contact: float = 1e-3
    limits: float = 1e-3
    clearance: float = 1e-2


@dataclass(frozen=True)
class Evaluated:
    """A motion evaluated: z (4, P, n) = q and its three time derivatives at the points of a grid; the dynamic terms at
    those points that are nodes; the rows.
    """

    duration: float
    z: Array
    terms: MotionTerms
    families: tuple[Family, ...]

    @property
    def worst(self) -> tuple[float, str]:
        """Largest row, and the family it belongs to."""
        return max((float(f.values.max()), f.name) for f in self.families)

    @property
    def violation(self) -> float:
        return max(0.0, self.worst[0])


def evaluate(
    problem: TransportProblem, s: Array, z: Array, duration: float, margins: Margins, nodes: Indices | None = None
) -> Evaluated:
    """All rows of a motion z (4, P, n) at points s (P,) in [0, 1] of its duration.

    nodes: (N,) indices of the points at which dynamics and distances are evaluated, all by default. The limits of
    the joints' own motion cost little and are evaluated at all points.
    """
    nodes = np.arange(len(s)) if nodes is None else nodes
    at = z[:, nodes]
    terms = motion_terms(problem.model, problem.arm.tray_id, at[0], at[1], at[2])
    loop = None if problem.tracking is None else problem.tracking.response(s[nodes], duration, terms)
    families = [
        *_limits(problem, z, margins.limits),
        *_torque(problem, s, duration, terms, loop, nodes, margins.limits),
        *_contact(problem, terms, loop, nodes, margins.contact),
        *_tilt(problem, terms, nodes, margins.limits),
    ]
    if problem.keep_out is not None and len(problem.keep_out.required):
        families.append(_clearance(problem, problem.keep_out, at[0], loop, nodes, margins.clearance))
    return Evaluated(duration, z, terms, tuple(families))


def _limits(problem: TransportProblem, z: Array, margin: float) -> list[Family]:
    """Position, velocity, acceleration, jerk; two rows for each joint with a finite limit."""
    n, points = problem.n, np.arange(z.shape[1])
    families = []
    for kind in LIMITS:
        middle, bound = problem.limits.range(kind)
        finite = np.flatnonzero(np.isfinite(bound))
        if kind.of != "position" or not len(finite):
            continue
        scaled = ((z[kind.order] - middle) / bound)[:, finite]

        def gradient(
            i: Indices, f: Indices, order: int = kind.order, bound: Array = bound, finite: Indices = finite
        ) -> Array:
            joint, sign = finite[f % len(finite)], np.where(f < len(finite), 1.0, -1.0)
            rows = np.zeros((len(i), 4 * n))
            rows[np.arange(len(i)), order * n + joint] = sign / bound[joint]
            return rows

        values = np.hstack([scaled, -scaled]) - 1 + margin
        families.append(Family(kind.name, values, gradient, points, scales=kind.order > 0))
    return families


def _torque(
    problem: TransportProblem,
    s: Array,
    duration: float,
    terms: MotionTerms,
    loop: Response | None,
    nodes: Indices,
    margin: float,
) -> list[Family]:
    """Torque, and its rate between neighbouring nodes. A wrong load adds its worst case to the torque."""
    n, limits = problem.n, problem.limits
    families = []
    finite = np.flatnonzero(np.isfinite(limits.torque))
    if len(finite):
        bound = limits.torque[finite]
        scaled = terms.torque[:, finite] / bound
        extra = np.zeros_like(scaled)
        if loop is not None:
            extra = loop.torque_radius()[:, finite] / bound

        def gradient(i: Indices, f: Indices) -> Array:
            column, sign = f % len(finite), np.where(f < len(finite), 1.0, -1.0)
            return _padded(terms.torque_z[i, finite[column]] * (sign / bound[column])[:, None], n)

        values = np.hstack([scaled + extra, -scaled + extra]) - 1 + margin
        families.append(Family("torque", values, gradient, nodes))
    finite_rate = np.flatnonzero(np.isfinite(limits.torque_rate))
    if len(finite_rate):
        step = np.diff(s[nodes]) * duration
        bound_rate = limits.torque_rate[finite_rate]
        rate = np.diff(terms.torque[:, finite_rate], axis=0) / step[:, None] / bound_rate

        def side(i: Indices, f: Indices, shift: int) -> Array:
            column, sign = f % len(finite_rate), np.where(f < len(finite_rate), 1.0, -1.0)
            weight = (2 * shift - 1) * sign / step[i] / bound_rate[column]
            return _padded(terms.torque_z[i + shift, finite_rate[column]] * weight[:, None], n)

        families.append(
            Family(
                "torque rate",
                np.hstack([rate, -rate]) - 1 + margin,
                lambda i, f: side(i, f, 0),
                nodes,
                following=lambda i, f: side(i, f, 1),
                edge=1 - margin,
            )
        )
    return families


def _contact(
    problem: TransportProblem, terms: MotionTerms, loop: Response | None, nodes: Indices, margin: float
) -> list[Family]:
    """Facets of the contact wrench cones of everything on the tray, at the worst parameters."""
    change, acting = (None, ()) if loop is None else (loop.motion_change(), loop.tracking.parameters)
    families = []
    for rows in problem.contacts:
        worst = worst_case(rows, terms.w, change, acting)

        def gradient(i: Indices, f: Indices, worst: WorstCase = worst) -> Array:
            return _padded(np.einsum("rk,rkz->rz", worst.attained(i, f), terms.w_z[i]), problem.n)

        carried = " and ".join(body.name for body in rows.network.bodies)
        families.append(Family(f"contact of {carried}", worst.values + margin, gradient, nodes))
    return families


def _tilt(problem: TransportProblem, terms: MotionTerms, nodes: Indices, margin: float) -> list[Family]:
    """Tray level within the tolerance, or tilted by no more than allowed."""
    if not np.isfinite(problem.max_tilt):
        return []
    n = problem.n
    up = terms.R_SE[:, 2, :]  # the vertical, in E
    up_q = np.cross(up[:, :, None], terms.jacobian[:, 3:], axisa=1, axisb=1, axisc=1)
    if problem.level:
        scaled = up[:, :2] / LEVEL_TOLERANCE

        def level(i: Indices, f: Indices) -> Array:
            sign = np.where(f < 2, 1.0, -1.0) / LEVEL_TOLERANCE
            return _padded(up_q[i, f % 2] * (sign * LEVEL_SCALE)[:, None], n)

        values = LEVEL_SCALE * (np.hstack([scaled, -scaled]) - 1 + 50 * margin)
        return [Family("tilt", values, level, nodes, scales=False)]
    scale = 1.0 / max(1 - np.cos(problem.max_tilt), 1e-6)
    values = scale * (np.cos(problem.max_tilt) - up[:, 2:]) + margin
    return [Family("tilt", values, lambda i, f: _padded(-scale * up_q[i, 2], n), nodes, scales=False)]


REACH_BEYOND_TRAY = 0.2  # m; lever at which the tray's rotation error moves what stands on it
LEVEL_SCALE = 1e-3  # rows of "level" in rad, the size at which a tilt matters to contact


def _clearance(
    problem: TransportProblem, keep_out: KeepOut, q: Array, loop: Response | None, nodes: Indices, margin: float
) -> Family:
    """Distances of all watched pairs, less what the arm may stray, in units of 0.1 m."""
    distance = keep_out.distances(q)
    if loop is not None:
        position, turn = loop.tray_radius()
        stray = np.linalg.norm(position, axis=1) + REACH_BEYOND_TRAY * np.linalg.norm(turn, axis=1)
        distance = distance - stray[:, None]

    def gradient(i: Indices, f: Indices) -> Array:
        return _padded(-10.0 * keep_out.gradient(q, i, f), problem.n)

    return Family("clearance", -10.0 * distance + margin, gradient, nodes, scales=False, reach=0.05, kinked=True)


def _padded(rows: Array, n: int) -> Array:
    """Derivatives with respect to (q, dq, ddq) or fewer, filled up with zeros to 4n columns."""
    out = np.zeros((len(rows), 4 * n))
    out[:, : rows.shape[1]] = rows
    return out
