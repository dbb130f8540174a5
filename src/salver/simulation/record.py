"""The record of one run as arrays and a summary, saved and loaded."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from salver.display import Shown
from salver.errors import FileFormatError
from salver.files import read_result
from salver.geometry import Array
from salver.motion_files.motion import MotionSeries
from salver.plots import Curves, Plotted
from salver.run_directory import check_digest, save_record
from salver.tables import Table, Tabular, dimensioned

if TYPE_CHECKING:
    from salver.models.load_dynamics import Drawn
    from salver.simulation.scene.loads import Load

FOLDER = "simulation"
WHAT_IF = "-what-if"  # suffix of a run with values outside their ranges, which is no evidence about its plan
OUTCOMES = ("holds", "slides", "spills", "swings", "tips", "lifts", "lost", "limit")


@dataclass(frozen=True, repr=False)
class SimulationRecord(Shown, Tabular, Plotted):
    """One run at T instants, with m objects, n joints (n = 0 without an arm), n_c contact points of the first object.

    t (T,): s, 0 at the start of the motion. q, dq, tau (T, n): true joint state and applied torque.
    p_SE (T, 3), quat_SE_wxyz (T, 4): the real tray. p_SB (T, m, 3), quat_SB_wxyz (T, m, 4): the objects.
    slip_E (T, m, 3): displacement of the centre of each base relative to the tray since t = 0, in E, with creep.
    creep_E (T, m, 3): the part of slip_E that is creep of the engine's contacts (salver.simulation.creep).
    slip (T, m): largest displacement of any corner of the base along its support, without creep, m.
    lift (T, m): height of the lowest corner of the base over its support, m. tip_angle (T, m): rad.
    in_contact (T, m). contact_force_E (T, m, 3): sum of contact forces on each object from its support, in E, N.
    contact_points_B (n_c, 3), contact_forces_B (T, n_c, 3): of the first object, force on it, in B, m and N.
    cone_coefficients (T, n_lambda): Lambda of the net contact wrench on the first object, pinv(G F_hat) F_B, N.
    e_p, e_o (T,): deviation of the first object from its reference, m and rad. tray_e_p, tray_e_o: of the tray.
    surface (T, m, 3): `LoadDynamics.seen` of the liquid or pendulum in each object, m; NaN without one. For a liquid:
    its height at the wall along the object's x and y, and its highest point, above the level at rest.
    object_names: m names. parameters: the values that were not nominal. summary: figures, see `salver simulate --help`.
    """

    t: Array
    q: Array
    dq: Array
    tau: Array
    p_SE: Array
    quat_SE_wxyz: Array
    p_SB: Array
    quat_SB_wxyz: Array
    slip_E: Array
    creep_E: Array
    slip: Array
    lift: Array
    tip_angle: Array
    in_contact: Array
    contact_force_E: Array
    contact_points_B: Array
    contact_forces_B: Array
    cone_coefficients: Array
    e_p: Array
    e_o: Array
    tray_e_p: Array
    tray_e_o: Array
    object_names: tuple[str, ...]
    surface: Array = field(default_factory=lambda: np.zeros((0, 0, 3)))
    parameters: Mapping[str, float] = field(default_factory=dict)
    summary: Mapping[str, Any] = field(default_factory=dict)

    @property
    def outcome(self) -> str:
        """One of `OUTCOMES`."""
        return str(self.summary["outcome"])

    def facts(self) -> dict[str, str]:
        """Facts that a notebook shows."""
        slipped = {item["name"]: 1e3 * item["peak_slip"] for item in self.summary.get("objects", [])}
        return {
            "outcome": self.outcome,
            "duration": f"{float(self.summary['duration']):.4g} s",
            "slip": ", ".join(f"{name} {value:.3g} mm" for name, value in slipped.items()),
            "true parameters": ", ".join(f"{name} = {value:.4g}" for name, value in self.parameters.items())
            or "as assumed",
            "largest deviation": f"{1e3 * float(np.nanmax(self.e_p)):.3g} mm",
        }

    def table(self) -> Table:
        """The record for pandas and xarray, with parameters and outcome as attributes."""
        arrays = {name: getattr(self, name) for name in ARRAYS}
        about = {"outcome": self.outcome, **{f"true {name}": value for name, value in self.parameters.items()}}
        return Table(dimensioned(arrays, _DIMENSIONS), {"object": self.object_names}, about)

    def curves(self) -> tuple[Array, Curves]:
        """How far each object slipped and leaned on its support, and how far the first one was off its reference."""
        shown = {"slip, mm": 1e3 * self.slip, "tip angle, deg": np.rad2deg(self.tip_angle)}
        panels = {label: dict(zip(self.object_names, values.T, strict=True)) for label, values in shown.items()}
        return self.t, {**panels, "off its reference,\nmm": {self.object_names[0]: 1e3 * self.e_p}}

    def motion(self, joint_names: tuple[str, ...] = ()) -> MotionSeries:
        """The executed motion of joints, tray and first object, for `salver.motion_files.write`.

        joint_names: of the n joints; numbers by default. Velocities are left out, because motion files with velocities
        are read as commands, and this is a recording.
        """
        ns: Any = np.round((self.t - self.t[0]) * 1e9).astype(np.int64)
        names = joint_names or tuple(f"q{k + 1}" for k in range(self.q.shape[1]))
        p_SB, quat_SB_wxyz = self.p_SB[:, 0], self.quat_SB_wxyz[:, 0]
        return MotionSeries(ns, names, self.q, None, None, None, self.p_SE, self.quat_SE_wxyz, p_SB, quat_SB_wxyz)

    def what_if(self, outside: Mapping[str, tuple[float, float] | None]) -> SimulationRecord:
        """The record with the true values that were outside their ranges (`salver.simulation.scene.loads.outside`)
        added to its summary."""
        return replace(self, summary={**self.summary, "outside": dict(outside)}) if outside else self

    def save(self, directory: str | Path, stem: str = "plan", kind: str = "") -> Path:
        """Write DIRECTORY/simulation/STEM.npz and .json, atomically; returns the path of the first.

        Existing files of a different run are kept as STEM-1, STEM-2, ... kind: added to the file name if the run was
        not of the whole plan. A run with a value outside its range is STEM-what-if.
        """
        kind = kind or (WHAT_IF if "outside" in self.summary else "")
        return save_record(
            Path(directory),
            FOLDER,
            stem,
            {name: getattr(self, name) for name in ARRAYS},
            {"object_names": list(self.object_names), "parameters": dict(self.parameters), **self.summary},
            kind,
        )


_DIMENSIONS: Mapping[str, tuple[str, ...]] = {
    **dict.fromkeys(("p_SB", "slip_E", "creep_E", "contact_force_E"), ("object", "xyz")),
    "quat_SB_wxyz": ("object", "wxyz"),
    **dict.fromkeys(("slip", "lift", "tip_angle", "in_contact"), ("object",)),
    "contact_forces_B": ("foot", "xyz"),
    **dict.fromkeys(("e_p", "e_o", "tray_e_p", "tray_e_o"), ()),
}
_META = ("object_names", "parameters", "summary")
ARRAYS = tuple(f.name for f in dataclasses.fields(SimulationRecord) if f.name not in _META)
_REQUIRED = tuple(name for name in ARRAYS if name != "surface")


def load_record(directory: str | Path, stem: str = "plan") -> SimulationRecord:
    """Read a record that `SimulationRecord.save` wrote. Raises FileFormatError, also if it is of another plan."""
    folder = Path(directory) / FOLDER
    path = folder / f"{stem}.json"
    arrays, summary = read_result(path, _REQUIRED)
    if summary.get("outcome") not in OUTCOMES:
        raise FileFormatError(f"{path} is not the summary of a simulation; write it again with salver simulate.")
    check_digest(summary, path, Path(directory), stem)
    names = tuple(summary.pop("object_names", ()))
    parameters = summary.pop("parameters", {})
    if np.shape(arrays["p_SB"])[1:2] != (len(names),):
        raise FileFormatError(f"{path} and {stem}.npz are of different runs; write them again with salver simulate.")
    return SimulationRecord(
        **{name: arrays[name] for name in ARRAYS if name in arrays},
        object_names=names,
        parameters=parameters,
        summary=summary,
    )


def drawn_inside(loads: Sequence[Load], inner: Array, summary: Mapping[str, Any]) -> list[Drawn | None]:
    """Drawings of the liquid or pendulum in each object; None without one.

    loads: the true loads of the run. inner: `SimulationRecord.surface`. summary: that of the record.
    """
    out: list[Drawn | None] = [None] * len(loads)
    for k, load in enumerate(loads):
        if load.value is not None and inner.shape[1]:
            out[k] = load.drawn(inner[:, k, :2], summary["objects"][k].get(load.inner.event))
    return out
