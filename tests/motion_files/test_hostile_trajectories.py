"""Trajectories that no arm made: damaged, empty, endless. Each is read or refused with one sentence, soon."""

import json
import time

import numpy as np
import pytest
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from salver.errors import FileFormatError
from salver.motion_files.readers import read

STORE = get_typestore(Stores.ROS2_HUMBLE)


def point(k, **more):
    return {"positions": [0.1 * k, 0.2], "time_from_start": {"sec": k, "nanosec": 0}, **more}


def trajectory(**more):
    return {"joint_names": ["a", "b"], "points": [point(k) for k in range(10)], **more}


def test_fields_that_are_null_are_not_there(tmp_path):
    """As a script writes what it does not know."""
    path = tmp_path / "t.json"
    points = [point(k, velocities=None, accelerations=None) for k in range(10)]
    path.write_text(json.dumps(trajectory(points=points)))
    samples = read(path)
    assert samples.dq is None
    assert samples.ddq is None
    assert samples.q[3] == pytest.approx([0.3, 0.2])


@pytest.mark.parametrize(
    ("message", "words"),
    [
        (trajectory(joint_names=None), "needs a list of joint_names"),
        (trajectory(joint_names="ab"), "needs a list of joint_names"),
        (trajectory(joint_names=[["a"], ["b"]]), "which are text"),
        (trajectory(joint_names=["a", "a"]), "names a joint twice"),
        (trajectory(points={"a": 1}), "needs a list"),
        (trajectory(points=None), "needs a list"),
        (trajectory(points=[]), "2 joint names and 0 points"),
        (trajectory(points=[None] * 10), "has no time_from_start"),
        (trajectory(points=[1] * 10), "has no time_from_start"),
        (trajectory(points=[{"time_from_start": 10**400}] * 10), "has no time_from_start"),
        (trajectory(points=[point(k, positions=None) for k in range(10)]), "point 1 has no positions"),
        (trajectory(points=[point(k, positions=3) for k in range(10)]), "positions that are not a list"),
        (trajectory(points=[point(k, positions="ab") for k in range(10)]), "positions that are not a list"),
        (trajectory(points=[point(k, positions=[[1, 2], [3, 4]]) for k in range(10)]), "positions must be numbers"),
        (trajectory(points=[point(k, positions=[{}, 1]) for k in range(10)]), "positions must be numbers"),
        (trajectory(points=[point(k, positions=[10**400, 1]) for k in range(10)]), "positions must be numbers"),
        (trajectory(points=[point(k, velocities=[1]) for k in range(10)]), "has 1 velocities; there are 2 joints"),
        (trajectory(points=[point(k, positions=[float("nan"), 1]) for k in range(10)]), "is not a finite number"),
    ],
)
def test_a_message_that_is_none_is_one_sentence(tmp_path, message, words):
    path = tmp_path / "t.json"
    path.write_text(json.dumps(message))
    with pytest.raises(FileFormatError, match=words):
        read(path)


@pytest.mark.slow
@pytest.mark.parametrize(
    "text",
    [
        "a: &a [x, x]\nb: &b [*a, *a]\njoint_names: *b\npoints: []",
        "a: &a {x: 1}\nb: &b {<<: [*a, *a]}\nc: {<<: [*b, *b]}",
        "&a [*a]",
        "&a {joint_names: *a, points: *a}",
        "[" * 5_000,
        "a: 2000-99-99",
        "a: " + "9" * 10_000,
        "? [a]\n: b",
        "!!python/object/apply:os.system [true]",
        "a: !!float x",
        "\x00",
        "%YAML 9.9\n--- a",
    ],
)
def test_yaml_that_unfolds_or_breaks_is_one_sentence(tmp_path, text):
    path = tmp_path / "t.yaml"
    path.write_text(text)
    began = time.process_time()
    with pytest.raises(FileFormatError, match=r"t\.yaml"):
        read(path)
    assert time.process_time() - began < 10


def test_aliases_that_unfold_without_end_are_refused_at_the_first(tmp_path):
    path = tmp_path / "t.yaml"
    lines = ["a0: &a0 [x, x]"] + [f"a{k}: &a{k} [{', '.join([f'*a{k - 1}'] * 9)}]" for k in range(1, 12)]
    path.write_text("\n".join([*lines, "joint_names: *a11", "points: *a11"]))
    with pytest.raises(FileFormatError, match=r"the alias \*a0, which messages do not have at line 2"):
        read(path)


def test_a_star_in_a_comment_or_in_a_text_is_no_alias(tmp_path):
    path = tmp_path / "t.yaml"
    points = [{"time_from_start": 0.1 * k, "positions": [0.01 * k]} for k in range(12)]
    path.write_text(f"# from *home* to: *goal*\nnote: 'see *all'\njoint_names: [j1]\npoints: {points}\n")
    assert len(read(path).t) == 12


@pytest.mark.parametrize(("name", "size"), [("t.yaml", 5), ("t.json", 100), ("t.csv", 500), ("t.mcap", 2000)])
def test_files_beyond_what_is_read_are_refused_unread(tmp_path, name, size):
    path = tmp_path / name
    with open(path, "wb") as file:
        file.truncate(size * 1_000_000 + 1)  # sparse
    with pytest.raises(FileFormatError, match=f"is larger than {size} MB"):
        read(path)


def bag(path, kind, messages):
    with Writer(path, version=8, storage_plugin=StoragePlugin.MCAP) as writer:
        connection = writer.add_connection("/joint_states", kind, typestore=STORE)
        for k, message in enumerate(messages):
            writer.write(connection, k * 10_000_000, STORE.serialize_cdr(message, kind))
    return path


def joint_state(k, names=("a", "b"), position=(0.0, 1.0)):
    make = STORE.types
    stamp = make["builtin_interfaces/msg/Time"](sec=k // 100, nanosec=k % 100 * 10_000_000)
    none = np.zeros(0)
    return make["sensor_msgs/msg/JointState"](
        header=make["std_msgs/msg/Header"](stamp=stamp, frame_id=""),
        name=list(names),
        position=np.array(position, dtype=float) + 0.01 * k,
        velocity=none,
        effort=none,
    )


@pytest.mark.parametrize(
    ("names", "position", "words"),
    [
        ((), (), "a JointState needs names, each once; the first has none"),
        (("a", "a"), (0.0, 0.0), "a JointState needs names, each once; the first has a, a"),
        (("a", "b"), (), "has not one position for each of its 2 names"),
        (("a", "b"), (0.0,), "has not one position for each of its 2 names"),
    ],
)
def test_an_empty_joint_state_is_one_sentence(tmp_path, names, position, words):
    path = bag(tmp_path / "bag", "sensor_msgs/msg/JointState", [joint_state(k, names, position) for k in range(20)])
    with pytest.raises(FileFormatError, match=words):
        read(path)


def test_positions_of_unequal_length_are_one_sentence(tmp_path):
    messages = [joint_state(k, position=(0.0, 1.0)[: 1 + k % 2]) for k in range(20)]
    with pytest.raises(FileFormatError, match="has not one position for each"):
        read(bag(tmp_path / "bag", "sensor_msgs/msg/JointState", messages))


@pytest.mark.slow
def test_a_bag_with_flipped_bytes_is_read_or_one_sentence(tmp_path):
    path = bag(tmp_path / "bag", "sensor_msgs/msg/JointState", [joint_state(k) for k in range(40)])
    whole = read(path)
    assert len(whole.t) == 40
    (file,) = path.glob("*.mcap")
    content, rng = file.read_bytes(), np.random.default_rng(0)
    refused = 0
    for _ in range(60):
        damaged = bytearray(content)
        for at in rng.integers(len(content), size=rng.integers(1, 4)):
            damaged[at] ^= 1 << rng.integers(8)
        file.write_bytes(bytes(damaged))
        try:
            samples = read(path)
            assert np.isfinite(samples.q).all()
        except FileFormatError:
            refused += 1
    assert refused > 5


def test_a_path_that_no_file_has_is_one_sentence():
    for path in ("a\x00.csv", "x" * 5000 + ".csv"):
        with pytest.raises(FileFormatError, match="does not exist"):
            read(path)
