"""Workers of a campaign: this process, or a pool of processes. Records come as runs finish."""

from __future__ import annotations

import multiprocessing
import os
import threading
from collections.abc import Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from multiprocessing import connection
from typing import Any

from salver.campaigns.runners import Context

Batch = tuple[str, tuple[int, ...]]  # (stem, runs)
Records = list[dict[str, Any]]

ATTEMPTS = 3  # times that a batch is given to a worker that then dies, before its runs are called crashed

# Linear algebra threads would fight over the cores with the other workers.
_ONE_THREAD = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")

_context: Context | None = None  # of a pool's worker process


def serial(context: Context, batches: Sequence[Batch]) -> Iterator[Records]:
    """In this process, in order."""
    for stem, runs in batches:
        yield context.execute(stem, runs)


def processes(context: Context, batches: Sequence[Batch], jobs: int) -> Iterator[Records]:
    """In `jobs` processes. A worker that dies (killed, out of memory) costs its batch a second attempt."""
    attempts = dict.fromkeys(batches, 0)
    left = list(batches)
    while left:
        done: set[Batch] = set()
        with (
            _single_threaded(),
            ProcessPoolExecutor(jobs, multiprocessing.get_context("spawn"), _initialise, (context,)) as pool,
        ):
            futures: dict[Future[Records], Batch] = {}
            try:
                for records, batch in _as_completed(pool, left, futures, 2 * jobs):
                    done.add(batch)
                    yield records
            except BrokenProcessPool:
                for batch in {futures[f] for f in futures} - done:
                    attempts[batch] += 1
            except BaseException:
                pool.shutdown(wait=False, cancel_futures=True)
                raise
        left = [batch for batch in left if batch not in done]
        for stem, runs in [batch for batch in left if attempts[batch] >= ATTEMPTS]:
            left.remove((stem, runs))
            yield [_crashed(context, stem, run) for run in runs]


def _as_completed(
    pool: ProcessPoolExecutor, batches: Sequence[Batch], futures: dict[Future[Records], Batch], in_flight: int
) -> Iterator[tuple[Records, Batch]]:
    """Results as they come, with few batches handed out at a time: an interrupted campaign has little to cancel."""
    waiting = iter(batches)
    pending: set[Future[Records]] = set()
    while True:
        while len(pending) < in_flight and (batch := next(waiting, None)) is not None:
            future = pool.submit(_execute, batch)
            futures[future] = batch
            pending.add(future)
        if not pending:
            return
        finished, pending = wait(pending, return_when=FIRST_COMPLETED)
        # Results first: a pool that breaks fails all its pending futures at once.
        for future in sorted(finished, key=lambda f: f.exception() is not None):
            yield future.result(), futures[future]


@contextmanager
def _single_threaded() -> Iterator[None]:
    """Processes started meanwhile inherit one thread each."""
    before = {name: os.environ.get(name) for name in _ONE_THREAD}
    os.environ.update(dict.fromkeys(_ONE_THREAD, "1"))
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value


def _initialise(context: Context) -> None:
    global _context
    _context = context
    parent = multiprocessing.parent_process()
    if parent is not None:
        threading.Thread(target=_end_with, args=(parent.sentinel,), daemon=True).start()


def _end_with(sentinel: int) -> None:
    """A campaign that is killed leaves no worker behind."""
    connection.wait([sentinel])
    os._exit(1)


def _execute(batch: Batch) -> Records:
    assert _context is not None
    return _context.execute(*batch)


def _crashed(context: Context, stem: str, run: int) -> dict[str, Any]:
    return {
        "stem": stem,
        "run": run,
        "seconds": None,
        "parameters": context.parameters(run),
        "outcome": "crashed",
        "scalars": {"sentence": f"The process that made this run died, {ATTEMPTS} times."},
    }
