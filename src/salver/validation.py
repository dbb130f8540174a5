"""Convert pydantic's errors to one sentence for each mistake: file, key, value, what would be accepted.

What would be accepted comes from the types and bounds of the model, so that it cannot go out of date, or from the
description of a type that has one.
"""

from __future__ import annotations

import difflib
import json
import types
from collections.abc import Iterable
from functools import reduce
from typing import Annotated, Any, Literal, Union, get_args, get_origin

import annotated_types
from pydantic import BaseModel, ValidationError
from pydantic.fields import FieldInfo

from salver.wording import listed

_COUNTS = {1: "one", 2: "two", 3: "three", 4: "four", 5: "five", 6: "six"}


def sentences(error: ValidationError, model: type[BaseModel], data: Any, where: str) -> list[str]:
    """One sentence for each wrong key of `data`, which `model` refused. where: name of the file."""
    said: dict[str, str] = {}
    for item in error.errors():
        if item["type"] == "default_factory_not_called":  # its default depends on another key, which is wrong
            continue
        keys, accepted = _locate(model, data, item["loc"])
        said.setdefault(_path(keys), _sentence(item, model, data, keys, accepted, where))
    return list(said.values())


def _sentence(item: Any, model: type[BaseModel], data: Any, keys: tuple[Any, ...], accepted: Any, where: str) -> str:
    key = _path(keys)
    if item["type"] == "extra_forbidden":
        return f"{where}: unknown key {key}{_suggestion(model, data, keys)}."
    if item["type"] == "value_error":
        text = str(item.get("ctx", {}).get("error", item["msg"]))
        return f"{where}: {key}: {text}." if key else f"{where}: {text}."
    if item["type"] == "missing" and not _present(data, keys):
        return f"{where}: {key} is missing; it must be {in_words(accepted)}."
    return f"{where}: {key}{_shown(data, keys)}: must be {in_words(accepted)}."


def _locate(model: Any, data: Any, loc: tuple[Any, ...]) -> tuple[tuple[Any, ...], Any]:
    """The path of keys as the user wrote them, and the type that the last one must have.

    The path stops at what the user sees as one value (a number, a vector); pydantic's location also names members of
    unions and tuples.
    """
    keys: list[Any] = []
    annotation: Any = model
    value = data
    for part in loc:
        inner = _structured(annotation, value)
        if inner is None:
            break
        if isinstance(part, int):
            annotation = inner
        elif isinstance(inner, type) and issubclass(inner, BaseModel):
            if part not in inner.model_fields:
                if isinstance(value, dict) and part in value:
                    keys.append(part)  # an unknown key
                    break
                continue  # pydantic's name for a member of a union
            annotation = inner.model_fields[part]
        keys.append(part)
        value = _get(value, part)
    return tuple(keys), annotation


def _structured(annotation: Any, value: Any) -> Any:
    """The model of a table, or of the tables in a list; None for a plain value."""
    if isinstance(annotation, FieldInfo):
        annotation = annotation.annotation
    origin, args = get_origin(annotation), get_args(annotation)
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return annotation
    if origin is list:
        return args[0] if not isinstance(value, list) or _structured(args[0], None) is not None else None
    if origin is Annotated:
        if _description(args[1:]):
            return None
        return _structured(args[0], value)
    if origin in (Union, types.UnionType):
        members = [m for m in (_structured(a, value) for a in args if a is not type(None)) if m is not None]
        kind = value.get("type") if isinstance(value, dict) else None
        for member in members:
            if isinstance(member, type) and _tag(member) is not None and _tag(member) == kind:
                return member
        return members[0] if len(members) == 1 or (members and kind is None and value is None) else None
    return None


def in_words(annotation: Any, metadata: Iterable[Any] = ()) -> str:
    """The values that a type accepts, in words."""
    if isinstance(annotation, FieldInfo):
        return annotation.description or in_words(annotation.annotation, annotation.metadata)
    metadata = list(metadata)
    described = _description(metadata)
    if described:
        return described
    origin, args = get_origin(annotation), get_args(annotation)
    if origin is Annotated:
        return in_words(args[0], [*args[1:], *metadata])
    if origin in (Union, types.UnionType):
        return _union_in_words([a for a in args if a is not type(None)], metadata)
    if origin is Literal:
        return listed(map(json.dumps, args), "or")
    if origin is tuple:
        return _each(_COUNTS[len(args)], args[0])
    if origin is list:
        return "a list of " + _many(args[0]) + _length(metadata)
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return f"a table with the keys {', '.join(annotation.model_fields)}"
    if annotation is int:
        return "a whole number" + _bounds(metadata)
    if annotation is float:
        return "a finite number" + _bounds(metadata)
    return "text" if annotation is str else "a table"


def _union_in_words(members: list[Any], metadata: list[Any]) -> str:
    tags = [_tag(_bare(m)) for m in members]
    if len(members) > 1 and all(tags):
        return f"a table whose type is {listed(map(json.dumps, tags), 'or')}"
    if len(members) > 1 and all(get_origin(_bare(m)) is tuple for m in members):
        counts = listed((_COUNTS[len(get_args(_bare(m)))] for m in members), "or")
        return _each(counts, get_args(_bare(members[0]))[0])
    return listed(dict.fromkeys(in_words(m, metadata) for m in members), "or")


def _each(count: str, element: Any) -> str:
    bounds = in_words(element).removeprefix("a finite number").strip()
    return f"{count} finite numbers, each {bounds}" if bounds else f"{count} finite numbers"


def _many(element: Any) -> str:
    bare = _bare(element)
    if get_origin(bare) is tuple:
        return f"points of {_COUNTS[len(get_args(bare))]} finite numbers"
    return "tables" if _structured(element, None) is not None or get_origin(bare) is Union else "finite numbers"


def _bounds(metadata: list[Any]) -> str:
    said = []
    for limit in _flat(metadata):
        for kind, attribute, words in (
            (annotated_types.Gt, "gt", "greater than"),
            (annotated_types.Ge, "ge", "at least"),
            (annotated_types.Lt, "lt", "less than"),
            (annotated_types.Le, "le", "at most"),
        ):
            if isinstance(limit, kind):
                said.append(f"{words} {_figure(getattr(limit, attribute))}")
    return " " + " and ".join(said) if said else ""


def _figure(value: float) -> str:
    return str(int(value)) if value == int(value) and (isinstance(value, int) or abs(value) < 1e6) else f"{value:g}"


def _length(metadata: list[Any]) -> str:
    least = [m.min_length for m in _flat(metadata) if isinstance(m, annotated_types.MinLen)]
    most = [m.max_length for m in _flat(metadata) if isinstance(m, annotated_types.MaxLen)]
    said = [f"at least {_COUNTS[least[0]]}"] if least else []
    said += [f"at most {most[0]}"] if most else []
    return f", {' and '.join(said)}" if said else ""


def _flat(metadata: Iterable[Any]) -> list[Any]:
    return [x for m in metadata for x in (m.metadata if isinstance(m, FieldInfo) else [m])]


def _description(metadata: Iterable[Any]) -> str | None:
    return next((m.description for m in metadata if isinstance(m, FieldInfo) and m.description), None)


def _bare(annotation: Any) -> Any:
    return get_args(annotation)[0] if get_origin(annotation) is Annotated else annotation


def _tag(model: Any) -> str | None:
    """The value of `type` that selects this model in a union of tables."""
    field = getattr(model, "model_fields", {}).get("type")
    return get_args(field.annotation)[0] if field is not None and get_origin(field.annotation) is Literal else None


def _suggestion(model: type[BaseModel], data: Any, keys: tuple[Any, ...]) -> str:
    """Part of a sentence with the valid key most similar to an unknown one, or with all valid keys."""
    _, annotation = _locate(model, data, keys[:-1])
    fields = list(getattr(_structured(annotation, reduce(_get, keys[:-1], data)), "model_fields", {}))
    close = difflib.get_close_matches(str(keys[-1]), fields, n=1)
    return f"; did you mean {close[0]}" if close else f"; accepted are {', '.join(fields)}"


def _get(value: Any, key: Any) -> Any:
    try:
        return value[key]
    except (KeyError, IndexError, TypeError):
        return None


def _present(data: Any, keys: tuple[Any, ...]) -> bool:
    beside = reduce(_get, keys[:-1], data)
    return isinstance(beside, list) or (isinstance(beside, dict) and keys[-1] in beside)


def _shown(data: Any, keys: tuple[Any, ...]) -> str:
    value = reduce(_get, keys, data)
    if isinstance(value, dict):
        return ""
    text = json.dumps(value, default=str, ensure_ascii=False).replace("NaN", "nan").replace("Infinity", "inf")
    return f" = {text if len(text) <= 80 else text[:77] + '...'}"


def _path(keys: tuple[Any, ...]) -> str:
    text = ""
    for key in keys:
        text += f"[{key}]" if isinstance(key, int) else f".{key}" if text else str(key)
    return text
