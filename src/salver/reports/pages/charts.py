"""Charts of the page: what each shows, as data for the page's own plotting script."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from salver.errors import ScenarioError
from salver.geometry import Array, lean, spread
from salver.models.uncertain.parameters import Parameter
from salver.reports.parameters import pretty
from salver.reports.style import CYCLE, ROLE_COLOURS
from salver.sensitivity import tubes
from salver.wording import listed

if TYPE_CHECKING:
    from salver.models.arm.arm import ArmModel
    from salver.reports.run import Record, ReportedMotion, ReportedRun

Spec = dict[str, Any]
Units = tuple[tuple[str, float], ...]  # name and factor from SI
LENGTHS: Units = (("mm", 1e3), ("µm", 1e6))
ANGLES: Units = (("mrad", 1e3), ("µrad", 1e6))
DASH = {"plan": "", "baseline": "6 3", "nominal": "6 3"}


def thin(t: Array, *curves: Array) -> list[list[float | None]]:
    """Time and curves at no more than 240 instants, more than the pixels of a chart, to five digits."""
    keep = spread(len(t), 240)
    return [_digits(x[keep]) for x in (t, *curves)]


def _digits(values: Array) -> list[float | None]:
    """Five digits are more than a chart shows; a gap in a measurement becomes null."""
    return [float(f"{v:.5g}") if np.isfinite(v) else None for v in np.asarray(values, dtype=float)]


def curve(name: str, colour: str, t: Array, y: Array, **style: Any) -> Spec:
    x, values = thin(t, y)
    return {"name": name, "colour": colour, "x": x, "y": values, **style}


def series(motion: ReportedMotion, name: str, t: Array, y: Array, **style: Any) -> Spec:
    """A curve in the colour and dash of the motion it belongs to."""
    return curve(name, ROLE_COLOURS[motion.stem], t, y, dash=DASH[motion.stem], **style)


def time_chart(title: str, y: str, curves: list[Spec], note: str = "", unit: str = "", **more: Any) -> Spec:
    return {"title": title, "note": note, "x": "time, s", "y": y, "series": curves, "unit": unit, "time": True, **more}


def margin_charts(run: ReportedRun) -> list[Spec]:
    """Three ways to ask how close to sliding, tipping or lifting a motion comes, the paper's own condition where the
    plan is held to it, and which stops on the path keep the load."""
    curves = run.contact
    one = curves[run.plan.stem].coefficient is not None
    margin, friction, tip = [], [], []
    for m in run.motions:
        c = curves[m.stem]
        margin.append(series(m, f"{m.label}, worst case", c.t, 100 * c.worst))
        margin.append(series(m, f"{m.label}, nominal load", c.t, 100 * c.nominal, width=1.0, opacity=0.55))
        friction.append(series(m, m.label, c.t, c.coefficient if c.coefficient is not None else 100 * c.friction))
        tip.append(series(m, f"{m.label}, worst case", c.t, 1e3 * c.tip_worst))
        tip.append(series(m, f"{m.label}, nominal load", c.t, 1e3 * c.tip, width=1.0, opacity=0.55))
    zero = {"y": 0, "label": ""}
    follows = (
        "on the reference itself" if run.paper or run.given else "with the errors that they cause in the closed loop"
    )
    needed = "Least friction coefficient" if one else "Largest share of its friction that any object needs"
    charts = [
        time_chart(
            "Distance to sliding, tipping or lifting",
            "margin, % of the weight",
            margin,
            "How far inside its contact wrench cone the required wrench stays: above zero it sticks. Worst case: over "
            f"all uncertain parameters, {follows}.",
            "%",
            lines=[zero],
        ),
        time_chart(
            "Friction needed",
            "coefficient" if one else "% of what there is",
            friction,
            f"{needed} at which the contacts can give the nominal wrench. Below the line it sticks.",
            "" if one else "%",
            lines=_friction_lines(run) if one else [{"y": 100, "label": "all there is"}],
            zero=True,
        ),
        time_chart(
            "Distance to tipping over",
            "distance to edge, mm",
            tip,
            "How far inside its base the centre of pressure stays. At zero a body starts to tip. Worst case: over all "
            "uncertain parameters, on the reference itself.",
            "mm",
            lines=[zero],
            range=_tip_range(tip),
        ),
    ]
    if run.paper:
        one_alone = f" of {run.bodies[0].name} alone" if len(run.bodies) > 1 else ""
        charts.append(
            time_chart(
                "Least cone coefficient, lower edge of its tube",
                "min (Λ − r), N",
                [series(m, m.label, m.t, m.cone_floor.min(axis=1)) for m in run.motions],
                "The paper's condition asks that it stay above zero. Sufficient, not necessary: it judges one "
                f"distribution of the internal forces{one_alone}.",
                "N",
                lines=[zero],
            )
        )
    stops = [(m, known) for m in run.motions if (known := curves[m.stem].braking) is not None]
    if stops:
        charts.append(
            {
                "title": "Stops on the path",
                "note": "A protective or soft stop of the robot lets the speed fall evenly to zero on the path. Look "
                "up how long yours takes: the load then stays if it begins at so many of the instants, in the worst "
                "case. Only stops that end before the motion are counted. How the arm strays is left out.",
                "x": "duration of the stop, s",
                "y": "instants, %",
                "unit": "%",
                "zero": True,
                "series": [series(m, m.label, known.durations, 100 * known.kept) for m, known in stops],
            }
        )
    return charts


def _tip_range(curves: list[Spec]) -> list[float] | None:
    """None for all of the curves; once a body is far over the edge of its base, the figures run away to no use."""
    values = [v for c in curves for v in c["y"] if v is not None]
    high = max(values, default=1.0)
    return [-high, 1.06 * high] if values and min(values) < -high else None


def _friction_lines(run: ReportedRun) -> list[Spec]:
    """The friction there is, and the least that is assumed."""
    first = run.bodies[0]
    least = run.scenario.payload.least_friction(first)
    lines: list[Spec] = [{"y": first.friction, "label": f"available: {first.friction:g}"}]
    return lines + [{"y": least, "label": f"least assumed: {least:.3g}", "below": True}] * (least < first.friction)


def cone_charts(run: ReportedRun) -> list[Spec]:
    """All cone coefficients of each motion with their tubes, on one scale."""
    low = min(float(m.cone_floor.min()) for m in run.motions)
    high = max(float((m.arrays["cone_coefficients"] + m.arrays["cone_radius"]).max()) for m in run.motions)
    pad = 0.06 * (high - low)
    charts = []
    for m in run.motions:
        nominal, radius = m.arrays["cone_coefficients"], m.arrays["cone_radius"]
        bands, curves = [], []
        for i, (centre, r) in enumerate(zip(nominal.T, radius.T, strict=True)):
            t, y, bottom, top = thin(m.t, centre, centre - r, centre + r)
            colour = ROLE_COLOURS[m.stem]
            bands.append({"x": t, "low": bottom, "high": top, "colour": colour, "opacity": 0.10})
            curves.append({"name": f"Λ{i + 1}", "quiet": True, "colour": colour, "width": 0.9, "x": t, "y": y})
        charts.append(
            time_chart(
                f"{m.label}: {nominal.shape[1]} coefficients and their tubes",
                "Λ, N",
                curves,
                unit="N",
                bands=bands,
                range=[min(low - pad, 0.0 - pad), high + pad],
                lines=[{"y": 0, "label": ""}],
            )
        )
    return charts


def sensitivity_charts(run: ReportedRun) -> list[Spec]:
    """Deviation of the object, and change of the contact forces, under parameter errors."""
    wanted = (
        ("Position", "mm", slice(0, 3), "How far wrong parameters take the object off its reference."),
        ("Orientation", "mrad", slice(3, 6), "How far they turn it."),
    )
    charts = []
    for title, unit, rows, note in wanted:
        curves = [
            series(m, m.label, m.t, 1e3 * np.linalg.norm(_state_radius(run, m)[:, rows], axis=1))
            for m in run.motions
            if "state_sensitivity" in m.arrays
        ]
        if any(max(c["y"]) > 1e-6 for c in curves):
            charts.append(time_chart(title, f"tube radius, {unit}", curves, note, unit, zero=True))
    parameters = [run.parameter(str(n)) for n in run.plan.arrays["parameter_names"]]
    if len(parameters) > 1:
        charts.append(_by_parameter(run.plan, parameters))
    return charts


def _by_parameter(plan: ReportedMotion, parameters: list[Parameter]) -> Spec:
    """The parameters that move a cone coefficient; those that hardly do are named below the title."""
    half = plan.arrays["parameter_half_range"]
    effect = np.abs(plan.arrays["input_sensitivity"] * half).max(axis=1)
    peak = effect.max(axis=0)
    order = [int(i) for i in np.argsort(-peak, kind="stable") if peak[i] >= 0.02 * peak.max()][: len(CYCLE)]
    shown = zip(CYCLE, order, strict=False)
    curves = [curve(pretty(parameters[i]), colour, plan.t, effect[:, i]) for colour, i in shown]
    small = [pretty(p) for i, p in enumerate(parameters) if i not in order]
    note = "Share of each parameter in the widest tube."
    if small:
        note += f" Less than 2 % of the largest: {', '.join(small)}."
    return time_chart(f"{plan.label}: which parameter matters", "largest |Θ δ|, N", curves, note, "N", zero=True)


def _state_radius(run: ReportedRun, m: ReportedMotion) -> Array:
    uncertain = run.scenario.payload.uncertain.restricted([run.parameter(n) for n in m.arrays["parameter_names"]])
    return tubes.radius(m.arrays["state_sensitivity"], uncertain)


def reference_charts(run: ReportedRun) -> list[Spec]:
    """Path of the object per axis, relative to the start."""
    charts = []
    for axis, name in enumerate("xyz"):
        curves = [series(m, m.label, m.t, m.arrays["p_SB"][:, axis]) for m in run.motions]
        charts.append(time_chart(f"Position {name}", f"{name}, m", curves, unit="m", height=170))
    tilt = [series(m, m.label, m.t, np.rad2deg(lean(m.R_SB))) for m in run.motions]
    if max(max(c["y"]) for c in tilt) > 0.05:
        charts.append(time_chart("Tilt of the tray", "angle from level, °", tilt, unit="°", height=170, zero=True))
    return charts


def clearance_charts(run: ReportedRun, arm: ArmModel) -> list[Spec]:
    """Clearance of arm, tray and load from one another and from obstacles, over time."""
    from salver.models.arm.arm_geometry import arm_geometry

    try:
        parts = arm_geometry(arm, run.bodies, run.scenario.around)
    except ScenarioError:  # a mesh that was there when it was planned
        return []
    if not parts.pairs:
        return []
    around = [k for k, (_, j) in enumerate(parts.pairs) if j >= len(parts.names) - parts.obstacles]
    whole, near = [], []
    for m in run.motions:
        keep = spread(len(m.t), 121)
        distance = 1e3 * parts.clearance(m.arrays["q"][keep])
        whole.append(series(m, m.label, m.t[keep], distance.min(axis=1)))
        if around:
            near.append(series(m, m.label, m.t[keep], distance[:, around].min(axis=1)))
    charts = [time_chart("Clearance of arm, tray and load", "least distance, mm", whole, unit="mm", zero=True)]
    if near:
        names = listed(dict.fromkeys(obstacle.name for obstacle in run.scenario.around))
        charts.append(time_chart(f"Clearance from {names}", "least distance, mm", near, unit="mm", zero=True))
    return charts


def inside_charts(run: ReportedRun) -> list[Spec]:
    """How far what moves inside each object goes, and its edge: along the plans, with the range over its values and
    dampings, and in the physics engine."""
    payload, charts = run.scenario.payload, []
    for k, body in enumerate(run.bodies):
        inner = body.inner
        if inner is None:
            continue
        curves, bands = [], []
        for m in run.motions:
            whole = run.loads(m)
            assert whole is not None
            found = whole.worst[body.name][0].modes.seen[..., 2]
            x, low, high = thin(m.t, 1e3 * found.min(axis=0), 1e3 * found.max(axis=0))
            bands.append({"x": x, "low": low, "high": high, "colour": ROLE_COLOURS[m.stem]})
            nominal = whole.nominal[body.name][0].modes.seen[0, :, 2]
            curves.append(series(m, f"{m.label}, nominal load", m.t, 1e3 * nominal))
            if m.simulation is not None and m.simulation.arrays.get("surface", np.zeros((0, 0))).shape[1]:
                seen = m.simulation.arrays["surface"][:, k, 2]
                curves.append(
                    series(m, f"{m.label}, in the engine", m.simulation.t, 1e3 * seen, width=1.0, opacity=0.55)
                )
        half = payload.uncertain.ranges.get(Parameter(body.name, inner.quantity), 0.0)
        edge = min(inner.edge(inner.value - half), inner.edge(inner.value + half))
        charts.append(
            time_chart(
                f"{inner.chart[0]} {body.inside}",
                inner.chart[1],
                curves,
                f"Band: every {inner.quantity} and damping within their ranges; the line is the least edge of them.",
                "mm",
                zero=True,
                bands=bands,
                lines=[{"y": 1e3 * edge, "label": inner.chart[2]}] if np.isfinite(edge) else [],
            )
        )
    return charts


def run_charts(records: list[tuple[ReportedMotion, Record]]) -> list[Spec]:
    """What the physics engine or an arm says: tracking errors as in Fig. 8, slip, tip angle; of the tray alone when
    the object was not seen."""
    wanted = [
        ("e_p", "Position error of the object", "e_p", LENGTHS),
        ("e_o", "Orientation error of the object", "e_o", ANGLES),
        ("slip", "Slip on the tray", "displacement", LENGTHS),
        ("tip_angle", "Tip angle", "angle", (("°", 180 / np.pi),)),
    ]
    if not any("e_p" in record.arrays for _, record in records):
        wanted += [
            ("tray_e_p", "Position error of the tray", "e_p of the tray", LENGTHS),
            ("tray_e_o", "Orientation error of the tray", "e_o of the tray", ANGLES),
        ]
    charts = []
    for key, title, label, units in wanted:
        found = [(m, record.t, v) for m, record in records if (v := record_curve(record, key)) is not None]
        if not found:
            continue
        peak = max(float(np.nanmax(v)) for _, _, v in found)
        if key == "tip_angle" and peak < 1e-3:  # rad; less is the softness of the contact
            continue
        unit, factor = suited(peak, units)
        curves = [series(m, m.label, t, factor * v) for m, t, v in found]
        charts.append(time_chart(title, f"{label}, {unit}", curves, unit=unit, zero=True))
    return charts


def suited(peak: float, units: Units) -> tuple[str, float]:
    """The first of units, from coarse to fine, in which the peak is at least 0.1."""
    return next(((unit, factor) for unit, factor in units if factor * peak >= 0.1), units[-1])


def record_curve(record: Record | None, key: str) -> Array | None:
    """A quantity over time (T,) of a record, the largest over the objects; None when it has none."""
    if record is None or key not in record.arrays:
        return None
    values = record.arrays[key]
    return values if values.ndim == 1 else values.max(axis=1)
