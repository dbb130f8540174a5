"""The words at the top of the page: a level, a headline and the text below it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from salver.planning.plan import Plan
    from salver.scenario import Scenario
    from salver.studio.text import Mistake

PLANNING = ("", "Planning", "The fastest safe motion is sought in another process; change what you like meanwhile.")
BECAME = {"lost": "is off the tray", "fallen": "has fallen over", "slid": "has slid", "spilt": "has spilt"}
TRY = (
    "Drag the ring, or hold W A S D: the arm follows and its load stays. Try to make it slide, fall or spill; then "
    "uncheck “protected” and try again."
)
UNPROTECTED = (
    "The same hand moves the arm, and nothing keeps the load on its tray. Check “protected” again when it rests, or "
    "begin again."
)

Said = tuple[str, str, str]  # level ("" for good, "warning", "bad"), headline, detail


def mistaken(mistakes: Sequence[Mistake]) -> Said:
    return "bad", f"Line {mistakes[0].line} says what cannot be.", mistakes[0].sentence


def looked(scenario: Scenario, blocked: str, unchecked: Sequence[str], warnings: Sequence[str]) -> Said:
    """The words on a scenario before it is planned. blocked: why no plan is possible, or "". unchecked: what is not
    checked at the ends."""
    if blocked:
        return "bad", "Nothing can be planned here yet.", " ".join([blocked, *warnings])
    reached = f"The arm reaches both ends, and nothing {'that is checked ' if unchecked else ''}touches there."
    detail = [_not_checked(unchecked), "Plan, or change something.", *warnings]
    return "", reached if scenario.arm else "The tray moves without an arm.", " ".join(filter(None, detail))


def planned(plan: Plan, warnings: Sequence[str]) -> Said:
    """The words on a plan: what was not checked comes first, then the result."""
    blind = _not_checked(plan.unchecked)
    arm = "" if plan.arm_status is None or plan.arm_status.ok else plan.arm_status.sentence
    detail = " ".join(filter(None, [blind, plan.status.sentence, arm, *warnings]))
    if not plan.ok:
        return "bad", "No safe motion was found.", detail
    kept = "" if plan.speeds.every else " at full speed"
    return "", f"{plan.duration:.3f} s, safe in the worst case{kept}{' of what is checked' if blind else ''}.", detail


def _not_checked(unchecked: Sequence[str]) -> str:
    return f"Not checked: {'; '.join(unchecked)}." if unchecked else ""


def steered(frame: dict[str, Any], pace: float, planner: bool) -> dict[str, Any]:
    """The words on a frame of the live mode: its verdict; the present value of each of the three strips, also in words;
    the pace.

    pace: speed of the world's clock, as a share of real time. planner: whether its process is alive.
    """
    gone = [f"{item['name']} {BECAME[item['became']]}" for item in frame["load"] if item["became"]]
    doing, held = frame["doing"], frame["protected"]
    rests = f"at rest in {frame['restsIn']:.2f} s, {frame['nearest']}."
    head = {
        "following": f"Following: {rests}",
        "stopping": f"Stopping: {rests}",
        "unprotected": "Without protection.",
        "resting": "Planning a safe way to the ring." if frame["planning"] else "The arm rests.",
    }[doing]
    hint = "" if frame["planning"] or gone else {"resting": TRY, "unprotected": UNPROTECTED}.get(doing, "")
    if gone:
        head = f"The {', the '.join(gone)}."
    slow = f" This machine runs it at {100 * pace:.0f} % of real time." if pace < 0.97 else ""
    dead = "" if planner else " The planner is dead."
    margin = f"{100 * frame['margin']:.1f} % at {frame['limit']}" if held else "nothing is committed"
    friction = zip(frame["load"], frame["friction"], strict=True)
    return {
        "verdict": ("bad" if gone else "" if held else "warning", head, frame["said"] or hint),
        "values": [100 * frame["margin"] if held else None, max(frame["friction"]), frame["speed"]],
        "legends": [
            margin,
            " · ".join(f"{item['name']} {used:.2f}" for item, used in friction),
            f"{frame['speed']:.2f} m/s",
        ],
        "pace": f"Planning takes up to {1000 * frame['lead']:.0f} ms.{slow}{dead}",
    }
