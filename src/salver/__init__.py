"""salver: carry loose objects on a tray, fast and without dropping them, when their parameters are uncertain.

    import salver as sv

    plan = sv.plan("panda-cube")      # a ready-made scenario, a .toml file, or a Scenario
    print(plan.verify().sentence)     # contact condition and its tube, between the planner's nodes too
    run = sv.simulate(plan)           # whole arm, tray and loose object in a physics engine
    print(run.summary["outcome"])
    sv.report(plan, run)              # the page with its replay; shown in a notebook

Heavy parts (CasADi, MuJoCo, Pinocchio) are loaded when a function first needs them.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from salver.auditing import Audit
    from salver.campaigns import Campaign
    from salver.contact_margins import Margins
    from salver.geometry import Array
    from salver.live import Live
    from salver.planning.fastest import FastestOptions
    from salver.planning.plan import Plan
    from salver.planning.round import MultiLegPlan
    from salver.reports.inline import Page
    from salver.scenario import Scenario
    from salver.simulation.record import SimulationRecord
    from salver.simulation.round import RoundRecord
    from salver.trajectory import MotionSamples

__version__ = "0.1.0"
__all__ = [
    "Live",
    "audit",
    "campaign",
    "fastest",
    "load_plan",
    "load_scenario",
    "margins",
    "plan",
    "plan_legs",
    "report",
    "retime",
    "simulate",
    "simulate_legs",
]


def load_scenario(name_or_path: str | Path, **changes: Any) -> Scenario:
    """A ready-made scenario by name or a TOML file by path, with keys changed: `motion__duration=1.5`.

    Raises ScenarioError with one sentence for each mistake.
    """
    from salver.scenario import load

    scenario = load(name_or_path)
    return scenario.with_changes(**changes) if changes else scenario


def _scenario(given: Scenario | str | Path) -> Scenario:
    from salver.errors import ScenarioError
    from salver.scenario import Scenario, load

    if isinstance(given, Scenario):
        return given
    if not isinstance(given, str | Path):
        raise ScenarioError(
            f"A {type(given).__name__} was given for a scenario; it must be the name of a ready-made one, the path of "
            "a .toml file, or a Scenario."
        )
    return load(given)


def plan(scenario: Scenario | str | Path, method: str | None = None, *, arm: bool = True) -> Plan:
    """Plan a motion that keeps the objects on the tray.

    method: "robust" (the paper's optimisation, eqs 13-17), "baseline" (straight min-jerk line), "fastest" (the
    shortest safe duration; also what "robust" means for a scenario without one), "safest" (the largest worst-case
    margin in the scenario's duration) or "least-sensitive" (eq 13 in that duration, within the arm's limits); by
    default the scenario's `plan.method`, else "safest" where it has a duration and "fastest" where it has none. arm:
    follow it with the scenario's arm, when it has one. Infeasible problems give a plan whose `ok` is False and whose
    `status` says which constraint fails, when and by how much. Raises ScenarioError for mistakes in the scenario.
    """
    from salver.planning.make import make_plan

    return make_plan(_scenario(scenario), method, arm)


def plan_legs(scenario: Scenario | str | Path, *, safest: bool = False, **options: Any) -> MultiLegPlan:
    """The fastest plan of a task of several legs (docs/howto/legs.md): its `legs` are plans, each with its own load.

    safest: the safest one in its duration instead. options: as `fastest`. Raises ScenarioError, UnreachableError.
    """
    from salver.planning.fastest.legs import plan_legs as run
    from salver.planning.fastest.safest import plan_safest_legs

    return (plan_safest_legs if safest else run)(_scenario(scenario), options=_options("plan_legs", options))


def fastest(scenario: Scenario | str | Path, *, robust: bool = True, **options: Any) -> Plan:
    """The fastest plan of a scenario with an arm: the shortest duration at which everything is kept.

    robust: for the whole uncertain set, or for nominal parameters only. options: those of
    `salver.planning.fastest.FastestOptions`, as `time_limit=10, starts=4`. Raises ScenarioError, UnreachableError.
    """
    from salver.planning.fastest import plan_fastest

    chosen = _options("fastest", options)
    given = _scenario(scenario).with_changes(motion__duration=None)
    return plan_fastest(given, robust=robust, options=chosen)


def _options(name: str, options: Mapping[str, Any]) -> FastestOptions:
    """Those of a search. Raises ScenarioError for one that there is not."""
    from dataclasses import fields

    from salver.errors import ScenarioError
    from salver.planning.fastest import FastestOptions

    known = [field.name for field in fields(FastestOptions)]
    unknown = next((key for key in options if key not in known), None)
    if unknown is not None:
        raise ScenarioError(f'{name} has no option "{unknown}"; it has {", ".join(known)}.')
    return FastestOptions(**options)


def retime(
    path: Plan | str | Path | Array, scenario: Scenario | str | Path | None = None, *, robust: bool = True
) -> Plan:
    """The fastest safe timing of a path that is given; see `salver.planning.fastest.retiming`.

    path: postures (K, n) in rad, a file of them or of a motion (CSV, JSON, YAML, ROS bag), or a plan or its run
    directory, whose scenario is then the default.
    Raises ScenarioError, FileFormatError, UnreachableError.
    """
    from salver.errors import ScenarioError
    from salver.planning.fastest.retiming import plan_retimed
    from salver.planning.plan import Plan

    if isinstance(path, Plan):
        from salver.given import waypoints_of

        scenario = path.scenario if scenario is None else scenario
        path = waypoints_of(path)
    if isinstance(path, str | Path) and scenario is None and Path(path).is_dir():
        scenario = Path(path) / "scenario.toml"
    if scenario is None:
        raise ScenarioError("A path alone does not say what is carried; name a scenario too.")
    chosen = _scenario(scenario)
    if isinstance(path, str | Path):
        from salver.given import read_waypoints

        path = read_waypoints(Path(path), chosen)
    return plan_retimed(chosen, path, robust=robust)


def audit(
    motion: str | Path | Mapping[str, Any],
    scenario: Scenario | str | Path,
    *,
    topic: str | None = None,
    highest: float = 50.0,
    noise: float | None = None,
    gap: float | None = None,
) -> Audit:
    """Will it slip? The verdict on a motion that exists already, of the tray or of the arm's joints.

    motion: a CSV, JSON or YAML file or a ROS bag (docs/howto/audit.md); or columns by the same names, in a mapping of
    arrays or a pandas DataFrame. topic: of a bag. highest: Hz, above which
    nothing shakes the tray. noise: standard deviation of the samples, m or rad; found in them if None. gap: s without
    samples that is bridged. Raises SalverError with one sentence for each mistake.
    """
    from salver.auditing import audit as run
    from salver.errors import ScenarioError
    from salver.planning.plan import Plan

    if isinstance(motion, Plan):
        raise ScenarioError("audit is for motions that salver did not plan; a Plan knows its own: sv.margins(plan).")
    return run(motion, _scenario(scenario), topic, highest, noise, gap)


def load_plan(directory: str | Path, stem: str = "plan") -> Plan:
    """Read a plan of a run directory ("plan" or "baseline"). Raises FileFormatError or ScenarioError."""
    from salver.planning.plan import load_plan as load

    return load(directory, stem)


def simulate(
    plan: Plan | str | Path | Mapping[str, Any],
    scenario: Scenario | str | Path | None = None,
    *,
    parameters: Mapping[str, float] | None = None,
    seed: int = 0,
    stop_at: float | None = None,
) -> SimulationRecord:
    """Run a plan in the physics engine; see `salver.simulation.physics.simulate`.

    With a scenario: a motion file, or its columns, as `audit` takes it; the tray is then moved exactly, without an arm.
    parameters: true values by name where they are not nominal, for example {"mass": 0.3}. stop_at: s, when a stop is
    asked for, of a plan with stops. Raises ScenarioError.
    """
    from salver.errors import ScenarioError
    from salver.planning.plan import Plan

    if scenario is not None and isinstance(plan, Plan):
        raise ScenarioError(
            "A plan has a scenario of its own; leave it out. True values are given as parameters={...}."
        )
    if scenario is not None and not isinstance(plan, Plan):
        from salver.auditing import read_for
        from salver.given import simulate_given

        chosen = _scenario(scenario)
        return simulate_given(read_for(chosen, plan), chosen, parameters)
    if not isinstance(plan, Plan):
        raise _no_plan("simulate", plan)
    from salver.simulation.physics import simulate as run

    return run(plan, parameters=parameters, seed=seed, stop_at=stop_at)


def simulate_legs(
    plan: MultiLegPlan, *, parameters: Mapping[str, float] | None = None, seed: int = 0, stop_at: float | None = None
) -> RoundRecord:
    """Run a plan of several legs in the physics engine; what stays on the tray begins each leg where it was left.

    parameters: true values by name where they are not nominal, for example {"glass1.mass": 0.3}. stop_at: s of all
    motions together at which a stop is asked for, which ends the run; of legs that have stops. Raises ScenarioError.
    """
    from salver.simulation.round import simulate_round

    return simulate_round(plan, parameters=parameters, seed=seed, stop_at=stop_at)


def campaign(
    directory: str | Path,
    n: int = 100,
    *,
    seed: int = 0,
    method: str = "uniform",
    stems: Sequence[str] | None = None,
    engine: str = "physics",
    jobs: int | None = None,
    stops: bool = False,
) -> Campaign:
    """n perturbed runs of each plan of a run directory, on the same samples; goes on where an earlier one stopped.

    A plan that was just made: `sv.campaign(plan.save("runs/cube"))`. method: how the uncertain set is sampled
    ("uniform", "corners", "lhs", "sobol"). stems: plans to run (default: plan and what it is compared with). engine:
    "physics" or "closed-loop". jobs: processes (default: all cores); in a script, call it below
    `if __name__ == "__main__":`, as Python asks of whatever starts processes. stops: stop each run at a random instant
    by the plan's own stops, of plans made with `salver plan --stops`. Raises SalverError.
    """
    if not isinstance(directory, str | Path) or not Path(directory).exists():
        raise _no_plan("campaign", directory)
    from salver.campaigns import run_campaign

    return run_campaign(directory, n, seed, method, stems, engine, jobs, stops=stops)


def margins(motion: Plan | MotionSamples, scenario: Scenario | str | Path | None = None) -> Margins:
    """Every margin along a plan, or along a motion of the first object's frame B for what a scenario carries.

    See `salver.contact_margins`. Raises ScenarioError.
    """
    from salver.errors import ScenarioError
    from salver.planning.plan import Plan

    if isinstance(motion, Plan):
        return motion.margins
    from salver.contact_margins import margins as of
    from salver.trajectory import MotionSamples

    if isinstance(motion, str | Path):
        raise _no_plan("margins", motion)
    if not isinstance(motion, MotionSamples) or scenario is None:
        raise ScenarioError(
            f"margins wants a Plan, or MotionSamples and a scenario; it was given a {type(motion).__name__}"
            f"{' alone' if scenario is None else ''}."
        )
    return of(_scenario(scenario), motion)


def report(
    of: Plan | Audit | str | Path, run: SimulationRecord | None = None, *, path: str | Path | None = None
) -> Page:
    """The page with its 3-D replay; shown in a notebook, written to a file.

    of: a run directory (written to DIR/report.html unless `path` says where), or a plan, with a run of it, or an audit
    (written when there is a `path`). Raises SalverError.
    """
    from salver.auditing import Audit
    from salver.errors import ScenarioError
    from salver.planning.plan import Plan
    from salver.reports.inline import page_of

    if not isinstance(of, Plan | Audit | str | Path):
        raise ScenarioError(f"report wants a Plan, an Audit or a run directory; it was given a {type(of).__name__}.")
    if isinstance(of, str | Path) and not Path(of).exists():
        raise _no_plan("report", of)
    return page_of(of, run, path)


def _no_plan(name: str, given: object) -> Exception:
    """What a function says that wants a plan, or where one is."""
    from salver.errors import ScenarioError
    from salver.planning.plan import Plan

    named = isinstance(given, str | Path)
    what = f'"{given}"' if named else f"a {type(given).__name__}"
    made = f"sv.load_plan({what})" if Path(str(given)).is_dir() else f"sv.plan({what if named else '...'})"
    if name == "campaign":
        saved = f"{'plan' if isinstance(given, Plan) else made}.save(DIRECTORY)"
        return ScenarioError(f"campaign wants a run directory, such as {saved} gives; it was given {what}.")
    hint = f": sv.{name}({made})" if named else ", as sv.plan makes it"
    return ScenarioError(f"{name} wants a plan{hint}; it was given {what}.")


def __getattr__(name: str) -> Any:
    if name == "Live":  # a class, with all that it needs
        from salver.live import Live

        return Live
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    """What is public."""
    return sorted(["__version__", *__all__])
