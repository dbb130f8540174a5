"""A user-defined cost: the calmest motion, the one with the least mean square of acceleration, at a given duration."""

import numpy as np

import salver as sv
from salver.planning.fastest import Objective, Point, QuadraticModel, fastest, nearby, transport_problem


class Calm(Objective):
    sought = "calmest"

    def value(self, curve, at: Point) -> float:
        ddq = curve.motion(at.coefficients, at.duration)[2]
        return 0.5 * float(curve.grid.weights @ np.sum(ddq**2, axis=1))

    def model(self, curve, at: Point) -> QuadraticModel:
        ddq = curve.motion(at.coefficients, at.duration)[2]
        count, n = ddq.shape
        parts, point = np.zeros((count * n, 4, n)), np.repeat(np.arange(count), n)
        parts[np.arange(count * n), 2, np.tile(np.arange(n), count)] = 1.0  # rows: each joint's acceleration
        rows = curve.columns(at.coefficients, at.duration, parts, point)
        weighted = rows * np.repeat(curve.grid.weights, n)[:, None]
        return QuadraticModel(weighted.T @ ddq.ravel(), 0.0, weighted.T @ rows)


if __name__ == "__main__":
    quickest = fastest(transport_problem(sv.load_scenario("panda-cube")))
    for factor in (1.1, 1.3, 1.6):
        calm = nearby(quickest, Calm(), factor * quickest.duration)
        t = np.linspace(0, calm.duration, 401)
        acceleration = np.sqrt(np.mean(np.sum(calm.sample(t)[2] ** 2, axis=1)))
        print(f"{calm.status} Its acceleration is {acceleration:.1f} rad/s^2 on average.")
