"""Tasks of several legs: the load changes at stops, and each leg begins where the one before it ended."""

import json
import re
from dataclasses import replace

import numpy as np
import pytest
import tomli_w
from hypothesis import given, settings
from hypothesis import strategies as st

import salver as sv
from rewritten_runs import rewrite
from salver import scenario as scenarios
from salver.auditing import audit_legs
from salver.campaigns import run_campaign
from salver.campaigns.engine import TABLE
from salver.campaigns.summary import read_table
from salver.cli import main
from salver.contact_margins import margins
from salver.errors import FileFormatError, SalverError, ScenarioError, Status, UnreachableError
from salver.export import write_export
from salver.export.motion import read_motion
from salver.files import load_npz, read_json
from salver.geometry import log, matrix_from_quat_wxyz, quat_wxyz_from_matrix
from salver.models.arm.arm import load_arm
from salver.motion_files import JointSamples, read
from salver.motion_files.samples import cuts_at_rests, part
from salver.planning.fastest import FastestOptions, transport_problem
from salver.planning.fastest.legs import _status, chains, plan_legs
from salver.planning.fastest.retiming import plan_retimed_legs
from salver.planning.plan import load_plan
from salver.planning.postures import PoseTarget
from salver.planning.round import load_round
from salver.planning.stops import plan_stops, stop_problem
from salver.planning.trajopt.constraints.via_poses import PassPose
from salver.planning.trajopt.curves import FreeCurve, Grid
from salver.planning.trajopt.exchange import SHORTEST
from salver.planning.trajopt.programme import Programme
from salver.planning.trajopt.spline import RestSpline
from salver.planning.trajopt.watch import Watch
from salver.reports.pages.page import write_report
from salver.scenario.legs import Leg, loads
from salver.simulation.record import load_record
from salver.trajectory import smooth_step

CYLINDER = {"type": "cylinder", "radius": 0.03, "height": 0.1}


def task(legs=None, **changes):
    """A round with two cups on the tray and a plate with a bun on it."""
    cup = {"shape": CYLINDER, "mass": 0.2, "friction": 0.4, "uncertainty": {"mass": "20%", "friction": "10%"}}
    data = {
        "name": "round",
        "motion": {"start": {"position": [0.5, -0.2, 0.45]}, "orientation": "free"},
        "legs": legs
        or [
            {"goal": {"position": [0.55, 0.0, 0.45], "rpy_deg": [0, 0, 30]}, "take": "first"},
            {"goal": {"position": [0.5, 0.2, 0.45]}, "through": [{"position": [0.5, 0.1, 0.5]}]},
        ],
        "objects": [
            {"name": "first", "at": [0.05, 0.02], **cup},
            {"name": "second", "at": [-0.04, 0.05], **cup},
            {"name": "plate", "at": [-0.03, -0.05], **cup, "shape": {**CYLINDER, "height": 0.02, "radius": 0.04}},
            {"name": "bun", "on": "plate", "at": [-0.03, -0.05], **cup, "mass": 0.05},
        ],
        "contact": {"condition": "exact"},
        "arm": {"model": "panda"},
        "physics": {"timestep": 1e-3, "settle_before": 0.2, "settle_after": 0.1},
        **changes,
    }
    return data


def parsed(**changes):
    return scenarios.parse(task(**changes), "mine.toml")


def leg(**more):
    return {"goal": {"position": [0.5, 0.0, 0.45]}, **more}


@pytest.mark.parametrize(
    ("legs", "words"),
    [
        ([leg(take="third")], 'legs[0].take = "third": there is no such object; there are first, second, plate, bun'),
        (
            [leg(take="first"), leg(take="first")],
            'legs[1].take = "first": it is not on the tray then; the tray holds second',
        ),
        (
            [leg(take="plate"), leg()],
            'bun stands on "plate", which is not on the tray after legs[0]; take bun off before',
        ),
        ([leg(take="bun"), leg(put="bun"), leg(put="bun")], 'legs[2].put = "bun": it is on the tray already'),
        ([leg(take="first", put="first"), leg()], 'legs[0].put = "first": it is named twice at this stop'),
        ([leg(take=["first", "first"])], 'legs[0].take = "first": it is named twice at this stop'),
        ([leg(put=["first", "second"], take=["plate", "bun"])], None),
        (
            [leg(take=["first", "second", "plate", "bun"]), leg()],
            "legs[0].take leaves the tray empty, and a leg follows",
        ),
        ([leg(put=["first", "second", "plate", "bun"]), leg()], "the first leg begins with an empty tray"),
        ([leg(put="plate"), leg()], 'bun stands on "plate", which is not on the tray when the first leg begins'),
        ([leg(goal={"position": [0.5, 0, 0.45], "rpy_deg": [0, 40, 0]}), leg()], "legs[0]: motion.goal tilts the tray"),
        ([leg(take=[])], "legs[0].take = []: must be the name of an object, or a list of names"),
        ([leg(duration=1.0)], "unknown key legs[0].duration"),
        ([leg(), leg()], "legs[1] has the same pose twice in a row"),
        ([leg(through=[leg()["goal"]])], "legs[0] has the same pose twice in a row"),
    ],
)
def test_what_cannot_be_taken_or_put_is_one_sentence(legs, words):
    if words is None:
        assert [o.name for o in parsed(legs=legs).each_leg[0].objects] == ["plate", "bun"]
        return
    with pytest.raises(ScenarioError) as error:
        parsed(legs=legs)
    assert words in str(error.value)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"uncertainty": {"set": "ellipsoid", "correlation": {"first.mass,second.mass": 0.5}}}, "correlation"),
        ({"motion": {"start": {"position": [0.5, -0.2, 0.45]}, "goal": {"position": [0, 0, 0]}}}, "motion.goal is not"),
        ({"motion": {"start": {"position": [0.5, -0.2, 0.45]}, "goal_yaw": "free"}}, "goal_yaw"),
        (
            {"motion": {"start": {"position": [0.5, -0.2, 0.45]}, "through": [{"position": [0, 0, 0]}]}},
            r"legs\[0\]\.thr",
        ),
    ],
)
def test_what_is_not_known_of_several_legs_is_refused(changes, words):
    with pytest.raises(ScenarioError, match=words):
        parsed(**changes)


@pytest.mark.parametrize(
    ("later", "obstacles", "words"),
    [
        ({}, [{"type": "sphere", "name": "lamp", "radius": 0.05, "position": [0.52, 0.15, 0.45]}], "the obstacle lamp"),
        ({"goal": {"position": [1.5, 0.2, 0.45]}}, [], "No posture within the joint limits reaches the goal"),
    ],
)
def test_an_end_of_a_later_leg_that_is_impossible_is_named_before_any_leg_is_planned(later, obstacles, words):
    legs = [leg(), {"goal": {"position": [0.5, 0.2, 0.45]}, **later}]
    searched = []
    with pytest.raises(UnreachableError) as error:
        plan_legs(parsed(legs=legs, obstacles=obstacles), watch=Watch(tell=searched.append))
    assert str(error.value).startswith("round-leg2: ")
    assert words in str(error.value)
    assert not searched


@settings(max_examples=30)
@given(st.lists(st.tuples(st.sets(st.sampled_from("abc")), st.sets(st.sampled_from("abc"))), max_size=4))
def test_loads_are_what_was_there_less_what_was_taken_and_more_what_was_put(stops):
    objects = [
        scenarios.CarriedObject.model_validate({"name": name, "shape": CYLINDER, "mass": 0.2, "friction": 0.4})
        for name in "abc"
    ]
    goal = {"position": [0.0, 0.0, 0.0]}
    legs = [
        Leg.model_validate({"goal": goal, "take": sorted(take) or None, "put": sorted(put) or None})
        for take, put in stops
    ]
    try:
        found = [{item.name for item in load} for load in loads(objects, legs)]
    except ValueError:
        return
    assert len(found) == len(legs) + 1
    for (take, put), before, after in zip(stops, found, found[1:], strict=False):
        assert take <= before
        assert not put & before
        assert after == before - take | put
    assert all(found[:-1])


def test_poses_are_of_one_frame_on_the_tray_also_when_its_object_is_gone():
    """The tray's centre is (-0.05, -0.02) m from the first cup, turned with it by 30 degrees; the second cup stands at
    (-0.04, 0.05) m of it. Both cups are 0.1 m high, so their centres are at one height."""
    first, second = parsed().each_leg
    assert [item.name for item in second.objects] == ["second", "plate", "bun"]
    angle = np.deg2rad(30)
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    expected = np.array([0.55, 0.0]) + turn @ np.array([-0.09, 0.03])
    np.testing.assert_allclose(second.motion.start.position, [*expected, 0.45], atol=1e-12)
    np.testing.assert_allclose(second.motion.start.rotation[:2, :2], turn, atol=1e-12)
    np.testing.assert_allclose(second.motion.goal.position, [0.41, 0.23, 0.45], atol=1e-12)
    np.testing.assert_allclose(second.motion.through[0].position, [0.41, 0.13, 0.5], atol=1e-12)
    assert first.motion.goal.position == (0.55, 0.0, 0.45)
    assert first.arm is not None


def test_a_task_has_no_load_of_its_own():
    case = parsed()
    with pytest.raises(ScenarioError, match="round is a task of 2 legs, and "):
        _ = case.payload
    for call in (lambda: sv.plan(case), lambda: sv.fastest(case), lambda: sv.plan(case, "baseline")):
        with pytest.raises(ScenarioError, match=r"2 legs, and .* takes one motion with one load"):
            call()
    assert scenarios.parse(case.model_dump(mode="json", exclude_none=True), "again").digest == case.digest


@pytest.fixture(scope="module")
def planned():
    return sv.plan_legs(parsed(), spans=8, pairs=1)


@pytest.fixture(scope="module")
def directory(planned, tmp_path_factory):
    return planned.save(tmp_path_factory.mktemp("legs") / "run")


def test_each_leg_begins_where_the_last_one_ended_and_is_safe_with_its_own_load(planned):
    assert planned.ok, planned.status
    first, second = planned.legs
    assert planned.apart == 0
    assert first.joint.q[-1].tolist() == second.joint.q[0].tolist()
    assert [len(leg.scenario.payload.bodies) for leg in planned.legs] == [4, 3]
    assert planned.duration == first.duration + second.duration
    assert {m.name for m in second.margins.interfaces} == {"second on tray", "plate on tray", "bun on plate"}
    # The cup that was taken, were it still there, would stand where the first leg's goal had it.
    end = first.reference.sample(np.array([first.duration]))
    np.testing.assert_allclose(end.p_SB[0], [0.55, 0.0, 0.45], atol=1e-9)
    assert "what happens at the stops" in planned.unchecked[0]
    assert all(set(leg.unchecked) <= set(planned.unchecked) for leg in planned.legs)


def test_a_leg_ends_in_a_branch_from_which_the_next_one_goes_on():
    """The first leg alone is quicker in another branch of this arm's, from which the second turns the arm over."""
    legs = [{"goal": {"position": [0.6, -0.05, 0.4]}, "take": "first"}, {"goal": {"position": [0.5, 0.25, 0.35]}}]
    motion = {"start": {"position": [0.45, -0.4, 0.4]}, "orientation": "free", "speeds": "full"}
    case, tried = parsed(legs=legs, motion=motion, arm={"model": "ur5e"}), []
    case = case.with_changes(objects=[item for item in case.objects if item.name in ("first", "second")])
    found = plan_legs(case, options=FastestOptions(spans=8), watch=Watch(tell=lambda watch: tried.append(watch.trying)))
    assert found.ok
    assert all(np.ptp(each.joint.q, axis=0).max() < 1.0 for each in found.legs)
    assert not [name for name in tried if name == "way around"]


def test_a_plan_comes_back_from_its_one_file_and_knows_when_a_leg_was_edited(planned, directory, tmp_path):
    again = load_round(directory)
    assert again.ok
    assert again.status.sentence == planned.status.sentence
    assert load_plan(directory, "leg2").joint.q.tolist() == planned.legs[1].joint.q.tolist()
    with pytest.raises(
        FileFormatError, match="is a plan of 2 legs, where a plan of one motion is needed; name a leg, leg1 to"
    ):
        load_plan(directory)
    with pytest.raises(FileFormatError, match="name a leg, leg1 to leg2"):
        load_plan(directory, "leg3")
    planned.save(tmp_path / "edited")
    rewrite(tmp_path / "edited", arrays=lambda held: held["leg2.joint_q"].__iadd__(1e-9), certified=False)
    for call in (load_round, lambda d: load_plan(d, "leg1")):
        with pytest.raises(FileFormatError, match=r"array leg2\.joint_q is not what was judged"):
            call(tmp_path / "edited")


@pytest.mark.slow
def test_legs_that_do_not_meet_are_not_ok(planned, tmp_path):
    planned.save(tmp_path / "moved")

    def moved(held):
        for name in ("joint_q", "q"):
            held[f"leg2.{name}"] += 1e-3

    rewrite(tmp_path / "moved", arrays=moved)
    found = load_round(tmp_path / "moved")
    assert found.apart == pytest.approx(1e-3)
    assert not found.ok


def test_a_task_is_as_good_as_its_worst_leg(planned):
    first, second = planned.legs
    worse = replace(second, arm_status=Status("infeasible", "The mug slides.", False))
    for legs, number in (((first, worse), 2), ((worse, first), 1)):
        told = _status(legs, Watch())
        assert (told.ok, told.code, told.sentence) == (False, "infeasible", f"Leg {number}: The mug slides.")
    unsolved = replace(second, status=Status("limit", "Nothing was found.", False))
    assert _status((first, unsolved), Watch()).sentence == "Leg 2: Nothing was found."
    assert _status((first, second), Watch()).ok


@pytest.mark.slow
def test_what_slid_begins_the_next_leg_where_it_was_left(planned):
    """On ice the second cup slides on the first leg; the tray's motion of the second one begins with it there."""
    run = sv.simulate_legs(planned, parameters={"second.friction": 0.2})
    one, two = run.legs
    slid = (one.slip_E - one.creep_E)[-1, one.object_names.index("second"), :2]
    assert np.linalg.norm(slid) > 2e-3
    k = two.object_names.index("second")
    R_SE = matrix_from_quat_wxyz(two.quat_SE_wxyz[:1])[0]
    p_EB = R_SE.T @ (two.p_SB[0, k] - two.p_SE[0])
    nominal = planned.legs[1].scenario.payload.bodies[0].p_EB
    np.testing.assert_allclose(p_EB[:2] - nominal[:2], slid, atol=3e-4)
    assert run.outcome == "slides"
    assert run.summary["leg"] in (1, 2)
    with pytest.raises(ScenarioError, match=r'no parameter "third\.mass"'):
        sv.simulate_legs(planned, parameters={"third.mass": 1.0})


@pytest.mark.slow
def test_a_run_of_all_legs_can_be_stopped_on_any_of_them(planned, tmp_path, capsys):
    """The legs before are done; the one that the instant falls on comes to rest by its own stop, which ends the run."""
    stops = (plan_stops(stop_problem(leg), leg.joint, every=0.25, space=leg.space) for leg in planned.legs)
    legs = tuple(replace(leg, stops=found) for leg, found in zip(planned.legs, stops, strict=True))
    plan = replace(planned, legs=legs)
    first, second = (leg.duration for leg in legs)
    for stop_at, own in ((0.3 * first, 0.3 * first), (first + 0.4 * second, 0.4 * second)):
        run = sv.simulate_legs(plan, stop_at=stop_at)
        number = 1 + (stop_at > first)
        assert len(run.legs) == number
        assert all(leg.outcome == "holds" for leg in run.legs)
        stopped, course = run.legs[-1], legs[number - 1].stops.course(own)
        assert course.stop is not None
        assert run.summary["stop_at"] == stop_at
        assert run.summary["stop_takes"] == pytest.approx(course.rests - own)
        rest = legs[number - 1].stops.motion(course.stop).q[-1]
        assert np.abs(stopped.q[-1] - rest).max() < 1e-3  # rad
        assert np.abs(legs[number - 1].joint.q[-1] - rest).max() > 0.05
    with pytest.raises(ScenarioError, match="The stop is requested at"):
        sv.simulate_legs(plan, stop_at=first + second + 0.1)
    plan.save(tmp_path)
    made = run_campaign(tmp_path, 1, jobs=1, stops=True)
    rows = read_table(made.folder / TABLE)
    assert rows["stop_at"] == [made.definition.stop_at(0, plan.duration)]
    assert made.summary["plans"]["plan"]["stops"]["lost"]["count"] == 0
    assert main_of("simulate", tmp_path, "--run", 0, "--folder", "stops") == 0
    number = 1 + (rows["stop_at"][0] > first)
    assert f"Stopped on leg {number}, which ends the run." in capsys.readouterr().err
    told = json.loads((tmp_path / "simulation" / f"leg{number}-stop.json").read_text())
    assert told["stop_takes"] == pytest.approx(rows["stop_takes"][0])


@pytest.mark.slow
def test_commands_take_a_task_of_several_legs(directory, capsys):
    """Simulated, run in a campaign, shown, exported leg by leg; what is for one motion says so. A run with a value
    outside its range is none of the plan."""
    assert main_of("simulate", directory, "--set", "second.mass=0.9", "--set", "first.mass=0.22") == 0
    told = capsys.readouterr().out
    assert "leg 2" in told
    assert "What if: second.mass = 0.9" in told
    for name in ("leg1-what-if", "leg2-what-if"):
        summary = read_json(directory / "simulation" / f"{name}.json")
        assert summary["outside"] == {"second.mass": pytest.approx([0.16, 0.24])}
    run_campaign(directory, 1, jobs=1)
    written = write_report(directory)
    text = written.read_text()
    for anchor in re.findall(r'<a href="#([^"]+)"', text):
        assert f'id="{anchor}"' in text, anchor
    assert "On all legs the load stayed put in all 1 perturbed runs" in text
    assert 'href="report-leg2.html"' in text
    assert "mass of second 900 g (" in written.with_name("report-leg2.html").read_text()
    assert [path.name for path in write_export(directory, "csv", stem="leg2")] == ["leg2.csv"]
    for refused in (
        ("export", directory, "--format", "mujoco"),
        ("export", directory, "--format", "csv", "--plan", "leg2", "--pause", "1"),
        ("export", directory, "--format", "csv", "--pause", "-1"),
        ("execute", directory, "--yes", "--address", "172.16.0.2"),
        ("campaign", directory, "--plan", "leg1"),
        ("campaign", directory, "--stops"),
        ("simulate", directory, "--stop-at", "0.1"),
        ("simulate", directory, "--stop-at", "9"),
    ):
        assert main_of(*refused) == 2
        assert re.search("leg|no stops", capsys.readouterr().err)


@pytest.mark.slow
def test_a_file_of_all_legs_has_each_at_its_time_with_the_arm_at_rest_between(planned, directory, tmp_path, capsys):
    """Against the plans of the legs themselves, and read back from the file that the command writes."""
    motion = read_motion(directory, rate=200.0, pause=0.7)
    begins = 0.0
    for k, leg in enumerate(planned.legs):
        t = np.array([0.3, 0.61]) * leg.duration
        q = [np.interp(begins + t, motion.t, column) for column in motion.q.T]
        np.testing.assert_allclose(np.transpose(q), leg.joint.sample(t)[0], atol=1e-3)
        arrives = begins + leg.duration
        still = (motion.t > arrives + 1e-6) & (motion.t < arrives + 0.7 - 1e-6)
        assert still.sum() == (139 if k == 0 else 0)
        np.testing.assert_allclose(motion.q[still], np.broadcast_to(leg.joint.q[-1], (still.sum(), 7)), atol=1e-12)
        assert not np.diff(motion.q[still], axis=0).any()
        assert not motion.dq[still].any()
        begins = arrives + 0.7
    assert motion.t[-1] == pytest.approx(planned.duration + 0.7, abs=1e-8)
    assert np.diff(motion.t).min() > 0
    assert motion.p_SB is None  # the first object is another one from leg to leg
    tray = load_arm(planned.scenario.arm, planned.scenario.tray).tray_pose(motion.q[-1])[0]
    np.testing.assert_allclose(motion.p_SE[-1], tray, atol=1e-9)
    assert motion.verdict == planned.verdict
    assert main_of("export", directory, "--format", "yaml", "-o", tmp_path / "all.yaml", "--rate", 50) == 0
    assert "rests for 5 s between two legs" in capsys.readouterr().err
    again = read(tmp_path / "all.yaml")
    assert again.t[-1] == pytest.approx(planned.duration + 5.0, abs=1e-8)
    with pytest.raises(SalverError, match="it must be a number, 0 or more"):
        read_motion(directory, pause=-1.0)


@pytest.mark.slow
def test_an_audit_cuts_a_file_of_all_legs_at_its_rest_and_knows_what_is_taken_there(planned, directory, tmp_path):
    (path,) = write_export(directory, "csv", tmp_path / "all.csv", pause=0.8)
    first, second = audit_legs(path, planned.scenario)
    assert [len(one.scenario.payload.bodies) for one in (first, second)] == [4, 3]
    for one, leg in ((first, planned.legs[0]), (second, planned.legs[1])):
        assert one.ok, one.worst
        assert one.arm.code == "within_limits"  # by the joints beside the tray
        assert one.motion.samples.t[-1] == pytest.approx(leg.duration + 0.4, abs=0.03)
        samples = leg.reference.sample(np.linspace(0.0, leg.duration, 401))
        alike = margins(leg.scenario, samples, edges=one.margins.model.edges)  # finer pyramids than the plan's own
        assert one.margins.exact_worst.min() == pytest.approx(alike.exact_worst.min(), abs=1e-4)
    table = np.genfromtxt(path, delimiter=",", names=True)
    in_mm = {name: (1e3 if name.startswith("p_S") else 1.0) * table[name] for name in table.dtype.names}
    for one, again in zip((first, second), audit_legs(in_mm, planned.scenario, units="mm"), strict=True):
        assert np.allclose(one.motion.samples.p_SB, again.motion.samples.p_SB, rtol=0, atol=1e-6)
    (alone,) = write_export(directory, "csv", tmp_path / "leg1.csv", stem="leg1")
    with pytest.raises(FileFormatError, match=r"rests 0 times on its way.*2 legs need 1\."):
        audit_legs(alone, planned.scenario)


def test_a_motion_is_cut_in_the_middle_of_its_longest_rests():
    t = np.arange(0.0, 10.0, 0.01)
    moves = ((t > 1) & (t < 2)) | ((t > 4) & (t < 5)) | ((t > 5.2) & (t < 6)) | ((t > 8) & (t < 9))
    q = np.cumsum(np.where(moves, 0.003, 0.0))[:, None] * [1.0, -2.0]
    samples = JointSamples(t, ("a", "b"), q, None, None, "mine.csv")
    parts = [part(samples, some) for some in cuts_at_rests(samples, 3)]
    assert [part.t[0] for part in parts] == [0.0] * 3
    assert [part.t[-1] for part in parts] == pytest.approx([3.0, 4.0, 2.99], abs=0.02)
    begins = len(parts[0].t) - 1
    np.testing.assert_array_equal(parts[1].q, q[begins : begins + len(parts[1].t)])
    np.testing.assert_allclose(np.ptp(parts[1].q, axis=0), [0.003 * 178, 0.006 * 178], atol=0.013)
    assert len(cuts_at_rests(samples, 4)) == 4
    with pytest.raises(FileFormatError, match=r"mine\.csv rests 3 times on its way.*5 legs need 4\."):
        cuts_at_rests(samples, 5)


@pytest.mark.slow
def test_the_legs_of_a_round_are_timed_anew_each_on_its_own_path(planned, directory, tmp_path, capsys):
    """With more friction it goes faster, on the same path; the plan comes back from its file as it was written."""
    slippery = [{**item, "friction": 0.5} for item in task()["objects"]]
    (tmp_path / "rough.toml").write_text(tomli_w.dumps(task(objects=slippery)))
    assert main_of("retime", directory, "-s", tmp_path / "rough.toml", "-o", tmp_path / "again") == 0
    assert "the legs take" in capsys.readouterr().out
    again = load_round(tmp_path / "again")
    assert again.ok, again.verdict
    assert again.apart < 1e-9
    for one, other in zip(planned.legs, again.legs, strict=True):
        assert 0.6 * one.duration < other.duration < 1.02 * one.duration
        far = np.abs(one.joint.q[:, None] - other.joint.sample(np.linspace(0, other.duration, 801))[0]).max(axis=2)
        assert far.min(axis=1).max() < 0.02
    with pytest.raises(ScenarioError, match="round has 2 legs, and paths of 1 were given"):
        plan_retimed_legs(planned.scenario, [planned.legs[0].joint.q])


@pytest.mark.slow
def test_a_run_of_all_legs_is_one_film_and_one_file(planned, directory, tmp_path, capsys):
    assert main_of("simulate", directory, "--write", tmp_path / "done.csv") == 0
    records = [load_record(directory, f"leg{k}") for k in (1, 2)]
    done = read(tmp_path / "done.csv", as_path=True)
    assert len(done.t) == sum(len(record.t) for record in records)
    np.testing.assert_allclose(done.q[len(records[0].t)], records[1].q[0])
    assert main_of("render", directory, "-o", tmp_path / "f.gif", "--rate", 4, "--width", 32, "--height", 32) == 0
    pictures = sum(int(4 * record.t[-1] + 1e-9) + 1 for record in records)
    assert f"{pictures} pictures" in capsys.readouterr().err
    assert main_of("execute", directory, "--dry-run", "--no-realtime") == 0
    assert "leg 1 is done, then first taken off; leg 2 follows" in capsys.readouterr().err
    for number, leg in enumerate(planned.legs, 1):
        log_ = load_npz(directory / "execution" / f"leg{number}.npz")
        np.testing.assert_allclose(log_["q"][-1], leg.joint.q[-1], atol=2e-3)
    assert main_of("simulate", directory, "--speed", 0.8) == 0
    slow = load_npz(directory / "simulation" / "leg2-slow.npz")
    assert slow["t"][-1] - records[1].t[-1] == pytest.approx(0.25 * planned.legs[1].duration, abs=records[1].t[1])


def test_options_that_are_not_for_several_legs_are_refused(tmp_path, capsys):
    path = tmp_path / "round.toml"
    path.write_text(tomli_w.dumps(task()))
    refusals = {
        ("--beside", "nominal"): "legs",
        ("--no-arm",): "legs",
        ("--safest",): "--safest is not for a task of several legs",
        ("--duration", "3"): "planned as fast as is safe",
    }
    for option, words in refusals.items():
        assert main_of("plan", path, "-o", tmp_path / "run", *option) == 2
        assert words in capsys.readouterr().err
    with pytest.raises(SalverError, match="2 legs"):
        sv.audit({"t": np.arange(9.0), **dict.fromkeys(("x", "y", "z", "qw", "qx", "qy", "qz"), np.full(9, 0.5))}, path)


def main_of(*words):
    """Exit code of a command."""
    import sys
    from unittest.mock import patch

    with patch.object(sys, "argv", ["salver", *map(str, words)]), pytest.raises(SystemExit) as end:
        main()
    return end.value.code or 0


def test_a_pose_on_the_way_is_passed_whole_in_order_without_a_stop(planned):
    """Looked for in the motion itself, in steps of its own."""
    second = planned.legs[1]
    t = np.linspace(0, second.duration, 20001)
    samples = second.reference.sample(t)
    (pose,) = second.scenario.motion.through
    away = np.linalg.norm(samples.p_SB - pose.position, axis=1)
    nearest = int(np.argmin(away))
    assert away[nearest] <= 1e-3
    assert np.linalg.norm(log(samples.R_SB[nearest].T @ pose.rotation)) <= 5e-3
    assert np.linalg.norm(samples.v_S[nearest]) > 0.2
    assert second.verification.passes == pytest.approx(away[nearest], abs=1e-3)

    def judged(*poses):
        motion = second.scenario.motion.model_copy(update={"through": list(poses)})
        return replace(second, scenario=second.scenario.model_copy(update={"motion": motion})).verification

    moved = pose.model_copy(update={"position": (pose.position[0], pose.position[1], pose.position[2] + 2e-3)})
    assert not judged(moved).ok
    assert "misses a pose to pass by" in judged(moved).sentence
    half = samples.p_SB[nearest // 2], quat_wxyz_from_matrix(samples.R_SB[nearest // 2])
    earlier = scenarios.Pose.model_validate({"position": half[0].tolist(), "quat_wxyz": half[1].tolist()})
    assert judged(earlier, pose).ok
    assert not judged(pose, earlier).ok


def test_rows_of_a_pose_to_pass_need_no_unknown_for_the_time_of_passing():
    """By differences, coefficients and duration both changed, of a motion that passes at 0.3 mm between two nodes."""
    leg = parsed().each_leg[0]
    problem = transport_problem(leg, robust=False)
    one, other = chains([problem], np.random.default_rng(0))[0][0]
    spline, s = RestSpline(5, 6), np.linspace(0, 1, 101)
    grid = Grid.of(spline, spline.nodes(2))
    path = one + smooth_step(s)[:, None] * (other - one)
    path += 0.1 * np.sin(np.pi * s)[:, None] ** 2 * np.linspace(-1, 1, problem.n)
    at = spline.fit(s, path)
    p_SE, R_SE = problem.arm.tray_pose((spline.matrices(np.array([0.437]))[0] @ at)[0])
    constraint = PassPose(problem.arm, PoseTarget(p_SE + 3e-4, R_SE), "pose 1 to pass")
    programme = Programme(FreeCurve(problem, grid), (constraint,), SHORTEST)
    here = programme.begin(at, 0.8)
    rng, h = np.random.default_rng(2), 1e-5
    step = np.append(rng.normal(size=at.size), 0.7)
    rows = np.arange(12)
    derivatives = programme.derivatives(here, here.blocks[0], np.zeros(12, dtype=int), rows)
    claimed = derivatives @ step
    np.testing.assert_allclose(derivatives[:, -1], 0.0, atol=1e-9)  # the same path in another time passes the same

    def values(sign):
        moved = at + sign * h * step[:-1].reshape(at.shape)
        return programme.begin(moved, 0.8 * np.sqrt(1 + sign * h * step[-1])).blocks[0].values[0]

    found = (values(1) - values(-1)) / (2 * h)
    assert np.abs(found).max() > 1.0
    np.testing.assert_allclose(claimed, found, atol=5e-3 * np.abs(found).max())
