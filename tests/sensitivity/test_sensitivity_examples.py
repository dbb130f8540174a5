"""The examples that are not about trays: sensitivities by differences, tubes by Monte Carlo."""

import contextlib
import importlib
import io
import re
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from salver.sensitivity.engine import sensitivity, simulate
from salver.sensitivity.tubes import excess

pytestmark = pytest.mark.slow
EXAMPLES = Path(__file__).parents[2] / "examples"
MAKERS = {"unicycle": "unicycle", "quadrotor": "quadrotor"}


@pytest.fixture(autouse=True)
def _examples_on_path(monkeypatch):
    monkeypatch.syspath_prepend(str(EXAMPLES))


@pytest.fixture(scope="module", params=MAKERS)
def script(request, tmp_path_factory):
    """(module, what it checked, what it printed, its figure): the example run as a script."""
    figure = tmp_path_factory.mktemp("figure") / "tubes.png"
    checked, printed = [], io.StringIO()
    with pytest.MonkeyPatch.context() as patched, contextlib.redirect_stdout(printed):
        patched.syspath_prepend(str(EXAMPLES))
        module = importlib.import_module(request.param)
        check = module.check
        patched.setattr(module, "check", lambda *given: checked.append(check(*given)) or checked[-1])
        patched.setattr(sys, "argv", [request.param, "--samples", "12", "--seed", "1", "--plot", str(figure)])
        module.main()
    return module, checked[0], printed.getvalue(), figure


@pytest.fixture
def wide(script):
    return script[1]


def test_sensitivities_agree_with_central_differences_of_nonlinear_motions(wide):
    assert wide.sensitivity.status.ok
    assert wide.motions.status.ok
    assert wide.difference_error < 1e-6


def test_nominal_motion_is_tracked_exactly(wide):
    """The controllers know the reference's derivatives, so with p = p_n there is no error to integrate."""
    integrals = wide.sensitivity.xi[:, -2:]
    assert np.abs(integrals).max() < 1e-7


def test_tubes_hold_all_motions_but_for_a_second_order_excess(wide):
    """Of half the range the tube is half as wide: reactions are those of the nominal motion, the same for both."""
    example = wide.example
    half = replace(example.uncertain, half_range=example.uncertain.half_range / 2)
    parameters = importlib.import_module("tube_check").scattered(half, 12, seed=1)
    motions = simulate(example.loop, parameters, half.nominal, example.t, example.x0, example.xi0, tolerance=1e-6)
    records = np.concatenate([motions.x, motions.u], axis=2)
    narrow = excess(records, wide.nominal, wide.radius / 2).max(axis=1)
    peak = wide.radius.max(axis=0)
    assert (wide.excess / peak).max() < 0.2
    assert (narrow / (peak / 2)).max() < 0.1
    # Falls fourfold with half the range; relative to the radius, twofold.
    np.testing.assert_allclose(wide.excess.max(axis=0) / narrow.max(axis=0), 4, rtol=0.25)


def test_tubes_are_not_wider_than_needed(wide):
    """The corners of the box reach the tube of every quantity to within a tenth."""
    reached = np.abs(wide.samples - wide.nominal).max(axis=(0, 1)) / wide.radius.max(axis=0)
    assert reached.min() > 0.9


@pytest.mark.parametrize("name", MAKERS)
def test_integral_action_is_part_of_the_sensitivity(name, monkeypatch):
    """Without it the same loop reacts differently: the controller's own state is in Theta."""
    module = importlib.import_module(name)
    with_it = getattr(module, MAKERS[name])()
    monkeypatch.setattr(module, "KI", 0.0)
    without = getattr(module, MAKERS[name])()

    def final_radius(example):
        result = sensitivity(
            example.loop, example.uncertain.nominal, example.t[[0, -1]], example.x0, example.xi0, tolerance=1e-4
        )
        return np.abs(result.state_sensitivity[-1, :2]) @ example.uncertain.half_range

    assert final_radius(with_it).max() < 0.8 * final_radius(without).max()


def test_script_prints_its_table_and_writes_its_figure(script):
    module, _, printed, figure = script
    assert "worst excess" in printed
    assert printed.count("/12 ") == len(module.STATES) + len(module.INPUTS)
    assert float(re.search(r"differ from Pi and Theta by (\S+) of a tube", printed)[1]) < 1e-6
    assert figure.stat().st_size > 10_000
