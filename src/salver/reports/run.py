"""Content of a run directory, read once for the page and the figures."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from salver import scenario as scenarios
from salver.errors import FileFormatError, MissingDependencyError
from salver.files import read_result, read_sealed
from salver.geometry import Array, matrix_from_quat_wxyz
from salver.models.bodies import Body
from salver.models.uncertain.parameters import Parameter
from salver.planning.plan_files import read_plan
from salver.reports.contact import ContactCurves, contact_curves, planned_samples
from salver.run_directory import RECORDS, STEMS, check_digest, known_stems, plan_digest, scenario_of
from salver.simulation.record import FOLDER, WHAT_IF

if TYPE_CHECKING:
    from salver.dynamics.payload_response import PayloadResponse

_NEEDED = (
    "t", "p_SB", "v_S", "a_S", "quat_SB_wxyz", "omega_B", "alpha_B", "wrench_B", "grasp_map", "cone_coefficients",
    "cone_radius", "state_sensitivity", "input_sensitivity", "parameter_names", "parameter_half_range",
)  # fmt: skip


@dataclass(frozen=True)
class Record:
    """One run in the physics engine, or a log of the real arm: arrays, time first, and a summary."""

    arrays: dict[str, np.ndarray]
    summary: dict[str, Any]

    @property
    def t(self) -> Array:
        return self.arrays["t"]


@dataclass(frozen=True)
class ReportedMotion:
    """A plan or what it is compared with, and what is known of it.

    stem: "plan", "baseline" or "nominal". arrays: those of plan.npz (docs: file formats). summary: plan.json.
    simulation: its run in the physics engine, if there was one. execution: its run on an arm, real or simulated.
    what_if: its run in the engine with values outside the ranges that it was planned for.
    """

    stem: str
    arrays: dict[str, np.ndarray]
    summary: dict[str, Any]
    simulation: Record | None = None
    execution: Record | None = None
    what_if: Record | None = None

    @property
    def seen(self) -> Record | None:
        """The run that the replay shows: in the physics engine, or on an arm; without one, what would happen if."""
        return self.simulation or self.execution or self.what_if

    @property
    def label(self) -> str:
        """For a legend: what kind of motion this is."""
        if self.stem != "plan":
            return self.stem.capitalize()
        method = self.summary.get("method")
        searched = ("fastest", "safest", "least-sensitive", "live", "excite", "tilt", "given")
        return str(method).replace("-", " ").capitalize() if method in searched else "Robust"

    def planned_for(self, ranges: bool) -> str:
        """The line below a motion's name that says what it was planned for; empty for one that was not planned.

        ranges: whether any parameter has a range.
        """
        if self.stem == "baseline":
            return "the straight line in the same time"
        robust = (self.summary.get("solver") or {}).get("robust")
        if robust or self.summary.get("method") == "robust":
            return "planned for the ranges" if ranges else "planned for exact values"
        return "" if robust is None else "planned for nominal values"

    @property
    def t(self) -> Array:
        return self.arrays["t"]

    @property
    def duration(self) -> float:
        return float(self.t[-1])

    @cached_property
    def R_SB(self) -> Array:
        return matrix_from_quat_wxyz(self.arrays["quat_SB_wxyz"])

    @property
    def cone_floor(self) -> Array:
        """(T, n_lambda) lower edge of the tube, Lambda - r, N."""
        return self.arrays["cone_coefficients"] - self.arrays["cone_radius"]


@dataclass(frozen=True)
class ReportedRun:
    """A run directory: the scenario, one or two motions, what later commands added.

    notes: what is there but belongs to other plans, and so is not part of this, as sentences. margins: what is known
    of the motions' contact already, by stem.
    """

    directory: Path
    scenario: scenarios.Scenario
    motions: list[ReportedMotion]
    campaign: dict[str, Any] | None = None
    runs: dict[str, np.ndarray] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)
    margins: Mapping[str, ContactCurves] = field(default_factory=dict)

    @cached_property
    def bodies(self) -> tuple[Body, ...]:
        return self.scenario.payload.bodies

    @property
    def plan(self) -> ReportedMotion:
        return self.motions[0]

    @property
    def compared(self) -> ReportedMotion | None:
        """The motion that the plan is compared with."""
        return self.motions[1] if len(self.motions) > 1 else None

    @property
    def given(self) -> bool:
        """Whether the motion of the run was made by another planner."""
        return self.plan.summary.get("method") == "given"

    @property
    def paper(self) -> bool:
        """Whether the plan must satisfy the paper's contact condition."""
        return self.scenario.contact.condition == "paper" and not self.given

    @cached_property
    def contact(self) -> dict[str, ContactCurves]:
        """Stem to how near the motion comes to sliding, tipping or lifting."""
        return {m.stem: self.margins.get(m.stem) or contact_curves(self.scenario, m.arrays) for m in self.motions}

    def loads(self, motion: ReportedMotion) -> PayloadResponse | None:
        """What moves inside the loads along a motion as it was planned, at its times; None where nothing does."""
        from salver.contact_margins import tray_motion
        from salver.dynamics.payload_response import PayloadResponse

        w = tray_motion(self.scenario, planned_samples(motion.arrays))
        return PayloadResponse.along(self.scenario.payload, motion.t, w)

    def parameter(self, name: str) -> Parameter:
        """The parameter that one of the files calls so. Raises FileFormatError."""
        try:
            return self.scenario.payload.parameter(name)
        except ValueError as error:
            raise FileFormatError(f"{self.directory}: {error}; the files of a run directory belong together.") from None

    @property
    def load(self) -> str:
        """The load in a sentence: "the cube", "the 3 objects"."""
        return f"the {self.bodies[0].name}" if len(self.bodies) == 1 else f"the {len(self.bodies)} objects"

    def motion(self, stem: str) -> ReportedMotion | None:
        return next((m for m in self.motions if m.stem == stem), None)


def read_leg(directory: str | Path, number: int) -> ReportedRun:
    """Read one leg, 1 for the first, of a run directory of several, as a run of its own."""
    directory, notes = Path(directory), list[str]()
    stem = f"leg{number}"
    files = read_plan(directory, stem, _NEEDED)
    motion = _with_records(directory, ReportedMotion("plan", files.arrays, files.record), notes, stem)
    return ReportedRun(directory, files.scenario, [motion], notes=notes)


def read_run(directory: str | Path) -> ReportedRun:
    """Read a run directory. Raises FileFormatError if the directory is not one, or a file in it is damaged."""
    directory = Path(directory)
    scenario_of(directory)
    if not (directory / "plan.npz").is_file():
        raise FileFormatError(f"{directory} holds no plan.npz; make one with `salver plan`.")
    files = {stem: read_plan(directory, stem, _NEEDED) for stem in STEMS if (directory / f"{stem}.npz").is_file()}
    notes: list[str] = []
    motions = [
        _with_records(directory, ReportedMotion(stem, plan.arrays, plan.record), notes) for stem, plan in files.items()
    ]
    campaign, runs = read_campaign(directory, notes)
    return ReportedRun(directory, files["plan"].scenario, motions, campaign, runs, notes)


def _with_records(directory: Path, motion: ReportedMotion, notes: list[str], stem: str = "") -> ReportedMotion:
    """The motion with its runs in the engine and on an arm; those of another plan are noted and left out.

    stem: under which they are, if not the motion's own.
    """
    found: dict[str, Any] = {}
    stem = stem or motion.stem
    places = {folder: directory / folder / f"{stem}.npz" for folder in RECORDS}
    places["what_if"] = directory / FOLDER / f"{stem}{WHAT_IF}.npz"
    for kind, path in places.items():
        if not path.is_file():
            continue
        record = Record(*read_result(path, ("t",)))
        try:
            check_digest(record.summary, path, directory, stem)
            if len(record.t) < 2:
                raise FileFormatError(f"{path} ends before it begins. {record.summary.get('stopped', '')}".strip())
            found[kind] = record
        except FileFormatError as error:
            notes.append(f"Not shown: {error}")
    return replace(motion, **found)


def read_campaign(directory: Path, notes: list[str]) -> tuple[dict[str, Any] | None, dict[str, np.ndarray]]:
    """Summary and table of runs (column name to values) of a campaign, if there is a finished one of these plans."""
    path = directory / "campaign" / "campaign.json"
    if not path.is_file() or not path.with_name("runs.parquet").is_file():
        return None, {}
    summary = read_sealed(path)
    if "plans" not in summary:  # begun, not finished
        return None, {}
    from salver.campaigns.definition import definition_in

    try:
        ran = definition_in(summary, path).plans
    except FileFormatError as error:
        notes.append(f"Not shown: {error}")
        return None, {}
    if any(
        stem not in known_stems(directory) or plan_digest(directory, stem) != digest for stem, digest in ran.items()
    ):
        notes.append(f"Not shown: {path} is a campaign of other plans than those of {directory}.")
        return None, {}
    from salver.campaigns.summary import columns_of

    content = path.with_name("runs.parquet").read_bytes()
    if hashlib.sha256(content).hexdigest() != summary.get("table_digest"):
        raise FileFormatError(
            f"{path.with_name('runs.parquet')} was damaged or edited since it was written; run `salver campaign` "
            "again, it resumes."
        )
    try:
        columns = columns_of(content, path.with_name("runs.parquet"))
    except MissingDependencyError as error:
        notes.append(f"Not shown: the campaign. {error}")
        return None, {}
    return summary, {name: _column(values) for name, values in columns.items()}


def _column(values: list[Any]) -> Array:
    """Numbers that are missing are no numbers; of anything else None stays."""
    numbers = all(
        isinstance(value, (int, float)) and not isinstance(value, bool) for value in values if value is not None
    )
    return np.array([np.nan if value is None and numbers else value for value in values])
