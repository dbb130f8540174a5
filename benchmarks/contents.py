"""Whatever is in the box, counted: against random densities, against a linear programme, in the physics engine.

python benchmarks/contents.py [--densities 100000] [--programmes 30] [--fillings 200] [--docs]

Densities: so many random sets of point masses for each of 24 things that a tray feels, for three shapes; the wrench is
Newton's law summed over the points. Programme: the largest mean over all densities on a grid of 31^3 points of a box.
Fillings: the 56 cm box of Heins and Schoellig (2025), planned for any contents to each of their three goals, as
any-box-56 has it, filled with points, and in the shortest time with a margin of 1 % of the weight, filled with lead;
their grid (15 centres of mass x 3 scales of the uniform inertia, as far as there are such boxes) and random fillings,
on a tray that moves as planned.
"""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path

import numpy as np

from salver.contact_margins import margins
from salver.geometry import Array
from salver.models.contact.contact import support_contacts
from salver.models.contact.wrench_cone import cone_facets
from salver.models.contact_rows import contact_rows
from salver.models.physical import realisable
from salver.models.rigid_body import inertia_entries
from salver.models.tray_motion import frame_map
from salver.models.uncertain.contents import Hull, largest_mean
from salver.planning.make import plan_object
from salver.planning.plan import Plan
from salver.scenario import Scenario, load
from salver.simulation.physics import simulate_tray
from tall_boxes import GOALS, INERTIA_SCALES, centres

PAGE = Path(__file__).parents[1] / "docs" / "howto" / "contents.md"
GRAVITY = 9.81
POINTS = 1e-5  # kg m^2 that the engine needs of a box all of whose mass is in a point
LEAD = 3e-4  # kg m^2 of a ball of lead of 1 kg; with less than 1e-4 the engine's contacts shake a box off its edge
NAMES = ("com_x", "com_y", "com_z", *(f"inertia_{k}" for k in ("xx", "xy", "yy", "xz", "yz", "zz")))


def fillings(hull: Hull, com: Array, count: int, rng: np.random.Generator) -> tuple[Array, Array]:
    """Points (count, 7, 3) within a hull and their shares (count, 7) of the mass; centre of mass within com (3,)."""
    corners = hull.centre + hull.half * hull.foot[: hull.corners]
    mixed = rng.dirichlet(np.full(len(corners), 0.3), (count, 6)) @ corners
    at_corner = corners[rng.integers(len(corners), size=(count, 6))]
    x = np.where(rng.random((count, 6, 1)) < 0.6, at_corner, mixed)
    share = rng.dirichlet(np.full(6, 0.4), count)
    mean = np.einsum("np,npi->ni", share, x)
    wanted = com * np.where(rng.random((count, 3)) < 0.5, rng.choice([-1.0, 1.0], (count, 3)), rng.uniform(-1, 1, 3))
    inside = np.all(((wanted - hull.centre) / hull.half) @ hull.normal.T <= hull.offset, axis=1)
    wanted = np.where(inside[:, None], wanted, 0.5 * com * rng.uniform(-1, 1, (count, 3)))
    # One more point, beyond the wanted mean as seen from this one, brings the mean there.
    way, slack = wanted - mean, hull.offset - ((wanted - hull.centre) / hull.half) @ hull.normal.T
    with np.errstate(divide="ignore", invalid="ignore"):
        speed = (way / hull.half) @ hull.normal.T
        room = np.where(speed > 1e-12, np.maximum(slack, 0.0) / speed, np.inf).min(axis=1)
    far = np.clip(room, 0.0, 1e6)[:, None] * rng.uniform(0.3, 1.0, (count, 1))
    last = 1.0 / (1.0 + far)
    points = np.concatenate([x, (wanted + far * way)[:, None]], axis=1)
    return points, np.concatenate([share * (1 - last), last], axis=1)


def densities(count: int) -> list[str]:
    """For each shape: how many random densities exceed the bound, and how near they come to it."""
    known = {"com": [0.012, 0.009, 0.016], "contents": "any"}
    shapes = {
        "box 15 x 15 x 56 cm": load("any-box-56"),
        "cube of 12 cm": load("panda-cube").with_changes(objects__0__uncertainty=known),
        "tall bottle": load("panda-tall-bottle").with_changes(objects__0__uncertainty=known),
    }
    rows = ["| shape | densities | beyond the bound | nearest to it, of the weight |", "|---" * 4 + "|"]
    for name, scenario in shapes.items():
        body, rng = scenario.payload.first, np.random.default_rng(0)
        com = np.array(scenario.objects[0].uncertainty.com)
        hull, bound_of = Hull.of(body.points_B), contact_rows(scenario.payload)[0]
        contacts = support_contacts(body.base_polygon_B, body.friction, scenario.contact.edges)
        facets, place = cone_facets(contacts).rows, frame_map(body.p_EB, body.R_EB)
        w = np.zeros((24, 12))
        w[:, :3] = [0, 0, GRAVITY] + rng.normal(size=(24, 3)) * [1, 1, 0.5]
        w[:, 3:6] = 2 * rng.normal(size=(24, 3))
        omega = rng.normal(size=(24, 3))
        w[:, 6:] = omega[:, [0, 0, 1, 0, 1, 2]] * omega[:, [0, 1, 1, 2, 2, 2]]
        bound, above, near = bound_of.worst(w).max(axis=1), 0, np.inf
        for k, felt in enumerate(w @ place.T):  # in B
            spin = felt[[6, 7, 9, 7, 8, 10, 9, 10, 11]].reshape(3, 3)
            x, y, z = felt[3:6]
            rate = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]]) + spin - np.trace(spin) * np.eye(3)
            points, shares = fillings(hull, com, count, rng)
            force = felt[:3] + points @ rate.T
            parts = [np.einsum("np,npi->ni", shares, v) for v in (force, np.cross(points, force))]
            value = (np.hstack(parts) @ facets.T / GRAVITY).max(axis=1)
            above, near = above + int((value > bound[k] + 1e-9).sum()), min(near, float(bound[k] - value.max()))
        rows.append(f"| {name} | {len(w)} x {count} | {above} | {100 * near:.2g} % |")
        print(rows[-1], file=sys.stderr, flush=True)
    return rows


def programmes(count: int) -> list[str]:
    """How far the bound lies above the best density on a grid."""
    from scipy.optimize import linprog

    rng, off = np.random.default_rng(2), []
    for _ in range(count):
        half = rng.uniform(0.03, 0.3, 3)
        beside, mean = 0.3 * half * rng.uniform(-1, 1, 3), half * rng.uniform(0, 0.6, 3)
        axes = [np.linspace(-h - o, h - o, 31) for h, o in zip(half, beside, strict=True)]
        grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
        hull = Hull.of(np.stack(np.meshgrid(*(a[[0, -1]] for a in axes)), axis=-1).reshape(-1, 3))
        lever, alpha, omega = rng.normal(size=3), 8 * rng.normal(size=3), 2 * rng.normal(size=3)
        rate = np.cross(np.eye(3), -alpha) + np.outer(omega, omega) - omega @ omega * np.eye(3)
        cross = np.cross(np.eye(3), lever)
        b, Q = cross @ (rng.normal(size=3) + np.array([0, 0, GRAVITY])), 0.5 * (cross @ rate + (cross @ rate).T)
        bound = largest_mean(hull, mean, b[None], Q[None])[0][0]
        value = grid @ b + np.einsum("gi,ij,gj->g", grid, Q, grid)
        best = -linprog(-value, np.vstack([grid.T, -grid.T]), np.r_[mean, mean], np.ones((1, len(grid))), [1.0]).fun
        off.append((bound - best) / abs(best))
    return [
        "| boxes | bound over the best on the grid: least | median | most |",
        "|---" * 4 + "|",
        f"| {count} | {100 * min(off):+.3f} % | {100 * np.median(off):+.3f} % | {100 * max(off):+.3f} % |",
    ]


def shortest(scenario: Scenario) -> Plan:
    """Planned for the shortest duration to 2 % for which it is safe."""

    def made(duration: float) -> Plan | None:
        plan = plan_object(scenario.with_changes(motion__duration=duration))
        sure = plan.ok and margins(plan.scenario, plan.reference.sample(plan.t)).verdict(worst=True).ok
        return plan if sure else None

    low, high = 2.0, 16.0
    best = made(high)
    assert best is not None
    while high > 1.02 * low:
        middle = (low * high) ** 0.5
        found = made(middle)
        low, high, best = (low, middle, found) if found is not None else (middle, high, best)
    return best


def engine(count: int) -> list[str]:
    """How often the 56 cm box stays, of their grid and of random fillings."""
    rows = ["| planned | goals | duration | least margin | their grid | random fillings |", "|---" * 6 + "|"]
    planned = (("as any-box-56 has it", None, POINTS), ("shortest, margin 1 %, lead", 0.01, LEAD))
    for name, margin, least_inertia in planned:
        plans, kept, runs = list[Plan](), [0, 0], [0, 0]
        for k, goal in enumerate(GOALS):
            scenario = load("any-box-56")
            goal_at = np.add(scenario.motion.start.position, goal).tolist()
            scenario = scenario.with_changes(motion__goal__position=goal_at)
            if margin is None:
                plans.append(plan_object(scenario))
            else:
                plans.append(shortest(scenario.with_changes(contact__margin=margin)))
            for i, values in enumerate(
                cases(plans[-1].scenario, -(-count // len(GOALS)), least_inertia, np.random.default_rng(k))
            ):
                for value in values:
                    given = dict(zip(NAMES, map(float, value[1:]), strict=True))
                    outcome = simulate_tray(plans[-1].reference, plans[-1].scenario, given).outcome
                    kept[i], runs[i] = kept[i] + (outcome == "holds"), runs[i] + 1
                    if outcome != "holds":
                        print(f"  {name}, goal {goal}: {outcome}, {given}", file=sys.stderr, flush=True)
        least = min(float(plan.margins.exact_worst.min()) for plan in plans)
        found = sorted(f"{plan.duration:.2f}" for plan in plans)
        times = " to ".join(dict.fromkeys([found[0], found[-1]]))
        counts = " | ".join(f"{a} of {b}" for a, b in zip(kept, runs, strict=True))
        rows.append(f"| {name} | {len(GOALS)} | {times} s | {100 * least:.1f} % | {counts} |")
        print(rows[-1], file=sys.stderr, flush=True)
    return rows


def cases(scenario: Scenario, count: int, least: float, rng: np.random.Generator) -> tuple[list[Array], list[Array]]:
    """Values (10,) of mass, centre of mass and inertia: the grid of Heins and Schoellig, and random fillings, to whose
    inertia so much is added."""
    body, half = scenario.payload.first, np.array(scenario.objects[0].uncertainty.com)
    x, y, z = scenario.objects[0].shape.size  # type: ignore[union-attr]
    uniform = np.array([y * y + z * z, 0, x * x + z * z, 0, 0, x * x + y * y]) / 12
    grid = [np.concatenate([[1.0], com, scale * uniform]) for com in centres(half) for scale in INERTIA_SCALES]
    points, shares = fillings(Hull.of(body.points_B), half, count, rng)
    c = np.einsum("np,npi->ni", shares, points)
    away = points - c[:, None]
    second = np.einsum("np,npi,npj->nij", shares, away, away)
    about = inertia_entries(np.trace(second, axis1=1, axis2=2)[:, None, None] * np.eye(3) - second)
    about += least * np.array([1, 0, 1, 0, 0, 1])
    drawn = [np.concatenate([[1.0], *both]) for both in zip(c, about, strict=True)]
    return [v for v in grid if realisable(body, v[None])[0]], drawn


def main() -> None:
    asked = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    asked.add_argument("--densities", type=int, default=100_000)
    asked.add_argument("--programmes", type=int, default=30)
    asked.add_argument("--fillings", type=int, default=200)
    asked.add_argument("--docs", action="store_true", help="write the tables into docs/howto/contents.md")
    given = asked.parse_args()
    made = {"densities": densities, "programmes": programmes, "fillings": engine}
    for name, count_of in made.items():
        count, begun = getattr(given, name), time.process_time()
        if not count:
            continue
        table = "\n".join(count_of(count))
        print(table, f"({time.process_time() - begun:.0f} s of CPU time)", sep="\n", end="\n\n", flush=True)
        if given.docs:
            sys.path.insert(0, str(PAGE.parent))
            import blocks

            blocks.replace(PAGE, f"contents-{name}", table)


if __name__ == "__main__":
    main()
