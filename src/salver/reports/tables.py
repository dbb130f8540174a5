"""Results in rows: what was found, how much of the arm is used."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from salver.models.arm.arm_limits import LIMITS

if TYPE_CHECKING:
    from salver.models.arm.arm import ArmModel
    from salver.reports.run import ReportedMotion, ReportedRun


def found_rows(run: ReportedRun) -> list[tuple[str, str]]:
    """What was found of each motion, in sentences; all of plan.json is on the page besides."""
    rows = []
    for m in run.motions:
        for name, key in (("result", "status"), ("check", "verification"), ("arm", "arm")):
            sentence = (m.summary.get(key) or {}).get("sentence")
            if sentence:
                rows.append((f"{m.label.lower()}: {name}", sentence))
    return rows


def arm_usage(m: ReportedMotion, arm: ArmModel) -> dict[str, np.ndarray]:
    """Largest share (n,) of each of the arm's limits over the motion, NaN for a joint that has none.

    Jerk and torque rate by differences. Kinds that no joint has are left out.
    """
    t, q, dq, ddq = (m.arrays[key] for key in ("t", "q", "dq", "ddq"))
    curves = {"position": q, "velocity": dq, "acceleration": ddq, "jerk": np.gradient(ddq, t, axis=0)}
    if "tau" in m.arrays:
        curves |= {"torque": m.arrays["tau"], "torque_rate": np.gradient(m.arrays["tau"], t, axis=0)}
    shares = arm.limits.shares(curves)
    known = {kind.key: np.isfinite(arm.limits.range(kind)[1]) for kind in LIMITS}
    return {
        key: np.where(known[key], np.abs(share).max(axis=0), np.nan)
        for key, share in shares.items()
        if known[key].any()
    }
