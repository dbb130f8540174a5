"""The chain of arm, controller and carried objects: against nonlinear forward dynamics, and the engine."""

import numpy as np
import pytest

from arm_rollouts import T, case_of, relative
from salver import scenario
from salver.geometry import log, matrix_from_quat_wxyz
from salver.models.tray_motion import frame_map, wrench_map
from salver.models.uncertain.parameters import INERTIAL, inertial_vector, phi_of
from salver.planning.make import plan_baseline, with_arm
from salver.planning.plan import Plan
from salver.sensitivity.arm import arm_chain, chain_model
from salver.sensitivity.arm.terms import motion_terms
from salver.simulation.physics import simulate
from salver.simulation.run import Options


@pytest.fixture(params=["panda", "ur10"])
def case(request):
    return case_of(request.param)


@pytest.fixture
def panda():
    return case_of("panda")


@pytest.mark.slow
@pytest.mark.parametrize("space", ["joint", "object"])
def test_chain_is_the_derivative_of_the_nonlinear_loop(case, space):
    """Each uncertain parameter, joints and torque, to 1e-4; arms with and without a redundant joint.

    The largest differences are printed; docs/arm-chain.md quotes them.
    """
    chain = arm_chain(case.model, case.joint, space=space, t=T)
    uncertain = chain.uncertain
    largest = dict.fromkeys(("q", "dq", "ddq", "torque"), 0.0)
    for name in ("mass", "com_x", "com_z", "inertia_xx", "inertia_xz", "position_x", "tilt_y"):
        if name not in uncertain.names:
            continue
        j = uncertain.names.index(name)
        h = 0.05 * float(uncertain.half_range[j])
        slope = case.slope(space, {name: h})
        found = {"q": chain.joints.q, "dq": chain.joints.dq, "ddq": chain.joints.ddq, "torque": chain.torque}
        for key, derivative in found.items():
            error = relative(derivative[:, :, j] * h, slope[key])
            assert error < (1e-4 if key == "torque" else 2e-4), (name, key)
            largest[key] = max(largest[key], error)
    shown = ", ".join(f"{key} {error:.1e}" for key, error in largest.items())
    print(
        f"{case.scenario.arm.model}, loop on the {space}: largest difference as a share of the largest value: {shown}"
    )


@pytest.mark.parametrize("space", ["joint", "object"])
@pytest.mark.slow
def test_what_first_order_leaves_out_is_of_second_order(panda, space):
    """Central differences approach the derivative with the square of their step: slope 2."""
    chain = arm_chain(panda.model, panda.joint, space=space, t=T)
    uncertain = chain.uncertain
    direction = dict(zip(uncertain.names, uncertain.half_range * np.cos(np.arange(uncertain.size)), strict=True))
    direction.pop("friction")
    columns = [uncertain.names.index(name) for name in direction]
    linear = chain.torque[:, :, columns] @ np.array(list(direction.values()))
    errors = []
    for h in (4.0, 2.0, 1.0):
        slope = panda.slope(space, {name: h * value for name, value in direction.items()})["torque"] / h
        errors.append(np.abs(slope - linear).max())
    assert np.diff(np.log2(errors)) == pytest.approx([-2, -2], abs=0.15)


@pytest.mark.slow
@pytest.mark.parametrize("space", ["joint", "object"])
def test_tray_and_what_it_feels(panda, space):
    """Pose and velocity of the tray and w, against differences of rollouts."""
    chain = arm_chain(panda.model, panda.joint, space=space, t=T)
    arm = panda.model.loaded
    j = chain.uncertain.names.index("mass")
    h = 0.1 * float(chain.uncertain.half_range[j])
    up, down = (panda.rollout(space, {"mass": s * h}) for s in (1.0, -1.0))
    a, b = (motion_terms(arm.pin_model, arm.tray_id, run["q"], run["dq"], run["ddq"]) for run in (up, down))
    R0 = chain.terms.R_SE
    turn = [log(np.swapaxes(R0, 1, 2) @ x.R_SE) for x in (a, b)]
    v_S = [np.einsum("tij,tj->ti", x.R_SE, x.twist[:, :3]) for x in (a, b)]
    expected = [a.p_SE - b.p_SE, turn[0] - turn[1], v_S[0] - v_S[1], a.twist[:, 3:] - b.twist[:, 3:]]
    for k, value in enumerate(expected):
        assert relative(chain.tray.state[:, 3 * k : 3 * k + 3, j] * h, value / 2) < 1e-4
    assert relative(chain.tray.w[:, :, j] * h, (a.w - b.w) / 2) < 2e-4


@pytest.mark.slow
def test_contact_wrench(panda):
    """Contact wrench of the object as it truly is, over rollouts; its place included."""
    chain = arm_chain(panda.model, panda.joint, space="joint", t=T)
    body, uncertain = panda.body, chain.uncertain

    def true(change):
        run = panda.rollout("joint", change)
        inertial = inertial_vector(body.inertial) + [change.get(name, 0.0) for name in INERTIAL]
        (moved,) = panda.carried(change)
        need = wrench_map(phi_of(inertial)) @ frame_map(moved.p_EB, moved.R_EB)
        return panda.felt(run) @ need.T

    for name in ("mass", "com_x", "inertia_xx", "position_x"):
        j = uncertain.names.index(name)
        h = 0.05 * float(uncertain.half_range[j])
        assert relative(chain.wrench[:, :, j] * h, (true({name: h}) - true({name: -h})) / 2) < 1e-4, name


def test_products_carry_the_chain_to_the_corners(case):
    """At a corner of the set the prediction with products is several times nearer than the derivatives alone."""
    names = ("mass", "com_x", "com_z")
    chain = arm_chain(case.model, case.joint, space="joint", t=T)
    uncertain = chain.uncertain
    change = {name: float(uncertain.half_range[uncertain.names.index(name)]) for name in names}
    values = uncertain.nominal + [change.get(name, 0.0) for name in uncertain.names]
    nominal, true = case.rollout("joint", {}), case.rollout("joint", change)
    deviation = true["q"] - nominal["q"]
    terms = chain.model.load.deviations(values)
    whole = relative(chain.joints.q @ terms, deviation)
    first = relative(chain.joints.q[:, :, : uncertain.size] @ terms[: uncertain.size], deviation)
    assert whole < 0.01
    assert first > 4 * whole
    inertial = inertial_vector(case.body.inertial) + [change.get(name, 0.0) for name in INERTIAL]
    known, moved = (
        wrench_map(phi_of(x)) @ frame_map(case.body.p_EB, case.body.R_EB)
        for x in (inertial_vector(case.body.inertial), inertial)
    )
    needed = case.felt(true) @ moved.T - case.felt(nominal) @ known.T
    whole = relative(chain.wrench @ terms, needed)
    first = relative(chain.wrench[:, :, : uncertain.size] @ terms[: uncertain.size], needed)
    assert whole < 0.6 * first < 0.006  # what is left is of third order


# ---- against the engine ----------------------------------------------------------------------------------------


@pytest.mark.slow
def test_engine_agrees():
    """MuJoCo's arm under the sampled controller, +-10 % mass: tray, torque and measured contact wrench."""
    duration = 1.2
    named = scenario.load("panda-cube").with_changes(motion__duration=duration)
    plan: Plan = with_arm(plan_baseline(named))
    chain = arm_chain(chain_model(named), plan.joint)
    up, down = (simulate(plan, parameters={"mass": x}, options=Options(record_rate=1000)) for x in (0.2816, 0.2304))
    moving = up.t <= duration
    t, h = up.t[moving], 0.0256

    def at(values):
        return np.stack([np.interp(t, chain.t, column) for column in values[:, :, 0].T], axis=1) * h

    def difference(values):
        return 0.5 * (values(up) - values(down))[moving]

    def wrench(record):
        points, forces = record.contact_points_B, record.contact_forces_B
        return np.concatenate([forces.sum(axis=1), np.cross(points, forces).sum(axis=1)], axis=1)

    turn = np.swapaxes(matrix_from_quat_wxyz(down.quat_SE_wxyz), 1, 2) @ matrix_from_quat_wxyz(up.quat_SE_wxyz)
    assert relative(at(chain.tray.state[:, :3]), difference(lambda r: r.p_SE)) < 0.005
    assert relative(at(chain.tray.state[:, 3:6]), 0.5 * log(turn)[moving]) < 0.006
    assert relative(at(chain.torque), difference(lambda r: r.tau)) < 0.02
    assert relative(at(chain.wrench[:, :3]), difference(wrench)[:, :3]) < 0.002
