"""`plot` of plans, runs and margins draws their own values over time, with units in its labels."""

import matplotlib

matplotlib.use("Agg")

import numpy as np
import pytest
from matplotlib.figure import Figure

import salver as sv
from salver.errors import SalverError


@pytest.fixture(scope="module")
def plan():
    return sv.plan("panda-cube-1.2s")


def drawn(axes):
    """Label of the axes to the values of its named curves."""
    return {one.get_ylabel(): {line.get_label(): line.get_ydata() for line in one.lines[:-1]} for one in axes}


def test_margins_are_drawn_on_axes_that_are_given(plan):
    margins, own = plan.margins, Figure().subplots()
    assert margins.plot(own) == [own]
    assert own.get_xlabel() == "time, s"
    curves = drawn([own])["contact margin,\n% of the weight"]
    assert np.array_equal(curves["nominal"], 100 * margins.exact)
    assert np.array_equal(curves["worst case"], 100 * margins.exact_worst)
    assert np.array_equal(own.lines[0].get_xdata(), margins.t)
    with pytest.raises(SalverError, match=r"^plot was given 2 axes; it needs 1: contact margin"):
        margins.plot(Figure().subplots(2))


def test_a_plan_is_drawn_with_its_joints_and_its_margins(plan):
    axes = plan.plot()
    curves, t = drawn(axes), axes[0].lines[0].get_xdata()
    p, dq = plan.reference.sample(t).p_SB, plan.joint.sample(t)[1]
    assert np.allclose(curves["way, m"]["y"], p[:, 1] - p[0, 1], atol=1e-12)
    assert np.allclose(curves["joint velocity,\nrad/s or m/s"]["panda_joint4"], dq[:, 3])
    assert np.array_equal(curves["contact margin,\n% of the weight"]["worst case"], 100 * plan.margins.exact_worst)
    assert len(sv.plan("panda-cube", "baseline", arm=False).plot()) == len(axes) - 1


@pytest.mark.slow
def test_a_run_is_drawn_with_what_its_objects_did(plan):
    run = sv.simulate(plan, parameters={"mass": 0.27})
    curves = drawn(run.plot())
    assert np.array_equal(curves["slip, mm"]["cube"], 1e3 * run.slip[:, 0])
    assert np.array_equal(curves["tip angle, deg"]["cube"], np.degrees(run.tip_angle[:, 0]))
    assert np.array_equal(curves["off its reference,\nmm"]["cube"], 1e3 * run.e_p)
