"""A hand or a policy in command: at each tick what is committed is bent a little towards what is wanted.

The bend is a coarse spline that begins at the hand-over with value, velocity and acceleration zero, and ends at rest
within the horizon. No bend *is* the committed motion, so with bounds of max(-row, 0) the quadratic programme of a tick
can always be solved and needs no slack: real-time iteration (Diehl, Bock, Schloeder, SIAM J. Control Optim. 43(5),
2005), whose every iterate is feasible. What it finds is checked like any other motion before it is committed.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import Protocol

import numpy as np

from salver.dynamics.motion_gradients import Unknowns
from salver.errors import Status
from salver.geometry import Array, Indices, Mask, exp, hat, interpolated, log
from salver.live.committed.commit import Finding, verified
from salver.live.committed.motion import SAME, Committed
from salver.live.replanning.replan import Sought
from salver.planning import qp
from salver.planning.fastest import Block, MotionEvaluation, TransportProblem, evaluate
from salver.planning.trajopt.curves import Grid, united
from salver.planning.trajopt.spline import RestSpline
from salver.sensitivity.arm.terms import motion_terms
from salver.trajectory import JointMotion

TICK = 0.02  # s; hand-overs are at its multiples, and so are the bends' knots
BREAKS = np.array([0, 1, 2, 4, 6, 9, 13, 18, 26])  # ticks: short where what is asked for is soon to be seen
HORIZON = float(TICK * BREAKS[-1])  # s in which every bend is at rest
NODES_PER_SPAN = 4  # at which conditions are imposed; POINTS from each to the next for the joints' own
POINTS = 2
DEPTH = 0.25  # rows further than this from their edge are left out of a tick
TOLERANCE = 1e-6
RIDGE = 1e-6
LEAST_CAUTION, MOST_CAUTION = 0.1, 1e5
BENT = 5e-4  # by which a bend may miss the stricter rows at the nodes, or by a share of what is kept from their edge:
SPENT = 0.5  # of 564 second bends that took no more than half 89 % would pass the verdict; of 644 third ones 73 %
WILD = 0.3  # by which rows are missed in trials that led too far
CALM = 150.0  # rad/s^3: a bend with less jerk than this that passed makes the next one
EASED, HELD = 0.5, 0.9  # times as dear; one with more, nearly as dear: else a quarter of all ticks have a wild trial
# rad/s^3: of bends with less jerk as many pass the verdict at once (77 % of 243) as of others after a trial (73 %)
SMALL = 600.0
ROUNDS = 3  # programmes of a tick: rows that a bend breaks though they were far away join the next one
LARGEST_BEND = 1.0  # rad
SAME_KNOT = 1e-7  # s: knots nearer than this are one
MOST_KEPT, EASIER = 10.0, 0.97  # times a planner's margin; of what is kept beside it, what still is a bend later
LEAST_SHARE, MOST_SHARE = 0.1, 0.7  # of a bend that was refused as a whole

# Weights of squares, integrated over time. Speeds in m/s and rad/s, accelerations in rad/s^2.
SPEED, TURNING = 100.0, 20.0
LIFTING = 3.0  # times as much for the vertical: else a lift is bought for its normal force
PLACE, HEADING = 400.0, 100.0  # of a pose that is wanted at a time
JOINTS, RATES = 200.0, 20.0  # of a posture that is
UPRIGHT, STRAIGHT = 2.0, 2000.0  # where the tray may tilt; and where it may not
ACCELERATION, JERK = 2e-4, 2e-8
BENT_RATE = 1e-3  # of a bend's acceleration, beside its size


@dataclass(frozen=True, eq=False)
class Residuals:
    """Residuals at points of the grid: value (r,), derivatives parts (r, 4, n) by q and its rates, point (r,),
    weight (r,)."""

    value: Array
    parts: Array
    point: Indices
    weight: Array


class Wanted(Protocol):
    """A request that is followed as nearly as safety allows."""

    def residuals(self, motion: MotionEvaluation, t: Array, weight: Array) -> Residuals:
        """How far a motion is from it; t: (N,) live times of the nodes, weight: (N,) s, what each stands for."""
        ...


@dataclass(frozen=True, eq=False)
class TwistWanted:
    """The tray's velocity and angular velocity in S, (6,) at live time t0, changing at slope (6,) for a while."""

    twist: Array
    slope: Array
    t0: float
    window: float = 0.2  # s from the hand-over in which it is followed
    ahead: float = 0.12  # s for which the slope is believed

    def at(self, t: Array) -> Array:
        """(N, 6) at live times."""
        return np.asarray(self.twist + np.clip(t - self.t0, 0.0, self.ahead)[:, None] * self.slope)

    def residuals(self, motion: MotionEvaluation, t: Array, weight: Array) -> Residuals:
        within = np.flatnonzero(t <= t[0] + self.window)
        each = np.array([SPEED, SPEED, LIFTING * SPEED, TURNING, TURNING, TURNING])
        return _speed(motion, within, self.at(t[within]), np.outer(weight[within], each).ravel())


@dataclass(frozen=True, eq=False)
class ChunkWanted:
    """A timed motion of the tray or of the joints: samples at live times t (C,), increasing.

    p_SE (C, 3) and R_SE (C, 3, 3), or q (C, n). Between them linear, turns about a fixed axis; after the last one it is
    held.
    """

    t: Array
    p_SE: Array | None
    R_SE: Array | None
    q: Array | None

    def residuals(self, motion: MotionEvaluation, t: Array, weight: Array) -> Residuals:
        if self.q is not None:
            wanted = interpolated(self.t, self.q, t)
            return _joints(motion, wanted, np.repeat(JOINTS * weight, motion.n))
        assert self.p_SE is not None
        assert self.R_SE is not None
        p = interpolated(self.t, self.p_SE, t)
        k = np.interp(t, self.t, np.arange(len(self.t)))
        first = k.astype(np.intp)
        R, after = self.R_SE[first], self.R_SE[np.minimum(first + 1, len(self.t) - 1)]
        turned = R @ exp((k - first)[:, None] * log(np.swapaxes(R, 1, 2) @ after))
        return _pose(motion, p, turned, weight)


def _speed(motion: MotionEvaluation, nodes: Indices, wanted_S: Array, weight: Array) -> Residuals:
    """Twist of the tray against one in S (N, 6)."""
    terms, n = motion.terms, motion.n
    R = terms.R_SE[nodes]
    both = np.zeros((len(nodes), 6, 6))
    both[:, :3, :3] = both[:, 3:, 3:] = R
    twist_S = np.einsum("kij,kj->ki", both, terms.twist[nodes])
    parts = np.zeros((len(nodes), 6, 4, n))
    # d(R v) = R (dv + dtheta x v), dtheta = J_omega dq.
    turned = np.concatenate([hat(terms.twist[nodes, :3]), hat(terms.twist[nodes, 3:])], axis=1)
    parts[:, :, 0] = both @ (terms.twist_q[nodes] - turned @ terms.jacobian[nodes, 3:])
    parts[:, :, 1] = both @ terms.jacobian[nodes]
    point = np.repeat(motion.nodes[nodes], 6)
    return Residuals((twist_S - wanted_S).ravel(), parts.reshape(-1, 4, n), point, weight)


def _pose(motion: MotionEvaluation, p_SE: Array, R_SE: Array, weight: Array) -> Residuals:
    """Pose of the tray against (p_SE, R_SE)."""
    terms, n, count = motion.terms, motion.n, len(motion.nodes)
    value = np.concatenate([terms.p_SE - p_SE, log(np.swapaxes(R_SE, 1, 2) @ terms.R_SE)], axis=1)
    parts = np.zeros((count, 6, 4, n))
    parts[:, :3, 0], parts[:, 3:, 0] = terms.R_SE @ terms.jacobian[:, :3], terms.jacobian[:, 3:]
    each = np.array([PLACE, PLACE, LIFTING * PLACE, HEADING, HEADING, HEADING])
    weight = np.outer(weight, each).ravel()
    return Residuals(value.ravel(), parts.reshape(-1, 4, n), np.repeat(motion.nodes, 6), weight)


def _joints(motion: MotionEvaluation, q: Array, weight: Array) -> Residuals:
    count, n = q.shape
    parts = np.zeros((count, n, 4, n))
    parts[:, range(n), 0, range(n)] = 1.0
    value = (motion.at_nodes[0] - q).ravel()
    return Residuals(value, parts.reshape(-1, 4, n), np.repeat(motion.nodes, n), weight)


def _level(motion: MotionEvaluation, weight: Array) -> Residuals:
    """The tray upright."""
    terms, count, n = motion.terms, len(motion.nodes), motion.n
    up = terms.R_SE[:, 2, :]
    turning = np.cross(up[:, :, None], terms.jacobian[:, 3:], axisa=1, axisb=1, axisc=1)
    parts = np.zeros((count, 2, 4, n))
    parts[:, :, 0] = turning[:, :2]
    return Residuals(up[:, :2].ravel(), parts.reshape(-1, 4, n), np.repeat(motion.nodes, 2), np.repeat(weight, 2))


class Bends(RestSpline):
    """The coarse spline of a bend."""

    def breaks(self) -> Array:
        return BREAKS / BREAKS[-1]


@dataclass
class Caution:
    """Cost of a bend's size, and distances kept from the boundaries of constraints by name, beyond those of the
    verdict: more after a bend that was refused, less after one that passed. trusting: whether the bend of a first
    programme, if it is small, is judged without a trial: the last one that was tried was found to keep all."""

    weight: float = LEAST_CAUTION
    trusting: bool = True
    kept: dict[str, float] = field(default_factory=dict)

    def passed(self, whole: bool, jerk: float) -> None:
        """jerk: the bend's largest, rad/s^3."""
        self.weight = max(LEAST_CAUTION, self.weight * ((EASED if jerk < CALM else HELD) if whole else 1.5))
        if whole:
            self.kept = {name: EASIER * margin for name, margin in self.kept.items()}

    def failed(self) -> None:
        self.weight = min(MOST_CAUTION, 4.0 * self.weight)

    def wild(self, times: float) -> None:
        """What was left out of a programme mattered: smaller steps."""
        self.weight = min(MOST_CAUTION, times * self.weight)

    def broken(self, what: str, excess: float) -> None:
        """A whole bend broke a row."""
        self.kept[what] = self.kept.get(what, 0.0) + 1.2 * excess

    def margins(self, blocks: Sequence[Block]) -> list[float]:
        """Of the rows of each; several blocks may have one name, and each keeps no more than its own most."""
        most = [MOST_KEPT * block.margins[0] for block in blocks]
        for what, kept in self.kept.items():
            own = [x for block, x in zip(blocks, most, strict=True) if of_block(what, block.name)]
            self.kept[what] = min(kept, max(own, default=np.inf))
        more = [max((x for what, x in self.kept.items() if of_block(what, b.name)), default=0.0) for b in blocks]
        return [min(each) for each in zip(more, most, strict=True)]


def of_block(what: str, name: str) -> bool:
    """Whether a row is of a block: that of one joint perhaps, `"acceleration of panda_joint1"`."""
    return what == name or what.startswith(f"{name} of ")


@dataclass(frozen=True, eq=False)
class Steering:
    """problem: by which motions are judged; sought: the same, under conditions a little stricter."""

    problem: TransportProblem
    sought: Sought
    spline: Bends
    grid: Grid
    smooth: Array  # (4, size, P) what multiplies q and its rates along the motion for the slope of the cost
    curvature: Array  # (size n, size n) of the cost that does not change
    nearness: Array  # (size n, size n) square of a bend's size
    caution: Caution

    @classmethod
    def of(cls, problem: TransportProblem, sought: Sought) -> Steering:
        spline = Bends(5, len(BREAKS) - 1)
        grid = Grid.of(spline, spline.nodes(NODES_PER_SPAN), POINTS)
        basis = grid.basis / HORIZON ** np.arange(4.0)[:, None, None]
        weights = HORIZON * grid.weights * np.array([0.0, 0.0, ACCELERATION, JERK])[:, None]
        smooth = np.swapaxes(basis * weights[:, :, None], 1, 2)
        gram = (smooth @ basis).sum(axis=0)
        size = HORIZON * (
            (grid.basis[0].T * grid.weights) @ grid.basis[0] + BENT_RATE * (basis[2].T * grid.weights) @ basis[2]
        )
        each = np.eye(problem.n)
        return cls(problem, sought, spline, grid, smooth, np.kron(gram, each), np.kron(size, each), Caution())

    def tick(self, wanted: Wanted, base: Committed, begins: float) -> tuple[Committed | None, Status]:
        """Bend the committed motion towards the request, from live time `begins` on."""
        bends = self._bends(wanted, base, begins)
        found = next(bends, None)
        if found is None:
            return None, Status("refused", "the programme of the tick was not solved", False)
        bend, margins = found
        finding = self._judged(base, begins, bend)
        tried = next(bends, None) if finding.committed is None else None
        if tried is not None and tried[0] is not bend:
            bend = tried[0]
            finding = self._judged(base, begins, bend)
        whole = finding.committed is not None
        if not whole:
            self.caution.broken(finding.what, finding.excess)
            # What a bend breaks is of second order in it.
            kept = min((x for name, x in margins if of_block(finding.what, name)), default=0.0)
            share = np.clip(0.9 * np.sqrt(kept / (kept + finding.excess)), LEAST_SHARE, MOST_SHARE)
            finding = self._judged(base, begins, share * bend)
        if finding.committed is None:
            self.caution.failed()
            return None, Status("refused", finding.sentence, False)
        self.caution.passed(whole, float(np.abs(self.grid.basis[3] @ bend).max()) / HORIZON**3)
        return finding.committed, Status("optimal", "", True)

    def _judged(self, base: Committed, begins: float, bend: Array) -> Finding:
        """The verdict on what is committed with a bend."""
        return verified(self.problem, self.bent(base, begins, bend), begins, base)

    def bent(self, base: Committed, begins: float, bend: Array) -> JointMotion:
        """The committed motion from `begins` on with a bend (size, n) added."""
        own, motion = begins - base.begins, base.motion
        ends = max(motion.duration, own + HORIZON) - own
        left = motion.t - own
        left = left[(left > SAME) & (left < ends - SAME)]
        t = united(np.concatenate([[0.0], left, [ends]]), HORIZON * self.spline.breaks(), SAME_KNOT)
        ticks = TICK * np.round(t / TICK)  # the same from tick to tick, to the last digit: then what is kept is found
        t = np.where(np.abs(t - ticks) < SAME_KNOT, ticks, t)
        s = np.minimum(t / HORIZON, 1.0)
        added = self.spline.matrices(s)[:3] @ bend / HORIZON ** np.arange(3.0)[:, None, None]
        added[1:, s >= 1.0] = 0.0
        states = [x + y for x, y in zip(motion.sample(own + t), added, strict=True)]
        return JointMotion(t, *states)

    def _bends(self, wanted: Wanted, base: Committed, begins: float) -> Iterator[tuple[Array, list[tuple[str, float]]]]:
        """The bend of the first programme, if it is small and such are trusted; then, if that will not do, of a few
        that were tried; with what was kept from the edges of the rows of which blocks."""
        grid, n = self.grid, self.problem.n
        ahead = TICK * round((begins - base.begins) / TICK)  # the same from tick to tick, to the last digit
        ahead = ahead if abs(begins - base.begins - ahead) < SAME_KNOT else begins - base.begins
        t, own = begins + HORIZON * grid.s, ahead + HORIZON * grid.s
        moving = (own < base.motion.duration)[:, None]
        z = np.stack([*base.motion.sample(own), base.motion.jerk(own) * moving])
        sought = base.left(begins, self.sought)
        motion = replace(sought.at(grid.s, z, HORIZON, grid.nodes), moving=False)
        if (
            sought.cases and sought.tracking is not None
        ):  # a mode's filter takes half of a jump of the jerk as before it
            rates = motion.at_nodes[1:].copy()
            rates[2] = 0.5 * (rates[2] + base.motion.jerk(own[grid.nodes] - SAME) * moving[grid.nodes])
            terms, shares = motion.terms, motion.shares
            strayed = sought.tracking.along(HORIZON * shares, terms, rates, shares=shares)
            motion = motion.knowing(terms=terms, response=strayed)
        constraints = [constraint.near(motion.at_nodes[0]) for constraint in self.sought.constraints]
        blocks = evaluate(constraints, motion)
        more_kept = self.caution.margins(blocks)
        # What margins there are not along what is committed need not be there: only no less of them.
        lacking = [np.maximum(block.values + more, 0.0) for block, more in zip(blocks, more_kept, strict=True)]
        lacking = [lack - more for lack, more in zip(lacking, more_kept, strict=True)]
        for block, lack in zip(blocks, lacking, strict=True):
            block.values[:] -= lack
        hessian = self.curvature + self.caution.weight * self.nearness
        slope = np.zeros((grid.basis.shape[2], n))
        for order in (2, 3):
            slope += self.smooth[order] @ z[order]
        cost = slope.ravel()
        steps = np.diff(t[grid.nodes])
        weight = 0.5 * (np.append(steps, 0.0) + np.append(0.0, steps))
        asked = [wanted.residuals(motion, t[grid.nodes], weight)]
        asked.append(_level(motion, (STRAIGHT if self.problem.level else UPRIGHT) * weight))
        for part in asked:
            rows = grid.chained(part.parts, part.point, HORIZON)
            weighted = rows * part.weight[:, None]
            hessian += weighted.T @ rows
            cost = cost + weighted.T @ part.value
        hessian[range(len(hessian)), range(len(hessian))] += RIDGE
        masks = [block.near(DEPTH) & np.ones(block.values.shape, dtype=bool) for block in blocks]
        unknowns = self._unknowns(motion) if sought.cases else None
        matrix = self._rows(blocks, masks, unknowns)
        where = [np.nonzero(mask) for mask in masks]
        bound = -np.concatenate([block.values[at] for block, at in zip(blocks, where, strict=True)])
        kept = [(block.name, block.margins[0] + more) for block, more in zip(blocks, more_kept, strict=True)]
        for left in reversed(range(ROUNDS)):
            # Bounds are never negative: no bend is always allowed.
            found = qp.solve(_programme(hessian, cost, matrix, np.maximum(bound, 0.0), n), TOLERANCE)
            if found is None:
                return
            bend = np.vstack([np.zeros(n), found.x.reshape(-1, n)])
            added = grid.motion(bend, HORIZON)
            first, small = left == ROUNDS - 1, np.abs(added[3]).max() < SMALL
            if first and small and self.caution.trusting:
                yield bend, kept
            if not left:
                break  # the verdict is another's
            bent = replace(sought.at(grid.s, z + added, HORIZON, grid.nodes), moving=False)
            # What the arm strays from what is committed is nearly what it strays from a bend of it.
            bent = bent.knowing(terms=motion_terms(bent.model, bent.frame_id, *bent.at_nodes[:3]))
            bent = bent.giving_way_as(motion) if sought.cases else bent.straying_as(motion)
            trial = evaluate(constraints, bent)
            for block, lack in zip(trial, lacking, strict=True):
                block.values[:] -= lack
            excess = max(float(block.values.max()) for block in trial)
            most = [max(BENT, SPENT * room) for _, room in kept]
            kept_all = all(block.values.max() <= least for block, least in zip(trial, most, strict=True))
            if first and small:
                self.caution.trusting = kept_all
            if kept_all:
                break
            if excess > WILD:
                hessian += excess * self.caution.weight * self.nearness
                self.caution.wild(1.0 + excess)
            # Bounds with which the linear rows are exact where the step led to; the rows that were forgotten, and anew
            # those that are broken there: beyond a kink their derivatives are others.
            values = np.concatenate([trial[k % len(trial)].values[at] for k, at in enumerate(where)])
            bound = np.where(values > BENT, bound, matrix @ bend.ravel() - values)
            more = [block.joining(mask & (block.values <= BENT)) for block, mask in zip(trial, masks, strict=True)]
            masks = [mask | joining for mask, joining in zip(masks, more, strict=True)]
            where += [np.nonzero(mask) for mask in more]
            rows = self._rows(trial, more, unknowns)
            values = np.concatenate([block.values[mask] for block, mask in zip(trial, more, strict=True)])
            matrix, bound = np.vstack([matrix, rows]), np.append(bound, rows @ bend.ravel() - values)
        yield bend, kept

    def _unknowns(self, motion: MotionEvaluation) -> Unknowns:
        """Derivatives of the tray's motion regressor at the nodes by the bend."""
        slope = motion.terms.w_z
        parts = np.zeros((slope.shape[0] * slope.shape[1], 4, motion.n))
        parts[:, :3] = slope.reshape(len(parts), 3, motion.n)
        felt = self.grid.chained(parts, np.repeat(motion.nodes, slope.shape[1]), HORIZON)
        return Unknowns(felt.reshape(*slope.shape[:2], -1))

    def _rows(self, blocks: Sequence[Block], masks: Sequence[Mask], unknowns: Unknowns | None) -> Array:
        """Derivatives (r, size n) of the masked rows by the bend, block by block."""
        matrices = [np.zeros((0, self.grid.basis.shape[2] * self.problem.n))]
        for block, mask in zip(blocks, masks, strict=True):
            node, column = np.nonzero(mask)
            if not len(node):
                continue
            parts = block.gradient(node, column).reshape(len(node), 4, -1)
            rows = self.grid.chained(parts, block.points[node], HORIZON)
            if block.following is not None:
                parts = block.following(node, column).reshape(len(node), 4, -1)
                rows = rows + self.grid.chained(parts, block.points[node + 1], HORIZON)
            if block.history is not None and unknowns is not None:
                near = np.flatnonzero(block.values[node, column] > -block.remembers)
                if len(near):
                    rows[near] += block.history(node[near], column[near], unknowns)
            matrices.append(rows)
        return np.vstack(matrices)


def _programme(hessian: Array, cost: Array, matrix: Array, bound: Array, fixed: int) -> qp.Quadratic:
    """Of the unknowns but the first ones, which are zero: the first control posture is that of the hand-over."""
    count = len(cost) - fixed
    none, far = np.zeros((0, count)), np.full(count, LARGEST_BEND)
    return qp.Quadratic(hessian[fixed:, fixed:], cost[fixed:], matrix[:, fixed:], bound, none, np.zeros(0), -far, far)
