"""The planner of a live motion, in a process of its own or in a thread."""

from __future__ import annotations

import contextlib
import gc
import os
import subprocess
import sys
import threading
from dataclasses import dataclass
from multiprocessing import Pipe
from multiprocessing.connection import Connection
from types import TracebackType
from typing import Self

from salver.errors import SalverError
from salver.live.committed import seal
from salver.live.live import Live
from salver.live.replanning.planner import Answer, Job, Planner, PlannerOptions
from salver.live.standing import live_scenario
from salver.planning.fastest import transport_problem
from salver.scenario import Scenario


@dataclass(frozen=True)
class WorkerOptions:
    """Options of the planner's process.

    Attributes:
        pause: s between two checks for a job. Doubled, planning begins 2 ms later.
        switch: s for which Python lets one thread run while another is ready; the robot's loop waits no longer than
            this. With 5e-4, 1 % of the periods of a busy machine were late by 0.32 ms instead of 0.21 ms.
        patience: s after the budget at which a process that does not answer is given up.
    """

    pause: float = 2e-3
    switch: float = 1e-4
    patience: float = 20.0


# Matrices here are small: threads of the linear algebra would only take the loop's core away.
ONE_THREAD = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")


class Worker:
    """Plans while it is entered: `with Worker(live): ...`, or `start` and `close`."""

    def __init__(
        self,
        live: Live,
        budget: float = 2.0,
        *,
        process: bool = True,
        stops: bool = False,
        options: WorkerOptions = WorkerOptions(),
    ) -> None:
        """budget: approximate time of one step of planning, s. process: plan in a process of its own, which leaves the
        interpreter to the robot's loop and takes some seconds to start; otherwise in a thread, which delays a loop
        beside it. stops: when nothing else is to be planned, plan stops that are then ready in the loop's process.

        A small thread here exchanges with the process. Start it from a thread that has the loop's real-time priority:
        it inherits that, and the process does not. Without, the loop waits for it on a machine that is busy.

        Until `close`, Python's collector of garbage does not go through what existed before (`gc.freeze`).
        """
        self._live, self._budget, self._stops, self._options = live, budget, stops, options
        self._closing, self._froze = threading.Event(), False
        self._process = _Process(live, options.patience) if process else None
        self._thread = threading.Thread(target=self._work, name="salver-live", daemon=True)

    def start(self) -> Self:
        sys.setswitchinterval(min(sys.getswitchinterval(), self._options.switch))
        if self._process is not None:
            self._process.ready()  # or else the first lead would be that of a start
        # A whole collection takes up to 40 ms, in whichever thread it begins: the loop's, or that of a camera.
        # Python 3.12 begins with objects that are frozen, so their count does not tell whether somebody froze the rest.
        self._froze = any(each is Worker for each in gc.get_objects())
        gc.freeze()
        self._thread.start()
        return self

    def close(self) -> None:
        """End planning; the committed motion is finished."""
        self._closing.set()
        self._thread.join()
        if self._process is not None:
            self._process.close()
        if self._froze:  # else somebody else did, and keeps it so
            gc.unfreeze()
            self._froze = False

    @property
    def alive(self) -> bool:
        return self._thread.is_alive()

    def __enter__(self) -> Self:
        return self.start()

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _work(self) -> None:
        answer = None if self._process is None else self._process.answer
        while not self._closing.is_set():
            if self._process is not None and self._process.behind:
                with contextlib.suppress(SalverError):  # said of the next request
                    self._process.ready()  # or else the next lead would be that of a start
            if not self._live.idle:
                self._live.plan(self._budget, answer)
            elif not (self._stops and self._live.prepare(self._budget, answer)):
                self._closing.wait(self._options.pause)


class _Process:
    """A planner in another process. One that died is replaced when the next job comes."""

    def __init__(self, live: Live, patience: float = WorkerOptions.patience) -> None:
        self._live, self._about, self._patience = live, self._of(live), patience
        self._running: subprocess.Popen[bytes] | None = None

    @staticmethod
    def _of(live: Live) -> tuple[Scenario, bool, PlannerOptions, bytes]:
        return live.problem.scenario, live.robust, live.options.planner, seal.key()

    @property
    def behind(self) -> bool:
        """Whether another load is carried by now."""
        return self._about[0] is not self._live.problem.scenario

    def ready(self) -> None:
        """Wait until it can be asked; for another load another process is started. Raises SalverError when it cannot
        begin."""
        if self.behind:
            self.close()
            self._about = self._of(self._live)
        if self._running is not None:
            return
        self._pipe, other = Pipe()
        with other:
            code = f"from salver.live.worker import serve; serve({other.fileno()})"
            self._running = subprocess.Popen(
                [sys.executable, "-c", code],
                pass_fds=[other.fileno()],
                env={**os.environ, **ONE_THREAD},
                stdin=subprocess.DEVNULL,
                start_new_session=True,  # Ctrl-C is for the loop
            )
            if hasattr(os, "sched_setscheduler"):  # and a real-time priority too, which it would inherit
                with contextlib.suppress(OSError):
                    os.sched_setscheduler(self._running.pid, os.SCHED_OTHER, os.sched_param(0))
        self._told(self._about, self._patience)

    def answer(self, job: Job) -> Answer:
        """Raises SalverError when the process died or hangs."""
        self.ready()
        answered = self._told(job, job.budget + self._patience)
        if isinstance(answered, Answer):
            return answered
        raise SalverError(str(answered))

    def _told(self, what: object, seconds: float) -> object:
        try:
            self._pipe.send(what)
            if not self._pipe.poll(seconds):
                raise TimeoutError
            return self._pipe.recv()
        except (OSError, EOFError) as error:
            self.close()
            how = "did not answer" if isinstance(error, TimeoutError) else "died"
            raise SalverError(f"the process that plans {how}; the next request starts another one") from None

    def close(self) -> None:
        running, self._running = self._running, None
        if running is not None:
            self._pipe.close()
            running.kill()  # it holds nothing that could be lost
            running.wait()


def serve(descriptor: int) -> None:
    """The planner's process: answers jobs until the process that asks has ended."""
    with Connection(descriptor) as pipe:
        try:
            scenario, robust, options, key = pipe.recv()
            seal.use(key)
            assert isinstance(scenario, Scenario)
            planner = Planner(transport_problem(live_scenario(scenario), robust=robust), options)
            pipe.send("ready")
            while True:
                job = pipe.recv()
                try:
                    pipe.send(planner.answer(job))
                except Exception as error:  # one job that fails is no reason to end
                    pipe.send(f"{type(error).__name__}: {error}")
        except (EOFError, OSError):
            return
