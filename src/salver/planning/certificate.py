"""Digests that tie a plan's files together: of the scenario, of every array and of every field of the record.

A verdict holds only for the data that was judged. `certificate` returns a digest of each piece of that data, which is
stored with the plan; `check` names the pieces that were edited since. Results refer to a plan by the digest of its
certificate (`salver.run_directory.plan_digest`). It detects edited, mixed and damaged files; it is no signature.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Mapping
from pathlib import Path
from shlex import quote
from typing import TYPE_CHECKING, Any

import numpy as np

from salver.errors import FileFormatError
from salver.files import digest_of
from salver.run_directory import CERTIFICATE

if TYPE_CHECKING:
    from salver.scenario import Scenario


def certificate(scenario: Scenario, arrays: Mapping[str, np.ndarray], record: Mapping[str, Any]) -> dict[str, Any]:
    """Digests of each table of the resolved scenario, of the files it names, of each array and each field of a record.

    scenario: the resolved scenario. arrays: the arrays of the plan's .npz file, by name. record: the plan's .json file
    as it is read back.
    """
    resolved = scenario.model_dump(mode="json")
    return {
        "scenario": {key: digest_of(value) for key, value in resolved.items()},
        "files": {str(path): hashlib.sha256(path.read_bytes()).hexdigest() for path in _files(resolved)},
        "arrays": {name: _of_array(array) for name, array in arrays.items()},
        "record": {key: digest_of(value) for key, value in record.items() if key != CERTIFICATE},
    }


def check(
    directory: Path, stem: str, scenario: Scenario, arrays: Mapping[str, np.ndarray], record: Mapping[str, Any]
) -> None:
    """Raise FileFormatError, which names what differs, unless a plan's files agree with its certificate."""
    certified = record.get(CERTIFICATE)
    method = record.get("method")
    named = method in ("fastest", "safest", "least-sensitive", "robust") and method != scenario.plan.method
    asked = f" --{method}" if named else ""
    again = f"plan again with `salver plan {quote(f'{directory}/scenario.toml')}{asked} -o ANOTHER_DIRECTORY`"
    if not isinstance(certified, dict):
        raise FileFormatError(
            f"{directory / stem}.json has no certificate: {stem}.npz may differ from what was judged; {again}."
        )
    found = certificate(scenario, arrays, record)
    where = {
        "scenario": (f"{directory / 'scenario.toml'}", "key"),
        "files": ("a file that scenario.toml names", "file"),
        "arrays": (f"{directory / stem}.npz", "array"),
        "record": (f"{directory / stem}.json", "key"),
    }
    for part, (place, kind) in where.items():
        was, now = certified.get(part), found[part]
        if was == now:
            continue
        was = was if isinstance(was, dict) else {}
        different = [name for name in {**was, **now} if was.get(name) != now.get(name)]
        names = ", ".join(different[:3]) + (f" and {len(different) - 3} more" if len(different) > 3 else "")
        raise FileFormatError(
            f"{place} was edited since {directory / stem} was planned: {kind} {names} is not what was judged; put "
            f"back what was there, or {again}."
        )


def _of_array(array: np.ndarray) -> str:
    array = np.asarray(array)
    head = f"{array.dtype.str}{array.shape}".encode()
    return hashlib.sha256(head + np.ascontiguousarray(array).tobytes()).hexdigest()


def _files(value: Any) -> Iterator[Path]:
    """Files that a resolved scenario names (by absolute paths): a robot's description, meshes."""
    if isinstance(value, dict):
        value = list(value.values())
    if isinstance(value, list):
        for item in value:
            yield from _files(item)
    elif isinstance(value, str) and value.startswith("/") and Path(value).is_file():
        yield Path(value)
