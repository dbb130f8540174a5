"""Makes pictures of concepts from salver itself and of results from docs/data: python docs/make_figures.py [NAME ...]

Every curve is computed here; nothing is drawn by hand except arrows, labels and frames.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from salver import scenario as scenarios
from salver.geometry import Array, exp, matrix_from_rpy
from salver.models.contact.contact import cone_edges
from salver.models.contact.wrench_cone import facets, margin
from salver.models.uncertain.parameters import INERTIAL, inertial_vector, phi_of
from salver.reports import style

IMAGES = Path(__file__).parent / "images"
DATA = Path(__file__).parent / "data"


def cone() -> Any:
    """The friction cone, the pyramid inscribed in it, and a force made of the pyramid's edges."""
    figure = _figure(3.6, 3.2)
    axes = figure.add_subplot(projection="3d", computed_zorder=False)
    mu, height = 0.5, 1.0
    angle, z = np.meshgrid(np.linspace(0, 2 * np.pi, 80), np.linspace(0, height, 2))
    axes.plot_surface(mu * z * np.cos(angle), mu * z * np.sin(angle), z, color=style.GREY, alpha=0.16, linewidth=0)
    edges = cone_edges(mu, 4)
    tips = edges / edges[2]
    ring = np.concatenate([tips, tips[:, :1]], axis=1)
    axes.plot(*ring, color=style.BLUE, linewidth=0.8)
    for j, tip in enumerate(tips.T):
        axes.plot(*np.stack([np.zeros(3), tip], axis=1), color=style.BLUE, linewidth=1.4)
        axes.text(*(tip * [1.15, 1.15, 1.06]), rf"$\hat f_{{{j + 1}}}$", color=style.BLUE, fontsize=9, ha="center")
    coefficients = np.array([0.42, 0.24, 0.08, 0.16])
    force = edges @ coefficients
    axes.quiver(0, 0, 0, *force, color=style.VERMILION, linewidth=2, arrow_length_ratio=0.1)
    axes.text(0.3, -0.1, 0.3, r"$f_c=\sum_j \lambda_j \hat f_j$", color=style.VERMILION, fontsize=9)
    axes.text(0, 0, -0.12, r"contact $C_i$", fontsize=8, ha="center")
    axes.set(xlim=(-0.5, 0.5), ylim=(-0.5, 0.5), zlim=(0, 1.1))
    axes.set_box_aspect((1, 1, 1), zoom=1.1)
    axes.set_axis_off()
    axes.view_init(elev=24, azim=-68)
    return figure


def acceleration() -> Any:
    """What is left of the paper's condition and of the exact one while a level tray accelerates sideways."""
    cube = scenarios.load("panda-cube").payload.first
    a = np.linspace(0, 5.6, 561)
    wrench = np.zeros((len(a), 6))
    wrench[:, 0], wrench[:, 2] = cube.inertial.mass * a, cube.inertial.mass * 9.81
    least = (wrench @ np.linalg.pinv(cube.contacts.grasp_map).T).min(axis=1)
    exact = margin(facets(cube.contacts), wrench)
    figure = _figure(4.6, 2.6)
    axes = figure.add_subplot()
    axes.axhline(0, color=style.BLACK, linewidth=0.6)
    for values, colour, label in (
        (least, style.VERMILION, r"least $\lambda$ of the pseudo-inverse (the paper's condition)"),
        (exact / exact[0] * least[0], style.BLUE, "distance to the edge of the wrench cone (exact), scaled"),
    ):
        axes.plot(a, values, color=colour, label=label)
        zero = float(np.interp(0, -values, a))
        axes.plot(zero, 0, "o", color=colour, markersize=4)
        axes.annotate(f"{zero:.2f} m/s²", (zero, 0), (4, 6), textcoords="offset points", color=colour, fontsize=8)
    axes.set(xlabel="sideways acceleration of a level tray (m/s²)", ylabel="what is left (N)", xlim=(0, 5.6))
    axes.legend(loc="lower left")
    return figure


def tube() -> Any:
    """One cone coefficient of the robust plan: nominal, tube, and perturbed runs of the full nonlinear loop."""
    from salver.control.object import Gains
    from salver.planning.make import make_plan
    from salver.sampling import draw
    from salver.simulation.closed_loop import rollout

    scenario = scenarios.load("panda-cube").with_changes(
        objects__0__uncertainty={"mass": "10%", "com": [1e-3, 1e-3, 1e-3]}, motion__duration=1.5
    )
    plan = make_plan(scenario, arm=False)
    cube, uncertain = scenario.payload.first, scenario.payload.uncertain
    values = np.tile(inertial_vector(cube.inertial), (60, 1))
    values[:, [INERTIAL.index(name) for name in uncertain.names]] = draw(uncertain, len(values), seed=0)
    gains = Gains(scenario.control.kp, scenario.control.kd)
    t = plan.t
    runs = rollout(plan.reference, cube.inertial, cube.contacts.grasp_map, gains, phi_of(values), t)
    column = int(np.argmax(plan.cone_radius.max(axis=0)))
    nominal, radius = plan.cone_coefficients[:, column], plan.cone_radius[:, column]
    figure = _figure(4.6, 2.6)
    axes = figure.add_subplot()
    axes.fill_between(t, nominal - radius, nominal + radius, color=style.SKY, alpha=0.45, linewidth=0, label="tube")
    axes.plot(t, runs.cone_coefficients[:, :, column].T, color=style.GREY, linewidth=0.35)
    axes.plot([], [], color=style.GREY, linewidth=0.6, label=f"{len(values)} runs, mass ±10 %, centre of mass ±1 mm")
    axes.plot(t, nominal, color=style.BLUE, label="nominal")
    axes.axhline(0, color=style.BLACK, linewidth=0.8)
    axes.annotate("below 0 the contact would have to pull", (0.02, 0), (2, 3), textcoords="offset points", fontsize=7)
    axes.set(xlabel="time (s)", ylabel=rf"cone coefficient $\lambda_{{{column + 1}}}$ (N)", xlim=(0, t[-1]))
    axes.set_ylim(-0.02, 1.12 * float((nominal + radius).max()))
    axes.legend(loc="upper right", ncols=3)
    return figure


def frames() -> Any:
    """Frames of docs/conventions.md on the paper's cube, tilted a little so that they can be told apart."""
    cube = scenarios.load("panda-cube").with_changes(objects__0__at=[-0.035, 0.0]).payload.first
    R_SE = matrix_from_rpy(np.deg2rad([0, 12, 20]))
    p_SE = np.array([0.10, 0.0, 0.07])
    p_SB, R_SB = p_SE + R_SE @ cube.p_EB, R_SE @ cube.R_EB
    figure = _figure(5.0, 3.6)
    axes = figure.add_subplot(projection="3d", computed_zorder=False)
    half = 0.062
    tray = np.array([[half, half], [-half, half], [-half, -half], [half, -half], [half, half]])
    axes.plot(*(p_SE[:, None] + R_SE[:, :2] @ tray.T), color=style.TRAY_COLOUR, linewidth=1.2)
    corners = cube.solid.bounding_points_G - cube.com_G
    for i, a in enumerate(corners):
        for b in corners[i + 1 :]:
            if np.count_nonzero(np.abs(a - b) > 1e-9) == 1:
                axes.plot(*np.stack([p_SB + R_SB @ a, p_SB + R_SB @ b], axis=1), color=style.AMBER, linewidth=0.8)
    _triad(axes, np.zeros(3), np.eye(3), "S", 0.032)
    _triad(axes, p_SE, R_SE, "E", 0.024)
    _triad(axes, p_SB, R_SB, "B", 0.032)
    for i, p in enumerate(cube.contacts.p_BC):
        _triad(axes, p_SB + R_SB @ p, R_SB @ cube.contacts.R_BC[i], f"$C_{i + 1}$", 0.012)
    axes.set(xlim=(0, 0.17), ylim=(-0.06, 0.06), zlim=(0, 0.12))
    axes.set_box_aspect((0.17, 0.12, 0.12), zoom=1.25)
    axes.set_axis_off()
    axes.view_init(elev=32, azim=-62)
    return figure


def shaped() -> Any:
    """What the planner changes: the straight line and the robust reference, and what each does to the sensitivity."""
    from salver.planning.make import make_plan

    scenario = scenarios.load("panda-cube").with_changes(objective__weighting="paper")
    plans = {"plan": make_plan(scenario, arm=False), "baseline": make_plan(scenario, "baseline", arm=False)}
    labels = {"plan": "robust", "baseline": "straight line"}
    figure = _figure(6.4, 2.3)
    path, norm = figure.subplots(1, 2)
    for role, plan in plans.items():
        look = {"color": style.ROLE_COLOURS[role], "linestyle": style.ROLE_DASHES[role], "label": labels[role]}
        p = plan.evaluation.samples.p_SB
        path.plot(1e3 * p[:, 1], 1e3 * p[:, 2], **look)
        sensitivity = plan.state_sensitivity * plan.uncertain.half_range
        norm.plot(plan.t, 1e3 * np.linalg.norm(sensitivity[:, 6:9], axis=(1, 2)), **look)
    path.set(xlabel="y (mm)", ylabel="z (mm)", title='path of the object, weighting = "paper"')
    norm.set(xlabel="time (s)", ylabel="mm/s", title="velocity error at 10 % of mass, first order", xlim=(0, None))
    path.legend()
    figure.tight_layout()
    return figure


def speeds() -> Any:
    """Durations of docs/data/speeds.jsonl: what a level tray costs, and what holding at every speed costs."""
    lines = [json.loads(line) for line in (DATA / "speeds.jsonl").read_text(encoding="utf-8").splitlines()]
    loads = {line["name"]: line for line in lines if line["kind"] == "loads"}
    labels = {"level": "every speed, level tray", "any": "every speed (default)", "full": "full speed alone"}
    return _bars(list(loads), {label: [x[key] for x in loads.values()] for key, label in labels.items()})


def stops() -> Any:
    """How long the stops of docs/data/stops.json take, beside the motions that they stop."""
    loads = json.loads((DATA / "stops.json").read_text(encoding="utf-8"))
    labels = {"duration": "the whole motion", "longest": "longest stop", "median": "median stop"}
    return _bars(list(loads), {label: [x[key] for x in loads.values()] for key, label in labels.items()})


FIGURES: dict[str, Callable[[], Any]] = {
    f.__name__: f for f in (cone, acceleration, tube, frames, shaped, speeds, stops)
}


def _bars(names: list[str], series: dict[str, list[float]]) -> Any:
    """Durations in s: a group of bars for each name, one bar for each series."""
    figure = _figure(6.4, 0.6 + 0.38 * len(names))
    axes = figure.add_subplot()
    places, height = np.arange(len(names)), 0.8 / len(series)
    for k, (label, values) in enumerate(series.items()):
        colour = (style.GREY, style.BLUE, style.SKY)[k]
        axes.barh(places + (k - (len(series) - 1) / 2) * height, values, 0.9 * height, color=colour, label=label)
    axes.set_yticks(places, names)
    axes.invert_yaxis()
    axes.set(xlabel="duration, s")
    axes.legend(loc="upper center", bbox_to_anchor=(0.4, 1.1 if len(names) > 5 else 1.25), ncols=3, frameon=False)
    figure.tight_layout()
    return figure


def _figure(width: float, height: float) -> Any:
    from matplotlib.figure import Figure

    return Figure(figsize=(width, height))


def _triad(axes: Any, p: Array, rotation: Array, name: str, length: float) -> None:
    for axis, colour, letter in zip(rotation.T, (style.VERMILION, style.GREEN, style.BLUE), "xyz", strict=True):
        axes.quiver(*p, *(length * axis), color=colour, linewidth=1.1, arrow_length_ratio=0.18)
        if length > 0.012:
            axes.text(*(p + 1.18 * length * axis), letter, color=colour, fontsize=6, ha="center", va="center")
    beside = rotation @ exp(np.array([0.0, 0.0, -2.4])) @ np.array([0.2 * length + 0.004, 0, 0])
    axes.text(*(p + beside), name, fontsize=8, ha="center", va="center", weight="bold")


def main() -> None:
    import matplotlib

    wanted = sys.argv[1:] or list(FIGURES)
    IMAGES.mkdir(exist_ok=True)
    for name in wanted:
        with style.paper_style(), matplotlib.rc_context({"svg.fonttype": "path"}):
            FIGURES[name]().savefig(IMAGES / f"{name}.svg", metadata={"Date": None})
        print(IMAGES / f"{name}.svg")


if __name__ == "__main__":
    main()
