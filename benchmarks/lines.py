"""Lines of JSON to which many processes add, so that a benchmark that was cut goes on where it was."""

from __future__ import annotations

import json
import time
from collections.abc import Iterator
from multiprocessing import TimeoutError
from pathlib import Path
from typing import Any

Line = dict[str, Any]


def read(path: Path) -> list[Line]:
    return [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()] if path.exists() else []


def write(path: Path, line: Line) -> Line:
    """Append a line; it is one write, so that processes do not mix theirs."""
    with path.open("a", encoding="utf-8") as file:
        file.write(json.dumps(line, default=lambda number: number.item()) + "\n")
    return line


def taken(results: Any, until: float) -> Iterator[Any]:
    """Results of a pool as they come, until they end or the time is over."""
    while True:
        try:
            yield results.next(max(0.0, until - time.time()))
        except (StopIteration, TimeoutError):
            return
