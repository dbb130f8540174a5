"""The perturbed runs behind Figs 5, 6 and 8: closed loops of other bodies than the planned one."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from salver import sampling
from salver.control.object import Gains
from salver.errors import SalverError
from salver.geometry import Array
from salver.models.uncertain.parameters import Parameter
from salver.simulation.closed_loop import Coverage, Rollout, coverage, rollout

if TYPE_CHECKING:
    from salver.planning.plan import Plan
    from salver.reports.run import ReportedRun
    from salver.simulation.record import SimulationRecord

MOST_GIGABYTES = 2.0
EXTRA_MASS = 0.05  # kg, of the paper's Fig. 8 (b)


@dataclass(frozen=True)
class Perturbed:
    """n rollouts of one motion without an engine, and how they lie in its tubes."""

    rollout: Rollout
    coverage: Coverage


def perturbed_rollouts(run: ReportedRun, stem: str, n: int, seed: int) -> Perturbed:
    """n bodies drawn from the uncertain set (the same for every motion) under eqs (18), (19) along one motion."""
    from salver.planning.plan import load_plan

    plan = load_plan(run.directory, stem)
    gigabytes = 3 * 8e-9 * n * len(plan.t) * (12 + plan.cone_coefficients.shape[1])
    if gigabytes > MOST_GIGABYTES:
        raise SalverError(
            f"{n} perturbed bodies at {len(plan.t)} instants take {gigabytes:.0f} GB; at most "
            f"{int(n * MOST_GIGABYTES / gigabytes)} of them fit into {MOST_GIGABYTES:g} GB."
        )
    payload = run.scenario.payload
    body = payload.first
    phi = payload.phi(body, sampling.draw(payload.uncertain, n, seed, "corners", payload.bodies))
    gains = Gains(run.scenario.control.kp, run.scenario.control.kd)
    made = rollout(plan.reference, body.inertial, body.contacts.grasp_map, gains, phi, plan.t)
    names = [f"coefficient {i + 1}" for i in range(plan.cone_coefficients.shape[1])]
    return Perturbed(made, coverage(plan.t, made.cone_coefficients, plan.cone_coefficients, plan.cone_radius, names))


def heavier(plan: Plan, extra: float = EXTRA_MASS) -> SimulationRecord:
    """The plan in the physics engine with its first object heavier by `extra` kg."""
    from salver.simulation.physics import simulate

    item = plan.scenario.objects[0]
    mass = Parameter(item.name, "mass", lone=len(plan.scenario.objects) == 1)
    return simulate(plan, parameters={mass.name: item.mass + extra})


def envelope(coefficients: Array, radius: Array) -> tuple[Array, Array]:
    """Least and largest value (T,) of all tubes together."""
    return (coefficients - radius).min(axis=1), (coefficients + radius).max(axis=1)
