"""Constraints on a joint motion: each gives blocks of rows g <= 0, sampled along the motion, with derivatives.

    JointLimit              (|q^(k) - middle_k| + deviation) / half_k - 1,   k = 0 to 3
    TorqueLimit             (|tau| + deviation) / limit - 1
    TorqueRateLimit         |tau_(i+1) - tau_i| / (t_(i+1) - t_i) / limit - 1
    ContactConstraint       max over p of c(p) . (w + dw(p)), plus what load dynamics add
    LevelConstraint         |e_x . R_SE^T e_z|, |e_y . R_SE^T e_z| - tolerance
    TiltConstraint          (cos(largest) - e_z . R_SE e_z) / (1 - cos(largest))
    Clearance               (required + deviation - distance) / 0.1 m
    Driving                 (|velocity of the base along, across its heading| - largest) / (1 m/s)

The optimiser gets a list of `Constraint` objects; users can add subclasses (docs/extending.md). Rows are scaled such
that 0 is the limit and 1 the size of the quantity: the limit itself, or the weight of an object.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from salver.dynamics.load_rows import LoadRows
from salver.dynamics.motion_gradients import Unknowns
from salver.geometry import Array, Indices, hat
from salver.models.arm.arm import DRIVEN, ArmModel
from salver.models.arm.arm_limits import LIMITS, JointLimits, LimitKind
from salver.models.contact_rows import ContactRows
from salver.models.tray_motion import FULL_SPEED, Speed
from salver.models.uncertain.worst_case import WorstCase
from salver.planning.trajopt.constraints.obstacles import CLEARANCE, KeepOut
from salver.planning.trajopt.evaluation import MotionEvaluation

Gradient = Callable[[Indices, Indices], Array]
History = Callable[[Indices, Indices, Unknowns], Array]

FINEST = 1e-4  # share of a limit kept at the points of the check, for peaks between them
LEVEL_TOLERANCE = 1e-3  # rad; largest tilt of a level tray in the planner; contact is judged on the true motion
REACH_BEYOND_TRAY = 0.2  # m; lever arm that converts the tray's rotation error to a displacement of the load
UNSEEN = -0.02  # a row that was left out of a programme is added when a step brings it above this
PER_METRE = 10.0  # 1/m, scale of the rows of distances


def of_its_limit(excess: float) -> str:
    """The violation of a constraint that is scaled by a limit, in words."""
    return f"{100 * excess:.3g} % of its limit"


@dataclass(frozen=True, eq=False)
class Block:
    """Constraints of one kind along a motion.

    Attributes:
        name: in words.
        values: (N, m), at most 0 where the row is met.
        gradient: gradient(node, row) returns derivatives (r, 4 n) of rows (r,) by z = (q, dq, ddq, dddq) at the node.
        points: indices of the grid points of the values.
        margins: distance from the limit that is kept at nodes, for peaks between them, and in the check; in the unit
            of the rows.
        scales: whether the rows depend on time, and so become nearly linear in T^2 when multiplied by it.
        following: derivatives by z at the next node, for rows that couple two neighbours.
        by_duration: (N, m) derivative by log T at fixed z, for rows that contain the duration itself.
        history: for rows that depend on the motion at other nodes too: additional derivatives (r, c) by c unknowns.
        whole: for rows that know their derivatives (r, size m) by the coefficients themselves: these, which are added.
        remembers: history is neglected for rows further than this from their limit, because it is expensive.
        slows: relative increase of the duration that removes a unit of violation.
        reach: rows further than this from their limit are never included, because their derivatives are expensive.
        most: largest number of rows per node that are included; None for all. always: include rows at any distance.
        kinked: whether derivatives jump, as those of distances between polyhedra, or change quickly.
        inherits: whether the first node's rows depend on the initial state only, and so cannot be changed.
        in_words: returns the violation of a row above 0 in words, with a unit.
        factor: speed factor of the rows.
        of: the constraint.
    """

    name: str
    values: Array
    gradient: Gradient
    points: Indices
    margins: tuple[float, float] = (1e-3, FINEST)
    scales: bool = True
    following: Gradient | None = None
    by_duration: Array | None = None
    history: History | None = None
    whole: Gradient | None = None
    remembers: float = np.inf
    slows: float = 1.5
    reach: float = np.inf
    most: int | None = None
    always: bool = False
    kinked: bool = False
    inherits: bool = True
    in_words: Callable[[float], str] = of_its_limit
    factor: float = 1.0
    of: Constraint | None = None

    def having(self, **other: Any) -> Block:
        """A copy with some fields changed, ten times as fast as `replace`."""
        made = object.__new__(Block)
        vars(made).update(vars(self), **other)
        return made

    @property
    def by_time(self) -> bool:
        """Whether the rows change with the duration of the same path."""
        return self.scales or self.by_duration is not None

    @property
    def peaks(self) -> np.ndarray:
        """Mask (N, m) of local maxima of the rows over time."""
        padded = np.pad(self.values, ((1, 1), (0, 0)), constant_values=-np.inf)
        return np.asarray((self.values >= padded[:-2]) & (self.values >= padded[2:]))

    def near(self, depth: float) -> np.ndarray:
        """Mask (N, m) of the rows to include: those within `depth` of their limit."""
        return self._foremost(1) & (self.values > -min(np.inf if self.always else depth, self.reach))

    def joining(self, known: np.ndarray) -> np.ndarray:
        """Mask (N, m) of rows close to or beyond their limit that should be added to the `known` ones."""
        return self._foremost(3) & (self.values > UNSEEN) & ~known

    def _foremost(self, times: int) -> np.ndarray:
        """Mask (N, m) or (1, 1) of the largest rows of each node, `times` times `most` of them."""
        if self.most is None or self.values.shape[1] <= times * self.most:
            return np.ones((1, 1), dtype=bool)
        k = times * self.most
        return np.asarray(self.values >= -np.partition(-self.values, k - 1, axis=1)[:, k - 1 : k])


class Constraint(ABC):
    """A constraint on a motion."""

    @abstractmethod
    def blocks(self, motion: MotionEvaluation) -> Iterable[Block]:
        """The rows along a motion."""

    def near(self, q: Array) -> Constraint:
        """The constraint for motions near postures (N, n), which may have fewer rows."""
        return self


@np.errstate(over="ignore", invalid="ignore")  # along a motion on which waves grow beyond all bounds
def evaluate(constraints: Sequence[Constraint], motion: MotionEvaluation, margins: bool = True) -> tuple[Block, ...]:
    """Rows of all constraints along a motion, by default with their margins. NaN counts as a violation."""
    blocks = []
    for constraint in constraints:
        for block in constraint.blocks(motion):
            margin = block.margins[0 if motion.imposed else 1] if margins else 0.0
            if not (motion.moving and block.inherits):
                values = block.values + margin
            else:
                values = block.values + margin * motion.eased(block.points[: len(block.values)])[:, None]
                values[0] = np.where(values[0] < 1e-4, np.minimum(values[0], 0.0), values[0])
            values[np.isnan(values)] = np.inf
            blocks.append(block.having(values=values, of=constraint))
    return tuple(blocks)


def worst_of(blocks: Sequence[Block]) -> tuple[float, str]:
    """Largest row, and the name of the block it belongs to."""
    return max((float(block.values.max()), block.name) for block in blocks)


def violated(blocks: Sequence[Block]) -> str:
    """The most violated constraint and the amount, in words."""
    worst = max(blocks, key=lambda block: float(block.values.max()))
    return f"{worst.name}, by {worst.in_words(float(worst.values.max()))}"


def padded(rows: Array, n: int) -> Array:
    """Derivatives by (q, dq, ddq) or fewer, padded with zeros to 4 n columns."""
    out = np.zeros((len(rows), 4 * n))
    out[:, : rows.shape[1]] = rows
    return out


def both_sides(scaled: Array, extra: Array | float = -1.0) -> Array:
    """Rows (N, 2 m) that keep shares of a limit (N, m) within -1 and 1. extra: -1 plus the uncertainty of the shares.

    The memory layout is column by column: maxima over each row and instant are then six times as fast."""
    out = np.empty((2 * scaled.shape[1], len(scaled))).T
    np.add(extra, scaled, out=out[:, : scaled.shape[1]])
    np.subtract(extra, scaled, out=out[:, scaled.shape[1] :])
    return out


@dataclass(frozen=True, eq=False)
class JointLimit(Constraint):
    """Limits of position, velocity, acceleration and jerk: two rows per joint with a finite limit, and two of the
    position-dependent velocity limit, where the arm has one.

    Position and velocity include the tracking error by parameter errors, the zero-order hold and load dynamics;
    acceleration and jerk are those of the reference, as in manufacturers' limits. orders: of the derivatives checked.
    """

    limits: JointLimits
    orders: tuple[int, ...] = (0, 1, 2, 3)

    @cached_property
    def _ranges(self) -> list[tuple[LimitKind, Array, Array, Indices, Indices | slice]]:
        """Kind, middle and half-width of each limit, and the indices of the joints that have it."""
        ranges = [
            (kind, *self.limits.range(kind)) for kind in LIMITS if kind.of == "position" and kind.order in self.orders
        ]
        given = [(kind, middle, half, np.flatnonzero(np.isfinite(half))) for kind, middle, half in ranges]
        return [
            (kind, middle[finite], half[finite], finite, finite if len(finite) < len(half) else slice(None))
            for kind, middle, half, finite in given
        ]

    def blocks(self, motion: MotionEvaluation) -> Iterator[Block]:
        n, points = motion.n, np.arange(len(motion.s))
        for kind, middle, half, finite, theirs in self._ranges:
            if not len(finite):
                continue
            order = kind.order

            def gradient(
                i: Indices, f: Indices, order: int = order, half: Array = half, finite: Indices = finite
            ) -> Array:
                k, sign = f % len(finite), np.where(f < len(finite), 1.0, -1.0)
                rows = np.zeros((len(i), 4 * n))
                rows[np.arange(len(i)), order * n + finite[k]] = sign / half[k]
                return rows

            extra: Array | float = -1.0
            if order < 2 and motion.response is not None:
                extra = motion.between_nodes(motion.joint_radius(order)[:, theirs]) / half - 1.0
            values = both_sides((motion.z[order][:, theirs] - middle) / half, extra)
            # A derivative of order k scales with T^-k; the rest allows for other nonlinearity.
            slows = 1.5 if order == 0 else 1.0 / order + 0.02
            yield Block(kind.name, values, gradient, points, scales=order > 0, slows=slows, inherits=order < 3)
        if self.limits.velocity_by_position is not None and 1 in self.orders:
            yield self._velocity_by_position(motion)

    def _velocity_by_position(self, motion: MotionEvaluation) -> Block:
        """Rows dq + radius <= v(q + radius) towards the upper end, and likewise towards the lower one."""
        by_position, whole, n = self.limits.velocity_by_position, self.limits.finite_velocity, motion.n
        assert by_position is not None
        stray: Array | float = 0.0
        extra: Array | float = 0.0
        if motion.response is not None:
            stray, extra = (motion.between_nodes(motion.joint_radius(order)) for order in (0, 1))
        allowed, by_distance = by_position.towards_ends(motion.z[0], stray)
        values = both_sides(motion.z[1] / whole, extra / whole) - allowed / np.tile(whole, 2)

        def gradient(i: Indices, f: Indices) -> Array:
            k, row, sign = f % n, np.arange(len(i)), np.where(f < n, 1.0, -1.0)
            rows = np.zeros((len(i), 4 * n))
            rows[row, k] = sign * by_distance[i, f] / whole[k]
            rows[row, n + k] = sign / whole[k]
            return rows

        return Block("velocity", values, gradient, np.arange(len(motion.s)), slows=1.02)


@dataclass(frozen=True, eq=False)
class TorqueLimit(Constraint):
    """Torque limits in the worst case of parameter errors and load dynamics."""

    limits: JointLimits

    def blocks(self, motion: MotionEvaluation) -> Iterator[Block]:
        finite = np.flatnonzero(np.isfinite(self.limits.torque))
        if not len(finite):
            return
        bound = self.limits.torque[finite]
        extra: Array | float = -1.0
        if motion.response is not None:
            extra = motion.torque_radius()[:, finite] / bound - 1.0

        def gradient(i: Indices, f: Indices) -> Array:
            column, sign = f % len(finite), np.where(f < len(finite), 1.0, -1.0)
            return padded(motion.terms.torque_z[i, finite[column]] * (sign / bound[column])[:, None], motion.n)

        yield Block("torque", both_sides(motion.terms.torque[:, finite] / bound, extra), gradient, motion.nodes)


@dataclass(frozen=True, eq=False)
class TorqueRateLimit(Constraint):
    """Limits of the torque rate between neighbouring nodes."""

    limits: JointLimits

    def blocks(self, motion: MotionEvaluation) -> Iterator[Block]:
        finite = np.flatnonzero(np.isfinite(self.limits.torque_rate))
        if not len(finite):
            return
        bound, step = self.limits.torque_rate[finite], motion.steps
        rate = np.diff(motion.terms.torque[:, finite], axis=0) / step[:, None] / bound

        def side(i: Indices, f: Indices, shift: int) -> Array:
            column, sign = f % len(finite), np.where(f < len(finite), 1.0, -1.0)
            weight = (2 * shift - 1) * sign / step[i] / bound[column]
            return padded(motion.terms.torque_z[i + shift, finite[column]] * weight[:, None], motion.n)

        yield Block(
            "torque rate",
            both_sides(rate),
            lambda i, f: side(i, f, 0),
            motion.nodes,
            margins=(1.2e-3, 3e-4),  # a mean between nodes: over a control period it was up to 2e-4 larger
            following=lambda i, f: side(i, f, 1),
            by_duration=-np.hstack([rate, -rate]),  # the step between the nodes grows with T
            slows=0.5,  # it scales with T^-3, except for gravity's part
            inherits=False,
        )


@dataclass(frozen=True, eq=False)
class ContactConstraint(Constraint):
    """Facets of the contact wrench cones of one network of touching objects, at the worst parameters.

    margin: of the scenario, as a share of the normal force at rest. speed: factor. exactly: for an arm without tracking
    error, which the check of a plan requires too. coarsely: whether a bound is enough for rows far from their
    limit, unless a load has inner dynamics.
    """

    rows: ContactRows
    margin: float = 0.0
    speed: Speed = FULL_SPEED
    exactly: bool = False
    coarsely: bool = False

    def blocks(self, motion: MotionEvaluation) -> Iterator[Block]:
        speed = self.speed
        tracking = None if self.exactly or not speed.factor else motion.tracking
        w, drift = motion.felt(speed.factor, speed.rate, self.exactly)
        loads = motion.at_factor(speed.factor).loads if speed.factor else {}
        worst = WorstCase.of(self.rows, w, drift, self.coarsely and not loads, self.margin)
        values, history = worst.values, None
        if loads:
            added = LoadRows.of(self.rows, loads)
            values, history = values + added.values, added.history

        def gradient(i: Indices, f: Indices) -> Array:
            slope, side = worst.attained_swinging(i, f)
            slopes = motion.terms.w_z if speed == FULL_SPEED else motion.terms.w_z_at(speed.factor**2, speed.rate)
            rows, n = padded(np.einsum("rk,rkz->rz", slope, slopes[i]), motion.n), motion.n
            if tracking is not None:
                # A held command is exact at its beginning; at its end its acceleration lags by jerk times twice the
                # delay. All other dependence of the drift is in the history.
                rows[:, 3 * n :] = ((side - 1) * tracking.delay * speed.factor)[:, None] * rows[:, 2 * n : 3 * n]
            return rows

        most = 4 if len(loads) < 2 else 1  # of facets: a fine cone has hundreds, nearly parallel
        carried = " and ".join(body.name for body in self.rows.network.bodies)
        margins = (self.margin + 1e-3, max(self.margin, FINEST))
        name = f"contact of {carried}{speed.words}{' when the arm follows exactly' * self.exactly}"
        yield Block(
            name,
            values,
            gradient,
            motion.nodes,
            margins,
            scales=speed.factor > 0,
            most=most,
            history=history,
            remembers=0.05,
            factor=speed.factor,
            in_words=_of_the_weight,
        )


def _of_the_weight(excess: float) -> str:
    return f"{100 * excess:.3g} % of the weight"


@dataclass(frozen=True)
class LevelConstraint(Constraint):
    """Tray level within `LEVEL_TOLERANCE`; rows in rad."""

    def blocks(self, motion: MotionEvaluation) -> Iterator[Block]:
        up = motion.terms.R_SE[:, 2, :]  # the vertical, in E

        def gradient(i: Indices, f: Indices) -> Array:
            sign = np.where(f < 2, 1.0, -1.0)
            return padded(_vertical_q(motion)[i, f % 2] * sign[:, None], motion.n)

        values = both_sides(up[:, :2], -LEVEL_TOLERANCE)
        margins = (0.05 * LEVEL_TOLERANCE, 50 * FINEST * LEVEL_TOLERANCE)
        yield Block("tilt", values, gradient, motion.nodes, margins, scales=False, always=True, in_words=_deg)


@dataclass(frozen=True)
class TiltConstraint(Constraint):
    """Tray tilted from level by no more than `largest`, rad."""

    largest: float

    def blocks(self, motion: MotionEvaluation) -> Iterator[Block]:
        scale = 1.0 / max(1 - np.cos(self.largest), 1e-6)
        values = scale * (np.cos(self.largest) - motion.terms.R_SE[:, 2, 2:])

        def gradient(i: Indices, f: Indices) -> Array:
            return padded(-scale * _vertical_q(motion)[i, 2], motion.n)

        def in_words(excess: float) -> str:
            return _deg(np.arccos(np.clip(np.cos(self.largest) - excess / scale, -1.0, 1.0)) - self.largest)

        margins = (1e-2, 6e-3)  # between two points the tilt of a turning tray rises by up to 0.3 % of its limit
        yield Block("tilt", values, gradient, motion.nodes, margins, scales=False, in_words=in_words)


def _deg(angle: float) -> str:
    return f"{np.rad2deg(angle):.3g} deg"


def _vertical_q(motion: MotionEvaluation) -> Array:
    """Derivative (N, 3, n) by q of the vertical in E."""
    up = motion.terms.R_SE[:, 2, :]
    return np.asarray(hat(up) @ motion.terms.jacobian[:, 3:])


def strayed(position: Array, turn: Array) -> Array:
    """Largest displacement (...), m, of an object on the tray from the tray's position error (..., 3), m, and rotation
    error (..., 3), rad."""
    return np.asarray(np.linalg.norm(position, axis=-1) + REACH_BEYOND_TRAY * np.linalg.norm(turn, axis=-1))


def mm_of_distance(excess: float) -> str:
    """The violation of a constraint on distances, in words."""
    return f"{1e3 * excess / PER_METRE:.3g} mm"


@dataclass(frozen=True, eq=False)
class Clearance(Constraint):
    """Distances of all pairs of `keep_out` minus the tracking error, in units of 0.1 m."""

    keep_out: KeepOut

    def near(self, q: Array) -> Constraint:
        return Clearance(self.keep_out.near(q))

    def blocks(self, motion: MotionEvaluation) -> Iterator[Block]:
        if not len(self.keep_out.required):
            return
        q, stray = motion.at_nodes[0], np.zeros(1)
        if motion.response is not None:
            stray = strayed(*motion.tray_radius())
        distance = self.keep_out.distances(q, float(stray.max()))
        if not motion.imposed:
            distance += self.keep_out.required - self.keep_out.least
        yield Block(
            "clearance",
            -PER_METRE * (distance - stray[:, None]),
            lambda i, f: padded(-PER_METRE * self.keep_out.gradient(q, i, f), motion.n),
            motion.nodes,
            margins=(PER_METRE * CLEARANCE.at_nodes, 0.0),
            scales=False,
            reach=PER_METRE * CLEARANCE.reach,
            kinked=True,
            in_words=mm_of_distance,
        )


@dataclass(frozen=True, eq=False)
class Driving(Constraint):
    """Velocities of a base that drives, along its heading and across it, within `ArmModel.base_limits`, of the motion
    itself; in units of 1 m/s."""

    arm: ArmModel
    limits: JointLimits

    def blocks(self, motion: MotionEvaluation) -> Iterator[Block]:
        n, points = motion.n, np.arange(len(motion.s))
        velocity, axes = self.arm.base_velocity(*motion.z[:2])
        by_yaw = np.stack([velocity[:, 1], -velocity[:, 0]], axis=1)
        for k, most in enumerate(self.arm.base_limits(self.limits)):
            if np.isinf(most):
                continue

            def gradient(i: Indices, f: Indices, k: int = k) -> Array:
                rows = np.zeros((len(i), 4 * n))
                rows[:, 2], rows[:, n : n + 2] = by_yaw[i, k], axes[i, k]
                return np.where(f == 0, 1.0, -1.0)[:, None] * rows

            yield Block(
                f"velocity of the base {DRIVEN[k]} its heading",
                both_sides(velocity[:, k : k + 1], -most),
                gradient,
                points,
                slows=1 / most,
                always=True,
                in_words=lambda excess: f"{1e3 * excess:.3g} mm/s",
            )
