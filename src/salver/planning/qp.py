"""Convex quadratic programmes, by the libraries DAQP and PIQP:

    minimise 1/2 x'Hx + c'x   subject to   E x = e,   R x <= b,   low <= x <= high

`solve` takes the faster method: a dual active-set method (DAQP: Arnstrom, Bemporad, Axehill, IEEE TAC 67(8), 2022),
whose work grows with the number of active rows, or, for many unknowns with banded matrices, as splines have, an
interior-point method (PIQP: Schwan, Jiang, Kuhn, Jones, CDC 2023). If one fails, the other is tried. `SOLVERS` can hold
any other `Solver`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import daqp
import numpy as np
import piqp

from salver.geometry import Array

if TYPE_CHECKING:
    from scipy.sparse import csc_matrix


@dataclass(frozen=True)
class Quadratic:
    """A quadratic programme: hessian H (n, n), positive definite; cost c (n,); rows R (m, n), bound b (m,); equal E
    (k, n), target e (k,); low, high (n,), infinite for no bound. Cost and rows should be of order one.
    """

    hessian: Array
    cost: Array
    rows: Array
    bound: Array
    equal: Array
    target: Array
    low: Array
    high: Array

    @cached_property
    def share(self) -> float:
        """Share of nonzero entries in the rows."""
        return np.count_nonzero(self.rows) / max(1, self.rows.size)


@dataclass(frozen=True)
class Optimum:
    """Minimiser x (n,) and multipliers: of the rows (m,), the equalities (k,), the lower and upper bounds (n,).

    H x + c + R' rows + E' equal - low + high = 0, where all multipliers but `equal` are at least 0.
    """

    x: Array
    rows: Array
    equal: Array
    low: Array
    high: Array


Solver = Callable[[Quadratic, float], Optimum | None]


def solve(programme: Quadratic, tolerance: float) -> Optimum | None:
    """The minimiser, with rows met to the tolerance; None when none was found, for example when rows contradict."""
    for solver in reversed(SOLVERS) if _banded(programme) else SOLVERS:
        found = solver(programme, tolerance)
        if found is not None and np.all(np.isfinite(found.x)):
            return replace(found, x=np.clip(found.x, programme.low, programme.high))
    return None


def _banded(programme: Quadratic, unknowns: int = 64, dense: float = 0.25) -> bool:
    """Whether there are many unknowns, of which each row involves only a few; else, up to `unknowns` or above a share
    `dense` of nonzero entries, the active-set method is always the faster one."""
    return len(programme.cost) > unknowns and programme.share < dense


def active_set(programme: Quadratic, tolerance: float, changes: int = 2000) -> Optimum | None:
    """Solve by DAQP. changes: of the active set, at most; a programme of a few hundred rows takes about a hundred."""
    p, n, k = programme, len(programme.cost), len(programme.target)
    none = np.full(len(p.bound), -np.inf)
    upper, lower = np.concatenate([p.high, p.target, p.bound]), np.concatenate([p.low, p.target, none])
    kind = np.zeros(len(upper), dtype=np.int32)
    kind[n : n + k] = 5  # an equality
    matrix = np.ascontiguousarray(np.vstack([p.equal, p.rows]))
    x, _, flag, info = daqp.solve(
        np.ascontiguousarray(p.hessian),
        p.cost,
        matrix,
        upper,
        lower,
        kind,
        primal_tol=tolerance,
        iter_limit=changes,
    )
    if flag <= 0:
        return None
    price = np.asarray(info["lam"], dtype=float)
    bounds = price[:n]
    return Optimum(
        np.array(x, dtype=float),
        np.maximum(price[n + k :], 0.0),
        price[n : n + k],
        np.maximum(-bounds, 0.0),
        np.maximum(bounds, 0.0),
    )


def interior_point(
    programme: Quadratic, tolerance: float, iterations: int = 100, close: float = 1e-4
) -> Optimum | None:
    """Solve by PIQP. iterations: at most, of which about twenty are needed; if they run out, rows violated by less than
    `close` are accepted."""
    p = programme
    form: Callable[[Array], Any]
    if _banded(p):
        solver, form = piqp.SparseSolver(), _sparse
        solver.settings.kkt_solver = piqp.sparse_multistage
    else:
        solver, form = piqp.DenseSolver(), np.asfortranarray
    settings = solver.settings
    settings.eps_abs = settings.eps_rel = tolerance
    settings.eps_duality_gap_abs = settings.eps_duality_gap_rel = tolerance
    settings.max_iter = iterations
    # The rows are scaled already; equilibration and the default step length would only cost iterations.
    settings.preconditioner_iter = 0
    settings.tau = 0.95
    rows = (form(p.rows), np.full(len(p.bound), -1e30), p.bound) if len(p.bound) else (None, None, None)
    equal = (form(p.equal), p.target) if len(p.target) else (None, None)
    solver.setup(form(p.hessian), p.cost, *equal, *rows, p.low, p.high)
    status, result = solver.solve(), solver.result
    late = status == piqp.PIQP_MAX_ITER_REACHED and result.info.primal_res < max(close, tolerance)
    if status != piqp.PIQP_SOLVED and not late:
        return None
    return Optimum(
        np.array(result.x),
        np.maximum(result.z_u, 0.0) if len(p.bound) else np.zeros(0),
        np.array(result.y) if len(p.target) else np.zeros(0),
        np.maximum(result.z_bl, 0.0),
        np.maximum(result.z_bu, 0.0),
    )


def _sparse(matrix: Array) -> csc_matrix:
    """The matrix in compressed sparse column format; seven times as fast as SciPy's own conversion."""
    from scipy.sparse import csc_matrix  # imported only where it is needed

    columns = np.ascontiguousarray(matrix.T)
    where = np.flatnonzero(columns != 0)
    starts = np.arange(len(columns) + 1) * max(1, len(matrix))
    ends = np.searchsorted(where, starts)
    rows = where - np.repeat(starts[:-1], np.diff(ends))
    return csc_matrix((columns.ravel()[where], rows.astype(np.int32), ends.astype(np.int32)), shape=matrix.shape)


SOLVERS: tuple[Solver, ...] = (active_set, interior_point)
