"""CSV and JSON: every number with all its digits."""

from __future__ import annotations

import csv
import io
import json
from pathlib import Path
from typing import Any

from salver.export.motion import ExportedMotion
from salver.files import provenance, to_json, write_atomic
from salver.geometry import Array

_FIELDS = (
    "p_SE", "quat_SE_wxyz", "p_SB", "quat_SB_wxyz", "v_S", "a_S", "omega_B", "alpha_B", "q", "dq", "ddq", "tau",
)  # fmt: skip


def columns(motion: ExportedMotion) -> dict[str, Array]:
    """Name to values (T,): t, then each component, as p_SE_x, quat_SE_w, q_panda_joint1. Units as in the docs (SI)."""
    out: dict[str, Array] = {"t": motion.t}
    for field in _FIELDS:
        values = getattr(motion, field)
        if field.startswith("quat"):
            names = [f"{field.removesuffix('_wxyz')}_{c}" for c in "wxyz"]
        elif field in ("q", "dq", "ddq", "tau"):
            names = [f"{field}_{joint}" for joint in motion.joint_names]
        else:
            names = [f"{field}_{c}" for c in "xyz"]
        out.update({name: values[:, i] for i, name in enumerate(names[: values.shape[1]])})
    return out


def write_csv(motion: ExportedMotion, path: Path) -> list[Path]:
    """One row an instant, one column a component; headings as in `columns`."""
    table = columns(motion)
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(table)
    for row in zip(*(values.tolist() for values in table.values()), strict=True):
        writer.writerow([repr(float(value)) for value in row])
    return [write_atomic(path, text.getvalue(), keep=True)]


def write_json(motion: ExportedMotion, path: Path) -> list[Path]:
    """Arrays by name, the scenario, and where they come from."""
    document: dict[str, Any] = {
        "format": "salver motion",
        "provenance": provenance(motion.plan.scenario),
        "method": motion.plan.method,
        "joint_names": list(motion.joint_names),
        "t": motion.t,
        **{field: getattr(motion, field) for field in _FIELDS},
        "scenario": json.loads(motion.plan.scenario.model_dump_json(exclude_none=True)),
    }
    return [write_atomic(path, to_json(document), keep=True)]
