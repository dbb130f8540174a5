"""Every arm that comes by name carries something: planned as fast as it goes, checked, and run in the engine."""

from __future__ import annotations

import numpy as np
import pytest

from salver import scenario
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
    "gen3": "gen3-cup",
    "xarm7": "gen3-cup",  # the same cup, the same way
}


@pytest.mark.slow
@pytest.mark.parametrize("name", sorted(KNOWN_ARMS))
def test_carries_as_fast_as_it_goes_and_keeps_it(name: str) -> None:
    """At nominal values, and with the least friction and the heaviest load of the uncertain set."""
    case = scenario.load(CARRIED[name]).with_changes(arm__model=name, arm__torque_scale=0.95)  # feedback has the rest
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
