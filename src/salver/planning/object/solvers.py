"""Solvers of the planning problem, eqs (13) to (17): convex problems to global optimality, others by the sequential
quadratic programming of `planning.trajopt`.

A convex programme has a quadratic cost and thousands of concave constraints, few of which are active. Tangents of the
violated ones are added to a quadratic programme until none is violated. Each of these programmes has fewer constraints
and so bounds the optimum from below, which gives the duality gap that is reported.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from salver.errors import Status
from salver.geometry import Array
from salver.planning import qp
from salver.planning.object.conditions import apart, size_of, unit_of
from salver.planning.object.problem import MISSED, ObjectProgramme, Problem
from salver.planning.qp import Optimum, Quadratic
from salver.planning.trajopt.objectives import Point
from salver.planning.trajopt.sqp import SqpOptions, minimise
from salver.planning.trajopt.trust import Trust

TOLERANCE = 1e-9  # N (or the row's own unit): violation of a convex programme's constraint that is allowed
SEARCH = SqpOptions(gain=1e-5, violation=1e-5, least_damping=1e-9, thorough=True)
"""Options of the sequential solver; rows keep what its solution may violate."""


@dataclass(frozen=True)
class Solution:
    """A solution z with its cost and how it was found.

    cost: integral (13). lower_bound: a proven bound on it, or None without a proof. violation: of the worst constraint
    on the grid. iterations: number of convex programmes solved.
    """

    z: Array
    cost: float
    lower_bound: float | None
    violation: float
    iterations: int
    method: str
    status: Status

    @property
    def gap(self) -> float | None:
        """Relative duality gap: |cost - lower bound| / cost. The bound itself has an error of about 1e-10."""
        return None if self.lower_bound is None else _relative(self.cost, self.lower_bound)


def solve(problem: Problem, start: Array | None = None) -> Solution:
    """Solve a planning problem: as one convex programme if it is convex, else by a sequence of them.

    An infeasible problem is reported in the status, not by an exception.
    """
    return solve_convex(problem) if problem.is_affine else solve_sequential(problem, start)


def solve_convex(problem: Problem) -> Solution:
    """Global optimum of a convex problem, with the duality gap; or the solution with the least possible violation."""
    method = "convex quadratic programme with tangent cuts"
    cut = by_cuts(problem)
    if cut is not None and problem.at(cut.z).violation <= TOLERANCE:
        here = problem.at(cut.z)
        gap = _relative(here.cost, cut.lower_bound)
        sentence = f"Optimal: no reference of this degree costs less (duality gap {gap:.1e})."
        status = Status("optimal", sentence, True, {"gap": gap})
        return Solution(cut.z, here.cost, cut.lower_bound, here.violation, cut.rounds, method, status)
    relaxed = by_cuts(problem, elastic=True)
    z = np.zeros(problem.size) if relaxed is None else relaxed.z  # too badly scaled for the solver: without a proof
    here = problem.at(z)
    if here.violation <= TOLERANCE:  # only the programme of least cost failed
        status = Status("iteration_limit", "The plan is safe; whether it is optimal could not be shown.", True)
    else:
        status = infeasible(problem, z, relaxed is not None)
    return Solution(z, here.cost, None, here.violation, 0 if relaxed is None else relaxed.rounds, method, status)


def solve_sequential(problem: Problem, start: Array | None = None, options: SqpOptions = SEARCH) -> Solution:
    """Local optimum from a start z (n_z,). By default it is 0 with a free orientation, and else where the cost alone,
    which is convex then, is least."""
    cheapest = np.zeros(problem.size) if problem.rotates else _cheapest(problem)
    begun = problem.repaired((cheapest if start is None else start)[:, None])
    programme = ObjectProgramme.of(problem, max(problem.at(begun[:, 0]).cost, 1e-12), options.violation)
    found = minimise(programme, programme.begin(begun, problem.duration), options, Trust(1e-5))
    z = found.iterate.coefficients[:, 0]
    here = problem.at(z)
    if here.violation > MISSED:
        status = infeasible(problem, z, False)
    elif found.status.code == "optimal":
        sentence = "Locally optimal: a small change of the reference would save less than 0.01 % of the cost."
        status = Status("optimal", sentence, True)
    else:
        sentence = f"Stopped after {found.iterations} iterations; the plan is safe but not quite optimal."
        status = Status(found.status.code, sentence, True)
    bound = None if problem.rotates else problem.at(cheapest).cost
    method = "sequential quadratic programming"
    return Solution(z, here.cost, bound, here.violation, found.programmes, method, status)


def infeasible(problem: Problem, z: Array, proven: bool) -> Status:
    """Status that names the most violated constraint of the variables of least violation, its instant and amount."""
    contact, (slack, owners) = problem.scenario.contact, problem.at(z).slack
    k, row = np.unravel_index(int(np.argmin(slack)), slack.shape)
    short, t, owner = problem.margin - float(slack[k, row]), float(problem.t[k]), owners[row]
    i = row - owners.index(owner)
    what = "cone coefficient" if contact.condition == "paper" else "facet of the contact wrench cone"
    where = owner if apart(owner) else f"{owner} ({what} {i})"
    shown = "No reference of this degree and duration is safe" if proven else "No safe reference was found"
    unit = unit_of(problem.scenario, owner)
    if short <= problem.margin:
        kept = f"{problem.margin - short:.4g} of the {problem.margin:.4g} {unit} of contact.margin over its tube"
        sentence = (
            f"{shown}: the best one keeps only {kept}, on {where} at t = {t:.3f} s; "
            "a smaller contact.margin would help."
        )
    else:
        sentence = (
            f"{shown}: the best one still misses the condition on {where} at t = {t:.3f} s by {short:.4g} {unit}; "
            "a longer duration, more friction, a wider base or less uncertainty would help."
        )
    details = {"object": owner, "constraint": int(i), "time": t, "violation": short, "proven": proven}
    return Status("infeasible", sentence, False, details)


def _cheapest(problem: Problem) -> Array:
    """z (n_z,) of the least cost without any constraints, where it is convex."""
    here = problem.at(np.zeros(problem.size))
    return np.asarray(np.linalg.lstsq(here.residual_jacobian, -here.residual, rcond=None)[0], dtype=float)


def _relative(cost: float, bound: float) -> float:
    return abs(cost - bound) / max(cost, 1e-300)


# The convex programme ----------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Cut:
    """Solution z of a convex problem by tangent cuts. lower_bound: of its cost. rounds: quadratic programmes solved."""

    z: Array
    lower_bound: float
    rounds: int


def by_cuts(problem: Problem, elastic: bool = False, most_rounds: int = 60) -> Cut | None:
    """Minimise the cost of a convex problem with all rows above the margin; None when they contradict each other.

    elastic: minimise one common violation of all rows instead; a tiny weight of the cost decides between equal
    solutions. most_rounds: of adding tangents.
    """
    n, programme, at_0 = problem.size, ObjectProgramme.of(problem), problem.at(np.zeros(problem.size))
    if n == 0:  # the boundary conditions leave nothing free
        return Cut(np.zeros(0), at_0.cost, 1) if elastic or at_0.violation <= TOLERANCE else None
    jacobian, constant = at_0.residual_jacobian, at_0.cost
    hessian, gradient = 2 * (jacobian.T @ jacobian), 2 * (jacobian.T @ at_0.residual)
    hessian = hessian + 1e-14 * np.trace(hessian) / n * np.eye(n)
    unit, size = max(float(np.abs(gradient).max()), float(np.abs(hessian).max()), 1e-300), n + elastic
    if elastic:
        unit = 1e6 * max(constant, 1e-12)
    h, g, low = 1e-9 * np.eye(size), np.ones(size), np.zeros(size)
    h[:n, :n], g[:n], low[:n] = hessian / unit, gradient / unit, -np.inf
    rows, bound, cut = np.zeros((0, size)), np.zeros(0), None
    for rounds in range(1, most_rounds + 1):
        quadratic = Quadratic(h, g, rows, bound, np.zeros((0, size)), np.zeros(0), low, np.full(size, np.inf))
        found = qp.solve(quadratic, 1e-12)  # of scaled rows: it limits the accuracy of the lower bound
        if found is None:  # elastic: the latest tangents differ by rounding only, the last solution is as good
            return cut if elastic else None
        z = found.x[:n]
        cut = Cut(z, constant + unit * _dual_value(quadratic, found), rounds)
        path = programme.at(Point(z[:, None], problem.duration))
        most = TOLERANCE + (float(found.x[n]) if elastic else 0.0)
        masks = [block.peaks & (block.values * size_of(block.of) > most) for block in path.blocks]
        new = programme.linearised(path, masks)
        if not len(new.bound):
            break
        slope = new.matrix[:, :n]
        # A row that z cannot change has a slope of rounding errors: with s it is scaled to order one all the same.
        norm = np.maximum(np.linalg.norm(slope, axis=1), 1.0 if elastic else 1e-12)[:, None]
        sizes = np.concatenate([np.full(len(node), size_of(path.blocks[k].of)) for k, node, _ in new.where])[:, None]
        rows = np.vstack([rows, np.hstack([slope, -1 / sizes])[:, :size] / norm])
        bound = np.concatenate([bound, (new.bound + slope @ z) / norm[:, 0]])
    return cut


def _dual_value(p: Quadratic, found: Optimum) -> float:
    """Value of the dual at the solver's multipliers."""
    low, high = np.isfinite(p.low), np.isfinite(p.high)
    linear = p.cost + p.equal.T @ found.equal + p.rows.T @ found.rows + found.high * high - found.low * low
    value = (
        -found.equal @ p.target - found.rows @ p.bound + found.low[low] @ p.low[low] - found.high[high] @ p.high[high]
    )
    x = np.linalg.solve(p.hessian, -linear)
    return float(value + 0.5 * linear @ x)
