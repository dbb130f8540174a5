"""Display of results: one line in a console, a small table in a notebook."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields
from html import escape
from typing import Any

SHORT = 40  # longest value of an outline, characters


class Shown:
    """A result with facts to display, in order; the first is the headline."""

    __slots__ = ()

    def facts(self) -> Mapping[str, str]:
        """Label to value, in words."""
        raise NotImplementedError

    def __repr__(self) -> str:
        (_, headline), *others = self.facts().items()
        rest = "".join(f", {label} {value}" for label, value in others[:3])
        return f"<{type(self).__name__} {headline}{rest}>"

    def _repr_html_(self) -> str:
        rows = "".join(
            f'<tr><th style="text-align:left">{escape(label)}</th><td style="text-align:left">{escape(value)}</td></tr>'
            for label, value in self.facts().items()
        )
        return f"<table><caption>{escape(type(self).__name__)}</caption>{rows}</table>"


class Outlined:
    """A dataclass (repr=False) of arrays, which shows their shapes and not their numbers."""

    __slots__ = ()

    def __repr__(self) -> str:
        own: Any = self
        known = ((item.name, getattr(self, item.name)) for item in fields(own))
        told = ", ".join(f"{name} {_outline(value)}" for name, value in known if value is not None)
        return f"<{type(self).__name__} {told}>"


def _outline(value: Any) -> str:
    if hasattr(value, "shape"):
        return "×".join(map(str, value.shape)) or "number"
    if isinstance(value, tuple | list | dict) and len(repr(value)) > SHORT:
        return f"{len(value)} of them"
    return text if len(text := repr(value)) <= SHORT else type(value).__name__
