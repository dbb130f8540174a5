"""From scenario to bodies: where objects stand, what they touch, and which arrangements cannot be."""

import numpy as np
import pytest
import trimesh
from numpy.testing import assert_allclose

from armless_scenarios import scenario
from salver.errors import ScenarioError
from salver.models.shapes.polygons import eroded, inset, intersection, simplified

SQUARE = np.array([[1.0, 1.0], [-1.0, 1.0], [-1.0, -1.0], [1.0, -1.0]])


def cube(name: str, side: float = 0.04, **more: object) -> dict:
    return {"name": name, "shape": {"type": "box", "size": [side] * 3}, "mass": 0.1, "friction": 0.4, **more}


def area(polygon: np.ndarray) -> float:
    x, y = polygon.T
    return 0.5 * float(np.sum(x * np.roll(y, -1) - y * np.roll(x, -1)))


def test_polygon_operations_by_hand() -> None:
    assert_allclose(area(intersection(SQUARE, SQUARE + np.array([0.5, 0.25]))), 1.5 * 1.75)
    assert len(intersection(SQUARE, SQUARE + np.array([2.5, 0]))) == 0
    assert len(intersection(SQUARE, SQUARE[:0])) == 0
    octagon = intersection(SQUARE, SQUARE @ (np.array([[1, -1], [1, 1]]) / np.sqrt(2)))
    assert len(octagon) == 8
    assert_allclose(area(octagon), 8 * (np.sqrt(2) - 1))
    assert_allclose(area(eroded(SQUARE, np.array([0.1, 0.3]))), 1.8 * 1.4)
    assert len(eroded(SQUARE, np.array([1.1, 0.0]))) == 0
    assert_allclose(area(inset(SQUARE, 0.05)), 1.9**2)
    assert len(inset(SQUARE, 1.001)) == 0
    # A short edge between two others vanishes when all are moved inwards.
    cut = np.array([[1, 0.99], [0.99, 1], [-1, 1], [-1, -1], [1, -1]], dtype=float)
    assert len(inset(cut, 0.1)) == 4
    assert_allclose(area(inset(cut, 0.1)), 1.8**2)


def test_simplified_polygon_lies_within() -> None:
    angle = np.linspace(0, 2 * np.pi, 100, endpoint=False)
    circle = np.column_stack([np.cos(angle), np.sin(angle)])
    few = simplified(circle, 16)
    assert len(few) == 16
    assert 0.97 * area(circle) < area(few) < area(circle)
    assert simplified(SQUARE, 4) is SQUARE


def test_stack_turned_by_45_degrees_touches_in_an_octagon() -> None:
    items = scenario([cube("lower"), cube("upper", on="lower", yaw_deg=45.0)]).payload.bodies
    upper = items[1]
    assert upper.on == ("lower",)
    assert upper.regions == (8,)
    assert_allclose(upper.p_EB, [0, 0, 0.06], atol=1e-12)
    assert_allclose(upper.contacts.p_BC[:, 2], -0.02)
    assert_allclose(np.abs(upper.contacts.p_BC[:, :2]).max(), 0.02)


def test_composite_object() -> None:
    parts = [
        {"shape": {"type": "box", "size": [0.1, 0.1, 0.02]}, "mass": 0.2},
        {"shape": {"type": "cylinder", "radius": 0.02, "height": 0.1}, "position": [0.02, 0, 0.06], "mass": 0.3},
    ]
    (body,) = scenario([{"shape": {"type": "composite", "parts": parts}, "mass": 0.5, "friction": 0.4}]).payload.bodies
    # Centre of mass over the base: (0.2 * 0.01 + 0.3 * 0.07) / 0.5; 12 mm to the side.
    assert_allclose(body.p_EB, [0.012, 0, 0.046], atol=1e-12)
    across, along = (3 * 0.02**2 + 0.1**2) / 12, 0.5 * 0.02**2
    expected = 0.2 * (0.1**2 + 0.1**2) / 12 + 0.2 * 0.012**2 + 0.3 * along + 0.3 * 0.008**2
    assert_allclose(body.inertial.inertia_com[2, 2], expected)
    expected = 0.2 * ((0.1**2 + 0.02**2) / 12 + 0.036**2) + 0.3 * (across + 0.024**2)
    assert_allclose(body.inertial.inertia_com[0, 0], expected)


def test_mesh_object(tmp_path) -> None:
    path = tmp_path / "box.stl"
    trimesh.creation.box((40, 40, 40)).export(path)
    shape = {"type": "mesh", "file": str(path), "scale": 1e-3}
    (body,) = scenario([{"shape": shape, "mass": 0.1, "friction": 0.4}]).payload.bodies
    (same,) = scenario([cube("object")]).payload.bodies
    assert_allclose(body.inertial.inertia_com, same.inertial.inertia_com, rtol=1e-9)
    assert_allclose(body.p_EB, same.p_EB)
    assert_allclose(np.ptp(body.contacts.p_BC, axis=0), [0.04, 0.04, 0], atol=1e-12)


def test_nothing_stands_on_a_pointed_top(tmp_path) -> None:
    path = tmp_path / "cone.stl"
    trimesh.creation.cone(0.03, 0.1).export(path)
    cone = {**cube("cone"), "shape": {"type": "mesh", "file": str(path)}}
    assert len(scenario([cone]).payload.first.contacts.p_BC) == 16
    with pytest.raises(ScenarioError, match="top stands beside cone, not on it"):
        scenario([cone, cube("top", on="cone")])


@pytest.mark.parametrize(
    ("objects", "sentence"),
    [
        ([cube("a"), cube("b", at=[0.039, 0])], "b and a are in the same place; move one of them"),
        ([cube("a"), cube("b", on="a", at=[0.05, 0])], "b stands beside a, not on it"),
        (
            [cube("a"), cube("b", 0.05, at=[0.05, 0]), cube("c", 0.1, on=["a", "b"], at=[0.02, 0])],
            "tops differ by 10.0 mm",
        ),
        ([cube("a", uncertainty={"friction": 0.4})], "uncertainty.friction = 0.4 is not below friction"),
        ([cube("a", support_inset=0.02)], "leaves nothing of its base"),
        ([cube("b", on="a")], 'b stands on "a", which is neither'),
        (
            [{**cube("a"), "shape": {"type": "mesh", "file": "nowhere.stl"}}],
            'the mesh file "nowhere.stl" does not exist',
        ),
    ],
)
def test_arrangements_that_cannot_be(objects: list[dict], sentence: str) -> None:
    with pytest.raises(ScenarioError, match=sentence):
        scenario(objects)


def test_objects_may_touch_and_bridge() -> None:
    scenario([cube("a"), cube("b", at=[0.04, 0])])
    posts = [cube("a", at=[-0.03, 0]), cube("b", at=[0.03, 0])]
    top = {**cube("top", on=["a", "b"]), "shape": {"type": "box", "size": [0.1, 0.04, 0.01]}}
    (*_, body) = scenario([*posts, top]).payload.bodies
    assert body.regions == (4, 4)
    assert_allclose(np.sort(np.unique(np.round(body.contacts.p_BC[:, 0], 9))), [-0.05, -0.01, 0.01, 0.05])


@pytest.mark.parametrize("com", [0.012, -0.012])
def test_whether_objects_are_in_the_same_place_does_not_depend_on_where_their_mass_is(com: float) -> None:
    """Each turned by its own angle: side by side along x they touch at 4 cm, whatever is inside."""
    pair = [cube("a", com=[com, 0.0, 0.0]), cube("b", com=[0.0, com, 0.0], yaw_deg=90)]
    scenario([pair[0], {**pair[1], "at": [0.0401, 0]}])
    with pytest.raises(ScenarioError, match="in the same place"):
        scenario([pair[0], {**pair[1], "at": [0.0399, 0]}])
