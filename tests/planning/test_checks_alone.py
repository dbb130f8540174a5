"""Each check alone between a motion and a yes: with it the answer is no, without it nothing else says so."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pinocchio as pin
import pytest

from arm_motions import REST, make, still, turn
from salver import scenario
from salver.errors import Status
from salver.geometry import Array, exp
from salver.models.arm.arm import ArmModel, load_arm
from salver.models.arm.arm_geometry import arm_geometry
from salver.models.arm.arm_limits import LIMITS
from salver.planning.follow.limits import peaks, verdict
from salver.planning.plan import Plan
from salver.trajectory import JointMotion, Reference, SampledReference, min_jerk_line


@pytest.mark.parametrize("kind", LIMITS, ids=lambda kind: kind.key)
def test_of_each_limit_alone_a_verdict_says_no(kind) -> None:
    """All others are far away; with this one a little wider it is a yes."""
    arm, t = make("ur5"), np.linspace(0.0, 1.0, 201)
    limits, motion = arm.limits, JointMotion(t, *turn(REST, 4, 1.2).sample(t))
    (peak,) = (p for p in peaks(arm, motion) if p.kind == kind.name)
    joint = arm.joint_names.index(peak.joint)
    for share, answer in ((0.99, False), (1.01, True)):
        edge = share * abs(peak.value)
        if kind.key == "position":
            low, high = limits.q_min.copy(), limits.q_max.copy()
            low[joint], high[joint] = (-edge, high[joint]) if peak.value < 0 else (low[joint], edge)
            other = replace(limits, q_min=low, q_max=high)
        else:
            given = getattr(limits, kind.key).copy()
            given[joint] = edge
            other = replace(limits, **{kind.key: given})
        status = verdict(replace(arm, limits=other, planning_limits=other), motion)
        assert status.ok is answer, status.sentence
        if not answer:
            assert f"the {kind.name} of {peak.joint}" in status.sentence
            assert status.sentence.count("over its limit") == 1


TOUCHING = [("link", "link"), ("link", "load"), ("link", "obstacle"), ("tray", "obstacle"), ("load", "obstacle")]


@pytest.mark.parametrize("kinds", TOUCHING, ids="-".join)
def test_of_each_kind_of_touch_alone_a_verdict_says_no(kinds: tuple[str, str]) -> None:
    """Of the parts that are compared only a pair of this kind touches; without those pairs it would be a yes."""
    bottle = scenario.load("panda-tall-bottle")
    arm, body = load_arm(scenario.Arm(model="ur5"), bottle.tray), bottle.payload.first
    frame = arm.tray_pose(REST)
    place = {
        "link": link_place(arm, "forearm_link"),
        "tray": frame[0] + frame[1] @ np.array([0.4 * arm.tray_size[0], 0.4 * arm.tray_size[1], -0.004]),
        "load": frame[0] + frame[1] @ body.p_EB,
    }
    ball = [{"type": "sphere", "name": "ball", "radius": 0.004, "position": tuple(place[kinds[0]])}]
    case = bottle.with_changes(obstacles=ball if kinds[1] == "obstacle" else None)
    parts = arm_geometry(arm, case.payload.bodies, case.obstacles)

    def kind(index: int) -> str:
        if index >= len(parts.names) - parts.obstacles:
            return "obstacle"
        return "load" if index > parts.tray else "tray" if index == parts.tray else "link"

    of = [tuple(sorted((kind(i), kind(j)), key=["link", "tray", "load", "obstacle"].index)) for i, j in parts.pairs]
    rng = np.random.default_rng(3)
    postures = [REST] if kinds[1] == "obstacle" else rng.uniform(-np.pi, np.pi, (3000, 6))
    alone = (q for q in postures if {of[k] for k in np.flatnonzero(parts.clearance(q[None])[0] <= 0)} == {kinds})
    motion = still(arm, next(alone))
    assert not verdict(arm, motion, parts=parts).ok
    assert verdict(arm, motion, parts=parts.only(k for k, each in enumerate(of) if each != kinds)).ok


def link_place(arm: ArmModel, link: str) -> Array:
    """A place inside a link at `REST`: half-way to the next joint."""
    data = arm.pin_model.createData()
    pin.forwardKinematics(arm.pin_model, data, REST)
    joint = arm.pin_model.frames[arm.pin_model.getFrameId(link)].parentJoint
    return np.asarray(0.5 * (data.oMi[joint].translation + data.oMi[joint + 1].translation))


@pytest.mark.parametrize(
    "model", ["panda", "ur5", *(pytest.param(x, marks=pytest.mark.slow) for x in ("xarm7", "gen3"))]
)
def test_all_kinds_of_pairs_that_move_are_looked_at(model: str) -> None:
    """Whatever two parts can come nearer to one another is compared, or named among what is left out."""
    case = scenario.load("panda-cube").with_changes(
        obstacles=[
            {"type": "sphere", "name": f"ball {k}", "radius": 0.05, "position": (0.5, 0.2 * k, 1.2)} for k in (0, 1)
        ]
    )
    arm = load_arm(scenario.Arm(model=model), case.tray)
    parts = arm_geometry(arm, case.payload.bodies, case.obstacles)
    joints, names = [part.parentJoint for part in parts.model.geometryObjects], parts.names
    told = {frozenset(pair) for pairs in parts.left_out.values() for pair in pairs}
    told |= {frozenset((names[i], names[j])) for i, j in parts.pairs}  # by hulls, or by pieces of links
    for j in range(len(names)):
        for i in range(j):
            moves = joints[i] != joints[j]
            assert not moves or {names[i], names[j]} in told, (model, names[i], names[j])
    assert len(parts.left_out) <= len(parts.unchecked)


def tilting(case: scenario.Scenario, line: Reference, largest: float) -> SampledReference:
    """A line with the tray leaning by so much (rad) about its y axis half-way, level at both ends."""
    t = np.linspace(0.0, line.duration, 401)
    s, T = t / line.duration, line.duration
    u, v = s * (1 - s), 1 - 2 * s
    lean = [64 * largest * x for x in (u**3, 3 * u**2 * v / T, 6 * u * (v**2 - u) / T**2)]
    y, seen = np.array([0.0, 1.0, 0.0]), line.sample(t)
    turned = seen.R_SB @ exp(np.multiply.outer(lean[0], y))
    return SampledReference(
        replace(seen, R_SB=turned, omega_B=np.multiply.outer(lean[1], y), alpha_B=np.multiply.outer(lean[2], y))
    )


@pytest.mark.parametrize("check", ["contact", "brim", "tilt", "ends", "passes"])
def test_of_each_condition_on_the_load_alone_a_plan_says_no(check: str) -> None:
    """The verification of a plan fails by this one; with it taken away nothing else says no."""
    case = scenario.load("panda-coffee" if check == "brim" else "panda-cube")
    case = case.with_changes(arm=None, motion__duration=None, motion__orientation="free")
    if check == "brim":
        case = case.with_changes(objects__0__liquid__brim=0.072)
    if check == "tilt":
        case = case.with_changes(motion__max_tilt_deg=3.0)
    if check == "passes":
        case = case.with_changes(motion__through=[{"position": [0.5, -0.1, 0.6]}])
    motion, seconds = case.motion, {"contact": 0.45, "brim": 1.1}.get(check, 2.5)
    goal = np.array(motion.goal.position) + (0.005 if check == "ends" else 0.0)
    line = min_jerk_line(seconds, np.array(motion.start.position), goal, motion.start.rotation, motion.goal.rotation)
    plan = Plan(
        case, "fastest", tilting(case, line, np.deg2rad(6.0)) if check == "tilt" else line, Status("optimal", "", True)
    )
    found = plan.verification
    assert not plan.ok
    said = {
        "contact": "contact condition",
        "brim": "room of what moves inside",
        "tilt": "limit on tilt",
        "ends": "misses its start or goal",
        "passes": "misses a pose to pass",
    }[check]
    assert said in found.sentence
    blind = {"ends": {"boundary_error": 0.0}, "passes": {"passes": 0.0}}.get(check, {"slack": 0.0})
    assert replace(found, **blind).ok
    slack, owner = plan.evaluation.slack.min(axis=0), plan.evaluation.slack_owner
    assert len({name for name, least in zip(owner, slack, strict=True) if least < 0}) == ("slack" in blind)
