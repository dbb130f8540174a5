"""Limits of an arm: motions that reach exactly one of them, by hand, and verdicts a hair beside each."""

from __future__ import annotations

import time
from dataclasses import replace

import numpy as np
import pytest

import odd_loads
from salver import scenario
from salver.geometry import Array
from salver.models.arm.arm import ArmModel, load_arm
from salver.models.arm.arm_geometry import arm_geometry
from salver.models.arm.arm_limits import LIMITS, JointLimits, joint_limits
from salver.planning.fastest import FastestOptions, TransportProblem, fastest, transport_problem
from salver.planning.fastest.retiming import SplinePath, retime
from salver.planning.follow.limits import peaks, verdict
from salver.planning.make import make_plan
from salver.trajectory import JointMotion

CUBE = scenario.load("panda-cube").with_changes(objects__0__friction=3.0)  # it holds whatever the arm does
POSTURE = np.array(CUBE.arm.start_posture)
LOOSE = {"velocity": 60.0, "acceleration": 2e3, "jerk": 1e7, "torque": 1e6, "torque_rate": 1e9}


def limits(**tight: float) -> JointLimits:
    """Limits that nothing reaches, but for joint 1."""
    values = {key: np.full(7, value) for key, value in LOOSE.items()}
    for key, value in tight.items():
        values[key][0] = value
    return JointLimits(np.full(7, -10.0), np.full(7, 10.0), **values)


def test_what_nobody_limits_is_unlimited() -> None:
    made, sources = joint_limits(2, [("a table", {"velocity": [1.0, np.nan]})])
    assert made.q_min.tolist() == [-np.inf, -np.inf]
    assert made.q_max.tolist() == [np.inf, np.inf]
    assert made.velocity.tolist() == [1.0, np.inf]
    assert sources["velocity"] == ("a table", None)


def test_the_limit_that_is_named_is_the_one_on_the_side_of_the_value() -> None:
    """For all but positions its magnitude, whichever the sign."""
    kinds = {kind.key: kind for kind in LIMITS}
    one_sided = replace(limits(velocity=2.0, torque_rate=7.0), q_min=np.full(7, -3.0), q_max=np.full(7, -1.0))
    for value, bound in ((-2.9, -3.0), (-1.2, -1.0), (5.0, -1.0)):
        assert one_sided.bound(kinds["position"], 2, value) == bound
    for value in (-1.0, 1.0):
        assert one_sided.bound(kinds["velocity"], 0, value) == 2.0
        assert one_sided.bound(kinds["velocity"], 1, value) == 60.0
        assert one_sided.bound(kinds["torque_rate"], 0, value) == 7.0


@pytest.fixture(scope="module")
def arm() -> ArmModel:
    return load_arm(CUBE.arm, CUBE.tray)


@pytest.fixture(scope="module")
def problem() -> TransportProblem:
    return transport_problem(CUBE.with_changes(motion__goal_yaw="free"), level=False, robust=False)


def inertia_of_joint_1(problem: TransportProblem) -> float:
    """kg m^2 about the vertical first axis, cube included: what joint 1 turns while the others stand still.

    The sum of each link's moment about the axis, by Pinocchio's centroidal inertias carried to the axis.
    """
    import pinocchio as pin

    model = problem.model
    data = model.createData()
    pin.forwardKinematics(model, data, POSTURE)
    total = 0.0
    for i in range(1, model.njoints):
        place, own = data.oMi[i], model.inertias[i]
        centre = place.act(own.lever)
        turned = place.rotation @ own.inertia @ place.rotation.T
        total += turned[2, 2] + own.mass * float(centre[0] ** 2 + centre[1] ** 2)
    return total


# The fastest turn of one joint, by hand ------------------------------------------------------------------------

TURN = 1.1


@pytest.mark.parametrize("kind", ["velocity", "acceleration", "jerk", "torque", "torque_rate"])
def test_fastest_turn_of_one_joint_by_hand(problem: TransportProblem, kind: str) -> None:
    """A turn d from rest to rest takes d/v + v/a, 2 sqrt(d/a), (32 d/j)^(1/3); torque and its rate likewise over the
    moment of inertia. Nothing else limits it, so a limit that is forgotten lets it be many times faster."""
    inertia = inertia_of_joint_1(problem)
    tight, least = {
        "velocity": ({"velocity": 1.3, "acceleration": 12.0}, TURN / 1.3 + 1.3 / 12.0),
        "acceleration": ({"acceleration": 7.0}, 2 * np.sqrt(TURN / 7.0)),
        "jerk": ({"jerk": 90.0}, (32 * TURN / 90.0) ** (1 / 3)),
        "torque": ({"torque": 6.0}, 2 * np.sqrt(TURN * inertia / 6.0)),
        "torque_rate": ({"torque_rate": 80.0}, (32 * TURN * inertia / 80.0) ** (1 / 3)),
    }[kind]
    alone = replace(problem, limits=limits(**tight), contacts=(), tracking=None)
    q = np.tile(POSTURE, (9, 1))
    q[:, 0] += np.linspace(0.0, TURN, 9)
    begun = time.perf_counter()
    found = retime(alone, SplinePath.through(q))
    assert found.status.ok, found.status
    assert 0 < found.wall_time <= time.perf_counter() - begun
    # Twenty quintic pieces come within a twentieth of the bang-bang law, and no law is faster.
    assert least * (1 - 1e-3) < found.duration < 1.05 * least
    if kind in ("velocity", "acceleration", "torque"):  # the others are no part of the bound
        assert found.lower_bound == pytest.approx(least, rel=1e-2)


@pytest.mark.parametrize(("kind", "share"), [("jerk", 0.03), ("velocity", 0.4), ("torque_rate", 0.12)])
def test_fastest_motion_of_the_whole_arm_reaches_a_tight_limit(
    problem: TransportProblem, kind: str, share: float
) -> None:
    """A load that holds, an arm with one tight limit: that limit binds, and is kept between all instants."""
    tight = replace(problem.limits, **{kind: share * getattr(problem.limits, kind)})
    found = fastest(replace(problem, limits=tight), FastestOptions(spans=8))
    assert found.status.ok, found.status
    t = np.linspace(0.0, found.duration, 4001)
    q, dq, ddq, dddq = found.sample(t)
    if kind == "torque_rate":
        loaded = odd_loads.torques(odd_loads.with_bodies(problem.arm, odd_loads.nominal_bodies(CUBE)), q, dq, ddq)
        values = np.diff(loaded, axis=0) / (t[1] - t[0])
    else:
        values = {"jerk": dddq, "velocity": dq}[kind]
    used = float((np.abs(values) / getattr(tight, kind)).max())
    # Torque rates are kept as means between nodes: inside a step one may be larger.
    assert 0.97 < used < (1.02 if kind == "torque_rate" else 1.0 + 1e-4)


# Verdicts ------------------------------------------------------------------------------------------------------


def min_jerk(distance: float, duration: float, count: int = 801) -> JointMotion:
    """Joint 1 from rest to rest, the others still."""
    u = np.linspace(0, 1, count)
    quintic = np.polynomial.Polynomial([0, 0, 0, 10, -15, 6])
    parts = [np.zeros((count, 7)) + (POSTURE if k == 0 else 0.0) for k in range(3)]
    for k, part in enumerate(parts):
        part[:, 0] += distance * (quintic.deriv(k)(u) if k else quintic(u)) / duration**k
    return JointMotion(u * duration, *parts)


@pytest.mark.parametrize("sign", [1, -1])
@pytest.mark.parametrize("kind", ["position", "velocity", "acceleration", "jerk", "torque", "torque_rate"])
def test_a_limit_is_a_limit(arm: ArmModel, problem: TransportProblem, kind: str, sign: int) -> None:
    """1.875 d/T, 10 d/(sqrt(3) T^2), 60 d/T^3; over and under by a share of 2e-4 are told apart."""
    d, T = 0.8, 1.7
    inertia = inertia_of_joint_1(problem)
    peak = {
        "position": POSTURE[0] + sign * d,
        "velocity": 1.875 * d / T,
        "acceleration": 10 * d / np.sqrt(3) / T**2,
        "jerk": 60 * d / T**3,
        "torque": inertia * 10 * d / np.sqrt(3) / T**2,
        "torque_rate": inertia * 60 * d / T**3,
    }[kind]
    # The rate of torque is a difference over one sample: at the ends it misses 3/800 of the jerk there.
    hair = 6e-3 if kind == "torque_rate" else 2e-4
    motion = min_jerk(sign * d, T)
    for factor, within in ((1 + hair, True), (1 - hair, False)):
        if kind == "position":
            middle = 0.3 * sign  # not about zero: the range is what counts, not the angle
            half = factor * abs(peak - middle)
            kept = replace(limits(), q_min=np.full(7, -10.0), q_max=np.full(7, 10.0))
            kept.q_min[0], kept.q_max[0] = middle - half, middle + half
        else:
            kept = limits(**{kind: factor * float(peak)})
        status = verdict(replace(arm, planning_limits=kept), motion, CUBE.payload.bodies)
        assert status.ok == within, status.sentence
        if not within:
            assert status.code == "limit_exceeded"
            name = kind.replace("_", " ")
            assert f"the {name} of panda_joint1" in status.sentence
            found = next(
                x for x in peaks(replace(arm, planning_limits=kept), motion, CUBE.payload.bodies) if x.kind == name
            )
            assert abs(found.value) == pytest.approx(abs(float(peak)), rel=hair)
            assert found.share == pytest.approx(1 / factor, rel=hair)


@pytest.mark.parametrize(("less", "within"), [(0.0, True), (1e-10, True), (1e-8, False)])
def test_a_limit_that_is_reached_to_rounding_is_kept(arm: ArmModel, less: float, within: bool) -> None:
    motion = min_jerk(0.8, 1.7)
    reached = next(peak.value for peak in peaks(arm, motion) if peak.kind == "velocity")
    kept = limits(velocity=abs(reached) * (1 - less))
    assert verdict(replace(arm, planning_limits=kept), motion).ok == within


def test_what_lies_between_samples_counts(arm: ArmModel) -> None:
    """Few samples of a min-jerk move, exact at each: its largest speed is at the middle, between two of them."""
    motion = min_jerk(0.8, 1.0, 4)
    assert np.abs(motion.dq[:, 0]).max() < 1.875 * 0.8 * 0.9
    found = next(peak for peak in peaks(arm, motion) if peak.kind == "velocity")
    assert found.value == pytest.approx(1.875 * 0.8, rel=1e-12)
    # A second later, after rest.
    later = JointMotion(
        np.append(0.0, 1.0 + motion.t), *(np.vstack([x[:1], x]) for x in (motion.q, motion.dq, motion.ddq))
    )
    found = next(peak for peak in peaks(arm, later) if peak.kind == "velocity")
    assert (found.value, found.time) == pytest.approx((1.875 * 0.8, 1.5), rel=1e-12)


def test_of_limits_that_are_broken_the_worst_is_told_first(arm: ArmModel) -> None:
    """Twice the speed and thrice the acceleration that are allowed."""
    d, T = 0.8, 1.7
    allowed = limits(velocity=0.5 * 1.875 * d / T, acceleration=10 * d / np.sqrt(3) / T**2 / 3)
    said = verdict(replace(arm, planning_limits=allowed), min_jerk(d, T)).sentence
    assert "200 % over its limit" in said
    assert 0 < said.index("the acceleration of panda_joint1") < said.index("the velocity of panda_joint1")


@pytest.mark.parametrize("of", ["q", "dq", "ddq"])
def test_what_is_no_number_is_within_no_limit(arm: ArmModel, of: str) -> None:
    motion = min_jerk(0.1, 2.0, 9)
    assert verdict(arm, motion).ok
    values = getattr(motion, of).copy()
    values[4, 2] = np.nan
    status = verdict(arm, replace(motion, **{of: values}))
    assert not status.ok
    assert status.code == "limit_exceeded"


def test_plan_is_not_ok_when_the_arm_cannot_follow() -> None:
    """The load holds, the motion is right, and joint 1 would have to turn faster than it can."""
    slab = {"type": "box", "size": [0.16, 0.16, 0.04]}
    plan = make_plan(CUBE.with_changes(motion__duration=0.42, objects__0__shape=slab, contact__condition="exact"))
    assert plan.status.ok
    assert plan.verification.ok
    assert plan.arm_status is not None
    assert plan.arm_status.code == "limit_exceeded"
    assert not plan.ok
    assert plan.summary()["ok"] is False
    assert replace(plan, arm_status=None).ok
    unsafe = replace(plan, arm_status=None, status=replace(plan.status, ok=False))
    assert not unsafe.ok


# Collisions ----------------------------------------------------------------------------------------------------


def test_a_collision_on_the_way_is_told(arm: ArmModel) -> None:
    """Out and back: the ends are free, and in the middle the tray is in the post for a twentieth of the time."""
    out = min_jerk(0.4, 2.0)
    there, back = np.concatenate([out.q, out.q[-2::-1]]), np.concatenate([out.t, 4.0 - out.t[-2::-1]])
    rates = (np.concatenate([x, sign * x[-2::-1]]) for x, sign in ((out.dq, -1), (out.ddq, 1)))
    motion = JointMotion(back, there, *rates)
    carried = CUBE.payload.bodies

    def status_with(place: Array) -> object:
        post = scenario.Obstacle(type="sphere", radius=0.01, position=tuple(place), name="post")
        return verdict(arm, motion, carried, arm_geometry(arm, carried, [post]))

    p, R = arm.tray_pose(there[len(there) // 2])
    start, _ = arm.tray_pose(there[0])
    # Beside the tray's leading edge at the turning point, 1 cm inside it.
    ahead = (p - start) / np.linalg.norm(p - start)
    inside = p + ahead * 0.10
    touched = status_with(inside)
    assert touched.code == "collision"
    assert "tray and post touch" in touched.sentence
    assert touched.details["collision"]["time"] == pytest.approx(2.0, abs=0.7)
    assert status_with(p + ahead * 0.30).ok
    assert R[2, 2] > 0.999
