"""Time and accuracy of the nonlinear rollouts: the perturbed closed loop, eqs (18) and (19), without an engine.

    python benchmarks/rollouts.py [-n 1000] [--runs 5]

Prints the time of n rollouts of 2.5 s (bar: 1000 in 5 s) and how the error falls with the step. On a busy machine the
CPU time is what to look at. Warm means: modules imported and one small rollout made before. Parameters: mass and
inertia within 10 %, centre of mass within 3 mm.
"""

from __future__ import annotations

import argparse
import os
import platform
import time

import numpy as np

from salver.control.object import Gains
from salver.geometry import exp
from salver.models.uncertain.parameters import inertial_vector, phi_of
from salver.scenario import load
from salver.simulation.closed_loop import rollout
from salver.trajectory import PolynomialReference, Reference, min_jerk_line

PAPER = load("panda-cube")
CUBE = PAPER.payload.first
GAINS = Gains(PAPER.control.kp, PAPER.control.kd)


def references(duration: float) -> dict[str, Reference]:
    start, goal, rng = PAPER.motion.start, PAPER.motion.goal, np.random.default_rng(0)
    line = min_jerk_line(duration, np.array(start.position), np.array(goal.position), start.rotation, goal.rotation)
    position, turning = 0.2 * rng.normal(size=(7, 3)), 1.5 * rng.normal(size=(5, 3))
    return {"paper's line": line, "tumbling": PolynomialReference(duration, exp([0.4, -0.3, 1.0]), position, turning)}


def parameters(n: int) -> np.ndarray:
    rng = np.random.default_rng(1)
    values = np.tile(inertial_vector(CUBE.inertial), (n, 1))
    values[:, [0, 4, 6, 9]] *= 1 + 0.1 * rng.uniform(-1, 1, (n, 4))
    values[:, 1:4] += 0.003 * rng.uniform(-1, 1, (n, 3))
    return phi_of(values)


def run(reference: Reference, phi: np.ndarray, t: np.ndarray, step: float | None = None) -> tuple[np.ndarray, float]:
    """Deviations and cone coefficients together, and the seconds they took."""
    began = time.perf_counter()
    result = rollout(reference, CUBE.inertial, CUBE.contacts.grasp_map, GAINS, phi, t, max_step=step)
    seconds = time.perf_counter() - began
    return np.concatenate([result.deviation, result.cone_coefficients], axis=-1), seconds


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n", 1)[0])
    parser.add_argument("-n", type=int, default=1000, help="rollouts (1000)")
    parser.add_argument("--runs", type=int, default=5, help="timed repetitions (5)")
    options = parser.parse_args()
    load_average = os.getloadavg()[0] if hasattr(os, "getloadavg") else float("nan")
    print(
        f"machine: {platform.processor() or platform.machine()}, {os.cpu_count()} cores, load {load_average:.1f}; "
        f"Python {platform.python_version()}, NumPy {np.__version__}; one process, warm"
    )
    duration, phi = 2.5, parameters(options.n)
    print(f"\nN = {options.n} rollouts of {duration} s, {options.runs} runs, default step")
    print(f"{'reference':>14} {'outputs':>8} {'min [s]':>9} {'median [s]':>11} {'CPU, min [s]':>13}")
    for name, reference in references(duration).items():
        run(reference, phi[:10], np.linspace(0, duration, 11))
        for outputs in (61, 251):
            t = np.linspace(0, duration, outputs)
            seconds, busy = [], []
            for _ in range(options.runs):
                began = time.process_time()
                seconds.append(run(reference, phi, t)[1])
                busy.append(time.process_time() - began)
            print(f"{name:>14} {outputs:8d} {min(seconds):9.2f} {np.median(seconds):11.2f} {min(busy):13.2f}")

    print("\nerror against steps of 2 ms, 20 samples, 251 instants (ends of steps and between them)")
    print("(largest over samples, time and all 28 states and coefficients, relative to the deviation of each)")
    print(f"{'reference':>14} {'step [ms]':>10} {'error':>10} {'order':>7}")
    t = np.linspace(0, duration, 251)
    nominal = {k: run(r, CUBE.inertial.phi[None], t)[0] for k, r in references(duration).items()}
    for name, reference in references(duration).items():
        fine, _ = run(reference, phi[:20], t, 0.002)
        deviation = np.abs(fine - nominal[name]).max(axis=(0, 1))
        size = np.maximum(deviation, 1e-6)  # on the level line nothing drives some states: they are rounding
        previous = None
        for step in (0.04, 0.02, 0.01, 0.005, None):
            values, _ = run(reference, phi[:20], t, step)
            error = float((np.abs(values - fine).max(axis=(0, 1)) / size).max())
            order = f"{np.log2(previous / error):7.1f}" if previous and step else f"{'':7}"
            print(f"{name:>14} {f'{1e3 * step:.0f}' if step else 'default':>10} {error:10.1e} {order}")
            previous = error


if __name__ == "__main__":
    main()
