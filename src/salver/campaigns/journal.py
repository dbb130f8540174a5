"""The journal: one line for each finished run, appended at once, so that a kill at any moment loses nothing finished.

A line that was cut off by the kill is dropped on reading, and that run is done again. So is a line that was damaged
since (each carries a checksum); the journal is then kept as it was, numbered, beside the repaired one. One process
writes; a lock that the operating system gives up when the process dies keeps a second one out.
"""

from __future__ import annotations

import fcntl
import json
import os
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from salver.errors import SalverError
from salver.files import set_aside, write_atomic

Record = Mapping[str, Any]
Item = tuple[str, int]  # (stem, run)


class Journal:
    """Records of finished runs by (stem, run); `with` holds the lock."""

    def __init__(self, folder: Path) -> None:
        self.path = folder / "journal.jsonl"
        self._lock_path = folder / "lock"
        self.records: dict[Item, Record] = {}
        self.notes: list[str] = []  # what was found damaged, as sentences

    def __enter__(self) -> Journal:
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            self._lock = os.open(self._lock_path, os.O_RDWR | os.O_CREAT, 0o644)
        except OSError as error:
            raise SalverError(f"{self.path.parent} cannot be written to ({error.strerror}).") from None
        try:
            fcntl.flock(self._lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            os.close(self._lock)
            raise SalverError(
                f"Another campaign is running in {self.path.parent}; wait until it ends or stop it."
            ) from None
        try:
            self._repair()
            self._file = os.open(self.path, os.O_RDWR | os.O_CREAT | os.O_APPEND, 0o644)
        except OSError as error:
            os.close(self._lock)
            raise SalverError(f"{self.path} cannot be read and written ({error.strerror}).") from None
        except SalverError:
            os.close(self._lock)
            raise
        return self

    def __exit__(self, *_: object) -> None:
        os.close(self._file)
        os.close(self._lock)

    def append(self, record: Record) -> None:
        """Add a finished run, to the disk before the next one. Raises SalverError when the disk is full or gone."""
        left = memoryview(_line(record))
        try:
            while left:
                left = left[os.write(self._file, left) :]
            os.fsync(self._file)
        except OSError as error:
            raise SalverError(
                f"{self.path} cannot be written ({error.strerror}); finished runs are kept; the same command goes on."
            ) from None
        self.records[record["stem"], record["run"]] = record

    def _repair(self) -> None:
        """Take in all sound lines; what is between them is set aside, with a note, and what was cut off is dropped."""
        if not self.path.is_file():
            return
        *lines, cut = self.path.read_bytes().split(b"\n")
        sound, damaged = [], []
        for number, line in enumerate(lines, 1):
            record = _record(line)
            if record is None:
                damaged.append(number)
            else:
                sound.append(line)
                self.records[record["stem"], record["run"]] = record
        if damaged:
            set_aside(self.path)
            shown = ", ".join(map(str, damaged[:5])) + (", ..." if len(damaged) > 5 else "")
            what = f"line {shown} is" if len(damaged) == 1 else f"{len(damaged)} lines ({shown}) are"
            self.notes.append(f"{self.path}: {what} damaged; what was lost is made again, the damaged file is kept.")
        if damaged or cut:
            write_atomic(self.path, b"".join(line + b"\n" for line in sound))


def _line(record: Record) -> bytes:
    """A record as a line, with the checksum of the rest."""
    return _dumped({**record, "check": _check(record)}) + b"\n"


def _dumped(record: Record) -> bytes:
    return json.dumps(record, separators=(",", ":")).encode()


def _check(record: Record) -> int:
    return zlib.crc32(_dumped(record))


def _record(line: bytes) -> dict[str, Any] | None:
    """The record of a line, or None when it is not what was written."""
    try:
        record = json.loads(line)
        if record.pop("check") != _check(record):
            return None
    except (ValueError, TypeError, KeyError, AttributeError, RecursionError):
        return None
    kinds = {"stem": str, "run": int, "outcome": str, "parameters": dict, "scalars": dict}
    return record if all(type(record.get(key)) is kind for key, kind in kinds.items()) else None
