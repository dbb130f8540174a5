"""What a plan claims, against means that share nothing with the planner: an engine, samples.

Scenarios are drawn at random near the limit of what can be done, as in a search for counterexamples.
"""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from salver.contact_margins import margins
from salver.control.object import Gains
from salver.errors import SalverError, ScenarioError
from salver.geometry import GRAVITY_S, Array
from salver.planning.make import plan_baseline, plan_object
from salver.sampling import draw
from salver.scenario import Scenario, load, parse
from salver.simulation.closed_loop import rollout
from salver.simulation.physics import simulate_tray

CUBE = load("panda-cube").with_changes(arm=None)


# Random scenarios --------------------------------------------------------------------------------------------


def random_object(rng: np.random.Generator, name: str, on: str, at: list[float], friction: float) -> tuple[dict, float]:
    """An object, and the acceleration at which it begins to slide or tip, roughly."""
    side, height = float(rng.uniform(0.03, 0.1)), float(rng.uniform(0.03, 0.2))
    block = {"type": "box", "size": [side, side, 0.5 * height]}
    knob = {"type": "box", "size": [0.6 * side, 0.5 * side, 0.5 * height]}
    shapes = (
        {"type": "box", "size": [side, 1.2 * side, height]},
        {"type": "cylinder", "radius": side / 2, "height": height, "support_points": int(rng.choice([3, 8, 12]))},
        {"type": "prism", "polygon": [[side / 2, 0], [-side / 4, side / 2], [-side / 4, -side / 2]], "height": height},
        {
            "type": "composite",
            "parts": [
                {"shape": block, "position": [0, 0, -0.25 * height], "mass": 0.3},
                {"shape": knob, "position": [0.05 * side, 0, 0.25 * height], "mass": 0.2},
            ],
        },
    )
    uncertainty: dict = {}
    if rng.random() < 0.7:
        uncertainty["mass"] = f"{rng.uniform(5, 40):.0f}%"
    if rng.random() < 0.6:
        uncertainty["com"] = [0.04 * side, 0.03 * side, 0.05 * height]
    if rng.random() < 0.5:
        uncertainty["friction"] = f"{rng.uniform(3, 25):.0f}%"
    if rng.random() < 0.4:
        uncertainty["position"] = [0.003, 0.002]
    made = {
        "name": name,
        "shape": shapes[rng.integers(4)],
        "mass": float(rng.uniform(0.05, 2)),
        "friction": friction,
        "on": on,
        "at": at,
        "yaw_deg": float(rng.choice([0, rng.uniform(-180, 180)])),
        "com": [0.02 * side, 0.0, float(rng.uniform(-0.1, 0.1)) * height],
        "uncertainty": uncertainty,
    }
    return made, 9.81 * min(0.6 * friction, 0.35 * side / height)


def random_scenario(seed: int, condition: str, **changes: object) -> Scenario:
    rng = np.random.default_rng(seed)
    friction = float(rng.uniform(0.15, 0.8))
    first, limit = random_object(rng, "below", "tray", [0.0, 0.0], friction)
    objects = [first]
    if rng.random() < 0.5 and condition == "exact":
        stacked = rng.random() < 0.6
        second, other = random_object(rng, "above", "below" if stacked else "tray", [0.0, 0.0 if stacked else 0.2], 0.5)
        objects.append(second)
        limit = (0.4 if stacked else 1.0) * min(limit, other)
    way = rng.uniform(-0.5, 0.5, 3) * [1, 1, 0.4]
    free, turned = rng.random() < 0.3, rng.random() < 0.3
    motion = {
        "start": {"position": [0, 0, 1]},
        "goal": {"position": (way + np.array([0, 0, 1])).tolist(), "rpy_deg": [0, 0, 60.0 * turned]},
        "duration": float(np.sqrt(5.77 * np.linalg.norm(way) / limit) * rng.uniform(0.8, 1.2)),
        "nodes": 31,
        "orientation": "free" if free else "fixed",
    }
    made = {
        "name": f"random-{seed}",
        "motion": motion,
        "objects": [{"uncertainty": "none"} | item for item in objects],
        "uncertainty": {"set": str(rng.choice(["box", "ellipsoid"])), "tilt_deg": [float(rng.uniform(0, 1)), 0.2]},
        "contact": {"condition": condition, "edges": int(rng.choice([3, 4, 5, 8]))},
        "tray": {"size": [0.8, 0.8]},
        "physics": {"settle_before": 0.05, "settle_after": 0.1},
    }
    return parse(made, "test").with_changes(**changes)


def possible_scenarios(condition: str, first: int, count: int, **changes: object) -> list[Scenario]:
    """The first ones that can exist at all."""
    out: list[Scenario] = []
    for seed in range(first, first + 10 * count):
        try:
            out.append(random_scenario(seed, condition, **changes))
        except SalverError:
            continue
        if len(out) == count:
            break
    assert len(out) == count
    return out


# A plan that is said to hold, in the engine ------------------------------------------------------------------


@pytest.mark.slow
def test_what_is_planned_as_safe_holds_in_the_engine_at_the_worst_and_at_corners() -> None:
    held = 0
    for k, scenario in enumerate(possible_scenarios("exact", 0, 8)):
        plan = plan_object(scenario)
        assert np.isfinite(plan.cost)
        if not plan.ok:
            assert plan.status.sentence.endswith(".")
            continue
        assert plan.margins.verdict(worst=True).ok  # judged with finer pyramids that contain the plan's
        corner = draw(plan.uncertain, 4, k, "corners", scenario.payload.bodies)[k % 4]
        for values in (plan.margins.worst_parameters(), dict(zip(plan.uncertain.names, corner, strict=True))):
            try:
                record = simulate_tray(plan.reference, scenario, values)
            except ScenarioError:  # no such inertia
                continue
            assert record.summary["outcome"] == "holds", (scenario.name, values)
            assert float(record.slip.max()) < 1e-4
            held += 1
    assert held >= 8


def test_an_object_stands_on_the_top_of_what_is_below_it_in_the_engine() -> None:
    """A knob narrower than its base: feet beside it would let the upper object drop by degrees."""
    knob = {
        "type": "composite",
        "parts": [
            {"shape": {"type": "box", "size": [0.08, 0.08, 0.04]}, "position": [0, 0, -0.02], "mass": 0.3},
            {"shape": {"type": "box", "size": [0.03, 0.03, 0.04]}, "position": [0, 0, 0.02], "mass": 0.2},
        ],
    }
    ball = {"type": "cylinder", "radius": 0.03, "height": 0.04}
    ends = {"start": {"position": [0, 0, 1]}, "goal": {"position": [0.1, 0, 1]}, "duration": 1.0}
    objects = [
        {"name": "knob", "shape": knob, "mass": 0.5, "friction": 0.5},
        {"name": "disc", "shape": ball, "mass": 0.2, "friction": 0.5, "on": "knob"},
    ]
    made = parse(
        {
            "name": "knob",
            "motion": ends,
            "objects": [{"uncertainty": "none"} | item for item in objects],
            "contact": {"condition": "exact"},
        },
        "test",
    )
    record = simulate_tray(plan_object(made).reference, made)
    assert record.summary["outcome"] == "holds"
    assert float(record.tip_angle.max()) < 1e-3
    assert_allclose(np.abs(record.contact_points_B[:, :2]).max(), 0.04, atol=1e-9)


# The paper's condition and what its loop does not know -------------------------------------------------------


@pytest.mark.parametrize(
    "changes",
    [
        {"objects__0__uncertainty": {"friction": "70%"}},
        {"uncertainty__tilt_deg": [3.0, 0.0], "objects__0__uncertainty": {}},
        {"uncertainty__tilt_deg": [1.0, 2.0], "motion__orientation": "free", "objects__0__uncertainty": {}},
        {"objects__0__uncertainty": {"position": [0.05, 0.05]}, "motion__goal__rpy_deg": [0.0, 0.0, 170.0]},
    ],
)
def test_the_papers_condition_answers_for_friction_tilt_and_place(changes: dict) -> None:
    """Least Lambda over true parameters, one by one at both ends: the slack is its bound, and attained."""
    scenario = CUBE.with_changes(contact__condition="paper", motion__duration=1.6, **changes)
    plan = plan_baseline(scenario)
    slack = plan.evaluation.slack.min()
    body, least = scenario.payload.first, np.inf
    half = dict(zip(plan.uncertain.names, plan.uncertain.half_range, strict=True))
    mu = body.friction - half.get("friction", 0.0)
    contacts = scenario.with_changes(objects__0__friction=mu, objects__0__uncertainty={}).payload.first.contacts
    distribution = np.linalg.pinv(contacts.grasp_map)
    for signs in np.ndindex(2, 2):
        x, y = (2 * s - 1 for s in signs)
        wrench_B = true_wrench(plan.evaluation.samples, body, half, float(x), float(y))
        least = min(least, float((wrench_B @ distribution.T).min()))
    assert slack == pytest.approx(least, abs=0.03 * 0.1755)


def true_wrench(samples, body, half: dict[str, float], x: float, y: float) -> Array:
    """(T, 6) Newton's and Euler's wrench at B of an object displaced on a tilted tray."""
    from salver.geometry import exp, invert

    tray = samples.of_frame(*invert(body.p_EB, body.R_EB))
    tilted = tray.of_frame(np.zeros(3), exp(np.array([x * half.get("tilt_x", 0), y * half.get("tilt_y", 0), 0])))
    place = body.p_EB + np.array([x * half.get("position_x", 0), y * half.get("position_y", 0), 0])
    motion = tilted.of_frame(place, body.R_EB)
    inertia, omega = body.inertial.inertia_com, motion.omega_B
    force = body.inertial.mass * np.einsum("tji,tj->ti", motion.R_SB, motion.a_S - GRAVITY_S)
    torque = motion.alpha_B @ inertia + np.cross(omega, omega @ inertia)
    return np.hstack([force, torque])


@pytest.mark.parametrize("condition", ["exact", "paper"])
def test_a_place_beside_the_tray_is_refused(condition: str) -> None:
    scenario = CUBE.with_changes(contact__condition=condition, objects__0__uncertainty={"position": [0.15, 0.0]})
    with pytest.raises(ScenarioError, match="may stand beside its support"):
        plan_object(scenario)


@pytest.mark.parametrize("edges", [3, 5, 6, 7])
def test_margins_judge_with_pyramids_that_contain_those_of_the_plan(edges: int) -> None:
    scenario = CUBE.with_changes(contact__condition="exact", contact__edges=edges, motion__duration=1.0)
    plan = plan_baseline(scenario)
    own = margins(scenario, plan.evaluation.samples, edges=edges).exact
    assert np.all(plan.margins.exact >= own - 1e-12)


def test_contacts_with_too_many_facets_are_refused() -> None:
    round_base = {"type": "cylinder", "radius": 0.03, "height": 0.06, "support_points": 64}
    objects = [{"name": "can", "shape": round_base, "mass": 0.2, "friction": 0.5}]
    with pytest.raises(ScenarioError, match=r"can has 64 contact points with contact\.edges = 32"):
        plan_object(CUBE.with_changes(contact__condition="exact", contact__edges=32, objects=objects))


# Numbers at their ends ---------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("condition", ["exact", "paper"])
@pytest.mark.parametrize(
    "changes",
    [
        {"motion__degree": 30},
        {"motion__degree": 5, "motion__orientation": "free"},
        {"motion__duration": 120.0},
        {"motion__duration": 0.05},
        {"motion__goal": {"position": list(CUBE.motion.start.position)}, "motion__orientation": "free"},
        {"control__kp": [1e4, 1e4], "control__kd": [20.0, 20.0]},
        {"control__kp": [1.0, 1.0], "control__kd": [2.0, 2.0]},  # critically damped, all poles equal
        {"objects__0__shape": {"type": "box", "size": [0.01] * 3}, "objects__0__mass": 1e-3},
        {"objects__0__shape": {"type": "box", "size": [1.0] * 3}, "objects__0__mass": 50.0, "tray__size": [1.0, 1.0]},
        {"contact__edges": 32},
        {"contact__edges": 3},
    ],
)
def test_ends_of_what_may_be_asked_give_a_plan_or_a_sentence(condition: str, changes: dict) -> None:
    plan = plan_object(CUBE.with_changes(contact__condition=condition, objects__0__inertia=None, **changes))
    assert np.isfinite(plan.cost)
    assert np.isfinite(plan.verification.slack)
    assert plan.verification.boundary_error < 1e-9
    if plan.ok:
        assert plan.margins.exact_worst.min() > 0
    else:
        assert plan.status.code == "infeasible"
        assert plan.status.sentence.startswith(("No reference of this degree", "No safe reference"))


# The tube of the closed loop ---------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["fixed", "free"])
@pytest.mark.slow
def test_full_rollouts_leave_the_tube_by_no_more_than_second_order(kind: str) -> None:
    """Both ends of the range of mass: with half the range, what leaves the tube falls to a quarter."""
    excess = []
    for share in (0.05, 0.1):
        scenario = CUBE.with_changes(
            motion__orientation=kind, motion__duration=1.2, objects__0__uncertainty={"mass": 0.25 * share}
        )
        plan, body = plan_object(scenario), scenario.payload.first
        true = np.tile(body.inertial.phi, (2, 1))
        true[:, 0] += [-0.25 * share, 0.25 * share]
        gains = Gains(scenario.control.kp, scenario.control.kd)
        made = rollout(plan.reference, body.inertial, body.contacts.grasp_map, gains, true, plan.t)
        beyond = np.abs(made.cone_coefficients - plan.cone_coefficients) - plan.cone_radius
        excess.append(float(beyond.max() / plan.cone_radius.max()))
    assert excess[1] < 0.1
    assert excess[0] < 0.65 * excess[1]  # a share of the radius, which itself halves
