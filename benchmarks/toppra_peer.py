"""The time-optimal law on the straight line: TOPP-RA's reachability analysis against salver's linear programme.

    python benchmarks/toppra_peer.py [--points 201 801]

Both get the same path in joint space, the same limits on velocity, acceleration and torque, then also the same rows
of nominal contact, at as many points. TOPP-RA (Pham and Pham 2018) is the package `toppra`, which salver does not
need: pip install toppra. It states its conditions at the points ("nodes") or at both ends of every interval
("intervals", its default); salver at the middles. So durations differ by what a finer grid takes away.
"""

from __future__ import annotations

import argparse
import logging
import time
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from fastest import line_path, scenarios
from salver.geometry import Array
from salver.planning.fastest.problem import TransportProblem, transport_problem
from salver.planning.fastest.retiming import SplinePath, reachable_law
from salver.sensitivity.arm.terms import motion_terms

try:
    import toppra
    from toppra.algorithm import TOPPRA
    from toppra.constraint import (
        DiscretizationType,
        JointAccelerationConstraint,
        JointVelocityConstraint,
        SecondOrderConstraint,
    )
except ImportError:
    raise SystemExit("The package toppra is not installed; install it with: pip install toppra.") from None

SCHEMES = {"nodes": DiscretizationType.Collocation, "intervals": DiscretizationType.Interpolation}


@dataclass(frozen=True)
class PeerPath(toppra.interpolator.AbstractGeometricPath):
    """A path as toppra takes it."""

    path: SplinePath

    def __call__(self, path_positions: Any, order: int = 0) -> Array:
        q: Array = self.path.derivatives(np.asarray(path_positions), order)[order]
        return q

    @property
    def dof(self) -> int:
        return int(self.path.spline.c.shape[1])

    @property
    def path_interval(self) -> Array:
        return np.array([0.0, 1.0])

    @property
    def waypoints(self) -> None:
        return None


def both_sides(limit: Array) -> Array:
    return np.column_stack([-limit, limit])


def peer(problem: TransportProblem, path: SplinePath, count: int, scheme: DiscretizationType) -> float:
    """Duration that toppra finds, s; infinite when it finds none. Torque and contact are one of its constraints: rows
    on the vector (w, torque) that depends on the motion as torque does."""
    limits, n = problem.limits, problem.n

    def wrench_and_torque(q: Array, dq: Array, ddq: Array) -> Array:
        terms = motion_terms(problem.model, problem.arm.tray_id, q[None], dq[None], ddq[None])
        return np.concatenate([terms.w[0], terms.torque[0]])

    width = len(wrench_and_torque(*np.zeros((3, n)))) - n
    torque = np.hstack([np.zeros((n, width)), np.eye(n)])
    contact = [np.hstack([rows.nominal, np.zeros((len(rows.nominal), n))]) for rows in problem.contacts]
    matrix = np.vstack([torque, -torque, *contact])
    bound = np.concatenate([limits.torque, limits.torque, np.zeros(len(matrix) - 2 * n)])
    constraints = [
        JointVelocityConstraint(both_sides(limits.velocity)),
        JointAccelerationConstraint(both_sides(limits.acceleration), discretization_scheme=scheme),
        SecondOrderConstraint(wrench_and_torque, lambda q: matrix, lambda q: bound, n, discretization_scheme=scheme),
    ]
    points = np.linspace(0.0, 1.0, count)
    _, rate, _ = TOPPRA(
        constraints, PeerPath(path), gridpoints=points, solver_wrapper="seidel"
    ).compute_parameterization(0.0, 0.0)
    if rate is None:
        return np.inf
    return float(np.sum(2 * np.diff(points) / (rate[1:] + rate[:-1])))


def own(problem: TransportProblem, path: SplinePath, count: int) -> float:
    law = reachable_law(problem, path, count)
    return np.inf if law is None else float(law[0][-1])


def timed(work: Any, *arguments: Any) -> tuple[float, float]:
    began = time.process_time()
    duration = work(*arguments)
    return duration, time.process_time() - began


def main() -> None:
    options = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    options.add_argument("--points", type=int, nargs="*", default=[201, 801])
    options.add_argument("--only", nargs="*", help="names of scenarios")
    chosen = options.parse_args()
    logging.getLogger("toppra").setLevel(logging.ERROR)
    print("duration in s by salver and by toppra (conditions at nodes, over intervals), ratios salver / toppra, and")
    print("processor time of each in s")
    print(f"{'':37s}points   salver    nodes intervals  ratios            processor time")
    for name, scenario in scenarios().items():
        if chosen.only is not None and name not in chosen.only:
            continue
        path = line_path(scenario)
        full = transport_problem(scenario, level=True, robust=False)
        for what, problem in (("limits", replace(full, contacts=())), ("limits, contact", full)):
            for count in chosen.points:
                ours, *seconds = timed(own, problem, path, count)
                found = []
                for kind in SCHEMES.values():
                    theirs, spent = timed(peer, problem, path, count, kind)
                    found.append(theirs)
                    seconds.append(spent)
                durations = " ".join(f"{duration:8.5f}" for duration in (ours, *found))
                ratios = " ".join(f"{ours / theirs:.5f}" for theirs in found)
                spent_all = " ".join(f"{spent:.2f}" for spent in seconds)
                print(f"{name:20s} {what:16s} {count:5d} {durations}   {ratios}   {spent_all}", flush=True)


if __name__ == "__main__":
    main()
