"""The table of finished runs (Parquet), and their summary with confidence intervals."""

from __future__ import annotations

import hashlib
import io
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from shlex import quote
from typing import Any

from salver.campaigns.definition import DEFAULT_FOLDER
from salver.campaigns.journal import Item, Record
from salver.errors import FileFormatError, needs
from salver.files import write_atomic
from salver.statistics import clopper_pearson, mcnemar, quantiles

DROPPED = ("tips", "lifts", "lost")  # outcomes of a stopped run that count as a loss of the load
LARGEST_SLIP = 5e-3  # m; a larger slip counts as a loss too
MAGIC = b"PAR1"  # at both ends of a Parquet file

# From best to worst; an outcome that is not listed is worst.
SEVERITY = ("holds", "limit", "slides", "swings", "spills", "lifts", "tips", "lost", "error")
SUMMARISED = (
    "peak_slip",
    "final_slip",
    "peak_lift",
    "peak_tip_angle",
    "e_p_peak",
    "e_o_peak",
    "tray_e_p_peak",
    "tray_e_o_peak",
    "cone_least",
)

Row = dict[str, Any]


def table(records: Mapping[Item, Record], stems: Sequence[str]) -> list[Row]:
    """One row for each run and plan, sorted by run, then by plan: stem, run, outcome, parameters by name, scalars."""
    order = {stem: rank for rank, stem in enumerate(stems)}
    rows = [
        {"stem": r["stem"], "run": r["run"], "outcome": r["outcome"], **r["parameters"], **r["scalars"]}
        for r in records.values()
    ]
    return sorted(rows, key=lambda row: (row["run"], order[row["stem"]]))


def write_table(path: Path, rows: Sequence[Row]) -> str:
    """Write rows as Parquet, columns in order of first appearance; returns the digest. Equal rows give equal bytes."""
    with needs("engine", "A campaign"):
        from arro3.core import Array, DataType, Table
        from arro3.io import write_parquet

    types = {bool: DataType.bool(), int: DataType.int64(), float: DataType.float64(), str: DataType.string()}
    names = list(dict.fromkeys(name for row in rows for name in row))
    columns = {}
    for name in names:
        values = [row.get(name) for row in rows]
        kinds = {type(v) for v in values if v is not None}
        if kinds == {int, float}:
            values = [None if v is None else float(v) for v in values]
        elif len(kinds) > 1:
            values = [None if v is None else str(v) for v in values]
        kind = next((type(v) for v in values if v is not None), float)
        columns[name] = Array(values, types[kind])
    buffer = io.BytesIO()
    write_parquet(Table.from_pydict(columns), buffer, compression="zstd(3)")
    write_atomic(path, buffer.getvalue())
    return hashlib.sha256(buffer.getvalue()).hexdigest()


def read_table(path: str | Path) -> dict[str, list[Any]]:
    """Read the columns of a runs.parquet, None if a run has no such value. Raises FileFormatError."""
    return columns_of(Path(path).read_bytes(), Path(path))


def columns_of(content: bytes, path: Path) -> dict[str, list[Any]]:
    """The columns of a runs.parquet from its content. Raises FileFormatError, naming `path`."""
    with needs("engine", path.name):
        from arro3.io import read_parquet

    if len(content) < 2 * len(MAGIC) or {content[: len(MAGIC)], content[-len(MAGIC) :]} != {MAGIC}:
        raise FileFormatError(f"{path} is not a Parquet file, or is truncated.")
    found = read_parquet(io.BytesIO(content)).read_all()
    return {name: [value.as_py() for value in found[name]] for name in found.column_names}


def summarise(
    rows: Sequence[Row], stems: Sequence[str], directory: Path, folder: str = DEFAULT_FOLDER
) -> dict[str, Any]:
    """Outcome rates with 95 % Clopper-Pearson intervals, quantiles, tube coverage, worst runs, comparison of plans."""
    by_stem = {stem: [row for row in rows if row["stem"] == stem] for stem in stems}
    return {
        "plans": {stem: _plan_summary(own, stem, directory, folder) for stem, own in by_stem.items()},
        "paired": [
            _pair(by_stem[first], by_stem[second], first, second)
            for i, first in enumerate(stems)
            for second in stems[i + 1 :]
        ],
    }


def _plan_summary(rows: Sequence[Row], stem: str, directory: Path, folder: str) -> dict[str, Any]:
    counts = {outcome: sum(row["outcome"] == outcome for row in rows) for outcome in {row["outcome"] for row in rows}}
    ordered = sorted(counts | {"holds": counts.get("holds", 0)}, key=severity)
    worst = max(rows, key=badness)
    return {
        "runs": len(rows),
        "outcomes": {name: clopper_pearson(counts.get(name, 0), len(rows)).as_dict() for name in ordered},
        "quantiles": {name: quantiles(_numbers(rows, name)) for name in SUMMARISED if _numbers(rows, name)},
        "tube": _tube(rows),
        "stops": _stops(rows),
        "worst_run": {
            "run": worst["run"],
            "outcome": worst["outcome"],
            "peak_slip": worst.get("peak_slip"),
            "cone_least": worst.get("cone_least"),
            "sentence": worst.get("sentence"),
            "replay": f"salver simulate {quote(str(directory))} --plan {stem} --run {worst['run']}"
            + (f" --folder {quote(folder)}" if folder != DEFAULT_FOLDER else ""),
        },
    }


def _stops(rows: Sequence[Row]) -> dict[str, Any] | None:
    """Summary of stopped runs: number of lost loads (tipped, lifted, off the tray, slipped over 5 mm), of runs beyond
    a limit of the arm, of runs that finished instead; times of the stops, s. None without stops."""
    stopped = [row for row in rows if _is_number(row.get("stop_at"))]
    if not stopped:
        return None
    lost = sum(row["outcome"] in DROPPED or row.get("peak_slip", 0.0) > LARGEST_SLIP for row in stopped)
    return {
        "lost": clopper_pearson(lost, len(stopped)).as_dict(),
        "beyond_a_limit": clopper_pearson(sum(row["outcome"] == "limit" for row in stopped), len(stopped)).as_dict(),
        "takes": quantiles(_numbers(stopped, "stop_takes")),
        "finished": sum(bool(row["finishes"]) for row in stopped),
    }


LEFT_TUBES = (
    "A contact coefficient outside its tube does not mean that the load moved; the outcomes show whether it did. A "
    "tube bounds the paper's coefficients to first order for an arm that starts without error; the simulated arm "
    "starts with a static deflection under the true load."
)


def _tube(rows: Sequence[Row], tolerance: float = 0.01) -> dict[str, Any] | None:
    """Number of runs with a cone coefficient outside the plan's first-order tube, and the largest excess.

    "left": runs with an excess over a share `tolerance` of the tube's largest radius.
    """
    excess = [
        (row["tube_excess_relative"], row["tube_excess"], row["run"])
        for row in rows
        if _is_number(row.get("tube_excess_relative"))
    ]
    if not excess:
        return None
    relative, absolute, run = max(excess)
    return {
        "left": clopper_pearson(sum(e > tolerance for e, _, _ in excess), len(excess)).as_dict(),
        "tolerance_relative": tolerance,
        "worst_excess": absolute,
        "worst_excess_relative": relative,
        "worst_run": run,
        "excess_settled": quantiles(_numbers(rows, "tube_excess_settled")),
    }


def _pair(first: Sequence[Row], second: Sequence[Row], first_name: str, second_name: str) -> dict[str, Any]:
    """Comparison of two plans on the runs that both have."""
    a, b = ({row["run"]: row["outcome"] == "holds" for row in rows} for rows in (first, second))
    runs = sorted(a.keys() & b.keys())
    return {"first": first_name, "second": second_name, "holds": mcnemar([a[k] for k in runs], [b[k] for k in runs])}


def severity(outcome: str) -> int:
    return SEVERITY.index(outcome) if outcome in SEVERITY else len(SEVERITY)


def badness(row: Row) -> tuple[int, float, float, int]:
    """Sort key of runs: by outcome, then slip, then least cone coefficient, then number; the worst is largest."""
    slip = row.get("peak_slip")
    least = row.get("cone_least")
    return (
        severity(row["outcome"]),
        float(slip) if _is_number(slip) else 0.0,  # type: ignore[arg-type]
        -float(least) if _is_number(least) else 0.0,  # type: ignore[arg-type]
        -row["run"],
    )


def _numbers(rows: Sequence[Row], name: str) -> list[float]:
    return [row[name] for row in rows if _is_number(row.get(name))]


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)
