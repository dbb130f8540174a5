"""What moves on the report page: tray, objects, links and forces, and the meshes that are drawn."""

from __future__ import annotations

import base64
import itertools
import shutil
from pathlib import Path

import numpy as np
import pytest

from page_contents import data_of, floats
from salver import scenario
from salver.geometry import matrix_from_quat_wxyz
from salver.models.arm.arm import load_arm
from salver.planning.make import make_plan
from salver.reports.pages.meshes import cell_meshes, decimate, link_meshes, merge_vertices, pack
from salver.reports.pages.page import write_report
from salver.reports.pages.replay import replay_scene, stage
from salver.reports.run import read_run

pytestmark = pytest.mark.slow


def test_replay_is_the_plan(cube_plans: Path) -> None:
    """Tray, object and links in the page against forward kinematics; contact forces against Newton's law."""
    run = read_run(cube_plans)
    arm = load_arm(run.scenario.arm, run.scenario.tray)  # type: ignore[arg-type]
    scene = replay_scene(run, arm)
    for variant, motion in zip(scene["variants"], run.motions, strict=True):
        frames = len(variant["t"])
        tray = floats(variant["tray"]).reshape(frames, 7)
        objects = floats(variant["objects"]).reshape(frames, 1, 7)
        joints = floats(variant["joints"]).reshape(frames, arm.n + 1, 7)
        forces = floats(variant["forces"]).reshape(frames, variant["contactCount"], 3)
        for k in (0, frames // 3, frames - 1):
            sample = int(np.argmin(np.abs(motion.t - variant["t"][k])))
            p_SE, R_SE = arm.tray_pose(motion.arrays["q"][sample])
            assert np.abs(tray[k, :3] - p_SE).max() < 2e-5
            assert np.abs(matrix_from_quat_wxyz(tray[k, 3:]) - R_SE).max() < 2e-5
            assert np.abs(objects[k, 0, :3] - motion.arrays["p_SB"][sample]).max() < 1e-6
            flange, _ = arm.link_pose(motion.arrays["q"][sample], "panda_link7")
            assert np.abs(joints[k, arm.n, :3] - flange).max() < 1e-5
            weight = run.scenario.objects[0].mass * (motion.arrays["a_S"][sample] + [0, 0, 9.81])
            assert np.abs(forces[k].sum(axis=0) - weight).max() < 1e-4
    assert np.array_equal(
        floats(scene["variants"][0]["joints"]).reshape(frames, arm.n + 1, 7)[:, 0], [[0, 0, 0, 1, 0, 0, 0]] * frames
    )


@pytest.mark.parametrize("rpy_deg", [(180.0, 0.0, 0.0), (160.0, 0.0, 40.0), (20.0, 0.0, 0.0)])
def test_the_tray_is_held_from_below_whatever_the_side_of_its_flange(rpy_deg: tuple[float, float, float]) -> None:
    """What holds it is drawn from the flange to its underside, never through what stands between them."""
    task = scenario.load("panda-cube").with_changes(tray__height=0.15, tray__rpy_deg=rpy_deg)
    arm = load_arm(task.arm, task.tray)  # type: ignore[arg-type]
    post = np.array(stage(task, task.payload.bodies, arm, [])["tray"]["post"])
    p, R = arm.tray_pose(np.zeros(7))
    assert np.abs(p + R @ post[0] - arm.link_pose(np.zeros(7), arm.flange)[0]).max() < 1e-9
    assert post[-1].tolist() == [0.0, 0.0, -task.tray.thickness]
    along = np.concatenate([np.linspace(a, b, 50) for a, b in itertools.pairwise(post)])
    beside = np.any(np.abs(along[:, :2]) > 0.5 * np.array(task.tray.size) + 0.029, axis=1)  # its radius
    assert np.all(beside | (along[:, 2] <= 0.0) | (along[:, 2] >= post[0, 2] - 1e-9))


def test_replay_of_a_simulation_shows_what_was_simulated(cube_run: Path) -> None:
    run = read_run(cube_run)
    arm = load_arm(run.scenario.arm, run.scenario.tray)  # type: ignore[arg-type]
    variant = replay_scene(run, arm)["variants"][0]
    record = run.plan.simulation
    assert record is not None
    assert variant["source"] == "run"
    objects = floats(variant["objects"]).reshape(len(variant["t"]), 1, 7)
    assert np.abs(objects[-1, 0, :3] - record.arrays["p_SB"][-1, 0]).max() < 1e-6
    forces = floats(variant["forces"]).reshape(len(variant["t"]), -1, 3)
    assert np.abs(forces[-1].sum(axis=0) - [0, 0, 0.256 * 9.81]).max() < 1e-3  # at rest: the weight


def test_meshes_keep_their_shape_when_decimated(monkeypatch: pytest.MonkeyPatch) -> None:
    arm = load_arm(scenario.load("panda-cube").arm, scenario.load("panda-cube").tray)  # type: ignore[arg-type]
    coarse = link_meshes(arm)
    monkeypatch.setattr("salver.reports.pages.meshes.decimate", lambda *mesh, **_: mesh)
    fine = link_meshes(arm)
    assert {m.joint for m in coarse} == set(range(8))
    for link in {m.name for m in fine}:
        few, all_ = ([m for m in meshes if m.name == link] for meshes in (coarse, fine))
        assert sum(len(m.triangles) for m in few) <= 2210 < sum(len(m.triangles) for m in all_)
        for bound in (np.min, np.max):
            a, b = (bound(np.vstack([m.vertices for m in meshes]), axis=0) for meshes in (few, all_))
            assert np.abs(a - b).max() < 1e-3
    for m in coarse:
        packed = pack(m)
        grid = np.frombuffer(base64.b64decode(packed["vertices"]), "<u2").reshape(-1, 3)
        assert np.abs(packed["low"] + grid / 65535 * packed["span"] - m.vertices).max() < 1e-5


def test_the_keep_in_box_is_drawn_by_its_edges() -> None:
    """A quarter turn about z: its x runs along y. Every corner of a bar is near two faces, or more."""
    room = {"position": (0.4, 0.1, 0.6), "rpy_deg": (0, 0, 90), "size": (1.2, 2.0, 1.4)}
    case = scenario.load("panda-cube").with_changes(surroundings__keep_in=room)
    (mesh,) = cell_meshes(case, thick=0.01)
    assert (
        [drawn["name"] for drawn in stage(case, case.bodies, None, [])["obstacles"]] == [mesh.name] == ["keep-in box"]
    )
    off = mesh.vertices - room["position"]
    np.testing.assert_allclose(np.abs(off).max(axis=0), [1.005, 0.605, 0.705])
    assert np.all(np.sum(np.abs(np.abs(off) - [1.0, 0.6, 0.7]) < 0.0051, axis=1) >= 2)
    for corner in itertools.product((-1, 1), repeat=3):  # each of the eight is in three bars
        assert np.sum(np.all(np.abs(off - corner * np.array([1.0, 0.6, 0.7])) < 0.0051, axis=1)) == 12


def test_merging_vertices_by_hand() -> None:
    corners = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 0, 0], [1, 1, 0], [0, 1, 0.0]])
    vertices, triangles = merge_vertices(corners, np.array([[0, 1, 2], [3, 4, 5], [0, 3, 5]]))
    assert len(vertices) == 4
    assert len(triangles) == 2  # the third had two corners in one place
    assert {frozenset(map(tuple, vertices[t])) for t in triangles} == {
        frozenset({(0, 0, 0), (1, 0, 0), (1, 1, 0)}),
        frozenset({(0, 0, 0), (1, 1, 0), (0, 1, 0)}),
    }
    assert decimate(vertices, triangles, 10)[1] is triangles


def test_a_log_of_the_arm_is_shown_like_a_simulation(cube_plans: Path, tmp_path: Path) -> None:
    from salver.driver.execute import run_plan

    shutil.copytree(cube_plans, tmp_path / "run")
    run_plan(tmp_path / "run", realtime=False)
    page = write_report(tmp_path / "run")
    data = data_of(page)
    text = page.read_text()
    assert 'id="execution"' in text
    assert "simulated arm: holds" in text
    assert "Position error of the object" in [
        c["title"] for k, c in data["charts"].items() if k.startswith("execution")
    ]
    variant = data["replay"]["variants"][0]
    poses = floats(variant["objects"]).reshape(len(variant["t"]), 1, 7)
    tray = floats(variant["tray"]).reshape(-1, 7)
    assert np.abs(np.linalg.norm(poses[:, 0, :3] - tray[:, :3], axis=1) - 0.02).max() < 1e-3


def test_a_carried_mesh_is_drawn_as_it_is_not_as_its_hull(tmp_path: Path) -> None:
    import trimesh

    waist = [[0, 0], [0.03, 0], [0.01, 0.05], [0.03, 0.1], [0, 0.1]]
    trimesh.creation.revolve(np.array(waist), sections=12).export(tmp_path / "vase.stl")
    shape = {"type": "mesh", "file": str(tmp_path / "vase.stl")}
    item = {"name": "vase", "shape": shape, "mass": 0.3, "friction": 0.5}
    pose = {"position": [0.5, 0.0, 0.4]}
    way = {"start": pose, "goal": {"position": [0.5, 0.1, 0.4]}, "duration": 2.0}
    vase = scenario.parse({"name": "vase", "motion": way, "objects": [item]}, "vase")
    make_plan(vase, "baseline").save(tmp_path / "run")
    drawn = data_of(write_report(tmp_path / "run"))["replay"]["objects"][0]
    points = np.array(drawn["points"])
    radius, middle = np.hypot(points[:, 0], points[:, 1]), np.ptp(points[:, 2]) / 2 + points[:, 2].min()
    assert np.ptp(points[:, 2]) == pytest.approx(0.1, abs=1e-4)
    assert radius[np.abs(points[:, 2] - middle) < 0.002].max() == pytest.approx(0.01, abs=1e-3)  # the hull: 0.03
