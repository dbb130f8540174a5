"""The words at the top of the page: a level, a headline and the text below it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from salver.planning.plan import Plan
    from salver.planning.round import MultiLegPlan
    from salver.scenario import Scenario
    from salver.studio.text import Mistake

PLANNING = ("", "Planning", "The fastest safe motion is sought in another process; change what you like meanwhile.")
BECAME = {"lost": "is off the tray", "fallen": "has fallen over", "slid": "has slid", "spilt": "has spilt"}
TRY = (
    "Drag the ring, hold W A S D, or take a gamepad: try to make the load slide, fall or spill. The same hand moves "
    "both arms; nothing keeps the load of the one without protection."
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


def planned(plan: Plan | MultiLegPlan, warnings: Sequence[str]) -> Said:
    """The words on a plan: what was not checked comes first, then the result."""
    blind = _not_checked(plan.unchecked)
    legs: Sequence[Plan] = [plan] if not hasattr(plan, "legs") else plan.legs
    arm = " ".join(leg.arm_status.sentence for leg in legs if leg.arm_status and not leg.arm_status.ok)
    detail = " ".join(filter(None, [blind, plan.status.sentence, arm, *warnings]))
    if not plan.ok:
        return "bad", "No safe motion was found.", detail
    kept = "" if all(leg.speeds.every for leg in legs) else " at full speed"
    return "", f"{plan.duration:.3f} s, safe in the worst case{kept}{' of what is checked' if blind else ''}.", detail


def _not_checked(unchecked: Sequence[str]) -> str:
    return f"Not checked: {'; '.join(unchecked)}." if unchecked else ""


def steered(frame: dict[str, Any], pace: float, planner: bool) -> dict[str, Any]:
    """The words on a frame of the live mode: its verdict; the present value of each of the three strips, also in words;
    the pace.

    pace: speed of the world's clock, as a share of real time. planner: whether its process is alive.
    """
    gone, doing = _gone(frame), frame["doing"]
    rests = f"at rest in {frame['restsIn']:.2f} s, {frame['nearest']}."
    head = {
        "following": f"Following: {rests}",
        "stopping": f"Stopping: {rests}",
        "unprotected": "Without protection.",
        "resting": "Planning a safe way to the ring." if frame["planning"] else "The arm rests.",
    }[doing]
    hint = TRY if doing == "resting" and not frame["planning"] and not gone else ""
    slow = f" This machine runs it at {100 * pace:.0f} % of real time." if pace < 0.97 else ""
    dead = "" if planner else " The planner is dead."
    friction = zip(frame["load"], frame["friction"], strict=True)
    return {
        "verdict": ("bad" if gone else "", gone or head, frame["said"] or hint),
        "values": [100 * frame["margin"], max(frame["friction"]), frame["speed"]],
        "legends": [
            f"{100 * frame['margin']:.1f} % at {frame['limit']}",
            " · ".join(f"{item['name']} {used:.2f}" for item, used in friction),
            f"{frame['speed']:.2f} m/s",
        ],
        "pace": f"Planning takes up to {1000 * frame['lead']:.0f} ms.{slow}{dead}",
    }


def compared(
    frame: dict[str, Any], since: float | None, lost: float | None, failed: str, spilt: Sequence[float]
) -> list[str]:
    """The words over one of the two arms of the live mode: what it is, what became of its load and when, the score.

    since: s since the hand moved first, None before. lost: s after which the load was not in place any more, or None.
    failed: why the arm stands still, or "". spilt: s after which the unprotected arm has lost its load, in each round.
    """
    line = _gone(frame) or ("" if since is None else f"In place for {since:.1f} s.")
    if lost is not None:
        line = f"{line[:-1]}, lost {lost:.1f} s after the hand's first move."
    if frame["protected"]:
        return ["salver", line, "planned for the ranges"]
    score = f", lost {len(spilt)} ×, soonest after {min(spilt):.1f} s" if spilt else ""
    return ["without protection", failed or line, f"a what-if: nothing keeps its load{score}"]


def _gone(frame: dict[str, Any]) -> str:
    """What became of the loads that are not in place, as a sentence, or ""."""
    gone = [f"{item['name']} {BECAME[item['became']]}" for item in frame["load"] if item["became"]]
    return f"The {', the '.join(gone)}." if gone else ""
