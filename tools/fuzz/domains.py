"""What is fuzzed: for each domain a function that makes an input from a random generator and gives it to salver.

It ends quietly when the input was accepted and what came of it is right, with a SalverError when it was refused, and
with an AssertionError when what was accepted is wrong.
"""

from __future__ import annotations

import json
import shutil
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import tomli_w
from mutate import VALUES, Rng, damaged_bytes, damaged_tree, damaged_xml

from salver import scenario as scenarios
from salver.errors import FileFormatError

URDF = """<robot name="r"><link name="base"/>{links}{joints}</robot>"""
LINK = """<link name="l{k}"><inertial><origin xyz="0 0 0.1"/><mass value="{m}"/>
<inertia ixx="1e-2" ixy="0" ixz="0" iyy="1e-2" iyz="0" izz="1e-2"/></inertial>
<collision><geometry><box size="0.05 0.05 0.2"/></geometry></collision></link>"""
JOINT = """<joint name="j{k}" type="{kind}"><parent link="{parent}"/><child link="l{k}"/><origin xyz="0 0 0.2"/>
<axis xyz="{axis}"/><limit lower="-2" upper="2" effort="80" velocity="2"/></joint>"""


@cache
def ready_made() -> list[dict[str, Any]]:
    return [scenarios.load(name).model_dump(mode="json", exclude_none=True) for name in scenarios.names()]


def toml_ready(data: Any) -> Any:
    """What TOML can say: nothing is left out, what is too large is text."""
    if isinstance(data, dict):
        return {str(key): toml_ready(value) for key, value in data.items() if value is not None}
    if isinstance(data, list):
        return [toml_ready(value) for value in data if value is not None]
    return data


def scenario(rng: Rng, folder: Path) -> None:
    """A scenario file; of what is accepted the straight line is checked, without the arm."""
    from salver.planning.make import plan_baseline, plan_object

    base = ready_made()[rng.integers(len(ready_made()))]
    text = tomli_w.dumps(toml_ready(damaged_tree(rng, base))).encode()
    path = folder / "case.toml"
    path.write_bytes(damaged_bytes(rng, text) if rng.random() < 0.15 else text)
    case = scenarios.load(path)
    assert scenarios.parse(case.model_dump(mode="json", exclude_none=True), "again").digest == case.digest
    if case.motion.duration is None or rng.random() < 0.5:
        return
    plan = (plan_object if rng.random() < 0.3 else plan_baseline)(case)
    check_plan(plan)


def check_plan(plan: Any) -> None:
    """What a plan says of itself against arrays that say it too."""
    arrays = plan.arrays()
    for name, values in arrays.items():
        assert values.dtype.kind not in "fc" or np.isfinite(values).all(), f"{name} is not finite"
    if plan.ok:
        needed = max(float(m.friction_needed.max() - m.friction) for m in plan.margins.interfaces)
        assert needed <= 1e-9, f"ok, and {needed} more friction needed than there is"
        assert min(float(m.tip_over.min()) for m in plan.margins.interfaces) >= -1e-9, "ok, and tips over"


def small_urdf(rng: Rng) -> str:
    n = int(rng.integers(1, 8))
    kinds = ("revolute", "revolute", "continuous", "prismatic", "fixed")
    links = "".join(LINK.format(k=k, m=rng.uniform(0.2, 3)) for k in range(n))
    joints = "".join(
        JOINT.format(
            k=k,
            kind=kinds[rng.integers(len(kinds))],
            parent=f"l{k - 1}" if k else "base",
            axis=("1 0 0", "0 1 0", "0 0 1")[rng.integers(3)],
        )
        for k in range(n)
    )
    return URDF.format(links=links, joints=joints)


def urdf(rng: Rng, folder: Path) -> None:
    """An arm: of what is accepted mass matrix and pose are finite, the matrix symmetric and not negative."""
    from salver.models.arm.arm import load_arm
    from salver.models.arm.arm_geometry import arm_geometry

    path = folder / "case.urdf"
    path.write_bytes(damaged_xml(rng, small_urdf(rng)))
    arm = load_arm(scenarios.Arm(model=str(path), flange=f"l{rng.integers(3)}"), scenarios.Tray())
    assert 1 <= arm.n <= 20
    q = np.clip(np.zeros(arm.n), arm.limits.q_min, arm.limits.q_max)
    mass = arm.mass_matrix(q)
    assert np.isfinite(mass).all(), "a mass matrix that is not finite"
    assert np.linalg.eigvalsh(mass)[0] >= -1e-9 * np.abs(mass).max(), "a mass matrix with a negative eigenvalue"
    assert all(np.isfinite(x).all() for x in arm.tray_pose(q))
    if rng.random() < 0.3:
        arm_geometry(arm)


@cache
def finished_run() -> dict[str, bytes]:
    """The files of a run directory with a simulation and a campaign, made once."""
    import tempfile

    from salver.campaigns import run_campaign
    from salver.planning.make import plan_baseline
    from salver.simulation.physics import simulate

    case = scenarios.load("slippery-cube").with_changes(arm=None, motion__nodes=21, motion__degree=7)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        plan = plan_baseline(case)
        plan.save(folder)
        plan.save(folder, "baseline")
        simulate(plan).save(folder)
        run_campaign(folder, n=4, jobs=1)
        return {str(p.relative_to(folder)): p.read_bytes() for p in folder.rglob("*") if p.is_file()}


def unpacked(folder: Path) -> Path:
    for name, content in finished_run().items():
        path = folder / "run" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(content)
    return folder / "run"


def run_directory(rng: Rng, folder: Path) -> None:
    """A run directory with a damaged, missing or swapped file, given to what reads it.

    What is accepted is what was written: damage that does not change the content (a blank in JSON) is none.
    """
    from salver.campaigns import parameters_of_run
    from salver.export import write_export
    from salver.files import load_npz
    from salver.planning.plan import load_plan
    from salver.reports.pages.page import write_report
    from salver.simulation.record import load_record

    run = unpacked(folder)
    files = sorted(p for p in run.rglob("*") if p.is_file() and p.name != "lock")
    for _ in range(rng.integers(1, 3)):
        path, other = files[rng.integers(len(files))], files[rng.integers(len(files))]
        kind = rng.integers(6)
        if kind == 0:
            path.unlink(missing_ok=True)
        elif kind == 1 and other.exists():
            shutil.copy(other, path) if other != path else None
        elif kind <= 3 and path.suffix == ".json" and path.exists():
            path.write_text(json.dumps(damaged_tree(rng, json.loads(finished_run()[str(path.relative_to(run))]))))
        elif path.exists():
            path.write_bytes(damaged_bytes(rng, path.read_bytes()))
    kind = rng.integers(5)
    if kind == 0:
        load_plan(run)
    elif kind == 1:
        load_record(run)
    elif kind == 2:
        page = write_report(run).read_text(encoding="utf-8")
        assert page.count("<script") == 2, "a script of somebody else"
    elif kind == 3:
        write_export(run, ("csv", "json", "yaml")[rng.integers(3)], unsafe=True)
    else:
        parameters_of_run(run, int(rng.integers(-1, 6)))
    if kind in (0, 2, 3):
        before = finished_run()["plan.npz"]
        (folder / "before.npz").write_bytes(before)
        old, new = load_npz(folder / "before.npz"), load_npz(run / "plan.npz")
        assert old.keys() == new.keys(), "accepted a plan that was edited"
        assert all(np.array_equal(old[k], new[k], equal_nan=old[k].dtype.kind == "f") for k in old), (
            "edited and accepted"
        )


def trajectory(rng: Rng, folder: Path) -> None:
    """Motions from elsewhere in every format: what is read is finite and runs forwards."""
    from salver.motion_files import read_path
    from salver.motion_files.readers import read

    count, n = int(rng.integers(0, 40)), int(rng.integers(1, 8))
    t = np.cumsum(rng.uniform(0.001, 0.1, count))
    q = rng.normal(size=(count, n)).cumsum(axis=0) * 0.01
    kind = rng.integers(6)
    if kind == 0:
        header = ["t", *(f"q{k + 1}" for k in range(n))]
        rows = [[repr(float(x)) for x in row] for row in np.column_stack([t, q])] if count else []
        text, path = "\n".join(",".join(row) for row in [header, *rows]), folder / "case.csv"
        path.write_bytes(damaged_bytes(rng, text.encode()))
    elif kind == 1:
        quat = np.tile([1.0, 0, 0, 0], (count, 1))
        rows = np.column_stack([t, rng.normal(size=(count, 3)), quat]) if count else np.zeros((0, 8))
        header = ["t", "x", "y", "z", "qw", "qx", "qy", "qz"]
        text = "\n".join([",".join(header), *(",".join(map(repr, row.tolist())) for row in rows)])
        path = folder / "case.txt"
        path.write_bytes(damaged_bytes(rng, text.encode()))
    elif kind <= 3:
        message = {
            "joint_names": [f"j{k}" for k in range(n)],
            "points": [
                {
                    "positions": row.tolist(),
                    "velocities": None,
                    "time_from_start": {"sec": int(x), "nanosec": int(x % 1 * 1e9)},
                }
                for x, row in zip(t, q, strict=True)
            ],
        }
        message = damaged_tree(rng, message)
        text = json.dumps(message)
        if rng.random() < 0.3:
            text = damaged_bytes(rng, text.encode()).decode("utf-8", "replace")
        path = folder / ("case.json" if kind == 2 else "case.yaml")  # JSON is YAML
        path.write_text(text, encoding="utf-8", errors="replace")
    elif kind == 4:
        path = folder / "case.csv"
        path.write_bytes(damaged_bytes(rng, "\n".join(",".join(map(repr, row)) for row in q.tolist()).encode()))
        points = read_path(path, tuple(f"j{k}" for k in range(n)))
        assert points.ndim <= 2
        return
    else:
        path = damaged_bag(rng, folder)
    samples = read(path)
    for name, values in vars(samples).items():
        if isinstance(values, np.ndarray):
            assert np.isfinite(values).all(), f"{name} is not finite"
    assert (np.diff(samples.t) > 0).all(), "time does not run forwards"


@cache
def bag() -> bytes:
    import tempfile

    from rosbags.rosbag2 import StoragePlugin, Writer
    from rosbags.typesys import Stores, get_typestore

    store, kind = get_typestore(Stores.ROS2_HUMBLE), "sensor_msgs/msg/JointState"
    make = store.types
    with tempfile.TemporaryDirectory() as name:
        path = Path(name) / "bag"
        with Writer(path, version=8, storage_plugin=StoragePlugin.MCAP) as writer:
            connection = writer.add_connection("/joint_states", kind, typestore=store)
            for k in range(20):
                stamp = make["builtin_interfaces/msg/Time"](sec=k // 100, nanosec=k % 100 * 10_000_000)
                message = make[kind](
                    header=make["std_msgs/msg/Header"](stamp=stamp, frame_id=""),
                    name=["a", "b"],
                    position=np.array([0.01 * k, 0.0]),
                    velocity=np.zeros(0),
                    effort=np.zeros(0),
                )
                writer.write(connection, k * 10_000_000, store.serialize_cdr(message, kind))
        return next(path.glob("*.mcap")).read_bytes()


def damaged_bag(rng: Rng, folder: Path) -> Path:
    path = folder / "case.mcap"
    path.write_bytes(damaged_bytes(rng, bag()))
    return path


def journal(rng: Rng, folder: Path) -> None:
    """A damaged journal: what is left are records that were written, and never another one."""
    from salver.campaigns.journal import Journal

    content = finished_run()["campaign/journal.jsonl"]
    written = [json.loads(line) for line in content.splitlines()]
    for record in written:
        record.pop("check")
    lines = content.splitlines(keepends=True)
    if rng.random() < 0.3:
        rng.shuffle(lines)
    if rng.random() < 0.3:
        k = int(rng.integers(len(lines)))
        lines[k] = json.dumps(damaged_tree(rng, json.loads(lines[k]))).encode() + b"\n"
    damaged = b"".join(lines)
    if rng.random() < 0.8:
        damaged = damaged_bytes(rng, damaged)
    (folder / "journal.jsonl").write_bytes(damaged)
    with Journal(folder) as opened:
        assert all(record in written for record in opened.records.values()), "a record that nobody wrote"
        left = len(opened.records)
        opened.append(written[0])
    with Journal(folder) as again:
        assert len(again.records) in (left, left + 1), "records were lost"


def command(rng: Rng, folder: Path) -> None:
    """A command line with a strange option: an exit code that is foreseen, one sentence, nothing damaged."""
    from typer.testing import CliRunner

    from salver.cli import app

    run = unpacked(folder)

    def strange() -> str:
        value = VALUES[rng.integers(len(VALUES))](rng)
        return str(value).replace("\x00", "")[:200]

    lines = (
        ["export", run, "--format", "csv", "--rate", strange()],
        ["export", run, "--format", strange()],
        ["export", run, "--format", "yaml", "--plan", strange()],
        ["export", run, "--format", "csv", "-o", run / strange()],
        ["report", run, "-o", folder / strange()],
        ["report", run / strange()],
        ["simulate", run, "--set", f"friction={strange()}"],
        ["simulate", run, "--set", strange()],
        ["simulate", run, "--run", strange(), "--folder", strange()],
        ["campaign", run, "-n", strange(), "-j", "1", "--folder", "other"],
        ["campaign", run, "-n", "2", "-j", "1", "--folder", strange()],
        ["campaign", run, "-n", "2", "-j", "1", "--seed", strange(), "--folder", "other"],
        ["plan", "slippery-cube", "--no-arm", "--duration", strange(), "-o", folder / "made"],
        ["retime", run, "-s", strange()],
        ["render", run, "--rate", strange(), "-o", folder / "x.gif"],
        ["audit", folder / strange(), "-s", "panda-cube"],
    )
    before = {p: p.read_bytes() for p in run.rglob("*") if p.is_file() and "simulation" not in p.parts}
    arguments = [str(word) for word in lines[rng.integers(len(lines))]]
    done = CliRunner().invoke(app, arguments)
    (folder / "command.json").write_text(json.dumps(arguments))
    if done.exit_code not in (0, 1, 2, 3):
        raise RuntimeError(f"exit code {done.exit_code}: {done.stderr[-2000:]}") from done.exception
    assert all(path.read_bytes() == content for path, content in before.items()), "a file of the run was changed"
    if done.exit_code == 2:
        raise FileFormatError(done.stderr.strip()[:500] or "no words")


DOMAINS = {
    "scenario": scenario,
    "urdf": urdf,
    "run-directory": run_directory,
    "trajectory": trajectory,
    "journal": journal,
    "command": command,
}
