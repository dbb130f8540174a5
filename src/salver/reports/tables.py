"""Numbers in rows: the scenario (the paper's Table I), what the solver did, how much of the arm is used."""

from __future__ import annotations

import csv
import io
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from salver.files import write_atomic
from salver.models.arm.arm_limits import LIMITS
from salver.planning.object.conditions import UNITS
from salver.reports.parameters import ranges

if TYPE_CHECKING:
    from salver.models.arm.arm import ArmModel
    from salver.reports.perturbed import Perturbed
    from salver.reports.run import ReportedMotion, ReportedRun
    from salver.scenario import Obstacle

Rows = list[tuple[str, str]]


def scenario_rows(run: ReportedRun) -> Rows:
    """The task, as the paper's Table I and beyond."""
    s, uncertain = run.scenario, run.scenario.payload.uncertain
    rows: Rows = [("scenario", s.name), ("source", s.source or "–")]
    rows += [
        ("start", _vector(s.motion.start.position, "m")),
        ("goal", _vector(s.motion.goal.position, "m")),
        ("duration", f"{run.plan.duration:.4g} s"),
        (
            "reference",
            f"polynomials of degree {s.motion.degree}, {s.motion.nodes} nodes, "
            f"orientation {'free' if s.motion.may_turn else 'fixed'}",
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
    rows += [(f"± {name}", half) for name, _, half in ranges(uncertain)]
    rows += [
        ("uncertain set", uncertain.kind),
        ("gains K_p", f"{s.control.kp[0]:g}, {s.control.kp[1]:g} 1/s² (translation, rotation)"),
        ("gains K_d", f"{s.control.kd[0]:g}, {s.control.kd[1]:g} 1/s"),
        (
            "contact condition",
            f"{s.contact.condition}, {s.contact.edges} edges a cone, "
            f"margin {s.contact.margin:g} {UNITS[s.contact.condition]}",
        ),
        ("arm", s.arm.model if s.arm else "none"),
    ]
    return rows + [(obstacle.name, _obstacle(obstacle)) for obstacle in s.obstacles]


def _obstacle(obstacle: Obstacle) -> str:
    """An obstacle in words: what it is, how large, where."""
    sizes = {
        "box": lambda: f"{_vector(obstacle.size, 'm')}",
        "sphere": lambda: f"radius {obstacle.radius:g} m",
        "mesh": lambda: Path(obstacle.file or "").name,
    }
    size = sizes.get(obstacle.type, lambda: f"radius {obstacle.radius:g} m, length {obstacle.length:g} m")()
    return f"obstacle, {obstacle.type}, {size}, at {_vector(obstacle.position, 'm')}"


def solver_rows(run: ReportedRun) -> Rows:
    """How each motion was found, and its provenance; all of plan.json is on the page besides."""
    rows: list[tuple[str, Any]] = []
    for m in run.motions:
        name, summary = m.label.lower(), m.summary
        solver = summary.get("solver") or {}
        rows += [
            (f"{name}: result", summary.get("status", {}).get("sentence")),
            (f"{name}: check", summary.get("verification", {}).get("sentence")),
            (f"{name}: arm", summary.get("arm", {}).get("sentence")),
            (f"{name}: wrong parameters", _arm_chain(summary.get("arm_chain"), summary.get("verification", {}))),
            (f"{name}: solver", solver.get("name")),
            (f"{name}: sensitivity cost, eq (13)", _text(summary.get("cost"))),
            (f"{name}: weighting", summary.get("weighting") if solver else None),
        ]
    made = run.plan.summary.get("provenance", {})
    versions = ", ".join(f"{key} {value}" for key, value in made.get("versions", {}).items())
    rows += [
        ("scenario digest", made.get("scenario_digest")),
        ("seed", _text(made.get("seed"))),
        ("made by", f"salver {made['salver']}, Python {made.get('python')}, {made.get('platform')}" if made else None),
        ("with", versions),
    ]
    return [(name, str(value)) for name, value in rows if value]


def _arm_chain(chain: Mapping[str, Any] | None, check: Mapping[str, Any]) -> str | None:
    """Effect of parameter errors through the arm's controller, to first order."""
    if not chain or "tray_position_radius" not in chain:
        return None
    text = (
        f"They move the tray by at most {1e3 * chain['tray_position_radius']:.2g} mm and "
        f"{1e3 * chain['tray_rotation_radius']:.2g} mrad; torques reach {100 * chain['torque_share']:.0f} % of the "
        "limits"
    )
    if chain.get("contact_slack") is not None:
        text += f"; the contact condition keeps {chain['contact_slack']:.3g} {check.get('unit', '')}".rstrip()
    return text + "."


def _text(item: Any) -> str | None:
    return f"{item:.6g}" if isinstance(item, int | float) else item


def _vector(values: Any, unit: str) -> str:
    return f"({', '.join(f'{x:g}' for x in values)}) {unit}"


def arm_usage(m: ReportedMotion, arm: ArmModel) -> dict[str, np.ndarray]:
    """Largest share (n,) of each of the arm's limits over the motion, NaN for a joint that has none.

    Jerk by differences of the acceleration. Kinds that no joint has are left out.
    """
    t, q, dq, ddq = (m.arrays[key] for key in ("t", "q", "dq", "ddq"))
    curves = {"position": q, "velocity": dq, "acceleration": ddq, "jerk": np.gradient(ddq, t, axis=0)}
    curves |= {"torque": m.arrays["tau"]} if "tau" in m.arrays else {}
    shares = arm.limits.shares(curves)
    known = {kind.key: np.isfinite(arm.limits.range(kind)[1]) for kind in LIMITS}
    return {
        key: np.where(known[key], np.abs(share).max(axis=0), np.nan)
        for key, share in shares.items()
        if known[key].any()
    }


def numbers_table(run: ReportedRun, rollouts: Mapping[str, Perturbed]) -> list[Sequence[str]]:
    """The numbers behind the figures, one column a motion, in SI units with their unit in the first column; headings
    first."""
    curves = run.contact
    rows: list[Sequence[str]] = [("quantity", *(m.label.lower() for m in run.motions))]

    def add(label: str, value: Callable[[ReportedMotion], float | int | str | None]) -> None:
        values = [value(m) for m in run.motions]
        if any(v is not None for v in values):
            rows.append([label, *("" if v is None else f"{v:.6g}" if isinstance(v, float) else str(v) for v in values)])

    add("duration [s]", lambda m: m.duration)
    add("sensitivity cost, eq (13)", lambda m: m.summary.get("cost"))
    add("length of the path [m]", lambda m: float(np.linalg.norm(np.diff(m.arrays["p_SB"], axis=0), axis=1).sum()))
    add("highest above the straight line [m]", lambda m: float(_rise(m).max()))
    add("lowest below the straight line [m]", lambda m: float(_rise(m).min()))
    add("least cone coefficient, nominal [N]", lambda m: float(m.arrays["cone_coefficients"].min()))
    add("least cone coefficient, lower edge of its tube [N]", lambda m: float(m.cone_floor.min()))
    add("widest tube radius of a coefficient [N]", lambda m: float(m.arrays["cone_radius"].max()))
    add(
        "integral of the largest tube radius [N s]",
        lambda m: float(np.trapezoid(m.arrays["cone_radius"].max(axis=1), m.t)),
    )
    add("friction needed, nominal, share of what there is", lambda m: float(curves[m.stem].friction.max()))
    add("least exact margin, nominal, share of the weight", lambda m: float(curves[m.stem].nominal.min()))
    add("least exact margin, worst case, share of the weight", lambda m: float(curves[m.stem].worst.min()))
    add("least tip-over margin, nominal [m]", lambda m: float(curves[m.stem].tip.min()))
    add("least tip-over margin, worst case [m]", lambda m: float(curves[m.stem].tip_worst.min()))
    add("perturbed bodies", lambda m: len(rollouts[m.stem].rollout.cone_coefficients))
    add("perturbed bodies that left a tube", lambda m: rollouts[m.stem].coverage.left)
    add("furthest out of a tube [N]", lambda m: float(rollouts[m.stem].coverage.excess.max()))
    add("least cone coefficient, perturbed [N]", lambda m: float(rollouts[m.stem].rollout.cone_coefficients.min()))
    add("largest position deviation, perturbed [m]", lambda m: _deviation(rollouts[m.stem], slice(0, 3)))
    add("largest rotation deviation, perturbed [rad]", lambda m: _deviation(rollouts[m.stem], slice(3, 6)))
    add("solver", lambda m: (m.summary.get("solver") or {}).get("name"))
    add("solver time [s]", lambda m: (m.summary.get("solver") or {}).get("seconds"))
    return rows


def _rise(m: ReportedMotion) -> np.ndarray:
    """Height (T,) above the straight line from start to goal, at the same progress along it."""
    p = m.arrays["p_SB"]
    line = p[-1] - p[0]
    progress = (p - p[0]) @ line / max(float(line @ line), 1e-12)
    return p[:, 2] - (p[0, 2] + progress * line[2])


def _deviation(runs: Perturbed, rows: slice) -> float:
    return float(np.linalg.norm(runs.rollout.deviation[:, :, rows], axis=2).max())


def write_table(stem: Path, rows: Sequence[Sequence[str]]) -> list[Path]:
    """Rows, the headings first, as STEM.csv and STEM.md."""
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows(rows)
    lines = [rows[0], ["---"] * len(rows[0]), *rows[1:]]
    markdown = "".join(f"| {' | '.join(cell.replace('|', '/') for cell in row)} |\n" for row in lines)
    return [
        write_atomic(stem.with_suffix(".csv"), text.getvalue()),
        write_atomic(stem.with_suffix(".md"), markdown),
    ]
