"""`salver execute --live`: the driver's loop on a live motion, its stops, and what is kept of it."""

import io
import json
import sys
import time
from dataclasses import replace

import numpy as np
import pytest
from typer.testing import CliRunner

import salver as sv
import salver.driver.live as module
from live_runs import EVERY, LEAD, PATIENCE
from pylibfranka_stand_in import Library
from salver.cli import app
from salver.driver.execution import Watchdog
from salver.driver.live import LiveRunOptions, commanded, run_live
from salver.driver.robots.franka import within_fr3
from salver.driver.robots.simulated import SimulatedRobot
from salver.driver.signals import Signals
from salver.errors import SalverError
from salver.live import Live, LiveCourse
from salver.live.options import LiveOptions
from salver.live.script import Prompter, script
from salver.planning.plan import load_plan
from salver.trajectory import JointMotion

# On a machine with other work, hundreds of periods may pass.
PATIENT = Watchdog(joint_error=3.0, velocity_share=100.0, late_periods=10**6)
SHORT = {"physics__settle_before": 0.05, "physics__settle_after": 0.1}
GOAL = {"t": 0, "goto": [0.45, 0.1, 0.45]}


@pytest.fixture(scope="module")
def cube():
    return sv.load_scenario("panda-cube").with_changes(**SHORT)


def lines(*wishes):
    return [json.dumps(wish) for wish in wishes]


class Interrupting(Signals):
    """Asks for a stop at a time of the motion."""

    def __init__(self, at):
        super().__init__()
        self.at = at

    def wish(self, t):
        if t >= self.at - 1e-9:
            self.note("Protective stop")
        return super().wish(t)


def test_before_the_first_request_the_arm_rests_for_as_long_as_is_said(cube):
    plan = module._resting(cube, Live(cube), 0.3)
    assert plan.duration == 0.3
    assert np.array_equal(plan.joint.q, np.tile(Live(cube).problem.start.q, (2, 1)))


@pytest.mark.slow
def test_what_is_told_is_done_and_kept_as_a_plan_that_can_be_simulated_and_exported(cube, tmp_path):
    told = lines(
        GOAL,
        {"t": 0.3, "goto": [0.5, -0.3, 0.4]},
        {"t": 0.7, "twist": [0.1, 0.1, 0.0, 0.0], "for": 0.2},
        {"t": 1.3, "goto": [9.0, 0.0, 0.5]},
    )
    result = run_live(cube, told, tmp_path, realtime=False)
    assert result.achieved
    assert result.summary["objects"][0]["peak_slip"] < 1e-4
    answers = [note["answer"] for note in result.summary["wishes"]]
    assert answers[:3] == ["Accepted."] * 3
    assert answers[-1].endswith("is refused: no posture of the arm within its limits reaches it.")
    plan = load_plan(tmp_path)
    assert plan.ok
    # What the arm did, at 200 Hz, is what was commanded, but for the controller's error.
    t, q = result.arrays["t"], result.arrays["q"]
    assert np.abs(plan.joint.sample(t)[0] - q)[t >= 0].max() < 1e-3
    table = tmp_path / "commanded.csv"
    assert (
        CliRunner()
        .invoke(app, ["export", str(tmp_path), "--format", "csv", "--rate", "1000", "-o", str(table)])
        .exit_code
        == 0
    )
    kept = np.genfromtxt(table, delimiter=",", names=True)
    columns = np.stack([kept[f"q_panda_joint{j}"] for j in range(1, 8)], axis=1)
    assert len(kept) >= 1000 * plan.duration
    assert np.abs(columns - plan.joint.sample(kept["t"])[0]).max() < 1e-9
    assert sv.simulate(plan).outcome == "holds"


@pytest.mark.slow
def test_the_same_script_gives_the_same_run(cube, tmp_path):
    near = lines({"t": 0, "goto": [0.5, -0.25, 0.42]})
    runs = [run_live(cube, near, tmp_path / name, realtime=False) for name in "ab"]
    assert np.ptp(runs[0].arrays["q"], axis=0).max() > 0.05
    assert np.array_equal(runs[0].arrays["q"], runs[1].arrays["q"])


FAR = {"t": 0, "goto": [0.45, 0.2, 0.5]}


@pytest.fixture(scope="module")
def slow_cube(cube):
    return cube.with_changes(arm__velocity_scale=0.3)  # so that there is something to stop for long enough


@pytest.fixture(scope="module")
def whole(slow_cube, tmp_path_factory):
    """What nothing stopped: its plan."""
    folder = tmp_path_factory.mktemp("whole")
    assert run_live(slow_cube, lines(FAR), folder, realtime=False).achieved
    return load_plan(folder)


def test_what_was_commanded_is_judged_along_all_of_it(cube, tmp_path):
    """Between knots that are far apart the tray moves as the joints say; a jolt of 0.04 s in ten seconds is seen."""
    arm, q = Live(cube).problem.arm, Live(cube).command(0.0)[0]
    turn = np.eye(7)[0]
    jolt = 1e-3 * turn  # rad, there and back, 20 ms each: 14 rad/s^2, 7 m/s^2 at the tray
    t = np.array([0.0, 1.2, 6.008, 6.028, 6.048, 10.0])
    there = np.array([q, *[q + 0.8 * turn] * 5])
    still = np.zeros_like(there)
    calm = commanded(cube, JointMotion(t, there, still, still))
    calm.save(tmp_path)
    assert calm.verification.ok
    assert np.diff(calm.t).max() < 0.0101
    for at in (0.35, 0.55, 0.85):
        a_S, before, after = (calm.reference.sample(x) for x in ([at], [at - 1e-4], [at + 1e-4]))
        body = cube.payload.bodies[0]
        p, near, far = (
            arm.object_pose(calm.joint.sample([x])[0][0], body.p_EB, body.R_EB)[0] for x in (at, at - 1e-4, at + 1e-4)
        )
        np.testing.assert_allclose(a_S.p_SB[0], p, atol=1e-7)
        np.testing.assert_allclose(a_S.a_S[0], (far - 2 * p + near) / 1e-8, atol=1e-3)
        np.testing.assert_allclose(after.v_S[0] - before.v_S[0], 2e-4 * a_S.a_S[0], atol=1e-7)
    assert load_plan(tmp_path).verification.sentence == calm.verification.sentence
    there[3] += jolt
    shaken = commanded(cube, JointMotion(t, there, still, still))
    assert not shaken.verification.ok
    assert 6.0 < shaken.verification.time < 6.06
    assert not shaken.margins.verdict(worst=True).ok


@pytest.mark.slow
@pytest.mark.parametrize("planner", ["plans", "is dead"])
def test_a_stop_is_sooner_than_finishing_also_when_the_planner_is_dead(
    slow_cube, whole, tmp_path, planner, monkeypatch
):
    """Stops that are ready are held by the loop: who planned them may be gone."""
    end = whole.duration - 0.1
    signals = Interrupting(0.45)
    if planner == "is dead":
        plan, prepare = Live.plan, Live.prepare
        monkeypatch.setattr(Live, "plan", lambda live, *a: plan(live, *a) if not signals.seen else live.state)
        monkeypatch.setattr(Live, "prepare", lambda live, *a: not signals.seen and prepare(live, *a))
    result = run_live(slow_cube, lines(FAR), tmp_path / "stopped", realtime=False, signals=signals)
    assert result.summary["stopped"] == "Protective stop at t = 0.450 s."
    assert result.summary["load_kept_in_stop"] is True
    assert result.summary["objects"][0]["outcome"] == "holds"
    assert not result.achieved
    stopped = load_plan(tmp_path / "stopped")
    assert stopped.ok
    moving = np.flatnonzero(np.abs(stopped.joint.dq).max(axis=1) > 1e-6)
    rests = stopped.joint.t[moving[-1]]
    assert rests < end - 0.2
    assert rests < 0.45 + 0.4  # the stops of the cube's fastest plan take 0.3 s at most; one begins every 0.1 s
    # Until it was asked for nothing was different.
    same = stopped.joint.t < 0.45
    assert np.array_equal(stopped.joint.q[same], whole.joint.q[: same.sum()])


@pytest.mark.slow
def test_states_that_stay_false_end_in_a_stop_that_may_not_keep_the_load(cube, tmp_path, monkeypatch):
    """A joint's reading that jumps and stays there: the arm is braked, and nobody says that the load surely stays."""
    look = SimulatedRobot.look

    def false(self):
        state = look(self)
        if self._recorder.count > 400:
            state.q[3] += 0.15
        return state

    monkeypatch.setattr(SimulatedRobot, "look", false)
    result = run_live(cube, lines(GOAL), tmp_path, realtime=False)
    assert result.summary["stopped"]
    assert result.summary["load_kept_in_stop"] is False
    assert np.abs(result.arrays["dq"][-1]).max() < 0.02


@pytest.mark.slow
def test_on_a_franka_what_its_own_limits_forbid_is_not_committed(cube, tmp_path, monkeypatch):
    """The Research 3 accelerates its joints by 10 rad/s^2, the Panda some by 20, and near the end of its range it turns
    them more slowly than in the middle."""
    run_live(cube, [], tmp_path / "still", realtime=False)
    still = load_plan(tmp_path / "still")
    fake = Library(still)
    monkeypatch.setitem(sys.modules, "pylibfranka", fake)
    standing = module._real  # whose time waits for the planner
    monkeypatch.setattr(module, "_real", lambda *given: replace(standing(*given), waits=True))
    told = lines({"t": 0, "goto": [0.5, -0.35, 0.5]})
    result = run_live(cube, told, tmp_path / "run", "franka", "arm", PATIENT)
    assert result.summary["stopped"] == ""
    assert fake.calls[-1] == ("stopped",)
    joint = load_plan(tmp_path / "run").joint
    assert np.abs(joint.q[-1] - joint.q[0]).max() > 0.1
    assert within_fr3(sv.Live(cube).problem.arm, joint) == ""
    assert np.abs(joint.ddq).max() > 8.0


def test_what_the_research_3_does_not_do_is_said():
    arm = sv.Live("panda-cube").problem.arm
    t = np.linspace(0, 0.2, 101)[:, None]
    q = np.array([0.0, -0.5, 0.0, -2.0, 0.0, 1.8, 0.0]) + 0.5 * 12.0 * np.array([1.0, *[0.0] * 6]) * (t - 0.1) ** 2
    dq, ddq = np.zeros((101, 7)), np.zeros((101, 7))
    dq[:, 0], ddq[:, 0] = 12.0 * (t[:, 0] - 0.1), 12.0
    words = within_fr3(arm, JointMotion(t[:, 0], q, dq, ddq))
    assert words.startswith("panda_joint1 uses 120 % of the Franka Research 3's acceleration limit")
    rest = JointMotion(np.array([0.0, 1.0]), q[50:52] * [[1], [1]], np.zeros((2, 7)), np.zeros((2, 7)))
    assert within_fr3(arm, JointMotion(rest.t, np.tile(q[50], (2, 1)), rest.dq, rest.ddq)) == ""


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("goto 1 2 3", "is not JSON"),
        ("[1, 2]", "it is not a JSON object"),
        (
            '{"t": 1}',
            "it has none of goto, posture, twist, jog, chunk, stop, resume, override, hold, release, put, remove; "
            "a line has one of them",
        ),
        ('{"stop": true, "goto": [1, 2, 3]}', "it has goto and stop of"),
        ('{"stop": false}', "stop is false; it must be true"),
        ('{"stop": 1}', "stop is 1; it must be true"),
        ('{"resume": "yes"}', 'resume is "yes"; it must be true'),
        ('{"hold": 1}', "hold is 1; it must be true"),
        ('{"release": false}', "release is false; it must be true"),
        ('{"stop": true, "reason": 3}', "reason is 3; it must be a text"),
        ('{"goto": [1, 2, 3], "queued": "no"}', 'queued is "no"; it must be true or false'),
        ('{"goto": [1, 2, 3], "source": "me"}', 'source is "me"; it must be one of policy, operator, monitor'),
        ('{"t": true, "goto": [1, 2, 3]}', "t is true; it must be a number of seconds"),
        ('{"t": 1' + "0" * 400 + ', "stop": true}', "0...; it must be a number of seconds"),
        ('{"t": 1' + "0" * 5000 + ', "stop": true}', "is not JSON"),
        ('{"goto": ' + "[" * 50_000 + "]" * 50_000 + "}", "is not JSON"),
        ('{"goto": ' + "[" * 400 + "]" * 400 + "}", "it is nested deeper than any request is"),
        ('{"t": -1, "stop": true}', "t is -1; it must be a number of seconds from 0 on"),
        ('{"t": "now", "stop": true}', 't is "now";'),
        ('{"goto": [1, 2, 3], "for": 2}', '"for" is not a key of a line with goto'),
        ('{"twist": [1, 2], "for": 2}', "twist must be three numbers"),
        ('{"twist": [1, 2, 3], "for": -1}', "for is -1; it must be a number of seconds, at least 0"),
    ],
)
def test_a_line_that_cannot_be_understood_is_named(line, words):
    with pytest.raises(SalverError) as told:
        list(script(["# what follows is wrong", "", line], "wishes.jsonl"))
    assert str(told.value).startswith("wishes.jsonl, line 3: ")
    assert words in str(told.value)


def test_times_that_go_back_are_refused():
    with pytest.raises(SalverError, match=r"line 2: t is 0\.5; it must be a number of seconds from 1 on"):
        list(script(lines({"t": 1, "stop": True}, {"t": 0.5, "stop": True}), "wishes"))


class Heard:
    """Stands where a live motion would be told, and notes what it is told when."""

    refused = ""

    def __init__(self):
        self.told = []

    def __getattr__(self, name):
        def told(*given, **named):
            self.told.append((name, given, named))
            return sv.errors.Status("accepted", "Accepted.", True)

        return told


def test_wishes_are_said_at_their_times_and_a_twist_as_long_as_it_lasts():
    heard = Heard()
    prompter = Prompter(heard).of(
        script(
            lines(
                {"t": 0.01, "goto": [0.4, 0.0, 0.5], "source": "policy"},
                {"posture": [0.0] * 7, "queued": True},
                {"t": 0.03, "twist": [0.1, 0.2, 0.3, 0.4], "for": 0.1},
                {"t": 0.2, "chunk": [0.1, 0.2], "postures": [[0.0] * 7] * 2},
                {"t": 0.25, "stop": True},
                {"t": 0.3, "twist": [0.1, 0.2, 0.3], "frame": "tray"},
                {"t": 0.31, "jog": [0.1, 0.2]},
                {"t": 0.32, "put": {"name": "crate", "type": "sphere", "position": [0, 0, 1], "radius": 0.1}},
                {"t": 0.33, "remove": "crate"},
                {"t": 0.335, "chunk": [0.1], "positions": [[0.4, 0.0, 0.5]], "quats_wxyz": [[0.0, 0.0, 0.0, 2.0]]},
                {"t": 0.34, "put": {"name": "crate", "type": "sphere", "velocity": [0, 0, 1]}},
            ),
            "wishes",
        )
    )
    for k in range(-50, 400):
        before = len(heard.told)
        prompter.period(k * 1e-3)
        assert len(heard.told) <= before + 1
    names = [name for name, *_ in heard.told]
    assert names == ["goto", "goto"] + ["twist"] * 6 + ["chunk", "stop", "twist", "jog", "put", "remove", "chunk"]
    assert heard.told[10] == ("twist", ([0.1, 0.2, 0.3], (0.0, 0.0, 0.0)), {"frame": "tray", "source": "operator"})
    assert heard.told[11] == ("jog", ([0.1, 0.2],), {"source": "operator"})
    times, (places, turned) = heard.told[14][1]
    assert (times, places) == ([0.1], [[0.4, 0.0, 0.5]])
    np.testing.assert_allclose(turned, [np.diag([-1.0, -1.0, 1.0])], atol=1e-12)
    crate = heard.told[12][1][0]
    assert (crate.name, crate.type, crate.position, crate.radius) == ("crate", "sphere", [0, 0, 1], 0.1)
    assert "an obstacle has a name, a type and some of length, position, radius" in prompter.notes[-1]["answer"]
    assert heard.told[0] == ("goto", ([0.4, 0.0, 0.5],), {"queued": False, "source": "policy"})
    assert heard.told[1] == ("goto", (), {"q": [0.0] * 7, "queued": True, "source": "operator"})
    assert heard.told[2][1] == ([0.1, 0.2, 0.3], (0.0, 0.0, 0.4))
    assert prompter.over
    assert [note["t"] for note in prompter.notes] == pytest.approx(
        [0.01, 0.011, 0.03, 0.2, 0.25, 0.3, 0.31, 0.32, 0.33, 0.335, 0.34]
    )


def test_a_twist_lasts_while_the_cell_and_the_speed_change():
    """Until another motion, a stop or a hold is requested."""
    ball = {"name": "ball", "type": "sphere", "position": [0, 0, 1], "radius": 0.1}
    for said, lasts in (({"put": ball}, 6), ({"remove": "ball"}, 6), ({"override": 0.5}, 6), ({"hold": True}, 3)):
        heard = Heard()
        prompter = Prompter(heard).of(
            script(lines({"t": 0.0, "twist": [0.1, 0.0, 0.0], "for": 0.1}, {"t": 0.05, **said}), "wishes")
        )
        for k in range(200):
            prompter.period(k * 1e-3)
        assert [name for name, *_ in heard.told].count("twist") == lasts
        assert prompter.over


def test_a_run_takes_its_options():
    """The record of the live motion is as long as the run, unless it is to be longer."""
    assert LiveRunOptions(longest=300.0).kept.record == 300.0
    assert LiveRunOptions(longest=30.0, live=LiveOptions(record=500.0)).kept.record == 500.0
    assert run_live.__kwdefaults__["realtime"]  # only a simulated arm can wait for the planner


def heard_in(prompter, heard, periods):
    """What is requested in so many periods, once all lines have come."""
    while not prompter._ended:
        time.sleep(1e-3)
    for k in range(periods):
        prompter.period(k * 1e-3)
    return [name for name, *_ in heard.told]


def test_a_stop_waits_for_no_line_before_it():
    """Twelve hundred twists come before it, and what comes after it is judged after it."""
    heard = Heard()
    told = [*lines(*[{"twist": [0.1, 0.0, 0.0]}] * 1200, {"stop": True}, {"goto": [0.5, 0.0, 0.5]})]
    prompter = Prompter(heard).listening(io.StringIO("\n".join(told)), "standard input")
    assert heard_in(prompter, heard, 1) == ["stop"]
    assert prompter.dropped == 1200
    assert heard_in(prompter, heard, 1) == ["stop", "goto"]
    assert prompter.over


def test_a_timed_stop_comes_in_time_whatever_waits():
    heard = Heard()
    told = [{"twist": [0.1, 0.0, 0.0]}] * 900 + [{"t": 0.1, "stop": True}, {"goto": [0.5, 0.0, 0.5]}]
    prompter = Prompter(heard).of(script(lines(*told), "wishes"))
    names = heard_in(prompter, heard, 105)
    assert names == ["twist"] * 100 + ["stop", "goto"]
    assert (prompter.accepted, prompter.dropped) == (102, 800)


def test_a_timed_stop_that_comes_does_not_wait_for_a_later_time():
    heard = Heard()
    told = lines({"t": 60.0, "goto": [0.4, 0.0, 0.5]}, {"t": 0.05, "stop": True}, {"goto": [0.5, 0.0, 0.5]})
    prompter = Prompter(heard).listening(told, "standard input")
    assert heard_in(prompter, heard, 50) == []  # what comes after it waits for it
    assert heard_in(prompter, heard, 60) == ["stop", "goto"]
    assert (prompter.dropped, prompter.over) == (1, True)


def test_a_script_that_is_known_is_carried_out_to_its_end_however_long():
    heard = Heard()
    prompter = Prompter(heard).of(script(lines(*[{"twist": [0.1, 0.0, 0.0]}] * 1500), "wishes"))
    assert heard_in(prompter, heard, 1600) == ["twist"] * 1500
    assert prompter.dropped == 0


def test_nothing_that_comes_makes_it_deaf():
    heard = Heard()
    deep = b'{"goto": ' + b"[" * 100_000 + b"]" * 100_000 + b"}"
    coming = [b'{"twist": [0.1, 0, 0]}', b"\xff\xfe{}", deep, b'{"t": 1e999, "goto": [0, 0, 0]}', b'{"stop": true}']
    prompter = Prompter(heard).listening(coming, "standard input")
    assert heard_in(prompter, heard, 10) == ["stop"]
    heard = Heard()
    prompter = Prompter(heard).listening(coming[1:4], "standard input")
    heard_in(prompter, heard, 10)
    said = [note["answer"] for note in prompter.notes]
    assert "line 1: it is no text in UTF-8" in said[0]
    assert "line 2: '{" in said[1]
    assert "is not JSON" in said[1]
    assert "line 3: t is Infinity" in said[2]

    def breaking():
        yield b'{"twist": [0.1, 0, 0]}'
        raise OSError("the line was cut")

    prompter = Prompter(heard).listening(breaking(), "standard input")
    heard_in(prompter, heard, 10)
    assert prompter.notes[-1]["answer"] == "standard input cannot be read any more (OSError: the line was cut)."
    assert prompter.over


def test_lines_that_come_are_not_kept_without_end():
    heard = Heard()
    prompter = Prompter(heard).listening(lines(*[{"twist": [0.1, 0.0, 0.0]}] * 3_000), "standard input")
    heard_in(prompter, heard, 0)
    assert (len(prompter._waiting), prompter.dropped) == (1000, 2_000)


@pytest.mark.slow
def test_a_run_of_which_all_was_refused_does_not_end_well(cube, tmp_path, monkeypatch):
    """And one of whose lines some were granted does; so does one told nothing, planned for every 20 periods."""
    refused = lines({"goto": [9.0, 0.0, 900.0]}, {"twist": [99.0, 0.0, 0.0]})
    result = run_live(cube, refused, tmp_path / "a", realtime=False)
    assert result.summary["requests"] == {"accepted": 0, "refused": 2, "dropped": 0}
    assert result.summary["outcome"] == "holds"
    assert not result.achieved
    assert run_live(cube, [*refused, '{"stop": true}'], tmp_path / "b", realtime=False).achieved
    planned, prepare = [], Live.prepare
    monkeypatch.setattr(Live, "prepare", lambda live, *given: planned.append(live.now) or prepare(live, *given))
    assert run_live(cube, [], tmp_path / "c", realtime=False).achieved
    assert len(planned) > 3
    assert np.diff(planned) == pytest.approx(1e-3 * LiveRunOptions().every)


def test_commands_that_cannot_be(tmp_path):
    run = CliRunner().invoke
    script_file = tmp_path / "s.jsonl"
    script_file.write_text('{"stop": true}\n')
    for args, words in (
        (["panda-cube", "--live", str(tmp_path / "none")], "cannot be read"),
        (["panda-cube", "--live", str(script_file)], "Give the arm's --address"),
        (["panda-cube", "--live", str(script_file), "--move-to-start"], "--live goes with none of"),
        (["panda-cube", "--live", "-", "--address", "arm"], "give --yes"),
        (["ur10-bottle", "--live", str(script_file), "--address", "arm"], "--robot franka drives a panda or an fr3."),
        (["tall-box-40", "--live", str(script_file), "--dry-run"], "arm"),
        (["panda-cube", "--live", str(script_file), "--dry-run", "--longest", "0"], "--longest is 0 s; it must be"),
        (["panda-cube", "--live", str(script_file), "--dry-run", "--longest", "nan"], "--longest is nan s; it must be"),
        (
            ["panda-cube", "--live", str(script_file), "--dry-run", "--longest", "3"],
            "at most 3 s is too short",
        ),
    ):
        result = run(app, ["execute", *args, "-o", str(tmp_path / "out")])
        assert result.exit_code == 2, args
        assert words in result.stderr


def test_a_restart_leaves_the_planners_work_space_alone(cube):
    """What the loop asks while a planner computes distances must not be computed with the planner's own data."""
    live = sv.Live(cube)
    parts = live.problem.keep_out.parts
    q = live.committed.motion.q[0]
    parts.clearance(q[None] + 0.1)
    placed = [np.array(parts.data.oMg[k].homogeneous) for k in range(len(parts.names))]
    assert live.restart(q).ok
    assert all(np.array_equal(a, parts.data.oMg[k].homogeneous) for k, a in enumerate(placed))


@pytest.mark.slow
def test_a_run_ends_at_rest_within_the_time_that_the_command_gives(tmp_path):
    """A twist for 9 s would take it 9 s."""
    (tmp_path / "s.jsonl").write_text("\n".join(lines({"twist": [0.0, 0.0, 0.01], "for": 9.0})))
    command = ["execute", "panda-cube", "--live", str(tmp_path / "s.jsonl"), "--dry-run", "--no-realtime"]
    CliRunner().invoke(app, [*command, "--longest", "7", "-o", str(tmp_path / "out"), "--json"])
    plan = load_plan(tmp_path / "out")
    assert 1.0 < plan.duration < 7.0
    assert np.abs(plan.joint.dq[-1]).max() < 1e-9


def test_what_a_course_gave_stays_what_it_was(cube):
    """A loop keeps references of the periods before, to which an arm that follows late is compared."""
    live = Live(cube, lead=LEAD)
    course = LiveCourse(live)
    live.goto((0.45, 0.1, 0.45))
    for k in range(300):
        course.instant(1e-3 * k)
        if k % EVERY == 0:
            live.plan(PATIENCE)
    before = course.at(0, 0.0)
    kept = [x.copy() for x in before]
    course.instant(0.3)
    assert all(np.array_equal(x, y) for x, y in zip(before, kept, strict=True))
    assert all(np.any(x != y) for x, y in zip(course.at(0, 0.0), kept, strict=True))
