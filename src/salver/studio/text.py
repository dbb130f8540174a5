"""Edits of a scenario's text: values change in place, comments and order stay; mistakes have their line."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import tomlkit
from tomlkit.exceptions import TOMLKitError
from tomlkit.items import AoT

from salver.errors import SalverError, ScenarioError
from salver.scenario import Scenario
from salver.scenario.files import read

LONGEST = 200_000  # bytes of a text that is edited
HEADER = re.compile(r"(?m)^([^#\n].*\n)(\[+[A-Za-z_][\w.]*\]+)")  # of a table, right below another line
Key = Sequence[str | int]  # such as ["objects", 0, "mass"]


@dataclass(frozen=True)
class Mistake:
    """A mistake in a text, with its line, from 1."""

    line: int
    sentence: str


def changed(text: str, changes: Iterable[tuple[Key, Any]]) -> str:
    """The text with values put in place of others, or added; None takes a key out. An index one beyond the last
    adds to a list.

    Raises ScenarioError where the text has no such place.
    """
    try:
        document = tomlkit.parse(text)
        for key, value in changes:
            _put(document, key, value)
        found = tomlkit.dumps(document)
    except (TOMLKitError, LookupError, TypeError, ValueError) as error:
        raise ScenarioError(f"The text cannot be changed there; edit it by hand first ({error}).") from None
    if len(HEADER.findall(found)) > len(HEADER.findall(text)):  # a new table has an empty line before and after it
        found = HEADER.sub(r"\1\n\2", found)
    return found


def _put(document: Any, key: Key, value: Any) -> None:
    *parents, last = key
    table = document
    for at, part in enumerate(parents):
        if isinstance(part, str) and part not in table:
            if value is None:
                return
            table[part] = tomlkit.aot() if isinstance(key[at + 1], int) else tomlkit.table()
        table = table[part]
    if value is None:
        if isinstance(last, int) or last in table:
            del table[last]
        if isinstance(table, AoT) and not table:  # no table is left of them
            _put(document, parents, None)
    elif isinstance(last, int) and last == len(table):
        table.append(_table(value) if isinstance(table, AoT) else value)
    else:
        table[last] = _inline(value) if isinstance(value, dict) else value


def _table(values: dict[str, Any]) -> Any:
    """A table with inline ones in it."""
    table = tomlkit.table()
    for key, value in values.items():
        table[key] = _inline(value) if isinstance(value, dict) else value
    return table


def _inline(values: dict[str, Any]) -> Any:
    table = tomlkit.inline_table()
    table.update(values)
    return table


def checked(text: str, folder: Path, name: str = "scenario") -> Scenario | list[Mistake]:
    """The scenario of a text, or its mistakes. folder: folder of the files that the text names."""
    try:
        return read(text, name, folder)
    except ScenarioError as error:
        return mistakes(error, text, name)


def mistakes(error: SalverError, text: str, name: str = "scenario") -> list[Mistake]:
    """The sentences of an error, each at its line."""
    found = []
    for sentence in str(error).splitlines():
        at = re.search(r"at line (\d+)", sentence)
        key = re.match(r"(?:[^:\n]*: )?(?:unknown key )?([A-Za-z_][\w.\[\]]*)", sentence)
        line = int(at[1]) if at else _line(text, _place(text, key[1])) if key else 1
        if "end of document" in sentence:
            line = text.count("\n") + 1
        found.append(Mistake(line, sentence.removeprefix(f"{name}: ")))
    return found


def _place(text: str, word: str) -> str:
    """The key that a sentence begins with; of a name of an object, that of its table."""
    try:
        for k, item in enumerate(tomlkit.parse(text).get("objects", [])):
            if item.get("name") == word:
                return f"objects[{k}]"
    except (TOMLKitError, AttributeError):
        pass
    return word


def _line(text: str, key: str) -> int:
    """The line of a key such as objects[0].mass, or of the last of its tables that is there: 1 for none."""
    mark = "salver-is-here"
    try:
        place: Any = tomlkit.parse(text)
        path: list[str | int] = []
        for word in re.findall(r"[^.\[\]]+", key):
            part = int(word) if word.isdigit() else word
            try:
                place = place[part]
            except (LookupError, TypeError, TOMLKitError):
                break
            path.append(part)
        while path and isinstance(place, dict | AoT) and place:  # a table is where the first of its values is
            part = 0 if isinstance(place, AoT) else next(iter(place))
            path.append(part)
            place = place[part]
        if not path:
            return 1
        there = changed(text, [(path, mark)])
        return there.count("\n", 0, there.index(mark)) + 1
    except (ScenarioError, TOMLKitError, ValueError):
        return 1
