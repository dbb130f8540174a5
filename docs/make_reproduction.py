"""Measures what of the paper reproduces, draws its figures, and writes both into docs/reproduction.md.

python docs/make_reproduction.py
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterable
from pathlib import Path

import blocks
import numpy as np
import paper_figures as figures
from paper_figures import paper_style, perturbed_rollouts

from salver.geometry import Array
from salver.models.uncertain.parameters import INERTIAL, inertial_vector, phi_of
from salver.planning.make import plan_baseline, plan_object
from salver.planning.object.cost import tray_loop
from salver.planning.plan import Plan
from salver.reports.run import read_run
from salver.sampling import draw
from salver.scenario import Scenario, load
from salver.simulation.closed_loop import rollout

PAGE = Path(__file__).parent / "reproduction.md"
IMAGES = Path(__file__).parent / "images"
PAPER = load("panda-cube")
WEIGHTINGS = ("paper", "pose", "scaled")
RUNS, SEED = 100, 0


def table(header: Iterable[str], rows: Iterable[Iterable[str]]) -> str:
    header = list(header)
    lines = [header, ["---"] * len(header), *(list(row) for row in rows)]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def heights(plan: Plan) -> tuple[float, float]:
    """How far the path goes above and below the straight line's height, mm."""
    z = 1e3 * (plan.evaluation.samples.p_SB[:, 2] - plan.scenario.motion.start.position[2])
    return float(z.max()), float(z.min())


def _shape(scenario: Scenario) -> list[str]:
    plan = plan_object(scenario)
    if not plan.status.ok:
        return ["infeasible", "", "", ""]
    above, below = heights(plan)
    ratio = plan.cost / plan_baseline(scenario).cost
    lowest = 1e3 * float((plan.cone_coefficients - plan.cone_radius).min())
    return [f"{ratio:.4f}", f"{above:+.0f}", f"{below:+.0f}", f"{lowest:.1f}"]


def norms() -> str:
    """Weighting by degree at the paper's duration."""
    rows = []
    for weighting in WEIGHTINGS:
        for degree in (7, 9, 12):
            scenario = PAPER.with_changes(objective__weighting=weighting, motion__degree=degree)
            rows.append([weighting, str(degree), *_shape(scenario)])
    return table(["norm", "degree", "cost / line's", "z above (mm)", "z below (mm)", "least Lambda in tube (mN)"], rows)


def durations() -> str:
    """The claim that the shape does not depend on the duration."""
    rows = []
    for weighting in WEIGHTINGS:
        for duration in (4.0, 2.5, 1.5, 1.2, 1.0, 0.9):
            scenario = PAPER.with_changes(objective__weighting=weighting, motion__duration=duration)
            rows.append([weighting, f"{duration:g}", *_shape(scenario)])
    return table(
        ["norm", "duration (s)", "cost / line's", "z above (mm)", "z below (mm)", "least Lambda in tube (mN)"], rows
    )


def least_perturbed(plan: Plan, share: float, inertia: bool) -> tuple[float, float]:
    """Least Lambda (mN) over RUNS nonlinear closed loops with mass (and inertia) off by up to a share; and when."""
    uncertainty = {"mass": f"{100 * share:g}%"} | ({"inertia": f"{100 * share:g}%"} if inertia else {})
    scenario = plan.scenario.with_changes(objects__0__uncertainty=uncertainty)

    carried, uncertain = scenario.payload.bodies, scenario.payload.uncertain
    values = np.tile(inertial_vector(carried[0].inertial), (RUNS, 1))
    drawn = draw(uncertain, RUNS, SEED, "corners", carried)
    for column, name in enumerate(uncertain.names):
        values[:, INERTIAL.index(name)] = drawn[:, column]
    run = rollout(
        plan.reference,
        carried[0].inertial,
        carried[0].contacts.grasp_map,
        tray_loop(scenario).gains,
        phi_of(values),
        plan.t,
    )
    lowest: Array = run.cone_coefficients.min(axis=(0, 2))
    return 1e3 * float(lowest.min()), float(plan.t[int(np.argmin(lowest))])


def perturbed() -> str:
    """Figs 5 and 6 in numbers: does the baseline go negative?"""
    rows = []
    for duration in (2.5, 1.5, 1.2, 1.0):
        for share, inertia in ((0.1, False), (0.1, True), (0.2, True)):
            scenario = PAPER.with_changes(motion__duration=duration)
            cells = []
            for plan in (plan_object(scenario), plan_baseline(scenario)):
                least, when = least_perturbed(plan, share, inertia)
                cells.append(f"{least:.1f} at {when:.2f} s")
            what = f"mass{' and inertia' if inertia else ''} ±{100 * share:.0f} %"
            rows.append([f"{duration:g}", what, *cells])
    return table(["duration (s)", "uncertain", "robust: least Lambda (mN)", "line: least Lambda (mN)"], rows)


def tubes() -> str:
    """Box against ellipsoid with four parameters: how many of the sampled runs leave them."""
    rows = []
    for name, uncertainty in (
        ("mass", {"mass": "10%"}),
        ("mass and inertia", {"mass": "10%", "inertia": "10%"}),
        ("mass, centre of mass", {"mass": "10%", "com": [0.002, 0.002, 0.002]}),
    ):
        for kind in ("box", "ellipsoid"):
            scenario = PAPER.with_changes(objects__0__uncertainty=uncertainty)
            own = scenario.with_changes(uncertainty__set=kind)
            plan = plan_baseline(own)
            with tempfile.TemporaryDirectory() as folder:
                # Samples always fill the box (8), whatever shape the tube assumes.
                boxed = plan_baseline(scenario)
                boxed.save(folder)
                made = perturbed_rollouts(read_run(folder), "plan", RUNS, SEED)
            excess = np.abs(made.cone_coefficients - plan.cone_coefficients) - plan.cone_radius
            left = int(np.sum(excess.max(axis=(1, 2)) > 1e-6))
            worst = 1e3 * float(excess.max())
            radius = 1e3 * float(plan.cone_radius.max())
            rows.append([name, kind, f"{radius:.1f}", f"{left} of {RUNS}", f"{max(worst, 0):.2f}"])
    return table(["uncertain", "tube of the", "widest radius (mN)", "runs that left it", "furthest out (mN)"], rows)


def summary() -> str:
    plan, line = plan_object(PAPER), plan_baseline(PAPER)
    rows = [
        ["solver time", "16.74 s", f"{1e3 * plan.solver['seconds']:.0f} ms (first solve of a process)"],
        ["duality gap", "not given", f"{plan.solver['relative_gap']:.1e}"],
        ["Lambda at rest (N)", "not given", f"{plan.cone_coefficients[0, 0]:.4f}, all sixteen"],
        ["least nominal Lambda, robust (mN)", "> 0", f"{1e3 * plan.cone_coefficients.min():.1f}"],
        ["least nominal Lambda, line (mN)", "> 0, above the robust one", f"{1e3 * line.cone_coefficients.min():.1f}"],
        [
            "length of the straight line (m)",
            "0.4 along y",
            f"{np.ptp(line.evaluation.samples.p_SB, axis=0)[1]:.3f} along y",
        ],
    ]
    return table(["quantity", "paper", "salver, default weighting"], rows)


def pictures() -> None:
    """Figs 3 to 6 for the paper's norm, the default one, and the default one at the duration where tubes bind."""
    cases = {
        "paper-norm": PAPER.with_changes(objective__weighting="paper"),
        "default": PAPER,
        "one-second": PAPER.with_changes(motion__duration=1.0),
    }
    for name, scenario in cases.items():
        with tempfile.TemporaryDirectory() as folder, paper_style():
            plan_object(scenario).save(folder)
            plan_baseline(scenario).save(folder, "baseline")
            run = read_run(folder)
            made = {"fig3": figures.trajectories(run.motions)}
            if name != "paper-norm":
                made["fig4"] = figures.coefficients(run.motions)
                for number, motion in zip((5, 6), run.motions, strict=True):
                    runs = perturbed_rollouts(run, motion.stem, RUNS, SEED)
                    made[f"fig{number}"] = figures.perturbed_figure(motion, runs)
            for figure, picture in made.items():
                (IMAGES / f"{name}-{figure}.png").write_bytes(figures.drawn(picture))


def main() -> None:
    for make in (summary, norms, durations, perturbed, tubes):
        blocks.replace(PAGE, make.__name__, make())
    pictures()


if __name__ == "__main__":
    main()
