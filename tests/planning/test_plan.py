"""Plans: what they promise, that they keep it between the nodes, and that files bring them back."""

import json
import time
from dataclasses import replace

import numpy as np
import pytest

from salver.errors import FileFormatError, ScenarioError
from salver.planning.make import make_plan, method_of, plan_baseline, plan_object, plan_pair
from salver.planning.object.evaluation import evaluate
from salver.planning.plan import load_plan
from salver.scenario import load, names

PAPER = load("panda-cube")


@pytest.fixture(scope="module")
def plan():
    return plan_object(PAPER)


def test_paper_scenario_is_solved_to_proven_optimality_and_checks_itself(plan):
    assert plan.ok
    assert plan.solver["relative_gap"] < 1e-9
    assert plan.verification.instants == 601
    assert plan.verification.violation == 0
    assert plan.verification.boundary_error < 1e-9


def test_the_time_that_a_plan_took_is_told():
    begun = time.perf_counter()
    seconds = plan_object(PAPER).solver["seconds"]
    assert 0 < seconds <= time.perf_counter() - begun


def test_arrays_have_the_shapes_and_meaning_that_other_tools_rely_on(plan):
    arrays = plan.arrays()
    n = len(arrays["t"])
    shapes = {"p_SB": 3, "v_S": 3, "a_S": 3, "quat_SB_wxyz": 4, "omega_B": 3, "alpha_B": 3, "wrench_B": 6}
    for name, width in shapes.items():
        assert arrays[name].shape == (n, width)
    assert arrays["grasp_map"].shape == (6, 16)
    assert arrays["cone_coefficients"].shape == arrays["cone_radius"].shape == (n, 16)
    assert arrays["state_sensitivity"].shape == (n, 12, 1)
    assert arrays["input_sensitivity"].shape == (n, 16, 1)
    assert list(arrays["parameter_names"]) == ["mass"]
    assert arrays["parameter_half_range"] == pytest.approx([0.0256])
    # Wrench balance: the coefficients give back the wrench, and the wrench is the weight when at rest.
    assert arrays["cone_coefficients"] @ arrays["grasp_map"].T == pytest.approx(arrays["wrench_B"], abs=1e-12)
    assert arrays["wrench_B"][[0, -1]] == pytest.approx(np.array([[0, 0, 0.256 * 9.81, 0, 0, 0]] * 2), abs=1e-9)
    assert arrays["cone_radius"] == pytest.approx(np.abs(arrays["input_sensitivity"][..., 0]) * 0.0256)


@pytest.mark.parametrize("kind", ["box", "ellipsoid"])
def test_the_papers_condition_is_lambda_minus_its_tube(kind):
    many = {"mass": "10%", "com": [0.002] * 3, "inertia": "10%"}
    plan = plan_baseline(PAPER.with_changes(uncertainty__set=kind, objects__0__uncertainty=many))
    assert plan.evaluation.slack == pytest.approx(plan.cone_coefficients - plan.cone_radius, abs=1e-12)


def test_same_scenario_gives_identical_arrays(plan):
    again = plan_object(load("panda-cube")).arrays()
    for name, array in plan.arrays().items():
        assert np.array_equal(array, again[name]), name


def test_finer_grids_converge_to_the_same_sensitivities(plan):
    coarse, fine = evaluate(PAPER, plan.reference, 61), evaluate(PAPER, plan.reference, 601)
    assert coarse.state_sensitivity == pytest.approx(fine.state_sensitivity[::10], abs=1e-8)
    assert coarse.cone_radius == pytest.approx(fine.cone_radius[::10], abs=1e-8)


def test_violation_between_the_nodes_is_found_and_planned_away():
    coarse = PAPER.with_changes(motion__nodes=11, motion__duration=1.0, contact__margin=0)
    plan = plan_object(coarse)
    assert plan.verification.violation == 0
    assert plan.solver["nodes"] > 11


def test_infeasible_plans_say_so_and_are_not_ok():
    plan = plan_object(PAPER.with_changes(motion__duration=0.6))
    assert plan.status.code == "infeasible"
    assert not plan.ok
    assert plan.summary()["ok"] is False


def test_unsafe_baseline_is_reported_as_unsafe():
    baseline = plan_baseline(PAPER.with_changes(motion__duration=1.0))
    assert not baseline.ok
    assert "not safe" in baseline.status.sentence


def test_poses_on_the_way_are_passed_in_their_order_or_not_at_all():
    """A line passes its points at a quarter and at three quarters of it, not the other way round."""
    motion, line = PAPER.motion, plan_baseline(PAPER)
    start, goal = np.array(motion.start.position), np.array(motion.goal.position)

    def judged(*shares):
        poses = [{"position": (start + share * (goal - start)).tolist()} for share in shares]
        return replace(line, scenario=PAPER.with_changes(motion__through=poses)).verification

    assert judged(0.25, 0.75).passes < 1e-9
    assert judged(0.25, 0.75).ok
    assert judged(0.75, 0.25).passes == np.inf
    assert not judged(0.75, 0.25).ok


@pytest.mark.slow
def test_arm_follows_the_plan(tmp_path):
    plan = make_plan(PAPER)
    assert plan.arm_status.ok
    plan.save(tmp_path)
    again = load_plan(tmp_path)
    assert again.tau.shape == (601, 7)
    assert np.array_equal(again.joint.q, plan.joint.q)
    assert again.arrays()["q"].shape == (601, 7)


def test_foreign_and_damaged_run_directories_get_a_sentence(tmp_path, plan):
    with pytest.raises(FileFormatError, match="not a run directory"):
        load_plan(tmp_path)
    plan.save(tmp_path)
    with pytest.raises(ScenarioError, match="another scenario"):
        plan_object(PAPER.with_changes(motion__duration=2.0)).save(tmp_path)
    with pytest.raises(FileFormatError, match=r"a plan of one motion and has no leg2"):
        load_plan(tmp_path, "leg2")
    content = (tmp_path / "plan.npz").read_bytes()
    (tmp_path / "plan.npz").write_bytes(content[: len(content) // 2])
    with pytest.raises(FileFormatError, match=r"plan\.npz"):
        load_plan(tmp_path)
    (tmp_path / "plan.npz").write_bytes(content)
    summary = json.loads((tmp_path / "plan.json").read_text())
    summary["provenance"]["scenario_digest"] = "000000000000"
    (tmp_path / "plan.json").write_text(json.dumps(summary))
    with pytest.raises(FileFormatError, match=r"was edited since .* key provenance"):
        load_plan(tmp_path)


def test_methods_and_durations_that_do_not_exist_get_a_sentence():
    with pytest.raises(ScenarioError, match="robust, baseline, fastest, safest and least-sensitive"):
        make_plan(PAPER, "best")
    with pytest.raises(ScenarioError, match=r"motion\.duration is missing"):
        plan_object(PAPER.with_changes(motion__duration=None))
    for made in (plan_object, plan_baseline):  # each began with the heading of motion.start, without a word
        with pytest.raises(ScenarioError, match='start_yaw = "free" is for motions of an arm'):
            made(PAPER.with_changes(motion__start_yaw="free"))


def test_the_check_tells_of_the_contact_unless_only_the_limit_on_tilt_fails():
    """Slacks in radians and in shares of the weight are not compared with each other."""
    tilting = PAPER.with_changes(contact__condition="exact", motion__orientation="free", motion__max_tilt_deg=1.0)
    kept = plan_baseline(tilting)
    contact = kept.evaluation.slack[:, [owner != "tilt limit" for owner in kept.evaluation.slack_owner]]
    assert np.deg2rad(1.0) < contact.min() == kept.verification.slack
    assert kept.verification.unit == "of the weight"
    leaning = {"position": PAPER.motion.goal.position, "rpy_deg": [2, 0, 0]}
    missed = plan_baseline(tilting.with_changes(motion__max_tilt_deg=90.0, motion__goal=leaning))
    missed = replace(missed, scenario=tilting)
    miss = np.deg2rad(2.0) ** 2 / np.deg2rad(1.0) / 2 - np.deg2rad(1.0) / 2  # the slack is quadratic in the tilt
    assert missed.verification.violation == pytest.approx(miss, rel=1e-3)
    assert missed.verification.sentence.startswith("The limit on tilt is missed by 0.0262 rad")


def test_why_the_arm_does_not_move():
    assert plan_object(PAPER).no_arm_motion == "The plan was made without the arm."
    failed = make_plan(PAPER.with_changes(motion__duration=0.3))
    assert failed.joint is None
    assert failed.no_arm_motion == failed.status.sentence


@pytest.mark.parametrize("tilt", [None, 1.0])
def test_what_is_left_is_of_the_contacts_whatever_else_is_limited(tilt):
    """Of an exact plan the least row of its contact, in shares of the weight; a limit on tilt is in a unit of its
    own."""
    limited = PAPER.with_changes(**({"motion__max_tilt_deg": tilt} if tilt else {}))
    plan = plan_object(limited.with_changes(contact__condition="exact"))
    rows = plan.evaluation.slack[:, [owner.startswith("cube on tray") for owner in plan.evaluation.slack_owner]]
    assert rows.shape[1] >= 8
    assert plan.left == rows.min()


@pytest.mark.parametrize(
    ("changes", "arm", "method"),
    [
        ({}, True, "safest"),
        ({}, False, "robust"),
        ({"arm": None}, True, "robust"),
        ({"motion__duration": None}, True, "fastest"),
        ({"plan__method": "least-sensitive"}, True, "least-sensitive"),
        ({"plan__method": "fastest"}, False, "fastest"),
    ],
)
def test_a_scenario_that_names_no_method_gets_the_safest_in_its_time_or_the_fastest(changes, arm, method):
    assert method_of(load("ur5-bottle").with_changes(**changes), arm) == method


def test_the_scenarios_of_the_paper_name_its_method_and_no_other_does():
    named = {name: load(name).plan.method for name in names()}
    assert {name for name, method in named.items() if method} == {n for n in named if n.startswith("panda-cube")}
    assert {method for method in named.values() if method} == {"robust"}


@pytest.mark.slow
def test_what_is_planned_where_nothing_is_asked_leaves_more_than_the_straight_line_and_than_the_papers():
    case = load("ur10-bottle")
    plan, line = plan_pair(case)
    assert plan.method == "safest"
    assert plan.left > 1.5 * max(line.left, make_plan(case, "robust").left)
