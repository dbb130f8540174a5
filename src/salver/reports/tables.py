"""Numbers in rows: what the solver did, how much of the arm is used."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from salver.models.arm.arm_limits import LIMITS

if TYPE_CHECKING:
    from salver.models.arm.arm import ArmModel
    from salver.reports.run import ReportedMotion, ReportedRun

Rows = list[tuple[str, str]]


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
