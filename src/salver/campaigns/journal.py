"""The journal of a campaign: one line for each finished run, written at once, so that an interruption loses none.

When a journal is read, an incomplete last line and damaged lines (each has a checksum) are dropped, and those runs are
repeated; damaged lines are reported. A lock, which the operating system releases when the process ends, admits only one
process.
"""

from __future__ import annotations

import fcntl
import json
import logging
import os
import zlib
from collections.abc import Mapping
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from salver.errors import SalverError
from salver.files import write_atomic

Record = Mapping[str, Any]
Item = tuple[str, int]  # (stem, run)


class Journal:
    """Records of finished runs by (stem, run); a context manager that holds the lock."""

    def __init__(self, folder: Path) -> None:
        self.path = folder / "journal.jsonl"
        self._lock_path = folder / "lock"
        self.records: dict[Item, Record] = {}

    def __enter__(self) -> Journal:
        with ExitStack() as opened:
            try:
                self.path.parent.mkdir(parents=True, exist_ok=True)
                lock = os.open(self._lock_path, os.O_RDWR | os.O_CREAT, 0o644)
            except OSError as error:
                raise SalverError(f"{self.path.parent} cannot be written to ({error.strerror}).") from None
            opened.callback(os.close, lock)
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except OSError:
                raise SalverError(
                    f"Another campaign is running in {self.path.parent}; wait until it ends or stop it."
                ) from None
            try:
                self._repair()
                self._file = os.open(self.path, os.O_RDWR | os.O_CREAT | os.O_APPEND, 0o644)
            except OSError as error:
                raise SalverError(f"{self.path} cannot be read and written ({error.strerror}).") from None
            opened.callback(os.close, self._file)
            self._opened = opened.pop_all()
        return self

    def __exit__(self, *_: object) -> None:
        self._opened.close()

    def append(self, record: Record) -> None:
        """Write a finished run to the disk. Raises SalverError when the disk is full or missing."""
        left = memoryview(_line(record))
        try:
            while left:
                left = left[os.write(self._file, left) :]
            os.fsync(self._file)
        except OSError as error:
            raise SalverError(
                f"{self.path} cannot be written ({error.strerror}); finished runs are kept: repeat the command to "
                "continue."
            ) from None
        self.records[record["stem"], record["run"]] = record

    def _repair(self) -> None:
        """Read all valid lines, and drop others from the file, which a warning (on standard error) says."""
        if not self.path.is_file():
            return
        *lines, cut = self.path.read_bytes().split(b"\n")
        found = [(line, record) for line in lines if (record := _record(line)) is not None]
        self.records = {(record["stem"], record["run"]): record for _, record in found}
        if damaged := len(lines) - len(found):
            told = "%s: %d damaged line(s) are dropped; their runs are made again."
            logging.getLogger(__name__).warning(told, self.path, damaged)
        if damaged or cut:
            write_atomic(self.path, b"".join(line + b"\n" for line, _ in found))


def _line(record: Record) -> bytes:
    """A record as a line, with a checksum."""
    return _dumped({**record, "check": _check(record)}) + b"\n"


def _dumped(record: Record) -> bytes:
    return json.dumps(record, separators=(",", ":")).encode()


def _check(record: Record) -> int:
    return zlib.crc32(_dumped(record))


def _record(line: bytes) -> dict[str, Any] | None:
    """The record of a line, or None if it is damaged."""
    try:
        record = json.loads(line)
        if record.pop("check") != _check(record):
            return None
    except (ValueError, TypeError, KeyError, AttributeError, RecursionError):
        return None
    kinds = {"stem": str, "run": int, "outcome": str, "parameters": dict, "scalars": dict}
    return record if all(type(record.get(key)) is kind for key, kind in kinds.items()) else None
