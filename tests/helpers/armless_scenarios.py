"""A scenario of objects on a tray without an arm."""

from __future__ import annotations

from salver.scenario import Scenario, parse


def scenario(objects: list[dict], **more: object) -> Scenario:
    """Known exactly, unless they say otherwise."""
    ends = {"start": {"position": [0, 0, 0]}, "goal": {"position": [1, 0, 0]}, "duration": 1.0}
    return parse(
        {"name": "test", "motion": ends, "objects": [{"uncertainty": "none"} | item for item in objects], **more},
        "test",
    )
