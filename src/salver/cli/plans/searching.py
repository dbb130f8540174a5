"""Searches of commands: progress, time limit, and Ctrl-C, which ends a search with the best plan so far; and the
planning of stops."""

from __future__ import annotations

import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from types import FrameType
from typing import TYPE_CHECKING, TypeVar

from salver.cli.common import say
from salver.cli.progress import step

if TYPE_CHECKING:
    from salver.planning.plan import Plan
    from salver.planning.round import MultiLegPlan
    from salver.planning.trajopt.watch import Watch

Planned = TypeVar("Planned", bound="Plan | MultiLegPlan")


@contextmanager
def searching(time_limit: float | None = None, once: float = 0.3) -> Iterator[Watch]:
    """The watch of a search; a second Ctrl-C ends the command.

    time_limit: s, or None. once: s within which signals count as one, because some shells send them to a process and to
    its group.
    """
    from salver.planning.trajopt.watch import Watch

    def tell(watch: Watch) -> None:
        best = "" if watch.best is None else f"; {watch.best:.3f} s so far, Ctrl-C takes it"
        step(round(100 * watch.share), 100, f"{watch.trying}{best}")

    watch = Watch(time_limit, tell, trying="the task is set up")
    tell(watch)
    if threading.current_thread() is not threading.main_thread():
        yield watch
        return

    first = float("inf")

    def interrupted(number: int, frame: FrameType | None) -> None:
        nonlocal first
        if time.monotonic() - first > once and callable(before):
            before(number, frame)
        if not watch.ended:
            first = time.monotonic()
            watch.interrupt()
            say("salver: the search ends with the best found so far; Ctrl-C once more ends the command.")

    before = signal.signal(signal.SIGINT, interrupted)
    try:
        yield watch
    finally:
        signal.signal(signal.SIGINT, before)


def stopping(plan: Planned, keep: Callable[[], object]) -> Planned:
    """A plan with stops for each leg; an unsafe plan is returned unchanged.

    keep: called if the user interrupts, to save the plan without stops.
    """
    from salver.planning.round import MultiLegPlan
    from salver.planning.stops import with_stops

    def progress_of(what: str) -> Callable[[int, int], None]:
        return lambda done, total: step(done, total, what)

    if not plan.ok:
        return plan
    try:
        if isinstance(plan, MultiLegPlan):
            legs = (with_stops(leg, progress_of(f"stops of leg {k}")) for k, leg in enumerate(plan.legs, 1))
            return replace(plan, legs=tuple(legs))
        return replace(plan, stops=with_stops(plan, progress_of("stops")).stops)
    except KeyboardInterrupt:
        keep()
        raise
