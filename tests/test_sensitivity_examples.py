"""The examples that are not about trays: sensitivities by differences, tubes by Monte Carlo."""

import importlib
import re
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

pytestmark = pytest.mark.slow
EXAMPLES = Path(__file__).parent.parent / "examples"
MAKERS = {"unicycle": "unicycle", "quadrotor": "quadrotor"}


@pytest.fixture(autouse=True)
def _examples_on_path(monkeypatch):
    monkeypatch.syspath_prepend(str(EXAMPLES))


@pytest.fixture(scope="module", params=MAKERS)
def case(request):
    sys.path.insert(0, str(EXAMPLES))
    module, checker = importlib.import_module(request.param), importlib.import_module("tube_check")
    sys.path.remove(str(EXAMPLES))
    example = getattr(module, MAKERS[request.param])()
    narrow = replace(example.uncertain, half_range=example.uncertain.half_range / 2)
    return [checker.check(e, 12, seed=1) for e in (example, replace(example, uncertain=narrow))]


def test_sensitivities_agree_with_central_differences_of_nonlinear_motions(case):
    wide, _ = case
    assert wide.sensitivity.status.ok
    assert wide.motions.status.ok
    assert wide.difference_error < 1e-6


def test_nominal_motion_is_tracked_exactly(case):
    """The controllers know the reference's derivatives, so with p = p_n there is no error to integrate."""
    wide, _ = case
    integrals = wide.sensitivity.xi[:, -2:]
    assert np.abs(integrals).max() < 1e-7


def test_tubes_hold_all_motions_but_for_a_second_order_excess(case):
    wide, narrow = case
    assert wide.coverage.relative.max() < 0.2
    assert narrow.coverage.relative.max() < 0.1
    # Falls fourfold with half the range; relative to the radius, twofold.
    np.testing.assert_allclose(wide.coverage.excess.max(axis=0) / narrow.coverage.excess.max(axis=0), 4, rtol=0.25)


def test_tubes_are_not_wider_than_needed(case):
    """The corners of the box reach the tube of every quantity to within a tenth."""
    wide, _ = case
    reached = np.abs(wide.samples - wide.nominal).max(axis=(0, 1)) / wide.radius.max(axis=0)
    assert reached.min() > 0.9


@pytest.mark.parametrize("name", MAKERS)
def test_integral_action_is_part_of_the_sensitivity(name, monkeypatch):
    """Without it the same loop reacts differently: the controller's own state is in Theta."""
    module = importlib.import_module(name)
    from salver.sensitivity.engine import sensitivity

    with_it = getattr(module, MAKERS[name])()
    monkeypatch.setattr(module, "KI", 0.0)
    without = getattr(module, MAKERS[name])()

    def final_radius(example):
        result = sensitivity(example.loop, example.uncertain.nominal, example.t[[0, -1]], example.x0, example.xi0)
        return np.abs(result.state_sensitivity[-1, :2]) @ example.uncertain.half_range

    assert final_radius(with_it).max() < 0.8 * final_radius(without).max()


@pytest.mark.parametrize("name", MAKERS)
def test_script_prints_its_table_and_writes_its_figure(name, monkeypatch, capsys, tmp_path):
    module = importlib.import_module(name)
    figure = tmp_path / "tubes.png"
    monkeypatch.setattr(sys, "argv", [name, "--samples", "4", "--plot", str(figure)])
    module.main()
    printed = capsys.readouterr().out
    assert "worst excess" in printed
    assert printed.count("/4 ") == len(module.STATES) + len(module.INPUTS)
    assert float(re.search(r"differ from Pi and Theta by (\S+) of a tube", printed)[1]) < 1e-6
    assert figure.stat().st_size > 10_000
