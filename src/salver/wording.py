"""Words for people."""

from __future__ import annotations

from collections.abc import Iterable


def listed(names: Iterable[str], before_last: str = "and") -> str:
    """Names in a row: "a, b and c"."""
    found = list(names)
    return found[0] if len(found) == 1 else f"{', '.join(found[:-1])} {before_last} {found[-1]}"
