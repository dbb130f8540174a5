"""What `import salver as sv` offers: it does what the commands do, and says in a sentence what it wants."""

import doctest
import importlib
import pkgutil
import sys
from dataclasses import replace

import numpy as np
import pytest

import salver as sv
from salver.contact_margins import margins
from salver.errors import FileFormatError, SalverError, ScenarioError
from salver.export import write_export
from salver.trajectory import MotionSamples


@pytest.fixture(scope="module")
def plan():
    return sv.plan("panda-cube-1.2s")


@pytest.fixture(scope="module")
def directory(plan, tmp_path_factory):
    return plan.save(tmp_path_factory.mktemp("public") / "run")


def test_what_is_listed_is_what_is_public():
    assert dir(sv) == sorted([*sv.__all__, "__version__"])
    assert all(hasattr(sv, name) for name in dir(sv))


@pytest.mark.slow
@pytest.mark.parametrize("name", sv.__all__)
def test_every_public_name_has_an_example_that_runs(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    found = doctest.DocTestFinder(recurse=False).find(getattr(sv, name), name, globs={"sv": sv})
    assert [one.examples != [] for one in found] == [True]
    assert doctest.DocTestRunner().run(found[0]).failed == 0


@pytest.fixture(scope="module")
def run(plan):
    return sv.simulate(plan, parameters={"mass": 0.27})


@pytest.mark.slow
def test_every_name_is_a_function_after_everything_was_used():
    """A package of the same name would take its place once it is imported."""
    for module in pkgutil.iter_modules(sv.__path__, "salver."):
        importlib.import_module(module.name)
    assert [name for name in sv.__all__ if not callable(getattr(sv, name))] == []


def standing():
    """A plan that needs no planner."""
    return sv.plan("panda-cube", "baseline", arm=False)


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: sv.simulate("panda-cube"), 'simulate wants a plan: sv.simulate(sv.plan("panda-cube"))'),
        (lambda: sv.simulate(None), "simulate wants a plan, as sv.plan makes it; it was given a NoneType."),
        (lambda: sv.simulate(standing(), {"mass": 0.3}), "True values are given as parameters={...}."),
        (lambda: sv.campaign(3), "campaign wants a run directory"),
        (
            lambda: sv.campaign("panda-cube"),
            'such as sv.plan("panda-cube").save(DIRECTORY) gives; it was given "panda-',
        ),
        (lambda: sv.report("panda-cube"), 'report wants a plan: sv.report(sv.plan("panda-cube")); it was given "panda'),
        (lambda: sv.report(3), "report wants a Plan, an Audit or a run directory; it was given a int."),
        (lambda: sv.plan(3), "A int was given for a scenario"),
        (lambda: sv.fastest("panda-cube", speed=3), 'fastest has no option "speed"; it has '),
        (lambda: sv.retime(np.zeros((3, 7))), "A path alone does not say what is carried"),
    ],
)
def test_what_is_wrong_is_one_sentence(call, words):
    with pytest.raises(ScenarioError) as error:
        call()
    assert words in str(error.value)
    assert str(error.value).endswith(".")


@pytest.mark.parametrize("motion", [3, [1, 2], {}, {"t": [0, 1]}, {"t": np.arange(9.0), "x": "far"}])
def test_what_is_no_motion_is_one_sentence(motion):
    with pytest.raises(FileFormatError, match=r"^the (int|list|dict) "):
        sv.audit(motion, "panda-cube")


@pytest.mark.slow
def test_a_plan_is_retimed_as_its_directory_is_and_is_not_audited(plan, directory):
    retimed, same = sv.retime(plan), sv.retime(directory)
    assert retimed.duration == same.duration < plan.duration
    assert np.array_equal(retimed.joint.q, same.joint.q)
    with pytest.raises(ScenarioError, match=r"plan\.margins\.$"):
        sv.audit(plan, "panda-cube")
    with pytest.raises(FileFormatError, match="holds a plan without a joint motion"):
        sv.retime(replace(plan, joint=None))


def test_a_directory_given_for_a_plan_is_told_how_to_load_it(directory):
    with pytest.raises(SalverError, match="load_plan"):
        sv.simulate(str(directory))


def test_an_audit_of_the_exported_motion_finds_the_margin_of_the_plan(plan, directory, tmp_path):
    (path,) = write_export(directory, "csv", tmp_path / "motion.csv", rate=500.0)
    audit = sv.audit(path, plan.scenario)
    assert audit.outcome == "holds"
    assert float(audit.margins.exact.min()) == pytest.approx(float(plan.margins.exact.min()), abs=0.02)
    assert repr(audit).startswith("<Audit panda-cube-1.2s, verdict holds")
    table = audit.to_pandas()
    assert table["margin"].min() == pytest.approx(float(audit.margins.exact.min()))
    assert list(table.filter(like="p_SE").columns) == ["p_SE_x", "p_SE_y", "p_SE_z"]


def test_margins_of_a_motion_at_rest_are_those_of_standing_still(plan):
    """The weight presses, nothing pulls: no friction is needed."""
    zero, eye = np.zeros((3, 3)), np.tile(np.eye(3), (3, 1, 1))
    still = margins(plan.scenario, MotionSamples(np.arange(3.0), zero, zero, zero, eye, zero, zero))
    assert np.allclose(still.interfaces[0].friction_needed, 0, atol=1e-9)


@pytest.mark.slow
def test_fastest_and_retime_give_plans_and_the_path_of_one_is_hardly_quicker_again(plan, directory):
    found = sv.fastest("panda-cube", time_limit=20.0, robust=False)
    assert found.method == "fastest"
    assert found.solver["robust"] is False
    again = sv.retime(found.joint.q, found.scenario, robust=False)
    assert again.duration > 0.97 * found.duration


def test_a_plan_as_tables(plan):
    data, frame = plan.to_xarray(), plan.to_pandas()
    assert data["p_SB"].dims == ("t", "xyz")
    assert np.array_equal(data["quat_SB_wxyz"].sel(wxyz="w"), frame["quat_SB_w"])
    assert np.array_equal(frame.index, plan.t)
    assert np.array_equal(frame[[f"q_panda_joint{k}" for k in range(1, 8)]], plan.arrays()["q"])
    assert frame.attrs["scenario"] == "panda-cube-1.2s"
    pi, theta = data["state_sensitivity"], data["input_sensitivity"]
    assert np.array_equal(pi.sel(state="v_z", parameter="mass"), plan.state_sensitivity[:, 8, 0])
    assert (theta.dims, theta.shape) == (("t", "edge", "parameter"), plan.input_sensitivity.shape)
    assert np.array_equal(frame["input_sensitivity_3_mass"], plan.input_sensitivity[:, 3, 0])


@pytest.mark.slow
def test_a_run_as_tables(run):
    data, frame = run.to_xarray(), run.to_pandas()
    assert data["slip"].sel(object="cube").max().item() == run.slip.max()
    assert data.attrs["true mass"] == 0.27
    assert np.array_equal(frame["p_SB_cube_z"], run.p_SB[:, 0, 2])
    assert np.array_equal(frame["contact_forces_B_3_z"], run.contact_forces_B[:, 3, 2])
    assert len(frame) == len(run.t)


@pytest.mark.slow
def test_a_notebook_shows_the_page_of_a_plan_that_was_never_saved(plan, run, tmp_path):
    shown = sv.report(plan, run)
    assert shown.path is None
    assert "holds" in shown.html
    frame = shown._repr_html_()
    assert frame.startswith('<iframe srcdoc="&lt;!DOCTYPE html&gt;')
    assert 'sandbox="allow-scripts"' in frame
    assert "<script" not in frame
    assert len(repr(shown)) < 60
    written = sv.report(plan, run, path=tmp_path / "page.html")
    assert written.path.read_text() == written.html


@pytest.mark.slow
def test_a_campaign_as_a_table(directory):
    runs = sv.campaign(directory, 3, jobs=1)
    frame = runs.to_pandas()
    assert list(frame["run"]) == [0, 1, 2]
    assert set(frame["stem"]) == {"plan"}


def test_without_pandas_one_sentence_says_how_to_get_it(run, monkeypatch):
    for package in ("pandas", "xarray"):
        monkeypatch.setitem(sys.modules, package, None)
        with pytest.raises(SalverError, match=rf"needs {package}, which is not installed; .*salver\[tables\]"):
            getattr(run, f"to_{package}")()
