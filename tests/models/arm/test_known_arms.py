"""Every arm that comes by name carries something: planned as fast as it goes, checked, and run in the engine."""

from __future__ import annotations

import numpy as np
import pinocchio as pin
import pytest

from salver import scenario
from salver.models.arm.arm import load_arm
from salver.models.arm.known_arms import KNOWN_ARMS
from salver.planning.fastest import transport_problem
from salver.planning.make import make_plan
from salver.planning.trajopt.bound import least_duration
from salver.simulation.physics import simulate

CARRIED = {
    "panda": "panda-cube",
    "ur3": "ur3-cup",
    "ur5": "ur5-bottle",
    "ur10": "ur10-bottle",
    "fr3": "panda-cube",
    "ur3e": "ur3-cup",
    "ur5e": "ur5-bottle",
    "ur10e": "ur10-bottle",
    "xarm6": "gen3-cup",
    "lite6": "ur3-cup",  # nearer, for its arm is shorter
    "gen3": "gen3-cup",
    "xarm7": "gen3-cup",  # the same cup, the same way
}


UR_TWISTS = np.pi / 2 * np.array([1, 0, 0, 1, -1, 0])
FORWARD_UP = np.arctan2(0.2845, 0.0535)  # of an xArm 6's upper arm

# Denavit-Hartenberg parameters (d, a, alpha, offset of theta; m and rad), the turn of their first frame about the
# base's z, and masses of the moved links in kg. Universal Robots, article "DH parameters for calculations of kinematics
# and dynamics"; UFACTORY, "Kinematic and dynamic parameters", xArm 6.
PUBLISHED = {
    "ur3e": (
        [0.15185, 0, 0, 0.13105, 0.08535, 0.0921], [0, -0.24355, -0.2132, 0, 0, 0], UR_TWISTS, np.zeros(6), np.pi,
        [1.98, 3.4445, 1.437, 0.871, 0.805, 0.261],
    ),
    "ur5e": (
        [0.1625, 0, 0, 0.1333, 0.0997, 0.0996], [0, -0.425, -0.3922, 0, 0, 0], UR_TWISTS, np.zeros(6), np.pi,
        [3.761, 8.058, 2.846, 1.37, 1.3, 0.365],
    ),
    "ur10e": (
        [0.1807, 0, 0, 0.17415, 0.11985, 0.11655], [0, -0.6127, -0.57155, 0, 0, 0], UR_TWISTS, np.zeros(6), np.pi,
        [7.369, 13.051, 3.989, 2.1, 1.98, 0.615],
    ),
    "xarm6": (
        [0.267, 0, 0, 0.3425, 0, 0.097], [0, np.hypot(0.2845, 0.0535), 0.0775, 0, 0.076, 0],
        np.pi / 2 * np.array([-1, 0, -1, 1, -1, 0]), np.array([0, -FORWARD_UP, FORWARD_UP, 0, 0, 0]), 0.0, None,
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", sorted(PUBLISHED))
def test_flange_is_where_the_makers_parameters_put_it(name: str) -> None:
    d, a, alpha, offset, turn, masses = PUBLISHED[name]
    tray = scenario.Tray()
    arm = load_arm(scenario.Arm(model=name), tray)
    model = arm.pin_model
    flange = model.getFrameId(arm.flange)
    q = np.random.default_rng(3).uniform(-2, 2, 6)
    expected = pin.SE3(pin.rpy.rpyToMatrix(0, 0, turn), np.zeros(3))
    for j in range(6):
        along = pin.SE3(pin.rpy.rpyToMatrix(0, 0, q[j] + offset[j]), np.array([0, 0, d[j]]))
        expected = expected * along * pin.SE3(pin.rpy.rpyToMatrix(alpha[j], 0, 0), np.array([a[j], 0, 0]))
    pin.framesForwardKinematics(model, arm.data, q)
    assert arm.data.oMf[flange].translation == pytest.approx(expected.translation, abs=2e-5)
    assert arm.data.oMf[flange].rotation == pytest.approx(expected.rotation, abs=2e-5)
    if masses is not None:
        moved = [inertia.mass for inertia in model.inertias[1:]]
        assert moved == pytest.approx([*masses[:-1], masses[-1] + tray.mass], abs=6e-4)


NEARER = {"motion__start__position": (0.2, -0.1, 0.45), "motion__goal__position": (0.2, 0.1, 0.45)}


@pytest.mark.slow
@pytest.mark.parametrize("name", sorted(KNOWN_ARMS))
def test_carries_as_fast_as_it_goes_and_keeps_it(name: str) -> None:
    """At nominal values, and with the least friction and the heaviest load of the uncertain set."""
    changes = {"arm__model": name, "arm__torque_scale": 0.95, "motion__speeds": "full"}  # feedback has the other 5 %
    case = scenario.load(CARRIED[name]).with_changes(**changes, **(NEARER if name == "lite6" else {}))
    plan = make_plan(case, "fastest")
    assert plan.ok, (plan.status, plan.arm_status)
    assert plan.arm_status is not None
    details = plan.arm_status.details
    shares = [details[kind]["share"] for kind in ("position", "velocity", "acceleration", "torque")]
    assert max(*shares, 1 - plan.verification.slack) > 0.95  # something binds: it is as fast as it goes
    bound = least_duration(transport_problem(case).limits, plan.joint.q[0], plan.joint.q[-1])
    assert plan.solver["bound"] == pytest.approx(bound, rel=1e-12)
    assert plan.solver["bound"] < plan.duration
    uncertain = plan.uncertain
    worst = {}
    for key, nominal, half in zip(uncertain.names, uncertain.nominal, uncertain.half_range, strict=True):
        if key.endswith(("mass", "friction")):
            worst[key] = float(nominal + half * (1 if key.endswith("mass") else -1))
    for parameters in ({}, worst):
        assert simulate(plan, parameters=parameters).summary["outcome"] == "holds"


@pytest.mark.slow
@pytest.mark.parametrize("name", ["ur3-cup", "ur5-bottle", "gen3-cup"])
def test_ready_made_cups_and_bottles_in_their_own_time(name: str) -> None:
    plan = make_plan(scenario.load(name))
    assert plan.ok, (plan.status, plan.arm_status)
    assert np.isfinite(plan.cost)
