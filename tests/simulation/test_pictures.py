"""Without the engine, without OpenGL, and with both: one sentence, a drawing, pictures of the load."""

from __future__ import annotations

import os
import subprocess
import sys

import numpy as np
import pytest

from salver.errors import MissingDependencyError
from salver.simulation.pictures import _add_trail, painter
from salver.simulation.scene.engine import mujoco
from salver.simulation.scene.meshes import read_mesh


@pytest.mark.slow
def test_missing_engine_is_one_sentence():
    code = (
        "import sys; sys.modules['mujoco'] = None\n"
        "from salver.errors import MissingDependencyError\n"
        "try:\n    import salver.simulation.physics\n"
        "except MissingDependencyError as error:\n    print(error)"
    )
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert "mujoco" in out
    assert len(out.strip().splitlines()) == 1
    assert issubclass(MissingDependencyError, Exception)


@pytest.mark.slow
def test_physics_loads_whatever_opengl_is_asked_for():
    code = "import salver.simulation.physics, os; print(os.environ['MUJOCO_GL'])"
    environment = os.environ | {"MUJOCO_GL": "osmesa"}
    out = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True, env=environment
    ).stdout
    assert out.strip() == "osmesa"


@pytest.mark.slow
def test_without_opengl_one_sentence_says_what_to_install(nominal, baseline, monkeypatch):
    monkeypatch.setattr("salver.simulation.pictures._BACKENDS", ())
    monkeypatch.delenv("MUJOCO_GL", raising=False)
    with (
        pytest.raises(MissingDependencyError, match=r"No OpenGL .*; install libegl1"),
        painter(nominal, baseline.scenario, 320, 240) as paint,
    ):
        paint(0)


@pytest.mark.slow
def test_pictures_show_the_object_move(nominal, baseline):
    try:
        with painter(nominal, baseline.scenario, 320, 240) as paint:
            images = [paint(0), paint(len(nominal.t) - 1)]
    except MissingDependencyError as error:
        pytest.skip(str(error))

    def where(image):
        """Centre of the pixels with the cube's colour: red well above green and blue."""
        r, g, b = (image[..., i].astype(int) for i in range(3))
        rows, columns = np.nonzero((r > 90) & (r > 2 * g) & (r > 2 * b))
        assert len(rows) > 20
        return np.array([columns.mean(), rows.mean()])

    # it is carried to +y of S, which from in front of the arm is to the right
    assert where(images[1])[0] - where(images[0])[0] > 20


SQUARE = """<COLLADA xmlns="http://www.collada.org/2005/11/COLLADASchema">
<asset><unit meter="0.001"/><up_axis>Z_UP</up_axis></asset>
<library_geometries><geometry id="square"><mesh>
<source id="places"><float_array id="numbers" count="12">0 0 0 20 0 0 20 10 0 0 10 0</float_array></source>
<vertices id="corners"><input semantic="POSITION" source="#places"/></vertices>
<polylist count="1"><input semantic="VERTEX" source="#corners" offset="0"/>
<input semantic="NORMAL" source="#normals" offset="1"/><vcount>4</vcount><p>0 7 1 7 2 7 3 7</p></polylist>
</mesh></geometry></library_geometries>
<library_visual_scenes><visual_scene>
<node><instance_geometry url="#square"/></node>
</visual_scene></library_visual_scenes>
</COLLADA>"""


def test_a_collada_mesh_is_read_with_its_unit_and_is_white_where_it_has_no_colour(tmp_path):
    """A rectangle of 20 by 10 mm; each corner is told with the number of its normal beside it."""
    (tmp_path / "square.dae").write_text(SQUARE)
    (part,) = read_mesh(str(tmp_path / "square.dae"))
    np.testing.assert_allclose(part.vertices, [[0, 0, 0], [0.02, 0, 0], [0.02, 0.01, 0], [0, 0.01, 0]], atol=1e-15)
    assert part.faces.tolist() == [[0, 1, 2], [0, 2, 3]]
    assert all(0.9 < share <= 1.0 for share in part.colour)


def test_a_path_is_dotted_where_it_goes_and_not_where_it_goes_nowhere_or_flies_away():
    """30 cm bent by 40 deg, a dot about every 6 mm."""
    scene = mujoco.MjvScene(mujoco.MjModel.from_xml_string("<mujoco/>"), maxgeom=5000)
    corner, end = np.array([0.5, -0.2, 0.4]), np.array([0.5 + 0.2 * np.cos(0.7), -0.2, 0.4 + 0.2 * np.sin(0.7)])
    path = np.concatenate([np.linspace(corner - [0.1, 0, 0], corner, 11), np.linspace(corner, end, 5)[1:]])
    for astray in (path[:1] + np.zeros((9, 3)), path * 100):
        _add_trail(scene, astray)
        assert scene.ngeom == 0
    _add_trail(scene, path)
    dots = np.array([scene.geoms[k].pos for k in range(scene.ngeom)])
    assert dots[[0, -1]] == pytest.approx(path[[0, -1]], abs=1e-6)
    apart = np.linalg.norm(np.diff(dots, axis=0), axis=1)
    assert apart.max() < 6.2e-3
    assert apart.min() > 5.5e-3  # across the corner
    along = (dots - corner) @ ((end - corner) / 0.2)
    off = np.where(dots[:, 0] > 0.5, np.linalg.norm(dots - corner - np.outer(along, (end - corner) / 0.2), axis=1), 0)
    assert off.max() < 1e-6
