"""`salver figures`: the paper's figures, for any scenario, sized for a two-column paper."""

from __future__ import annotations

import io
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from salver.errors import MissingDependencyError, SalverError
from salver.files import write_atomic
from salver.geometry import Array
from salver.models.shapes.obstacle_shapes import obstacle_shapes
from salver.models.shapes.surfaces import Surface, surface
from salver.reports import perturbed
from salver.reports.run import ReportedMotion, ReportedRun, read_run
from salver.reports.style import (
    BLACK,
    COLUMN,
    CYCLE,
    GREY,
    OBSTACLE_COLOUR,
    PAGE,
    ROLE_COLOURS,
    ROLE_DASHES,
    paper_style,
)
from salver.reports.tables import numbers_table, scenario_rows, write_table
from salver.wording import number

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from salver.scenario import Obstacle
    from salver.simulation.record import SimulationRecord

FORMATS = ("pdf", "svg", "png")
AXES = ("x", "y", "z")


def write_figures(
    directory: str | Path,
    file_format: str = "pdf",
    n: int = 100,
    seed: int = 0,
    physics: bool = True,
    say: Callable[[str], None] = lambda text: None,
) -> list[Path]:
    """All figures and tables of a run directory into DIR/figures; returns their paths.

    n, seed: perturbed rollouts of Figs 5 and 6. physics: also Figs 7 and 8, for which the physics engine runs each
    motion twice. say: told what is left out and why. Raises SalverError for an unknown format.
    """
    check_format(file_format)
    run = read_run(directory)
    folder = run.directory / "figures"
    rollouts = {m.stem: perturbed.perturbed_rollouts(run, m.stem, n, seed) for m in run.motions}
    made: list[Path] = []
    with paper_style():
        figures = {
            "fig3-trajectories": trajectories(run.motions, run.scenario.obstacles),
            "fig4-coefficients": coefficients(run.motions),
        }
        for number, m in zip((5, 6), run.motions, strict=False):
            figures[f"fig{number}-perturbed-{m.stem}"] = perturbed_figure(m, rollouts[m.stem])
        if run.scenario.arm is None:
            say("Figs 7 and 8 are left out: the scenario has no arm.")
        elif physics:
            nominal, heavier = _physics_records(run)
            try:
                figures["fig7-snapshots"] = snapshots(run, nominal)
            except MissingDependencyError as error:
                say(f"Fig. 7 is left out: {error}")
            figures["fig8-tracking"] = tracking(run.motions, nominal, heavier)
        for name, figure in figures.items():
            made.append(write_atomic(folder / f"{name}.{file_format}", render(figure, file_format)))
    made += write_table(folder / "table1-parameters", [("quantity", "value"), *scenario_rows(run)])
    made += write_table(folder / "numbers", numbers_table(run, rollouts))
    return made


def check_format(file_format: str) -> None:
    """Raises SalverError for an unknown one."""
    if file_format not in FORMATS:
        raise SalverError(f'There is no figure format "{file_format}"; known are {", ".join(FORMATS)}.')


def render(figure: Figure, file_format: str) -> bytes:
    """A figure as a file's content; the same data give the same bytes."""
    buffer = io.BytesIO()
    metadata: dict[str, Any] = {"pdf": {"CreationDate": None}, "svg": {"Date": None}}.get(file_format, {})
    figure.savefig(buffer, format=file_format, metadata=metadata)
    return buffer.getvalue()


def _new(width: float, height: float, rows: int = 1, columns: int = 1, **more: Any) -> tuple[Figure, Any]:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), layout="constrained")
    return figure, figure.subplots(rows, columns, squeeze=False, **more)


def _style(m: ReportedMotion) -> dict[str, Any]:
    return {"color": ROLE_COLOURS[m.stem], "linestyle": ROLE_DASHES[m.stem]}


def trajectories(motions: Iterable[ReportedMotion], obstacles: Sequence[Obstacle] = ()) -> Figure:
    """Fig. 3: position over time, and in space, where obstacles stand."""
    from matplotlib.figure import Figure

    motions = list(motions)
    figure = Figure(figsize=(PAGE, 2.75))
    left = figure.add_gridspec(3, 1, left=0.075, right=0.47, top=0.93, bottom=0.14, hspace=0.16)
    axes = [figure.add_subplot(left[i]) for i in range(3)]
    for i, ax in enumerate(axes):
        for m in motions:
            ax.plot(m.t, m.arrays["p_SB"][:, i], label=m.label, **_style(m))
        ax.set_ylabel(f"${AXES[i]}$ [m]")
        ax.margins(x=0)
        _widen(ax, 0.04)
        ax.yaxis.set_label_coords(-0.15, 0.5)
        if i < 2:
            ax.tick_params(labelbottom=False)
    axes[-1].set_xlabel("time [s]")
    figure.legend(*axes[0].get_legend_handles_labels(), loc="upper left", bbox_to_anchor=(0.07, 1.02), ncols=2)
    space = figure.add_axes((0.515, 0.02, 0.47, 0.98), projection="3d")
    _in_space(space, motions, obstacles)
    return figure


def _in_space(ax: Any, motions: list[ReportedMotion], obstacles: Sequence[Obstacle]) -> None:
    """Paths of the object to one scale in all three directions, with start, goal and, dotted, the paths from above."""
    from mpl_toolkits.mplot3d.art3d import Poly3DCollection  # type: ignore[import-untyped]

    points = np.vstack([m.arrays["p_SB"] for m in motions])
    around = _within(obstacles, points.min(axis=0) - 0.15, points.max(axis=0) + 0.15)  # m around the paths
    points = np.vstack([points, *(vertices for vertices, _ in around)])
    middle, half = 0.5 * (points.max(axis=0) + points.min(axis=0)), 0.55 * np.ptp(points, axis=0).max()
    spans = np.maximum(np.ptp(points, axis=0) * 0.6, 0.35 * half)
    floor = middle[2] - spans[2]
    for m in motions:
        p = m.arrays["p_SB"]
        ax.plot(*p.T, label=m.label, **_style(m))
        ax.plot(p[:, 0], p[:, 1], floor, color=ROLE_COLOURS[m.stem], linewidth=0.6, linestyle=":")
    start, goal = motions[0].arrays["p_SB"][[0, -1]]
    ax.scatter(*start, color=BLACK, s=14, marker="o", depthshade=False)
    ax.scatter(*goal, color=BLACK, s=18, marker="s", depthshade=False)
    for point, word in ((start, "start"), (goal, "goal")):
        ax.text(point[0], point[1], point[2] + 0.12 * spans[2], f" {word}", fontsize=7)
    for i, name in enumerate(AXES):
        getattr(ax, f"set_{name}lim")(middle[i] - spans[i], middle[i] + spans[i])
        getattr(ax, f"set_{name}label")(f"${name}$ [m]", labelpad={"x": -4, "y": 3, "z": 1}[name])
        getattr(ax, f"{name}axis").set_major_locator(_few_ticks())
        getattr(ax, f"{name}axis").pane.set_facecolor("white")
    for vertices, faces in around:
        ax.add_collection3d(Poly3DCollection(vertices[faces], facecolor=OBSTACLE_COLOUR, edgecolor="none", alpha=0.25))
    ax.set_box_aspect(spans, zoom=1.15)
    ax.tick_params(pad=-1)
    ax.view_init(elev=20, azim=-35)


def _within(obstacles: Sequence[Obstacle], low: Array, high: Array) -> list[Surface]:
    """Surfaces of obstacles, clamped to the box from low (3,) to high (3,); obstacles outside of it are left out."""
    pieces = [surface(shape, placement) for obstacle in obstacles for shape, placement in obstacle_shapes(obstacle)]
    return [
        (np.clip(vertices, low, high), faces)
        for vertices, faces in pieces
        if np.all(vertices.max(axis=0) > low) and np.all(vertices.min(axis=0) < high)
    ]


def _few_ticks() -> Any:
    from matplotlib.ticker import MaxNLocator

    return MaxNLocator(nbins=3, steps=[1, 2, 5, 10])


def _widen(ax: Axes, least: float) -> None:
    """Make the y axis span at least `least`, so that a constant does not look like a motion."""
    low, high = ax.get_ylim()
    if high - low < least:
        middle = 0.5 * (low + high)
        ax.set_ylim(middle - 0.5 * least, middle + 0.5 * least)


def coefficients(motions: Iterable[ReportedMotion]) -> Figure:
    """Fig. 4: all cone coefficients of the nominal object."""
    motions = list(motions)
    figure, axes = _new(COLUMN, 1.55 * len(motions) + 0.3, rows=len(motions), sharex=True, sharey=True)
    for ax, m, letter in zip(axes[:, 0], motions, "ab", strict=False):
        ax.plot(m.t, m.arrays["cone_coefficients"], color=ROLE_COLOURS[m.stem], linewidth=0.7)
        _zero_line(ax)
        ax.set_title(
            f"({letter}) {m.label}: least {number(1e3 * m.arrays['cone_coefficients'].min(), 0, ' mN')}", loc="left"
        )
        ax.set_ylabel(r"$\Lambda$ [N]")
        ax.margins(x=0)
    axes[-1, 0].set_xlabel("time [s]")
    return figure


def perturbed_figure(m: ReportedMotion, runs: perturbed.Perturbed) -> Figure:
    """Figs 5 and 6: cone coefficients of perturbed bodies, within the least and largest edge of all tubes."""
    figure, axes = _new(COLUMN, 2.0)
    ax = axes[0, 0]
    t, values = runs.rollout.t, runs.rollout.cone_coefficients
    n = len(values)
    for i, colour in zip(_spread_coefficients(m), CYCLE[:4], strict=False):
        ax.plot(t, values[:, :, i].T, color=colour, linewidth=0.3, alpha=0.5, rasterized=n > 30)
        ax.plot([], [], color=colour, linewidth=1.2, label=rf"$\Lambda_{{{i + 1}}}$")
    low, high = perturbed.envelope(m.arrays["cone_coefficients"], m.arrays["cone_radius"])
    ax.plot(m.t, low, color=BLACK, linestyle="--", linewidth=1.0)
    ax.plot(m.t, high, color=BLACK, linestyle="--", linewidth=1.0, label="edges of the tubes")
    _zero_line(ax)
    ax.set_ylim(bottom=ax.get_ylim()[0] - 0.16 * np.ptp(ax.get_ylim()))
    ax.set(xlabel="time [s]", ylabel=r"$\Lambda$ [N]")
    ax.set_title(f"{m.label}, {n} perturbed bodies: least {number(1e3 * float(values.min()), 0, ' mN')}", loc="left")
    ax.margins(x=0)
    ax.legend(loc="lower center", ncols=5, columnspacing=0.8, handlelength=1.1, handletextpad=0.4)
    return figure


def _spread_coefficients(m: ReportedMotion) -> list[int]:
    """Up to four coefficients that tell most: lowest, highest, and two between, by their value where one is lowest."""
    values = m.arrays["cone_coefficients"]
    instant = int(np.argmin(values.min(axis=1)))
    order = np.argsort(values[instant])
    # Sorted, so that two motions that show the same coefficients show them in the same colours.
    return sorted(int(order[round(k)]) for k in np.linspace(0, len(order) - 1, min(4, len(order))))


def _physics_records(run: ReportedRun) -> tuple[dict[str, SimulationRecord], dict[str, SimulationRecord]]:
    """Physics runs of every motion, nominal and with the paper's extra mass."""
    from salver.planning.plan import load_plan

    plans = {m.stem: load_plan(run.directory, m.stem) for m in run.motions}
    return (
        {stem: perturbed.heavier(plan, 0.0) for stem, plan in plans.items()},
        {stem: perturbed.heavier(plan) for stem, plan in plans.items()},
    )


SNAPSHOTS = 4


def snapshots(run: ReportedRun, records: Mapping[str, SimulationRecord]) -> Figure:
    """Fig. 7: pictures along each simulated motion, one row a motion. Raises MissingDependencyError without OpenGL."""
    from salver.simulation.pictures import frames_at, painter

    motions = [m for m in run.motions if m.stem in records]
    figure, axes = _new(PAGE, 1.42 * len(motions) + 0.2, rows=len(motions), columns=SNAPSHOTS)
    for row, m in zip(axes, motions, strict=True):
        times, record = np.linspace(0.0, m.duration, SNAPSHOTS), records[m.stem]
        with painter(record, run.scenario, 640, 480) as paint:
            pictures = [paint(k) for k in frames_at(record, times)]
        for ax, picture, t in zip(row, pictures, times, strict=True):
            ax.imshow(picture)
            ax.set_title(f"{t:.2f} s", loc="left", pad=2)
            ax.set_xticks([])
            ax.set_yticks([])
            for spine in ax.spines.values():
                spine.set_visible(False)
        row[0].set_ylabel(m.label)
    return figure


def tracking(
    motions: Iterable[ReportedMotion], nominal: Mapping[str, SimulationRecord], heavier: Mapping[str, SimulationRecord]
) -> Figure:
    """Fig. 8: norms of the object's position and orientation error, as planned and with more mass."""
    figure, axes = _new(COLUMN, 2.7, rows=2, columns=2, sharex=True, sharey="row")
    titles = ("(a) nominal", f"(b) {1e3 * perturbed.EXTRA_MASS:+.0f} g")
    for column, (records, title) in enumerate(zip((nominal, heavier), titles, strict=True)):
        for row, (key, label) in enumerate((("e_p", r"$\|e_p\|$ [mm]"), ("e_o", r"$\|e_o\|$ [mrad]"))):
            ax = axes[row, column]
            for m in motions:
                if m.stem in records:
                    record = records[m.stem]
                    ax.plot(record.t, 1e3 * getattr(record, key), label=m.label, **_style(m))
            ax.axvline(0, color=GREY, linewidth=0.5)
            ax.margins(x=0)
            if column == 0:
                ax.set_ylabel(label)
            if row == 0:
                ax.set_title(title, loc="left")
            else:
                ax.set_xlabel("time [s]")
    for ax in axes[:, 0]:
        ax.set_ylim(bottom=0)
    axes[1, 1].legend(loc="best")
    return figure


def _zero_line(ax: Axes) -> None:
    ax.axhline(0, color=GREY, linewidth=0.7)
    ax.set_ylim(bottom=min(0.0, ax.get_ylim()[0]))
