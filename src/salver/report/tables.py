"""Numbers in rows: the scenario (the paper's Table I), what the solver did, how much of the arm is used."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from salver.models.bodies import uncertain_set
from salver.report.words import pretty, quantity

if TYPE_CHECKING:
    from salver.models.arm import ArmModel
    from salver.report.run import Motion, Run

Rows = list[tuple[str, str]]


def scenario_rows(run: Run) -> Rows:
    """What was asked, as the paper's Table I and beyond."""
    s, uncertain = run.scenario, uncertain_set(run.scenario)
    rows: Rows = [("scenario", s.name), ("source", s.source or "–")]
    rows += [
        ("start", _vector(s.motion.start.position, "m")),
        ("goal", _vector(s.motion.goal.position, "m")),
        ("duration", f"{run.plan.duration:.4g} s"),
        (
            "reference",
            f"polynomials of degree {s.motion.degree}, {s.motion.nodes} nodes, orientation {s.motion.orientation}",
        ),
        (
            "tray",
            f"{s.tray.size[0]:g} × {s.tray.size[1]:g} m, {s.tray.mass:g} kg, "
            f"inertia {_vector(s.tray.inertia, 'kg m²')}",
        ),
    ]
    for item, body in zip(s.objects, run.bodies, strict=True):
        inertia = body.inertial.inertia_com
        rows += [
            (item.name, f"{item.mass:g} kg, friction {item.friction:g}, {body.contacts.count} contacts"),
            (f"{item.name}, inertia", _vector(np.diag(inertia), "kg m²")),
        ]
    rows += [
        (f"± {pretty(name)}", quantity(name, half) + (f" ({100 * half / abs(nominal):.3g} %)" if nominal else ""))
        for name, nominal, half in zip(uncertain.names, uncertain.nominal, uncertain.half_range, strict=True)
    ]
    rows += [
        ("uncertain set", uncertain.kind),
        ("gains K_p", f"{s.control.kp[0]:g}, {s.control.kp[1]:g} 1/s² (translation, rotation)"),
        ("gains K_d", f"{s.control.kd[0]:g}, {s.control.kd[1]:g} 1/s"),
        ("contact condition", f"{s.contact.condition}, {s.contact.edges} edges a cone, margin {s.contact.margin:g} N"),
        ("arm", s.arm.model if s.arm else "none"),
    ]
    return rows


def solver_rows(run: Run) -> Rows:
    """plan.json, flattened: whatever it says."""
    rows: Rows = []
    for m in run.motions:
        rows += [(f"{m.label.lower()}: {key}", value) for key, value in _flatten(m.summary)]
    return rows


def _flatten(value: Mapping[str, Any], prefix: str = "") -> Rows:
    rows: Rows = []
    for key, item in value.items():
        name = f"{prefix}{key.replace('_', ' ')}"
        if isinstance(item, Mapping):
            rows += _flatten(item, f"{name}, ")
        elif isinstance(item, list) and len(item) > 8:
            rows.append((name, f"{len(item)} values"))
        elif item is not None and item != "" and item != []:
            rows.append((name, _text(item)))
    return rows


def _text(item: Any) -> str:
    if isinstance(item, bool):
        return "yes" if item else "no"
    if isinstance(item, float):
        return f"{item:.6g}"
    if isinstance(item, list):
        return ", ".join(_text(x) for x in item)
    return str(item)


def _vector(values: Any, unit: str) -> str:
    return f"({', '.join(f'{x:g}' for x in values)}) {unit}"


def arm_usage(m: Motion, arm: ArmModel) -> dict[str, np.ndarray]:
    """Largest share (n,) of each of the maker's limits over the motion. Jerk by differences of the acceleration."""
    limits = arm.limits
    middle, half = 0.5 * (limits.q_max + limits.q_min), 0.5 * (limits.q_max - limits.q_min)
    t, q, dq, ddq = (m.arrays[key] for key in ("t", "q", "dq", "ddq"))
    candidates: dict[str, tuple[np.ndarray, np.ndarray]] = {
        "position": (q - middle, half),
        "velocity": (dq, limits.velocity),
        "acceleration": (ddq, limits.acceleration),
        "jerk": (np.gradient(ddq, t, axis=0), limits.jerk),
        "torque": (m.arrays["tau"], limits.torque),
    }
    return {
        kind: np.abs(values / limit).max(axis=0)
        for kind, (values, limit) in candidates.items()
        if np.all(np.isfinite(limit))
    }
