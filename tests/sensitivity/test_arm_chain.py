"""What the chain of arm, controller and carried objects is made of, its limits, and what it bounds."""

from dataclasses import replace

import numpy as np
import pinocchio as pin
import pytest
from scipy.interpolate import interp1d

from arm_rollouts import CUBE, DURATION, STEP, Case, T, case_of, relative
from salver.errors import ScenarioError
from salver.geometry import log
from salver.linear_filter import LinearFilter
from salver.models.arm.arm import with_load
from salver.models.contact.wrench_cone import cone_facets
from salver.models.contact_rows import contact_rows
from salver.models.tray_motion import frame_map, motion_vector, wrench_map
from salver.models.uncertain.parameters import INERTIAL, phi_jacobian
from salver.models.uncertain.worst_case import Drift
from salver.sensitivity.arm import arm_chain, chain_model
from salver.sensitivity.arm.load import load_change
from salver.sensitivity.arm.terms import motion_terms
from salver.sensitivity.tray import TrayLoop
from salver.trajectory import JointMotion


@pytest.fixture(params=["panda", "ur10"])
def case(request):
    return case_of(request.param)


@pytest.fixture
def panda():
    return case_of("panda")


# ---- parts ----------------------------------------------------------------------------------------------------


def test_joints_that_do_not_carry_the_tray_do_not_move_it():
    """A branched chain, its tray after the second and the fourth joint: against Pinocchio's own frame."""
    model, rng, parent = pin.Model(), np.random.default_rng(4), {}
    for k, before in enumerate((0, 1, 2, 2, 4), start=1):  # the third is a branch, the fifth lies beyond the tray
        place = pin.SE3.Random()
        parent[k] = model.addJoint(parent.get(before, 0), pin.JointModelRZ(), place, f"j{k}")
        model.appendBodyToJoint(parent[k], pin.Inertia.Random(), pin.SE3.Random())
    tray = model.addFrame(pin.Frame("tray", parent[4], 0, pin.SE3.Random(), pin.FrameType.OP_FRAME))
    data, z = model.createData(), rng.normal(size=(3, 15))

    def terms(z):
        return motion_terms(model, tray, z[:, :5], z[:, 5:10], z[:, 10:])

    here = terms(z)
    for i, row in enumerate(z):
        jacobian = pin.computeFrameJacobian(model, data, row[:5], tray, pin.ReferenceFrame.LOCAL)
        assert here.jacobian[i] == pytest.approx(jacobian, abs=1e-12)
        assert not jacobian[:, [2, 4]].any()
        assert here.twist[i] == pytest.approx(jacobian @ row[5:10], abs=1e-12)
    for k in range(15):
        step = 1e-6 * np.eye(15)[k]
        difference = (terms(z + step).w - terms(z - step).w) / 2e-6
        assert here.w_z[:, :, k] == pytest.approx(difference, rel=1e-6, abs=1e-6)


@pytest.mark.parametrize("gains", [(500.0, 25.0), (100.0, 20.0), (40.0, 30.0)])
def test_filter_on_uneven_nodes(gains):
    """Against a fine even grid, whose cubics miss the forcing by 1e-11, for under-, critically and overdamped gains."""
    kp, kd = gains
    fine = np.linspace(0.0, 1.0, 1001)

    def forcing(t):
        return np.cos(5 * t) + t**2

    exact = LinearFilter.on_nodes(fine, kp, kd, 3).respond(forcing(fine))
    s = np.linspace(0.0, 1.0, 81)
    nodes = np.round((s - 0.6 * np.sin(2 * np.pi * s) / (2 * np.pi)) * 1000) / 1000
    e, rate = LinearFilter.on_nodes(nodes, kp, kd, 3).respond(forcing(nodes))
    index = np.round(nodes * 1000).astype(int)
    # Cubics miss the forcing by at most 9/384 h^4 times its fourth derivative, 625.
    cubic = 9 / 384 * np.diff(nodes).max() ** 4 * 625
    assert relative(e, exact[0][index]) < cubic
    assert relative(rate, exact[1][index]) < 2 * cubic


def test_terms_against_differences(case):
    """Derivatives of w, twist and torque by central differences; w itself against the accelerations of points."""
    model, frame = case.model.loaded.pin_model, case.model.loaded.tray_id
    rng = np.random.default_rng(1)
    n = case.model.arm.n
    z = np.concatenate([case.joint.q[:1] + 0.1 * rng.normal(size=(1, n)), rng.normal(size=(2, n))])
    terms = motion_terms(model, frame, *z[:, None])
    h = 1e-6
    for column in range(3 * n):
        step = np.zeros((3, n))
        step.flat[column] = h
        up, down = (motion_terms(model, frame, *(z + s * step)[:, None]) for s in (1, -1))
        assert terms.w_z[0, :, column] == pytest.approx((up.w - down.w)[0] / (2 * h), abs=2e-7)
        assert terms.torque_z[0, :, column] == pytest.approx((up.torque - down.torque)[0] / (2 * h), abs=2e-6)
    moved = [motion_terms(model, frame, (z[0] + s * h * z[1])[None], z[1:2], z[2:]) for s in (1, -1)]
    rate = (moved[0].jacobian - moved[1].jacobian)[0] / (2 * h)
    assert terms.jacobian_rate[0] == pytest.approx(rate, abs=1e-7)
    # Accelerations from positions alone: q(t) = q + dq t + ddq t^2 / 2.
    h = 1e-3
    still = np.zeros((1, n))
    path = [
        motion_terms(model, frame, z[:1] + s * h * z[1] + 0.5 * (s * h) ** 2 * z[2], still, still) for s in (-1, 0, 1)
    ]
    a_S = (path[0].p_SE - 2 * path[1].p_SE + path[2].p_SE) / h**2
    back, ahead = (log(np.swapaxes(path[1].R_SE, 1, 2) @ path[k].R_SE) for k in (0, 2))
    omega, alpha = (ahead - back) / (2 * h), (ahead + back) / h**2
    assert terms.w == pytest.approx(motion_vector(terms.R_SE, a_S, omega, alpha), abs=1e-5)


def test_load_terms_are_the_torque_of_the_true_load(case):
    """J^T (d load) w against inverse dynamics with the load as it truly is, far from nominal."""
    load, names = load_change(case.scenario.payload), case.model.uncertain.names
    rng = np.random.default_rng(2)
    q, dq, ddq = (x[200:201] for x in case.joint.sample(T))
    terms = motion_terms(case.model.loaded.pin_model, case.model.loaded.tray_id, q, dq, ddq)
    values = case.model.uncertain.nominal + case.model.uncertain.half_range * rng.choice([-1, 1], len(names))
    change = dict(zip(names, values - case.model.uncertain.nominal, strict=True))
    true = with_load(case.model.arm, case.carried(change)).inverse_dynamics(q[0], dq[0], ddq[0])
    wrench = np.einsum("c,cij,j->i", load.deviations(values), load.load_p, terms.w[0])
    first = np.einsum("c,cij,j->i", values - case.model.uncertain.nominal, load.load_p[: len(names)], terms.w[0])
    extra = true - terms.torque[0]
    left, left_by_first = (relative(terms.jacobian[0].T @ x, extra) for x in (wrench, first))
    assert left < 2e-3  # products of three parameters
    assert left_by_first > 5 * left


# ---- limits and bounds ----------------------------------------------------------------------------------------


def test_without_the_arms_own_inertia_it_is_the_papers_loop():
    """A massless arm leaves a free object under its controller: section III of the paper, state and input alike."""
    case = Case("ur10")
    case.model = replace(case.model, loop=replace(case.model.loop, settle=0.0), loaded=_weightless(case.model))
    chain = arm_chain(case.model, case.joint, space="object", t=T)
    names = chain.uncertain.names
    gains, own = case.model.gains, chain.uncertain.parameters
    paper = TrayLoop(case.body.inertial, gains, phi_jacobian(case.body.inertial, case.body.name, own)).along(
        case.reference, T
    )
    p, turn, R = case.body.p_EB, case.body.R_EB, chain.terms.R_SE
    acting = [j for j, name in enumerate(names) if name in INERTIAL]
    half = chain.uncertain.half_range[acting]
    # The tray's deviation seen at B: the object's place on it is nominal.
    theta = np.moveaxis(chain.tray.state[:, 3:6, acting], 1, 2)
    dp = np.moveaxis(chain.tray.state[:, :3, acting], 1, 2) + np.einsum("tij,tkj->tki", R, np.cross(theta, p))
    found = [dp, theta @ turn, np.moveaxis(chain.wrench[:, :, acting], 1, 2)]
    expected = [paper.state[:, :3, acting], paper.state[:, 3:6, acting], paper.wrench[:, :, acting]]
    for ours, theirs in zip(found, expected, strict=True):
        assert relative(ours * half[:, None], np.moveaxis(theirs, 1, 2) * half[:, None]) < 1e-3


def _weightless(model):
    """The arm with a millionth of its own inertia, its objects as they are."""
    bare = model.arm.pin_model.copy()
    for i in range(1, bare.njoints):
        inertia = bare.inertias[i]
        bare.inertias[i] = pin.Inertia(1e-6 * inertia.mass, inertia.lever, 1e-6 * inertia.inertia)
    return with_load(replace(model.arm, pin_model=bare, data=bare.createData()), model.items)


def test_instants_of_a_long_motion_are_no_further_apart_than_of_a_short_one(case):
    joint = case.joint
    slower = JointMotion(1.6 * joint.t, joint.q, joint.dq / 1.6, joint.ddq / 1.6**2)
    for motion in (joint, slower):
        t = arm_chain(case.model, motion, space="joint").t
        assert np.diff(t) == pytest.approx(np.full(len(t) - 1, 0.0125))  # s; 80 and 128 of them
        assert (t[0], t[-1]) == (0.0, pytest.approx(motion.duration))


def test_worst_contact_without_tracking_is_that_of_the_rows(case):
    w = arm_chain(case.model, case.joint, space="joint").terms.w
    for rows in contact_rows(case.scenario.payload):
        terms = case.model.load.terms
        still = Drift(terms, np.zeros((*w.shape, len(terms))), np.zeros_like(w))
        assert rows.worst(w, still) == pytest.approx(rows.worst(w), abs=1e-12)


def test_least_slack_bounds_perturbed_runs(panda):
    """Nonlinear runs at the corners that differences call worst, for the row that is nearest to failing there.

    Contact slack stays above the bound everywhere and comes near to it where it was aimed.
    """
    chain = arm_chain(panda.model, panda.joint, space="joint", t=T)
    bound, body, uncertain = chain.least_slack(), panda.body, chain.uncertain

    def slack(w, change):
        """(T, n_rows) of what is carried, at w (T, 12) of the tray."""
        (moved,) = panda.carried(change)
        need = wrench_map(moved.inertial.phi) @ frame_map(moved.p_EB, moved.R_EB)
        friction = np.full(body.contacts.count, body.friction + change.get("friction", 0.0))
        facets = cone_facets(replace(body.contacts, friction=friction)).rows
        return -w @ need.T @ facets.T / (9.81 * moved.inertial.mass)

    for k in (60, int(np.argmin(bound)), 330):
        w, nominal = chain.terms.w[[k]], slack(chain.terms.w[[k]], {})[0]
        effect = np.array(
            [
                (
                    slack(w + h * chain.tray.w[[k], :, j], {name: h})
                    - slack(w - h * chain.tray.w[[k], :, j], {name: -h})
                )[0]
                / 2
                for j, (name, h) in enumerate(zip(uncertain.names, uncertain.half_range, strict=True))
            ]
        )
        row = int(np.argmin(nominal - np.abs(effect).sum(axis=0)))
        corner = np.where(effect[:, row] >= 0, -1.0, 1.0) * uncertain.half_range
        change = dict(zip(uncertain.names, corner, strict=True))
        found = slack(panda.felt(panda.rollout("joint", change)), change).min(axis=1)
        assert (found - bound).min() > -1e-3
        # The rest of the tube is products of two parameters, bounded one by one, and held commands.
        assert found[k] - bound[k] < 0.1 * (nominal.min() - bound[k]), (found[k], bound[k])
    assert np.all(chain.least_slack(tracking=False) >= bound - 1e-12)


def test_the_loop_on_uneven_nodes_is_the_chains(panda):
    """Fastest plans evaluate it on nodes of their own: the same dw by every term, products included."""
    chain = arm_chain(panda.model, panda.joint, space="joint", t=T)
    s = np.linspace(0.0, 1.0, 101)
    nodes = DURATION * (s - 0.5 * np.sin(2 * np.pi * s) / (2 * np.pi))
    q, *rates = (*panda.joint.sample(nodes), panda.joint.jerk(nodes))
    terms = motion_terms(panda.model.loaded.pin_model, panda.model.loaded.tray_id, q, *rates[:2])
    found = panda.model.loop.along(nodes, terms, np.stack(rates))
    expected = interp1d(T, chain.tray.w[:, 4], axis=0)(nodes)
    scale = chain.model.load.half_range
    assert relative(found.tray.w[:, 4] * scale, expected * scale) < 1e-3


def test_a_motion_that_begins_deviated_goes_on_as_the_whole_does(panda):
    """With what late commands do to it, and between two nodes."""
    loop = replace(panda.model.loop, delay=0.5 * STEP)
    t, half = np.linspace(0.0, DURATION, 801), 400

    def along(t, loop):
        q, *rates = (*panda.joint.sample(t), panda.joint.jerk(t))
        loaded = panda.model.loaded
        return loop.along(t - t[0], motion_terms(loaded.pin_model, loaded.tray_id, q, *rates[:2]), np.stack(rates))

    whole = along(t, loop)
    second = along(t[half:], loop.begun(whole.state_at(t, t[half])))
    for name in ("q", "dq"):
        for mine, all_ in ((second.joints, whole.joints), (second.held, whole.held)):
            expected = getattr(all_, name)[half:]
            assert relative(getattr(mine, name), expected) < 1e-6
            assert np.abs(expected[0]).max() > 0.05 * np.abs(expected).max()
    for now in (t[7], t[7] + 0.3 * (t[1] - t[0])):
        e, rate = whole.state_at(t, now)
        position = [np.interp(now, t, -whole.held.q[:, joint]) for joint in range(7)]
        speed = [np.interp(now, t, -whole.joints.dq[:, joint, 0]) for joint in range(7)]
        assert e[:, -1] == pytest.approx(position, rel=1e-9)
        assert rate[:, 0] == pytest.approx(speed, rel=1e-9)


@pytest.mark.parametrize("space", ["joint", "object"])
def test_deviations_are_derivatives_of_one_another(panda, space):
    """Also of a posture that a redundant arm is free to take."""
    chain = arm_chain(panda.model, panda.joint, space=space, t=T)
    q, dq, ddq = (x * chain.model.load.half_range for x in (chain.joints.q, chain.joints.dq, chain.joints.ddq))
    for value, rate in ((q, dq), (dq, ddq)):
        assert relative(rate[1:-1], (value[2:] - value[:-2]) / (2 * STEP)) < 3e-3  # a quarter of it at half the step


@pytest.mark.slow
@pytest.mark.parametrize("space", ["joint", "object"])
def test_held_commands_act_half_a_period_late(panda, space):
    """Nominal load, each torque held for 2.5 and for 5 ms, against what the delay predicts; its error falls with it."""
    free = panda.rollout(space, {})
    misses = []
    for hold in (2, 1):
        model = replace(panda.model, loop=replace(panda.model.loop, delay=0.5 * hold * STEP))
        held = arm_chain(model, panda.joint, space=space, t=T).held
        run = panda.rollout(space, {}, hold)
        every = slice(None, None, hold)
        misses.append(relative(held.q[every], (run["q"] - free["q"])[every]))
        assert relative(held.torque[every], (run["torque"] - free["torque"])[every]) < 0.04
        at_command = (panda.felt(run) - panda.felt(free))[every]
        assert relative((held.w + held.swing)[every], at_command) < 0.04
    assert misses[1] < 0.02
    assert misses[1] == pytest.approx(0.5 * misses[0], rel=0.3)


def test_no_uncertainty_no_tubes():
    plain = CUBE.with_changes(objects__0__uncertainty={}, uncertainty__tilt_deg=[0.0, 0.0])
    case = Case("panda")
    chain = arm_chain(chain_model(plain), case.joint)
    assert not chain.radius(chain.tray.state).any()
    planned = chain.least_slack(tracking=False)
    assert chain.least_slack(held=False) == pytest.approx(planned, abs=1e-12)
    assert chain.least_slack() == pytest.approx(planned, abs=3e-3)


def test_a_seen_object_in_an_unknown_place_is_refused():
    with pytest.raises(ScenarioError, match='feedback = "object"'):
        chain_model(CUBE.with_changes(physics__feedback="object"))


def test_without_an_arm_there_is_no_chain():
    with pytest.raises(ScenarioError, match=r"has no arm; give it a table \[arm\]"):
        chain_model(CUBE.with_changes(arm=None))


def jolted(q: np.ndarray, jerk: float, pieces: int = 24, each: float = 0.031) -> JointMotion:
    """From rest in a posture with a jerk, rad/s^3, that is constant in each piece and jumps between them, so that it
    ends at rest; most of it of the first joint, some of the fourth."""
    way = np.zeros((len(q), 1))
    way[[0, 3]] = [[1.0], [0.4]]
    sign = np.array([1.0, -1.0, -1.0, 1.0])  # to speed and acceleration 0 again, and back the same way
    signs = np.tile(np.concatenate([sign, -sign]), pieces // 8 + 1)[:pieces]
    states = [np.zeros((3, len(q)))]
    states[0][0] = q
    for s in signs:
        x, v, a = states[-1]
        j = s * jerk * way[:, 0]
        states.append(
            np.array([x + v * each + a * each**2 / 2 + j * each**3 / 6, v + a * each + j * each**2 / 2, a + j * each])
        )
    return JointMotion(each * np.arange(pieces + 1), *np.swapaxes(np.array(states), 0, 1))


def test_where_the_jerk_jumps_the_least_slack_is_that_of_a_fine_grid(panda):
    """Against a loop on instants .25 ms apart, beside each jump a microsecond, for which all is linear in between."""
    model, motion = chain_model(CUBE), jolted(panda.joint.q[0], 100.0)
    found = arm_chain(model, motion, space="joint")
    t = np.arange(0.0, motion.duration, 2.5e-4)
    t = np.unique(np.concatenate([t[np.abs(t[:, None] - motion.t).min(axis=1) > 1e-5], motion.t, motion.t[1:] - 1e-6]))
    q, *rates = (*motion.sample(t), motion.jerk(t))
    terms = motion_terms(model.loaded.pin_model, model.loaded.tray_id, q, *rates[:2])
    fine = replace(found, t=t, **vars(model.loop.along(t, terms, np.stack(rates), order=1)))
    least = fine.least_slack()
    assert (np.diff(found.t) > 0).all()
    jumps = motion.t[1:-1][np.arange(1, 24) % 4 != 2]
    for side in (jumps, jumps - 1e-5):  # after each and before
        assert np.abs(found.t[:, None] - side).min(axis=0).max() < 1e-5
    assert found.least_slack() == pytest.approx(np.interp(found.t, t, least), abs=1e-4)
    assert found.least_slack().min() == pytest.approx(least.min(), abs=1e-4)
    even = arm_chain(model, motion, space="joint", t=np.linspace(0.0, motion.duration, 81))
    assert even.least_slack().min() > least.min() + 1e-3


@pytest.mark.slow
def test_a_chain_with_a_liquid_says_no_slack(coffee_plan):
    """As a solid the coffee of a safe plan would seem to slide: what its waves take off is not in the chain."""
    plan = coffee_plan
    assert plan.ok
    assert plan.chain.least_slack().min() < 0
    assert "contact_slack" not in plan.summary()["arm_chain"]
