"""What a wrong load does through the arm that carries it: bounds of the chain and of fastest plans, for nasty loads.

The bounds must hold for every true load of the set and be attained by one, both loads and arm computed by Newton, Euler
and Pinocchio; what first order leaves out vanishes with the set.
"""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

import numpy as np
import pinocchio as pin
import pytest
from numpy.testing import assert_allclose

import odd_loads
import sampled_sets
from salver.geometry import Array
from salver.models.arm.arm import load_arm
from salver.planning.fastest import transport_problem
from salver.planning.plan import Plan
from salver.planning.trajopt.constraints import obstacles
from salver.planning.trajopt.constraints.constraints import Block, evaluate
from salver.scenario import Scenario, load
from salver.sensitivity.arm import ArmChain, arm_chain, chain_model
from salver.simulation.physics import simulate
from salver.trajectory import JointMotion

LOADS = {"single": odd_loads.single, "stack": odd_loads.stack, "pair": odd_loads.pair}
CASES = [(load, kind) for load in LOADS for kind in ("box", "ellipsoid")]
SOME = [("single", "ellipsoid"), ("stack", "ellipsoid"), ("pair", "box")]
EVERY = [case if case in SOME else pytest.param(*case, marks=pytest.mark.slow) for case in CASES]
POSTURE = np.array(load("panda-cube").arm.start_posture)
SWING = np.array([0.5, -0.2, 0.2, 0.15, 0.3, 0.2, -0.4])
T = np.linspace(0.0, 1.0, 41)
FINER = 4  # nodes of the planner between two of these: its drive is linear between them
ENDS = np.stack([POSTURE, POSTURE + SWING])
JOINT = JointMotion(np.array([0.0, 1.0]), ENDS, np.zeros((2, 7)), np.zeros((2, 7)))


AT_ONCE = 0.0  # s by which a command acts late: what small sets do is not lost beside held commands
HELD = 1e-3


@lru_cache(maxsize=16)
def small(name: str, kind: str, share: float = 1e-3) -> Scenario:
    made = odd_loads.small(LOADS[name](kind), share)
    place = [3 * share * 1e-3, 2 * share * 1e-3]
    return made.with_changes(**{f"objects__{k}__uncertainty__position": place for k in range(len(made.objects))})


@lru_cache(maxsize=16)
def chain_of(name: str, kind: str, share: float = 1e-3, delay: float = AT_ONCE) -> ArmChain:
    made = small(name, kind, share) if share else LOADS[name](kind)
    model = chain_model(made)
    model = replace(model, loop=replace(model.loop, delay=delay))
    return arm_chain(model, JOINT, space="joint", t=T)


def deviations(chain: ArmChain, change: dict[str, float]) -> Array:
    return np.array([change.get(name, 0.0) for name in chain.uncertain.names])


def felt_with(chain: ArmChain, at: slice = slice(None)) -> sampled_sets.Felt:
    """What the tray feels when parameters deviate, to first order in what the arm makes of it."""
    linear = chain.tray.w[at, :, : chain.uncertain.size]
    return lambda change: chain.terms.w[at] + linear @ deviations(chain, change)


@pytest.mark.parametrize(("name", "kind"), EVERY)
def test_least_slack_of_a_small_set_is_attained(name: str, kind: str) -> None:
    """By a true load, on a tray that strays as the arm does: no parameter's two effects are added with a wrong sign."""
    chain, at = chain_of(name, kind), slice(None, None, 5)
    rows = odd_loads.TrueRows(small(name, kind))
    nominal = -rows.worst({}, chain.terms.w[at])
    planned = -sampled_sets.sampled(rows, chain.terms.w[at], 2)
    # A controller that is better than assumed may follow exactly: the bound is of both.
    strayed = np.minimum(planned, -sampled_sets.sampled(rows, felt_with(chain, at), 2))
    for reached, tracking in ((planned, False), (strayed, True)):
        share = (nominal - reached) / (nominal - chain.least_slack(tracking=tracking, held=False)[at])
        if tracking and name == "pair" and kind == "ellipsoid":
            # What the other object does to the arm is added as if it were not of the same ellipsoid: a tenth at most.
            assert np.all((share > 0.9) & (share < 1.003))
        else:
            assert_allclose(share, 1.0, atol=3e-3)


@pytest.mark.slow
@pytest.mark.parametrize(("name", "kind"), SOME)
def test_no_load_of_the_set_has_less_than_the_least_slack(name: str, kind: str) -> None:
    chain, at = chain_of(name, kind, 0), slice(None, None, 5)
    rows = odd_loads.TrueRows(LOADS[name](kind))
    bound = chain.least_slack(held=False)[at]
    reached = -sampled_sets.sampled(rows, felt_with(chain, at), 30)
    # Left out: what a parameter makes of the deviation that another one causes, some thousandths of the weight.
    assert np.all(reached >= bound - 2e-3)


@pytest.mark.slow
@pytest.mark.parametrize("delay", [AT_ONCE, HELD])
@pytest.mark.parametrize(("name", "kind"), CASES)
def test_fastest_plans_and_the_chain_agree_on_the_contact(name: str, kind: str, delay: float) -> None:
    """The planner's rows along a motion, on nodes of its own, against the chain's least slack."""
    made = small(name, kind)
    chain, seen = chain_of(name, kind, delay=delay), evaluated(name, kind, delay)
    worst = np.max([f.values.max(axis=1) for f in seen if f.name.startswith("contact")], axis=0)[::FINER]
    nominal = odd_loads.TrueRows(made).worst({}, chain.terms.w)
    assert_allclose((worst - nominal) / (-chain.least_slack() - nominal), 1.0, atol=5e-3)


@pytest.mark.slow
@pytest.mark.parametrize(("name", "kind"), [("single", "box"), ("stack", "ellipsoid")])
def test_fastest_plans_count_the_products_of_a_large_set(name: str, kind: str) -> None:
    chain, seen = chain_of(name, kind, 0), rows_along(LOADS[name](kind))
    worst = np.max([f.values.max(axis=1) for f in seen if f.name.startswith("contact")], axis=0)[::FINER]
    assert_allclose(worst, -chain.least_slack(), atol=1e-4)  # what a cubic between nodes of other spacing leaves


@lru_cache(maxsize=16)
def evaluated(name: str, kind: str, delay: float = AT_ONCE) -> tuple[Block, ...]:
    return rows_along(small(name, kind), delay)


def rows_along(made: Scenario, delay: float = AT_ONCE) -> tuple[Block, ...]:
    """The planner's rows along the motion, no margins."""
    s = np.linspace(0.0, 1.0, FINER * (len(T) - 1) + 1)
    z = np.stack([*JOINT.sample(s), JOINT.jerk(s)])
    problem = transport_problem(made.with_changes(motion__speeds="full"), level=False)
    assert problem.tracking is not None
    problem = replace(problem, tracking=replace(problem.tracking, delay=delay))
    return evaluate(problem.constraints, problem.at(s, z, 1.0), margins=False)


# The load ------------------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("name", ["stack", "pair"])
def test_missing_acceleration_is_that_of_the_true_load(name: str) -> None:
    """M^-1 J^T dF of every parameter, dF by Newton and Euler, M and J^T by Pinocchio's inverse dynamics."""
    made, chain = LOADS[name]("box"), chain_of(name, "box", 0)
    q, dq, ddq = JOINT.sample(T)
    nominal = odd_loads.nominal_bodies(made)
    model, bare = odd_loads.with_bodies(chain.model.arm, nominal), odd_loads.with_bodies(chain.model.arm, [])
    mass_matrix = odd_loads.mass_matrices(model, q)
    for j, parameter in enumerate(chain.uncertain.names):
        h = 1e-3 * float(chain.uncertain.half_range[j])
        ends = [
            odd_loads.torques(
                odd_loads.with_bodies(chain.model.arm, odd_loads.true_bodies(made, {parameter: s * h})), q, dq, ddq
            )
            for s in (1, -1)
        ]
        expected = np.linalg.solve(mass_matrix, ((ends[0] - ends[1]) / (2 * h))[:, :, None])[:, :, 0]
        found = chain.joints.missing[:, :, j]
        size = max(np.abs(expected).max(), 1e-9)
        assert np.abs(found - expected).max() < 1e-5 * size, parameter
    assert np.abs(odd_loads.torques(bare, q, dq, ddq)).max() > 1


@pytest.mark.slow
@pytest.mark.parametrize("name", ["single", "stack"])
def test_products_are_what_two_wrong_parameters_do_together(name: str) -> None:
    """M^-1 J^T of the load's second differences, and of what each parameter's load makes of the other's deviation."""
    made, chain = LOADS[name]("box"), chain_of(name, "box", 0)
    at, n_p = slice(None, None, 10), chain.uncertain.size
    half = dict(zip(chain.uncertain.names, chain.uncertain.half_range, strict=True))
    model, q = odd_loads.with_bodies(chain.model.arm, odd_loads.nominal_bodies(made)), JOINT.sample(T)[0][at]
    mass_matrix, w = odd_loads.mass_matrices(model, q), chain.terms.w[at]
    jacobian = np.array([chain.model.arm.body_jacobian(posture) for posture in q])

    def needed(change: dict[str, float], w: Array) -> Array:
        return sum(odd_loads.needed_at_E(body, w) for body in odd_loads.true_bodies(made, change))

    def first(parameter: str, w: Array) -> Array:
        h = 1e-3 * half[parameter]
        return (needed({parameter: h}, w) - needed({parameter: -h}, w)) / (2 * h)

    products = [tuple(p.name for p in factors) for factors in chain.model.load.terms[n_p:]]
    assert {("mass", "com_x"), ("com_z", "com_z")} <= {tuple(x.rpartition(".")[2] for x in pair) for pair in products}
    for k, (a, b) in enumerate(products):
        ha, hb = half[a], half[b]
        strayed = {p: chain.tray.w[at, :, chain.uncertain.names.index(p)] for p in (a, b)}
        if a == b:
            wrench = (needed({a: ha}, w) + needed({a: -ha}, w) - 2 * needed({}, w)) / (2 * ha**2) + first(a, strayed[a])
        else:
            corners = [s * t * needed({a: s * ha, b: t * hb}, w) for s in (1, -1) for t in (1, -1)]
            wrench = sum(corners) / (4 * ha * hb) + first(a, strayed[b]) + first(b, strayed[a])
        expected = np.linalg.solve(mass_matrix, np.einsum("tij,ti->tj", jacobian, wrench)[:, :, None])[:, :, 0]
        found = chain.joints.missing[at, :, n_p + k]
        assert np.abs(found - expected).max() < 1e-4 * np.abs(expected).max(), (a, b)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["stack", "pair"])
def test_terms_of_the_load_add_up_to_the_true_load(name: str) -> None:
    """Load, first object's wrench: at corners of the set, products of two parameters included."""
    made, chain = LOADS[name]("box"), chain_of(name, "box", 0)
    known, w = chain.model.load, chain.terms.w[::16]
    nominal = sum(odd_loads.needed_at_E(body, w) for body in odd_loads.nominal_bodies(made))
    left, first = [], []
    for change in sampled_sets.samples(chain.uncertain, 12):
        true = odd_loads.true_bodies(made, change)
        extra = sum(odd_loads.needed_at_E(body, w) for body in true) - nominal
        values = chain.uncertain.nominal + deviations(chain, change)
        parts = np.einsum("cij,tj->tic", known.load_p, w) * known.deviations(values)
        left.append(np.abs(parts.sum(axis=2) - extra).max() / np.abs(extra).max())
        first.append(np.abs(parts[:, :, : chain.uncertain.size].sum(axis=2) - extra).max() / np.abs(extra).max())
    assert max(left) < 2e-3  # products of three parameters
    assert np.median(first) > 5 * max(left)


@pytest.mark.parametrize(("name", "kind"), EVERY)
def test_tubes_of_the_chain_hold_every_load_and_touch_one(name: str, kind: str) -> None:
    """Of torques, tray and joints: first order is attained; with products no sample of the set is outside."""
    chain = chain_of(name, kind, 0)
    n_p = chain.uncertain.size
    joints = np.concatenate([chain.joints.q, chain.joints.dq], axis=1)
    for quantity in (chain.torque, chain.tray.state, joints, chain.wrench):
        part = quantity[::20]
        linear = part[..., :n_p]
        farthest = sampled_sets.steepest(linear, chain.uncertain)
        assert_allclose(chain.radius(linear), np.einsum("...p,...p->...", linear, farthest), rtol=1e-9, atol=1e-12)
        whole = chain.radius(part)
        for change in sampled_sets.samples(chain.uncertain, 20):
            values = deviations(chain, change)
            reached = np.abs(part @ chain.model.load.deviations(chain.uncertain.nominal + values))
            assert np.all(reached <= whole * (1 + 1e-9) + 1e-12)
        assert np.median(whole / np.maximum(chain.radius(linear), 1e-12)) > 1.002  # the products are in it


@pytest.mark.slow
@pytest.mark.parametrize(("name", "kind"), SOME)
def test_fastest_plans_leave_room_for_the_torque_of_any_load(name: str, kind: str) -> None:
    made, chain, seen = small(name, kind), chain_of(name, kind), evaluated(name, kind)
    (block,) = (f for f in seen if f.name == "torque")
    limit = chain.model.arm.planning_limits.torque
    nominal = odd_loads.torques(
        odd_loads.with_bodies(chain.model.arm, odd_loads.nominal_bodies(made)), *JOINT.sample(T)
    )
    room = (block.values[::FINER] + 1) * np.tile(limit, 2) - np.hstack([nominal, -nominal])
    expected = np.tile(chain.torque_radius(), 2)
    assert_allclose(room, expected, atol=5e-3 * expected.max())


@pytest.mark.slow
@pytest.mark.parametrize("order", [0, 1])
@pytest.mark.parametrize("delay", [AT_ONCE, HELD])
def test_fastest_plans_leave_room_for_where_and_how_fast_the_joints_stray(delay: float, order: int) -> None:
    """At nodes, what the chain says of them; and there is more room with held commands than without."""
    chain, seen = chain_of("pair", "box", delay=delay), evaluated("pair", "box", delay)
    (block,) = (f for f in seen if f.name == ("position", "velocity")[order])
    limits, planned = chain.model.arm.planning_limits, JOINT.sample(T)[order]
    above, below = ((limits.q_max, -limits.q_min), (limits.velocity, limits.velocity))[order]
    half = 0.5 * (above + below)
    room = np.tile(half, 2) * -block.values[::FINER]
    radius = np.hstack([above - planned, below + planned]) - room
    deviation, held = (chain.joints.q, chain.held.q) if order == 0 else (chain.joints.dq, chain.held.dq)
    expected = np.abs(held) + chain.radius(deviation)
    assert_allclose(radius, np.tile(expected, 2), atol=5e-3 * expected.max())
    assert expected.max() > (1e-4 if delay else 1e-8)


@pytest.mark.slow
def test_no_load_of_the_set_makes_a_joint_faster_than_its_limit(bottle_plan: Plan) -> None:
    """By the chain; and in the engine at two corners. A joint of this plan is at its limit where a wrong load acts."""
    plan = bottle_plan
    assert plan.ok
    assert plan.joint is not None
    assert plan.chain is not None
    chain, limit = plan.chain, plan.chain.model.arm.planning_limits.velocity
    reached = np.abs(plan.joint.sample(chain.t)[1] + chain.held.dq) + chain.radius(chain.joints.dq)
    assert 0.99 < (reached / limit).max() <= 1.0
    half = plan.uncertain.half_range
    for corner in (half, -half):
        parameters = dict(zip(plan.uncertain.names, (plan.uncertain.nominal + corner).tolist(), strict=True))
        assert (np.abs(simulate(plan, parameters=parameters).dq) / limit).max() <= 1.0


# Clearance -----------------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["box", "ellipsoid"])
def test_fastest_plans_keep_clear_by_the_safety_distance_and_by_what_the_arm_strays(
    kind: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A ball behind the tray: distance by hand from the tray's pose, less 5 mm and what the load makes it stray."""
    made = odd_loads.single(kind)
    arm = load_arm(made.arm, made.tray)
    radius = 0.05
    (p, R), (after, _) = arm.tray_pose(POSTURE), arm.tray_pose(POSTURE + SWING)
    behind = -np.sign((R.T @ (after - p))[1])
    centre = p + R @ np.array([0.02, behind * (0.1 + radius + 0.03), 0.01])
    ball = {"type": "sphere", "name": "ball", "radius": radius, "position": centre.tolist()}
    made = made.with_changes(obstacles=[ball])
    monkeypatch.setattr(
        obstacles.ClearanceOptions, "exact", np.inf
    )  # otherwise a large distance is only no larger than the true one
    seen = rows_along(made)
    (block,) = (f for f in seen if f.name == "clearance")
    chain = arm_chain(chain_model(made), JOINT, space="joint", t=T)
    q = JOINT.sample(T)[0]
    size, thickness = np.array(made.tray.size), made.tray.thickness
    free = []
    for posture in q:
        p, R = arm.tray_pose(posture)
        local = R.T @ (centre - p) + np.array([0, 0, 0.5 * thickness])
        beyond = np.abs(local) - 0.5 * np.array([*size, thickness])
        assert beyond.max() > 0
        free.append(np.linalg.norm(np.maximum(beyond, 0.0)) - radius)
    tray = chain.radius(chain.tray.state[:, :6])
    # What stands up to 0.2 m from the tray's centre moves with its turn.
    stray = np.linalg.norm(tray[:, :3], axis=1) + 0.2 * np.linalg.norm(tray[:, 3:6], axis=1)
    assert stray.max() > 2e-4
    names = transport_problem(made, level=False).keep_out.parts
    column = names.pairs.index((names.names.index("tray"), names.names.index("ball")))
    found = -0.1 * block.values[::FINER, column]
    assert_allclose(found, np.array(free) - 5e-3 - stray, atol=1e-4)


def test_the_tray_turns_as_far_as_the_joints_deviations_turn_it() -> None:
    """By Pinocchio's Jacobian of the tray in E, about each of its three axes."""
    problem = transport_problem(load("panda-cube"))
    s = np.linspace(0, 1, 21)
    blend = (s**3 * (10 - 15 * s + 6 * s**2), 30 * s**2 * (1 - s) ** 2, 60 * s * (1 - s) * (1 - 2 * s))
    q, dq, ddq = (x[:, None] * SWING for x in blend)
    response = problem.at(s, np.stack([POSTURE + q, dq, ddq, 0 * q]), 1.0).response
    assert response is not None
    data = problem.model.createData()
    jacobian = np.stack(
        [pin.computeFrameJacobian(problem.model, data, x, problem.arm.tray_id, pin.LOCAL)[3:] for x in POSTURE + q]
    )
    turned = response.load.radius(jacobian @ response.joints.q) + np.abs(
        np.einsum("tij,tj->ti", jacobian, response.held.q)
    )
    position, turn = response.tray_radius()
    assert position.shape == turn.shape == (21, 3)
    assert turn.max() > 1e-4
    assert_allclose(turn, turned, atol=1e-9)
