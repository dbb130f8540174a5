"""`salver track`: compare the executed motion with the plan, and its effect on the contact margin."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from salver.cli.checks.audit import Topic
from salver.cli.common import ExitCode, Json, headed, print_json, print_table, result_console

if TYPE_CHECKING:
    from salver.learning.tracking.track import Tracking
    from salver.models.uncertain.parameters import Vibration

UNSEEN = "what joint encoders do not see: how arm and tray bend, and where the load stands"


def track(
    directory: Annotated[Path, typer.Argument(help="Run directory of the plan that was run.")],
    log: Annotated[Path, typer.Argument(help="Log of the joints: .npz, CSV, JSON, YAML (MoveIt), ROS bag.")],
    stem: Annotated[str, typer.Option("--plan", help="Which plan of the directory.")] = "plan",
    topic: Topic = None,
    json: Json = False,
) -> None:
    """Compare a robot's motion with the plan, and say what the difference takes from the contact margin.

    The log holds joint positions (rad) over time (s), 90 samples a second or more, from rest to rest; its clock may
    begin anywhere. A common delay of all joints is removed, because it does not affect the load. The executed motion of
    the tray is then judged like the plan, for every load in the scenario's ranges: the excess is the missing margin, as
    a share of the weight. The output names the joint that causes most of it, the tray's vibration beside the commanded
    motion, and the remedies in order.

    Example: `salver track runs/panda-tall-bottle runs/panda-tall-bottle/execution/plan.npz`

    Ends with 0 when the executed motion lacks no margin, with 3 when it does.
    """
    from salver.learning.tracking.executed import read_joints
    from salver.learning.tracking.track import Judge
    from salver.learning.tracking.track import track as compare
    from salver.planning.plan import load_plan

    plan = load_plan(directory, stem)
    judge = Judge.of(plan.scenario, plan.space)
    found = compare(plan, read_joints(log, judge.arm, topic), judge)
    if json:
        print_json(record(found))
    else:
        _show(found)
    if not found.ok:
        raise typer.Exit(ExitCode.NO_SAFE_PLAN)


def unseen(found: Tracking) -> str:
    """What the verdict does not cover, in words."""
    return f"{UNSEEN}; what shakes faster than {found.done.fastest:.0f} Hz"


def record(found: Tracking) -> dict[str, Any]:
    """The result as a JSON object; margins as shares of the weight."""
    return {
        "not_checked": unseen(found),
        "ok": found.ok,
        "row": found.row,
        "noise": found.noise,
        "uncertainty": found.uncertainty,
        "planned": found.planned,
        "shake": None if found.shake is None else shake_table(found.shake),
        "excess": found.excess,
        "time": found.time,
        "interface": found.interface,
        "shift": found.done.shift,
        "cause": found.cause,
        "margin_that_pays": found.margin,
        "joints": [vars(joint) for joint in found.joints],
    }


def shake_table(shake: Vibration, more: float = 1.1) -> dict[str, float]:
    """The keys of a scenario's `uncertainty.shake`, rounded up to two digits.

    more: share of the measured displacement that is stated, because the next log may show a tenth more.
    """
    amounts = {"amplitude": more * shake.amplitude, "tilt_deg": more * math.degrees(shake.tilt)}
    amounts["frequency"] = shake.frequency
    size = {key: 10.0 ** math.floor(math.log10(value) - 1) for key, value in amounts.items() if value}
    return {key: float(f"{unit * math.ceil(amounts[key] / unit - 1e-6):.2g}") for key, unit in size.items()}


def vibration(found: Tracking) -> str:
    """The tray's vibration in a sentence, with the keys that count it."""
    if found.shake is None:
        return "None of the tray is above the noise of the log."
    known, keys = found.plan.uncertain.shake, shake_table(found.shake)
    if known is not None and known.covers(found.shake):
        return f"The tray shakes by {found.shake.words}; the plan has margin for {known.words}."
    table = ", ".join(f"{key} = {value:g}" for key, value in keys.items())
    return f"The tray shakes by {found.shake.words} beside the commanded motion: [uncertainty] shake = {{ {table} }}."


def verdict(found: Tracking) -> str:
    """The verdict in one sentence."""
    where = f"({found.interface}, at {found.time:.3f} s)"
    known = f"+- {100 * found.uncertainty:.1f} %"
    if found.ok:
        return f"Executed with a worst-case margin of {-100 * found.row:.1f} {known} of the weight {where}."
    if found.row > 0:
        return (
            f"The executed motion violates the worst-case limit by {100 * found.row:.1f} {known} of the weight {where}."
        )
    return (
        f"It is unknown whether the executed motion holds in the worst case: its margin is {-100 * found.row:.1f} "
        f"{known} of the weight {where}."
    )


def _show(found: Tracking) -> None:
    console = result_console()
    console.print(headed("not checked", f"{unseen(found)}."))
    console.print(headed("executed", verdict(found)))
    console.print(
        f"The log's clock is {found.done.shift:.4f} s ahead of the plan's; the plan itself has a margin of "
        f"{-100 * found.planned:.1f} % of the weight, and of {100 * found.plan.left:.1f} % for an arm that follows "
        "exactly."
    )
    console.print(headed("vibration", vibration(found)))
    rows = [
        (
            joint.name,
            f"{1e3 * joint.peak:.3f} m{joint.unit}",
            f"{1e3 * joint.lag:.2f} ms",
            f"{1e3 * joint.friction:.3f} m{joint.unit}",
            f"{1e6 * joint.noise:.1f} u{joint.unit}",
            f"{-100 * joint.row:.1f} %",
        )
        for joint in found.joints
    ]
    print_table(("joint", "off the plan", "later than all", "friction", "noise", "margin alone"), rows, left=("joint",))
    if found.ok:
        return
    console.print(headed("cause", f"{found.cause}."))
    shake = "" if found.shake is None else ", with the shake above"
    console.print(headed("remedy 1", f"add margin: contact.margin = {found.margin:.4f}{shake}, and plan again."))
    console.print(
        headed("remedy 2", "if that is too slow: another robot, or this one with friction and payload configured.")
    )
