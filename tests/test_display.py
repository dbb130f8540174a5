"""Results say what they are in one line, and in a small table where there is a notebook."""

import re

import pytest

import salver as sv
from salver.campaigns import run_campaign

JOINTS = [f"panda_joint{k}" for k in range(1, 8)]


@pytest.fixture(scope="module")
def shown(tmp_path_factory):
    plan = sv.plan("panda-cube-1.2s")
    directory = plan.save(tmp_path_factory.mktemp("shown"))
    run = sv.simulate(plan, parameters={"mass": 0.28})
    campaign = run_campaign(directory, 2, jobs=1)
    return {"scenario": plan.scenario, "plan": plan, "run": run, "campaign": campaign, "margins": plan.margins}


@pytest.mark.slow
@pytest.mark.parametrize("name", ["scenario", "plan", "run", "campaign", "margins"])
def test_one_line_in_a_console_and_one_table_in_a_notebook(shown, name):
    line, html = repr(shown[name]), shown[name]._repr_html_()
    assert re.fullmatch(r"<[A-Z]\w+ [^\n]{5,280}>", line)
    assert len(re.findall("<tr>", html)) == len(shown[name].facts()) >= 2
    assert len(html) < 4000


@pytest.mark.slow
def test_what_is_shown_is_what_was_found(shown):
    assert repr(shown["plan"]) == "<Plan panda-cube-1.2s, method robust, duration 1.2 s, ok yes>"
    assert shown["run"].facts()["outcome"] == "holds"
    assert shown["run"].facts()["true parameters"] == "mass = 0.28"
    assert shown["campaign"].facts()["plan"] == "holds 2 of 2"


def test_text_from_a_scenario_is_text_in_a_notebook():
    changed = sv.load_scenario("panda-cube").with_changes(summary="<script>alert(1)</script>")
    assert "<script>" not in changed._repr_html_()


@pytest.mark.slow
def test_arrays_show_their_shapes(shown):
    """A motion of a thousand numbers is one line, and so is all that hangs on a plan and an audit."""
    plan = shown["plan"]
    assert re.fullmatch(r"<JointMotion t (\d+), q \1×7, dq \1×7, ddq \1×7>", repr(plan.joint))
    audit = sv.audit({"t": plan.joint.t, **dict(zip(JOINTS, plan.joint.q.T, strict=True))}, plan.scenario)
    held = (plan.chain, plan.scenario.payload, plan.arm_status, audit.joints, audit.motion, shown["run"].motion())
    for thing in held:
        assert len(repr(thing)) < 400
        assert "\n" not in repr(thing)
