"""Reading and writing files atomically, without pickle; a damaged or foreign file is refused with a sentence."""

from __future__ import annotations

import contextlib
import filecmp
import hashlib
import io
import itertools
import json
import math
import os
import platform
import secrets
import shutil
import zipfile
import zlib
from collections.abc import Iterator, Mapping
from functools import cache
from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from salver.errors import FileFormatError, SalverError, reason

if TYPE_CHECKING:
    import numpy.typing as npt

# Packages whose version can change the numbers of a plan or of a simulation.
_RECORDED = ("numpy", "scipy", "piqp", "pin", "mujoco")


def write_atomic(path: str | Path, data: bytes | str, *, keep: bool = False) -> Path:
    """Write a file atomically: a reader of `path` sees the old content or all of the new. Returns `path`.

    keep: an existing file with other content is kept beside it, numbered (`set_aside`).
    Makes missing directories. Raises SalverError when `path` cannot be written.
    """
    path = Path(path)
    content = data.encode("utf-8") if isinstance(data, str) else data
    temporary = path.with_name(f".{path.name}.{secrets.token_hex(4)}.tmp")
    with writing(path):
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            with open(temporary, "xb") as file:
                file.write(content)
                file.flush()
                os.fsync(file.fileno())
            put_in_place(temporary, path, keep=keep)
        except BaseException:
            with contextlib.suppress(OSError):
                temporary.unlink()
            raise
    return path


@contextlib.contextmanager
def writing(path: Path) -> Iterator[None]:
    """Turn an OSError into a SalverError that names `path`."""
    try:
        yield
    except OSError as error:
        raise SalverError(f"{path} cannot be written: {reason(error)}.") from None


def put_in_place(made: Path, path: Path, *, keep: bool) -> None:
    """Rename a finished file to `path`; with keep, an existing different file is set aside first.

    Raises SalverError for a device or a pipe, which a file would replace.
    """
    if path.exists() and not (path.is_file() or path.is_dir()):
        raise SalverError(f"{path} is a device or a pipe; name a file.")
    if keep and path.is_file() and not filecmp.cmp(made, path, shallow=False):
        set_aside(path)
    os.replace(made, path)


@contextlib.contextmanager
def new_directory(path: Path, what: str) -> Iterator[Path]:
    """A context with the name of a directory to make, which is `path` once the context ends without an exception.

    what: what the directory is, such as "a ROS 2 bag". Raises SalverError when `path` exists or cannot be written.
    """
    if path.exists():
        raise SalverError(f"{path} exists; {what} is a new directory: name another with -o, or remove that one.")
    made = path.parent / f".{path.name}.{secrets.token_hex(4)}.tmp" / path.name
    try:
        with writing(path):
            made.parent.mkdir(parents=True)
            yield made
            made.rename(path)
    finally:
        shutil.rmtree(made.parent, ignore_errors=True)


def set_aside(*paths: Path) -> None:
    """Rename existing files `paths` with the first number that is free for all: plan.npz becomes plan-1.npz."""
    number = next(k for k in itertools.count(1) if not any(_numbered(path, k).exists() for path in paths))
    for path in paths:
        if path.exists():
            path.rename(_numbered(path, number))


def _numbered(path: Path, number: int) -> Path:
    return path.with_name(f"{path.stem}-{number}{path.suffix}")


def output_file(path: str | Path, endings: tuple[str, ...]) -> Path:
    """Check the output path of a user: it has one of the endings or none, and is not a file of a run directory.

    Raises SalverError, so that a page or a table never replaces a scenario or a plan.
    """
    path = Path(path)
    if path.suffix and path.suffix.lower() not in endings:
        raise SalverError(f"{path} is not a name for this output; it must end in {' or '.join(endings)}.")
    if path.is_dir():
        raise SalverError(f"{path} is a directory; name a file that ends in {' or '.join(endings)}.")
    if path.with_suffix(".npz").is_file() or (path.parent / "journal.jsonl").is_file():
        raise SalverError(f"{path} stands among the files of a run; name another place with -o.")
    return path


def save_result(path: str | Path, arrays: Mapping[str, npt.ArrayLike], summary: Mapping[str, Any]) -> Path:
    """Write PATH.npz and PATH.json; existing files of a different run are kept beside them, numbered."""
    place, content = Path(path).with_suffix(".npz"), npz_bytes(arrays)
    text = to_json(sealed({**summary, "arrays_digest": hashlib.sha256(content).hexdigest()}))
    if place.is_file() and place.read_bytes() != content:
        set_aside(place, place.with_suffix(".json"))
    write_atomic(place, content)
    write_atomic(place.with_suffix(".json"), text)
    return place


def read_result(path: str | Path, required: tuple[str, ...] = ()) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """Read the arrays and the summary that `save_result` wrote.

    Raises FileFormatError when the files are damaged, edited, or from different runs.
    """
    place = Path(path).with_suffix(".npz")
    arrays, summary = load_npz(place, required), read_sealed(place.with_suffix(".json"))
    if summary.pop("arrays_digest", None) != hashlib.sha256(place.read_bytes()).hexdigest():
        raise FileFormatError(f"{place} and {place.stem}.json are of different runs; make them again.")
    return arrays, summary


def npz_bytes(arrays: Mapping[str, npt.ArrayLike]) -> bytes:
    """The bytes of an .npz file of named arrays; equal arrays give equal bytes."""
    made = {name: np.asarray(value) for name, value in arrays.items()}
    for name, array in made.items():
        if array.dtype.hasobject:
            raise TypeError(f"array {name} holds Python objects; only numbers, booleans and strings can be stored")
    buffer = io.BytesIO()
    np.savez(buffer, **made)  # type: ignore[arg-type]
    return buffer.getvalue()


def load_npz(path: str | Path, required: tuple[str, ...] = ()) -> dict[str, np.ndarray]:
    """All arrays of a file of `npz_bytes`, read in full and checked against their checksums.

    Raises FileFormatError when the file is missing, truncated or not from salver, or lacks one of `required`.
    """
    path = Path(path)
    try:
        with np.load(path, allow_pickle=False) as file:
            if not isinstance(file, np.lib.npyio.NpzFile):
                raise ValueError
            arrays = {name: file[name] for name in file.files}
    except OSError as error:
        raise FileFormatError(f"{path} cannot be read: {reason(error)}.") from None
    except (ValueError, EOFError, KeyError, TypeError, zipfile.BadZipFile, zlib.error, NotImplementedError):
        raise FileFormatError(
            f"{path} is truncated or is not a file of arrays that salver wrote; write it again with the command "
            "it came from."
        ) from None
    missing = [name for name in required if name not in arrays]
    if missing:
        raise FileFormatError(f"{path} has no array {missing[0]}; it holds {', '.join(arrays) or 'none'}.")
    return arrays


def to_json(obj: Any) -> str:
    """JSON text of numbers, strings, NumPy scalars and arrays, mappings, sequences, paths.

    Numbers that are not finite become null, because JSON cannot represent them. Other types raise TypeError.
    """
    return json.dumps(_plain(obj), indent=2, allow_nan=False, ensure_ascii=False) + "\n"


def write_json(path: str | Path, obj: Any) -> Path:
    """Write `to_json(obj)` to a file, atomically."""
    return write_atomic(path, to_json(obj))


def read_text(path: str | Path) -> str:
    """Read a text file. Raises FileFormatError when it is missing or not UTF-8."""
    try:
        return Path(path).read_text(encoding="utf-8-sig")
    except OSError as error:
        raise FileFormatError(f"{path} cannot be read: {reason(error)}.") from None
    except UnicodeDecodeError:
        raise FileFormatError(f"{path} is not a text file in UTF-8.") from None


def read_json(path: str | Path) -> Any:
    """Read a JSON file. Raises FileFormatError when it is missing, truncated or not JSON."""
    text = read_text(path)
    try:
        return json.loads(text)
    except json.JSONDecodeError as error:
        raise FileFormatError(
            f"{path} is truncated or is not JSON: {error.msg} at line {error.lineno}, column {error.colno}."
        ) from None
    except (ValueError, RecursionError) as error:  # numbers of thousands of digits, deep nesting
        raise FileFormatError(f"{path} is not JSON that can be read ({type(error).__name__}).") from None


def sealed(obj: Mapping[str, Any]) -> dict[str, Any]:
    """A JSON object with its digest added, so that an edit by hand is detected."""
    plain: dict[str, Any] = _plain(obj)
    return {**plain, "digest": digest_of(plain)[:16]}


def read_sealed(path: str | Path) -> dict[str, Any]:
    """Read a JSON object that `sealed` made. Raises FileFormatError when its digest shows that it was edited."""
    found = read_json(path)
    if not isinstance(found, dict):
        raise FileFormatError(f"{path} is not a file that salver wrote: it holds a {type(found).__name__}.")
    if found.pop("digest", None) != digest_of(found)[:16]:
        raise FileFormatError(f"{path} was edited or damaged since salver wrote it; make it again.")
    return found


def digest_of(value: Any) -> str:
    """SHA-256 of a value that JSON can hold, independent of the order of its keys."""
    return hashlib.sha256(json.dumps(value, sort_keys=True).encode()).hexdigest()


def provenance(scenario: Any) -> dict[str, Any]:
    """Provenance of a result: a scenario's name, content hash and seed, and versions. Equal runs give equal records."""
    found = versions()
    return {
        "salver": found.pop("salver"),
        "scenario": scenario.name,
        "scenario_digest": scenario.digest,
        "seed": scenario.seed,
        "python": found.pop("python"),
        "platform": found.pop("platform"),
        "versions": found,
    }


def versions() -> dict[str, str]:
    """Versions of salver, Python, the platform, and the packages that can change numbers."""
    return {
        "salver": metadata.version("salver"),
        "python": platform.python_version(),
        "platform": f"{platform.system()} {platform.machine()}",
        **{name: found for name in _RECORDED if (found := _version(name))},
    }


@cache
def _version(name: str) -> str:
    """The version of a package; empty if it is not installed."""
    try:
        return metadata.version(name)
    except metadata.PackageNotFoundError:
        return ""


def _plain(obj: Any) -> Any:
    if obj is None or isinstance(obj, bool | str):
        return obj
    if isinstance(obj, np.ndarray):
        return _plain(obj.tolist())
    if isinstance(obj, np.generic):
        return _plain(obj.item())
    if isinstance(obj, int):
        return int(obj)
    if isinstance(obj, float):
        return obj if math.isfinite(obj) else None
    if isinstance(obj, dict) or hasattr(obj, "keys"):
        for key in obj:
            if not isinstance(key, str):
                raise TypeError(f"the key {key!r} is not a string; JSON objects have string keys")
        return {key: _plain(obj[key]) for key in obj}
    if isinstance(obj, list | tuple | set | frozenset):
        return [_plain(item) for item in (sorted(obj) if isinstance(obj, set | frozenset) else obj)]
    if isinstance(obj, Path):
        return str(obj)
    raise TypeError(f"a {type(obj).__name__} cannot be written as JSON")
