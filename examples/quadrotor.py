"""A planar quadrotor whose mass, inertia and thrust coefficient are not quite what its controller believes.

Plant: two rotors of thrust k u_i (u_i: squared rotor speed) at distance L from the centre of mass, in the x-z plane.
Controller: cascaded, as on real vehicles. The outer loop is a PID law on position that asks for an acceleration,
hence for a total thrust and a pitch; the inner one is a PD law on pitch with the feed-forward of the flat
reference. Internal states: the integrals of the position error, which end up carrying the wrong weight.

Run: python examples/quadrotor.py [--samples 300] [--plot quadrotor.png]
"""

from __future__ import annotations

import argparse
from pathlib import Path

import casadi as ca
import numpy as np

from salver.models.uncertain.parameters import UncertainSet
from salver.sensitivity.engine import ClosedLoop
from tube_check import Example, check, plot, report

STATES = ("x [m]", "z [m]", "pitch [rad]", "vx [m/s]", "vz [m/s]", "rate [rad/s]")
INPUTS = ("u_1 [rad2/s2]", "u_2 [rad2/s2]")
GRAVITY, ARM = 9.81, 0.18
KP, KD, KI = 6.0, 4.5, 3.0
KP_PITCH, KD_PITCH = 120.0, 20.0
DURATION = 3.0
VEHICLE = UncertainSet.named(
    ("mass", "inertia", "thrust"), np.array([1.2, 0.015, 6e-6]), np.array([0.06, 0.0015, 3e-7])
)  # kg, kg m^2, N s^2: 5, 10 and 5 %


def path(t: ca.SX) -> ca.SX:
    """From rest at (0, 0) to rest at (2, 1): four derivatives vanish at both ends, so rotors start and end at hover."""
    s = t / DURATION
    blend = s**5 * (126 - 420 * s + 540 * s**2 - 315 * s**3 + 70 * s**4)
    return ca.vertcat(2 * blend, blend)


def quadrotor() -> Example:
    t, x, u = ca.SX.sym("t"), ca.SX.sym("x", 6), ca.SX.sym("u", 2)
    p, p_nominal, xi = ca.SX.sym("p", 3), ca.SX.sym("p_nominal", 3), ca.SX.sym("xi", 2)
    position, pitch, velocity, rate = x[:2], x[2], x[3:5], x[5]

    mass, inertia, k = ca.vertsplit(p)
    thrust, torque = k * (u[0] + u[1]), k * ARM * (u[0] - u[1])
    up = ca.vertcat(-ca.sin(pitch), ca.cos(pitch))
    f = ca.vertcat(velocity, rate, thrust / mass * up - ca.vertcat(0, GRAVITY), torque / inertia)

    # y_d is position, velocity, acceleration of the path, and pitch rate and acceleration of its flat motion.
    y_d = ca.SX.sym("y_d", 8)
    velocity_d = ca.jacobian(path(t), t)
    acceleration_d = ca.jacobian(velocity_d, t)
    rate_d = ca.jacobian(ca.atan2(-acceleration_d[0], acceleration_d[1] + GRAVITY), t)
    reference = ca.vertcat(path(t), velocity_d, acceleration_d, rate_d, ca.jacobian(rate_d, t))

    mass_n, inertia_n, k_n = ca.vertsplit(p_nominal)
    error = y_d[:2] - position
    lift = y_d[4:6] + KD * (y_d[2:4] - velocity) + KP * error + KI * xi + ca.vertcat(0, GRAVITY)
    pitch_d = ca.atan2(-lift[0], lift[1])
    thrust_d = mass_n * ca.dot(lift, up)
    torque_d = inertia_n * (y_d[7] + KD_PITCH * (y_d[6] - rate) + KP_PITCH * (pitch_d - pitch))
    h = ca.vertcat(thrust_d + torque_d / ARM, thrust_d - torque_d / ARM) / (2 * k_n)
    loop = ClosedLoop(x=x, u=u, p=p, f=f, h=h, xi=xi, g=error, p_nominal=p_nominal, y_d=y_d, t=t, reference=reference)
    times = np.linspace(0, DURATION, 121)
    return Example("planar quadrotor", loop, np.zeros(6), np.zeros(2), VEHICLE, STATES, INPUTS, times)


def main() -> None:
    parser = argparse.ArgumentParser(description="Tubes of a planar quadrotor, checked by Monte Carlo.")
    parser.add_argument("--samples", type=int, default=300, help="perturbed motions (300)")
    parser.add_argument("--seed", type=int, default=0, help="seed of the samples (0)")
    parser.add_argument("--plot", type=Path, help="write a figure to this file")
    options = parser.parse_args()
    result = check(quadrotor(), options.samples, options.seed)
    print(report(result))
    if options.plot:
        plot(result, options.plot)
        print(f"figure: {options.plot}")


if __name__ == "__main__":
    main()
