"""Workers of a campaign: this process or a pool of processes, which yield records as runs finish."""

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

ATTEMPTS = 3  # after so many workers have died on a batch, its runs have the outcome "crashed"

# One thread of linear algebra for each worker, because all cores are in use.
_ONE_THREAD = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")

_context: Context | None = None  # set in the worker processes of a pool


def serial(context: Context, batches: Sequence[Batch]) -> Iterator[Records]:
    """Run batches in this process, in order."""
    for stem, runs in batches:
        yield context.execute(stem, runs)


def processes(context: Context, batches: Sequence[Batch], jobs: int) -> Iterator[Records]:
    """Run batches in `jobs` processes. The batch of a worker that dies (killed, out of memory) is repeated."""
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
    """Results as they finish; few batches are submitted at a time, so that an interrupt has little to cancel."""
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
        # Results first, because all pending futures fail when a pool breaks.
        for future in sorted(finished, key=lambda f: f.exception() is not None):
            yield future.result(), futures[future]


@contextmanager
def _single_threaded() -> Iterator[None]:
    """A context in which processes are started with one thread of linear algebra each."""
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
    """End this worker when the campaign's process ends, even if that is killed."""
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
