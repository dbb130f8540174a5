"""A run as an MCAP file of ROS 2 messages, which Foxglove, Rerun and `rosbag2` open: nothing else is needed to see it.

Topics: /joint_states; /tf with the links, the tray and the objects below "world"; /salver/markers, the shapes of all of
them, once; /salver/verdict, on the plan, once. Time begins at 0.
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from salver.errors import FileFormatError, ScenarioError
from salver.files import output_file, put_in_place, writing
from salver.geometry import Array
from salver.models.arm.arm import moved_links
from salver.models.bodies import Body
from salver.models.shapes import hulls, shapes
from salver.motion_files.ros_writers import WORLD_FRAME, Row, header_of, write_rows
from salver.reports.pages.meshes import cell_meshes, link_meshes
from salver.reports.pages.replay import joint_poses, poses
from salver.reports.run import read_leg, read_run
from salver.reports.style import OBJECT_COLOURS, TRAY_COLOUR, rgb
from salver.run_directory import leg_number, plan_verdict

TRIANGLE_LIST = 11  # of visualization_msgs/msg/Marker


def write_mcap(directory: str | Path, path: str | Path, stem: str = "plan") -> Path:
    """Write a motion of a run directory: as it was run, in the engine or on an arm, or else as it is planned.

    Raises FileFormatError for a directory without such a motion, ScenarioError for an object that has the name of
    another frame, SalverError for a place that is taken.
    """
    directory, path = Path(directory), output_file(Path(path), (".mcap",))
    leg = leg_number(stem)
    run = read_run(directory) if leg is None else read_leg(directory, leg)
    motion = run.motion(stem if leg is None else "plan")
    if motion is None:
        raise FileFormatError(f'{directory} has no motion "{stem}"; it has {", ".join(m.stem for m in run.motions)}.')
    scenario, source = run.scenario, motion.seen.arrays if motion.seen else motion.arrays
    arm = None if scenario.arm is None else scenario.load_arm()
    links = {0: WORLD_FRAME} | ({} if arm is None else moved_links(arm.pin_model))
    called = ["tray", *links.values(), *(body.name for body in run.bodies)]
    for name in called:
        if called.count(name) > 1:
            raise ScenarioError(
                f'Two frames would be called "{name}"; give the object or link of that name another one.'
            )
    ns = np.round((source["t"] - source["t"][0]) * 1e9).astype(np.int64)
    tray, objects = poses(motion, run.bodies, np.arange(len(ns)))
    frames: dict[str, Array] = {"tray": tray}
    frames |= {body.name: objects[:, k] for k, body in enumerate(run.bodies)}
    markers = [_marker("tray", "tray", _tray(scenario.tray), rgb(TRAY_COLOUR))]
    for k, body in enumerate(run.bodies):
        markers.append(_marker("load", body.name, _body(body), rgb(OBJECT_COLOURS[k % len(OBJECT_COLOURS)])))
    for mesh in cell_meshes(scenario):
        markers.append(_marker("obstacles", WORLD_FRAME, mesh.vertices[mesh.triangles], mesh.colour))
    if arm is not None:
        at = joint_poses(source["q"], arm)
        frames |= {links[j]: at[:, j] for j in range(1, arm.n + 1)}
        for mesh in link_meshes(arm):
            markers.append(_marker("arm", links[mesh.joint], mesh.vertices[mesh.triangles], mesh.colour))
    for number, marker in enumerate(markers):
        marker["id"] = number

    def rows() -> Iterator[Row]:
        yield "/salver/verdict", "std_msgs/msg/String", 0, {"data": plan_verdict(directory, stem)}
        yield "/salver/markers", "visualization_msgs/msg/MarkerArray", 0, {"markers": markers}
        for k, now in enumerate(ns.tolist()):
            if arm is not None:
                state = {key: source[name][k] for key, name in JOINTS.items() if np.size(source.get(name, ()))}
                named = {"header": header_of(now), "name": list(arm.joint_names), **state}
                yield "/joint_states", "sensor_msgs/msg/JointState", now, named
            moved = [_transform(now, name, at[k]) for name, at in frames.items()]
            yield "/tf", "tf2_msgs/msg/TFMessage", now, {"transforms": moved}

    with writing(path), tempfile.TemporaryDirectory(dir=path.parent, prefix=f".{path.name}.") as folder:
        bag = Path(folder) / "bag"
        write_rows(bag, rows())
        put_in_place(next(bag.glob("*.mcap")), path, keep=True)
    return path


JOINTS = {"position": "q", "velocity": "dq", "effort": "tau"}


def _transform(ns: int, child: str, pose: Array) -> dict[str, Any]:
    """pose (7,): position and quaternion w, x, y, z, in S."""
    place = dict(zip("xyz", pose[:3].tolist(), strict=True))
    turn = dict(zip("wxyz", pose[3:].tolist(), strict=True))
    transform = {"translation": place, "rotation": turn}
    return {"header": header_of(ns), "child_frame_id": child, "transform": transform}


def _marker(group: str, frame: str, triangles: Array, colour: Any) -> dict[str, Any]:
    """triangles (k, 3, 3): corners in the frame, m."""
    return {
        "header": header_of(0, frame),
        "ns": group,
        "type": TRIANGLE_LIST,
        "pose": {"orientation": {"w": 1.0}},
        "scale": dict.fromkeys("xyz", 1.0),
        "color": {**dict(zip("rgb", map(float, colour), strict=True)), "a": 1.0},
        "frame_locked": True,
        "points": [dict(zip("xyz", point, strict=True)) for point in triangles.reshape(-1, 3).tolist()],
    }


def _tray(tray: Any) -> Array:
    corners = [shapes.box(size).bounding_points_G + centre for centre, size in tray.boxes]
    return np.concatenate([points[hulls.triangles(points)] for points in corners])


def _body(body: Body) -> Array:
    surface = body.solid.surface
    if surface is None:
        return np.asarray(body.points_B[hulls.triangles(body.points_B)])
    return np.asarray((surface[0] - body.com_G)[surface[1]])
