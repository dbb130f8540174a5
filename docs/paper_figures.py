"""The paper's figures 3 to 6 and 8 of a run directory, in the style of a two-column paper, and the runs behind them."""

from __future__ import annotations

import io
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

import numpy as np

from salver import sampling
from salver.control.object import Gains
from salver.geometry import Array
from salver.models.uncertain.parameters import Parameter
from salver.planning.plan import Plan, load_plan
from salver.reports.run import ReportedMotion, ReportedRun
from salver.reports.style import BLACK, CYCLE, GREY, ROLE_COLOURS
from salver.simulation.closed_loop import Rollout, rollout
from salver.simulation.physics import simulate
from salver.simulation.record import SimulationRecord
from salver.wording import number

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

AXES = ("x", "y", "z")
ROLE_DASHES = {"plan": "-", "baseline": (0, (5, 2)), "nominal": (0, (5, 2))}
COLUMN = 3.45  # in, width of a column of a two-column paper
PAGE = 7.1  # in, width of its page

RC: dict[Any, Any] = {
    "font.size": 8,
    "font.family": "DejaVu Sans",
    "mathtext.fontset": "dejavusans",
    "axes.titlesize": 8,
    "axes.labelsize": 8,
    "xtick.labelsize": 7,
    "ytick.labelsize": 7,
    "legend.fontsize": 7,
    "legend.frameon": False,
    "legend.handlelength": 1.8,
    "axes.linewidth": 0.6,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "grid.color": "#e6e9ec",
    "grid.linewidth": 0.5,
    "axes.axisbelow": True,
    "xtick.major.width": 0.6,
    "ytick.major.width": 0.6,
    "lines.linewidth": 1.2,
    "figure.dpi": 100,
    "savefig.dpi": 220,
    "savefig.bbox": "tight",
    "savefig.pad_inches": 0.03,
    "pdf.fonttype": 42,  # text stays text: journals ask for embedded TrueType
    "svg.fonttype": "none",
    "svg.hashsalt": "salver",  # same data, same file
}


@contextmanager
def paper_style() -> Iterator[None]:
    """matplotlib's settings for the figures of a paper, restored afterwards. Figures are made without pyplot, so
    no display is needed and nothing global is left behind."""
    import matplotlib

    with matplotlib.rc_context(RC):
        yield


EXTRA_MASS = 0.05  # kg, of the paper's Fig. 8 (b)


def perturbed_rollouts(run: ReportedRun, stem: str, n: int, seed: int) -> Rollout:
    """n bodies drawn from the uncertain set (the same for every motion) under eqs (18), (19) along one motion."""
    plan = load_plan(run.directory, stem)
    payload = run.scenario.payload
    body = payload.first
    phi = payload.phi(body, sampling.draw(payload.uncertain, n, seed, "corners", payload.bodies))
    gains = Gains(run.scenario.control.kp, run.scenario.control.kd)
    return rollout(plan.reference, body.inertial, body.contacts.grasp_map, gains, phi, plan.t)


def heavier(plan: Plan, extra: float = EXTRA_MASS) -> SimulationRecord:
    """The plan in the physics engine with its first object heavier by `extra` kg."""
    item = plan.scenario.objects[0]
    mass = Parameter(item.name, "mass", lone=len(plan.scenario.objects) == 1)
    return simulate(plan, parameters={mass.name: item.mass + extra})


def envelope(coefficients: Array, radius: Array) -> tuple[Array, Array]:
    """Least and largest value (T,) of all tubes together."""
    return (coefficients - radius).min(axis=1), (coefficients + radius).max(axis=1)


def drawn(figure: Figure, file_format: str = "png") -> bytes:
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


def trajectories(motions: Iterable[ReportedMotion]) -> Figure:
    """Fig. 3: position over time, and in space."""
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
    _in_space(space, motions)
    return figure


def _in_space(ax: Any, motions: list[ReportedMotion]) -> None:
    """Paths of the object to one scale in all three directions, with start, goal and, dotted, the paths from above."""
    points = np.vstack([m.arrays["p_SB"] for m in motions])
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
    ax.set_box_aspect(spans, zoom=1.15)
    ax.tick_params(pad=-1)
    ax.view_init(elev=20, azim=-35)


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


def perturbed_figure(m: ReportedMotion, runs: Rollout) -> Figure:
    """Figs 5 and 6: cone coefficients of perturbed bodies, within the least and largest edge of all tubes."""
    figure, axes = _new(COLUMN, 2.0)
    ax = axes[0, 0]
    t, values = runs.t, runs.cone_coefficients
    n = len(values)
    for i, colour in zip(_spread_coefficients(m), CYCLE[:4], strict=False):
        ax.plot(t, values[:, :, i].T, color=colour, linewidth=0.3, alpha=0.5, rasterized=n > 30)
        ax.plot([], [], color=colour, linewidth=1.2, label=rf"$\Lambda_{{{i + 1}}}$")
    low, high = envelope(m.arrays["cone_coefficients"], m.arrays["cone_radius"])
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


def tracking(
    motions: Iterable[ReportedMotion], nominal: Mapping[str, SimulationRecord], heavier: Mapping[str, SimulationRecord]
) -> Figure:
    """Fig. 8: norms of the object's position and orientation error, as planned and with more mass."""
    figure, axes = _new(COLUMN, 2.7, rows=2, columns=2, sharex=True, sharey="row")
    titles = ("(a) nominal", f"(b) {1e3 * EXTRA_MASS:+.0f} g")
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
