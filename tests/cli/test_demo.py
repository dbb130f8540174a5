"""The demo shows what planning for the unknown is worth: one bottle, two motions, one of which drops it."""

import json
import re

import pytest

from salver import scenario
from salver.cli.plans.demo import BOTTLE, experiment
from salver.errors import ScenarioError
from salver.planning.fastest import EFFORTS
from salver.planning.make import plan_pair
from salver.planning.plan import load_plan

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def found(tmp_path_factory):
    directory = tmp_path_factory.mktemp("demo")
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr("salver.campaigns.engine._cores", lambda: 1)  # workers take longer to start than eight runs
        return directory, experiment(BOTTLE, "fastest", "nominal", directory, n=4, seed=0, quiet=True)


def test_the_bottle_stays_when_planned_for_its_ranges_and_falls_when_planned_for_nominal_values(found):
    _, demo = found
    outcomes = {stem: plan["outcomes"] for stem, plan in demo["campaign"]["plans"].items()}
    assert outcomes["plan"]["holds"]["count"] == 4
    assert outcomes["nominal"].get("holds", {"count": 0})["count"] < 2
    assert demo["nominal"]["duration"] < demo["plan"]["duration"]


def test_a_motion_for_nominal_values_is_not_called_safe(found):
    directory, demo = found
    assert demo["plan"]["ok"]
    assert not demo["nominal"]["ok"]
    plan = load_plan(directory, "nominal")
    assert plan.status.code == "unsafe"
    assert "over the uncertain set it is not safe" in plan.status.sentence


def test_the_page_shows_the_same_bottle_with_both_motions(found):
    _, demo = found
    page = demo["page"].read_text(encoding="utf-8")
    data = json.loads(re.search(r'<script[^>]*type="application/json"[^>]*>(.*?)</script>', page, re.S)[1])
    fastest, nominal = data["replay"]["variants"]
    assert (fastest["label"], nominal["label"]) == ("Fastest", "Nominal")
    assert fastest["caption"].endswith("holds")
    assert nominal["caption"].endswith("tips")
    assert fastest["caption"].split(":")[0] == nominal["caption"].split(":")[0]  # the same true parameters


def test_a_plan_of_a_given_duration_and_the_fastest_nominal_one_stand_in_one_directory(tmp_path):
    """Both are judged by one condition, the plan's own."""
    asked = scenario.load("panda-cube").with_changes(motion__duration=1.2)
    plans = plan_pair(asked, beside="nominal", options=EFFORTS["quick"])
    for stem, plan in zip(("plan", "nominal"), plans, strict=True):
        plan.save(tmp_path, stem)
    plan, nominal = (load_plan(tmp_path, stem) for stem in ("plan", "nominal"))
    assert plan.duration == 1.2
    assert 0.6 < nominal.duration < 0.7
    assert nominal.scenario.digest == plan.scenario.digest
    for each in (plan, nominal):
        assert each.status.ok == (each.verification.violation == 0)
        assert each.status.ok or each.verification.sentence in each.status.sentence


def test_the_straight_line_beside_a_fastest_plan_is_judged_as_that_is():
    asked = scenario.load("panda-cube")
    plan, line = plan_pair(asked, "fastest", options=EFFORTS["quick"])
    assert line.duration == plan.duration
    assert line.scenario.contact == plan.scenario.contact
    assert not line.status.ok
    assert line.verification.sentence in line.status.sentence


def test_an_unknown_comparison_is_refused_in_a_sentence():
    with pytest.raises(ScenarioError, match='baseline or nominal, not with "other"'):
        plan_pair(None, beside="other")
