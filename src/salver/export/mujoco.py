"""The MuJoCo scene of a plan as files that others can open: XML, meshes, and the reference to follow."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import TYPE_CHECKING, Any
from xml.etree import ElementTree

import numpy as np

from salver.errors import SalverError
from salver.export.motion import read_motion
from salver.files import new_directory, write_atomic
from salver.geometry import GRAVITY_S, Array
from salver.motion_files.verdict import place_for
from salver.motion_files.writers import write_csv
from salver.planning.plan import load_plan

if TYPE_CHECKING:
    from salver.models.arm.arm import ArmModel

START = "start"
MESHES = "meshes"


def write_scene(directory: str | Path, path: Path, stem: str = "plan", *, unsafe: bool = False) -> list[Path]:
    """A new directory: scene.xml, meshes/, motion.csv (the reference). Opens in MuJoCo's viewer.

    The scene is the one that `salver simulate` runs, but for servos on the joints and compensated weight, so that it
    holds itself up: set ctrl to the columns q_... of motion.csv to replay. Keyframe "start" has the arm at the start
    and the objects on the tray. unsafe: as `salver.export.write_export`. Raises SalverError when `path` exists and for
    inner dynamics that are no body to such a file, FileFormatError for a directory without such a plan, UnsafeError.
    """
    from salver.simulation.scene import scene as scenes
    from salver.simulation.scene.elements import lent
    from salver.simulation.scene.engine import mujoco
    from salver.simulation.scene.loads import true_world

    plan = load_plan(directory, stem)
    path = place_for(path, plan.verdict, unsafe)
    scenario = plan.scenario
    arm = scenario.load_arm() if scenario.arm and plan.joint is not None else None
    world = true_world(scenario)
    for load in world.loads:
        if lent(load.still):
            raise SalverError(
                f"A MuJoCo scene as a file cannot hold {load.nominal.inside}: the part of it that does not swing "
                "has an inertia that no solid has; make the container heavier or less oblong."
            )
    spec = scenes.specify(scenario, world, arm, visual=True)
    spec.modelname = scenario.name
    spec.option.gravity = GRAVITY_S  # without an arm the engine leaves it to the moving tray
    with new_directory(path, "a MuJoCo scene") as made:
        made.mkdir()
        _copy_meshes(spec, made)
        if arm is not None:
            _add_servos(spec, arm)
        scene = scenes.build(scenario, world, arm, visual=True)
        data = mujoco.MjData(scene.model)
        q = plan.joint.sample(0.0)[0][0] if plan.joint is not None and arm is not None else None
        scene.place(data, q)
        spec.add_key(name=START, qpos=data.qpos, ctrl=q if q is not None else [])
        model = spec.compile()
        comment = f"<!-- {plan.verdict.replace('--', '- -')} -->\n"
        write_atomic(made / "scene.xml", comment + with_all_digits(spec.to_xml(), model))
        if arm is not None:
            write_csv(read_motion(directory, stem), made / "motion.csv")
    return sorted(p for p in path.rglob("*") if p.is_file())


def _copy_meshes(spec: Any, folder: Path) -> None:
    """Write every mesh as a file into the folder, and make the scene refer to these files.

    Points written into the XML would do for MuJoCo; other readers of its scenes, USD's among them, want files.
    """
    import trimesh

    for mesh in spec.meshes:
        (folder / MESHES).mkdir(exist_ok=True)
        stem = folder / MESHES / mesh.name.replace("/", "_").replace(":", "_")
        if mesh.file:
            target = stem.with_name(stem.name + Path(mesh.file).suffix)
            shutil.copyfile(mesh.file, target)
        else:  # a convex part, in the engine's own single precision
            target = stem.with_name(stem.name + ".stl")
            hull = trimesh.convex.convex_hull(np.reshape(mesh.uservert, (-1, 3)))
            target.write_bytes(bytes(hull.export(file_type="stl")))
            mesh.uservert, mesh.userface = [], []
        mesh.file = str(target.resolve())


def _add_servos(spec: Any, arm: ArmModel, stiffness: float = 4000.0, damping: float = 200.0) -> None:
    """A position servo on every joint, within the maker's torque, and weight compensated as in a real arm.

    stiffness, damping: N m/rad, N m s/rad; stiff and overdamped, so that what is on the tray stays while one looks.
    """
    from salver.simulation.scene.elements import ARM_PREFIX, TRAY_BODY
    from salver.simulation.scene.engine import mujoco

    for body in spec.bodies:
        if body.name.startswith(ARM_PREFIX) or body.name == TRAY_BODY:
            body.gravcomp = 1.0
    for k, name in enumerate(arm.joint_names):
        servo = spec.add_actuator(name=name, target=ARM_PREFIX + name, trntype=mujoco.mjtTrn.mjTRN_JOINT)
        servo.set_to_position(kp=stiffness, kv=damping)
        if np.isfinite(arm.limits.torque[k]):
            servo.forcelimited = mujoco.mjtLimited.mjLIMITED_TRUE
            servo.forcerange = [-arm.limits.torque[k], arm.limits.torque[k]]


def with_all_digits(xml: str, model: Any) -> str:
    """Restore poses and inertias, which MuJoCo rounds when it writes XML, to all digits."""
    root = ElementTree.fromstring(xml)
    compiler = root.find("compiler")
    if compiler is not None:
        compiler.set("meshdir", MESHES)
    for element in root.iter("mesh"):
        if element.get("file"):
            element.set("file", Path(str(element.get("file"))).name)
    for element in root.iter("body"):
        body = model.body(element.get("name"))
        _drop(element, "pos", "quat", "euler", "axisangle", "xyaxes", "zaxis")
        element.set("pos", _digits(body.pos))
        element.set("quat", _digits(body.quat))
        inertial = element.find("inertial")
        if inertial is not None:
            _drop(inertial, "fullinertia", "euler", "axisangle", "xyaxes", "zaxis")
            inertial.set("mass", _digits(body.mass))
            inertial.set("pos", _digits(body.ipos))
            inertial.set("quat", _digits(body.iquat))
            inertial.set("diaginertia", _digits(body.inertia))
    for element in root.iter("key"):
        key = model.key(element.get("name"))
        element.set("qpos", _digits(key.qpos))
        if model.nu:
            element.set("ctrl", _digits(key.ctrl))
    ElementTree.indent(root)
    return ElementTree.tostring(root, encoding="unicode") + "\n"


def _drop(element: ElementTree.Element, *names: str) -> None:
    for name in names:
        element.attrib.pop(name, None)


def _digits(values: Array) -> str:
    return " ".join(repr(float(x)) for x in np.ravel(values))
