"""`salver simulate`: one run in the physics engine."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from salver.cli.checks.audit import OnTray, Topic, Units
from salver.cli.common import Json, headed, named_numbers, of_a_run, print_json, print_table, result_console, say
from salver.errors import ScenarioError

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from salver.planning.plan import Plan
    from salver.planning.round import MultiLegPlan
    from salver.scenario import Scenario
    from salver.simulation.record import SimulationRecord


def simulate(
    directory: Annotated[
        Path, typer.Argument(help="Run directory that `salver plan` made; or a motion file, with --scenario.")
    ],
    stem: Annotated[
        str,
        typer.Option(
            "--plan",
            help="Which plan: plan, baseline, nominal, or both; for a plan of several legs, leg1, leg2 and so on, or "
            "plan: all legs, one after the other.",
        ),
    ] = "plan",
    set_: Annotated[
        list[str] | None,
        typer.Option("--set", help="True value of a parameter, as mass=0.3 (SI units); repeat for several."),
    ] = None,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the sensor noise.")] = 0,
    run: Annotated[
        int | None, typer.Option(help="Repeat run number K of the directory's campaign: its parameters and its seed.")
    ] = None,
    folder: Annotated[str, typer.Option(help="Folder of that campaign in DIRECTORY.")] = "campaign",
    stop_at: Annotated[
        float | None, typer.Option(help="Request a stop at this time, s; the plan needs stops (salver plan --stops).")
    ] = None,
    speed: Annotated[
        float, typer.Option(help="Run the plan at this constant share of its speed, above 0 and at most 1.")
    ] = 1.0,
    scenario: OnTray = None,
    topic: Topic = None,
    units: Units = None,
    write: Annotated[
        Path | None,
        typer.Option(
            help="Write the executed motion of arm, tray and first object to this motion file; its ending gives the "
            "format (.csv, .yaml; none: ROS bag)."
        ),
    ] = None,
    json: Json = False,
) -> None:
    """Run a plan once in the physics engine: arm, tray, loose objects, contact.

    Prints whether each object held, slid, tipped or left the tray, how near the arm came to its limits, and how far the
    measured contact forces are from the plan's tube. Without an arm in the scenario, the tray is moved exactly.
    Writes DIRECTORY/simulation/PLAN.npz (time histories) and .json (summary); earlier runs are kept as PLAN-1, PLAN-2.
    A run with a stop is PLAN-stop, a run at another speed PLAN-slow; the page does not count them as runs of the plan.
    A run with a value outside the plan's range is PLAN-what-if: the page shows it separately, with that range.

    The legs of a task are run one after the other: an object that stays on the tray begins a leg at the position to
    which it slid on the leg before. The runs are written as leg1, leg2 and so on.

    For a motion file (CSV, JSON, YAML, ROS bag) the tray is moved exactly along the motion, as `salver audit` reads it,
    without an arm; a file is written only with --write.

    Example: `salver simulate runs/panda-cube --plan both --set mass=0.306`

    Ends with 0 when the run was made, whatever its outcome.
    """
    from salver.motion_files import form_of
    from salver.planning.round import has_legs
    from salver.run_directory import STEMS, leg_number

    if stem not in (*STEMS, "both") and leg_number(stem) is None:
        raise ScenarioError(f'--plan = "{stem}"; it must be {", ".join(STEMS)} or both; or leg1, leg2, ...')
    if scenario is None:
        of_a_run(directory)
        if topic is not None or units is not None:
            raise ScenarioError("--topic and --units are for motion files; give --scenario with one.")
    true = named_numbers(set_ or [], "--set", "mass=0.3")
    asked = _Asked(directory, stem, true, seed, run, folder, stop_at, write, speed)
    if speed != 1.0 and (scenario is not None or run is not None or stop_at is not None):
        raise ScenarioError("--speed is for a run of a plan; leave out --scenario, --run and --stop-at.")
    if run is not None:
        asked = _repeated(asked)
    if write is not None:
        form_of(write)  # raises before anything is computed
        if stem == "both" and scenario is None:
            raise ScenarioError("--write is for one run; name its plan with --plan.")
    if scenario is not None:
        results = _motion(asked, scenario, topic, units)
    elif stem in ("plan", "both") and has_legs(directory):
        _legs(asked, json)
        return
    else:
        results = _plans(asked)
    if json:
        found = {name: {"parameters": record.parameters, **record.summary} for name, record in results.items()}
        print_json(found if scenario is None else found[directory.name])
    else:
        show(results)
        if scenario is None:
            say(f"Written to {directory / 'simulation'}.")


@dataclass(frozen=True)
class _Asked:
    """Options of the runs. run: number in the campaign of `folder`, or None."""

    directory: Path
    stem: str
    parameters: dict[str, float]
    seed: int
    run: int | None
    folder: str
    stop_at: float | None
    write: Path | None
    speed: float = 1.0

    def stop(self, plan: Plan | MultiLegPlan) -> float | None:
        """Time of the stop request in a run of a plan, s, or None."""
        from salver.campaigns import read_definition

        if self.run is None:
            return self.stop_at
        return read_definition(self.directory, self.folder).stop_at(self.run, plan.duration)


def _repeated(asked: _Asked) -> _Asked:
    """Options with the parameters and the seed of a campaign's run."""
    from salver.campaigns import parameters_of_run, read_definition

    if asked.parameters:
        raise ScenarioError("--run takes its parameters from the campaign; leave out --set.")
    assert asked.run is not None
    parameters, seed = parameters_of_run(asked.directory, asked.run, asked.folder)
    if asked.stop_at is not None and read_definition(asked.directory, asked.folder).stops:
        raise ScenarioError("--run of a campaign with stops has its own time of the stop; leave out --stop-at.")
    return replace(asked, parameters=parameters, seed=seed)


def _plans(asked: _Asked) -> dict[str, SimulationRecord]:
    """One run of each plan, by stem."""
    from salver.planning.plan import load_plan
    from salver.planning.round import has_legs
    from salver.run_directory import STEMS
    from salver.simulation.physics import simulate as run_physics

    directory = asked.directory
    if asked.run is not None and has_legs(directory):
        raise ScenarioError("--run repeats a run of all legs; leave out --plan.")
    both = [name for name in STEMS if (directory / f"{name}.npz").is_file()] or STEMS[:1]
    results: dict[str, SimulationRecord] = {}
    for name in both if asked.stem == "both" else (asked.stem,):
        plan = load_plan(directory, name)
        _warn(plan, name)
        stop_at = asked.stop(plan)
        moved = plan if asked.speed == 1.0 else plan.at_speed(asked.speed)
        record = results[name] = run_physics(moved, parameters=asked.parameters, seed=asked.seed, stop_at=stop_at)
        record.save(directory, name, "-stop" if stop_at is not None else "" if moved is plan else "-slow")
        if asked.write is not None:
            _write([record], plan.scenario, asked.write, plan.verdict)
    return results


def _legs(asked: _Asked, json: bool) -> None:
    """All legs in the engine, one after the other."""
    from salver.planning.round import load_round
    from salver.simulation.round import simulate_round

    directory = asked.directory
    plan = load_round(directory)
    if asked.speed != 1.0:
        plan = replace(plan, legs=tuple(leg.at_speed(asked.speed) for leg in plan.legs))
    for k, leg in enumerate(plan.legs, 1):
        _warn(leg, f"leg{k}")
    record = simulate_round(plan, parameters=asked.parameters, seed=asked.seed, stop_at=asked.stop(plan))
    record.save(directory, "" if asked.speed == 1.0 else "-slow")
    if asked.write is not None:
        _write(record.legs, plan.scenario, asked.write, plan.verdict)
    if json:
        print_json({"plan": {"parameters": record.parameters, **record.summary}})
        return
    show({f"leg {k}": leg for k, leg in enumerate(record.legs, 1)}, record.parameters)
    if "stop_at" in record.summary:
        say(f"Stopped on leg {len(record.legs)}, which ends the run.")
    elif len(record.legs) < len(plan.legs):
        say(f"salver: leg {len(record.legs) + 1} was not run, because the load was lost on the leg before it.")
    say(f"Written to {directory / 'simulation'}.")


def _write(records: Sequence[SimulationRecord], scenario: Scenario, path: Path, verdict: str) -> None:
    """Write the executed motion of all legs as a motion file, marked if the motion is unsafe or the load was lost."""
    from salver.motion_files import MotionSeries, write
    from salver.motion_files.verdict import UNSAFE, one_line

    first = records[0]
    arm = None if scenario.arm is None or not first.q.shape[1] else scenario.load_arm()
    if not verdict.startswith(UNSAFE):
        lost = [sentence for record in records if record.outcome != "holds" for sentence in sentences(record)]
        verdict = one_line(f"{UNSAFE}: {' '.join(lost)}") if lost else ""
    parts = [record.motion(arm.joint_names if arm else ()) for record in records]
    step = float(first.t[1] - first.t[0])
    motion = MotionSeries.in_turn(parts, 0.0, step) if len(parts) > 1 else parts[0]
    motion = replace(motion, verdict=verdict)
    for file in write(motion, path, unsafe=True):
        say(f"Wrote {file}")


def _motion(asked: _Asked, scenario: str, topic: str | None, units: str | None) -> dict[str, SimulationRecord]:
    """Run a motion file in the engine."""
    from salver import scenario as scenarios
    from salver.auditing import read_for
    from salver.given import simulate_given

    if asked.run is not None or asked.stop_at is not None or asked.stem != "plan":
        raise ScenarioError("--run, --stop-at and --plan are for run directories, not for a motion file.")
    chosen, path = scenarios.load(scenario), asked.directory
    samples = read_for(chosen, path, topic, units=units)
    record = simulate_given(samples, chosen, asked.parameters)
    if asked.write is not None:
        _write([record], chosen, asked.write, samples.verdict)
    return {path.name: record}


def _warn(plan: Plan, stem: str) -> None:
    if plan.arm_status is not None and not plan.arm_status.ok and plan.joint is not None:
        say(f"salver: {stem}: {plan.arm_status.sentence}")


def show(results: dict[str, SimulationRecord], parameters: Mapping[str, float] | None = None) -> None:
    """Print runs side by side. parameters: true values of all runs; default: those of the first record."""
    console = result_console()
    true = next(iter(results.values())).parameters if parameters is None else parameters
    drawn = ", ".join(f"{name} = {value:.6g}" for name, value in true.items())
    console.print(f"True parameters (SI units): {drawn or 'nominal'}")
    for name, ends in next(iter(results.values())).summary.get("outside", {}).items():
        known = (
            f" is outside its range, {ends[0]:.4g} to {ends[1]:.4g}" if ends else ", which the plan assumes to be exact"
        )
        console.print(f"What if: {name} = {true[name]:.6g}{known}; this run is no evidence about the plan.")
    several = any(len(record.object_names) > 1 for record in results.values())
    columns = [_lines(record, several) for record in results.values()]
    labels = dict.fromkeys(label for column in columns for label in column)
    print_table(["", *results], ([label, *(column.get(label, "") for column in columns)] for label in labels))
    for name, record in results.items():
        for sentence in sentences(record):
            console.print(headed(name, sentence))


def _lines(record: SimulationRecord, several: bool) -> dict[str, str]:
    summary = record.summary
    lines = {"duration": f"{summary['duration']:.3f} s"}
    for item in summary["objects"]:
        name = f"{item['name']}: " if several else ""
        lines[f"{name}outcome"] = item["outcome"]
        lines[f"{name}slip, peak / final"] = f"{1e3 * item['peak_slip']:.3f} / {_millimetres(item['final_slip'])} mm"
        for peak, label in (("peak_wave", "liquid, peak / brim"), ("peak_swing", "swing, peak / room")):
            if peak in item:
                lines[f"{name}{label}"] = f"{1e3 * item[peak]:.1f} / {_millimetres(item['room'], 1)} mm"
        lines[f"{name}lift, tip"] = f"{1e3 * item['peak_lift']:.2f} mm, {57.29578 * item['peak_tip_angle']:.2f} deg"
        lines[f"{name}without contact for"] = f"{1e3 * item['contact_lost']:.0f} ms"
    lines["object off its reference, peak"] = _pose(summary["e_p_peak"], summary["e_o_peak"])
    lines["tray off its reference, peak"] = _pose(summary["tray_e_p_peak"], summary["tray_e_o_peak"])
    lines["least measured cone coefficient"] = f"{1e3 * summary['cone_coefficient_min']:.1f} mN"
    if (beyond := summary.get("tube", {}).get("excess")) is not None:
        lines["... most outside the plan's tube"] = f"{1e3 * max(0.0, beyond):.1f} mN"
    if "arm" in summary:
        arm = summary["arm"]
        lines["torque, speed of their limits"] = (
            f"{100 * arm['torque_share_peak']:.0f} %, {100 * arm['velocity_share_peak']:.0f} %"
        )
    return lines


def _millimetres(value: float | None, digits: int = 3) -> str:
    return "-" if value is None else f"{1e3 * value:.{digits}f}"


def _pose(position: float, angle: float) -> str:
    return f"{1e3 * position:.3f} mm, {1e3 * angle:.2f} mrad"


def sentences(record: SimulationRecord) -> list[str]:
    """Sentences about the outcome of a run."""
    from salver.models.arm.arm import STAND_IN
    from salver.wording import listed

    summary: Any = record.summary
    found = []
    for item in summary["objects"]:
        found.append(_fate(item, summary))
    if summary["collides_at"] is not None:
        found.append(f"Tray or object hits an obstacle at t = {_time(summary['collides_at'])}.")
    arm = summary.get("arm")
    if arm is None:
        found.append("No arm was simulated: the tray was moved exactly along the reference.")
        return found
    if summary.get("stand_ins"):
        found.append(
            f"The URDF gives {listed(summary['stand_ins'])} no mass: each has {STAND_IN.mass:g} kg in the physics "
            "engine, and the arm follows its command as under position control."
        )
    if arm["torque_cut"] > 0:
        found.append(
            f"The arm's torque saturated: up to {100 * arm['torque_share_peak']:.0f} % of its limit was commanded, and "
            f"{100 * arm['torque_cut']:.1f} % of the commands were cut."
        )
    if arm["torque_rate_cut"] > 0:
        found.append(f"{100 * arm['torque_rate_cut']:.1f} % of the commands were cut to the limit of torque rate.")
    if arm["velocity_share_peak"] > 1:
        found.append(f"A joint moved at {100 * arm['velocity_share_peak']:.0f} % of its speed limit.")
    if arm["position_margin"] < 0:
        found.append(f"A joint went {-arm['position_margin']:.3f} rad beyond its range.")
    return found


def _fate(item: dict[str, Any], summary: dict[str, Any]) -> str:
    name, limits = item["name"], summary["thresholds"]
    if summary["slides_at_rest"] and item["outcome"] != "holds":
        return f"{name} slides on the tray even at rest: friction does not hold it at the start's inclination."
    return {
        "holds": f"{name} holds: it slid less than {1e3 * limits['slip']:g} mm, creep of the engine "
        f"({1e6 * item['peak_creep']:.0f} um) not counted.",
        "slides": f"{name} slides from t = {_time(item['first_slip'])} on, {1e3 * item['peak_slip']:.2f} mm at most.",
        "spills": f"{name} spills from t = {_time(item.get('first_spill'))} on: its liquid rises by "
        f"{1e3 * item.get('peak_wave', 0.0):.1f} mm, and the brim is {1e3 * (item.get('room') or 0.0):.1f} mm "
        f"above it.",
        "swings": f"{name} is struck from t = {_time(item.get('first_swing'))} on: its pendulum swings by "
        f"{1e3 * item.get('peak_swing', 0.0):.1f} mm, and has room for {1e3 * (item.get('room') or 0.0):.1f} mm.",
        "tips": f"{name} tips by over {57.3 * limits['tip_angle']:.0f} degrees from t = {_time(item['first_tip'])} on.",
        "lifts": f"{name} lifts off: over {1e3 * limits['lift']:g} mm from t = {_time(item['first_lift'])} on.",
        "lost": f"{name} slid off the tray at t = {_time(item['lost_at'])}.",
    }[item["outcome"]]


def _time(t: float | None) -> str:
    return "?" if t is None else f"{t:.3f} s"
