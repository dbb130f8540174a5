"""Workers of a campaign: this process or a pool of processes, which yield records as runs finish."""

from __future__ import annotations

import multiprocessing
import os
import threading
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from multiprocessing import connection
from typing import Any

from salver.campaigns.journal import Item
from salver.campaigns.runners import Context
from salver.errors import SalverError

# One thread of linear algebra for each worker, because all cores are in use.
_ONE_THREAD = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")

_context: Context | None = None  # set in the worker processes of a pool


def processes(context: Context, items: Sequence[Item], jobs: int) -> Iterator[dict[str, Any]]:
    """Records of runs, made in `jobs` processes, as they finish. Raises SalverError when a process dies (killed, out of
    memory)."""
    with _single_threaded():
        pool = ProcessPoolExecutor(jobs, multiprocessing.get_context("spawn"), _initialise, (context,))
        try:
            for future in as_completed([pool.submit(_execute, item) for item in items]):
                yield future.result()
        except BrokenProcessPool:
            raise SalverError(
                "A process that made runs died (killed, or out of memory); finished runs are kept: repeat the command "
                "to continue, with fewer --jobs if memory is short."
            ) from None
        finally:  # without waiting: a worker that is killed when idle may hold a lock that the others wait for
            pool.shutdown(wait=False, cancel_futures=True)


@contextmanager
def _single_threaded() -> Iterator[None]:
    """A context in which processes are started with one thread of linear algebra each."""
    before = {name: os.environ[name] for name in _ONE_THREAD if name in os.environ}
    os.environ.update(dict.fromkeys(_ONE_THREAD, "1"))
    try:
        yield
    finally:
        for name in _ONE_THREAD:
            os.environ.pop(name, None)
        os.environ.update(before)


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


def _execute(item: Item) -> dict[str, Any]:
    assert _context is not None
    return _context.execute(*item)
