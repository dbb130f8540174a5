"""The parts of a scenario that can be dragged or set by a slider: keys of its text, values, ranges."""

from __future__ import annotations

from typing import Any

import numpy as np

from salver.models.arm.known_arms import KNOWN_ARMS
from salver.scenario import CarriedObject, Obstacle, Pose, Scenario, Tray
from salver.scenario.objects import Relative

LOADS: dict[str, dict[str, Any]] = {
    "box": {"shape": {"type": "box", "size": [0.08, 0.08, 0.1]}, "mass": 0.3, "friction": 0.4},
    "bottle": {"shape": {"type": "cylinder", "radius": 0.03, "height": 0.24}, "mass": 0.4, "friction": 0.4},
    "cup of coffee": {
        "shape": {"type": "cylinder", "radius": 0.043, "height": 0.085},
        "mass": 0.25,
        "friction": 0.4,
        "liquid": {"kind": "coffee", "radius": 0.04, "fill": 0.05, "brim": 0.08},
    },
}  # examples, as docs/scenario-file.md has them
OBSTACLES: dict[str, dict[str, Any]] = {
    "box": {"type": "box", "size": [0.1, 0.1, 0.2], "position": [0.5, 0.0, 0.1]},
    "sphere": {"type": "sphere", "radius": 0.08, "position": [0.5, 0.0, 0.2]},
}

Part = dict[str, Any]


def poses(scenario: Scenario, leg: int | None = None) -> list[tuple[str, list[str | int], Pose]]:
    """The poses that a task states, or those of one of its legs, in order: name, key of its table, pose."""
    motion, legs = scenario.motion, scenario.legs
    found: list[list[tuple[str, list[str | int], Pose]]] = []
    begin: tuple[list[str | int], Pose] = (["motion", "start"], motion.start)
    for k, (through, goal) in enumerate([(one.through, one.goal) for one in legs] or [(motion.through, motion.goal)]):
        own: list[str | int] = ["legs", k] if legs else ["motion"]
        between = [(f"via {i + 1}", [*own, "through", i], pose) for i, pose in enumerate(through)]
        found.append([("start", *begin), *between, ("goal", [*own, "goal"], goal)])
        begin = [*own, "goal"], goal
    if leg is not None:
        return found[leg]
    return [*found[0], *(one for rest in found[1:] for one in rest[1:])]


def parts(scenario: Scenario, leg: int = 0) -> list[Part]:
    """The parts of a scenario, each with its name and the key of its table. `handle`: key of the position that can be
    dragged, on the tray or in the world; `fields`: values that sliders set; `lists`: values that are chosen from
    several. leg: which one of several, 0 for the first; an object that it does not carry has no handle."""
    motion, carried = scenario.motion, {item.name for item in scenario.each_leg[leg].objects}
    found: list[Part] = [
        *(_pose(name, pose, key) for name, key, pose in poses(scenario, leg)),
        {
            "name": "motion",
            "key": ["motion"],
            "fields": [_field("duration", ["motion", "duration"], motion.duration or 0.0, 0.0, 5.0, "s", zero=True)],
            "lists": [
                _list("tray", ["motion", "orientation"], ["free", "fixed"], "free" if motion.may_turn else "fixed"),
                _list("heading at the start", ["motion", "start_yaw"], ["free", "fixed"], motion.start_yaw or "fixed"),
                _list("heading at the goal", ["motion", "goal_yaw"], ["free", "fixed"], motion.goal_yaw),
            ],
        },
        *(_object(item, k, len(scenario.objects) > 1, item.name in carried) for k, item in enumerate(scenario.objects)),
        *(_obstacle(item, k) for k, item in enumerate(scenario.obstacles)),
        {
            "name": "tray",
            "key": ["tray"],
            **({"handle": _flange(scenario.tray)} if scenario.arm else {}),
            "fields": [
                *_each("size", ["tray", "size"], scenario.tray.size, 0.05, 0.6, "m"),
                _field("height on the flange", ["tray", "height"], scenario.tray.height, 0.0, 0.3, "m"),
                *_each("aside", ["tray", "offset"], scenario.tray.offset, -0.3, 0.3, "m"),
                *_each("turn", ["tray", "rpy_deg"], scenario.tray.rpy_deg, -180.0, 180.0, "deg", "rpy"),
                _field("mass", ["tray", "mass"], scenario.tray.mass, 0.0, 3.0, "kg"),
            ],
        },
    ]
    if scenario.arm is not None:
        arm = scenario.arm
        names = sorted({*KNOWN_ARMS, arm.model})
        base = _each("base", ["arm", "base_position"], arm.base_position, -1.5, 1.5, "m")
        speeds = [
            _field(f"share of {kind}", ["arm", f"{kind}_scale"], getattr(arm, f"{kind}_scale"), 0.05, 1.0, "")
            for kind in ("velocity", "acceleration", "jerk", "torque")
        ]
        lists = [_list("arm", ["arm", "model"], names, arm.model)]
        found.append({"name": "arm", "key": ["arm"], "fields": [*base, *speeds], "lists": lists})
    return found


def _flange(tray: Tray) -> Part:
    """The flange, as it is dragged under the tray."""
    at_E = np.round(-tray.R_FE.T @ tray.p_FE, 6)
    return {"key": ["tray", "flange"], "at": at_E.tolist(), "of": "tray"}


def _pose(name: str, pose: Pose, key: list[str | int]) -> Part:
    fields = _each("position", [*key, "position"], pose.position, -1.5, 1.5, "m")
    if pose.quat_wxyz is None:
        fields += _each("turn", [*key, "rpy_deg"], pose.rpy_deg or (0.0, 0.0, 0.0), -180.0, 180.0, "deg", "rpy")
    handle = {"key": [*key, "position"], "at": list(pose.position), "of": "world"}
    return {"name": name, "key": key, "handle": handle, "fields": fields}


def _object(item: CarriedObject, k: int, several: bool, here: bool) -> Part:
    key: list[str | int] = ["objects", k]
    ranges, shape = item.uncertainty, item.shape
    high = item.loose().solid.height
    fields = [
        _field("mass", [*key, "mass"], item.mass, 0.01, max(3.0, 2 * item.mass), "kg"),
        _range("mass", key, ranges.mass, item.mass),
        _field("friction", [*key, "friction"], item.friction, 0.05, 1.2, ""),
        _range("friction", key, ranges.friction, item.friction),
        *_each("centre of mass", [*key, "com"], item.com, -0.5 * high, 0.5 * high, "m"),
        *_each("range of it, ±", [*key, "uncertainty", "com"], ranges.com or (0.0, 0.0, 0.0), 0.0, 0.1 * high, "m"),
    ]
    if item.liquid is not None:
        fields += [
            _field("fill", [*key, "liquid", "fill"], item.liquid.fill, 0.001, item.liquid.brim, "m"),
            _range("fill", key, ranges.fill, item.liquid.fill),
        ]
    if shape.type in ("box", "cylinder", "cone"):
        for name in ("size", "radius", "top_radius", "height"):
            value = getattr(shape, name, None)
            if value is not None:
                own = [*key, "shape", name]
                fields += (
                    _each(name, own, value, 0.01, 0.5, "m")
                    if isinstance(value, tuple)
                    else [_field(name, own, value, 0.005, 0.5, "m")]
                )
    fields += [
        *_each("place on the tray", [*key, "at"], item.at, -0.3, 0.3, "m"),
        _field("yaw", [*key, "yaw_deg"], item.yaw_deg, -180.0, 180.0, "deg"),
    ]
    return {
        "name": item.name,
        "key": key,
        "at": list(item.at),
        **({"handle": {"key": [*key, "at"], "at": list(item.at), "of": "tray"}} if here else {}),
        "fields": fields,
        "removable": several,
    }


def _obstacle(item: Obstacle, k: int) -> Part:
    key: list[str | int] = ["obstacles", k]
    fields = _each("position", [*key, "position"], item.position, -1.5, 1.5, "m")
    fields += _each("turn", [*key, "rpy_deg"], item.rpy_deg, -180.0, 180.0, "deg", "rpy")
    if item.size is not None:
        fields += _each("size", [*key, "size"], item.size, 0.01, 1.5, "m")
    fields += [
        _field(name, [*key, name], value, 0.01, 1.0, "m")
        for name in ("radius", "length", "height")
        if (value := getattr(item, name)) is not None
    ]
    handle = {"key": [*key, "position"], "at": list(item.position), "of": "world"}
    name = item.name if item.name != "obstacle" else f"obstacle {k + 1}"
    return {"name": name, "key": key, "handle": handle, "fields": fields, "removable": True}


def _field(label: str, key: list[str | int], value: float, low: float, high: float, unit: str, **more: Any) -> Part:
    """zero: at 0 the key is left out. each: the index of a vector of which it is one."""
    low, high = min(low, value), max(high, value)
    return {"label": label, "key": key, "value": value, "low": low, "high": high, "unit": unit, **more}


def _each(
    label: str, key: list[str | int], values: tuple[float, ...], low: float, high: float, unit: str, of: str = "xyz"
) -> list[Part]:
    """A field for each number of a vector, which is set as a whole."""
    named = zip(of, values, strict=False)
    return [
        _field(f"{label} {axis}", key, value, low, high, unit, each=k, whole=list(values))
        for k, (axis, value) in enumerate(named)
    ]


def _range(kind: str, key: list[str | int], half: float | Relative | None, nominal: float) -> Part:
    """Of a half-range, in per cent of the nominal value; 0 leaves it out."""
    share = half.relative if isinstance(half, Relative) else (half or 0.0) / nominal
    own = [*key, "uncertainty", kind]
    return _field(f"range of {kind}, ±", own, round(100 * share, 3), 0.0, 60.0, "%", percent=True, zero=True)


def _list(label: str, key: list[str | int], choices: list[str], value: str) -> Part:
    return {"label": label, "key": key, "choices": choices, "value": value}
