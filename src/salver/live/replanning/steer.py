"""Steering by a hand or a policy: at each tick the committed motion is changed a little towards the request.

The unknown is an increment: a coarse spline of the joints that begins at the hand-over with value, velocity and
acceleration zero, and ends at rest within the horizon. A zero increment *is* the committed motion, so with bounds of
max(-g, 0) the quadratic programme of a tick is always feasible and needs no slack: real-time iteration (Diehl, Bock,
Schloeder, SIAM J. Control Optim. 43(5), 2005), whose every iterate is feasible. Its solution passes the verdict before
it is committed. Steps are damped as by Levenberg and Marquardt; constraints that the verdict found violated are
tightened in the programmes that follow.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from salver.dynamics.motion_gradients import Unknowns
from salver.errors import Status
from salver.geometry import Array, Mask
from salver.live.committed.commit import Finding, verified
from salver.live.committed.motion import SAME, Committed
from salver.live.replanning.objective import Wanted, Weights, level
from salver.live.replanning.replan import Sought
from salver.planning import qp
from salver.planning.fastest import Block, MotionEvaluation, TransportProblem, evaluate
from salver.planning.trajopt.curves import Grid, united
from salver.planning.trajopt.evaluation import NOTHING
from salver.planning.trajopt.spline import RestSpline
from salver.sensitivity.arm.terms import motion_terms
from salver.trajectory import JointMotion


@dataclass(frozen=True)
class SteeringOptions:
    """How the committed motion is changed at each tick.

    Effects were measured on 12 s of gentle, hostile, noisy and interrupted twists, with a cube and a tall bottle.

    Attributes:
        tick: s from one hand-over to the next; knots of increments are at its multiples. With twice the value a command
            is followed 20 ms later.
        breaks: ticks from the hand-over to the knots of an increment, at the last of which it is at rest.
        nodes_per_span: number of nodes from each knot to the next, at which constraints are imposed. At 3, a tick takes
            0.8 of the time and 1 % more ticks are refused.
        depth: share of its limit by which a constraint may be away from its boundary and is still in the first
            programme; others join when a trial violates them. At 1, a tick takes 1.4 times as long. On a base that
            drives, all limits of the jerk are in it.
        programmes: quadratic programmes in a tick at most: each but the last is followed by a trial of its solution.
            Doubled, the slowest ticks take 1.2 times as long; at 1, 9 % of the ticks are refused instead of 3 %.
        spent: share of a constraint's margin at the nodes that a trial may use up. Doubled, 4 % fewer programmes are
            solved; at 0, 1.6 times as many.
        acceleration: s^4, weight of an increment's acceleration beside its size: its norm squared is the integral of
            |dq|^2 + acceleration |d(ddq)|^2. Doubled, gentle twists are followed with 2 % more error; at 0, hostile
            ones at half the speed.
        least_damping, most_damping: weight of that norm. With ten times the least, gentle twists are followed with
            12 % more error. A way out is given up at the most.
        passed, refused: factors of the damping after an increment that passed the verdict, and one that did not. With
            0.9, hostile twists are followed at 0.87 of the speed; with 0.5, 6 % of the ticks are refused.
        step_length: share of an increment that is judged when the verdict refused all of it; 0.3 is as good.
        loosened: a constraint that the verdict found violated is tightened by its excess, at most by the share `depth`
            of its largest distance from its boundary; after each increment that passed, by this share of that. Without
            tightening, 6 % of the ticks are refused.
        tolerance: of the solution of a quadratic programme.
        same_knot: s; knots that are closer together count as one, because of rounding.
    """

    tick: float = 0.02
    breaks: tuple[int, ...] = (0, 1, 2, 4, 6, 9, 13, 18, 26)
    nodes_per_span: int = 4
    depth: float = 0.25
    programmes: int = 3
    spent: float = 0.5
    acceleration: float = 1e-3
    least_damping: float = 0.1
    most_damping: float = 1e5
    passed: float = 0.8
    refused: float = 2.0
    step_length: float = 0.5
    loosened: float = 0.97
    tolerance: float = 1e-6
    same_knot: float = 1e-7

    @property
    def horizon(self) -> float:
        """Time from the hand-over after which every increment is at rest, s."""
        return self.tick * self.breaks[-1]


STANDARD = SteeringOptions()
TICK = STANDARD.tick


@dataclass(frozen=True)
class IncrementSpline(RestSpline):
    """The coarse spline of an increment. ticks: those of its knots."""

    ticks: tuple[int, ...] = STANDARD.breaks

    def breaks(self) -> Array:
        return np.array(self.ticks) / self.ticks[-1]


@dataclass
class StepControl:
    """State that one tick leaves to the next: the damping of increments, and the tightening of constraints by name."""

    options: SteeringOptions
    damping: float
    tightened: dict[str, float] = field(default_factory=dict)

    def damped(self, factor: float) -> None:
        options = self.options
        self.damping = float(np.clip(factor * self.damping, options.least_damping, options.most_damping))

    def passed(self) -> None:
        """Note that a whole increment passed the verdict."""
        self.damped(self.options.passed)
        self.tightened = {name: self.options.loosened * margin for name, margin in self.tightened.items()}

    def refused(self, what: str, excess: float) -> None:
        """Note that the verdict refused an increment because of a constraint that it violates."""
        self.damped(self.options.refused)
        self.tightened[what] = min(self.tightened.get(what, 0.0) + excess, self.options.depth)

    def margin(self, block: Block) -> float:
        """The tightening of the constraints of a block; a name such as `"acceleration of panda_joint1"` belongs to the
        block of all joints."""
        of = f"{block.name} of "
        found = max((x for what, x in self.tightened.items() if what == block.name or what.startswith(of)), default=0.0)
        return min(found, self.options.depth * -float(block.values.min(initial=0.0)))


@dataclass(frozen=True, eq=False)
class Steering:
    """Changes the committed motion towards commands. problem: the constraints of the verdict; sought: the same problem,
    slightly tightened."""

    problem: TransportProblem
    sought: Sought
    spline: IncrementSpline
    grid: Grid
    norm: Array  # (size n, size n) of an increment, squared
    jerk: Array  # (size, P) gives the gradient of the jerk's cost along the motion
    jerk_hessian: Array  # (size n, size n)
    control: StepControl
    options: SteeringOptions
    weights: Weights

    @classmethod
    def of(
        cls,
        problem: TransportProblem,
        sought: Sought,
        options: SteeringOptions,
        weights: Weights,
    ) -> Steering:
        spline = IncrementSpline(5, len(options.breaks) - 1, ticks=options.breaks)
        grid, horizon = Grid.of(spline, spline.nodes(options.nodes_per_span)), options.horizon
        each = np.eye(problem.n)
        q, _, ddq, dddq = grid.basis / horizon ** np.arange(4.0)[:, None, None]
        norm = horizon * ((q.T * grid.weights) @ q + options.acceleration * (ddq.T * grid.weights) @ ddq)
        jerk = weights.jerk * horizon * dddq.T * grid.weights
        norm, hessian = np.kron(norm, each), np.kron(jerk @ dddq, each)
        control = StepControl(options, options.least_damping)
        return cls(problem, sought, spline, grid, norm, jerk, hessian, control, options, weights)

    def tick(self, wanted: Wanted, base: Committed, begins: float) -> tuple[Committed | None, Status]:
        """Change the committed motion towards the request, from live time `begins`, s, on."""
        control = self.control
        increment = self._increment(wanted, base, begins)
        if increment is None:
            control.damped(self.options.refused)
            return None, Status("refused", "the programme of the tick was not solved", False)
        finding = self._judged(base, begins, increment)
        if finding.committed is not None:
            control.passed()
            return finding.committed, Status("optimal", "", True)
        control.refused(finding.what, finding.excess)
        finding = self._judged(base, begins, self.options.step_length * increment)
        if finding.committed is None:
            return None, Status("refused", finding.sentence, False)
        return finding.committed, Status("optimal", "", True)

    @property
    def given_up(self) -> bool:
        """Whether increments are damped as much as they can be."""
        return self.control.damping >= self.options.most_damping

    def _judged(self, base: Committed, begins: float, increment: Array) -> Finding:
        """The verdict on the committed motion with an increment."""
        return verified(self.problem, self.changed(base, begins, increment), begins, base)

    def changed(self, base: Committed, begins: float, increment: Array) -> JointMotion:
        """The committed motion from `begins` on with an increment (size, n) added."""
        own, motion, horizon, same = begins - base.begins, base.motion, self.options.horizon, self.options.same_knot
        ends = max(motion.duration, own + horizon) - own
        left = motion.t - own
        left = left[(left > SAME) & (left < ends - SAME)]
        t = self._ticks(united(np.concatenate([[0.0], left, [ends]]), horizon * self.spline.breaks(), same))
        s = np.minimum(t / horizon, 1.0)
        added = self.spline.matrices(s)[:3] @ increment / horizon ** np.arange(3.0)[:, None, None]
        added[1:, s >= 1.0] = 0.0
        states = [x + y for x, y in zip(motion.sample(own + t), added, strict=True)]
        return JointMotion(t, *states)

    def _ticks(self, t: Array) -> Array:
        """t, with times near a multiple of a tick replaced by that multiple, so that results in the cache are found."""
        ticks = self.options.tick * np.round(t / self.options.tick)
        return np.where(np.abs(t - ticks) < self.options.same_knot, ticks, t)

    def _along(self, base: Committed, begins: float) -> MotionEvaluation:
        """The committed motion in the horizon from `begins` on, as constraints see it."""
        grid, horizon, sought = self.grid, self.options.horizon, base.left(begins, self.sought)
        own = self._ticks(np.array([begins - base.begins])) + horizon * grid.s
        ends = base.motion.duration
        before, after = (base.motion.jerk(t) * (t < ends)[:, None] for t in (own - SAME, own))
        # It jumps where an earlier increment ends: limits are kept on the side where it is larger.
        jerk = np.where(np.abs(before) > np.abs(after), before, after)
        jerk[0] = after[0]
        z = np.stack([*base.motion.sample(own), jerk])
        motion = replace(sought.at(grid.s, z, horizon, grid.nodes), moving=False)
        if sought.cases and sought.tracking is not None:
            # A mode's filter takes half of a jump of the jerk as before it.
            rates = motion.at_nodes[1:].copy()
            rates[2] = 0.5 * (before + after)[grid.nodes]
            terms, shares = motion.terms, motion.shares
            strayed = sought.tracking.along(horizon * shares, terms, rates, shares=shares)
            motion = motion.knowing(terms=terms, response=strayed)
        return motion

    def _trial(self, motion: MotionEvaluation, increment: Array) -> MotionEvaluation:
        """The motion with an increment. The arm's deviation from it is nearly that from the motion without it."""
        z = motion.z + self.grid.motion(increment, self.options.horizon)
        changed = replace(motion, z=z, known=NOTHING)
        changed = changed.knowing(terms=motion_terms(changed.model, changed.frame_id, *changed.at_nodes[:3]))
        return changed.giving_way_as(motion) if motion.cases else changed.straying_as(motion)

    def _increment(self, wanted: Wanted, base: Committed, begins: float) -> Array | None:
        """The increment (size, n) of the last programme of the tick, or of the first one whose trial keeps the
        constraints; None when a programme was not solved."""
        options, n = self.options, self.problem.n
        motion = self._along(base, begins)
        constraints = [constraint.near(motion.at_nodes[0]) for constraint in self.sought.constraints]
        blocks = evaluate(constraints, motion)
        tightened = [self.control.margin(block) for block in blocks]
        # Margins that are not kept along what is committed need not be kept: only no less of them.
        lacking = [np.maximum(block.values + more, 0.0) - more for block, more in zip(blocks, tightened, strict=True)]
        for block, lack in zip(blocks, lacking, strict=True):
            block.values[:] -= lack
        may_use = [
            max(options.tolerance, options.spent * (block.margins[0] + more))
            for block, more in zip(blocks, tightened, strict=True)
        ]
        hessian, cost = self._objective(wanted, motion, begins)
        # Rows of the jerk that join late only shorten the step, by which a base with its low limit hardly moves.
        first = "jerk" if self.problem.arm.base is not None else None
        depths = [np.inf if block.name == first else options.depth for block in blocks]
        masks = [
            block.near(depth) & np.ones(block.values.shape, dtype=bool)
            for block, depth in zip(blocks, depths, strict=True)
        ]
        unknowns = self._unknowns(motion) if motion.cases else None
        matrix = self._rows(blocks, masks, unknowns)
        where = [np.nonzero(mask) for mask in masks]
        bound = -np.concatenate([block.values[at] for block, at in zip(blocks, where, strict=True)])
        for left in reversed(range(options.programmes)):
            # Bounds are never negative: a zero increment is always allowed.
            found = qp.solve(_programme(hessian, cost, matrix, np.maximum(bound, 0.0), n), options.tolerance)
            if found is None:
                return None
            increment = np.vstack([np.zeros(n), found.x.reshape(-1, n)])
            if not left:
                break  # the verdict is another's
            trial = evaluate(constraints, self._trial(motion, increment))
            for block, lack in zip(trial, lacking, strict=True):
                block.values[:] -= lack
            if all(block.values.max() <= most for block, most in zip(trial, may_use, strict=True)):
                break
            # What the programme did not know of mattered: a smaller step.
            excess = max(0.0, *(float(block.values.max()) for block in trial))
            hessian += excess * self.control.damping * self.norm
            self.control.damped(1.0 + excess)
            # Bounds with which the linear constraints are exact at the trial (a second-order correction); and those
            # that it violates join, with their derivatives there.
            values = np.concatenate([trial[k % len(trial)].values[at] for k, at in enumerate(where)])
            bound = np.where(values > 0.0, bound, matrix @ increment.ravel() - values)
            joining = [block.joining(mask & (block.values <= 0.0)) for block, mask in zip(trial, masks, strict=True)]
            masks = [mask | more for mask, more in zip(masks, joining, strict=True)]
            where += [np.nonzero(mask) for mask in joining]
            rows = self._rows(trial, joining, unknowns)
            values = np.concatenate([block.values[mask] for block, mask in zip(trial, joining, strict=True)])
            matrix, bound = np.vstack([matrix, rows]), np.append(bound, rows @ increment.ravel() - values)
        return increment

    def _objective(self, wanted: Wanted, motion: MotionEvaluation, begins: float) -> tuple[Array, Array]:
        """Hessian (size n, size n), of Gauss and Newton, and gradient (size n,) at a zero increment."""
        t = begins + self.options.horizon * motion.shares
        steps = np.diff(t)
        dt = 0.5 * (np.append(steps, 0.0) + np.append(0.0, steps))
        parts = [wanted.residuals(motion, t, dt, self.weights)]
        parts.append(level(motion, (self.weights.level if self.problem.level else self.weights.upright) * dt))
        hessian = self.control.damping * self.norm + self.jerk_hessian
        gradient = (self.jerk @ motion.z[3]).ravel()
        for part in parts:
            rows = self.grid.chained(part.parts, part.point, self.options.horizon)
            weighted = rows * part.weight[:, None]
            hessian = hessian + weighted.T @ rows
            gradient = gradient + weighted.T @ part.value
        return hessian, gradient

    def _unknowns(self, motion: MotionEvaluation) -> Unknowns:
        """Derivatives of the tray's motion regressor at the nodes by the increment."""
        slope = motion.terms.w_z
        parts = np.zeros((slope.shape[0] * slope.shape[1], 4, motion.n))
        parts[:, :3] = slope.reshape(len(parts), 3, motion.n)
        felt = self.grid.chained(parts, np.repeat(motion.nodes, slope.shape[1]), self.options.horizon)
        return Unknowns(felt.reshape(*slope.shape[:2], -1))

    def _rows(self, blocks: Sequence[Block], masks: Sequence[Mask], unknowns: Unknowns | None) -> Array:
        """Derivatives (r, size n) of the masked rows by the increment, block by block."""
        chained, horizon = self.grid.chained, self.options.horizon
        matrices = [np.zeros((0, len(self.norm)))]
        for block, mask in zip(blocks, masks, strict=True):
            node, column = np.nonzero(mask)
            if not len(node):
                continue
            rows = chained(block.gradient(node, column).reshape(len(node), 4, -1), block.points[node], horizon)
            if block.following is not None:
                parts = block.following(node, column).reshape(len(node), 4, -1)
                rows = rows + chained(parts, block.points[node + 1], horizon)
            if block.history is not None and unknowns is not None:
                near = np.flatnonzero(block.values[node, column] > -block.remembers)
                if len(near):
                    rows[near] += block.history(node[near], column[near], unknowns)
            matrices.append(rows)
        return np.vstack(matrices)


def _programme(hessian: Array, cost: Array, matrix: Array, bound: Array, fixed: int) -> qp.Quadratic:
    """The programme in all unknowns but the first ones, which are zero: the first control posture is that of the
    hand-over."""
    count = len(cost) - fixed
    none, free = np.zeros((0, count)), np.full(count, np.inf)
    return qp.Quadratic(hessian[fixed:, fixed:], cost[fixed:], matrix[:, fixed:], bound, none, np.zeros(0), -free, free)
