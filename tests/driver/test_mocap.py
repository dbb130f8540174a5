"""Motion capture of object and tray: poses by hand, and what may be said of the load."""

from __future__ import annotations

import csv
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from salver import scenario
from salver.driver import execute, mocap
from salver.driver.seen import judge
from salver.errors import FileFormatError, SalverError
from salver.geometry import Array, compose, exp, log, matrix_from_quat_wxyz, quat_wxyz_from_matrix
from salver.models.arm.arm import load_arm
from salver.planning.make import make_plan
from salver.planning.plan import Plan, load_plan
from salver.reports.pages.page import write_report

DURATION = 1.8
SHORT = {"physics__settle_before": 0.05, "physics__settle_after": 0.1}


@pytest.fixture(scope="module")
def directory(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A motion that turns the tray about the vertical: errors of orientation show which frame they are told in."""
    case = scenario.load("panda-cube-yaw").with_changes(motion__duration=DURATION, **SHORT)
    folder = tmp_path_factory.mktemp("run")
    make_plan(case, "baseline").save(folder, "plan")
    return folder


@pytest.fixture(scope="module")
def plan(directory: Path) -> Plan:
    plan = load_plan(directory)
    assert plan.ok
    return plan


WORLD = (np.array([1.0, -2.0, 0.3]), exp(np.array([0.0, 0.0, 0.7])))  # of the capture, in S
MARKERS = (np.array([0.003, 0.012, 0.021]), exp(np.array([0.2, -0.1, 0.4])))  # on the object, in B
STARTS_AT = 3.37  # s of the capture's clock


def _capture(
    plan: Plan, path: Path, *, slides: float = 0.0, blind: float | None = None, quaternions: bool = False
) -> None:
    """What Vicon would write at 200 Hz of a cube that follows the plan or slides along the tray, markers anywhere."""
    t = np.arange(0.0, 6.0, 0.005)
    m = plan.reference.sample(t - STARTS_AT)
    body = plan.scenario.payload.first
    gone = slides * np.clip(t - STARTS_AT - 0.4, 0.0, 0.2) / 0.2
    p_SB = m.p_SB + np.einsum("tij,tj->ti", m.R_SB, np.outer(gone, [0.0, 1.0, 0.0]))
    tray = m.of_frame(*compose(np.zeros(3), body.R_EB.T, -body.p_EB, np.eye(3)))
    back = (-WORLD[1].T @ WORLD[0], WORLD[1].T)
    columns = [np.arange(1, len(t) + 1), np.zeros(len(t))]
    for p, R in ((p_SB, m.R_SB), (tray.p_SB, tray.R_SB)):
        p_V, R_V = compose(*back, *compose(p, R, *MARKERS))
        turn = quat_wxyz_from_matrix(R_V) if quaternions else np.rad2deg(log(R_V))
        turn = turn[:, [1, 2, 3, 0]] if quaternions else turn
        seen = np.ones(len(t), bool) if blind is None else np.abs(t - STARTS_AT - blind) > 0.02
        columns += [np.where(seen, x, 0.0) for x in [*turn.T, *(1e3 * p_V.T)]]
    names = "RX,RY,RZ,RW,TX,TY,TZ" if quaternions else "RX,RY,RZ,TX,TY,TZ"
    units = ",,,,mm,mm,mm" if quaternions else "deg,deg,deg,mm,mm,mm"
    gap = "," * names.count(",")
    with open(path, "w", newline="") as file:
        file.write(f"Objects\n200\n,,Global:cube{gap},Global:tray{gap}\n")
        file.write(f"Frame,Sub Frame,{names},{names}\n,,{units},{units}\n")
        csv.writer(file).writerows(zip(*columns, strict=True))


def _merged(plan: Plan, path: Path, **more: Any) -> dict[str, np.ndarray]:
    tracks = mocap.read_tracks(path)
    assert set(tracks) == {"cube", "tray"}
    first = plan.scenario.payload.first
    return mocap.merge(
        _logged(plan), tracks, plan.reference, first, object_name="cube", p_SV=WORLD[0], R_SV=WORLD[1], **more
    )


def _logged(plan: Plan) -> dict[str, np.ndarray]:
    """The log of an arm that follows its joint motion exactly."""
    t = np.arange(-0.05, DURATION + 0.1, 0.005)
    arm = load_arm(plan.scenario.arm, plan.scenario.tray)  # type: ignore[arg-type]
    poses = [arm.tray_pose(q) for q in plan.joint.sample(np.clip(t, 0, DURATION))[0]]  # type: ignore[union-attr]
    turned = quat_wxyz_from_matrix(np.array([R for _, R in poses]))
    return {"t": t, "p_SE": np.array([p for p, _ in poses]), "quat_SE_wxyz": turned}


@pytest.mark.slow
@pytest.mark.parametrize("quaternions", [False, True])
def test_motion_capture_of_a_faithful_cube_shows_no_error(plan: Plan, tmp_path: Path, quaternions: bool) -> None:
    _capture(plan, tmp_path / "vicon.csv", quaternions=quaternions)
    merged = _merged(plan, tmp_path / "vicon.csv", tray_name="tray", offset=STARTS_AT)
    assert merged["e_p"].max() < 2e-5  # straight lines between samples of 200 Hz
    assert merged["e_o"].max() < 1e-6
    assert merged["slip"].max() < 1e-6


@pytest.mark.slow
def test_motion_capture_sees_a_slide_and_finds_the_time(plan: Plan, tmp_path: Path) -> None:
    _capture(plan, tmp_path / "vicon.csv", slides=0.012)
    merged = _merged(plan, tmp_path / "vicon.csv", tray_name="tray")
    assert float(merged["mocap_offset"]) == pytest.approx(STARTS_AT, abs=0.02)
    exact = _merged(plan, tmp_path / "vicon.csv", tray_name="tray", offset=STARTS_AT)
    assert exact["slip"][-1, 0] == pytest.approx(0.012, abs=1e-5)
    assert exact["e_p"][-1] == pytest.approx(0.012, abs=1e-5)
    assert exact["slip"][exact["t"] < 0.39].max() < 1e-6


@pytest.mark.slow
def test_motion_capture_with_a_gap_leaves_the_gap_open(plan: Plan, tmp_path: Path) -> None:
    _capture(plan, tmp_path / "vicon.csv", blind=0.5)
    merged = _merged(plan, tmp_path / "vicon.csv", offset=STARTS_AT)
    assert np.all(np.isfinite(merged["e_p"]))  # 40 ms are bridged
    tracks = mocap.read_tracks(tmp_path / "vicon.csv")
    assert len(tracks["cube"].t) < 1200
    late = mocap.Track(tracks["cube"].t + 0.0, tracks["cube"].p, tracks["cube"].R)
    keep = late.t < STARTS_AT + 0.7
    carried = plan.scenario.payload.bodies
    t = np.arange(0, 1.0, 0.01)
    arrays = {"t": t, "p_SE": np.zeros((100, 3)), "quat_SE_wxyz": np.tile([1.0, 0, 0, 0], (100, 1))}
    cut = {"cube": mocap.Track(late.t[keep], late.p[keep], late.R[keep])}
    out = mocap.merge(arrays, cut, plan.reference, carried[0], object_name="cube", offset=STARTS_AT)
    assert np.array_equal(np.isfinite(out["e_p"]), np.isfinite(out["e_o"]))
    assert not np.isfinite(out["e_p"][t > 0.71]).any()
    assert np.isfinite(out["e_p"][t < 0.69]).all()


Tracks = dict[str, mocap.Track]


def _told(plan: Plan, path: Path, change: Callable[[Tracks], Tracks] = lambda tracks: tracks, **more: Any) -> Any:
    tracks = change(mocap.read_tracks(path))
    first = plan.scenario.payload.first
    given: dict[str, Any] = {"offset": STARTS_AT, "p_SV": WORLD[0], "R_SV": WORLD[1], **more}
    merged = mocap.merge(_logged(plan), tracks, plan.reference, first, object_name="cube", tray_name="tray", **given)
    return judge(merged, tracks, plan.reference, plan.scenario.payload.bodies, "cube", "tray")


def _only(name: str, keep: Callable[[Array], Array]) -> Callable[[Tracks], Tracks]:
    """One track with only those samples at which keep(time of the motion) is true."""

    def change(tracks: Tracks) -> Tracks:
        track = tracks[name]
        kept = keep(track.t - STARTS_AT)
        return {**tracks, name: mocap.Track(track.t[kept], track.p[kept], track.R[kept])}

    return change


def _moved(name: str, by: Callable[[Array], Array]) -> Callable[[Tracks], Tracks]:
    """One track with by(time of the motion), m, added to its positions."""

    def change(tracks: Tracks) -> Tracks:
        track = tracks[name]
        return {**tracks, name: mocap.Track(track.t, track.p + by(track.t - STARTS_AT), track.R)}

    return change


@pytest.mark.slow
def test_a_load_that_stayed_is_said_to_hold_and_one_that_slid_to_slide(plan: Plan, tmp_path: Path) -> None:
    path = tmp_path / "vicon.csv"
    _capture(plan, path)
    assert _told(plan, path).code == "holds"
    assert _told(plan, path, offset=None).code == "holds"
    _capture(plan, path, slides=0.0025)
    assert _told(plan, path).sentence.startswith("cube moved on its tray by up to 2.50 mm at t = ")
    _capture(plan, path, slides=0.0015)
    assert _told(plan, path).code == "holds"
    _capture(plan, path, blind=0.5)
    assert _told(plan, path).code == "holds"  # 40 ms are bridged


@pytest.mark.slow
def test_a_load_that_only_turned_or_rose_did_not_hold(plan: Plan, tmp_path: Path) -> None:
    """A corner of the cube's base is 28 mm from its middle: 0.1 rad about the vertical moves it by 2.8 mm."""
    path = tmp_path / "vicon.csv"
    _capture(plan, path)

    def turned(tracks: Tracks, angle: float) -> Tracks:
        cube = tracks["cube"]
        along = np.clip((cube.t - STARTS_AT) / 1.0, 0, 1) * angle
        up = WORLD[1].T @ np.array([0, 0, 1.0])
        # Markers sit anywhere on the cube: turn the cube about its own axis, in the capture's world.
        p_VB, R_VB = compose(cube.p, cube.R, *invert_of(MARKERS))
        p, R = compose(p_VB, exp(np.outer(along, up)) @ R_VB, *MARKERS)
        return {**tracks, "cube": mocap.Track(cube.t, p, R)}

    assert _told(plan, path, lambda tracks: turned(tracks, 0.05)).code == "holds"
    assert _told(plan, path, lambda tracks: turned(tracks, 0.1)).code == "slides"
    up = WORLD[1].T @ np.array([0, 0, 0.003])
    rising = _moved("cube", lambda t: np.outer((np.abs(t - 0.7) < 0.1).astype(float), up))
    assert _told(plan, path, rising).code == "slides"


def test_the_slip_is_that_of_the_corner_that_went_farthest(plan: Plan, tmp_path: Path) -> None:
    """Turned by 0.1 rad about a corner of its base, the opposite one goes along a chord of 40 sqrt(2) mm."""
    _capture(plan, tmp_path / "vicon.csv")
    tracks, body = mocap.read_tracks(tmp_path / "vicon.csv"), plan.scenario.payload.first
    cube, corner, turn = tracks["cube"], body.base_polygon_B[0], exp(np.array([0.0, 0.0, 0.1]))
    p_VB, R_VB = compose(cube.p, cube.R, *invert_of(MARKERS))
    late = cube.t > STARTS_AT + 0.5
    p_VB[late] += R_VB[late] @ (corner - turn @ corner)
    R_VB[late] = R_VB[late] @ turn
    seen = {**tracks, "cube": mocap.Track(cube.t, *compose(p_VB, R_VB, *MARKERS))}
    given: dict[str, Any] = {"offset": STARTS_AT, "p_SV": WORLD[0], "R_SV": WORLD[1], "tray_name": "tray"}
    merged = mocap.merge(_logged(plan), seen, plan.reference, body, object_name="cube", **given)
    assert merged["slip"][-1, 0] == pytest.approx(2 * np.sin(0.05) * 0.04 * np.sqrt(2), abs=1e-5)


def invert_of(pose: tuple[Array, Array]) -> tuple[Array, Array]:
    return -pose[1].T @ pose[0], pose[1].T


@pytest.mark.slow
@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (_only("cube", lambda t: t < 0.2), "cube: it was not seen after t = 0.20 s of 1.89 s"),
        (_only("cube", lambda t: t < 1.5), "cube: it was not seen after t = 1.50 s"),
        (_only("cube", lambda t: t < 1.86), "cube: it was not seen after t = 1.85 s of 1.89 s"),
        (_only("tray", lambda t: t < 1.0), "tray: it was not seen after t = 1.00 s"),
        (_only("cube", lambda t: np.abs(t - 0.8025) > 0.11), "cube: it was not seen from 0.69 to 0.92 s"),
        (_only("cube", lambda t: t > 0.1), "cube: it was not seen at rest before the motion (0 samples"),
        (_only("tray", lambda t: t > 0.1), "tray: it was not seen at rest before the motion"),
        (_only("cube", lambda t: t > 2.0), "cube: the clocks do not overlap: it was seen from 2."),
        (_only("cube", lambda t: t < -1.0), "cube: the clocks do not overlap"),
        (_moved("cube", lambda t: 0.1 * (np.abs(t - 0.9) < 3e-3)[:, None]), "cube: it jumps at t = 0.8"),
        (_moved("cube", lambda t: 2e-3 * np.sin(40 * t)[:, None]), "cube: at rest before the motion it strays"),
        (lambda tracks: {**tracks, "cube": _backwards(tracks["cube"])}, "cube: its clock does not go on"),
    ],
)  # fmt: skip
def test_what_a_recording_cannot_tell_is_not_said(
    plan: Plan, tmp_path: Path, change: Callable[[Tracks], Tracks], reason: str
) -> None:
    _capture(plan, tmp_path / "vicon.csv")
    told = _told(plan, tmp_path / "vicon.csv", change)
    assert told.code == "cannot_tell"
    assert told.sentence.startswith("It cannot be told whether the load held: ")
    assert reason in told.sentence


@pytest.mark.parametrize(("noise", "code"), [(1e-4, "holds"), (2.5e-4, "holds"), (6e-4, "cannot_tell")])
def test_noise_of_markers_is_told_from_a_slip_or_said_to_hide_it(
    plan: Plan, tmp_path: Path, noise: float, code: str
) -> None:
    _capture(plan, tmp_path / "vicon.csv")

    def noisy(tracks: Tracks) -> Tracks:
        rng = np.random.default_rng(3)
        return {
            name: mocap.Track(track.t, track.p + noise * rng.standard_normal(track.p.shape), track.R)
            for name, track in tracks.items()
        }

    told = _told(plan, tmp_path / "vicon.csv", noisy)
    assert told.code == code, told
    if code == "cannot_tell":
        assert "hides a slip of 2 mm (0.31 mm do not)" in told.sentence
        said = float(told.sentence.split("its noise of ")[1].split(" mm")[0])
        assert said == pytest.approx(1e3 * noise, rel=0.1)


def _backwards(track: mocap.Track) -> mocap.Track:
    t = track.t.copy()
    t[800:] -= 0.1
    return mocap.Track(t, track.p, track.R)


@pytest.mark.parametrize("more", [{"offset": STARTS_AT + 0.3}, {"offset": STARTS_AT - 0.3}, {"R_SV": np.eye(3)}])
def test_a_clock_or_a_world_that_does_not_fit_is_found(plan: Plan, tmp_path: Path, more: dict[str, Any]) -> None:
    _capture(plan, tmp_path / "vicon.csv")
    told = _told(plan, tmp_path / "vicon.csv", **more)
    assert told.code == "cannot_tell"
    assert "from where the joints put it" in told.sentence or "it strays" in told.sentence


@pytest.mark.parametrize("times", ["nan,nan,nan", "0,inf,0.1", "5,4,3", "0,1e12,2e12"])
def test_times_that_are_none_get_a_sentence(plan: Plan, tmp_path: Path, times: str) -> None:
    path = tmp_path / "plain.csv"
    rows = "".join(f"{t},1,2,{3 + k / 100},1,0,0,0\n" for k, t in enumerate(times.split(",")))
    path.write_text("t,p_x,p_y,p_z,q_w,q_x,q_y,q_z\n" + rows)
    with pytest.raises(SalverError, match=r"must be in s and go forwards|must cover the motion|no motion capture that"):
        mocap.find_offset(mocap.read_tracks(path)["object"], plan.reference)


def test_of_several_objects_one_track_tells_nothing_of_the_others(plan: Plan, tmp_path: Path) -> None:
    _capture(plan, tmp_path / "vicon.csv")
    tracks = mocap.read_tracks(tmp_path / "vicon.csv")
    first = plan.scenario.payload.first
    merged = mocap.merge(
        _logged(plan), tracks, plan.reference, first, object_name="cube", tray_name="tray", offset=STARTS_AT,
        p_SV=WORLD[0], R_SV=WORLD[1],
    )  # fmt: skip
    import dataclasses

    both = [first, dataclasses.replace(first, name="lid")]
    assert "nothing is known of lid" in judge(merged, tracks, plan.reference, both, "cube", "tray").sentence
    cup = [dataclasses.replace(scenario.load("panda-coffee").payload.first, name="cube")]
    wet = judge(merged, tracks, plan.reference, cup, "cube", "tray").sentence
    assert wet.startswith("Not judged: what the liquid in cube did, which motion capture does not see. cube kept")


@pytest.mark.slow
def test_without_the_tray_nothing_is_said_of_the_load(directory: Path, plan: Plan, tmp_path: Path) -> None:
    execute.run_plan(directory, realtime=False)
    _capture(plan, tmp_path / "vicon.csv")
    result = execute.merge_mocap(directory, "plan", tmp_path / "vicon.csv", offset=STARTS_AT, world=WORLD)
    assert result.summary["outcome"] == "done"
    assert "only with the tray in the recording" in result.summary["load"]
    blind = execute.merge_mocap(directory, "plan", tmp_path / "vicon.csv", offset=99.0, tray_name="tray", world=WORLD)
    assert blind.summary["outcome"] == "cannot_tell"
    assert not blind.achieved
    assert blind.summary["slip_peak"] is None
    assert write_report(directory).is_file()


@pytest.mark.slow
def test_motion_capture_merges_into_the_log(directory: Path, plan: Plan, tmp_path: Path) -> None:
    execute.run_plan(directory, realtime=False)
    _capture(plan, tmp_path / "vicon.csv", slides=0.012)
    result = execute.merge_mocap(
        directory, "plan", tmp_path / "vicon.csv", tray_name="tray", offset=STARTS_AT, world=WORLD
    )
    assert result.summary["outcome"] == "slides"
    assert not result.achieved
    assert result.summary["slip_peak"] == pytest.approx(0.012, abs=1e-4)
    assert result.arrays["p_SB"].shape[1:] == (1, 3)
    assert result.summary["mocap"] == {"file": "vicon.csv", "offset": STARTS_AT, "tray": "tray"}
    with pytest.raises(SalverError, match='has no object "cup"; it has cube, tray'):
        execute.merge_mocap(directory, "plan", tmp_path / "vicon.csv", object_name="cup")


def test_plain_table_of_motion_capture(tmp_path: Path) -> None:
    path = tmp_path / "plain.csv"
    path.write_text("t,p_x,p_y,p_z,q_w,q_x,q_y,q_z\n0,1,2,3,2,0,0,0\n0.1,1,2,4,0,0,0,-1\n0.2,,,,,,,\n")
    track = mocap.read_tracks(path)["object"]
    assert np.array_equal(track.t, [0, 0.1])
    assert np.array_equal(track.p, [[1, 2, 3], [1, 2, 4]])
    assert np.abs(track.R - matrix_from_quat_wxyz(np.array([[1, 0, 0, 0], [0, 0, 0, 1.0]]))).max() < 1e-15


@pytest.mark.parametrize(
    "content",
    [
        "",
        "hello\nworld\n",
        "t,p_x\n0,1\n",
        *(f"t,p_x,p_y,p_z,q_w,q_x,q_y,q_z\n0,{x}\n" for x in ("a,b,c,d,e,f,g", "1,2,3,1,0,0,0")),
    ],
)
def test_other_files_are_not_motion_capture(tmp_path: Path, content: str) -> None:
    (tmp_path / "x.csv").write_text(content)
    with pytest.raises(FileFormatError, match="no motion capture that can be read; accepted are"):
        mocap.read_tracks(tmp_path / "x.csv")
