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
    from salver.geometry import Array
    from salver.live import Live
    from salver.planning.fastest import FastestOptions
    from salver.planning.plan import Plan
    from salver.planning.round import MultiLegPlan
    from salver.reports.pages.inline import Page
    from salver.scenario import Scenario
    from salver.simulation.record import SimulationRecord
    from salver.simulation.round import RoundRecord

__version__ = "0.1.0"
__all__ = [
    "Live",
    "audit",
    "campaign",
    "fastest",
    "load_plan",
    "load_scenario",
    "plan",
    "plan_legs",
    "report",
    "retime",
    "simulate",
    "simulate_legs",
]


def load_scenario(name_or_path: str | Path, **changes: Any) -> Scenario:
    """Read a scenario, with keys changed.

    Args:
        name_or_path: name of a ready-made scenario, or path of a TOML file.
        changes: keys by their path, `__` between the parts: `motion__duration=1.5`, `objects__0__friction=0.4`.

    Returns:
        The checked Scenario.

    Raises:
        ScenarioError: one sentence for each mistake.

    Examples:
        >>> sv.load_scenario("panda-cube", motion__duration=1.5).motion.duration
        1.5
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

    Args:
        scenario: a Scenario, the name of a ready-made one, or the path of a TOML file.
        method: "fastest" (the shortest safe duration), "safest" (the largest worst-case margin in the scenario's
            duration), "least-sensitive" (eq 13 in that duration, within the arm's limits), "robust" (the paper's
            optimisation, eqs 13-17) or "baseline" (the straight min-jerk line). Default: the scenario's `plan.method`,
            else "safest" with a duration and "fastest" without.
        arm: follow the motion with the scenario's arm, if it has one.

    Returns:
        The Plan. If no safe motion was found, `ok` is False and `status` names the constraint, the time and the amount.

    Raises:
        ScenarioError: a mistake in the scenario.
        UnreachableError: no motion was found; the sentence says why.

    Examples:
        >>> sv.plan("panda-cube").ok
        True
    """
    from salver.planning.make import make_plan

    return make_plan(_scenario(scenario), method, arm)


def plan_legs(scenario: Scenario | str | Path, **options: Any) -> MultiLegPlan:
    """Plan a task of several legs (docs/howto/legs.md), as fast as is safe.

    Args:
        scenario: a Scenario with `legs`, the name of a ready-made one, or the path of a TOML file.
        options: fields of `salver.planning.fastest.FastestOptions`.

    Returns:
        A MultiLegPlan whose `legs` are plans, each with its own load.

    Raises:
        ScenarioError: a mistake in the scenario or an unknown option.
        UnreachableError: no motion was found; the sentence says why.

    Examples:
        >>> there, back = ({"goal": {"position": [0.444, y, 0.4]}} for y in (0.1, -0.1))
        >>> changes = {"motion__duration": None, "motion__goal": back["goal"]}
        >>> sv.plan_legs(sv.load_scenario("panda-cube", legs=[there, back], **changes), starts=1).ok
        True
    """
    from salver.planning.fastest.legs import plan_legs as run

    return run(_scenario(scenario), options=_options("plan_legs", options))


def fastest(scenario: Scenario | str | Path, *, robust: bool = True, **options: Any) -> Plan:
    """Plan the fastest motion of a scenario with an arm: the shortest duration at which every constraint holds.

    Args:
        scenario: a Scenario, the name of a ready-made one, or the path of a TOML file.
        robust: plan for the whole uncertain set; False: for the nominal parameters.
        options: fields of `salver.planning.fastest.FastestOptions`, such as `time_limit=10, starts=4`.

    Returns:
        The Plan.

    Raises:
        ScenarioError: a mistake in the scenario or an unknown option.
        UnreachableError: no motion was found; the sentence says why.

    Examples:
        >>> sv.fastest("panda-cube").duration < 1.0
        True
    """
    from salver.planning.fastest import plan_fastest

    chosen = _options("fastest", options)
    given = _scenario(scenario).with_changes(motion__duration=None)
    return plan_fastest(given, robust=robust, options=chosen)


def _options(name: str, options: Mapping[str, Any]) -> FastestOptions:
    """The FastestOptions with these fields. Raises ScenarioError for an unknown field; `name` is the function's."""
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
    """Plan the fastest safe timing of a given path (`salver.planning.fastest.retiming`).

    Args:
        path: postures (K, n) in rad; a file of postures or of a motion (CSV, JSON, YAML, ROS bag); or a plan or its
            run directory.
        scenario: the scenario with the load; default: the plan's own.
        robust: plan for the whole uncertain set; False: for the nominal parameters.

    Returns:
        The Plan.

    Raises:
        ScenarioError: a mistake in the scenario, or no scenario.
        FileFormatError: the file cannot be read.
        UnreachableError: no safe timing was found; the sentence says why.

    Examples:
        >>> sv.retime(sv.plan("panda-cube")).duration < 2.5
        True
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
    units: str | None = None,
    highest: float = 50.0,
    noise: float | None = None,
    gap: float | None = None,
) -> Audit:
    """Judge an existing motion, of the tray or of the arm's joints: does the load stay?

    Args:
        motion: a CSV, JSON or YAML file or a ROS bag (docs/howto/audit.md); or columns by the same names, in a mapping
            of arrays or a pandas DataFrame.
        scenario: the scenario with the load.
        topic: the topic to read, for a bag with several.
        units: units of a table or of columns other than rad, m and s: "deg,mm,ms", or some of these.
        highest: Hz, the highest frequency at which the tray is assumed to move or vibrate.
        noise: standard deviation of the samples, m or rad; estimated if None.
        gap: s, the longest gap between samples that is interpolated.

    Returns:
        The Audit, with the verdict for the nominal load and for the worst case of the ranges.

    Raises:
        SalverError: one sentence for each mistake.

    Examples:
        >>> line = sv.plan("panda-cube", "baseline").joint
        >>> sv.audit({"t": line.t} | {f"q{k + 1}": q for k, q in enumerate(line.q.T)}, "panda-cube").ok
        True
    """
    from salver.auditing import AuditOptions
    from salver.auditing import audit as run
    from salver.errors import ScenarioError
    from salver.planning.plan import Plan

    if isinstance(motion, Plan):
        raise ScenarioError("audit is for motions that salver did not plan; a Plan knows its own: plan.margins.")
    return run(motion, _scenario(scenario), topic, AuditOptions(highest, noise, gap), units)


def load_plan(directory: str | Path, stem: str = "plan") -> Plan:
    """Read a plan of a run directory.

    Args:
        directory: a run directory, as `salver plan` and `Plan.save` write it.
        stem: name of the plan: "plan", "baseline", "nominal" or "leg1".

    Returns:
        The Plan.

    Raises:
        FileFormatError: no such plan, or a file that was changed.
        ScenarioError: a mistake in its scenario.

    Examples:
        >>> directory = sv.plan("panda-cube").save("runs/cube")
        >>> sv.load_plan(directory).duration
        2.5
    """
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
    """Run a plan in the physics engine (`salver.simulation.physics.simulate`).

    Args:
        plan: a Plan; or, with a scenario, a motion as `audit` takes it, along which the tray moves exactly.
        scenario: the scenario with the load, for a motion that is not a Plan.
        parameters: true values by name, in SI units, such as {"mass": 0.3, "com_z": 0.005}; the others are nominal.
        seed: seed of the sensor noise.
        stop_at: s, when a stop is requested; the plan must have stops.

    Returns:
        The SimulationRecord; `outcome` is "holds", "slides", "tips", "lifts", "lost", "spills" or "limit".

    Raises:
        ScenarioError: an unknown parameter, or a value that no object can have.

    Examples:
        >>> sv.simulate(sv.plan("panda-cube"), parameters={"mass": 0.27}).summary["outcome"]
        'holds'
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
    """Run a plan of several legs in the physics engine; objects begin each leg where the leg before left them.

    Args:
        plan: what `plan_legs` returned.
        parameters: true values by name, in SI units, such as {"glass1.mass": 0.3}; the others are nominal.
        seed: seed of the sensor noise.
        stop_at: s, motion time from the start of the first leg, when a stop is requested, which ends the run.

    Returns:
        The RoundRecord; its `legs` are the records of the legs that were run.

    Raises:
        ScenarioError: an unknown parameter, or a value that no object can have.

    Examples:
        >>> there, back = ({"goal": {"position": [0.444, y, 0.4]}} for y in (0.1, -0.1))
        >>> changes = {"motion__duration": None, "motion__goal": back["goal"]}
        >>> plan = sv.plan_legs(sv.load_scenario("panda-cube", legs=[there, back], **changes), starts=1)
        >>> sv.simulate_legs(plan).outcome
        'holds'
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
    jobs: int | None = None,
    stops: bool = False,
) -> Campaign:
    """Run each plan of a run directory n times with perturbed parameters, all plans on the same samples.

    An interrupted campaign resumes. In a script, call it below `if __name__ == "__main__":`, because it starts
    processes.

    Args:
        directory: a run directory, such as `plan.save("runs/cube")` returns.
        n: runs of each plan.
        seed: seed of the samples.
        method: how the uncertain set is sampled: "uniform" or "corners" (extremes first).
        stems: names of the plans to run; default: the first two of "plan", "baseline" and "nominal" that exist.
        jobs: processes; default: one for each core.
        stops: stop each run at a random instant by the plan's own stops (`salver plan --stops`).

    Returns:
        The Campaign.

    Raises:
        SalverError: one sentence for each mistake.

    Examples:
        >>> sv.campaign(sv.plan("panda-cube").save("runs/campaign"), n=2, jobs=1)
        <Campaign panda-cube, plan holds 2 of 2>
    """
    if not isinstance(directory, str | Path) or not Path(directory).exists():
        raise _no_plan("campaign", directory)
    from salver.campaigns import run_campaign

    return run_campaign(directory, n, seed, method, stems, jobs, stops=stops)


def report(
    of: Plan | Audit | str | Path, run: SimulationRecord | None = None, *, path: str | Path | None = None
) -> Page:
    """Make the page with its 3-D replay; a notebook shows it.

    Args:
        of: a run directory, a Plan or an Audit.
        run: a simulated run of the Plan, for the replay.
        path: where the page is written; default: DIR/report.html for a run directory, nowhere for a Plan or an Audit.

    Returns:
        The Page.

    Raises:
        SalverError: one sentence for each mistake.

    Examples:
        >>> sv.report(sv.plan("panda-cube"), path="cube.html").path.name
        'cube.html'
    """
    from salver.auditing import Audit
    from salver.errors import ScenarioError
    from salver.planning.plan import Plan
    from salver.reports.pages.inline import page_of

    if not isinstance(of, Plan | Audit | str | Path):
        raise ScenarioError(f"report wants a Plan, an Audit or a run directory; it was given a {type(of).__name__}.")
    if isinstance(of, str | Path) and not Path(of).exists():
        raise _no_plan("report", of)
    return page_of(of, run, path)


def _no_plan(name: str, given: object) -> Exception:
    """The sentence for a function that needs a plan and got something else."""
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
    """The public names."""
    return sorted(["__version__", *__all__])
