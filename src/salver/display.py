"""How results show themselves: one line in a console, a small table in a notebook."""

from __future__ import annotations

from collections.abc import Mapping
from html import escape


class Shown:
    """What has something to say about itself: `facts` gives it, in order; the first is the headline."""

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
