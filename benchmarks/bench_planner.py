"""Speed of the planner: against IPOPT on the same problem in the same run, and against size.

    python benchmarks/bench_planner.py [--plot benchmarks/planner.png]

Warm means: modules imported and one plan made before; the problem is built anew for each timed plan. IPOPT gets
the finished matrices of the same convex programme (its construction is not timed), with exact derivatives. Times are
processor times, so that what else the machine does matters little.
"""

from __future__ import annotations

import argparse
import os
import platform
import time

import casadi as ca
import numpy as np

from salver.planning.make import plan_object
from salver.planning.object.conditions import CoefficientConstraint
from salver.planning.object.problem import ObjectProgramme, Problem
from salver.planning.object.solvers import solve, solve_convex
from salver.scenario import Scenario, load

PAPER = load("panda-cube")
FOUR = PAPER.with_changes(motion__orientation="free", objects__0__uncertainty={"mass": "10%", "inertia": "10%"})


def milliseconds(work, runs: int) -> np.ndarray:
    work()
    out = np.empty(runs)
    for k in range(runs):
        began = time.process_time()
        work()
        out[k] = 1e3 * (time.process_time() - began)
    return out


def ipopt(problem: Problem):
    """IPOPT on the convex programme of a problem with one uncertain parameter: all rows, both signs of the tube."""
    model, programme = problem.at(np.zeros(problem.size)), ObjectProgramme.of(problem)
    (rule,) = problem.constraints
    assert isinstance(rule, CoefficientConstraint)
    assert problem.uncertain.size == 1
    path, loop = programme.begin(model.z[:, None], problem.duration), model.closed_loop(True)
    w, felt = path.motion.terms.w, path.unknowns().felt[..., :-1]
    value = (w @ (rule.distribution @ rule.wrench).T).ravel()
    value_slope = (rule.distribution @ rule.wrench @ felt).reshape(len(value), -1)
    by_parameter, none = rule.by_parameter[0], np.zeros((len(w), 1, 3, problem.size))
    tangents = [none if part.tangent is None else part.tangent for part in (loop.df, loop.dtau)]
    wrong = rule.uncertain.factor[0, 0] * rule.distribution
    spread = ((w @ by_parameter.T + loop.wrench[..., 0]) @ wrong.T).ravel()
    spread_slope = (wrong @ (by_parameter @ felt + np.concatenate(tangents, axis=2)[:, 0])).reshape(len(value), -1)
    offset = np.concatenate([value - spread, value + spread])
    slope = np.vstack([value_slope - spread_slope, value_slope + spread_slope])
    residual, jacobian = model.residual, model.residual_jacobian
    unit = float(residual @ residual)
    z = ca.SX.sym("z", problem.size)
    cost = (z.T @ ca.DM(jacobian.T @ jacobian / unit) @ z + 2 * ca.DM(jacobian.T @ residual / unit).T @ z) + 1
    options = {"print_time": False, "ipopt": {"print_level": 0, "sb": "yes", "tol": 1e-10}}
    solver = ca.nlpsol("ipopt", "ipopt", {"x": z, "f": cost, "g": ca.DM(slope) @ z}, options)
    low = problem.margin - offset

    def run() -> float:
        answer = solver(x0=np.zeros(problem.size), lbg=low, ubg=np.inf)
        if not solver.stats()["success"]:
            raise RuntimeError(solver.stats()["return_status"])
        return float(answer["f"]) * unit

    return run, len(low)


def against_ipopt(scenario: Scenario, runs: int) -> None:
    problem = Problem(scenario, scenario.motion.nodes)
    ours = solve_convex(problem)
    run, rows = ipopt(problem)
    theirs = run()
    pairs = np.array(
        [[milliseconds(f, 1)[0] for f in (lambda: solve(Problem(scenario, 61)), run)] for _ in range(runs)]
    )
    whole = milliseconds(lambda: plan_object(scenario).verification, runs)
    print(f"{scenario.motion.duration} s, degree {scenario.motion.degree}, {rows} rows, N = {runs}")
    print(
        f"  solve, problem built anew      median {np.median(pairs[:, 0]):7.2f} ms, least {pairs[:, 0].min():7.2f} ms"
    )
    print(
        f"  IPOPT, matrices given          median {np.median(pairs[:, 1]):7.2f} ms, least {pairs[:, 1].min():7.2f} ms"
    )
    print(f"  ratio IPOPT / solve            median {np.median(pairs[:, 1] / pairs[:, 0]):7.1f}")
    print(f"  plan, checked at 601 instants  median {np.median(whole):7.2f} ms, least {whole.min():7.2f} ms")
    print(f"  relative difference of the optimum {abs(theirs - ours.cost) / ours.cost:.1e}, duality gap {ours.gap:.1e}")


def free_orientation(runs: int) -> None:
    print(f"Free orientation, mass and three inertias uncertain, 27 variables, N = {runs}")
    for name, goal in (("upright", [0, 0, 0]), ("90 degree yaw", [0, 0, 90])):
        for duration in (2.5, 1.0):
            scenario = FOUR.with_changes(motion__goal__rpy_deg=goal, motion__duration=duration)
            times = milliseconds(lambda s=scenario: solve(Problem(s, 61)), runs)
            status = solve(Problem(scenario, 61)).status.code
            print(
                f"  {name:14s} {duration} s: median {np.median(times):6.1f} ms, least {times.min():6.1f} ms ({status})"
            )


def against_size(runs: int) -> dict[str, tuple[list[int], list[float]]]:
    """Least solve time at T = 1 s, where the tubes bind, as degree, nodes and number of parameters grow."""
    binding = PAPER.with_changes(motion__duration=1.0, motion__orientation="fixed")
    inertia = [3.4e-5, 5e-6, 3.4e-5, 5e-6, 5e-6, 3.4e-5]
    sets = {
        1: {"mass": "10%"},
        4: {"mass": "10%", "inertia": "10%"},
        7: {"mass": "10%", "inertia": inertia},
        10: {"mass": "10%", "com": [2e-4] * 3, "inertia": inertia},
    }
    out = {}
    for label, key, values in (
        ("degree", "motion__degree", (6, 8, 9, 12, 16, 20, 24)),
        ("nodes", "motion__nodes", (21, 41, 61, 121, 241, 481)),
        ("uncertain parameters", "objects__0__uncertainty", tuple(sets)),
    ):
        times = []
        for value in values:
            scenario = binding.with_changes(**{key: sets[value] if value in sets and label[0] == "u" else value})
            problem = scenario.motion.nodes
            times.append(float(milliseconds(lambda s=scenario, n=problem: solve(Problem(s, n)), runs).min()))
        out[label] = (list(values), times)
        shown = "  ".join(f"{v}: {t:.1f}" for v, t in zip(values, times, strict=True))
        print(f"Against {label} (T = 1 s, least ms, N = {runs}): {shown}")
    return out


def plot(against: dict[str, tuple[list[int], list[float]]], path: str) -> None:
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(1, 3, figsize=(9, 2.8), sharey=True, layout="constrained")
    for axis, (label, (values, times)) in zip(axes, against.items(), strict=True):
        axis.plot(values, times, "o-", color="#0072b2")
        axis.set(xlabel=label, yscale="log")
        axis.grid(alpha=0.3, which="both")
    axes[0].set(ylabel="least solve time (ms)", ylim=(1, 300))
    figure.suptitle("Robust plan of the paper's cube, T = 1 s", fontsize=10)
    figure.savefig(path, dpi=150)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--plot", help="write the growth with size as a picture")
    parser.add_argument("--runs", type=int, default=50)
    arguments = parser.parse_args()
    processor = platform.processor() or platform.machine()
    print(f"{processor}, {os.cpu_count()} cores, Python {platform.python_version()}; processor time")
    against_ipopt(PAPER, arguments.runs)
    against_ipopt(PAPER.with_changes(motion__duration=1.0), arguments.runs)
    free_orientation(max(5, arguments.runs // 5))
    growth = against_size(max(3, arguments.runs // 10))
    if arguments.plot:
        plot(growth, arguments.plot)


if __name__ == "__main__":
    main()
