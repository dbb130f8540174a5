"""Pictures of a run, without a display: by MuJoCo's renderer, or by matplotlib if OpenGL does not work."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from importlib import import_module
from typing import TYPE_CHECKING, Any

import numpy as np

from salver.geometry import Array, interpolated, matrix_from_quat_wxyz
from salver.models.arm.arm import ArmModel, load_arm
from salver.models.load_dynamics import Colour, Drawn
from salver.scenario import Scenario
from salver.simulation.pictures.drawing import draw_obstacles
from salver.simulation.record import SimulationRecord, drawn_inside
from salver.simulation.scene.engine import mujoco
from salver.simulation.scene.loads import true_world
from salver.simulation.scene.scene import Scene, build

if TYPE_CHECKING:
    from matplotlib.axes import Axes

EDGE_RADIUS = 0.0012  # m, of the ring that shows the brim or the pendulum's limit
_BACKENDS = ("egl", "osmesa", "glfw")  # the first two need no display


@dataclass(frozen=True)
class View:
    """A camera.

    target_S: (3,) point in its centre, m. distance: m. None: chosen so that the whole motion is visible. azimuth,
    elevation: degrees, as in MuJoCo (azimuth 90 looks along +y of S, 180 along -x; a negative elevation looks down).
    """

    target_S: Array | None = None
    distance: float | None = None
    azimuth: float = 215.0
    elevation: float = -20.0


@dataclass(frozen=True)
class Pictures:
    """Rendered pictures.

    images: (N, height, width, 3) uint8. renderer: "mujoco" or "matplotlib". note: why not MuJoCo, or empty.
    """

    images: np.ndarray
    renderer: str
    note: str = ""


def snapshots(
    record: SimulationRecord,
    scenario: Scenario,
    times: Sequence[float] | Array,
    *,
    width: int = 960,
    height: int = 720,
    view: View | None = None,
    trail: bool = True,
    plain: bool = False,
) -> Pictures:
    """Render the scene at the samples of the record nearest to `times`, s.

    trail: show the path of the first object. plain: draw with matplotlib even if OpenGL works.
    Without OpenGL, matplotlib draws, and `note` of the result says why.
    """
    frames = frames_at(record, times)
    arm = load_arm(scenario.arm, scenario.tray) if scenario.arm is not None and record.q.shape[1] else None
    view = view or View()
    path = record.p_SB[:, 0] if trail else np.empty((0, 3))
    note = ""
    if not plain:
        try:
            with painter(record, scenario, width, height, view, path) as paint:
                return Pictures(np.stack([paint(k) for k in frames]), "mujoco")
        except NoOpenGLError as error:
            note = str(error)
    return Pictures(_drawings(record, scenario, arm, frames, width, height, view, path), "matplotlib", note)


def frames_at(record: SimulationRecord, times: Sequence[float] | Array) -> np.ndarray:
    """Indices of the samples nearest to `times`."""
    return np.abs(record.t[None] - np.asarray(times, dtype=float)[:, None]).argmin(axis=1)


class NoOpenGLError(RuntimeError):
    """No OpenGL context can be made on this machine; the message lists the backends that were tried."""


@contextmanager
def painter(
    record: SimulationRecord,
    scenario: Scenario,
    width: int,
    height: int,
    view: View | None = None,
    path: Array | None = None,
) -> Iterator[Callable[[int], np.ndarray]]:
    """A context with a function that renders a sample of the record to an image (height, width, 3), for films.

    Raises NoOpenGLError.
    """
    arm = load_arm(scenario.arm, scenario.tray) if scenario.arm is not None and record.q.shape[1] else None
    scene = build(scenario, true_world(scenario, record.parameters), arm, visual=True)
    scene.model.vis.global_.offwidth, scene.model.vis.global_.offheight = width, height
    data = mujoco.MjData(scene.model)
    camera = _camera(view or View(), record, arm)
    inside = drawn_inside(scene.loads, record.surface, record.summary)
    drawn, option = mujoco.MjvScene(scene.model, maxgeom=20000), mujoco.MjvOption()
    size = mujoco.MjrRect(0, 0, width, height)
    context = _context(width, height)
    try:
        resources = mujoco.MjrContext(scene.model, mujoco.mjtFontScale.mjFONTSCALE_150.value)
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN.value, resources)

        def paint(k: int) -> np.ndarray:
            context.make_current()  # several may paint in turn
            _pose(scene, data, record, k)
            mujoco.mjv_updateScene(scene.model, data, option, None, camera, mujoco.mjtCatBit.mjCAT_ALL.value, drawn)
            _add_trail(drawn, path)
            for j, each in enumerate(inside):
                if each is not None:
                    _add_inside(drawn, each, record, j, k)
            mujoco.mjr_render(size, drawn, resources)
            image = np.empty((height, width, 3), dtype=np.uint8)
            mujoco.mjr_readPixels(image, None, size, resources)
            return image[::-1]

        yield paint
        context.make_current()
        resources.free()
    finally:
        context.free()


def _context(width: int, height: int) -> Any:
    """A current OpenGL context of the backend that MUJOCO_GL names, or of the first that works."""
    wanted = os.environ.get("MUJOCO_GL", "").lower()
    tried = []
    for name in (wanted,) if wanted in _BACKENDS else _BACKENDS:
        if name == "glfw" and not wanted and not os.environ.get("DISPLAY"):
            continue
        try:
            module = import_module(f"mujoco.{name}")
            context = module.GLContext(width, height)
            context.make_current()
            return context
        # PyOpenGL raises various exceptions when a library is missing, such as AttributeError.
        except Exception as error:
            tried.append(f"{name}: {(str(error).strip().splitlines() or [type(error).__name__])[0]}")
            os.environ.pop("PYOPENGL_PLATFORM", None)
    raise NoOpenGLError(
        f"No OpenGL for pictures without a display ({'; '.join(tried) or 'none tried'}); install libegl1, "
        "libopengl0 and libgl1-mesa-dri, or set MUJOCO_GL. The pictures are drawn by matplotlib instead."
    )


def _pose(scene: Scene, data: Any, record: SimulationRecord, k: int) -> None:
    if scene.arm is not None:
        data.qpos[: scene.n] = record.q[k]
    else:
        scene.model.body_pos[scene.tray_id] = record.p_SE[k]
        scene.model.body_quat[scene.tray_id] = record.quat_SE_wxyz[k]
    for j, i in enumerate(scene.qpos_ids):
        data.qpos[i : i + 3] = record.p_SB[k, j]
        data.qpos[i + 3 : i + 7] = record.quat_SB_wxyz[k, j]
    mujoco.mj_kinematics(scene.model, data)
    mujoco.mj_camlight(scene.model, data)


def _camera(view: View, record: SimulationRecord, arm: ArmModel | None) -> Any:
    target, distance = _framing(view, record, arm)
    camera = mujoco.MjvCamera()
    camera.lookat = target
    camera.distance = distance
    camera.azimuth, camera.elevation = view.azimuth, view.elevation
    return camera


def _framing(view: View, record: SimulationRecord, arm: ArmModel | None) -> tuple[Array, float]:
    """Target (3,) and distance of a camera that sees the whole path of the tray, and the arm's base if there is one."""
    points = (
        record.p_SE
        if arm is None
        else np.vstack([record.p_SE, arm.base_position, arm.base_position + np.array([0, 0, 0.7])])
    )
    low, high = points.min(axis=0), points.max(axis=0)
    target = 0.5 * (low + high) if view.target_S is None else np.asarray(view.target_S, dtype=float)
    reach = float(np.linalg.norm(high - low))
    distance = (0.9 if arm is not None else 1.5) * reach + 0.45
    return target, view.distance if view.distance is not None else max(0.7, distance)


def _add_trail(scene: Any, path: Array | None, spacing: float = 6e-3) -> None:
    """Dots along a path (T, 3), about every `spacing` m."""
    if path is None or len(path) < 2:
        return
    length = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(path, axis=0), axis=1))])
    if not 0 < length[-1] < 20:
        return
    at = np.linspace(0, length[-1], max(2, int(length[-1] / spacing)))
    for point in interpolated(length, path[:, :3], at):
        _add(scene, mujoco.mjtGeom.mjGEOM_SPHERE, np.full(3, 2e-3), point, np.eye(3), (0.10, 0.25, 0.55, 0.8))


def _add(scene: Any, kind: Any, size: Array, at: Array, axes: Array, rgba: Sequence[float]) -> None:
    """Add a geom to the picture; the columns of axes (3, 3) may have any length and direction."""
    if scene.ngeom < scene.maxgeom:
        piece = scene.geoms[scene.ngeom]
        mujoco.mjv_initGeom(piece, kind, size, at, axes.ravel(), np.array(rgba, dtype=np.float32))
        scene.ngeom += 1


def _add_inside(scene: Any, inside: Drawn, record: SimulationRecord, j: int, k: int) -> None:
    """Add the liquid or pendulum inside object j at sample k, and the edge that it must not exceed."""
    p, R = record.p_SB[k, j], matrix_from_quat_wxyz(record.quat_SB_wxyz[k, j])
    for a, b, c in p + inside.triangles_B(k) @ R.T:
        across = np.cross(b - a, c - a)
        axes = np.column_stack([b - a, c - a, across / np.linalg.norm(across)])
        _add(scene, mujoco.mjtGeom.mjGEOM_TRIANGLE, np.ones(3), a, axes, (*inside.colour, 1))
    edge = p + inside.edge_B @ R.T
    colour = (*inside.edge_colour(record.t[k]), 1)
    for a, b in zip(edge, np.roll(edge, -1, axis=0), strict=True):
        _add(scene, mujoco.mjtGeom.mjGEOM_CAPSULE, np.ones(3), a, np.eye(3), colour)
        mujoco.mjv_connector(scene.geoms[scene.ngeom - 1], mujoco.mjtGeom.mjGEOM_CAPSULE, EDGE_RADIUS, a, b)


def _drawings(
    record: SimulationRecord,
    scenario: Scenario,
    arm: ArmModel | None,
    frames: np.ndarray,
    width: int,
    height: int,
    view: View,
    path: Array,
) -> np.ndarray:
    """Line drawings by matplotlib: arm as a chain of links, tray and objects as edges of their hulls."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
    from mpl_toolkits.mplot3d.art3d import Poly3DCollection  # type: ignore[import-untyped]

    loads = true_world(scenario, record.parameters).loads
    inside = drawn_inside(loads, record.surface, record.summary)
    target, distance = _framing(view, record, arm)
    x, y = 0.5 * np.array(scenario.tray.size)
    tray = np.array([[x, y, 0], [-x, y, 0], [-x, -y, 0], [x, -y, 0], [x, y, 0]])
    images = []
    for k in frames:
        figure = Figure(figsize=(width / 100, height / 100), dpi=100)
        canvas = FigureCanvasAgg(figure)
        axes: Any = figure.add_axes((0, 0, 1, 1), projection="3d")
        axes.view_init(elev=-view.elevation, azim=view.azimuth - 180)
        reach = 0.42 * distance
        axes.set(**{f"{n}lim": (c - reach, c + reach) for n, c in zip("xyz", target, strict=True)})
        axes.set_box_aspect((1, 1, 1))
        if len(path):
            axes.plot(*path.T, color="0.6", linewidth=1)
        if arm is not None:
            draw_obstacles(axes, scenario.obstacles)
            chain = np.array([arm.link_pose(record.q[k], link)[0] for link in arm.link_names])
            axes.plot(*np.vstack([chain, record.p_SE[k]]).T, color="0.25", linewidth=5, solid_joinstyle="round")
        _polygon(axes, record.p_SE[k] + tray @ matrix_from_quat_wxyz(record.quat_SE_wxyz[k]).T, "0.35")
        for j, load in enumerate(loads):
            base = np.column_stack([load.solid.base_polygon, np.full(len(load.solid.base_polygon), load.solid.base_z)])
            R = matrix_from_quat_wxyz(record.quat_SB_wxyz[k, j])
            bottom = record.p_SB[k, j] + (base - load.com_G) @ R.T
            top = bottom + R[:, 2] * load.solid.height
            for ring in (bottom, top):
                _polygon(axes, np.vstack([ring, ring[:1]]), f"C{1 + j}")
            for a, b in zip(bottom, top, strict=True):
                _polygon(axes, np.stack([a, b]), f"C{1 + j}")
            each = inside[j]
            if each is not None:
                edge = record.p_SB[k, j] + np.vstack([each.edge_B, each.edge_B[:1]]) @ R.T
                axes.add_collection3d(
                    Poly3DCollection(record.p_SB[k, j] + each.triangles_B(k) @ R.T, facecolor=each.colour)
                )
                _polygon(axes, edge, each.edge_colour(record.t[k]))
        axes.text2D(0.02, 0.95, f"t = {record.t[k]:.2f} s", transform=axes.transAxes)
        canvas.draw()
        images.append(np.asarray(canvas.buffer_rgba())[..., :3].copy())
    return np.stack(images)


def _polygon(axes: Axes, points: Array, colour: str | Colour) -> None:
    axes.plot(*points.T, color=colour, linewidth=1.5)
