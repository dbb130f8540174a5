"""The page's distributions over perturbed runs."""

from types import SimpleNamespace
from typing import Any

import numpy as np

from salver.reports.pages.perturbed_runs import MEASURES, _distribution


def test_runs_without_a_value_count_as_runs() -> None:
    """One of four runs could not be made: in three of four the slip was no larger than the largest."""
    slips = {"stem": np.array(["plan"] * 4 + ["baseline"]), "peak_slip": np.array([3e-3, np.nan, 1e-3, 2e-3, 9e-3])}
    motions = [SimpleNamespace(stem=stem, label=stem) for stem in ("plan", "baseline")]
    run: Any = SimpleNamespace(runs=slips, motions=motions)
    spec = _distribution(run, *MEASURES[0])
    assert spec is not None
    assert spec["series"][0]["x"] == [1.0, 2.0, 3.0]
    assert spec["series"][0]["y"] == [25.0, 50.0, 75.0]
    assert spec["series"][1]["y"] == [100.0]
