"""`salver audit`: does the load hold along an existing motion?"""

from __future__ import annotations

from pathlib import Path
from shlex import quote
from typing import TYPE_CHECKING, Annotated

import typer

from salver.cli.common import ExitCode, Json, print_json, result_console
from salver.wording import listed, millimetres, number

if TYPE_CHECKING:
    from salver.auditing import Audit
    from salver.errors import Status

OnTray = Annotated[
    str | None,
    typer.Option("-s", "--scenario", help="What is on the tray, for a motion file: a name or a .toml file."),
]
Topic = Annotated[str | None, typer.Option(help="Topic of the motion, when a bag has several.")]
Units = Annotated[
    str | None,
    typer.Option(
        help="Units of a table other than rad, m and s: some of deg, mm, ms, as in --units deg,ms. Files are "
        "written in rad, m, s."
    ),
]
Highest = Annotated[
    float, typer.Option(help="Highest frequency at which the tray may vibrate, Hz; a recording must resolve it.")
]
Noise = Annotated[
    float | None,
    typer.Option(help="Standard deviation of the sensor's noise, m (rad of joints). Default: found in the samples."),
]
Gap = Annotated[
    float | None, typer.Option(help="Bridge up to so many seconds without samples. Default: 0.02 s or three steps.")
]


def audit(
    trajectory: Annotated[
        Path,
        typer.Argument(help="CSV of a tray or joint motion, JointTrajectory (MoveIt's too) as YAML or JSON, bag."),
    ],
    scenario: Annotated[str, typer.Option("--scenario", "-s", help="What is on the tray: a name or a .toml file.")],
    topic: Topic = None,
    units: Units = None,
    highest: Highest = 50.0,
    noise: Noise = None,
    gap: Gap = None,
    json: Json = False,
) -> None:
    """Say whether what is on the tray holds, slides, tips or spills along a motion, nominally and in the worst case.

    Exit code 0: everything holds in the worst case of the scenario's uncertain parameters, for every motion that the
    samples allow, and the arm touches nothing on the way, where its joints are given; 3: it does not, or the samples
    cannot tell; 2: wrong use.

    A motion of several legs is cut at its longest rests, and each leg judged with what is then on the tray.

    CSV columns: t (s), then x, y, z (m), qw, qx, qy, qz of the tray, or the arm's joint names or q1 ... qn, J1 ... Jn
    (rad); other units with --units.

    Example: `salver audit motion.csv --scenario panda-cube`
    """
    from salver import scenario as model
    from salver.auditing import AuditOptions, audit_legs
    from salver.auditing import audit as run

    case, chosen = model.load(scenario), AuditOptions(highest, noise, gap)
    if case.legs:
        results = audit_legs(trajectory, case, topic, chosen, units)
    else:
        results = (run(trajectory, case, topic, chosen, units),)
    if json:
        print_json({"legs": [leg.summary() for leg in results]} if case.legs else results[0].summary())
    elif case.legs:
        for number, leg in enumerate(results, 1):
            result_console().print(f"Leg {number}, with {listed([item.name for item in leg.scenario.objects])}:")
            _show(leg)
    else:
        fast = None if highest == 50.0 else highest
        given = {"topic": topic, "units": units, "highest": fast, "noise": noise, "gap": gap}
        options = "".join(f" --{name} {quote(str(value))}" for name, value in given.items() if value is not None)
        _show(results[0], f"{quote(str(trajectory))} -s {quote(scenario)}", options)
    if not all(result.ok for result in results):
        raise typer.Exit(ExitCode.NO_SAFE_PLAN)


def _show(result: Audit, given: str = "", options: str = "") -> None:
    """Print an audit. given, options: the file and the options, for commands that the output proposes."""
    out = result_console()
    motion, margins, none = result.motion, result.margins, "(none suffices)"
    lines = [
        f"{result.source}: {motion.samples.t[-1] - motion.samples.t[0]:.3f} s, {_seen(result)}.",
        *motion.notes,
        f"Arm: {result.arm.sentence}",
        f"Nominal: {result.nominal.sentence}",
        f"Worst case: {result.worst.sentence}",
        *(
            f"{m.name}: friction needed {number(m.friction_needed.max(), 3, otherwise=none)} nominal, of "
            f"{m.friction:.3g}, {number(m.friction_needed_worst, 3, otherwise=none)} worst case, of "
            f"{m.least_friction:.3g}; tip-over margin {millimetres(m.tip_over.min())} nominal, "
            f"{millimetres(m.tip_over_worst.min())} worst case."
            for m in margins.interfaces
        ),
    ]
    if result.costs:
        name, cost = next(iter(result.costs.items()))
        lines.append(
            f"Costs most of the margin: {name}, {100 * cost:.1f} % of the weight."
            if cost > 5e-4
            else f"No uncertain parameter ({', '.join(result.costs)}) costs any of the margin."
        )
    for case, speeds in (("nominal", result.speeds), ("worst case", result.speeds_worst)):
        lines.append(f"Speeds, {case}: {speeds.sentence}")
        lines.append(f"Pace, {case}: {_pace_words(speeds.pace)}")
    if given:
        lines.append(f"As a page, with a replay: salver report {given}{options}")
    for line in lines:
        out.print(line)


def _seen(result: Audit) -> str:
    """Quality of the recording in words."""
    motion = result.motion
    recording = motion.recording
    if recording is None:
        return "known exactly"
    noise = 1e3 * recording.sensor.displacement
    slip, _ = result.hidden(worst=True)
    return (
        f"{recording.rate:.4g} samples a second with noise of {noise:.2g} mm; vibration of up to "
        f"{motion.options.highest:g} Hz that it hides would slide the load by at most {1e3 * slip.distance:.2g} mm"
    )


def _pace_words(pace: Status) -> str:
    factor = pace.details["factor"]
    if factor is None:
        return pace.sentence
    if factor > 1:
        return f"the same path must take {factor:.3f} times as long."
    return f"the same path could be run in {factor:.3f} of the time."
