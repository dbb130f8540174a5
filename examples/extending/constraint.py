"""A user-defined constraint on the fastest motion: the tray goes no faster than 0.8 m/s."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

import salver as sv
from salver.planning.fastest import Block, Constraint, MotionEvaluation, fastest, padded, transport_problem


@dataclass(frozen=True)
class TraySpeed(Constraint):
    limit: float  # m/s

    def blocks(self, motion: MotionEvaluation) -> Iterator[Block]:
        terms, square = motion.terms, self.limit**2
        v = terms.twist[:, :3]  # of the tray, in its own frame

        def gradient(node, row):
            by_q_and_dq = np.concatenate([terms.twist_q[node, :3], terms.jacobian[node, :3]], axis=2)
            return padded(2 / square * np.einsum("ri,riz->rz", v[node], by_q_and_dq), motion.n)

        yield Block("tray speed", np.sum(v**2, axis=1, keepdims=True) / square - 1, gradient, motion.nodes)


if __name__ == "__main__":
    scenario = sv.load_scenario("panda-cube")
    for extra in ((), (TraySpeed(0.8),)):
        found = fastest(transport_problem(scenario, extra=extra))
        t = np.linspace(0, found.duration, 401)
        speed = np.linalg.norm(found.reference().sample(t).v_S, axis=1).max()
        print(f"{found.status} The cube's top speed is {speed:.2f} m/s.")
