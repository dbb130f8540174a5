"""The journal: one line for each finished run, appended at once, so that a kill at any moment loses nothing finished.

A line that was cut off by the kill is dropped on reading, and that run is done again. One process writes; a
lock that the operating system gives up when the process dies keeps a second one out.
"""

from __future__ import annotations

import fcntl
import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from salver.errors import SalverError

Record = Mapping[str, Any]
Item = tuple[str, int]  # (stem, run)


class Journal:
    """Records of finished runs by (stem, run); `with` holds the lock."""

    def __init__(self, folder: Path) -> None:
        self.path = folder / "journal.jsonl"
        self._lock_path = folder / "lock"
        self.records: dict[Item, Record] = {}

    def __enter__(self) -> Journal:
        self.path.parent.mkdir(parents=True, exist_ok=True)
        self._lock = os.open(self._lock_path, os.O_RDWR | os.O_CREAT, 0o644)
        try:
            fcntl.flock(self._lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            os.close(self._lock)
            raise SalverError(
                f"Another campaign is running in {self.path.parent}; wait until it ends or stop it."
            ) from None
        whole = self._read()
        self._file = os.open(self.path, os.O_RDWR | os.O_CREAT, 0o644)
        os.ftruncate(self._file, whole)
        os.lseek(self._file, 0, os.SEEK_END)
        return self

    def __exit__(self, *_: object) -> None:
        os.close(self._file)
        os.close(self._lock)

    def append(self, record: Record) -> None:
        """Add a finished run, to the disk before the next one. Raises SalverError when the disk is full or gone."""
        left = memoryview((json.dumps(record, separators=(",", ":")) + "\n").encode())
        try:
            while left:
                left = left[os.write(self._file, left) :]
            os.fsync(self._file)
        except OSError as error:
            raise SalverError(
                f"{self.path} cannot be written ({error.strerror}); finished runs are kept; the same command goes on."
            ) from None
        self.records[record["stem"], record["run"]] = record

    def _read(self) -> int:
        """Take in all complete lines; returns how many bytes they are."""
        if not self.path.is_file():
            return 0
        whole = 0
        for line in self.path.read_bytes().splitlines(keepends=True):
            try:
                record = json.loads(line)
                if not line.endswith(b"\n"):
                    break
                self.records[record["stem"], int(record["run"])] = record
            except (ValueError, KeyError, TypeError):
                break
            whole += len(line)
        return whole
