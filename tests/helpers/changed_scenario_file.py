"""The scenario file of the paper's cube, with some of its keys changed or taken away."""

from __future__ import annotations

import tomllib
from typing import Any

from salver import scenario

CUBE = (scenario.SCENARIO_DIR / "panda-cube.toml").read_text(encoding="utf-8")
GONE = object()


def changed(*changes: tuple[str, object]) -> dict[str, Any]:
    data = tomllib.loads(CUBE)
    for key, value in changes:
        *parents, last = key.split(".")
        target = data
        for part in parents:
            target = target[int(part)] if part.isdigit() else target.setdefault(part, {})
        if value is GONE:
            del target[last]
        else:
            target[last] = value
    return data
