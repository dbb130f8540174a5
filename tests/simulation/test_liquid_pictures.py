"""The liquid in the replay of the page and in the film: where its surface stands, and when its brim is marked."""

from __future__ import annotations

import base64
from dataclasses import replace
from io import BytesIO

import mujoco
import numpy as np
import pytest
from PIL import Image

import browser
import salver as sv
from salver.dynamics.liquid.drawn_surface import DrawnSurface
from salver.geometry import matrix_from_quat_wxyz, matrix_from_rpy, quat_wxyz_from_matrix
from salver.models.load_dynamics import Drawn
from salver.reports.pages.page import write_report
from salver.reports.pages.replay import replay_scene
from salver.reports.run import read_run
from salver.simulation.pictures import frames_at, painter

STICKY = {"objects__0__friction": 2.0, "motion__duration": 0.75, "arm": None}  # it spills, and stays where it is


def tilting(coffee, tmp_path, simulated=True):
    """A run of which the tray is tilted by some 11 degrees, turned by 40, and all but at rest."""
    turned = {"rpy_deg": [9.0, -6.0, 40.0]}
    start = {"position": [0.5, 0.0, 0.4], **turned}
    goal = {"position": [0.5001, 0.0, 0.4], **turned}
    changes = {"motion__start": start, "motion__goal": goal, "motion__duration": 0.6, "arm": None}
    plan = sv.plan(coffee.with_changes(**changes), "baseline", arm=False)
    plan.save(tmp_path)
    if simulated:
        sv.simulate(plan).save(tmp_path)
    return read_run(tmp_path)


def drawn(run):
    """Times, poses (T, 7) of the first object, slopes (T, 2) of its liquid: as the page has them."""
    variant = replay_scene(run, None)["variants"][0]
    count = len(variant["t"])
    poses = floats(variant["objects"]).reshape(count, -1, 7)[:, 0]
    return np.array(variant["t"]), poses, floats(variant["inside"][0]["moves"]).reshape(count, 2)


def floats(text):
    return np.frombuffer(base64.b64decode(text), dtype="<f4").astype(float)


def upward_S(poses, slope):
    """(T, 3) unit normals of the surface, in S."""
    normal = np.column_stack([-slope, np.ones(len(slope))])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    return np.einsum("tij,tj->ti", matrix_from_quat_wxyz(poses[:, 3:]), normal)


@pytest.mark.slow
def test_in_a_tilted_cup_the_surface_of_the_engine_is_level(coffee, tmp_path):
    """Whatever the cup does: at rest a surface is horizontal. 0.1 mm in 0.6 s is 0.0016 m/s^2, 2e-4 rad."""
    run = tilting(coffee, tmp_path)
    _, poses, slope = drawn(run)
    assert np.abs(slope).min() > 0.05  # the cup is not
    np.testing.assert_allclose(upward_S(poses, slope), np.tile([0, 0, 1.0], (len(slope), 1)), atol=2e-3)


@pytest.mark.slow
def test_under_constant_acceleration_the_surface_is_across_what_gravity_seems_to_be(coffee, tmp_path):
    run = tilting(coffee, tmp_path, simulated=False)
    a_S, R = np.array([2.0, -1.0, 1.5]), matrix_from_rpy(np.deg2rad([4.0, -3.0, 25.0]))
    arrays = dict(run.plan.arrays)
    arrays["a_S"] = np.tile(a_S, (len(run.plan.t), 1))
    arrays["quat_SB_wxyz"] = np.tile(quat_wxyz_from_matrix(R), (len(run.plan.t), 1))
    arrays["omega_B"], arrays["alpha_B"] = (np.zeros_like(arrays["a_S"]) for _ in range(2))
    _, poses, slope = drawn(replace(run, motions=[replace(run.plan, arrays=arrays)]))
    felt = a_S + np.array([0, 0, 9.81])
    np.testing.assert_allclose(upward_S(poses, slope), np.tile(felt / np.linalg.norm(felt), (len(slope), 1)), atol=1e-6)


@pytest.mark.parametrize("box", [False, True])
def test_the_liquid_that_is_drawn_fills_the_cup_to_its_fill(coffee, box):
    """Volume inside the triangles, by Gauss, whatever the slope: base times fill. Beyond, the bottom stays wet."""
    if box:
        shape = {"type": "box", "size": [0.1, 0.07, 0.085]}
        inside = {"kind": "water", "size": [0.09, 0.06], "fill": 0.05, "brim": 0.08}
        coffee = coffee.with_changes(objects__0__shape=shape, objects__0__liquid=inside)
    body, fill = coffee.payload.first, 0.06
    heights = np.array([[0.0, 0.0], [0.02, -0.015], [0.3, -0.2]])
    surface = DrawnSurface.of_heights(body, fill, heights, None)
    corners = surface.bottom_B[:, :2]
    (x, y), (x_next, y_next) = corners.T, np.roll(corners, -1, axis=0).T
    area = 0.5 * np.sum(x * y_next - y * x_next)
    assert area == pytest.approx(0.09 * 0.06 if box else np.pi * 0.04**2, rel=0.01)  # 32 corners
    for k in range(3):
        a, b, c = np.moveaxis(surface.triangles_B(k) - surface.bottom_B.mean(axis=0), 1, 0)  # no flux through the base
        assert np.sum(a * np.cross(b, c)) / 6 == pytest.approx(area * fill)
        assert surface.ring_B(k)[:, 2].min() >= surface.bottom_B[0, 2] - 1e-12
    half = np.array([0.045, 0.03] if box else [0.04, 0.04])
    np.testing.assert_allclose(surface.slope[1], heights[1] / half)


def red(image):
    """Pixels of about the colour of a brim that was spilt over."""
    return int(np.sum(np.all(np.abs(image[..., :3] / 255.0 - Drawn.edge_colours[1]) < 0.12, axis=-1)))


@pytest.fixture(scope="module")
def spilling(coffee, tmp_path_factory):
    directory = tmp_path_factory.mktemp("spilling")
    plan = sv.plan(coffee.with_changes(**STICKY), "baseline", arm=False)
    plan.save(directory)
    record = sv.simulate(plan)
    record.save(directory)
    return directory, record, plan.scenario


@pytest.mark.slow
def test_the_brim_in_the_film_is_marked_from_the_spill_on(spilling):
    _, record, scenario = spilling
    assert record.outcome == "spills"
    spilt = record.summary["objects"][0]["first_spill"]
    k = int(np.searchsorted(record.t, spilt))
    camera = mujoco.MjvCamera()
    camera.lookat, camera.distance, camera.azimuth, camera.elevation = record.p_SB[k, 0], 0.35, 215.0, -30.0
    with painter(record, scenario, 960, 720, camera) as paint:
        before, after = (paint(j) for j in frames_at(record, [spilt - 0.02, spilt + 0.01]))
    assert red(before) < 0.1 * red(after)
    assert red(after) > 200


@pytest.mark.slow
@pytest.mark.skipif(browser.missing() is not None, reason=str(browser.missing()))
def test_the_brim_on_the_page_is_marked_from_the_spill_on(spilling):
    directory, record, _ = spilling
    spilt = record.summary["objects"][0]["first_spill"]
    page = write_report(directory)
    with browser.chromium() as chromium:
        chromium.open(page)
        chromium.wait_for("window.salver && salver.state.viewer")
        chromium.script("salver.state.viewer.options.camera = 'close'; byId('canvas').scrollIntoView()")
        pictures = []
        for t in (spilt - 0.02, spilt + 0.01):
            chromium.script("salver.setPlaying(false); salver.setTime(arguments[0])", t)
            url = chromium.script("return byId('canvas').toDataURL()")
            pictures.append(np.array(Image.open(BytesIO(base64.b64decode(url.split(",")[1])))))
        assert chromium.log("browser") == []
    assert red(pictures[0]) == 0
    assert red(pictures[1]) > 200
