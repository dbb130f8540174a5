"""Scenario files: the ready-made ones by name, others by path."""

from __future__ import annotations

import re
import tomllib
from difflib import get_close_matches
from pathlib import Path
from typing import Any

from salver.errors import ScenarioError, reason
from salver.run_directory import SCENARIO
from salver.scenario.model import Scenario, parse
from salver.wording import listed

SCENARIO_DIR = Path(__file__).parent.parent / "scenarios"


def load(name_or_path: str | Path) -> Scenario:
    """Load a ready-made scenario by name, a TOML file, or the scenario of a run directory. Raises ScenarioError."""
    path = Path(name_or_path)
    if path.suffix != ".toml":
        ready_made = SCENARIO_DIR / f"{name_or_path}.toml"
        found = next((file for file in (ready_made, path / SCENARIO) if file.is_file()), None)
        if found is None:
            raise ScenarioError(_unknown(str(name_or_path)))
        path = found
    return read(text_of(path), str(path), path.parent)


def text_of(path: Path, most: int = 1_000_000) -> str:
    """The text of a scenario file of at most so many bytes. Raises ScenarioError."""
    try:
        if path.stat().st_size > most:
            raise ScenarioError(f"{path} is larger than {most // 1000} kB; a scenario is a .toml file.")
        return path.read_text(encoding="utf-8-sig")
    except UnicodeDecodeError:
        raise ScenarioError(f"{path} is not a text file in UTF-8; a scenario is a .toml file.") from None
    except (OSError, ValueError) as error:
        raise ScenarioError(f"{path} cannot be read ({reason(error)}); a scenario is a .toml file.") from None


def read(text: str, where: str, folder: Path) -> Scenario:
    """Parse the text of a scenario file. Raises ScenarioError.

    where: name of the file in error messages. folder: where relative paths in the scenario start.
    """
    try:
        data = tomllib.loads(text)
    except (ValueError, RecursionError) as error:  # TOMLDecodeError, and numbers and nesting beyond Python's
        raise ScenarioError(f"{where} is not valid TOML: {_explained(error, text)}.") from None
    _find_files(data, folder)
    return parse(data, where)


def _unknown(name: str) -> str:
    """The error message for an unknown scenario, with similar names."""
    if Path(name).is_dir():
        return f"{name} is a directory without {SCENARIO}; give a .toml file, a run directory or a ready-made scenario."
    sentence = f'There is no ready-made scenario "{name}"'
    if Path(f"{name}.toml").is_file():
        return f"{sentence}; the file is {name}.toml."
    near = get_close_matches(name.lower().replace("_", "-"), names(), 3, 0.75)
    meant = f"; did you mean {listed(near, 'or')}? Known" if near else "; known"
    return f"{sentence}{meant} are {', '.join(names())}, or give a .toml file."


def _explained(error: Exception, text: str, letters: int = 60) -> str:
    """The error message of a TOML parser, with so many letters of the line that it is about."""
    said = str(error).replace("Cannot overwrite a value", "The same key is given twice")
    line = re.search(r"at line (\d+)", said)
    return said if line is None else f"{said}: {text.split(chr(10))[int(line[1]) - 1].strip()[:letters]}"


def _find_files(data: dict[str, Any], folder: Path) -> None:
    """Make the paths that a scenario names absolute; relative paths start at the scenario's folder."""

    def tables(value: Any) -> list[dict[str, Any]]:
        return [item for item in (value if isinstance(value, list) else [value]) if isinstance(item, dict)]

    def resolved(value: Any) -> Any:
        try:
            return str((folder / value).resolve()) if isinstance(value, str) else value
        except (OSError, RuntimeError, ValueError):  # a circle of links, a letter that no path has
            return value

    for arm in tables(data.get("arm")):
        if str(arm.get("model")).endswith((".urdf", ".xml", ".xacro")):
            arm["model"] = resolved(arm["model"])
        for key in ("srdf", "joint_limits"):
            if key in arm:
                arm[key] = resolved(arm[key])
        if isinstance(arm.get("package_dirs"), list):
            arm["package_dirs"] = [resolved(item) for item in arm["package_dirs"]]
    for item in tables(data.get("objects")):
        for shape in tables(item.get("shape")):
            if "file" in shape:
                shape["file"] = resolved(shape["file"])
    for obstacle in tables(data.get("obstacles")):
        if "file" in obstacle:
            obstacle["file"] = resolved(obstacle["file"])


def names() -> list[str]:
    """Names of the ready-made scenarios."""
    return sorted(p.stem for p in SCENARIO_DIR.glob("*.toml"))
