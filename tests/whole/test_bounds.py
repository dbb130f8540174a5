"""What would take hours or gigabytes is refused with a sentence before it begins."""

import functools
import io
import resource
import time
import zipfile

import numpy as np
import pytest

from salver import given, scenario
from salver.campaigns import run_campaign
from salver.errors import FileFormatError, SalverError, ScenarioError
from salver.export import write_export
from salver.models.arm.arm import load_arm
from salver.models.shapes.mesh_files import read_mesh_file
from salver.planning.make import plan_baseline
from salver.reports.film import write_film

CUBE = scenario.load("panda-cube")


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    directory = tmp_path_factory.mktemp("run")
    plan_baseline(scenario.load("slippery-cube").with_changes(arm=None)).save(directory)
    return directory


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        (
            {
                "objects__0__shape": {"type": "cylinder", "radius": 0.03, "height": 0.06, "support_points": 64},
                "contact__edges": 32,
                "arm": None,
            },
            "64 contact points with contact.edges = 32 each, which makes 2048 cone coefficients; at most 256",
        ),
        (
            {
                "motion__nodes": 2001,
                "contact__edges": 32,
                "objects__0__shape": {"type": "cylinder", "radius": 0.03, "height": 0.06},
                "objects__0__uncertainty": {
                    "mass": "10%",
                    "com": [1e-3, 1e-3, 1e-3],
                    "inertia": "10%",
                    "friction": "10%",
                },
                "arm": None,
            },
            "motion.nodes = 2001 with 256 cone coefficients and 8 uncertain parameters makes 5.1e",
        ),
        ({"physics__timestep": 1e-5, "motion__duration": 30}, "makes 3.1e.06 steps of a run; at most 1e.06"),
        ({"physics__timestep": 1e-5, "physics__settle_after": 60, "motion__duration": None}, "makes 6.5e.06 steps"),
    ],
)
def test_a_scenario_beyond_the_machine_is_refused(changes, words):
    with pytest.raises(ScenarioError, match=words):
        CUBE.with_changes(**changes)


@pytest.mark.slow
def test_a_long_motion_takes_memory_in_proportion_to_its_length():
    """The chain along 120 s once took 3 GB and 14 s."""
    from salver.planning.make import make_plan

    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    plan = make_plan(CUBE.with_changes(motion__duration=120.0), "baseline")
    assert plan.chain is not None
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 800_000  # kB


def test_too_many_runs_are_refused_before_they_are_drawn(run):
    began = time.process_time()
    with pytest.raises(SalverError, match="50000000 runs of 1 plans are more than the 200000 that fit into the memory"):
        run_campaign(run, n=50_000_000)
    assert time.process_time() - began < 5


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda run: write_export(run, "csv", rate=1e9), "at most 100000"),
        (lambda run: write_film(run, run / "x.gif", "plan", speed=1e-9), "it must be 0.1 to 120 pictures a second"),
    ],
)
def test_outputs_beyond_the_machine_are_refused(run, call, words):
    with pytest.raises(SalverError, match=words):
        call(run)


def test_the_samples_of_an_export_are_bounded(tmp_path):
    plan_baseline(scenario.load("slippery-cube").with_changes(arm=None, motion__duration=60.0)).save(tmp_path)
    with pytest.raises(SalverError, match=r"make 6e\+06 samples of this motion; at most 1e\+06"):
        write_export(tmp_path, "csv", rate=1e5)


@functools.cache
def bomb(size):
    """A zip file that unfolds to `size` zeros, its name that of a mesh."""
    content = io.BytesIO()
    with zipfile.ZipFile(content, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("mesh.stl", bytes(size))
    return content.getvalue()


@pytest.mark.slow
@pytest.mark.parametrize(
    "name", ["mesh.zip", "mesh.3mf", "mesh.glb", "mesh.tar.gz", "mesh.stl", "mesh.ply", "mesh.obj", "mesh.off"]
)
def test_an_archive_is_no_mesh(tmp_path, name):
    path = tmp_path / name
    path.write_bytes(bomb(100_000_000))
    began = time.process_time()
    with pytest.raises(ValueError, match=r"is not of a known format|cannot be read|holds no triangles"):
        read_mesh_file(path)
    assert time.process_time() - began < 5
    with pytest.raises(ScenarioError, match=name):
        CUBE.with_changes(objects__0__shape={"type": "mesh", "file": str(path)}, arm=None)


def test_a_large_mesh_is_refused_unread(tmp_path):
    path = tmp_path / "mesh.stl"
    with open(path, "wb") as file:
        file.truncate(10**10)  # sparse
    with pytest.raises(ValueError, match="has 10000 MB; at most 50 MB are read"):
        read_mesh_file(path)


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"", "is not valid TOML|is missing"),
        (b"\xff\xfe", "not a text file in UTF-8"),
        (b"a = " + b"[" * 100_000, "is not valid TOML"),
        (b"a = " + b"9" * 10_000, "is not valid TOML"),
        (b"#" * 2_000_000, "is larger than 1000 kB"),
    ],
)
def test_a_file_that_is_no_scenario_is_one_sentence(tmp_path, content, words):
    path = tmp_path / "x.toml"
    path.write_bytes(content)
    with pytest.raises(ScenarioError, match=words):
        scenario.load(path)


def test_files_with_impossible_names_are_one_sentence(tmp_path):
    import tomli_w

    loop = tmp_path / "loop.urdf"
    loop.symlink_to(loop)
    for model in (str(loop), "a\x00.urdf", "b" * 5000 + ".urdf"):
        data = CUBE.model_dump(mode="json", exclude_none=True)
        data["arm"] |= {"model": model, "flange": "tool"}
        path = tmp_path / "x.toml"
        path.write_text(tomli_w.dumps(data))
        with pytest.raises(ScenarioError):
            load_arm(*(lambda s: (s.arm, s.tray))(scenario.load(path)))


INERTIAL = '<inertial><mass value="1"/><inertia ixx="1e-2" ixy="0" ixz="0" iyy="1e-2" iyz="0" izz="1e-2"/></inertial>'


def urdf(joints, inertial=INERTIAL):
    links = "".join(f'<link name="l{k}">{inertial}</link>' for k in range(joints + 1))
    made = "".join(
        f'<joint name="j{k}" type="revolute"><parent link="l{k}"/><child link="l{k + 1}"/><axis xyz="0 0 1"/>'
        f'<origin xyz="0 0 0.1"/><limit lower="-2" upper="2" effort="50" velocity="2"/></joint>'
        for k in range(joints)
    )
    return f'<robot name="r">{links}{made}</robot>'


def test_an_arm_of_sixty_joints_is_refused(tmp_path):
    path = tmp_path / "long.urdf"
    path.write_text(urdf(60))
    arm = CUBE.arm.model_copy(update={"model": str(path), "flange": "l60"})
    with pytest.raises(ScenarioError, match=r"has 60 joints that move .* an arm may have at most 20"):
        load_arm(arm, CUBE.tray)


def test_a_bomb_of_entities_is_no_urdf(tmp_path):
    path = tmp_path / "bomb.urdf"
    entities = "".join(f'<!ENTITY e{k} "{f"&e{k - 1};" * 10}">' for k in range(1, 10))
    path.write_text(f'<!DOCTYPE r [<!ENTITY e0 "ha">{entities}]><robot name="r"><link name="&e9;"/></robot>')
    arm = CUBE.arm.model_copy(update={"model": str(path), "flange": "x"})
    with pytest.raises(ScenarioError, match="cannot be read"):
        load_arm(arm, CUBE.tray)


def test_waypoints_are_bounded(tmp_path, monkeypatch):
    path = tmp_path / "w.csv"
    path.write_text("1,2,3,4,5,6,7\n" * 11)
    monkeypatch.setattr(given, "MOST_SAMPLES", 10)
    with pytest.raises(FileFormatError, match="at most 10 are accepted"):
        given.read_waypoints(path, CUBE)


@pytest.mark.parametrize(("kp", "kd"), [(500, 25), (300, 15), (1e4, 200), (1, 2), (1e5, 600), (5e4, 60)])
def test_gains_are_refused_where_the_held_loop_grows(kp, kd):
    """Against the loop itself: e'' held over a period, a thousand periods long."""
    from salver.scenario import Control

    period, e = 1e-3, np.array([1.0, 0.0])
    largest = 0.0
    for k in range(20_000):
        push = -kp * e[0] - kd * e[1]
        e = np.array([e[0] + period * e[1] + 0.5 * period**2 * push, e[1] + period * push])
        if k > 19_000:
            largest = max(largest, abs(e[0]))
    control = Control(kp=(kp, kp), kd=(kd, kd))
    if largest < 1:
        control.check_held(period)
    else:
        with pytest.raises(ValueError, match="is unstable when commands are held"):
            control.check_held(period)


def load_urdf(tmp_path, text, flange):
    path = tmp_path / "arm.urdf"
    path.write_text(text)
    return load_arm(CUBE.arm.model_copy(update={"model": str(path), "flange": flange}), CUBE.tray)


def test_a_link_and_a_joint_may_share_their_name(tmp_path):
    """Found by the fuzzer: Pinocchio then knows two frames of the name."""
    named = load_urdf(tmp_path, urdf(3).replace('name="j1"', 'name="l2"'), "l2")
    plain = load_urdf(tmp_path, urdf(3), "l2")
    q = np.array([0.3, -0.2])
    assert np.array_equal(named.tray_pose(q)[0], plain.tray_pose(q)[0])


def test_a_urdf_of_two_trees_is_refused(tmp_path):
    """Found by the fuzzer: it fell over the links that hang on nothing."""
    text = urdf(3).replace('<link name="l0">', '<link name="island"/><link name="l0">')
    with pytest.raises(ScenarioError, match="is not one tree: no joint leads from its root l0 to island"):
        load_urdf(tmp_path, text, "l3")


def test_a_box_of_one_size_is_no_shape():
    from salver.models.arm.link_shapes import link_shapes

    text = '<robot name="r"><link name="l"><collision><geometry><box size="0.1"/></geometry></collision></link></robot>'
    assert "its box has 1 sizes, not 3" in link_shapes(text).missing["l"]
