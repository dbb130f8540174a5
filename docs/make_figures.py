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
from paper_figures import ROLE_DASHES, paper_style

from salver import scenario as scenarios
from salver.contact_margins import margins
from salver.geometry import Array, exp, matrix_from_rpy
from salver.models.contact.contact import cone_edges
from salver.models.contact.wrench_cone import cone_facets, margin, zero_moment_point
from salver.models.uncertain.parameters import INERTIAL, inertial_vector, phi_of
from salver.reports import style
from salver.trajectory import MotionSamples
from salver.wording import number

IMAGES = Path(__file__).parent / "images"
DATA = Path(__file__).parent / "data"
ARROW = {"arrowstyle": "-|>", "color": style.GREY, "linewidth": 1.2, "shrinkA": 0, "shrinkB": 0}


def cone() -> Any:
    """The friction cone, the pyramid inscribed in it, and a force made of the pyramid's edges."""
    figure, axes = _space(3.2, 3.1, (-0.08, -0.19, 1.2, 1.22))
    mu, height = 0.5, 1.0
    angle, z = np.meshgrid(np.linspace(0, 2 * np.pi, 80), np.linspace(0, height, 2))
    axes.plot_surface(mu * z * np.cos(angle), mu * z * np.sin(angle), z, color=style.GREY, alpha=0.16, linewidth=0)
    edges = cone_edges(mu, 4)
    tips = edges / edges[2]
    ring = np.concatenate([tips, tips[:, :1]], axis=1)
    axes.plot(*ring, color=style.BLUE, linewidth=0.8)
    for j, tip in enumerate(tips.T):
        axes.plot(*np.stack([np.zeros(3), tip], axis=1), color=style.BLUE, linewidth=1.4)
        axes.text(*(tip * [1.15, 1.15, 1.01]), rf"$\hat f_{{{j + 1}}}$", color=style.BLUE, fontsize=9, ha="center")
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
    exact = margin(cone_facets(cube.contacts).rows, wrench)
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
    axes.set(xlabel="sideways acceleration of a level tray (m/s²)", ylabel="margin (N)", xlim=(0, 5.6))
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
    figure, axes = _space(4.4, 2.6, (-0.1, -0.39, 1.2, 1.56))
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
        look = {"color": style.ROLE_COLOURS[role], "linestyle": ROLE_DASHES[role], "label": labels[role]}
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


def evasions() -> Any:
    """Shares of the balls and posts of docs/data/live-obstacles.json that were evaded in real time, by load."""
    runs = json.loads((DATA / "live-obstacles.json").read_text(encoding="utf-8"))
    coming = {
        name.partition(",")[0]: [x for x in each if x["would"]] for name, each in runs.items() if "virtual" not in name
    }
    series = {
        f"{what}s": [100 * np.mean([x["hit"] is None for x in each if x["what"] == what]) for each in coming.values()]
        for what in ("ball", "post")
    }
    return _bars(list(coming), series, "evaded in real time, %")


def survey() -> Any:
    """How far the durations of docs/data/survey.jsonl are above the best known ones, by rank."""
    tasks = [json.loads(line) for line in (DATA / "survey.jsonl").read_text(encoding="utf-8").splitlines()]
    above = []
    for task in tasks:
        duration = task["default"]["duration"]
        if duration is not None and task["known"]:
            above.append(100 * (duration / min(duration, *task["known"]) - 1))
    figure = _figure(6.4, 2.6)
    axes = figure.add_subplot()
    axes.plot(np.arange(1, len(above) + 1), np.sort(above), ".", color=style.BLUE, label=f"each of {len(above)} tasks")
    axes.axhline(
        3, color=style.GREY, linewidth=1, linestyle="--", label=f"3 %: {sum(x <= 3 for x in above)} tasks are below"
    )
    axes.set(xlabel="tasks, by this percentage", ylabel="duration above best known, %", ylim=(-0.2, None))
    axes.legend(loc="upper left")
    return _tight(figure)


def tipping() -> Any:
    """Where the force on a bottle's base acts (the zero-moment point) while a level tray accelerates."""
    scenario = scenarios.load("panda-tall-bottle")
    a = np.linspace(0.0, 4.0, 401)
    along = _accelerating(scenario, a)
    stays, tips, curve = _figure(6.9, 2.7).subplots(1, 3, width_ratios=(1, 1, 1.5))
    for axes, value, title in ((stays, 1.5, "stays"), (tips, 3.2, "tips")):
        _bottle_on_tray(axes, scenario.payload.first, value, 0.0)
        axes.set_title(f"{value:g} m/s²: {title}")
    for values, colour, dash, label, beside in (
        (along.tip_over, style.BLUE, "-", "nominal", (4, 6)),
        (along.tip_over_worst, style.VERMILION, (0, (5, 2)), "worst case of its ranges", (-46, -12)),
    ):
        curve.plot(a, 1e3 * values, color=colour, linestyle=dash, label=label)
        zero = float(np.interp(0, -values, a))
        curve.plot(zero, 0, "o", color=colour, markersize=4)
        curve.annotate(f"{zero:.2f} m/s²", (zero, 0), beside, textcoords="offset points", color=colour, fontsize=8)
    curve.axhline(0, color=style.BLACK, linewidth=0.6)
    curve.set(xlabel="sideways acceleration, m/s²", ylabel="zero-moment point to edge, mm", xlim=(0, 4))
    curve.legend(loc="upper right")
    return _tight(curve.figure)


def tilt() -> Any:
    """The waiter's tilt: what leaning does to the zero-moment point at full speed, at less and at rest."""
    scenario = scenarios.load("panda-tall-bottle")
    full, lean = 3.5, np.linspace(0.0, np.deg2rad(35), 141)
    best = float(np.arctan2(full, 9.81))
    level, leaning, curve = _figure(6.9, 2.7).subplots(1, 3, width_ratios=(1, 1, 1.5))
    for axes, angle, title in (
        (level, 0.0, "level: tips"),
        (leaning, best, f"leans by {np.rad2deg(best):.0f}°: stays"),
    ):
        _bottle_on_tray(axes, scenario.payload.first, full, angle)
        axes.set_title(title)
    cases = ((full, "full speed: 3.5 m/s²"), (full / 4, "half speed: 0.9 m/s²"), (0.0, "at rest"))
    looks = ((style.BLUE, "-"), (style.VERMILION, (0, (5, 2))), (style.GREY, (0, (1, 1))))
    for (value, label), (colour, dash) in zip(cases, looks, strict=True):
        room = _accelerating(scenario, np.full(len(lean), value), lean).tip_over
        curve.plot(np.rad2deg(lean), 1e3 * room, color=colour, linestyle=dash, label=label)
    curve.axhline(0, color=style.BLACK, linewidth=0.6)
    curve.set(xlabel="tray leans by, degrees", ylabel="zero-moment point to edge, mm", xlim=(0, 35), ylim=(-40, 60))
    curve.legend(loc="upper right")
    return _tight(curve.figure)


def ranges() -> Any:
    """The fastest motion for the ranges of a bottle beside the one for its nominal values."""
    from salver.planning.fastest import plan_fastest

    scenario = scenarios.load("panda-tall-bottle")
    speeding, left = _figure(6.4, 3.6).subplots(2, 1, sharex=True)
    way = np.subtract(scenario.motion.goal.position, scenario.motion.start.position)
    for role, robust in (("plan", True), ("nominal", False)):
        plan = plan_fastest(scenario, robust=robust)
        label = "planned for the ranges" if robust else "planned for the nominal values"
        look = {"color": style.ROLE_COLOURS[role], "linestyle": ROLE_DASHES[role], "label": label}
        samples = plan.evaluation.samples
        speeding.plot(samples.t, samples.a_S @ way / np.linalg.norm(way), **look)
        worst = 100 * plan.evaluation.contacts.min(axis=1)
        left.plot(samples.t, worst, **{**look, "label": f"least {number(worst.min(), 1, ' %')}"})
    for axes in (speeding, left):
        axes.axhline(0, color=style.BLACK, linewidth=0.6)
    speeding.set(ylabel="acceleration along\nthe path, m/s²")
    speeding.legend(loc="upper right")
    left.legend(loc="upper left", bbox_to_anchor=(0.03, 1.12))
    left.set(xlabel="time, s", ylabel="worst-case margin,\n% of the weight", xlim=(0, None))
    left.annotate("below 0 the bottle may slide or tip", (0.2, -16), fontsize=8)
    return _tight(speeding.figure)


def overview() -> Any:
    """From scenario to robot, with the command of each step."""
    axes = _figure(6.9, 2.2).add_axes((0, 0, 1, 1))
    boxes = {
        "Scenario": (0.0, "load and its ranges,\narm, tray,\nstart and goal", "salver new"),
        "Plan": (2.55, "fastest or safest\nmotion, with stops\non the way", "salver plan"),
        "Checks": (
            5.1,
            "tubes, exact margins,\nperturbed runs\nin MuJoCo",
            "salver campaign",
        ),
        "Robot": (7.65, "driven, exported,\nor steered live", "salver execute"),
    }
    for name, (x, text, command) in boxes.items():
        axes.add_patch(_rounded(x, 0.0, 2.0, 1.5, style.BLUE))
        axes.text(x + 1.0, 1.28, name, ha="center", va="center", weight="bold", fontsize=10)
        axes.text(x + 1.0, 0.76, text, ha="center", va="center", fontsize=7.5, linespacing=1.35)
        axes.text(
            x + 1.0, 0.2, command, ha="center", va="center", fontsize=8, family="DejaVu Sans Mono", color=style.BLUE
        )
        if x < 7:
            axes.annotate("", (x + 2.52, 0.75), (x + 2.03, 0.75), arrowprops=ARROW)
    axes.annotate("", (1.0, -0.03), (8.65, -0.03), arrowprops=ARROW | {"connectionstyle": "bar,fraction=-0.055"})
    axes.text(
        4.83,
        -0.47,
        "logs of the robot narrow the ranges: salver identify, calibrate, track",
        ha="center",
        va="top",
        fontsize=8,
    )
    axes.annotate("", (3.55, 1.53), (6.1, 1.53), arrowprops=ARROW | {"connectionstyle": "bar,fraction=0.09"})
    axes.text(
        4.83, 1.8, "not safe: the constraint, the time and the amount are named", ha="center", va="bottom", fontsize=8
    )
    axes.set(xlim=(-0.05, 9.7), ylim=(-0.75, 2.1))
    axes.set_axis_off()
    return axes.figure


def committed() -> Any:
    """Every motion that is committed while twists come in, with the stop in which it ends."""
    from salver.live import Live

    moving = Live("panda-tall-bottle", lead=0.04)
    arm, period, silent = moving.problem.arm, 1e-3, 1.5
    now, requested, commanded, stops, seen = [], [], [], [], None
    for k in range(2300):
        t = k * period
        request = 0.0 if t < 0.1 else 0.30 if t < 0.9 else -0.20
        if k % 20 == 0 and t < silent:
            moving.twist((0.0, request, 0.0))
            moving.plan()
        q, dq, *_ = moving.command(t)
        now.append(t)
        requested.append(request if t < silent else np.nan)
        commanded.append(_speed(arm, q, dq))
        if moving.committed is not seen:
            seen = moving.committed
            own = np.linspace(0.0, seen.motion.duration, 60)
            q, dq, _ = seen.motion.sample(own)
            stops.append((seen.begins + own, [_speed(arm, *state) for state in zip(q, dq, strict=True)]))
    axes = _figure(6.9, 2.9).add_subplot()
    axes.plot(now, requested, color=style.BLACK, linewidth=0.8, linestyle=(0, (1, 1)), label="twist requested")
    for k, (t, speed) in enumerate(stops):
        axes.plot(t, speed, color=style.SKY, linewidth=0.5, label="committed, and replaced later" if k == 1 else None)
    t, speed = stops[-1]
    axes.plot(now, commanded, color=style.BLUE, linewidth=1.8, label="carried out")
    axes.plot(t, speed, color=style.VERMILION, linewidth=1.8, label="the last one, to rest")
    axes.axvline(silent, color=style.GREY, linewidth=0.8)
    axes.annotate(
        "requests and planner\nare gone", (silent, 0.27), (4, 0), textcoords="offset points", fontsize=8, va="top"
    )
    axes.axhline(0, color=style.BLACK, linewidth=0.6)
    axes.set(xlabel="time, s", ylabel="velocity of the tray along y, m/s", xlim=(0, 2.2))
    axes.legend(loc="lower left")
    return axes.figure


def sloshing() -> Any:
    """The two modes of a cup that move, and the highest crest along two motions of the cup."""
    from scipy.special import j1

    from salver.planning.fastest import plan_fastest
    from salver.planning.make import make_plan

    scenario = scenarios.load("panda-coffee")
    cup = scenario.payload.first.inner
    radius, modes = cup.inside.half(cup.fill)[0], cup.modes(cup.fill)
    *drawn, curve = _figure(6.9, 2.6).subplots(1, 3, width_ratios=(1, 1, 1.7))
    x = np.linspace(-radius, radius, 121)
    for n, axes in enumerate(drawn):
        k = _root(modes.omega[n, 0], cup.fill, radius)
        shape = 0.2 * radius * j1(k * x) / j1(k * radius) / (1 + n)
        for sign, alpha in ((-1, 0.35), (1, 1.0)):
            axes.plot(1e3 * x, 1e3 * (cup.fill + sign * shape), color=style.BLUE, alpha=alpha)
        axes.fill_between(1e3 * x, 0, 1e3 * (cup.fill + shape), color=style.SKY, alpha=0.25, linewidth=0)
        axes.axhline(1e3 * cup.fill, color=style.GREY, linewidth=0.6, linestyle=":")
        wall = 1e3 * np.array([[-radius, -radius, radius, radius], [cup.brim, 0, 0, cup.brim]])
        axes.plot(*wall, color=style.BLACK, linewidth=1.6)
        share = modes.mass[n, 0] / modes.frozen.mass
        axes.set_title(f"mode {n + 1}: {modes.omega[n, 0] / (2 * np.pi):.1f} Hz,\n{100 * share:.0f} % of the liquid")
        axes.set(xlabel="across, mm", aspect="equal", xlim=(-46, 46), ylim=(-2, 84))
        axes.grid(visible=False)
    drawn[0].set_ylabel("height, mm")
    plan = plan_fastest(scenario)
    line = make_plan(scenario.with_changes(motion__duration=plan.duration), "baseline", arm=False)
    for role, made, label in (("plan", plan, "planned with the liquid"), ("baseline", line, "straight line")):
        (spill,) = made.margins.load_verdicts(worst=True)
        room = 1e3 * spill.left
        look = {"color": style.ROLE_COLOURS[role], "linestyle": ROLE_DASHES[role]}
        curve.plot(spill.t, room, label=f"{label}: least {number(room.min(), 0, ' mm')}", **look)
    curve.axhline(0, color=style.BLACK, linewidth=0.8)
    curve.set(xlabel="time, s", ylabel="highest crest to brim, mm", xlim=(0, plan.duration), ylim=(-28, 34))
    curve.annotate("may spill below 0", (0.295, -14), fontsize=7)
    curve.legend(loc="upper right")
    return _tight(curve.figure)


def _accelerating(scenario: Any, a: Array, lean: Array | float = 0.0) -> Any:
    """Margins of the first object on a tray that accelerates by a (T,), m/s^2, along x and leans into it, rad."""
    zero, lean = np.zeros((len(a), 3)), np.broadcast_to(lean, len(a))
    R = np.stack([matrix_from_rpy(np.array([0.0, angle, 0.0])) for angle in lean])
    samples = MotionSamples(np.linspace(0, 1, len(a)), zero, zero, np.column_stack([a, zero[:, :2]]), R, zero, zero)
    return margins(scenario, samples, edges=32).interfaces[0]


def _bottle_on_tray(axes: Any, bottle: Any, a: float, lean: float) -> None:
    """A bottle from the side, mm: weight, inertial force of an acceleration a along x, their sum."""
    turn = np.array([[np.cos(lean), np.sin(lean)], [-np.sin(lean), np.cos(lean)]])
    radius, height = 1e3 * bottle.solid.bounding_points_G[:, 0].max(), 1e3 * bottle.solid.height
    middle = turn @ [0.0, 0.5 * height]
    base = turn @ np.array([[-95, 95], [0, 0]])
    axes.plot(*base, color=style.TRAY_COLOUR, linewidth=3, solid_capstyle="butt")
    sides = turn @ np.array([[-radius, -radius, radius, radius, -radius], [0, height, height, 0, 0]])
    axes.fill(*sides, color=style.SKY, alpha=0.3, linewidth=0)
    axes.plot(*sides, color=style.BLUE, linewidth=0.9)
    down, back = np.array([0.0, -70.0]), np.array([-70.0 * a / 9.81, 0.0])  # 70 mm for the weight
    total = down + back
    reach = middle + total * float(middle @ turn[:, 1]) / -float(total @ turn[:, 1])
    axes.plot(*np.stack([middle, reach], axis=1), color=style.VERMILION, linewidth=0.9, linestyle=(0, (4, 2)))
    force = matrix_from_rpy(np.array([0.0, lean, 0.0])).T @ np.array([a, 0.0, 9.81])  # of a kilogram
    zmp, _ = zero_moment_point(bottle.contacts, np.concatenate([force, np.zeros(3)]))[0]
    axes.plot(*(turn @ [1e3 * zmp, 0.0]), "o", color=style.VERMILION, markersize=5)
    axes.text(0, -60, "zero-moment point", color=style.VERMILION, fontsize=8, ha="center")
    for arrow, colour, label, side in (
        (down, style.BLACK, "$m g$", (6, -6)),
        (back, style.BLACK, "$m a$", (-14, 3)),
        (total, style.VERMILION, "", (0, 0)),
    ):
        axes.annotate("", middle + arrow, middle, arrowprops=ARROW | {"color": colour})
        axes.annotate(label, middle + arrow, side, textcoords="offset points", fontsize=8)
    axes.annotate("", (-20, 262), (-80, 262), arrowprops=ARROW | {"color": style.GREEN})
    axes.annotate("$a$", (-55, 267), fontsize=9, color=style.GREEN)
    axes.set(xlim=(-105, 130), ylim=(-62, 285), aspect="equal")
    axes.set_axis_off()


def _root(omega: float, depth: float, radius: float) -> float:
    """Wave number, 1/m, of a mode with this frequency: omega^2 = g k tanh(k depth)."""
    from scipy.optimize import brentq

    return float(brentq(lambda k: 9.81 * k * np.tanh(k * depth) - omega**2, 0.1 / radius, 20 / radius))


def _speed(arm: Any, q: Array, dq: Array) -> float:
    """Velocity of the tray along y of the base, m/s."""
    _, R = arm.tray_pose(q)
    return float((R @ (arm.body_jacobian(q) @ dq)[:3])[1])


def _rounded(x: float, y: float, width: float, height: float, colour: str) -> Any:
    from matplotlib.patches import FancyBboxPatch

    return FancyBboxPatch(
        (x + 0.05, y),
        width - 0.1,
        height,
        "round,pad=0.02,rounding_size=0.08",
        facecolor="white",
        edgecolor=colour,
        linewidth=1.2,
    )


def _tight(figure: Any) -> Any:
    figure.tight_layout()
    return figure


FIGURES: dict[str, Callable[[], Any]] = {
    f.__name__: f
    for f in (
        cone,
        acceleration,
        tube,
        frames,
        shaped,
        speeds,
        stops,
        evasions,
        survey,
        tipping,
        tilt,
        ranges,
        overview,
        committed,
        sloshing,
    )
}


def _bars(names: list[str], series: dict[str, list[float]], unit: str = "duration, s") -> Any:
    """A group of bars for each name, one bar for each series."""
    figure = _figure(6.4, 0.6 + 0.38 * len(names))
    axes = figure.add_subplot()
    places, height = np.arange(len(names)), 0.8 / len(series)
    for k, (label, values) in enumerate(series.items()):
        colour = (style.GREY, style.BLUE, style.SKY)[k]
        axes.barh(places + (k - (len(series) - 1) / 2) * height, values, 0.9 * height, color=colour, label=label)
    axes.set_yticks(places, names)
    axes.invert_yaxis()
    axes.set(xlabel=unit)
    axes.legend(loc="upper center", bbox_to_anchor=(0.4, 1.1 if len(names) > 5 else 1.25), ncols=3, frameon=False)
    figure.tight_layout()
    return figure


def _figure(width: float, height: float) -> Any:
    from matplotlib.figure import Figure

    return Figure(figsize=(width, height))


def _space(width: float, height: float, place: tuple[float, float, float, float]) -> tuple[Any, Any]:
    """A figure of this size and 3-D axes over it and beyond, whose empty rim is cut off."""
    figure = _figure(width, height)
    axes = figure.add_axes(place, projection="3d", computed_zorder=False)
    return figure, axes


def _triad(axes: Any, p: Array, rotation: Array, name: str, length: float) -> None:
    for axis, colour, letter in zip(rotation.T, (style.VERMILION, style.GREEN, style.BLUE), "xyz", strict=True):
        axes.quiver(*p, *(length * axis), color=colour, linewidth=1.1, arrow_length_ratio=0.18)
        if length > 0.012:
            axes.text(*(p + 1.22 * length * axis), letter, color=colour, fontsize=8, ha="center", va="center")
    beside = rotation @ exp(np.array([0.0, 0.0, -2.4])) @ np.array([0.2 * length + 0.004, 0, 0])
    axes.text(*(p + beside), name, fontsize=8, ha="center", va="center", weight="bold")


def main() -> None:
    import matplotlib

    wanted = sys.argv[1:] or list(FIGURES)
    IMAGES.mkdir(exist_ok=True)
    for name in wanted:
        with paper_style(), matplotlib.rc_context({"svg.fonttype": "path"}):
            figure = FIGURES[name]()
            box = figure.bbox_inches if figure.axes[0].name == "3d" else None  # its own, or that of what is drawn
            figure.savefig(IMAGES / f"{name}.svg", metadata={"Date": None}, bbox_inches=box)
        print(IMAGES / f"{name}.svg")


if __name__ == "__main__":
    main()
