"""Pictures of a run by MuJoCo, without a display."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from importlib import import_module
from typing import Any

import numpy as np

from salver.errors import MissingDependencyError
from salver.geometry import Array, interpolated, matrix_from_quat_wxyz
from salver.models.arm.arm import ArmModel
from salver.models.load_dynamics import Drawn
from salver.scenario import Scenario
from salver.simulation.record import SimulationRecord, drawn_inside
from salver.simulation.scene.engine import mujoco
from salver.simulation.scene.loads import true_world
from salver.simulation.scene.scene import Scene, build

_BACKENDS = ("egl", "osmesa", "glfw")  # the first two need no display


def frames_at(record: SimulationRecord, times: Sequence[float] | Array) -> np.ndarray:
    """Indices of the samples nearest to `times`."""
    return np.abs(record.t[None] - np.asarray(times, dtype=float)[:, None]).argmin(axis=1)


@contextmanager
def painter(
    record: SimulationRecord,
    scenario: Scenario,
    width: int,
    height: int,
    camera: mujoco.MjvCamera | None = None,
) -> Iterator[Callable[[int], np.ndarray]]:
    """A context with a function that renders a sample of the record, with the path of the first object, to an image
    (height, width, 3), uint8.

    camera: default: one that sees the whole motion. Raises MissingDependencyError without OpenGL.
    """
    arm = scenario.load_arm() if scenario.arm is not None and record.q.shape[1] else None
    scene = build(scenario, true_world(scenario, record.parameters), arm, visual=True)
    scene.model.vis.global_.offwidth, scene.model.vis.global_.offheight = width, height
    data = mujoco.MjData(scene.model)
    camera = camera or _camera(record, arm)
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
            _add_trail(drawn, record.p_SB[:, 0])
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
    raise MissingDependencyError(
        f"No OpenGL for pictures without a display ({'; '.join(tried) or 'none tried'}); install libegl1, "
        "libopengl0 and libgl1-mesa-dri, or set MUJOCO_GL."
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


def _camera(record: SimulationRecord, arm: ArmModel | None) -> mujoco.MjvCamera:
    """A camera that sees the whole path of the tray, and the arm's base if there is one."""
    base = np.zeros((0, 3)) if arm is None else arm.base_position + np.array([[0, 0, 0], [0, 0, 0.7]])
    points = np.vstack([record.p_SE, base])
    low, high = points.min(axis=0), points.max(axis=0)
    camera = mujoco.MjvCamera()
    camera.lookat = 0.5 * (low + high)
    camera.distance = max(0.7, (1.5 if arm is None else 0.9) * float(np.linalg.norm(high - low)) + 0.45)
    camera.azimuth, camera.elevation = 215.0, -20.0  # degrees
    return camera


def _add_trail(scene: Any, path: Array, spacing: float = 6e-3) -> None:
    """Dots along a path (T, 3), about every `spacing` m."""
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


def _add_inside(scene: Any, inside: Drawn, record: SimulationRecord, j: int, k: int, thickness: float = 0.0012) -> None:
    """Add the liquid or pendulum inside object j at sample k, and the edge that it must not exceed, m thick."""
    p, R = record.p_SB[k, j], matrix_from_quat_wxyz(record.quat_SB_wxyz[k, j])
    for a, b, c in p + inside.triangles_B(k) @ R.T:
        across = np.cross(b - a, c - a)
        axes = np.column_stack([b - a, c - a, across / np.linalg.norm(across)])
        _add(scene, mujoco.mjtGeom.mjGEOM_TRIANGLE, np.ones(3), a, axes, (*inside.colour, 1))
    edge = p + inside.edge_B @ R.T
    colour = (*inside.edge_colour(record.t[k]), 1)
    for a, b in zip(edge, np.roll(edge, -1, axis=0), strict=True):
        _add(scene, mujoco.mjtGeom.mjGEOM_CAPSULE, np.ones(3), a, np.eye(3), colour)
        mujoco.mjv_connector(scene.geoms[scene.ngeom - 1], mujoco.mjtGeom.mjGEOM_CAPSULE, thickness, a, b)
