"""One family of motion files: what is written is read again, in every format, by every command that takes one."""

import json

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from ruamel.yaml import YAML
from typer.testing import CliRunner

import salver as sv
from recorded_motions import series_of
from salver import scenario as scenarios
from salver.cli import app
from salver.errors import FileFormatError, SalverError
from salver.given import read_waypoints
from salver.motion_files import (
    ENDINGS,
    JointSamples,
    MotionSeries,
    TraySamples,
    form_of,
    of_columns,
    read,
    read_path,
    write,
)
from salver.motion_files.readers import read_table
from salver.motion_files.samples import tray_samples
from salver.motion_files.units import Units

JOINTS = tuple(f"panda_joint{k}" for k in range(1, 8))
FORMS = tuple(ENDINGS)


def named(form, folder):
    return folder / f"motion{(ENDINGS[form] or ('',))[0]}"


def swing(duration=2.0, rate=200.0, reach=0.3):
    """A pose from rest to rest along y by a quintic, the tray level."""
    t = np.arange(round(duration * rate) + 1) / rate
    s = t / duration
    p = np.tile([0.45, 0.0, 0.4], (len(t), 1))
    p[:, 1] = reach * s**3 * (10 - 15 * s + 6 * s**2)
    return tray_samples(t, p, np.tile([1.0, 0, 0, 0], (len(t), 1)), "swing")


def joint_swing(count=60, duration=2.0):
    s = np.linspace(0, 1, count)[:, None]
    q0, q1 = np.array([0.08, 1.04, -0.78, -1.68, -2.2, 0.84, 1.12]), np.array([0.3, 1.1, -0.85, -1.8, -2.0, 0.82, 1.2])
    shape = [s**3 * (10 - 15 * s + 6 * s**2), 30 * s**2 * (1 - s) ** 2, 60 * s * (1 - s) * (1 - 2 * s)]
    q, dq, ddq = (x * (q1 - q0) / duration**k for k, x in enumerate(shape))
    return JointSamples(duration * s[:, 0], JOINTS, q + q0, dq, ddq, "swing", commanded=True)


@pytest.mark.slow
@settings(max_examples=15, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data(), form=st.sampled_from(FORMS))
def test_joints_come_back_to_the_last_digit(tmp_path_factory, data, form):
    n, count = data.draw(st.integers(1, 7)), data.draw(st.integers(8, 12))
    number = st.floats(-1e3, 1e3, allow_nan=False).filter(lambda x: x == 0 or abs(x) > 1e-300)
    q, dq, ddq = (data.draw(arrays(float, (count, n), elements=number)) for _ in range(3))
    steps = data.draw(arrays(np.int64, count - 1, elements=st.integers(20_000, 2_000_000_000)))
    ns = np.concatenate([[0], np.cumsum(steps)])
    path = named(form, tmp_path_factory.mktemp("joints"))
    write(MotionSeries(ns, JOINTS[:n], q, dq, ddq), path, form)
    again = read(path, lambda: JOINTS[:n])
    assert again.names == JOINTS[:n]
    assert np.allclose(again.t, ns * 1e-9, rtol=0, atol=1e-12 + 1e-15 * ns[-1])
    for mine, theirs in ((q, again.q), *(((dq, again.dq), (ddq, again.ddq)) if form != "csv" else ())):
        assert np.array_equal(mine, theirs)
    assert again.form == (form if form in ("csv", "ros2") else "message")
    assert again.commanded == (form != "csv")  # a table may be a recording; a trajectory is a command


@pytest.mark.parametrize("form", [form for form in FORMS if form != "moveit"])
def test_poses_come_back_to_the_last_digit(tmp_path, form):
    rng = np.random.default_rng(5)
    quat = rng.normal(size=4) + 0.05 * rng.normal(size=(20, 4)).cumsum(axis=0)
    samples = tray_samples(np.arange(20) * 0.01, rng.normal(size=(20, 3)), quat / np.linalg.norm(quat, axis=1)[:, None],
                           "made")  # fmt: skip
    path = named(form, tmp_path)
    write(series_of(samples), path, form)
    again = read(path)
    assert isinstance(again, TraySamples)
    assert np.array_equal(again.p, samples.p)
    assert np.allclose(again.quat_wxyz, samples.quat_wxyz, rtol=0, atol=1e-15)


def test_a_tray_is_no_joint_trajectory(tmp_path):
    with pytest.raises(SalverError, match="without joints"):
        write(series_of(swing()), tmp_path / "motion.yaml", "moveit")


def test_moveit_reads_what_is_written_as_robot_trajectory(tmp_path):
    """The members of moveit_msgs/RobotTrajectory, by their names and in their order."""
    (path,) = write(series_of(joint_swing()), tmp_path / "a.yaml", "moveit")
    message = YAML(typ="safe").load(path)
    assert list(message) == ["joint_trajectory", "multi_dof_joint_trajectory"]
    assert list(message["joint_trajectory"]) == ["header", "joint_names", "points"]
    assert list(message["joint_trajectory"]["points"][0]) == [
        "positions", "velocities", "accelerations", "effort", "time_from_start",
    ]  # fmt: skip
    assert message["multi_dof_joint_trajectory"]["points"] == []


@pytest.mark.parametrize(("name", "form"), [("a.csv", "csv"), ("a.TXT", "csv"), ("a.yml", "yaml"), ("bag", "ros2")])
def test_the_ending_says_the_format(name, form):
    assert form_of(name) == form


def test_no_other_ending_is_written(tmp_path):
    with pytest.raises(SalverError, match=r"must end in \.csv, \.yaml"):
        write(series_of(swing()), tmp_path / "a.xlsx")


@pytest.mark.slow
def test_columns_of_a_mapping_and_of_a_frame_are_those_of_a_file(tmp_path):
    import pandas

    (path,) = write(series_of(swing()), tmp_path / "a.csv")
    frame = pandas.read_csv(path)
    for columns in (frame, frame.set_index("t"), {name: frame[name].to_numpy() for name in frame}):
        again = of_columns(columns)
        assert np.array_equal(again.p, swing().p)
        assert np.allclose(again.t, swing().t, rtol=0, atol=1e-12)
    with pytest.raises(FileFormatError, match="columns of numbers of one length"):
        of_columns({"t": [0, 1], "x": [1, 2, 3]})


def test_a_file_of_tray_and_joints_is_the_trays_for_an_audit_and_the_joints_for_a_path(tmp_path):
    joints, tray = joint_swing(), swing(rate=59 / 2)
    both = MotionSeries(series_of(joints).ns, JOINTS, joints.q, p_SE=tray.p, quat_SE_wxyz=tray.quat_wxyz)
    (path,) = write(both, tmp_path / "both.csv")
    assert isinstance(read(path, lambda: JOINTS), TraySamples)
    assert np.array_equal(read_path(path, JOINTS), joints.q)


@pytest.mark.slow
def test_simulate_takes_a_file_and_the_engine_agrees_with_the_audit(tmp_path):
    """Half of what friction gives holds, one and a half times as much slides (and twice as much would tip a cube)."""
    path = tmp_path / "motion.csv"
    peak = 10 * 0.3 / np.sqrt(3)  # of a motion of 1 s
    for share, outcome in ((0.5, "holds"), (1.5, "slides")):
        samples = swing(float(np.sqrt(peak / (share * 0.5 * 9.81))), 500.0)
        write(series_of(samples), path)
        done = CliRunner().invoke(app, ["simulate", str(path), "-s", "panda-cube", "--json"])
        assert done.exit_code == 0, done.output
        assert json.loads(done.stdout)["outcome"] == outcome
        assert (sv.audit(path, "panda-cube").outcome == "holds") == (outcome == "holds")


@pytest.mark.slow
@pytest.mark.parametrize("accelerations", [True, False])
def test_a_command_to_the_joints_moves_the_tray_as_forward_kinematics_says(tmp_path, accelerations):
    """Both sides of every waypoint are instants of a command: no curve may be led through both."""
    from dataclasses import replace

    from salver.models.arm.arm import load_arm

    scenario = sv.load_scenario("panda-cube")
    samples = joint_swing(60) if accelerations else replace(joint_swing(60), ddq=None)
    (path,) = write(series_of(samples), tmp_path / "motion.yaml")
    record = sv.simulate(path, scenario)
    arm = load_arm(scenario.arm, scenario.tray)
    for k in (0, 20, 41, 59):
        at = int(np.argmin(np.abs(record.t - samples.t[k])))
        q = np.array([np.interp(record.t[at], samples.t, column) for column in samples.q.T])
        assert np.allclose(record.p_SE[at], arm.tray_pose(q)[0], atol=2e-4)  # straight lines between waypoints
    assert record.outcome == "holds"


def test_a_file_that_begins_at_speed_is_not_run(tmp_path):
    samples = swing(1.0, 500.0)
    half = tray_samples(samples.t[250:] - samples.t[250], samples.p[250:], samples.quat_wxyz[250:], "half")
    (path,) = write(series_of(half), tmp_path / "half.csv")
    with pytest.raises(SalverError, match=r"begins at 0\.56 m/s; a run in the engine begins at rest"):
        sv.simulate(path, "panda-cube")


@pytest.mark.slow
@pytest.mark.parametrize("form", ["moveit"])
def test_retime_reads_a_motion_file(tmp_path, form):
    path = named(form, tmp_path)
    write(series_of(joint_swing(30)), path, form)
    target = tmp_path / "retimed.yaml"
    for words in (["retime", path, "-s", "panda-cube", "-o"], ["export", "--format", form, "-o", target]):
        done = CliRunner().invoke(app, [*map(str, words), str(tmp_path / "run")])
        assert done.exit_code == 0, done.output
    plan, again = sv.load_plan(tmp_path / "run"), read(target)
    assert again.t[-1] == pytest.approx(plan.duration, abs=1e-9)
    assert plan.duration < 2.0
    assert np.allclose(again.q[[0, -1]], joint_swing(30).q[[0, -1]], atol=1e-9)


@pytest.fixture(scope="module")
def plan_in_every_form(tmp_path_factory):
    """(plan, folder, form -> file) of a plan of 1.5 s, as `salver export` writes it at 70 samples a second."""
    folder = tmp_path_factory.mktemp("matrix")
    plan = sv.plan(sv.load_scenario("panda-cube").with_changes(motion__duration=1.5), method="baseline")
    plan.save(folder / "run")
    files = {}
    for form in FORMS:
        files[form] = folder / f"plan-{form}{(ENDINGS[form] or ('',))[0]}"
        typed("export", folder / "run", "--format", form, "-o", files[form], "--rate", 70)
    files["message"] = folder / "message.json"  # MoveIt's message as JSON
    files["message"].write_text(json.dumps(YAML(typ="safe", pure=True).load(files["moveit"])))
    return plan, folder, files


def typed(*words):
    """What a command prints, which must end with 0."""
    done = CliRunner().invoke(app, [str(word) for word in words])
    assert done.exit_code == 0, done.output
    return done.stdout


@pytest.mark.slow
@pytest.mark.parametrize("form", [*FORMS, "message"])
def test_every_command_takes_and_writes_a_plan_in_every_form(plan_in_every_form, tmp_path, form):
    """audit, simulate, retime, report: a real plan's file in, files out that say the same motion."""
    plan, _, files = plan_in_every_form
    path, at, slow = files[form], ("-s", "panda-cube"), ("--highest", 20)  # Hz, which 70 samples a second show
    t = np.round(np.arange(106) / 70 * 1e9) * 1e-9  # whole nanoseconds
    planned = plan.joint.sample(t)[0]
    typed("audit", path, *at, *slow)  # exit 0: holds in the worst case
    again = read(path, lambda: JOINTS, as_path=True)
    assert again.names == JOINTS
    assert np.allclose(again.t, t, rtol=0, atol=1e-12)
    assert np.allclose(again.q, planned, rtol=0, atol=1e-12)
    if form != "csv":  # a table is a recording
        for mine, theirs in zip(plan.joint.sample(t)[1:], (again.dq, again.ddq), strict=True):
            assert np.allclose(mine, theirs, rtol=0, atol=1e-12)
    ran = tmp_path / f"ran{'.csv' if form == 'message' else path.suffix}"
    assert json.loads(typed("simulate", path, *at, "--write", ran, "--json"))["outcome"] == "holds"
    record = read(ran)
    ends = plan.reference.sample(np.array([0.0, plan.duration])).p_SB
    assert np.allclose(np.ptp(record.p, axis=0), np.abs(ends[1] - ends[0]), atol=1e-3)
    if form not in ("csv", "ros2"):  # a table, a bag; each other one: above
        return
    typed("retime", path, *at, "-o", tmp_path / "run")
    fast = sv.load_plan(tmp_path / "run").joint
    assert fast.t[-1] < 1.5
    assert np.allclose(fast.q[[0, -1]], planned[[0, -1]], atol=1e-6)
    typed("report", path, *at, *slow, "-o", tmp_path / "page.html")
    assert (tmp_path / "page.html").stat().st_size > 50_000


@pytest.mark.slow
def test_what_a_run_did_is_a_recording_without_velocities(tmp_path):
    """The tray of the record moves as the file says, to the last digit; nobody takes it for a command."""
    (path,) = write(series_of(swing()), tmp_path / "a.csv")
    typed("simulate", path, "-s", "panda-cube", "--write", tmp_path / "ran.csv")
    ran = read(tmp_path / "ran.csv")
    assert isinstance(ran, TraySamples)
    assert ran.t[0] == 0
    assert np.ptp(ran.p[:, 1]) == pytest.approx(0.3, abs=1e-6)
    record = sv.simulate(path, "panda-cube")
    assert np.array_equal(record.motion().p_SE, record.p_SE)
    assert record.motion().dq is None
    assert record.motion().ns[0] == 0


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (["export", "a.csv", "--format", "yaml"], "a.csv is not a run directory: it is a file"),
        (["simulate", "a.csv", "-s", "panda-cube", "--write", "a.xlsx"], "a.xlsx is not a name for a motion"),
        (["audit", "a.csv", "-s", "panda-cube", "--units", "inch"], '--units "inch" must name at most one of each'),
        (["simulate", ".", "--plan", "both", "--write", "b.csv"], "--write is for one run; name its plan with --plan"),
    ],
)
def test_wrong_use_of_motion_files_is_one_sentence(tmp_path, monkeypatch, words, sentence):
    monkeypatch.chdir(tmp_path)
    write(series_of(swing(rate=20.0)), tmp_path / "a.csv")
    done = CliRunner().invoke(app, words)
    assert done.exit_code == 2
    assert sentence in " ".join(done.output.split())
    assert sorted(file.name for file in tmp_path.iterdir()) == ["a.csv"]


@pytest.mark.slow
def test_every_command_that_reads_a_table_takes_its_units_and_writes_si(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    case = scenarios.load("panda-cube")
    start = np.array(case.arm.start_posture)
    t = np.arange(0, 2.001, 0.01)
    u = t / 2
    q = start + np.outer(10 * u**3 - 15 * u**4 + 6 * u**5, [0.2, 0, 0, 0, 0, 0, 0])
    header = "t;" + ";".join(f"A{k}" for k in range(1, 8))
    np.savetxt("own.csv", np.column_stack([1e3 * t, np.rad2deg(q)]), delimiter=";", header=header, comments="")
    np.savetxt("taught.csv", np.rad2deg(q[::50]), delimiter=";")
    with_units = ["own.csv", "-s", "panda-cube", "--units", "deg,ms"]
    for words in (
        ["simulate", "--write", "done.csv", "--json"],
        ["report", "-o", "page.html"],
        ["audit"],
    ):
        done = CliRunner().invoke(app, [words[0], *with_units, *words[1:]])
        assert done.exit_code == 0, done.output
    assert "Units of the table: deg, ms" in done.output
    units = Units.parse("deg,ms", (0,) * 7)
    assert np.allclose(read(tmp_path / "own.csv", lambda: JOINTS, units=units).q, q, atol=1e-9)
    assert np.ptp(read(tmp_path / "done.csv").t) == pytest.approx(2.0, abs=1.0)
    with pytest.raises(FileFormatError, match=r"taught\.csv has panda_joint\d at .*degrees: give --units deg"):
        read_waypoints(tmp_path / "taught.csv", case)
    assert np.allclose(read_waypoints(tmp_path / "taught.csv", case, units="deg"), q[::50], atol=1e-9)


def test_the_path_of_an_object_is_not_taken_for_the_trays(tmp_path):
    tray = swing()
    both = MotionSeries(
        series_of(tray).ns, p_SE=tray.p, quat_SE_wxyz=tray.quat_wxyz, p_SB=2 * tray.p, quat_SB_wxyz=tray.quat_wxyz
    )
    (path,) = write(both, tmp_path / "both.csv")
    assert np.array_equal(read(path).p, tray.p)
    write(both, tmp_path / "bag")
    assert np.array_equal(read(tmp_path / "bag").p, tray.p)
    (of_tray,) = write(both, tmp_path / "both.yaml")
    assert np.array_equal(read(of_tray).p, tray.p)
    (other,) = write(series_of(tray), tmp_path / "both_object_path.yaml")  # as salver once wrote it
    with pytest.raises(FileFormatError, match="is the path of an object; give that of the tray"):
        read(other)
    alone = {name: column for name, column in zip(*table_of(path), strict=True) if "SE" not in name}
    with pytest.raises(FileFormatError, match=r"is the motion of an object \(p_SB, quat_SB\); give that of the tray"):
        of_columns(alone)


def test_columns_that_name_the_trays_frame_come_before_others():
    tray = swing()
    named = dict(zip("xyz", tray.p.T, strict=True)), dict(zip("wxyz", tray.quat_wxyz.T, strict=True))
    of_tray = {f"p_SE_{x}": y for x, y in named[0].items()} | {f"quat_SE_{x}": y for x, y in named[1].items()}
    other = dict(zip("xyz", 2 * tray.p.T, strict=True))
    for table in ({"t": tray.t, **other, **of_tray}, {"t": tray.t, **of_tray, **other}):
        assert np.array_equal(of_columns(table).p, tray.p)


def table_of(path):
    header, values = read_table(path)
    return header, values.T
