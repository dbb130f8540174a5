"""Plans of a page, in a process of its own: a newer task ends the one before."""

from __future__ import annotations

import contextlib
import subprocess
import sys
import threading
from dataclasses import replace
from multiprocessing import Pipe
from multiprocessing.connection import Connection
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from salver.errors import SalverError
from salver.scenario import Scenario
from salver.scenario.warnings import warnings_of
from salver.studio.words import planned

if TYPE_CHECKING:
    from salver.models.uncertain.parameters import UncertainSet

NAMES = {"plan": "the plan", "baseline": "the straight line"}
EARLIER = "Runs from before are of the plan without stops, and are not counted."


def motions(directory: Path) -> dict[str, str]:
    """Stems of the motions in a run directory, and what they are: the plan's legs, if it has several."""
    from salver.planning.round import has_legs, load_round

    return {stem: f"leg {stem[3:]}" for stem in load_round(directory).by_stem} if has_legs(directory) else NAMES


class PlanningProcess:
    """A planning process, which is kept for the next task, and started anew after a task that was interrupted."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._running: tuple[subprocess.Popen[bytes], Connection] | None = None
        self._busy = False

    def plan(self, scenario: Scenario, directory: Path) -> dict[str, Any] | None:
        """Plan as `salver plan` does, into a run directory. Returns the result for the page; None when a newer task has
        ended this one."""
        return self._ask("plan", scenario, directory)

    def more(self, what: str, directory: Path) -> dict[str, Any] | None:
        """Do more with the plan of a run directory, into that directory: one of `MORE`."""
        return self._ask(what, directory)

    def _ask(self, *task: Any) -> dict[str, Any] | None:
        with self._lock:
            if self._busy or (self._running is not None and self._running[0].poll() is not None):
                self._end()
            process, pipe = self._started()
            self._busy = True
            pipe.send(task)
        try:
            found = pipe.recv()
        except (OSError, EOFError):
            found = _failed("The process that plans died; plan again.")
        with self._lock:
            if self._running is None or self._running[0] is not process:
                return None
            self._busy = False
        return dict(found)

    def close(self) -> None:
        with self._lock:
            self._end()

    def _started(self) -> tuple[subprocess.Popen[bytes], Connection]:
        if self._running is None:
            pipe, other = Pipe()
            with other:
                code = f"from salver.studio.planner import serve; serve({other.fileno()})"
                process = subprocess.Popen(
                    [sys.executable, "-c", code],
                    pass_fds=[other.fileno()],
                    stdin=subprocess.DEVNULL,
                    start_new_session=True,  # Ctrl-C is for the page
                )
            self._running = (process, pipe)
        return self._running

    def _end(self) -> None:
        running, self._running, self._busy = self._running, None, False
        if running is not None:
            running[0].kill()  # it holds nothing that could be lost; who waits for it hears of its end
            running[0].wait()


def serve(descriptor: int) -> None:
    """The planning process: it plans until the process that sends the tasks has ended."""
    with Connection(descriptor) as pipe, contextlib.suppress(EOFError, OSError):
        while True:
            do, *about = pipe.recv()
            try:
                pipe.send(_planned(*about) if do == "plan" else MORE[do](*about))
            except SalverError as error:
                pipe.send(_failed(str(error)))
            except Exception as error:  # one task that fails is no reason to end
                pipe.send(_failed(f"It failed ({type(error).__name__}: {error})."))


def _failed(sentence: str) -> dict[str, Any]:
    return {"ok": False, "verdict": ("bad", "No motion was found.", sentence), "sentence": sentence}


def _planned(scenario: Scenario, directory: Path) -> dict[str, Any]:
    from salver.planning.fastest.legs import plan_legs
    from salver.planning.make import plan_pair

    if scenario.legs:
        legs = plan_legs(scenario)
        legs.save(directory)
        return {"ok": legs.ok, "duration": legs.duration, "verdict": planned(legs, legs.warnings)}
    plan, baseline = plan_pair(scenario)
    plan.save(directory, "plan")
    baseline.save(directory, "baseline")
    verdict = planned(plan, warnings_of(scenario))
    return {"ok": plan.ok, "duration": plan.duration, "verdict": verdict, "speeds": plan.speeds.summary()}


def _run(directory: Path) -> dict[str, Any]:
    from salver.planning.plan import load_plan
    from salver.simulation.physics import simulate

    said = []
    for stem, name in motions(directory).items():
        plan = load_plan(directory, stem)
        if plan.joint is None and plan.scenario.arm is not None:
            said.append(f"{name} is nothing that the arm can follow")
            continue
        record = simulate(plan, parameters=_edge(plan.uncertain))
        record.save(directory, stem)
        said.append(f"{name}: {record.outcome}")
    return {
        "sentence": f"In the engine, with the least friction, nominal inertia, all else greatest: {'; '.join(said)}."
    }


def _stops(directory: Path) -> dict[str, Any]:
    from salver.planning.plan import load_plan
    from salver.planning.round import has_legs, load_round
    from salver.planning.stops import with_stops

    if has_legs(directory):
        whole = load_round(directory)
        legs = tuple(with_stops(leg) for leg in whole.legs)
        replace(whole, legs=legs).save(directory)
        said = " ".join(f"Leg {k}: {leg.stops.sentence}" for k, leg in enumerate(legs, 1) if leg.stops)
        return {"sentence": f"{said} {EARLIER}"}
    plan, baseline = with_stops(load_plan(directory)), load_plan(directory, "baseline")
    plan.save(directory)
    baseline.save(directory, "baseline")
    return {"sentence": f"{plan.stops.sentence} {EARLIER}" if plan.stops else ""}


def _campaign(directory: Path, n: int = 100) -> dict[str, Any]:
    """In this process alone, so that nothing goes on when it is ended."""
    from salver.campaigns import run_campaign

    outcomes = run_campaign(directory, n, jobs=1).facts()
    said = [f"{name}: {outcomes[stem]}" for stem, name in NAMES.items() if stem in outcomes]
    return {"sentence": f"{n} runs in the engine, drawn from the ranges: {'; '.join(said)}."}


MORE = {"run": _run, "stops": _stops, "campaign": _campaign}


def _edge(uncertain: UncertainSet) -> dict[str, float]:
    """Values at the edge of the ranges: friction and damping at the least, all else at the greatest; inertia stays
    nominal, because no body need have all its moments and products at their greatest."""
    share = uncertain.size**-0.5 if uncertain.kind == "ellipsoid" else 1.0
    signs = [{"friction": -1.0, "damping": -1.0, "inertia": 0.0}.get(p.kind, 1.0) for p in uncertain.parameters]
    return dict(zip(uncertain.names, uncertain.nominal + share * np.array(signs) * uncertain.half_range, strict=True))
