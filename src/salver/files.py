"""Reading and writing: atomically, without pickle, and with a sentence when a file is not what it should be."""

from __future__ import annotations

import contextlib
import io
import json
import math
import os
import platform
import secrets
import zipfile
import zlib
from functools import cache
from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from salver.errors import FileFormatError, SalverError

if TYPE_CHECKING:
    import numpy.typing as npt

    from salver.scenario import Scenario

# Packages whose version can change the numbers of a plan or of a simulation.
_RECORDED = ("numpy", "scipy", "casadi", "piqp", "pin", "mujoco")


def write_atomic(path: str | Path, data: bytes | str) -> Path:
    """Write a whole file or nothing: whoever reads `path` sees the old content or all of the new.

    Makes the directories that are missing. Raises SalverError when the place cannot be written to.
    """
    path = Path(path)
    content = data.encode("utf-8") if isinstance(data, str) else data
    temporary = path.with_name(f".{path.name}.{secrets.token_hex(4)}.tmp")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with open(temporary, "xb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, path)
    except BaseException as error:
        with contextlib.suppress(OSError):
            temporary.unlink()
        if isinstance(error, OSError):
            raise SalverError(f"{path} cannot be written: {_reason(error)}.") from None
        raise
    return path


def save_npz(path: str | Path, /, **arrays: npt.ArrayLike) -> Path:
    """Write named arrays, atomically. The same arrays give the same bytes."""
    made = {name: np.asarray(value) for name, value in arrays.items()}
    for name, array in made.items():
        if array.dtype.hasobject:
            raise TypeError(f"array {name} holds Python objects; only numbers, booleans and strings can be stored")
    buffer = io.BytesIO()
    np.savez(buffer, **made)  # type: ignore[arg-type]
    return write_atomic(path, buffer.getvalue())


def load_npz(path: str | Path, required: tuple[str, ...] = ()) -> dict[str, np.ndarray]:
    """All arrays of a file of `save_npz`, read in full and checked against their checksums.

    Raises FileFormatError when the file is missing, truncated or foreign, or lacks one of `required`.
    """
    path = Path(path)
    try:
        with np.load(path, allow_pickle=False) as file:
            if not isinstance(file, np.lib.npyio.NpzFile):
                raise ValueError
            arrays = {name: file[name] for name in file.files}
    except OSError as error:
        raise FileFormatError(f"{path} cannot be read: {_reason(error)}.") from None
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

    What is not finite becomes null, because JSON has no word for it. Anything else raises TypeError.
    """
    return json.dumps(_plain(obj), indent=2, allow_nan=False, ensure_ascii=False) + "\n"


def write_json(path: str | Path, obj: Any) -> Path:
    """`to_json` into a file, atomically."""
    return write_atomic(path, to_json(obj))


def read_json(path: str | Path) -> Any:
    """Raises FileFormatError when the file is missing, truncated or not JSON."""
    path = Path(path)
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise FileFormatError(f"{path} cannot be read: {_reason(error)}.") from None
    except UnicodeDecodeError:
        raise FileFormatError(f"{path} is not JSON: it is not text in UTF-8.") from None
    except json.JSONDecodeError as error:
        raise FileFormatError(
            f"{path} is truncated or is not JSON: {error.msg} at line {error.lineno}, column {error.colno}."
        ) from None


def provenance(scenario: Scenario) -> dict[str, Any]:
    """What made a result: scenario, its content hash and seed, versions. The same run gives the same record."""
    return {
        "salver": _version("salver"),
        "scenario": scenario.name,
        "scenario_digest": scenario.digest,
        "seed": scenario.seed,
        "python": platform.python_version(),
        "platform": f"{platform.system()} {platform.machine()}",
        "versions": {name: _version(name) for name in _RECORDED},
    }


@cache
def _version(package: str) -> str:
    return metadata.version(package)


def _reason(error: OSError) -> str:
    return error.strerror.lower() if error.strerror else str(error)


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
                raise TypeError(f"the key {key!r} is no string; JSON objects have string keys")
        return {key: _plain(obj[key]) for key in obj}
    if isinstance(obj, list | tuple | set | frozenset):
        return [_plain(item) for item in (sorted(obj) if isinstance(obj, set | frozenset) else obj)]
    if isinstance(obj, Path):
        return str(obj)
    raise TypeError(f"a {type(obj).__name__} cannot be written as JSON")
