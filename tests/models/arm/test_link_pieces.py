"""Links that are far from convex: what stands for them holds them, and touches hardly more often than they do."""

from __future__ import annotations

import itertools

import coal
import numpy as np
import pinocchio as pin
import pytest
import trimesh

from salver import scenario
from salver.geometry import Array
from salver.models.arm.arm import ArmModel, load_arm
from salver.models.arm.arm_geometry import arm_geometry
from salver.models.arm.link_shapes import link_shapes
from salver.models.shapes.convex_shapes import convex, convex_pieces

URS = ("ur5", *(pytest.param(model, marks=pytest.mark.slow) for model in ("ur3", "ur10")))


def arm_of(model: str) -> ArmModel:
    return load_arm(scenario.Arm(model=model), scenario.Tray(size=(0.12, 0.12)))


def meshes_overlap(arm: ArmModel, q: Array) -> set[tuple[str, str]]:
    """The pairs of links that overlap by their meshes, triangle against triangle, in the order of the URDF."""
    model, data = arm.pin_model, arm.pin_model.createData()
    pin.framesForwardKinematics(model, data, q)
    placed = []
    for item in link_shapes(arm.urdf).shapes:
        there = data.oMf[model.getFrameId(item.link, pin.FrameType.BODY)] * item.placement
        placed.append((item.link, item.itself, coal.Transform3s(there.rotation, there.translation)))
    request, result = coal.CollisionRequest(), coal.CollisionResult
    return {
        (first, second)
        for (first, *one), (second, *other) in itertools.combinations(placed, 2)
        if coal.collide(*one, *other, request, result())
    }


def test_the_hull_of_a_fine_drum() -> None:
    """A prism of 400 sides, whose flat faces Coal cannot keep as fans: volume by the formula, distance to a point
    beside it, over it and along a slant of its rim by hand."""
    turn = np.linspace(0, 2 * np.pi, 400, endpoint=False)
    ring = 0.05 * np.stack([np.cos(turn), np.sin(turn), 0 * turn], axis=1)
    drum = convex(np.vstack([ring, ring + np.array([0, 0, 0.2])]))
    assert drum.computeVolume() == pytest.approx(200 * np.sin(2 * np.pi / 400) * 0.05**2 * 0.2, rel=1e-9)
    for place, away in (((0.08, 0, 0.1), 0.03), ((0.01, 0.02, -0.04), 0.04), ((0.0, 0.08, 0.24), 0.05)):
        at, point = coal.Transform3s(np.eye(3), np.array(place, dtype=float)), coal.Sphere(1e-6)
        request, result = coal.DistanceRequest(), coal.DistanceResult()
        found = coal.distance(drum, coal.Transform3s.Identity(), point, at, request, result)
        assert found == pytest.approx(away, abs=3e-6)


@pytest.mark.parametrize("seed", range(4))
def test_pieces_hold_the_mesh_and_are_smaller_than_its_hull(seed: int) -> None:
    """A dumb-bell of random sizes, slanted: two boxes on a rod. Every point of its solid lies in a piece."""
    rng = np.random.default_rng(seed)
    wide = rng.uniform(0.08, 0.12, 2)
    parts = [
        trimesh.creation.box((w, w, 0.1), trimesh.transformations.translation_matrix((0, 0, z)))
        for w, z in zip(wide, (-0.2, 0.2), strict=True)
    ]
    parts.append(trimesh.creation.cylinder(0.02, 0.4))
    turned = trimesh.transformations.random_rotation_matrix(rng.random(3))
    for part in parts:
        part.apply_transform(turned)
    body = trimesh.util.concatenate(parts)
    pieces = convex_pieces(np.asarray(body.vertices), np.asarray(body.faces))
    assert 1 < len(pieces) <= 3
    rods = trimesh.creation.cylinder(0.02, 0.4)
    rods.apply_transform(turned)
    inside = np.vstack([part.bounding_box_oriented.sample_volume(500) for part in parts[:2]])
    inside = np.vstack([inside, np.asarray(body.sample(1000, seed=seed)), np.asarray(rods.sample(200, seed=seed))])
    beyond = np.min([[np.max(normals(p) @ x - offsets(p)) for x in inside] for p in pieces], axis=0)
    assert beyond.max() < 1e-9
    whole = convex(np.asarray(body.vertices)).computeVolume()
    solid = 0.1 * float(wide @ wide) + np.pi * 0.02**2 * 0.3
    assert solid <= sum(p.computeVolume() for p in pieces) < 0.8 * whole


def normals(shape: coal.ConvexBase) -> Array:
    return np.asarray(shape.normals())


def offsets(shape: coal.ConvexBase) -> Array:
    return -np.asarray(shape.offsets())


def test_a_convex_mesh_is_one_piece() -> None:
    ball = trimesh.creation.icosphere(2, 0.1)
    assert len(convex_pieces(np.asarray(ball.vertices), np.asarray(ball.faces))) == 1


def test_a_mesh_is_read_once_in_a_process() -> None:
    """Every plan looks whether its load lies in the last link's mesh; reading a Gen3's took it .12 s each time."""
    link = next(item for item in link_shapes(arm_of("ur5").urdf).shapes if item.mesh)
    first = link.itself
    assert link.itself is first


def test_a_ur_reaches_down_past_its_base() -> None:
    """The upper arm of a UR5 lies .136 m beside the axis of its base (`shoulder_offset` of its URDF), whose radius is
    .075 m: no angle of the shoulder lift brings one to the other. The hull of the upper arm touches 36 degrees down."""
    arm = arm_of("ur5")
    parts = arm_geometry(arm)
    named = [(parts.names[i], parts.names[j]) for i, j in parts.pairs]
    pair = [k for k, names in enumerate(named) if names == ("base_link", "upper_arm_link")]
    down = np.array([[-0.79, lift, -1.4, 2.31, -1.57, 2.36] for lift in np.linspace(0.6, 1.2, 7)])
    assert parts.clearance(down)[:, pair].min() > 0.0


@pytest.mark.parametrize("model", URS)
def test_what_touches_by_its_meshes_touches_by_what_stands_for_them(model: str) -> None:
    """At random postures; and the other way round in nearly all of them."""
    arm = arm_of(model)
    parts, postures = arm_geometry(arm), np.random.default_rng(1).uniform(-np.pi, np.pi, (15, arm.n))
    links = {item.link for item in link_shapes(arm.urdf).shapes}
    compared = {pair for i, j in parts.pairs if set(pair := (parts.names[i], parts.names[j])) <= links}
    seen = told = 0
    for q in postures:
        near = parts.clearance(q[None])[0] <= 0
        named = {(parts.names[i], parts.names[j]) for (i, j), yes in zip(parts.pairs, near, strict=True) if yes}
        meshes = meshes_overlap(arm, q) & compared
        assert meshes <= named
        seen, told = seen + bool(meshes), told + bool(named & compared)
    assert told <= seen + 3


@pytest.mark.slow
def test_links_whose_meshes_are_open_get_pieces_too() -> None:
    """Of random postures of a Lite 6 hulls would report 23 % as self-collisions in which no meshes touch."""
    arm = arm_of("lite6")
    parts = arm_geometry(arm)
    links = {item.link for item in link_shapes(arm.urdf).shapes}
    linked = [k for k, (i, j) in enumerate(parts.pairs) if {parts.names[i], parts.names[j]} <= links]
    compared = {(parts.names[i], parts.names[j]) for i, j in parts.pairs}
    low, high = np.maximum(arm.limits.q_min, -np.pi), np.minimum(arm.limits.q_max, np.pi)
    postures = np.random.default_rng(5).uniform(low, high, (100, arm.n))
    told = parts.clearance(postures)[:, linked].min(axis=1) <= 0
    seen = np.array([bool(meshes_overlap(arm, q) & compared) for q in postures])
    assert np.all(told[seen])
    assert np.mean(told & ~seen) < 0.04  # 1.9 % of a thousand


@pytest.mark.parametrize("model", URS)
def test_hulls_would_block_a_tenth_of_a_urs_postures(model: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """That are free, of random ones of arm and tray (.11, .22 and .15 of them); docs/howto/arm.md says so."""
    arm = arm_of(model)
    postures = np.random.default_rng(2).uniform(-np.pi, np.pi, (200, arm.n))
    in_pieces = arm_geometry(arm)
    monkeypatch.setattr("salver.models.arm.arm_geometry.bulky", lambda links: ())
    in_hulls = arm_geometry(arm)
    free = [np.mean([parts.clearance(q[None]).min() > 0 for q in postures]) for parts in (in_pieces, in_hulls)]
    assert free[0] - free[1] >= 0.1, free


@pytest.mark.parametrize("model", ["panda", pytest.param("gen3", marks=pytest.mark.slow)])
def test_arms_whose_hulls_are_as_good_keep_them(model: str) -> None:
    arm = arm_of(model)
    parts = arm_geometry(arm)
    assert len(parts.model.geometryObjects) == len(link_shapes(arm.urdf).shapes) + 1  # and the tray
    assert len(set(parts.names)) == len(parts.names)


def test_a_flat_mesh_becomes_a_millimetre_thick_to_either_side() -> None:
    corners = np.array([[-0.1, -0.05, 0.3], [0.1, -0.05, 0.3], [0.1, 0.05, 0.3], [-0.1, 0.05, 0.3]])
    turned = np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3)))[0]
    shape = convex(corners @ turned.T)
    assert shape.computeVolume() == pytest.approx(0.2 * 0.1 * 1e-3, rel=1e-6)
    heights = np.asarray(shape.points()) @ turned[:, 2]
    assert [heights.min(), heights.max()] == pytest.approx([0.2995, 0.3005], abs=1e-9)


def test_pieces_of_a_mirrored_mesh_are_as_large() -> None:
    """A rod with a box at a third of its way and a plate at one end: no end of it is the first one."""
    parts = [
        trimesh.creation.cylinder(0.02, 0.5),
        trimesh.creation.box((0.12, 0.1, 0.06), trimesh.transformations.translation_matrix((0, 0, 0.08))),
        trimesh.creation.box((0.1, 0.1, 0.02), trimesh.transformations.translation_matrix((0, 0, -0.24))),
    ]
    body = trimesh.util.concatenate(parts)
    points, corners = np.asarray(body.vertices), np.asarray(body.faces)
    sizes = [sorted(p.computeVolume() for p in convex_pieces(sign * points, corners)) for sign in (1.0, -1.0)]
    assert len(sizes[0]) == 3
    np.testing.assert_allclose(*sizes, rtol=1e-9)
