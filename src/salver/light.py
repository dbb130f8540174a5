"""Frozen dataclasses that are made by the thousand."""

from __future__ import annotations

from dataclasses import MISSING, fields
from functools import wraps
from typing import Any, TypeVar

T = TypeVar("T")


def light(made: type[T]) -> type[T]:
    """The same frozen dataclass, of which an object is made in a fifth of the time: its fields are put where they are
    kept, without asking each time the guard that keeps them from being changed.

    Without factories and `__post_init__`; as dataclasses do, this writes the function that it needs.
    """
    of = fields(made)  # type: ignore[arg-type]
    where: dict[str, Any] = {"unless": {field.name: field.default for field in of}}
    given = [field.name + f"=unless[{field.name!r}]" * (field.default is not MISSING) for field in of]
    puts = [f"    known[{field.name!r}] = {field.name}\n" for field in of]
    exec(f"def __init__(self, {', '.join(given)}):\n    known = self.__dict__\n{''.join(puts)}", where)
    made.__init__ = wraps(made.__init__)(where["__init__"])  # type: ignore[method-assign]
    return made
