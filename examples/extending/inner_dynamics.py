"""A load with inner dynamics: a third of the cube's mass hangs in it on a spring, free to swing across the tray."""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

import salver as sv
from salver.models.contact_rows import ContactRows
from salver.models.uncertain.worst_case import WorstCase
from salver.planning.fastest import Block, Constraint, MotionEvaluation, fastest, padded, transport_problem
from salver.sensitivity.filter import LinearFilter


@dataclass(frozen=True, eq=False)
class SpringMass(Constraint):
    rows: ContactRows
    share: float  # of the mass that moves
    frequency: float  # rad/s
    damping: float = 0.1  # of critical

    def blocks(self, motion: MotionEvaluation) -> Iterator[Block]:
        w, drift = motion.response.felt() if motion.response else (motion.terms.w, None)
        felt, t = w.copy(), motion.s[motion.nodes] * motion.duration
        spring = LinearFilter.on_nodes(t, self.frequency**2, 2 * self.damping * self.frequency, 3)
        # x'' + 2 d f x' + f^2 x = -a: the mass lags behind the tray, and the cube feels a + share x''.
        felt[:, :2] += self.share * spring.acceleration(-w[:, :2], *spring.respond(-w[:, :2]))
        worst = WorstCase.of(self.rows, felt, drift)

        def gradient(node, row):  # what the mass did before is taken as given
            return padded(np.einsum("rk,rkz->rz", worst.attained(node, row), motion.terms.w_z[node]), motion.n)

        yield Block("contact with a swinging mass", worst.values, gradient, motion.nodes, most=4)


if __name__ == "__main__":
    problem = transport_problem(sv.load_scenario("panda-cube"))
    for spring in (SpringMass(problem.contacts[0], 1 / 3, frequency) for frequency in (200.0, 30.0, 10.0, 5.0)):
        print(f"{spring.frequency:5g} rad/s: {fastest(replace(problem, extra=(spring,))).status}")
