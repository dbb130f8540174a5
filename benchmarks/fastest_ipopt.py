"""The fastest motion by IPOPT, on the same rows at the same nodes, against salver's own programme.

    python benchmarks/fastest_ipopt.py [--limit 120]

The paper's cube, friction known, level and tilting. Both start from the same straight path at the same duration, and
both get values and derivatives from `salver.planning.trajopt.constraints.constraints`; IPOPT has exact first
derivatives with their sparsity and a limited-memory Hessian, and every row from the beginning. salver's time is that
of the whole search, from few spline pieces to many, with the checks between the nodes; IPOPT's that of its one
programme at the nodes.
"""

from __future__ import annotations

import argparse
import os
import platform
import time
from typing import Any

import casadi as ca
import numpy as np

from fastest_solve import TURNS, cube
from salver.geometry import Array
from salver.planning.fastest import FastestOptions, fastest
from salver.planning.fastest.optimum import DEGREE
from salver.planning.seeds.starts import ends, straight
from salver.planning.trajopt.curves import FreeCurve
from salver.planning.trajopt.exchange import programme_of
from salver.planning.trajopt.objectives import Point
from salver.planning.trajopt.problem import TransportProblem, transport_problem
from salver.planning.trajopt.programme import Iterate
from salver.planning.trajopt.spline import RestSpline


class Rows:
    """All rows at x = (coefficients but the start posture, T^2 / T_0^2), with the goal's residual below them."""

    def __init__(self, problem: TransportProblem, options: FastestOptions) -> None:
        first = ends(problem, np.random.default_rng(options.seed))[0]
        start = straight(first).motion(problem, RestSpline(DEGREE, options.spans))
        nodes = start.spline.nodes(options.nodes_per_span)
        self.problem, self.size, self.n = problem, start.spline.size, problem.n
        self.first, self.duration = start.coefficients, start.duration
        self.programme = programme_of(problem, FreeCurve, start, nodes, points=1)
        self.start = np.append(self.first[1:].ravel(), 1.0)
        self.seen: tuple[Array, Iterate] | None = None

    def at(self, x: Array) -> Iterate:
        if self.seen is None or not np.array_equal(self.seen[0], x):
            coefficients = np.vstack([self.first[:1], x[:-1].reshape(-1, self.n)])
            duration = self.duration * float(np.sqrt(x[-1]))
            self.seen = x.copy(), self.programme.at(Point(coefficients, duration))
        return self.seen[1]

    def values(self, x: Array) -> Array:
        path = self.at(x)
        error, _ = self.problem.goal.residual(self.problem.arm, path.coefficients[-1])
        return np.concatenate([*(block.values.ravel() for block in path.blocks), error])

    def jacobian(self, x: Array) -> Array:
        path = self.at(x)
        blocks = []
        for block in path.blocks:
            node, column = (index.ravel() for index in np.indices(block.values.shape))
            slope = self.programme.derivatives(path, block, node, column)
            if block.scales:  # these are of the row times T^2
                slope[:, -1] -= block.values.ravel()
            blocks.append(slope)
        _, jacobian = self.problem.goal.residual(self.problem.arm, path.coefficients[-1])
        last = np.zeros((len(jacobian), self.size * self.n + 1))
        last[:, -1 - self.n : -1] = -jacobian
        full = np.vstack([*blocks, last])[:, self.n :]
        full[:, -1] /= x[-1]
        return full


class Value(ca.Callback):
    """The rows as CasADi takes them, with the places where their derivatives are not zero."""

    def __init__(self, rows: Rows) -> None:
        ca.Callback.__init__(self)
        self.rows, self.count = rows, len(rows.values(rows.start))
        rng = np.random.default_rng(0)
        pattern = np.abs(rows.jacobian(rows.start + 1e-3 * rng.normal(size=len(rows.start)))) > 0
        self.pattern = ca.sparsify(ca.DM(pattern.astype(float))).sparsity()
        self.slope: Slope | None = None
        self.construct("rows", {})

    def get_n_in(self) -> int:
        return 1

    def get_sparsity_in(self, _: int) -> Any:
        return ca.Sparsity.dense(len(self.rows.start), 1)

    def get_sparsity_out(self, _: int) -> Any:
        return ca.Sparsity.dense(self.count, 1)

    def eval(self, arguments: list[Any]) -> list[Any]:
        return [self.rows.values(np.array(arguments[0]).ravel())]

    def has_jacobian(self) -> bool:
        return True

    def get_jacobian(self, name: str, *_: Any) -> Any:
        self.slope = Slope(name, self)
        return self.slope


class Slope(ca.Callback):
    """Their derivatives."""

    def __init__(self, name: str, value: Value) -> None:
        ca.Callback.__init__(self)
        self.value = value
        self.row, self.column = (np.array(index) for index in value.pattern.get_triplet())
        self.construct(name, {})

    def get_n_in(self) -> int:
        return 2

    def get_sparsity_in(self, k: int) -> Any:
        return self.value.get_sparsity_in(0) if k == 0 else ca.Sparsity(self.value.count, 1)

    def get_sparsity_out(self, _: int) -> Any:
        return self.value.pattern

    def eval(self, arguments: list[Any]) -> list[Any]:
        full = self.value.rows.jacobian(np.array(arguments[0]).ravel())
        return [ca.DM(self.value.pattern, full[self.row, self.column])]


def by_ipopt(rows: Rows, limit: float) -> tuple[float, float, str, float]:
    """Duration, wall time in s, how it ended and the largest row left."""
    value = Value(rows)
    x = ca.MX.sym("x", len(rows.start))
    programme = {"x": x, "f": rows.duration * ca.sqrt(x[-1]), "g": value(x)}
    options = {
        "ipopt.hessian_approximation": "limited-memory",
        "ipopt.max_wall_time": limit,
        "ipopt.tol": 1e-5,
        "ipopt.print_level": 0,
        "ipopt.sb": "yes",
        "print_time": False,
    }
    began = time.perf_counter()
    solver = ca.nlpsol("fastest", "ipopt", programme, options)
    equal = len(rows.problem.goal.residual(rows.problem.arm, rows.first[-1])[0])
    low = np.full(value.count, -np.inf)
    low[-equal:] = 0.0
    bounds = np.full(len(rows.start), np.inf)
    least = np.append(-bounds[:-1], 0.01)
    found = solver(x0=rows.start, lbg=low, ubg=np.zeros(value.count), lbx=least, ubx=bounds)
    spent = time.perf_counter() - began
    end = np.array(found["x"]).ravel()
    left = rows.values(end)
    broken = max(float(left[:-equal].max()), float(np.abs(left[-equal:]).max()))
    return rows.duration * float(np.sqrt(end[-1])), spent, solver.stats()["return_status"], broken


def main() -> None:
    options = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    options.add_argument("--limit", type=float, default=120.0, help="s that IPOPT may take for one case")
    chosen = options.parse_args()
    print(f"{platform.machine()}, {os.cpu_count()} cores, Python {platform.python_version()}; wall time, warm")
    for friction in (0.4, 0.2):
        for orientation, turns in TURNS.items():
            problem = transport_problem(cube(friction, orientation))
            fastest(problem)
            found = fastest(problem)
            duration, spent, status, broken = by_ipopt(Rows(problem, FastestOptions()), chosen.limit)
            print(
                f"friction {friction}, {turns:8s} salver {found.duration:.4f} s in {found.wall_time:.2f} s; IPOPT "
                f"{duration:.4f} s in {spent:.1f} s ({status}, rows kept to {broken:.0e}); "
                f"ratio of times {spent / found.wall_time:.0f}",
                flush=True,
            )


if __name__ == "__main__":
    main()
