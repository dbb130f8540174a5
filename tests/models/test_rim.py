"""Objects against the rim of a tray: what holds them, by hand; what is refused; and what stays as it is without."""

from itertools import product

import numpy as np
import pytest
from numpy.testing import assert_allclose

from armless_scenarios import scenario
from salver.contact_margins import Margins, margin_model
from salver.errors import ScenarioError
from salver.geometry import exp
from salver.models.bodies import Body
from salver.models.contact.wrench_cone import cone_facets, friction_needed, margin, tip_over_margin
from salver.models.contact_rows import contact_rows
from salver.models.interfaces import sure_contacts
from salver.models.payload import Payload
from salver.scenario import Scenario

G = 9.81
X, Y = np.eye(3)[:2]
MU = 0.3
SIZE = (0.06, 0.10, 0.15)  # m, of the box: b = 30 mm along x, c = 75 mm


def box(**more: object) -> dict:
    return {"name": "box", "shape": {"type": "box", "size": list(SIZE)}, "mass": 0.4, "friction": MU, **more}


def bottle(**more: object) -> dict:
    shape = {"type": "cylinder", "radius": 0.03, "height": 0.2, "support_points": 16}
    return {"name": "bottle", "shape": shape, "mass": 0.5, "friction": MU, **more}


def beside(*items: dict, height: float = 0.03, **more: object) -> Scenario:
    """On a tray of 20 x 24 cm with a rim."""
    return scenario(list(items), tray={"size": [0.2, 0.24], "rim": {"height": height}}, **more)


def most(payload: Payload, along: np.ndarray, up: float = 0.0, network: int = 0) -> float:
    """Largest acceleration, m/s^2, of the level tray along a direction (3,) of E; up: m/s^2, beside it."""
    rows, w = contact_rows(payload)[network], np.zeros((1, 12))
    low, high = 0.0, 1e4
    while high - low > 1e-9 * high:
        middle = 0.5 * (low + high)
        w[0, :3] = middle * along + [0.0, 0.0, G + up]
        low, high = (middle, high) if rows.worst(w).max() <= 1e-12 else (low, middle)
    return low


@pytest.mark.parametrize("height", [0.01, 0.03, 0.06])
@pytest.mark.parametrize("up", [0.0, 4.0])
def test_box_tips_over_the_rim_about_its_top_edge(height: float, up: float) -> None:
    """Moments about the rim's top edge: m a (c - h) = m g b; no friction of the foot is counted on."""
    payload = beside(box(against="-x"), height=height).payload
    assert_allclose(payload.first.p_EB, [-0.1 + 0.03, 0, 0.075], atol=1e-15)
    assert_allclose(most(payload, X, up), (G + up) * 0.03 / (0.075 - height), rtol=1e-6)
    # Away from the wall, and along it, as without: it slides.
    assert_allclose([most(payload, way, up) for way in (-X, Y, -Y)], MU * (G + up), rtol=1e-6)


def test_box_lower_than_twice_the_rim_never_tips_over_it_nor_slides() -> None:
    payload = beside(box(against="-x"), height=0.08).payload
    assert most(payload, X) > 1e3
    assert_allclose(most(payload, -X), MU * G, rtol=1e-6)


@pytest.mark.parametrize(("against", "yaw", "pressed"), [("+y", 90.0, -Y), ("-y", 180.0, Y), ("+x", -180.0, -X)])
def test_other_sides_and_turned_boxes(against: str, yaw: float, pressed: np.ndarray) -> None:
    payload = beside(box(against=against, yaw_deg=yaw)).payload
    b = 0.05 if against == "-y" else 0.03
    assert_allclose(most(payload, pressed), G * b / (0.075 - 0.03), rtol=1e-6)
    assert_allclose(most(payload, -pressed), MU * G, rtol=1e-6)


def test_corner_holds_to_both_sides() -> None:
    payload = beside(box(against=["-x", "+y"])).payload
    assert_allclose(payload.first.p_EB[:2], [-0.07, 0.07], atol=1e-15)
    assert_allclose(most(payload, X), G * 0.03 / 0.045, rtol=1e-6)
    assert_allclose(most(payload, -Y), G * 0.05 / 0.045, rtol=1e-6)
    assert_allclose([most(payload, -X), most(payload, Y)], MU * G, rtol=1e-6)


@pytest.mark.parametrize("item", [bottle(against="-x"), box(against="-x", yaw_deg=30.0)], ids=["cylinder", "edge"])
def test_what_touches_along_one_line_is_kept_from_sliding_and_not_from_tipping(item: dict) -> None:
    slippery = item | {"friction": 0.05}
    payload = beside(slippery, height=0.05).payload
    touch = payload.first.p_EB + payload.first.walls.p_BC @ payload.first.R_EB.T
    assert_allclose(touch[:, [0, 2]], [[-0.1, 0.0]], atol=1e-12)
    reach = payload.first.p_EB[0] + 0.1
    assert most(payload, X) > 0.9 * G * 0.05  # it slides from here on without the rim
    assert_allclose(most(payload, X, -0.5 * G), 0.5 * most(payload, X), rtol=1e-6)
    assert most(payload, X) <= G * reach / payload.first.p_EB[2] + 1e-9


def test_bottle_against_the_rim_may_be_pushed_until_it_tips_over_its_foot() -> None:
    payload = beside(bottle(against="-x", friction=0.05), height=0.05).payload
    assert_allclose(payload.first.p_EB[0], -0.1 + 0.03)
    assert_allclose(most(payload, X), G * 0.03 / 0.1, rtol=1e-6)


def test_object_away_from_the_rim_is_as_without() -> None:
    """Also beside one that leans, with everything uncertain."""
    ranges = {"mass": "10%", "friction": "20%", "com": [0.003, 0.002, 0.01], "position": [0.002, 0.001]}
    own = box(name="free", at=[0.05, 0.02], yaw_deg=20.0, uncertainty=ranges)
    both = beside(box(against="-x", at=[0.0, -0.06], uncertainty=ranges), own)
    alone = scenario([own], tray={"size": [0.2, 0.24]})
    leaning, free = contact_rows(both.payload)
    (known,) = contact_rows(alone.payload)
    assert_allclose(free.nominal, known.nominal, atol=1e-14)
    assert_allclose(free.remainder, known.remainder, atol=1e-14)
    assert leaning.network.bodies[0].name == "box"


def test_place_is_exact_across_the_wall_and_only_there() -> None:
    ranges = {"friction": 0.05, "position": [0.002, 0.003]}
    assert beside(box(against="-x", uncertainty=ranges)).uncertain.names == ("friction", "position_y")
    assert beside(box(against="+y", uncertainty=ranges)).uncertain.names == ("friction", "position_x")
    assert beside(box(against=["+x", "-y"], uncertainty=ranges)).uncertain.names == ("friction",)


def corner_wrench(body: Body, f_E: np.ndarray, s: np.ndarray, half: np.ndarray) -> np.ndarray:
    """Wrench (6,) at B of a body with mass and centre of mass off by s * half (4,), on a tray that does not turn."""
    change = s * half
    force = (body.inertial.mass + change[0]) * (body.R_EB.T @ f_E)
    return np.concatenate([force, np.cross(change[1:], force)])


def test_worst_case_is_attained_at_corners_of_the_ranges() -> None:
    ranges = {"mass": 0.04, "com": [0.003, 0.002, 0.01], "friction": 0.06, "position": [0.001, 0.004]}
    made = beside(box(against=["-x"], at=[0.0, 0.03], yaw_deg=90.0, uncertainty=ranges))
    body, (rows,) = made.payload.first, contact_rows(made.payload)
    (sure,) = sure_contacts(made.payload.networks[0], made.payload.tray_half, made.payload.uncertain)
    assert_allclose(sure.base.friction, MU - 0.06)
    cone, rng = cone_facets(sure).rows, np.random.default_rng(3)
    w = np.zeros((40, 12))
    w[:, :3] = rng.normal(size=(40, 3)) * [3, 3, 2] + [0, 0, G]
    bound = rows.worst(w).reshape(40, -1, len(cone)).max(axis=1)
    half = np.array([0.04, 0.003, 0.002, 0.01])
    largest = np.full_like(bound, -np.inf)
    for s in product((-1, 1), repeat=4):
        weight = (0.4 + s[0] * 0.04) * G
        each = np.array([corner_wrench(body, f, np.array(s), half) for f in w[:, :3]])
        largest = np.maximum(largest, each @ cone.T / weight)
    assert_allclose(bound, largest, atol=1e-12)


@pytest.mark.parametrize("edges", [4, 8])
@pytest.mark.parametrize("against", [["-x"], ["-x", "+y"]])
def test_cone_grows_with_friction_and_stays_within_what_base_and_walls_can_do(edges: int, against: list[str]) -> None:
    body = beside(box(against=against, yaw_deg=90.0), contact={"edges": edges, "edge_phase_deg": 10.0}).payload
    (contacts,) = (face.contacts for face in body.networks[0].interfaces)
    rng, before = np.random.default_rng(1), None
    anything = cone_facets(contacts.base).rows, contacts.walls.grasp_map
    for friction in (0.05, 0.3, 1.0, 4.0):
        cone = cone_facets(contacts.of_friction(friction)).rows
        if before is not None:
            inside = inside_of(before, rng)
            assert margin(cone, inside).min() > -1e-9
        before = cone
    # The base without the friction that presses it into a wall, and the walls' push, are in it.
    upright = contacts.base.grasp_matrix[:, 2::3].T
    assert margin(cone_facets(contacts).rows, upright + 3.0 * anything[1].sum(axis=1)).min() > -1e-9


def inside_of(cone: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Wrenches (n, 6) in a cone, near its boundary: from one inside along random directions."""
    centre = np.array([0.0, 0.0, 1.0, 0.0, 0.0, 0.0])
    found = []
    for _ in range(200):
        d = rng.normal(size=6) * [1, 1, 1, 0.05, 0.05, 0.05]
        rate = cone @ d
        found.append(centre + d * 0.999 * np.min(-(cone @ centre)[rate > 0] / rate[rate > 0], initial=50.0))
    return np.array(found)


def test_friction_needed_and_distance_to_tipping_beside_a_wall() -> None:
    payload = beside(box(against="-x")).payload
    (contacts,) = (face.contacts for face in payload.networks[0].interfaces)
    a = np.array([1.0, 3.0, 5.0, -1.0, -2.9])
    force = 0.4 * np.column_stack([a, np.full(5, 0.7), np.full(5, G)])
    wrench = np.hstack([force, np.zeros((5, 3))])
    needed = friction_needed(contacts, wrench)
    # Pressed: the wall takes a, and friction the rest; away from it, friction takes the pyramid's sum of both.
    assert_allclose(needed, np.array([0.7, 0.7, 0.7, 1.7, 3.6]) / G, rtol=0.01)
    distance = tip_over_margin(contacts, wrench)
    assert_allclose(distance[2], 0.03 - 5.0 * 0.045 / G, rtol=1e-6)
    assert_allclose(distance[3:], 0.03 - np.array([1.0, 2.9]) * 0.075 / G, rtol=1e-6)
    assert tip_over_margin(contacts, np.array([0.4 * 7.0, 0, 0.4 * G, 0, 0, 0]))[0] < 0


def test_verdict_beside_a_wall_is_that_of_its_own_friction_not_of_the_interpolated_need() -> None:
    """Nearly tipping over the rim, the interpolated need is 5 % above the friction with which the box just holds."""
    model = margin_model(beside(box(against="-x")))
    for along, code in ((2.9, None), (2.96, "slides")):
        w = np.zeros((1, 12))
        w[0, :3] = [6.4, along, G]
        (contact,) = Margins(model, np.zeros(1), w).interfaces
        failure = contact.failure(worst=False)
        assert (failure and failure[2]) == code


def test_no_friction_suffices_where_the_worst_case_tips_over_the_rim() -> None:
    """Beside a wall tipping depends on friction too; here it does not slide with next to none."""
    item, w = box(against="-x", uncertainty={"com": [0.002, 0.002, 0.005]}), np.zeros((1, 12))
    w[0, :3] = [6.04, 0.01, G]
    (contact,) = Margins(margin_model(beside(item)), np.zeros(1), w).interfaces
    assert contact.friction_needed.max() < 0.01
    assert contact.friction_needed_worst == np.inf


def test_no_turning_beside_the_wall_relies_on_a_preload() -> None:
    """Leaning on the rim beyond its foot, held only by a couple of wall and friction: not counted on."""
    payload = beside(box(against="-x")).payload
    (contacts,) = (face.contacts for face in payload.networks[0].interfaces)
    overhang = np.array([[0.0, 0.0, 1.0, 0.0, 0.031, 0.0]])  # the centre of pressure is 1 mm beyond the base's edge
    assert margin(cone_facets(contacts).rows, overhang)[0] < 0
    assert margin(cone_facets(contacts).rows, overhang * [1, 1, 1, 1, -1, 1])[0] < 0


MISTAKES = [
    (
        beside,
        [box(at=[0.069, 0.0], uncertainty={"position": [0.002, 0.0]})],
        r"box may stand 1.0 mm inside the rim at \+x",
    ),
    (
        beside,
        [box(at=[0.0, -0.069], uncertainty={"position": [0.0, 0.002]})],
        r"box may stand 1.0 mm inside the rim at -y",
    ),
    (
        beside,
        [box(against="-x", at=[0.0, 0.069], uncertainty={"position": [0.002, 0.002]})],
        r"1.0 mm inside the rim at \+y",
    ),
    (scenario, [box(against="-x")], "box is set against the rim of the tray, which has none"),
    (beside, [box(against=["-x", "+x"])], "give one side along x and one along y"),
    (beside, [box(), bottle(on="box", against="-x")], 'against is only for objects on = "tray"'),
    (beside, [box(against="left")], "against"),
    (beside, [box(at=[-0.06, 0.0]), bottle(against="-x")], "in the same place"),
]


@pytest.mark.parametrize(("made", "items", "words"), MISTAKES, ids=range(len(MISTAKES)))
def test_mistakes_with_a_rim_are_one_sentence(made, items: list[dict], words: str) -> None:
    with pytest.raises(ScenarioError, match=words):
        made(*items) if made is beside else made(items)


@pytest.mark.parametrize("given", ["20%", 0.1])
def test_a_range_of_the_friction_of_a_rim_that_is_not_there_is_refused(given: str | float) -> None:
    with pytest.raises(ScenarioError, match="friction_rim is given, and the tray has no rim"):
        scenario([box()], uncertainty={"friction_rim": given})


def test_shape_without_upright_sides_is_refused() -> None:
    parts = [{"shape": {"type": "box", "size": [0.04, 0.04, 0.04]}, "mass": 1.0}]
    odd = box(against="-x") | {"shape": {"type": "composite", "parts": parts}}
    with pytest.raises(ScenarioError, match="upright sides, not a composite"):
        beside(odd)


def test_rim_that_is_lower_than_an_object_on_another_does_not_concern_it() -> None:
    wide = {
        "name": "lid",
        "shape": {"type": "box", "size": [0.3, 0.06, 0.02]},
        "mass": 0.1,
        "friction": 0.4,
        "on": "box",
    }
    assert beside(box(), wide, height=0.14).payload.bodies[1].walls is None
    with pytest.raises(ScenarioError, match=r"lid may stand 50.0 mm inside the rim at -x"):
        beside(box(), wide, height=0.16)


def test_turned_start_presses_it_against_the_wall() -> None:
    """On a tray that leans towards the wall the box stays up to the angle at which it tips over the rim."""
    payload = beside(box(against="-x", friction=0.05), height=0.03).payload
    (rows,) = contact_rows(payload)
    held = []
    for lean in np.deg2rad([5.0, 30.0, 33.0, 34.5, -5.0]):
        w = np.zeros((1, 12))
        w[0, :3] = exp(np.array([0.0, lean, 0.0])).T @ [0.0, 0.0, G] * [-1, 1, 1]
        held.append(bool(rows.worst(w).max() <= 1e-12))
    assert held == [True, True, True, False, False]  # atan(b / (c - h)) = 33.7 degrees; to the other side it slides
