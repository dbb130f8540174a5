"""Whatever is in the box: the worst case over all mass distributions inside a shape."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import linprog

import odd_loads
import salver as sv
from salver.contact_margins import margins
from salver.errors import ScenarioError
from salver.geometry import Array
from salver.models.contact.wrench_cone import cone_facets
from salver.models.contact_rows import contact_rows
from salver.models.interfaces import sure_contacts
from salver.models.physical import realisable
from salver.models.rigid_body import inertia_entries
from salver.models.uncertain import worst_contents
from salver.models.uncertain.contents import Hull, largest_mean, most_second_moments
from salver.models.uncertain.parameters import Parameter
from salver.models.uncertain.worst_case import Drift, WorstCase
from salver.sampling import METHODS, draw
from salver.scenario import Scenario, load
from salver.simulation.physics import simulate, simulate_tray
from salver.simulation.scene.loads import true_world

COM = (0.012, 0.009, 0.016)


def anything(made: Scenario, com: tuple[float, float, float] = COM) -> Scenario:
    """The same with contents that nobody knows."""
    changes: dict[str, object] = {}
    for k, item in enumerate(made.objects):
        known = item.uncertainty.model_dump(mode="json", exclude_none=True, exclude={"inertia"})
        changes[f"objects__{k}__uncertainty"] = known | {"com": list(com), "contents": "any"}
    return made.with_changes(**changes)


def densities(count: int, low: Array, high: Array, com: Array, rng: np.random.Generator) -> tuple[Array, Array]:
    """Points (count, 7, 3) in a box and their shares (count, 7) of a unit mass; |mean| <= com. Corners come often."""
    x = rng.uniform(low, high, (count, 6, 3))
    corner = rng.random(x.shape) < 0.6
    x = np.where(corner, np.where(rng.random(x.shape) < 0.5, low, high), x)
    share = rng.dirichlet(np.full(6, 0.4), count)
    mean = np.einsum("np,npi->ni", share, x)
    wanted = com * np.where(rng.random((count, 3)) < 0.5, rng.choice([-1.0, 1.0], (count, 3)), rng.uniform(-1, 1, 3))
    # One more point, beyond the wanted mean as seen from this one, brings the mean there.
    way = wanted - mean
    with np.errstate(divide="ignore", invalid="ignore"):
        room = np.where(way > 0, (high - wanted) / way, np.where(way < 0, (low - wanted) / way, np.inf)).min(axis=1)
    far = np.minimum(room, 1e6)[:, None] * rng.uniform(0.3, 1.0, (count, 1))
    last = 1.0 / (1.0 + far)
    points = np.concatenate([x, (wanted + far * way)[:, None]], axis=1)
    return points, np.concatenate([share * (1 - last), last], axis=1)


def inertial(points: Array, shares: Array, mass: Array) -> tuple[Array, Array]:
    """Centres of mass (n, 3), inertias (n, 6) about them, of point masses."""
    c = np.einsum("np,npi->ni", shares, points)
    away = points - c[:, None]
    second = np.einsum("np,npi,npj->nij", shares, away, away)
    return c, mass[:, None] * inertia_entries(np.trace(second, axis1=1, axis2=2)[:, None, None] * np.eye(3) - second)


def limits(made: Scenario, k: int = 0) -> tuple[Array, Array]:
    points = made.payload.bodies[k].points_B
    return points.min(axis=0), points.max(axis=0)


def test_never_optimistic_against_a_hundred_thousand_densities() -> None:
    """Of one box: the wrench is Newton's law summed over the point masses."""
    made = anything(odd_loads.scenario([{**odd_loads.LOWER, "name": "box"}])).with_changes(
        uncertainty=None, objects__0__uncertainty__position=None
    )
    rng = np.random.default_rng(0)
    w_E = odd_loads.felt(odd_loads.tray_motion(3, 3, 1.5))
    seen = odd_loads.true_body(made, made.payload.first, {})
    facets = odd_loads.TrueRows(made).facets[0]
    points, shares = densities(100_000, *limits(made), np.array(COM), rng)
    rows = contact_rows(made.payload)[0]
    bound = rows.worst(w_E)
    for k, w in enumerate(w_E):
        spin = w[[6, 7, 9, 7, 8, 10, 9, 10, 11]].reshape(3, 3)
        x, y, z = w[3:6]
        rate = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]]) + spin - np.trace(spin) * np.eye(3)
        force = seen.R_EB.T @ (w[:3] + rate @ seen.p_EB) + points @ (seen.R_EB.T @ rate @ seen.R_EB).T
        wrench = np.concatenate(
            [np.einsum("np,npi->ni", shares, force), np.einsum("np,npi->ni", shares, np.cross(points, force))], axis=1
        )
        value = (wrench @ facets.T / odd_loads.G).max(axis=1)
        assert value.max() <= bound[k].max() + 1e-9
        assert value.max() > bound[k].max() - 0.12  # random densities come near to it


def test_a_place_and_each_moment_of_what_is_inside_count_with_the_largest_that_both_can_be() -> None:
    """The wrench of a unit mass at x is a polynomial in x, of which a few places tell each term; E x_i x_j is bounded
    by (x - low)(high - x) >= 0 and by Cauchy and Schwarz. It counts from the nominal one on, of the least mass."""
    made = anything(odd_loads.scenario([{**odd_loads.LOWER, "name": "box"}])).with_changes(
        uncertainty={"tilt_deg": [1.0, 0.0]}, objects__0__uncertainty__position=[0.003, 0.0]
    )
    payload = made.payload
    (rows,), (network,), body = contact_rows(payload), payload.networks, payload.first
    facets = cone_facets(sure_contacts(network, payload.tray_half, payload.uncertain)[0]).rows

    def value(w: Array, x: Array, place: str, share: float) -> Array:
        seen = odd_loads.true_body(made, body, {place: share * {"position_x": 0.003, "tilt_x": np.deg2rad(1.0)}[place]})
        spin = w[[6, 7, 9, 7, 8, 10, 9, 10, 11]].reshape(3, 3)
        rate = np.cross(np.eye(3), w[3:6]) + spin - np.trace(spin) * np.eye(3)
        force = seen.R_EB.T @ (w[:3] + rate @ (seen.p_EB + seen.R_EB @ x))
        return np.concatenate([force, np.cross(x, force)]) @ facets.T / odd_loads.G

    low, high = limits(made)
    square = np.abs(low + high) * COM - low * high
    inertia = body.inertial.inertia_com
    nominal = (0.5 * np.trace(inertia) * np.eye(3) - inertia) / (0.85 * body.inertial.mass)
    for w in odd_loads.felt(odd_loads.tray_motion(3, 3, 1.5)):
        expected = np.zeros(len(facets))
        for place in ("position_x", "tilt_x"):

            def moved(x: Array, w: Array = w, place: str = place) -> Array:
                return 0.5 * (value(w, x, place, 1.0) - value(w, x, place, -1.0))

            second = {}
            for i, e in enumerate(np.eye(3)):
                expected += COM[i] * np.abs(0.5 * (moved(e) - moved(-e)))
                second[i, i] = 0.5 * (moved(e) + moved(-e)) - moved(0 * e)
            for i, j in [(0, 1), (0, 2), (1, 2)]:
                e = np.eye(3)[i] + np.eye(3)[j]
                second[i, j] = 0.5 * (moved(e) + moved(-e)) - moved(0 * e) - second[i, i] - second[j, j]
            for (i, j), each in second.items():
                expected += (np.sqrt(square[i] * square[j]) + abs(nominal[i, j])) * np.abs(each)
        assert expected.max() > 1e-4
        products = rows.remainder[-12:] @ w  # three with the place, nine with the tilt, after its square and theirs
        assert np.abs(products).sum(axis=0) == pytest.approx(np.tile(expected, 2), abs=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("load_of", [odd_loads.single, odd_loads.stack, odd_loads.pair])
@pytest.mark.parametrize("kind", ["box", "ellipsoid"])
def test_never_optimistic_with_places_tilt_and_stacks(load_of, kind: str) -> None:
    """Against Newton and Euler's laws for whole bodies in world axes."""
    made = anything(load_of("box"))
    if kind == "ellipsoid":
        made = made.with_changes(uncertainty__set="ellipsoid")
    w, rng = odd_loads.felt(odd_loads.tray_motion(5, 4)), np.random.default_rng(1)
    bound = np.max([rows.worst(w).max(axis=1) for rows in contact_rows(made.payload)], axis=0)
    true, uncertain = odd_loads.TrueRows(made), made.payload.uncertain
    others = [j for j, p in enumerate(uncertain.parameters) if p.kind in ("mass", "position", "tilt")]
    reached = np.full(len(w), -np.inf)
    for _ in range(50):
        s = rng.choice([-1.0, 1.0], len(others)) if kind == "box" else rng.normal(size=len(others))
        if kind == "ellipsoid":
            s /= np.linalg.norm(s)
        change = {uncertain.names[j]: float(s[i] * uncertain.half_range[j]) for i, j in enumerate(others)}
        for k, item in enumerate(made.objects):
            own = f"{item.name}." if len(made.objects) > 1 else ""
            mass = np.array([item.mass + change[f"{own}mass"]])
            c, about = inertial(*densities(1, *limits(made, k), np.array(COM), rng), mass)
            given = made.payload.bodies[k].inertial.inertia_com
            change |= {f"{own}com_{a}": float(x) for a, x in zip("xyz", c[0], strict=True)}
            names = ("xx", "xy", "yy", "xz", "yz", "zz")
            more = about[0] - inertia_entries(given)
            change |= {f"{own}inertia_{a}": float(x) for a, x in zip(names, more, strict=True)}
        reached = np.maximum(reached, true.worst(change, w))
    assert np.all(reached <= bound + 1e-5)  # tilt is cut off after its second order


@pytest.mark.parametrize("mean", [(0.02, 0.01, 0.05), (0.06, 0.06, 0.25), (0.0, 0.03, 0.0)])
def test_bound_of_a_box_is_that_of_a_linear_programme_over_a_grid(mean: tuple[float, float, float]) -> None:
    """Within 1 % of the row (a weight times a lever); the grid misses what lies between its points, so never below."""
    rng, half, beside = np.random.default_rng(2), np.array([0.075, 0.075, 0.28]), np.array([0.01, -0.02, 0.05])
    axes = [np.linspace(-h, h, 11) - o for h, o in zip(half, beside, strict=True)]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    hull = Hull.of(
        np.array(np.meshgrid(*([-h - o, h - o] for h, o in zip(half, beside, strict=True)))).reshape(3, -1).T
    )
    b, Q = np.empty((8, 3)), np.empty((8, 3, 3))
    for k in range(8):
        lever, alpha, omega = rng.normal(size=3), 8 * rng.normal(size=3), 2 * rng.normal(size=3)
        rate = np.cross(np.eye(3), -alpha) + np.outer(omega, omega) - omega @ omega * np.eye(3)
        cross = np.cross(np.eye(3), lever)
        b[k], Q[k] = cross @ (rng.normal(size=3) + np.array([0, 0, 9.81])), 0.5 * (cross @ rate + (cross @ rate).T)
    bound, moments = largest_mean(hull, np.array(mean), b, Q)
    for k in range(8):
        value = grid @ b[k] + np.einsum("gi,ij,gj->g", grid, Q[k], grid)
        sides = np.concatenate([mean, mean])
        best = -linprog(-value, np.vstack([grid.T, -grid.T]), sides, np.ones((1, len(grid))), [1.0]).fun
        scale = 9.81 * np.linalg.norm(half)
        assert best - 1e-9 <= bound[k] <= best + 0.01 * scale * 0.5
        second = np.array([Q[k][i, j] * (1 + (i != j)) for i, j in ((0, 0), (0, 1), (1, 1), (0, 2), (1, 2), (2, 2))])
        assert b[k] @ moments[k, :3] + second @ moments[k, 3:] == pytest.approx(bound[k], abs=2e-3 * np.abs(Q[k]).sum())
        assert np.all(np.abs(moments[k, :3]) <= np.array(mean) + 1e-6)


def test_without_turning_only_the_centre_of_mass_counts() -> None:
    made = load("any-box-56")
    known = made.with_changes(objects__0__uncertainty={"com": [0.06, 0.06, 0.28]})
    w = odd_loads.felt(odd_loads.tray_motion(20, 5, turning=0.0, push=0.3))
    assert contact_rows(made.payload)[0].worst(w) == pytest.approx(contact_rows(known.payload)[0].worst(w), abs=1e-9)


def test_the_most_second_moments_are_those_of_masses_at_two_ends() -> None:
    """Along an axis: at both ends, with the mean as far out as may be; across: Cauchy and Schwarz."""
    low, high, mean = np.array([-0.05, -0.1, -0.2]), np.array([0.1, 0.1, 0.3]), np.array([0.02, 0.0, 0.15])
    points = np.array([low, high])
    most = most_second_moments(points, mean)
    for i, k in enumerate((0, 2, 5)):
        share = np.linspace(0, 1, 100_001)  # at the upper end
        allowed = np.abs(share * high[i] + (1 - share) * low[i]) <= mean[i] + 1e-12
        assert most[k] == pytest.approx((share * high[i] ** 2 + (1 - share) * low[i] ** 2)[allowed].max(), rel=1e-4)
    assert most[[1, 3, 4]] == pytest.approx(np.sqrt(most[[0, 0, 2]] * most[[2, 5, 5]]))


def test_rows_that_are_only_bounded_have_the_sign_of_those_worked_out(monkeypatch: pytest.MonkeyPatch) -> None:
    """At motions about the edge, where several rows of an instant are near or beyond theirs."""
    rows, rng = contact_rows(load("any-box-56").payload)[0], np.random.default_rng(0)
    w = np.zeros((60, 12))
    w[:, 2] = odd_loads.G
    w[:, :2], w[:, 3:6] = 1.5 * rng.standard_normal((60, 2)), 2 * rng.standard_normal((60, 3))
    found = rows.worst(w)
    monkeypatch.setattr(worst_contents, "SURE", -np.inf)
    exact = rows.worst(w)
    assert ((exact > 0).sum(axis=1) > 1).mean() > 0.5
    assert np.array_equal(found > 0, exact > 0)
    assert np.all(found >= exact - 1e-9)


def test_what_is_attained_and_what_is_not_exceeded_lie_on_either_side_of_the_largest() -> None:
    rows, rng = contact_rows(load("any-box-56").payload)[0], np.random.default_rng(1)
    for filling in rows.fillings:
        of = rng.normal(size=(40, 9)) * filling.coefficients(odd_loads.felt(odd_loads.tray_motion(40, 2))).std(
            axis=(0, 1)
        )
        low, high = filling.limits(of)
        largest = filling.largest(of)[0]
        scale = np.abs(largest).max()
        assert np.all(low <= largest + 1e-3 * scale)
        assert np.all(largest <= high + 1e-9 * scale)
        assert np.mean(low > 0.1 * largest) > 0.3  # not nothing only


def test_a_drift_by_what_the_rows_do_not_know_adds_its_size(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(worst_contents, "SURE", -np.inf)
    rows, rng = contact_rows(load("any-box-56").payload)[0], np.random.default_rng(2)
    w, dw = odd_loads.felt(odd_loads.tray_motion(10, 3)), 0.1 * rng.normal(size=(10, 12, 1))
    strayed = rows.worst(w, Drift(((Parameter("another", "mass"),),), dw))
    assert strayed == pytest.approx(rows.worst(w) + np.abs(dw[..., 0] @ rows.nominal.T), abs=1e-9)


def test_slope_is_the_derivative_of_the_worst_case() -> None:
    rows = contact_rows(anything(odd_loads.single()).payload)[0]
    rng, w = np.random.default_rng(3), odd_loads.felt(odd_loads.tray_motion(30, 6))
    worst = WorstCase.of(rows, w)
    node, row = np.arange(30), worst.values.argmax(axis=1)
    step, way = 1e-5, rng.normal(size=w.shape)
    ahead, behind = rows.worst(w + step * way), rows.worst(w - step * way)
    slope = np.einsum("rk,rk->r", worst.attained(node, row), way)
    error = np.abs((ahead - behind)[node, row] / (2 * step) - slope)
    assert np.median(error) < 1e-3 * np.abs(slope).max()  # kinks have no derivative, and the search ends a little early


def test_drift_of_the_contents_is_that_of_their_moments() -> None:
    """To first order in the drift, of which the bound is the largest value over all densities."""
    made = anything(odd_loads.single()).with_changes(uncertainty=None, objects__0__uncertainty__position=None)
    uncertain, rng = made.payload.uncertain, np.random.default_rng(4)
    acting = [p for p in uncertain.parameters if p.kind != "friction"]
    w = odd_loads.felt(odd_loads.tray_motion(6, 7))
    drift = Drift(tuple((p,) for p in acting), 0.05 * rng.normal(size=(6, 12, len(acting))))
    rows = contact_rows(made.payload)[0]
    bound = rows.worst(w, drift).max(axis=1)
    points, shares = densities(150, *limits(made), np.array(COM), rng)
    item, body = made.objects[0], made.payload.first
    true, reached = odd_loads.TrueRows(made), np.full(6, -np.inf)
    for k in range(150):
        sign = rng.choice([-1.0, 1.0])
        mass = item.mass + sign * uncertain.half_range[0]
        # About B's origin, as the drift of a load is to first order.
        second = np.einsum("p,pi,pj->ij", shares[k], points[k], points[k])
        about_B = mass * inertia_entries(np.trace(second) * np.eye(3) - second)
        c, about = inertial(points[k : k + 1], shares[k : k + 1], np.array([mass]))
        given = inertia_entries(body.inertial.inertia_com)
        names = ("xx", "xy", "yy", "xz", "yz", "zz")
        change = {"mass": mass - item.mass, **{f"com_{a}": float(x) for a, x in zip("xyz", c[0], strict=True)}}
        change |= {f"inertia_{a}": float(x) for a, x in zip(names, about[0] - given, strict=True)}
        s = [sign, *(c[0] / uncertain.half_range[1:4]), *((about_B - given) / uncertain.half_range[4:10])]
        # The rows' own part at these contents, and the drift seen by the nominal ones at this mass.
        moved = np.einsum("tkp,p->tk", drift.dw, np.array(s))
        value = true.at(change, w)[0] + true.at({"mass": change["mass"]}, moved)[0]
        reached = np.maximum(reached, value.max(axis=1))
    assert np.all(reached <= bound + 1e-9)
    assert np.all(bound > rows.worst(w).max(axis=1))


@pytest.mark.slow
def test_plan_for_a_box_of_any_contents_holds_for_random_ones_in_the_engine() -> None:
    made = load("any-box-56").with_changes(motion__duration=7.7)
    found = sv.plan(made)
    assert found.status.ok
    assert margins(found.scenario, found.reference.sample(found.t)).verdict(worst=True).ok
    rng = np.random.default_rng(5)
    points, shares = densities(2, *limits(made), np.array([0.06, 0.06, 0.28]), rng)
    c, about = inertial(points, shares, np.ones(2))
    for k in range(2):
        values = dict(zip(("com_x", "com_y", "com_z"), c[k], strict=True))
        names = ("xx", "xy", "yy", "xz", "yz", "zz")
        values |= dict(
            zip((f"inertia_{a}" for a in names), about[k] + 1e-5 * np.array([1, 0, 1, 0, 0, 1]), strict=True)
        )
        assert simulate(found, parameters=values).summary["outcome"] == "holds"


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"objects__0__uncertainty": {"contents": "any", "inertia": "10%"}}, "leave inertia out"),
        ({"objects__0__uncertainty": {"contents": "full"}}, "contents"),
    ],
)
def test_what_cannot_be_is_refused(change: dict, said: str) -> None:
    with pytest.raises(ScenarioError, match=said):
        load("panda-cube").with_changes(**change)


@pytest.mark.slow
@pytest.mark.parametrize("method", METHODS)
def test_samples_of_any_contents_are_contents_that_can_be(method: str) -> None:
    payload = load("any-box-56").payload
    values = draw(payload.uncertain, 12, 6, method, payload.bodies)
    assert np.all(np.abs(values - payload.uncertain.nominal) <= payload.uncertain.half_range + 1e-12)
    inertial_values = np.column_stack([np.ones(12), values])
    assert realisable(payload.first, inertial_values).all()
    assert np.all(np.ptp(values[:, 3:6:2], axis=0) > 0.005)  # kg m^2: they are filled in different ways
    assert values[:, [3, 5, 8]].min() > 0


@pytest.mark.slow
def test_the_largest_row_of_an_instant_is_that_of_a_search_of_all_rows(monkeypatch: pytest.MonkeyPatch) -> None:
    """Most rows get a bound only; a search ends within 1e-3 of a row's curvature, here 1e-5 of the weight."""
    rng = np.random.default_rng(4)
    w = rng.normal(size=(2, 12)) * [2, 2, 1, *[10] * 3, *[6] * 6] + 9.81 * np.eye(12)[2]
    for made in (
        anything(load("panda-tall-bottle"), (0.01, 0.01, 0.03)),
        anything(odd_loads.small(odd_loads.stack(), 0.3)),
    ):
        (rows,) = margins(made, odd_loads.tray_motion(2)).model.robust
        found = rows.worst(w)
        alone = np.array([rows.worst(one[None])[0].max() for one in w])
        with monkeypatch.context() as all_of_them:
            all_of_them.setattr(worst_contents, "SURE", -np.inf)
            sought = rows.worst(w)
        assert (sought.max(axis=1) > 0).any()
        np.testing.assert_allclose(found.max(axis=1), sought.max(axis=1), rtol=0, atol=1e-5)
        np.testing.assert_allclose(alone, sought.max(axis=1), rtol=0, atol=1e-5)
        assert np.array_equal(found > 0, sought > 0)
        assert (found >= sought - 1e-5).all()


def test_a_shape_of_very_many_corners_counts_as_its_bounding_box() -> None:
    way = np.random.default_rng(2).normal(size=(400, 3))
    hull = Hull.of(np.array([0.1, 0.2, 0.3]) + way / np.linalg.norm(way, axis=1)[:, None] * [0.03, 0.04, 0.05])
    assert hull.corners == 8
    assert sorted(map(tuple, hull.foot[:8])) == sorted((x, y, z) for x in (-1, 1) for y in (-1, 1) for z in (-1, 1))
    assert [len(basis) for basis in hull.basis] == [12, 6, 1]
    np.testing.assert_allclose(hull.half, [0.03, 0.04, 0.05], rtol=0.02)  # 400 points nearly reach the ends


def test_all_mass_on_a_line_stands_in_the_engine():
    """The worst of any contents of the tall box is a half of its mass at either end of a line: without a moment about
    it, of which the engine must make a little, and not so little that contacts shake it off."""
    case = load("any-box-56")
    plan = sv.plan(case)
    worst = plan.margins.worst_parameters()
    moments = np.linalg.eigvalsh(true_world(case, worst).loads[0].inertial.inertia_com)
    assert moments[0] == pytest.approx(1e-3 * moments[2], rel=2e-3)
    assert moments[2] < moments[0] + moments[1] + 1e-12
    assert simulate_tray(plan.reference, case, worst).outcome == "holds"
    with pytest.raises(ScenarioError, match="principal moments"):
        true_world(case, {**worst, "inertia_zz": 0.5 * worst["inertia_zz"]})
