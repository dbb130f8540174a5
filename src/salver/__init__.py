"""salver: carry loose objects on a tray, fast and without dropping them, when their parameters are uncertain.

    import salver as sv

    plan = sv.plan("panda-cube")      # a ready-made scenario, a .toml file, or a Scenario
    print(plan.verify().sentence)     # contact condition and its tube, between the planner's nodes too
    run = sv.simulate(plan)           # whole arm, tray and loose object in a physics engine
    print(run.summary["outcome"])

Heavy parts (CasADi, MuJoCo, Pinocchio) are loaded when a function first needs them.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from salver.planning.plan import Plan
    from salver.scenario import Scenario
    from salver.simulation.record import SimulationRecord

__version__ = "0.1.0"
__all__ = ["load_plan", "load_scenario", "plan", "simulate"]


def load_scenario(name_or_path: str | Path, **changes: Any) -> Scenario:
    """A ready-made scenario by name or a TOML file by path, with keys changed: `motion__duration=1.5`.

    Raises ScenarioError with one sentence for each mistake.
    """
    from salver.scenario import load

    scenario = load(name_or_path)
    return scenario.with_changes(**changes) if changes else scenario


def plan(scenario: Scenario | str | Path, method: str = "robust", *, arm: bool = True) -> Plan:
    """Plan a motion that keeps the objects on the tray.

    method: "robust" (the paper's optimisation, eqs 13-17), "baseline" (straight min-jerk line) or "fastest" (the
    shortest safe duration; also what "robust" means for a scenario without a duration). arm: follow it with the
    scenario's arm, when it has one. Infeasible problems give a plan whose `ok` is False and whose `status` says
    which constraint fails, when and by how much. Raises ScenarioError for mistakes in the scenario.
    """
    from salver.planning.make import make_plan
    from salver.scenario import Scenario, load

    return make_plan(scenario if isinstance(scenario, Scenario) else load(scenario), method, arm)


def load_plan(directory: str | Path, stem: str = "plan") -> Plan:
    """Read a plan of a run directory ("plan" or "baseline"). Raises FileFormatError or ScenarioError."""
    from salver.planning.plan import load_plan as load

    return load(directory, stem)


def simulate(plan: Plan, *, parameters: Mapping[str, float] | None = None, seed: int = 0) -> SimulationRecord:
    """Run a plan in the physics engine; see `salver.simulation.physics.simulate`.

    parameters: true values by name where they are not nominal, for example {"mass": 0.3}.
    """
    from salver.simulation.physics import simulate as run

    return run(plan, parameters=parameters, seed=seed)
