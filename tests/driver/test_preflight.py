"""What is checked before an arm moves: of the very joint motion that will be sent, each check by itself."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from driver_rig import Rig
from salver import scenario
from salver.control.arm import ArmState
from salver.driver.preflight import check_approach, check_plan, check_posture, demand, looked_at
from salver.driver.robots.franka import FR3, check_franka
from salver.errors import SalverError, Status
from salver.geometry import Array
from salver.models.arm.arm import ArmModel, load_arm
from salver.models.arm.arm_geometry import arm_geometry
from salver.planning.follow.clearance import sweep
from salver.planning.follow.forward import tray_motion
from salver.planning.make import make_plan
from salver.planning.plan import Plan
from salver.trajectory import JointMotion, SampledReference

CASE = scenario.load("panda-cube").with_changes(motion__duration=1.4)


@pytest.fixture(scope="module")
def arm() -> ArmModel:
    return load_arm(CASE.arm, CASE.tray)  # type: ignore[arg-type]


@pytest.fixture(scope="module")
def plan() -> Plan:
    return make_plan(CASE, "baseline")


def failed(plan: Plan, arm: ArmModel) -> dict[str, str]:
    return {c.name: c.sentence for c in check_plan(plan, arm, plan.scenario.payload.bodies) if c.required and not c.ok}


def carried_by(plan: Plan, arm: ArmModel, joint: JointMotion) -> Plan:
    """A plan that claims to be safe, whose reference is just what these joints give."""
    body = plan.scenario.payload.first
    reference = SampledReference(tray_motion(arm, looked_at(joint)).of_frame(body.p_EB, body.R_EB))
    return replace(plan, joint=joint, reference=reference)


def by_itself(q_from: Array, q_to: Array, duration: float, count: int = 141) -> JointMotion:
    """A quintic from rest to rest."""
    x = np.linspace(0, 1, count)[:, None]
    step, rate, bend = x**3 * (10 - 15 * x + 6 * x**2), 30 * (x * (1 - x)) ** 2, 60 * x * (1 - x) * (1 - 2 * x)
    change = q_to - q_from
    return JointMotion(
        duration * x[:, 0], q_from + step * change, rate * change / duration, bend * change / duration**2
    )


def test_good_plans_pass_every_check(plan: Plan, arm: ArmModel) -> None:
    checks = check_plan(plan, arm, plan.scenario.payload.bodies)
    assert [c.name for c in checks if not c.ok] == ["stops"], checks  # it has none
    assert {c.name for c in checks} >= {
        "numbers", "plan", "limits", "clearance", "reference", "verdict", "rest"
    }  # fmt: skip
    demand(checks + check_franka(plan.scenario, arm, plan.joint))


@pytest.mark.slow
def test_a_plan_that_tilts_the_tray_passes_every_check(arm: ArmModel) -> None:
    """Poses are compared where the tray is neither level nor straight."""
    tilting = make_plan(scenario.load("panda-cube"), "fastest")
    samples = tilting.reference.sample(np.linspace(0, tilting.duration, 20))
    assert samples.R_SB[:, 2, 2].min() < np.cos(0.1)
    demand(check_plan(tilting, arm, tilting.scenario.payload.bodies))


@pytest.mark.parametrize("name", ["t", "q", "dq", "ddq"])
@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_what_is_no_number_is_refused_wherever_it_stands(plan: Plan, arm: ArmModel, name: str, value: float) -> None:
    array = getattr(plan.joint, name).copy()
    for index in (0, len(array) // 2, -1):
        spoilt = array.copy()
        spoilt[index] = value
        said = failed(replace(plan, joint=replace(plan.joint, **{name: spoilt})), arm)  # type: ignore[type-var]
        assert "where a number must be" in said["numbers"]
        assert f"joint_{name}" in said["numbers"]


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda j: replace(j, t=j.t + 0.1), "does not increase from 0"),
        (lambda j: replace(j, t=np.sort(np.r_[j.t[:-1], j.t[5]])), "does not increase from 0"),
        (lambda j: replace(j, t=j.t[::-1].copy()), "does not increase from 0"),
        (lambda j: replace(j, t=2 * j.t), "it lasts 2.8 s and the object's motion 1.4 s"),
        (lambda j: replace(j, t=1e9 * j.t), "more than can be judged"),
        (lambda j: replace(j, q=j.q[:, :6]), "joint_q is an array of float64 of shape"),
        (lambda j: replace(j, dq=j.dq[1:]), "joint_dq is an array"),
        (lambda j: replace(j, ddq=j.ddq.astype(complex)), "joint_ddq is an array of complex128"),
        (lambda j: JointMotion(j.t[:1], j.q[:1], j.dq[:1], j.ddq[:1]), "joint_t is an array"),
    ],
)
def test_arrays_that_are_no_motion(
    plan: Plan, arm: ArmModel, change: Callable[[JointMotion], JointMotion], words: str
) -> None:
    assert plan.joint is not None
    assert words in failed(replace(plan, joint=change(plan.joint)), arm)["numbers"]


def test_a_reference_that_is_no_number_is_refused(plan: Plan, arm: ArmModel) -> None:
    position = plan.reference.position.copy()  # type: ignore[attr-defined]
    position[2, 1] = np.nan
    spoilt = replace(plan, reference=replace(plan.reference, position=position))  # type: ignore[type-var]
    assert "holds what is no number" in failed(spoilt, arm)["numbers"]


@pytest.mark.slow
def test_joints_of_another_plan_are_refused(plan: Plan, arm: ArmModel) -> None:
    goal = {"position": [0.5, 0.2, 0.5]}
    other = make_plan(CASE.with_changes(motion__goal=goal), "baseline")
    assert other.joint is not None
    assert other.ok
    assert "reference" in failed(replace(plan, joint=other.joint), arm)
    nearly = replace(plan.joint, q=plan.joint.q + 1e-4)  # type: ignore[type-var, union-attr]
    assert set(failed(replace(plan, joint=nearly), arm)) == {"reference"}


@pytest.mark.parametrize("name", ["q", "dq", "ddq"])
def test_one_sample_that_does_not_belong_is_refused(plan: Plan, arm: ArmModel, name: str) -> None:
    array = getattr(plan.joint, name).copy()
    array[40, 3] += {"q": 1e-4, "dq": 1e-2, "ddq": 1.0}[name]
    assert failed(replace(plan, joint=replace(plan.joint, **{name: array})), arm)  # type: ignore[type-var]


def test_samples_that_contradict_each_other_are_seen_even_where_the_reference_follows_them(
    plan: Plan, arm: ArmModel
) -> None:
    """A speed that is 0.05 rad/s off, 5 ms from its neighbours, bends the motion by some 0.05 / 5 ms = 10 rad/s^2."""
    assert plan.joint is not None
    dq = plan.joint.dq.copy()
    dq[40, 3] += 0.05
    said = failed(carried_by(plan, arm, replace(plan.joint, dq=dq)), arm)
    assert "panda_joint4" in said["limits"]
    assert "acceleration of panda_joint4" in said["verdict"]


@pytest.mark.slow
def test_an_unsafe_baseline_is_refused_like_any_other(arm: ArmModel) -> None:
    case = CASE.with_changes(motion__duration=1.0)
    unsafe = make_plan(case, "baseline")
    assert "The straight min-jerk line is not safe" in failed(unsafe, arm)["plan"]
    assert "The plan is not safe" in failed(replace(unsafe, status=Status("evaluated", "", True)), arm)["plan"]


def test_a_plan_whose_arm_cannot_follow_is_not_ok(plan: Plan, arm: ArmModel) -> None:
    told = Status("collision", "tray and pole touch at t = 0.88 s.", False)
    assert not replace(plan, arm_status=told).ok
    assert "tray and pole touch at t = 0.88 s" in failed(replace(plan, arm_status=told), arm)["plan"]


def rough(plan: Plan, share: float, **more: Any) -> Plan:
    """The plan with a friction that is a share of what its acceleration sideways takes."""
    lateral = float(np.linalg.norm(plan.reference.sample(plan.t).a_S[:, :2], axis=1).max())
    return replace(plan, scenario=plan.scenario.with_changes(objects__0__friction=share * lateral / 9.81, **more))


def test_contact_is_judged_for_the_whole_uncertain_set(plan: Plan, arm: ArmModel) -> None:
    """A friction of 1.25 times what is needed is enough, and .75 times, the least of 1.25 +- 40 %, is not."""
    assert "verdict" not in failed(rough(plan, 1.25), arm)
    unsure = rough(plan, 1.25, objects__0__uncertainty={"friction": "40%"})
    assert "contact of cube would be exceeded" in failed(unsure, arm)["verdict"]


@pytest.mark.parametrize("end", ["start", "goal"])
def test_a_plan_that_misses_its_ends_by_ten_nanometres_is_not_ok(plan: Plan, arm: ArmModel, end: str) -> None:
    position = [*getattr(CASE.motion, end).position]
    position[1] += 1e-8
    moved = replace(plan, scenario=plan.scenario.with_changes(**{f"motion__{end}__position": position}))
    assert not moved.ok
    assert "misses its start or goal by 1e-08" in failed(moved, arm)["plan"]


def test_a_motion_that_loses_the_load_is_refused_by_its_contact(plan: Plan, arm: ArmModel) -> None:
    """Friction is a tenth less than it takes."""
    said = failed(rough(plan, 0.9), arm)
    assert "contact of cube would be exceeded" in said["verdict"]
    assert "reference" not in said


@pytest.mark.parametrize("end", [0, pytest.param(-1, marks=pytest.mark.slow)])
@pytest.mark.parametrize(("name", "value"), [("dq", 1e-3), pytest.param("ddq", 0.1, marks=pytest.mark.slow)])
def test_a_motion_must_begin_and_end_at_rest(plan: Plan, arm: ArmModel, end: int, name: str, value: float) -> None:
    assert plan.joint is not None
    array = getattr(plan.joint, name).copy()
    array[end, 2] = value
    assert f"{value:.1g} rad/s" in failed(replace(plan, joint=replace(plan.joint, **{name: array})), arm)["rest"]


def test_what_is_cut_out_of_a_motion_does_not_end_at_rest(plan: Plan, arm: ArmModel) -> None:
    j = plan.joint
    assert j is not None
    cut = slice(0, 150)
    begun = JointMotion(j.t[cut], j.q[cut], j.dq[cut], j.ddq[cut])
    assert "it must be at rest there" in failed(carried_by(plan, arm, begun), arm)["rest"]


def test_obstacles_of_the_scenario_are_kept_clear_of(plan: Plan, arm: ArmModel) -> None:
    """A pole in the middle of the way, which the plan knew nothing of; and one beside it."""
    middle = plan.reference.sample(0.7).p_SB[0]
    pole = {"type": "capsule", "name": "pole", "radius": 0.01, "length": 0.6}
    for offset, hits in ((0.0, True), (0.5, False)):
        there = [{**pole, "position": [float(middle[0]) + offset, float(middle[1]), float(middle[2])]}]
        said = failed(replace(plan, scenario=plan.scenario.with_changes(obstacles=there)), arm)
        assert ("clearance" in said) == hits
        assert ("limits" in said) == hits
        if hits:
            assert "pole touch at t = " in said["clearance"]


def test_a_stop_on_whose_way_something_stands_is_refused(safe: Rig) -> None:
    """By the stop's own check, which names when it begins."""
    plan, arm = safe.plan, safe.arm
    assert plan.stops is not None
    stop, body = plan.stops.motion(len(plan.stops.t) // 2), safe.carried[0]
    rest, _ = arm.object_pose(stop.q[-1], body.p_EB, body.R_EB)
    pole = {"type": "capsule", "name": "pole", "radius": 0.01, "length": 0.6}
    for offset, hits in ((0.0, True), (0.5, False)):
        there = [{**pole, "position": [float(rest[0]) + offset, float(rest[1]), float(rest[2])]}]
        (said,) = (c for c in check_plan(replace(plan, scenario=plan.scenario.with_changes(obstacles=there)), arm,
                                         safe.carried) if c.name == "stops")  # fmt: skip
        assert said.ok is not hits
        assert ("is not safe: " in said.sentence and "pole" in said.sentence) == hits


def test_a_thin_wall_between_two_samples_is_seen(arm: ArmModel) -> None:
    """A sweep of 1.5 rad of the first joint with samples at its two ends only, a wall of 2 mm between them."""
    q = np.array([-0.75, 0.0, 0.0, -1.6, 0.0, 1.6, 0.8])
    swing = by_itself(q, q + np.array([1.5, 0, 0, 0, 0, 0, 0]), 1.0, count=2)
    wall = scenario.Obstacle(type="box", name="wall", position=(0.6, 0.0, 0.5), size=(0.4, 0.002, 0.8))
    parts = arm_geometry(arm, CASE.payload.bodies, [wall])
    assert parts.first_touch(swing.q) is None
    near = sweep(parts, swing).touch
    assert near is not None
    assert "wall" in (near.first, near.second)
    fine = swing.sample(np.linspace(0, 1, 20001))[0]
    seen = parts.first_touch(fine)
    assert seen is not None
    assert near.time == pytest.approx(seen.index / 20000, abs=2e-3)


@pytest.mark.slow
@settings(max_examples=12, deadline=None, derandomize=True)
@given(seed=st.integers(0, 10**6))
def test_nothing_touches_where_the_sweep_says_so(seed: int) -> None:
    """Random motions of few samples among random obstacles, looked at 1500 times as an independent check."""
    rng = np.random.default_rng(seed)
    arm = load_arm(CASE.arm, CASE.tray)  # type: ignore[arg-type]
    q = rng.uniform(arm.limits.q_min, arm.limits.q_max)
    motion = by_itself(q, np.clip(q + rng.normal(0, 0.4, 7), arm.limits.q_min, arm.limits.q_max), 1.0, 4)
    around = [
        scenario.Obstacle(
            type="box", name=f"o{k}", position=tuple(rng.uniform(-0.8, 0.8, 3)), size=tuple(rng.uniform(0.002, 0.2, 3))
        )
        for k in range(4)
    ]
    parts = arm_geometry(arm, CASE.payload.bodies, around)
    found = sweep(parts, motion)
    near = found.nearest
    assert near is not None
    distance = parts.clearance(motion.sample(np.linspace(0, 1, 1500))[0])
    if found.touch is not None:  # within what it calls touching, of which the looks may be a step short
        steps = np.abs(np.diff(distance, axis=0)).max()
        assert distance.min() <= 2e-4 + steps
    else:
        assert distance.min() > 0
        assert distance.min() >= near.distance - 1.1e-3


@pytest.mark.slow
def test_the_arms_own_parts_are_kept_apart(plan: Plan, arm: ArmModel) -> None:
    folded = np.array([0.0, 0.0, 0.0, -3.0, 0.0, 0.0, 0.8])
    start = np.array([0.0, -0.5, 0.0, -2.0, 0.0, 1.6, 0.8])
    said = failed(carried_by(plan, arm, by_itself(start, folded, 3.0)), arm)
    assert "touch at t = " in said["clearance"]


def test_the_way_to_the_start_is_judged_too(plan: Plan, arm: ArmModel) -> None:
    assert plan.joint is not None
    goal = plan.joint.q[0]
    near = by_itself(goal + 0.05, goal, 3.0)
    assert all(c.ok for c in check_approach(near, plan, arm))
    middle = arm.tray_pose(near.sample(1.5)[0][0])[0]
    pole = [{"type": "sphere", "name": "ball", "radius": 0.05, "position": [float(x) for x in middle]}]
    blocked = replace(plan, scenario=plan.scenario.with_changes(obstacles=pole))
    assert {c.name for c in check_approach(near, blocked, arm) if not c.ok} >= {"way there: clearance"}


# The Franka Research 3 -----------------------------------------------------------------------------------------------


def _franka(plan: Plan, arm: ArmModel, joint: JointMotion) -> set[str]:
    return {c.name for c in check_franka(plan.scenario, arm, joint) if not c.ok}


@pytest.mark.slow
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_each_limit_of_the_research_3_is_checked(plan: Plan, arm: ArmModel, sign: float) -> None:
    """One joint at a time beyond one of the limits, the others well within; either way round."""
    middle = 0.5 * (FR3.q_min + FR3.q_max)
    assert _franka(plan, arm, by_itself(middle, middle + 0.3 * sign, 2.0)) == set()
    # A quintic step's steepest slope is 15/8, its largest acceleration 10/sqrt(3), its jerk at the ends 60.
    away = sign * np.eye(7)[0]
    assert _franka(plan, arm, by_itself(middle - away, middle + away, 1.0)) == {"FR3 velocity", "FR3 acceleration"}
    assert _franka(plan, arm, by_itself(middle, middle + 0.2 * away, 0.3)) == {"FR3 acceleration"}  # 12.8 > 10
    sudden = by_itself(middle, middle + 5e-4 * away, 0.018)  # 8.9 rad/s^2, but 60 * 5e-4 / 0.018^3 = 5144 rad/s^3
    assert _franka(plan, arm, sudden) == {"FR3 jerk"}
    # Joint 1 within 6e-3 rad of its end may turn at sqrt(12 * 0.0124) - 0.3 = 0.086 rad/s towards it, at 2.62 from it.
    # Over 0.012 rad in 0.1 s it turns at 0.225 rad/s in the middle, and nowhere faster than 6.9 rad/s^2.
    edge, beyond = middle.copy(), middle.copy()
    edge[0], beyond[6] = sign * 2.7437, sign * 3.0159
    assert _franka(plan, arm, by_itself(edge - 0.012 * away, edge, 0.1)) == {"FR3 velocity"}
    assert _franka(plan, arm, by_itself(edge, edge - 0.012 * away, 0.1)) == set()
    assert _franka(plan, arm, by_itself(beyond, beyond + 0.01 * sign * np.eye(7)[6], 1.0)) >= {"FR3 position"}


# The posture ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("q", "dq"), [(np.nan, 0.0), (0.0, np.nan), (np.inf, 0.0), (0.0, -np.inf)], ids=["q", "dq", "far", "fast"]
)
def test_a_posture_that_is_no_number_is_no_start(plan: Plan, arm: ArmModel, q: float, dq: float) -> None:
    assert plan.joint is not None
    state = ArmState(plan.joint.q[0].copy(), np.zeros(7))
    state.q[3] += q
    state.dq[3] += dq
    with pytest.raises(SalverError, match="does not report numbers"):
        demand(check_posture(plan.joint, arm, state))


def test_an_arm_that_stands_elsewhere_or_moves_is_told(plan: Plan, arm: ArmModel) -> None:
    assert plan.joint is not None
    q = plan.joint.q[0]
    demand(check_posture(plan.joint, arm, ArmState(q + 0.009, np.full(7, 0.009))))
    away = ArmState(q + np.array([0, 0, 0.2, 0, 0, 0, 0]), np.zeros(7))
    with pytest.raises(SalverError, match=r"panda_joint3 is at -0\.577\d rad, the motion starts at -0\.777\d rad"):
        demand(check_posture(plan.joint, arm, away))
    with pytest.raises(SalverError, match=r"panda_joint1 moves at 0\.5000 rad/s"):
        demand(check_posture(plan.joint, arm, ArmState(q, np.array([0.5, 0, 0, 0, 0, 0, 0]))))


def test_what_the_robot_cannot_do_is_told_by_name(plan: Plan, arm: ArmModel) -> None:
    changed = replace(
        plan, scenario=plan.scenario.with_changes(physics__feedback="object", physics__command_period=0.002)
    )
    assert {c.name for c in check_franka(changed.scenario, arm, changed.joint) if not c.ok} == {"period"}
    assert 'without a live measurement of the object it must be "joints"' in failed(changed, arm)["feedback"]
    other = replace(plan, scenario=plan.scenario.with_changes(arm__model="ur10"))
    assert {c.name for c in check_franka(other.scenario, arm, other.joint) if not c.ok} == {"arm"}
    elsewhere = plan.scenario.with_changes(arm__flange="panda_link7")  # set_load speaks of panda_link8
    refused = [c for c in check_franka(elsewhere, arm, plan.joint) if not c.ok]
    assert [c.name for c in refused] == ["arm"]
    assert refused[0].sentence.startswith("arm.flange is panda_link7; ")


def test_a_check_that_compares_with_no_number_is_no_pass(plan: Plan, arm: ArmModel) -> None:
    """Every sentence of a check that passes is free of "nan": none passes because nothing could be computed."""
    checks: list[Any] = check_plan(plan, arm, plan.scenario.payload.bodies) + check_franka(
        plan.scenario, arm, plan.joint
    )
    assert not any("nan" in c.sentence.replace("panda", "") for c in checks)
