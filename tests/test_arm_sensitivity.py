"""The chain of arm, controller and carried objects: against nonlinear forward dynamics, limits, and the engine."""

from dataclasses import replace

import numpy as np
import pinocchio as pin
import pytest
from scipy.interpolate import interp1d

from salver import scenario
from salver.control.arm import ArmController, ArmState
from salver.control.object import Gains
from salver.errors import ScenarioError
from salver.geometry import exp, log, matrix_from_quat_wxyz
from salver.models.arm import with_load
from salver.models.contact_rows import contact_rows
from salver.models.parameters import INERTIAL, inertial_vector, phi_jacobian, phi_of
from salver.models.rigid_body import RigidBody, inertia_matrix
from salver.models.tray_motion import frame_map, motion_vector, wrench_map
from salver.models.worst_case import Drift
from salver.models.wrench_cone import cone_facets
from salver.planning.make import plan_baseline, with_arm
from salver.planning.plan import Plan
from salver.sensitivity.arm import arm_chain, chain_model
from salver.sensitivity.arm.load import load_change
from salver.sensitivity.arm.terms import motion_terms
from salver.sensitivity.filter import LinearFilter, QuadratureGrid
from salver.sensitivity.tray import TrayLoop
from salver.simulation.physics import Options, simulate
from salver.trajectory import JointMotion, MotionSamples, SampledReference

DURATION, STEP = 1.0, 2.5e-3
T = np.linspace(0.0, DURATION, round(DURATION / STEP) + 1)
UNCERTAIN = {
    "mass": "10%",
    "com": [0.003, 0.002, 0.004],
    "inertia": [4e-5, 1e-5, 4e-5, 1e-5, 1e-5, 4e-5],
    "friction": "10%",
    "position": [0.002, 0.003],
}
CUBE = scenario.load("panda-cube").with_changes(
    motion__duration=DURATION, objects__0__uncertainty=UNCERTAIN, uncertainty__tilt_deg=[0.5, 0.5]
)
# A turned object beside the tray's centre, so that no lever vanishes.
CUBE = CUBE.with_changes(objects__0__at=[0.03, -0.02], objects__0__yaw_deg=20)
UR10 = scenario.load("ur10-bottle").with_changes(motion__duration=DURATION)


class Case:
    """A scenario with a quintic joint motion that swings and turns the tray, and the object's motion along it."""

    def __init__(self, name: str) -> None:
        self.scenario = {"panda": CUBE, "ur10": UR10}[name]
        start, swing = {
            "panda": (np.array(CUBE.arm.start_posture), np.array([0.7, -0.2, 0.3, 0.2, 0.4, 0.3, -0.5])),
            "ur10": (np.array([0.1, -1.6, 1.5, -1.4, -1.5, 0.3]), np.array([0.6, 0.2, -0.3, 0.3, 0.4, -0.5])),
        }[name]
        ends = np.stack([start, start + swing])
        self.joint = JointMotion(np.array([0.0, DURATION]), ends, np.zeros_like(ends), np.zeros_like(ends))
        model = chain_model(self.scenario)
        self.model = replace(model, loop=replace(model.loop, delay=0.0))
        self.body = self.model.items[0]
        fine = np.linspace(0.0, DURATION, 401)
        self.terms = motion_terms(self.model.loaded.pin_model, self.model.loaded.tray_id, *self.joint.sample(fine))
        force, omega, alpha = self.terms.w[:, :3], self.terms.twist[:, 3:], self.terms.w[:, 3:6]
        R, gravity = self.terms.R_SE, np.array([0.0, 0.0, -9.81])
        a_S = np.einsum("tij,tj->ti", R, force) + gravity
        v_S = np.einsum("tij,tj->ti", R, self.terms.twist[:, :3])
        tray = MotionSamples(fine, self.terms.p_SE, v_S, a_S, R, omega, alpha)
        self.reference = SampledReference(tray.of_frame(self.body.p_EB, self.body.R_EB))

    def carried(self, change: dict[str, float]) -> list:
        """The bodies as they are when parameters differ from nominal."""
        tilt = exp(np.array([change.get("tilt_x", 0.0), change.get("tilt_y", 0.0), 0.0]))
        shift = np.array([change.get("position_x", 0.0), change.get("position_y", 0.0), 0.0])
        inertial = inertial_vector(self.body.inertial) + [change.get(name, 0.0) for name in INERTIAL]
        true = RigidBody(inertial[0], inertial[1:4], inertia_matrix(inertial[4:]))
        moved = replace(self.body, inertial=true, p_EB=tilt @ (self.body.p_EB + shift), R_EB=tilt @ self.body.R_EB)
        return [moved, *self.model.items[1:]]

    def rollout(self, space: str, change: dict[str, float], hold: int = 0) -> dict[str, np.ndarray]:
        """Full forward dynamics with the true load stuck to the tray, under the real controller in every stage.

        hold: so many steps each torque is held instead.
        """
        control = self.scenario.control
        controller = ArmController(
            self.model.arm,
            list(self.model.items),
            self.joint,
            self.reference,
            Gains(control.kp, control.kd),
            space=space,
            limit_torque=False,
        )
        plant = with_load(self.model.arm, self.carried(change))
        model, data = plant.pin_model, plant.data

        def rate(t, x):
            q, dq = x
            now = controller.step(ArmState(q, dq), t) if held is None else held
            return np.stack([dq, pin.aba(model, data, q, dq, now)])

        held = None

        x = np.stack([self.joint.q[0], np.zeros(len(self.joint.q[0]))])
        out: dict[str, list] = {key: [] for key in ("q", "dq", "ddq", "torque")}
        for k in range(-round(self.model.loop.settle / STEP), len(T)):
            t = k * STEP
            if hold and k % hold == 0:
                held = controller.step(ArmState(*x), t)
            if k >= 0:
                torque = controller.step(ArmState(*x), t) if held is None else held
                for key, value in zip(out, (*x, pin.aba(model, data, *x, torque).copy(), torque), strict=True):
                    out[key].append(value)
            k1 = rate(t, x)
            k2 = rate(t + STEP / 2, x + STEP / 2 * k1)
            k3 = rate(t + STEP / 2, x + STEP / 2 * k2)
            x = x + STEP / 6 * (k1 + 2 * k2 + 2 * k3 + rate(t + STEP, x + STEP * k3))
        return {key: np.array(value) for key, value in out.items()}

    def slope(self, space: str, change: dict[str, float]) -> dict[str, np.ndarray]:
        """Central difference of the rollout along a direction, for a step of one."""
        up, down = (self.rollout(space, {k: s * v for k, v in change.items()}) for s in (1.0, -1.0))
        return {key: 0.5 * (up[key] - down[key]) for key in up}

    def felt(self, run: dict[str, np.ndarray]) -> np.ndarray:
        """w (T, 12) of E along a rollout."""
        return motion_terms(self.model.loaded.pin_model, self.model.loaded.tray_id, run["q"], run["dq"], run["ddq"]).w


@pytest.fixture(scope="module", params=["panda", "ur10"])
def case(request):
    return Case(request.param)


@pytest.fixture(scope="module")
def panda():
    return Case("panda")


def relative(found, expected):
    return float(np.abs(found - expected).max() / np.abs(expected).max())


# ---- parts ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("gains", [(500.0, 25.0), (100.0, 20.0), (40.0, 30.0)])
def test_filter_on_uneven_nodes(gains):
    """Against the exact filter on a fine even grid, for under-, critically and overdamped gains."""
    kp, kd = gains
    fine = np.linspace(0.0, 1.0, 1001)
    grid = QuadratureGrid(fine, 1)

    def forcing(t):
        return np.cos(5 * t) + t**2

    exact = LinearFilter.on_grid(grid, kp, kd).respond(forcing(grid.times))
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


# ---- against nonlinear forward dynamics ------------------------------------------------------------------------


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
    R0 = chain.nominal.R_SE
    turn = [log(np.swapaxes(R0, 1, 2) @ x.R_SE) for x in (a, b)]
    v_S = [np.einsum("tij,tj->ti", x.R_SE, x.twist[:, :3]) for x in (a, b)]
    expected = [a.p_SE - b.p_SE, turn[0] - turn[1], v_S[0] - v_S[1], a.twist[:, 3:] - b.twist[:, 3:]]
    for k, value in enumerate(expected):
        assert relative(chain.tray[:, 3 * k : 3 * k + 3, j] * h, value / 2) < 1e-4
    assert relative(chain.w[:, :, j] * h, (a.w - b.w) / 2) < 2e-4


def test_wrench_and_contact_rows(panda):
    """Contact wrench of the object as it truly is, and its facets, over rollouts; friction, place and tilt included."""
    chain = arm_chain(panda.model, panda.joint, space="joint", t=T)
    body, uncertain = panda.body, chain.uncertain

    def true(change):
        run = panda.rollout("joint", change)
        inertial = inertial_vector(body.inertial) + [change.get(name, 0.0) for name in INERTIAL]
        (moved,) = panda.carried(change)
        need = wrench_map(phi_of(inertial)) @ frame_map(moved.p_EB, moved.R_EB)
        wrench = panda.felt(run) @ need.T
        friction = np.full(body.contacts.count, body.friction + change.get("friction", 0.0))
        facets = cone_facets(replace(body.contacts, friction=friction)).rows
        return wrench, -wrench @ facets.T / (9.81 * inertial[0])

    _, slack = true({})
    assert slack == pytest.approx(chain.slack, abs=1e-5)
    for name in ("mass", "com_x", "com_z", "inertia_xx", "friction", "position_x"):
        j = uncertain.names.index(name)
        h = 0.05 * float(uncertain.half_range[j])
        up, down = true({name: h}), true({name: -h})
        if name != "friction":
            assert relative(chain.wrench[:, :, j] * h, (up[0] - down[0]) / 2) < 1e-4, name
        assert relative(chain.slack_p[:, :, j] * h, (up[1] - down[1]) / 2) < 1e-3, name


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
    p, turn, R = case.body.p_EB, case.body.R_EB, chain.nominal.R_SE
    acting = [j for j, name in enumerate(names) if name in INERTIAL]
    half = chain.uncertain.half_range[acting]
    # The tray's deviation seen at B: the object's place on it is nominal.
    theta = np.moveaxis(chain.tray[:, 3:6, acting], 1, 2)
    dp = np.moveaxis(chain.tray[:, :3, acting], 1, 2) + np.einsum("tij,tkj->tki", R, np.cross(theta, p))
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
    w = arm_chain(case.model, case.joint, space="joint").nominal.w
    for rows in contact_rows(case.scenario.payload):
        terms = case.model.load.terms
        still = Drift(terms, np.zeros((*w.shape, len(terms))), np.zeros_like(w))
        assert rows.worst(w, still) == pytest.approx(rows.worst(w), abs=1e-12)


def test_least_slack_bounds_perturbed_runs(panda):
    """Nonlinear runs at the corners that the derivatives call worst, for the row that is nearest to failing there.

    Contact slack stays above the bound everywhere and comes near to it where it was aimed.
    """
    chain = arm_chain(panda.model, panda.joint, space="joint", t=T)
    bound, body, uncertain = chain.least_slack(), panda.body, chain.uncertain
    tube = np.abs(chain.slack_p) @ uncertain.half_range
    for k in (60, int(np.argmin(bound)), 330):
        row = int(np.argmin(chain.slack[k] - tube[k]))
        corner = -np.where(chain.slack_p[k, row] >= 0, 1.0, -1.0) * uncertain.half_range
        change = dict(zip(uncertain.names, corner, strict=True))
        (moved,) = panda.carried(change)
        need = wrench_map(moved.inertial.phi) @ frame_map(moved.p_EB, moved.R_EB)
        friction = np.full(body.contacts.count, body.friction + change["friction"])
        facets = cone_facets(replace(body.contacts, friction=friction)).rows
        wrench = panda.felt(panda.rollout("joint", change)) @ need.T
        slack = (-wrench @ facets.T / (9.81 * moved.inertial.mass)).min(axis=1)
        assert (slack - bound).min() > -1e-3
        # The rest of the tube is products of two parameters, bounded one by one, and held commands.
        assert slack[k] - bound[k] < 0.1 * (chain.slack[k].min() - bound[k]), (slack[k], bound[k])
    assert np.all(chain.least_slack(tracking=False) >= bound - 1e-12)


def test_the_loop_on_uneven_nodes_is_the_chains(panda):
    """Fastest plans evaluate it on nodes of their own: the same dw by every term, products included."""
    chain = arm_chain(panda.model, panda.joint, space="joint", t=T)
    s = np.linspace(0.0, 1.0, 101)
    nodes = DURATION * (s - 0.5 * np.sin(2 * np.pi * s) / (2 * np.pi))
    q, *rates = (*panda.joint.sample(nodes), panda.joint.jerk(nodes))
    terms = motion_terms(panda.model.loaded.pin_model, panda.model.loaded.tray_id, q, *rates[:2])
    found = panda.model.loop.along(nodes, terms, np.stack(rates))
    expected = interp1d(T, chain.w[:, 4], axis=0)(nodes)
    scale = chain.model.load.half_range
    assert relative(found.tray.w[:, 4] * scale, expected * scale) < 1e-3


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
    assert not chain.radius(chain.tray).any()
    planned = chain.least_slack(tracking=False)
    assert chain.least_slack(held=False) == pytest.approx(planned, abs=1e-12)
    assert chain.least_slack() == pytest.approx(planned, abs=3e-3)


def test_a_seen_object_in_an_unknown_place_is_refused():
    with pytest.raises(ScenarioError, match='feedback = "object"'):
        chain_model(CUBE.with_changes(physics__feedback="object"))


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
    assert relative(at(chain.tray[:, :3]), difference(lambda r: r.p_SE)) < 0.005
    assert relative(at(chain.tray[:, 3:6]), 0.5 * log(turn)[moving]) < 0.006
    assert relative(at(chain.torque), difference(lambda r: r.tau)) < 0.02
    assert relative(at(chain.wrench[:, :3]), difference(wrench)[:, :3]) < 0.002
