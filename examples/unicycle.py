"""A unicycle whose wheel radius and axle are not quite what its controller believes.

Plant: x' = v cos(theta), y' = v sin(theta), theta' = w, with v = r (w_R + w_L) / 2 and w = r (w_R - w_L) / b from the
wheel speeds. Controller: dynamic feedback linearisation with integral action. Its internal states are the
commanded speed and the integrals of the position error; it inverts the wheels with the nominal r and b.
After Robuffo Giordano, Delamare, Franchi, "Trajectory generation for minimum closed-loop state sensitivity", 2018.

Run: python examples/unicycle.py [--samples 300] [--plot unicycle.png]
"""

from __future__ import annotations

import argparse
from pathlib import Path

import casadi as ca
import numpy as np

from salver.models.uncertain.parameters import UncertainSet
from salver.sensitivity.engine import ClosedLoop
from tube_check import Example, check, plot, report

STATES, INPUTS = ("x [m]", "y [m]", "theta [rad]"), ("w_R [rad/s]", "w_L [rad/s]")
KP, KD, KI = 9.0, 6.0, 2.0
WHEELS = UncertainSet.named(("r", "b"), np.array([0.1, 0.4]), np.array([0.005, 0.02]))


def path(t: ca.SX) -> ca.SX:
    """A slalom of 5 m, never at rest: the linearisation divides by the speed."""
    return ca.vertcat(0.6 * t, 0.5 * ca.sin(0.9 * t))


def unicycle() -> Example:
    t, x, u = ca.SX.sym("t"), ca.SX.sym("x", 3), ca.SX.sym("u", 2)
    p, p_nominal, xi = ca.SX.sym("p", 2), ca.SX.sym("p_nominal", 2), ca.SX.sym("xi", 3)

    def wheels_to_body(p: ca.SX) -> ca.SX:
        r, b = p[0], p[1]
        return ca.blockcat([[r / 2, r / 2], [r / b, -r / b]])

    body = wheels_to_body(p) @ u  # speed and turn rate
    f = ca.vertcat(body[0] * ca.cos(x[2]), body[0] * ca.sin(x[2]), body[1])

    # y_d is position, velocity and acceleration of the path.
    y_d = ca.SX.sym("y_d", 6)
    velocity_d = ca.jacobian(path(t), t)
    reference = ca.vertcat(path(t), velocity_d, ca.jacobian(velocity_d, t))
    speed, integral = xi[0], xi[1:]
    heading, left = ca.vertcat(ca.cos(x[2]), ca.sin(x[2])), ca.vertcat(-ca.sin(x[2]), ca.cos(x[2]))
    error = y_d[:2] - x[:2]
    command = y_d[4:] + KD * (y_d[2:4] - speed * heading) + KP * error + KI * integral
    g = ca.vertcat(ca.dot(heading, command), error)
    h = ca.solve(wheels_to_body(p_nominal), ca.vertcat(speed, ca.dot(left, command) / speed))
    loop = ClosedLoop(x=x, u=u, p=p, f=f, h=h, xi=xi, g=g, p_nominal=p_nominal, y_d=y_d, t=t, reference=reference)

    start = np.array(ca.Function("start", [t], [reference])(0.0)).ravel()
    x0 = np.array([start[0], start[1], np.arctan2(start[3], start[2])])
    xi0 = np.array([np.hypot(start[2], start[3]), 0.0, 0.0])
    times = np.linspace(0, 8, 161)
    return Example("unicycle", loop, x0, xi0, WHEELS, STATES, INPUTS, times)


def main() -> None:
    parser = argparse.ArgumentParser(description="Tubes of a unicycle with wrong wheels, checked by Monte Carlo.")
    parser.add_argument("--samples", type=int, default=300, help="perturbed motions (300)")
    parser.add_argument("--seed", type=int, default=0, help="seed of the samples (0)")
    parser.add_argument("--plot", type=Path, help="write a figure to this file")
    options = parser.parse_args()
    result = check(unicycle(), options.samples, options.seed)
    print(report(result))
    if options.plot:
        plot(result, options.plot)
        print(f"figure: {options.plot}")


if __name__ == "__main__":
    main()
