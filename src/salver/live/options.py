"""Options of a live motion."""

from __future__ import annotations

from dataclasses import dataclass, field

from salver.live.ready import ReadyOptions
from salver.live.replanning.lead import LeadOptions
from salver.live.replanning.lookout import LookoutOptions
from salver.live.replanning.obstacles import ObstacleOptions
from salver.live.replanning.planner import PlannerOptions
from salver.live.replanning.wishes import RequestOptions


@dataclass(frozen=True)
class LiveOptions:
    """Options of a live motion: what counts as an error, and how long it tries to reach a goal.

    Attributes:
        longest_gap: s between two commands; a longer one is taken for a jump of the clock.
        strayed: rad or m, largest accepted difference between the measured and the commanded position of a joint.
        calming: s after the end of a twist or chunk during which the motion is still steered, to rest; after that it is
            only finished. After hostile twists the tray moves on for 6 cm and 0.84 s (means); at 0, for 11 cm and 0.59
            s.
        queued: largest number of goals in the queue.
        attempts: number of attempts at a goal while the arm moves; one more follows from rest.
        record: s of the latest commanded motion that are kept for `save`.
        requests, obstacles: which requests and obstacles are accepted.
        lookout: at which instants the commanded motion is compared with moving obstacles.
        lead: how long before a hand-over planning begins. ready: which stops are kept ready.
        planner: how motions are proposed.
    """

    longest_gap: float = 0.05
    strayed: float = 0.05
    calming: float = 0.3
    queued: int = 100
    attempts: int = 4
    record: float = 120.0
    requests: RequestOptions = field(default_factory=RequestOptions)
    obstacles: ObstacleOptions = field(default_factory=ObstacleOptions)
    lookout: LookoutOptions = field(default_factory=LookoutOptions)
    lead: LeadOptions = field(default_factory=LeadOptions)
    ready: ReadyOptions = field(default_factory=ReadyOptions)
    planner: PlannerOptions = field(default_factory=PlannerOptions)
