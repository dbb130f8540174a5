"""A user-defined uncertainty: a draught of up to 0.1 N along x and along y, beside what the scenario says."""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

import salver as sv
from salver.models.contact_rows import ContactRows
from salver.models.uncertain.parameters import Parameter
from salver.models.uncertain.worst_case import Drift, WorstCase
from salver.planning.fastest import Block, Constraint, MotionEvaluation, fastest, padded, transport_problem


@dataclass(frozen=True, eq=False)
class Draught(Constraint):
    rows: ContactRows  # of the object that stands on the tray
    acceleration: float  # m/s^2, of the object if it were free: like a tray that accelerates the other way

    def blocks(self, motion: MotionEvaluation) -> Iterator[Block]:
        terms, count = motion.terms, len(motion.nodes)
        w, known = motion.response.felt() if motion.response else (terms.w, Drift((), np.zeros((count, 12, 0))))
        names, felt = tuple((Parameter("", "draught", axis),) for axis in "xy"), np.zeros((count, 12, 2))
        felt[:, :3] = self.acceleration * np.swapaxes(terms.R_SE, 1, 2)[:, :, :2]  # along x and y of S, seen in E
        drift = Drift((*known.terms, *names), np.concatenate([known.dw, felt], axis=2), known.swing)
        worst = WorstCase.of(self.rows, w, drift)

        def gradient(node, row):
            return padded(np.einsum("rk,rkz->rz", worst.attained(node, row), terms.w_z[node]), motion.n)

        yield Block("contact in a draught", worst.values, gradient, motion.nodes, most=4)


if __name__ == "__main__":
    problem = transport_problem(sv.load_scenario("panda-cube"))
    for force in (0.0, 0.1):
        draught = Draught(problem.contacts[0], force / problem.items[0].inertial.mass)
        print(f"{force} N: {fastest(replace(problem, extra=(draught,))).status}")
