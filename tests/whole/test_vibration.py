"""A tray that shakes: what contact must keep for it, that everything counts it, and that the engine agrees."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import mujoco
import numpy as np
import pytest
from numpy.testing import assert_allclose

import odd_loads
import salver as sv
from salver.auditing import Audit
from salver.auditing.motion import AuditedMotion
from salver.contact_margins import margin_model
from salver.driver.robots.simulated import SimulatedRobot
from salver.driver.sensing import Sensed
from salver.errors import ScenarioError
from salver.geometry import GRAVITY_S, Array, invert
from salver.live.committed.commit import verified
from salver.live.committed.motion import resting
from salver.models.contact_rows import contact_rows
from salver.models.tray_motion import at_rest
from salver.models.uncertain.parameters import Vibration
from salver.models.uncertain.worst_case import WorstCase
from salver.planning.fastest import transport_problem
from salver.planning.make import make_plan
from salver.planning.object.problem import ObjectProgramme, Problem
from salver.planning.object.solvers import solve
from salver.planning.plan import Plan
from salver.planning.stops import stop_from
from salver.planning.trajopt.constraints.constraints import ContactConstraint
from salver.planning.trajopt.ends import AtPosture
from salver.planning.trajopt.objectives import Point
from salver.playground.world import World
from salver.sampling import draw
from salver.scenario import Scenario
from salver.simulation.physics import Experiment, simulate_tray
from salver.simulation.scene.loads import true_world
from salver.simulation.scene.scene import build
from salver.simulation.scene.shaking import Shaking
from salver.simulation.tray_frame import TrayMotion, apply
from salver.trajectory import MotionSamples, SampledReference
from sampled_sets import samples

MM = {"amplitude": 1e-3, "frequency": 15.0}
TURNING = {"tilt_deg": 0.2, "frequency": 12.0}
BOTH = {"amplitude": 3e-4, "tilt_deg": 0.1, "frequency": 14.0}
WELL_KNOWN = {"objects__0__uncertainty": {}, "uncertainty": {}}
TRUE_BOTTLE = sv.load_scenario("panda-tall-bottle").with_changes(**WELL_KNOWN)
SHAKE = {"amplitude": 5e-5, "frequency": 15.0}


def shaking(made: Scenario, shake: dict[str, float] | None) -> Scenario:
    return made.with_changes(uncertainty__shake=shake)


def directions(count: int, seed: int = 0) -> Array:
    """(count, 3) unit vectors all around, each with its opposite."""
    ways = np.random.default_rng(seed).standard_normal((count // 2, 3))
    ways /= np.linalg.norm(ways, axis=1, keepdims=True)
    return np.concatenate([ways, -ways])


def felt(shake: dict[str, float], ways: Array, axes: Array) -> Array:
    """(K, 12) largest changes of what a tray feels that shakes along `ways`, about `axes`; without what leans."""
    rate = (2 * np.pi * shake["frequency"]) ** 2
    turn = np.deg2rad(shake.get("tilt_deg", 0.0))
    push, spin = rate * shake.get("amplitude", 0.0) * ways, rate * turn * axes
    return np.hstack([push, spin, np.zeros((len(ways), 6))])


# ---- the worst case -------------------------------------------------------------------------------------------


@pytest.mark.parametrize("shake", [MM, TURNING, BOTH], ids=["shifts", "turns", "both"])
@pytest.mark.parametrize("load", [odd_loads.single, odd_loads.stack])
def test_of_a_load_that_is_known_it_is_the_worst_direction(load: Any, shake: dict[str, float]) -> None:
    """Yawed boxes beside the middle, rows of Newton and Euler; each row by itself, in the best of 4000 directions."""
    made = load()
    known = {f"objects__{k}__uncertainty": {} for k in range(len(made.objects))}
    made = shaking(made.with_changes(**known, uncertainty={}), shake)
    w = odd_loads.felt(odd_loads.tray_motion(3, 7))
    ((rows,), (still,)) = (contact_rows(x.payload) for x in (made, shaking(made, None)))
    ways, axes = directions(4000), directions(4000, 1)
    moved = np.hstack(odd_loads.TrueRows(made).at({}, felt(shake, ways, 0 * axes))).max(axis=0)
    turned = np.hstack(odd_loads.TrueRows(made).at({}, felt(shake, 0 * ways, axes))).max(axis=0)
    lean = made.payload.uncertain.shake.acceleration - (2 * np.pi * shake["frequency"]) ** 2 * shake.get("amplitude", 0)
    assert lean == pytest.approx(9.81 * np.deg2rad(shake.get("tilt_deg", 0.0)))
    pushed = np.hstack(odd_loads.TrueRows(made).at({}, felt({"amplitude": 1.0, "frequency": 0.5 / np.pi}, ways, axes)))
    expected = moved + turned + lean * pushed.max(axis=0)
    added, expected = np.sort(rows.worst(w) - still.worst(w)), np.sort(expected)  # facets come in any order
    assert_allclose(added, np.broadcast_to(expected, added.shape), rtol=1e-2)  # 4000 directions miss it by 0.5 %
    assert np.all(added > expected - 1e-9)


@pytest.mark.parametrize("kind", ["box", "ellipsoid"])
@pytest.mark.parametrize("load", [odd_loads.single, odd_loads.stack])
def test_of_an_uncertain_load_no_sample_is_worse(load: Any, kind: str) -> None:
    made = shaking(load(kind), BOTH)
    w, uncertain = odd_loads.felt(odd_loads.tray_motion(4, 8)), made.payload.uncertain
    claimed = np.max([rows.worst(w).max(axis=1) for rows in contact_rows(made.payload)], axis=0)
    still = np.max([rows.worst(w).max(axis=1) for rows in contact_rows(load(kind).payload)], axis=0)
    true, reached, alone = odd_loads.TrueRows(made), np.full(len(w), -np.inf), np.full(len(w), -np.inf)
    changes = felt(BOTH, directions(60), directions(60, 1))
    for change in samples(uncertain, 60):
        alone = np.maximum(alone, true.worst(change, w))
        for dw in changes:
            reached = np.maximum(reached, true.worst(change, w + dw))
    assert np.all(reached <= claimed + 1e-5)
    assert np.all(claimed > still)
    assert np.all(reached - alone > 0.5 * (claimed - still))  # and not much too wide: 120 directions of two spheres


def test_contents_that_may_be_any_shake_with_the_tray() -> None:
    made = odd_loads.scenario(
        [{**odd_loads.LOWER, "name": "box", "inertia": None, "uncertainty": {"mass": 0.05, "contents": "any"}}]
    ).with_changes(uncertainty__shake=TURNING, uncertainty__tilt_deg=None)
    w = odd_loads.felt(odd_loads.tray_motion(2, 9))
    (rows,) = contact_rows(made.payload)
    claimed, uncertain = rows.worst(w).max(axis=1), made.payload.uncertain
    for values in draw(uncertain, 12, bodies=made.payload.bodies):
        drawn = dict(zip(uncertain.names, values.tolist(), strict=True))
        inertia = [drawn[f"inertia_{s}"] for s in ("xx", "xy", "yy", "xz", "yz", "zz")]
        known = {**made.objects[0].model_dump(mode="json", exclude_none=True), "uncertainty": {}}
        true = odd_loads.TrueRows(made.with_changes(objects=[known | {"inertia": inertia, "mass": drawn["mass"]}]))
        for dw in felt(TURNING, 0 * directions(40), directions(40)):
            assert np.all(true.worst({}, w + dw) <= claimed + 1e-9)


def test_what_contents_that_may_be_any_add_is_no_less_than_of_any_that_are() -> None:
    known = {**odd_loads.LOWER, "name": "box", "uncertainty": {}}
    made = odd_loads.scenario(
        [{**known, "inertia": None, "uncertainty": {"com": [0.01, 0.01, 0.01], "contents": "any"}}]
    )
    made = made.with_changes(uncertainty={"shake": BOTH})
    (rows,) = contact_rows(made.payload)
    uncertain, most = made.payload.uncertain, made.payload.uncertain.shake.support
    (still,) = contact_rows(shaking(made.with_changes(objects__0__uncertainty={}), None).payload)
    assert np.all(rows.shaken > 1.02 * most(still.nominal))
    for values in draw(uncertain, 8, bodies=made.payload.bodies):
        drawn = dict(zip(uncertain.names, values.tolist(), strict=True))
        inertia = [drawn[f"inertia_{s}"] for s in ("xx", "xy", "yy", "xz", "yz", "zz")]
        (true,) = contact_rows(made.with_changes(objects=[known | {"inertia": inertia}]).payload)
        assert np.all(most(true.nominal) <= rows.shaken + 1e-12)


@pytest.mark.parametrize("name", ["upright-tall-box", "panda-coffee"])
def test_derivatives_of_a_plans_conditions_are_those_of_their_values(name: str) -> None:
    made = shaking(sv.load_scenario(name), BOTH)
    made = made.with_changes(motion__duration=1.5, motion__orientation="fixed", motion__goal_yaw="fixed", arm=None)
    problem, rng = Problem(made, 11), np.random.default_rng(4)
    programme = ObjectProgramme.of(problem)
    z, d, h = solve(problem).z, rng.standard_normal(problem.size), 1e-6
    path, *sides = (programme.at(Point((z + s * h * d)[:, None], 1.5)) for s in (0, 1, -1))
    for block, up, down in zip(path.blocks, *(side.blocks for side in sides), strict=True):
        if isinstance(block.of, ContactConstraint):
            node, row = (x.ravel() for x in np.indices((len(block.values), min(8, block.values.shape[1]))))
            change = (up.values - down.values)[node, row] / (2 * h)
            slope = programme.derivatives(path, block.having(remembers=np.inf), node, row)[:, :-1] @ d
            wrong = np.abs(slope - change) > 1e-4 * np.abs(change).max()
            assert np.mean(wrong) < 1e-2  # where another case of the liquid becomes the worst


def test_at_rest_friction_bears_a_shake_up_to_what_is_worked_out_by_hand() -> None:
    """A block on a tray that shakes by a stays while a sqrt(1 + mu^2) < mu g, the worst way being across the cone."""
    cube = sv.load_scenario("panda-cube").with_changes(contact__condition="exact", contact__edges=4, **WELL_KNOWN)
    mu = cube.objects[0].friction * np.cos(np.pi / 4)  # of the pyramid inside the cone
    most = 9.81 * mu / np.sqrt(1 + mu**2)
    for share in (0.999, 1.001):
        shake = {"amplitude": share * most / (2 * np.pi * 20.0) ** 2, "frequency": 20.0}
        (rows,) = contact_rows(shaking(cube, shake).payload)
        friction = rows.worst(at_rest()[None])[0, rows.label.astype(bool)].max()
        assert (friction > 0) == (share > 1)


@pytest.mark.parametrize("load", [odd_loads.single, odd_loads.stack])
def test_bounds_and_derivatives_know_of_it(load: Any) -> None:
    made = shaking(load(), BOTH)
    w = odd_loads.felt(odd_loads.tray_motion(5, 10))
    for rows, still in zip(contact_rows(made.payload), contact_rows(load().payload), strict=True):
        exact = rows.worst(w)
        assert_allclose(exact - still.worst(w), np.broadcast_to(rows.shaken, exact.shape), atol=1e-12)
        assert rows.shaken.min() > 0
        assert np.all(WorstCase.of(rows, w, None, coarsely=True).values >= exact - 1e-12)
        node, row = (x.ravel() for x in np.indices(exact.shape))
        slope = WorstCase(rows, w, None, exact).attained(node, row)
        away = w + 1e-6 * np.random.default_rng(0).standard_normal(w.shape)
        change = np.einsum("rk,rk->r", slope, (away - w)[node])
        assert_allclose((rows.worst(away) - exact)[node, row], change, atol=1e-10)
        some = rows.only(np.array([3, 1]))
        assert_allclose(some.worst(w), exact[:, [3, 1]], atol=1e-12)


def test_a_vibration_is_part_of_the_scenarios_digest() -> None:
    made = sv.load_scenario("panda-cube")
    told = shaking(made, SHAKE)
    assert told.model_dump(mode="json")["uncertainty"]["shake"] == {**SHAKE, "tilt_deg": 0.0}
    assert shaking(told, None).digest == made.digest != told.digest


def test_words_name_what_is_counted() -> None:
    assert Vibration(2e-5, 0.0, 20.0).words == "0.02 mm at up to 20 Hz"
    assert Vibration(2e-5, np.deg2rad(0.05), 12.5).words == "0.02 mm and 0.05 deg at up to 12.5 Hz"


# ---- plans, stops, live motions, audits ------------------------------------------------------------------------


@pytest.fixture(scope="module")
def bottle() -> Plan:
    """The fastest motion of a bottle that is known exactly, on a tray that does not shake."""
    return make_plan(TRUE_BOTTLE, "fastest")


@pytest.fixture(scope="module")
def careful() -> Plan:
    return make_plan(shaking(TRUE_BOTTLE, SHAKE), "fastest")


def test_a_plan_leaves_room_for_it_and_says_so(bottle: Plan, careful: Plan) -> None:
    assert bottle.ok
    assert careful.ok
    assert careful.duration > 1.03 * bottle.duration
    assert "There is margin for a tray that shakes by 0.05 mm at up to 15 Hz." in careful.verification.sentence
    assert "shakes" not in bottle.verification.sentence
    assert "vibration of the tray (0.02 mm at up to 20 Hz pushes with 3.2 % of the weight" in bottle.verdict
    assert "vibration" not in careful.verdict
    hasty = replace(bottle, scenario=shaking(bottle.scenario, SHAKE))
    assert not hasty.verification.ok
    assert not hasty.ok


def test_a_plan_in_a_given_time_keeps_more_of_it() -> None:
    made = sv.load_scenario("panda-cube").with_changes(contact__condition="exact", motion__duration=1.4)
    still, shaken = (make_plan(shaking(made, shake), "robust") for shake in (None, SHAKE))
    assert still.verification.ok
    assert shaken.verification.ok
    margins = margin_model(shaken.scenario)
    assert margins.robust[0].shaken.min() > 0
    as_shaken = replace(still, scenario=shaken.scenario)
    assert still.left > as_shaken.left + 0.01
    assert shaken.left >= as_shaken.left - 1e-3


def test_the_papers_condition_refuses_it() -> None:
    with pytest.raises(ScenarioError, match=r"does not support a shaking tray \(uncertainty.shake\)"):
        make_plan(shaking(sv.load_scenario("panda-cube"), SHAKE), "robust")


@pytest.mark.slow
def test_a_stop_takes_longer(bottle: Plan) -> None:
    assert bottle.joint is not None
    q, dq, ddq = (x[0] for x in bottle.joint.sample(0.4 * bottle.duration))
    still, shaken = (
        stop_from(transport_problem(shaking(TRUE_BOTTLE, shake)), AtPosture(q, 0.8 * dq, 0.64 * ddq))
        for shake in (None, SHAKE)
    )
    assert still is not None
    assert shaken is None or shaken.motion.duration > 1.01 * still.motion.duration


def test_a_live_motion_is_refused_that_would_be_shaken_off() -> None:
    most = 9.81 * 0.4 / (2 * np.pi * 15.0) ** 2  # m, at which a block with friction 0.4 begins to slide by itself
    for share, held in ((0.0, True), (0.1, True), (1.1, False)):
        made = shaking(TRUE_BOTTLE, {"amplitude": share * most, "frequency": 15.0})
        problem = transport_problem(made)
        found = verified(problem, resting(problem.start_posture), 0.0, None)
        assert (found.committed is not None) == held, found.sentence
        assert held or found.what.startswith("contact of bottle")


def test_an_audit_counts_it_in_the_worst_case(bottle: Plan) -> None:
    first = bottle.scenario.payload.first
    tray = bottle.reference.sample(np.linspace(0, bottle.duration, 401)).of_frame(*invert(first.p_EB, first.R_EB))
    still, shaken = (Audit(shaking(bottle.scenario, shake), "motion", AuditedMotion(tray)) for shake in (None, SHAKE))
    assert still.ok
    assert shaken.nominal.ok
    assert not shaken.worst.ok
    assert "and of a tray that shakes by 0.05 mm at up to 15 Hz" in shaken.worst.sentence
    lost = still._borne[True].reserve - shaken._borne[True].reserve
    assert lost.min() > 0.5 * SHAKE["amplitude"] * (2 * np.pi * SHAKE["frequency"]) ** 2
    assert_allclose(still._borne[False].reserve, shaken._borne[False].reserve, atol=1e-12)


# ---- the engine -----------------------------------------------------------------------------------------------


def test_what_a_shake_does_is_its_second_derivative() -> None:
    """Of the place, and of the vector by which the tray is turned; and gravity, as a turned tray feels it."""
    made = Shaking.drawn(Vibration(3e-4, 0.002, 17.0), 5)
    assert np.linalg.norm(made.shift) == pytest.approx(3e-4)
    assert np.linalg.norm(made.turn) == pytest.approx(0.002)
    t, h = np.linspace(0.0, 0.2, 23), 1e-4
    a, alpha = made.at(t)

    def place(t: Array, way: Array, phase: float) -> Array:
        return np.sin(2 * np.pi * 17.0 * t + phase)[:, None] * way

    moved, turned = (
        (place(t + h, *x) - 2 * place(t, *x) + place(t - h, *x)) / h**2
        for x in ((made.shift, made.phases[0]), (made.turn, made.phases[1]))
    )
    assert_allclose(alpha, turned, atol=1e-4 * np.abs(alpha).max())
    angle = place(t, made.turn, made.phases[1])
    # The specific force -g in a tray that is turned by R is R^T (a - g): to first order -g + angle x g + a.
    leaning = np.array([odd_loads.rotation(x).T @ -GRAVITY_S for x in angle]) + GRAVITY_S
    assert_allclose(a, moved + leaning, atol=1e-4 * np.abs(a).max())
    assert not np.allclose(made.shift, Shaking.drawn(Vibration(3e-4, 0.002, 17.0), 6).shift)


@pytest.mark.parametrize("name", ["stack", "coffee"])
def test_it_pushes_as_a_tray_that_accelerates_so(name: str) -> None:
    """Against the forces of a moving tray, of turned boxes and of what swings in a cup."""
    made = odd_loads.stack() if name == "stack" else sv.load_scenario("panda-coffee")
    made = made.with_changes(arm=None, uncertainty__shake=BOTH)
    scene = build(made, true_world(made), seed=3)
    shake = replace(scene.shaking, turn=30 * scene.shaking.turn)
    data = mujoco.MjData(scene.model)
    scene.place(data)
    mujoco.mj_step1(scene.model, data)
    a, alpha = shake.at(np.array([0.31]))
    zero = np.zeros((1, 3))
    tray = MotionSamples(np.zeros(1), zero, zero, a + GRAVITY_S, np.eye(3)[None], zero, alpha)
    ids = np.array([*scene.object_ids, *scene.point_ids])
    apply(TrayMotion.of(tray), 0, scene.model, data, scene.object_ids, scene.qvel_ids, scene.point_ids)
    expected = data.xfrc_applied[ids].copy()
    data.xfrc_applied[:] = 0
    shake.push(scene.model, data, ids, np.zeros(3), 0.31)
    bodies = len(scene.object_ids)
    assert np.abs(expected[:bodies, 3:]).max() > 1e-4
    assert_allclose(data.xfrc_applied[ids, :3], expected[:, :3], atol=1e-12)
    assert_allclose(data.xfrc_applied[ids[:bodies], 3:], expected[:bodies, 3:], atol=1e-12)


@pytest.mark.parametrize(
    "vibration", [Vibration(4e-4, 0.0, 15.0), Vibration(0.0, 0.012, 15.0)], ids=["shifts", "turns"]
)
def test_a_tray_without_an_arm_shakes_as_one_that_is_moved_so(vibration: Vibration) -> None:
    """A block that slides on a tray which stands still but shakes, and on one whose motion is that shake."""
    cube = sv.load_scenario("panda-cube").with_changes(arm=None, contact__condition="exact", objects__0__friction=0.1)
    cube = cube.with_changes(physics__settle_before=0.0, physics__settle_after=0.0)
    shake = {"amplitude": vibration.amplitude, "tilt_deg": np.rad2deg(vibration.tilt), "frequency": 15.0}
    made, t = Shaking.drawn(vibration, 1), np.linspace(0.0, 0.3, 601)
    begin, lever = np.array(cube.motion.start.position), cube.payload.first.p_EB
    yaw = odd_loads.rotation([0.0, 0.0, 0.7])

    def wave(way: Array, phase: float) -> tuple[Array, Array, Array]:
        """With its rates."""
        at, w = made.rate * t + phase, made.rate
        return tuple(f[:, None] * way for f in (np.sin(at), w * np.cos(at), -(w**2) * np.sin(at)))

    (p, v, a), (angle, omega, alpha) = wave(made.shift, made.phases[0]), wave(made.turn, made.phases[1])
    zero, turns = np.zeros((len(t), 3)), np.array([odd_loads.rotation(x) @ yaw for x in angle])
    r = turns @ lever - lever  # of B from the tray's middle
    x = r + lever
    v, a = v + np.cross(omega, x), a + np.cross(alpha, x) + np.cross(omega, np.cross(omega, x))
    moved = SampledReference(MotionSamples(t, begin + p + r, v, a, turns, omega @ yaw, alpha @ yaw))
    still = SampledReference(MotionSamples(t, zero + begin, zero, zero, np.tile(yaw, (len(t), 1, 1)), zero, zero))
    slips = [
        simulate_tray(still, shaking(cube, shake), seed=1).slip_E,
        simulate_tray(moved, cube).slip_E,
        simulate_tray(still, cube).slip_E,
    ]
    far = [float(np.linalg.norm(slip, axis=-1).max()) for slip in slips]
    assert far[0] > 2e-4
    assert far[2] < 1e-5
    # The velocity of a turn is left out: 6 % here, against 108 % with the axis seen in the wrong frame.
    assert_allclose(slips[0], slips[1], atol=(0.1 if vibration.tilt else 1e-6) * far[0])


def test_the_simulated_robot_and_the_page_that_is_steered_by_hand_shake_too(careful: Plan) -> None:
    robot = SimulatedRobot(careful, Experiment(careful).arm, 0.0, realtime=False)
    world = World(careful.scenario)
    robot.start()
    robot.write(np.zeros(7), Sensed(0.0, np.zeros(7), np.zeros(7)))
    most = SHAKE["amplitude"] * (2 * np.pi * SHAKE["frequency"]) ** 2
    for data, scene in ((robot._data, robot._run.scene), (world.plant.data, world.plant.scene)):
        force = float(np.linalg.norm(data.xfrc_applied[scene.object_ids[0], :3]))
        assert 0.0 < force <= most * scene.model.body_mass[scene.object_ids[0]] * (1 + 1e-9)


@pytest.mark.slow
def test_the_fastest_bottle_is_lost_on_a_tray_that_shakes_and_kept_where_that_was_counted(
    bottle: Plan, careful: Plan
) -> None:
    """0.05 mm at 15 Hz, in four runs. The one that is known exactly slides by 1 mm on a still tray: it spends the last
    of its friction."""
    still, shaken = (Experiment(replace(bottle, scenario=made)) for made in (bottle.scenario, careful.scenario))
    slid, lost, kept = (
        [e.run(seed=seed).summary["objects"][0]["peak_slip"] for seed in range(1, 5)]
        for e in (still, shaken, Experiment(careful))
    )
    assert np.mean(lost) > 2 * np.max(slid)
    assert np.max(kept) < 1e-4
