"""Small damages: to bytes, to tables of keys and values, to elements of XML."""

from __future__ import annotations

import copy
import math
from collections.abc import Callable
from typing import Any
from xml.etree import ElementTree

import numpy as np

Rng = np.random.Generator

# Values that nobody means: of every type, empty, endless, hostile.
VALUES: tuple[Callable[[Rng], Any], ...] = (
    lambda rng: 0,
    lambda rng: -1,
    lambda rng: float(10.0 ** rng.integers(-300, 300)),
    lambda rng: -float(10.0 ** rng.integers(-12, 12)),
    lambda rng: math.nan,
    lambda rng: math.inf,
    lambda rng: int(rng.integers(2**62)),
    lambda rng: True,
    lambda rng: "",
    lambda rng: "[/]\x1b[31m<script>",
    lambda rng: "../" * 10 + "etc/passwd",
    lambda rng: "a\x00b",
    lambda rng: "x" * 10_000,
    lambda rng: "10%",
    lambda rng: [],
    lambda rng: {},
    lambda rng: [[[]]],
    lambda rng: [0.0] * int(rng.integers(1, 2000)),
    lambda rng: [1, "a", {}],
)


def damaged_bytes(rng: Rng, content: bytes) -> bytes:
    """A few bytes changed, cut out, doubled, put in, or the end cut off."""
    made = bytearray(content)
    for _ in range(rng.integers(1, 4)):
        if not made:
            return bytes(rng.integers(256, size=5, dtype=np.uint8))
        at, length = int(rng.integers(len(made))), int(rng.integers(1, 40))
        kind = rng.integers(6)
        if kind == 0:
            made[at] ^= 1 << int(rng.integers(8))
        elif kind == 1:
            made[at] = int(rng.integers(256))
        elif kind == 2:
            del made[at : at + length]
        elif kind == 3:
            made[at:at] = made[at : at + length] * int(rng.integers(1, 50))
        elif kind == 4:
            made[at:at] = rng.integers(256, size=length, dtype=np.uint8).tobytes()
        else:
            del made[at:]
    return bytes(made)


def damaged_tree(rng: Rng, data: Any, times: int | None = None) -> Any:
    """A few entries replaced, scaled, removed, doubled or renamed; gently: numbers changed by up to a half."""
    made, gently = copy.deepcopy(data), rng.random() < 0.5
    for _ in range(times or int(rng.integers(1, 4))):
        places = list(_places(made))
        if gently:
            places = [(p, k) for p, k in places if isinstance(p[k], int | float)]
        if not places:
            return made
        parent, key = places[rng.integers(len(places))]
        kind, value = rng.integers(8), parent[key]
        number = isinstance(value, int | float) and not isinstance(value, bool)
        if number and gently:
            parent[key] = type(value)(value * rng.uniform(0.5, 1.5))
        elif number and kind <= 2:
            factor = float(rng.choice([0.0, -1.0, 0.1, 0.9, 1.1, 10.0, 1e3, 1e-3, 1e6]))
            parent[key] = value * factor if math.isfinite(float(value)) else factor
        elif kind <= 4:
            parent[key] = VALUES[rng.integers(len(VALUES))](rng)
        elif kind == 5:
            del parent[key]
        elif kind == 6 and isinstance(parent, list):
            parent[key:key] = [copy.deepcopy(value) for _ in range(rng.integers(1, 60))]
        elif isinstance(parent, dict):
            parent[f"{key}x"] = parent.pop(key)
    return made


def _places(data: Any) -> Any:
    for key in range(len(data)) if isinstance(data, list) else list(data) if isinstance(data, dict) else ():
        yield data, key
        yield from _places(data[key])


def damaged_xml(rng: Rng, text: str) -> bytes:
    """Attributes changed, elements removed, doubled or moved; sometimes the bytes."""
    if rng.random() < 0.2:
        return damaged_bytes(rng, text.encode())
    root = ElementTree.fromstring(text)
    for _ in range(rng.integers(1, 5)):
        parents = [element for element in root.iter() if len(element)]
        if not parents:
            break
        parent = parents[rng.integers(len(parents))]
        child = parent[int(rng.integers(len(parent)))]
        kind = rng.integers(5)
        if kind <= 1 and child.attrib:
            key = list(child.attrib)[rng.integers(len(child.attrib))]
            others = [e.get(key) for e in root.iter() if e.get(key)]
            value = VALUES[rng.integers(len(VALUES))](rng) if rng.random() < 0.6 else others[rng.integers(len(others))]
            child.set(key, "".join(c for c in str(value) if c >= " "))
        elif kind == 2:
            parent.remove(child)
        elif kind == 3:
            parent.append(copy.deepcopy(child))
        else:
            root.append(child)
    return ElementTree.tostring(root)
