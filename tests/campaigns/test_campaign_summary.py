"""What is said of finished runs: tubes left, the worst run, counts and pairs, figures of several objects."""

from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from salver import scenario as scenarios
from salver.campaigns.runners import round_scalars, run_scalars
from salver.campaigns.summary import read_table, summarise, table, write_table
from salver.errors import FileFormatError
from salver.reports.run import _column
from salver.simulation.closed_loop import tube_scalars


class _FlatPlan:
    """A plan whose tube is known by hand: nominal 1 N and 2 N, radius 0.1 N and 0.2 N, for a second."""

    scenario = scenarios.load("panda-cube").with_changes(control__kd=[25, 20])  # start-up over at 8 / 20 s
    t = np.linspace(0, 1, 11)
    cone_coefficients = np.tile([1.0, 2.0], (11, 1))
    cone_radius = np.tile([0.1, 0.2], (11, 1))


def test_the_excess_over_the_tube_is_measured_where_the_motion_is():
    t = np.array([-0.1, 0.0, 0.25, 0.5, 1.0, 1.2])
    coefficients = np.tile([1.0, 2.0], (6, 1))
    coefficients[0] = coefficients[-1] = 50.0  # before and after the motion: of no concern
    coefficients[2, 0] = 0.75  # 0.25 below nominal, radius 0.1
    coefficients[3, 1] = 2.15  # inside
    found = tube_scalars(_FlatPlan(), t, coefficients)
    assert found["tube_excess"] == pytest.approx(0.15)
    assert found["tube_excess_relative"] == pytest.approx(0.15 / 0.2)
    assert found["tube_excess_time"] == 0.25
    assert found["tube_excess_settled"] == pytest.approx(-0.05 / 0.2)  # 0.15 N off, radius 0.2
    assert found["cone_least"] == 0.75
    assert tube_scalars(_FlatPlan(), t[:1], coefficients[:1]) == {}
    coefficients[2, 0] = np.nan  # a run that broke off
    assert tube_scalars(_FlatPlan(), t, coefficients) == {}


def record(stem, run, outcome, slip):
    return {
        "stem": stem,
        "run": run,
        "outcome": outcome,
        "parameters": {"mass": 1.0 + run},
        "scalars": {"peak_slip": slip},
    }


@pytest.mark.parametrize(
    ("outcome", "slip", "least", "worse"),
    [
        ("slides", 1e-3, 0.1, True),  # the word counts first
        ("holds", 2e-3, 0.9, False),
        ("limit", 2e-3, 0.2, True),  # then the slip
        ("limit", 1e-3, 0.0, False),
        ("limit", 1.5e-3, 0.05, True),  # then the least cone coefficient
        ("limit", 1.5e-3, 0.2, False),
        ("limit", 1.5e-3, 0.1, False),  # then the earlier run
        ("limit", None, None, False),  # without figures: nothing is known to be worse
        ("exploded", None, None, True),  # a word that nobody knows is the worst
    ],
)
def test_the_worst_run_by_word_then_slip_then_coefficient_then_number(outcome, slip, least, worse):
    rows = [
        {"stem": "plan", "run": 0, "outcome": "limit", "peak_slip": 1.5e-3, "cone_least": 0.1},
        {"stem": "plan", "run": 1, "outcome": outcome, "peak_slip": slip, "cone_least": least},
    ]
    for given in (rows, rows[::-1]):
        assert summarise(given, ["plan"], Path("x"))["plans"]["plan"]["worst_run"]["run"] == int(worse)


def test_words_from_harmless_to_worst():
    """Each must be worse than the one before: an arm beyond its limits, then what the load does, then no result."""
    words = ["holds", "limit", "slides", "lifts", "tips", "lost", "error"]
    for better, worse in pairwise(words):
        rows = [{"stem": "p", "run": k, "outcome": word} for k, word in enumerate([worse, better])]
        assert summarise(rows, ["p"], Path("x"))["plans"]["p"]["worst_run"]["outcome"] == worse
    rows = [{"stem": "p", "run": k, "outcome": word} for k, word in enumerate(reversed(words))]
    assert list(summarise(rows, ["p"], Path("x"))["plans"]["p"]["outcomes"]) == words


def test_summary_of_known_runs(tmp_path):
    # plan slides once, baseline slides in three others: discordant 3 to 1 of four, p = 2 (1 + 4) / 16.
    slides = {"plan": {3}, "baseline": {0, 1, 2}}
    records = {
        (stem, run): record(stem, run, "slides" if run in slides[stem] else "holds", 1e-3 * run)
        for stem in slides
        for run in range(10)
    }
    rows = table(records, ["plan", "baseline"])
    summary = summarise(rows, ["plan", "baseline"], Path("out/x"))
    assert summary["plans"]["plan"]["outcomes"]["holds"]["count"] == 9
    assert summary["plans"]["baseline"]["outcomes"]["slides"]["low"] == pytest.approx(0.0667, abs=1e-4)
    assert summary["paired"][0]["holds"]["p_value"] == pytest.approx(10 / 16)
    # Worst is the worst outcome, then the largest slip: run 3 slid, run 9 held with a larger number.
    assert summary["plans"]["plan"]["worst_run"]["run"] == 3
    assert summary["plans"]["baseline"]["worst_run"]["replay"] == "salver simulate out/x --plan baseline --run 2"
    assert summary["plans"]["plan"]["quantiles"]["peak_slip"]["max"] == pytest.approx(9e-3)
    write_table(tmp_path / "runs.parquet", rows)
    assert read_table(tmp_path / "runs.parquet")["mass"][:3] == [1.0, 1.0, 2.0]


def test_two_plans_are_compared_on_the_runs_that_both_have(tmp_path):
    """Of six and four runs those with the numbers 2 and 3: one holds with one plan and slides with the other."""
    outcomes = {
        "plan": dict.fromkeys(range(6), "holds"),
        "baseline": {2: "slides", 3: "holds", 8: "slides", 9: "slides"},
    }
    records = {
        (stem, run): record(stem, run, outcome, 1e-3 * run * (1 if stem == "plan" else 3))
        for stem, runs in outcomes.items()
        for run, outcome in runs.items()
    }
    paired = summarise(table(records, ["plan", "baseline"]), ["plan", "baseline"], tmp_path)["paired"][0]
    assert (paired["holds"]["only_first"], paired["holds"]["only_second"]) == (1, 0)


def test_runs_that_leave_the_tube_by_over_a_hundredth_are_counted(tmp_path):
    """First order misses up to that; the farthest run is named, and one of which nothing is known does not count."""
    excess = [-0.2, 0.009, 0.011, 0.3, 0.05, None]
    rows = [
        {"stem": "plan", "run": k, "outcome": "holds", "tube_excess_relative": x, "tube_excess": x and 2 * x}
        for k, x in enumerate(excess)
    ]
    tube = summarise(rows, ["plan"], tmp_path)["plans"]["plan"]["tube"]
    assert (tube["left"]["count"], tube["left"]["of"]) == (3, 5)
    assert (tube["worst_run"], tube["worst_excess_relative"], tube["worst_excess"]) == (3, 0.3, 0.6)
    assert tube["tolerance_relative"] == 0.01


def test_figures_of_several_objects_are_told_apart():
    objects = [
        {"name": "a", "outcome": "holds", "peak_slip": 1e-4},
        {"name": "b", "outcome": "slides", "peak_slip": 2e-3},
    ]
    flat = run_scalars({"outcome": "slides", "objects": objects, "wall_time": 3.0, "provenance": {}})
    assert flat == {
        "outcome": "slides",
        "a.outcome": "holds",
        "a.peak_slip": 1e-4,
        "b.outcome": "slides",
        "b.peak_slip": 2e-3,
        "peak_slip": 2e-3,
    }
    one = run_scalars({"outcome": "holds", "objects": objects[:1]})
    assert one == {"outcome": "holds", "peak_slip": 1e-4}


def test_of_a_cup_beside_a_box_only_the_cup_has_a_wave():
    """Whichever is named first, and on whichever leg it is."""
    wet, dry = {"name": "cup", "peak_slip": 1e-4, "peak_wave": 0.012}, {"name": "box", "peak_slip": 2e-4}
    for objects in ([wet, dry], [dry, wet]):
        flat = run_scalars({"outcome": "holds", "objects": objects})
        assert (flat["peak_slip"], flat["peak_wave"], flat["cup.peak_wave"]) == (2e-4, 0.012, 0.012)
    legs = [SimpleNamespace(summary={"outcome": "holds", "objects": objects}) for objects in ([dry], [wet, dry])]
    for order in (legs, legs[::-1]):
        flat = round_scalars(SimpleNamespace(legs=order, outcome="holds", summary={"leg": 1}))
        assert (flat["peak_slip"], flat["peak_wave"]) == (2e-4, 0.012)


def test_figures_of_a_run_of_several_legs_are_the_worst_of_them_and_say_which_leg():
    legs = [
        {"outcome": "holds", "objects": [{"name": "mug", "peak_slip": 2e-4, "peak_tip": 0.3}]},
        {"outcome": "slides", "objects": [{"name": "mug", "peak_slip": 4e-3, "peak_tip": 0.1}]},
    ]
    record = SimpleNamespace(
        legs=[SimpleNamespace(summary=leg) for leg in legs], outcome="slides", summary={"leg": np.int64(2)}
    )
    assert round_scalars(record) == {
        "outcome": "slides",
        "leg": 2,
        "peak_slip": 4e-3,
        "peak_tip": 0.3,
        "leg1.outcome": "holds",
        "leg1.peak_slip": 2e-4,
        "leg2.outcome": "slides",
        "leg2.peak_slip": 4e-3,
    }


@pytest.mark.slow
def test_a_table_is_what_another_reader_of_parquet_reads(tmp_path):
    """Every kind of value, what is missing, what is mixed, numbers to the last bit; and the other way round."""
    parquet, pyarrow = pytest.importorskip("pyarrow.parquet"), pytest.importorskip("pyarrow")
    path = tmp_path / "runs.parquet"
    rows = [
        {"stem": "plan", "run": 0, "sliced": True, "slip": 0.1 + 0.2, "mixed": 1, "never": None, "said": None},
        {"stem": "Brücke", "run": 1, "sliced": None, "slip": None, "mixed": 2.5, "never": None, "said": "tips"},
        {"stem": "plan", "run": 2**40, "sliced": False, "slip": float("inf"), "mixed": None, "never": None},
    ]
    digest = write_table(path, rows)
    expected = {name: [row.get(name) for row in rows] for name in rows[0]}
    assert read_table(path) == expected == parquet.read_table(path).to_pydict()
    types = [type(value) for value in parquet.read_table(path).to_pydict()["mixed"]]
    assert types == [float, float, type(None)]
    assert write_table(tmp_path / "again.parquet", rows) == digest
    parquet.write_table(pyarrow.table(expected), path, compression="zstd")  # as salver wrote them once
    assert read_table(path) == expected


@pytest.mark.parametrize("content", [b"", b"PAR1", b"stem,run\nplan,0\n", b"PAR1" + bytes(40)])
def test_what_is_no_table_is_refused(tmp_path, content):
    (tmp_path / "runs.parquet").write_bytes(content)
    with pytest.raises(FileFormatError, match=r"runs\.parquet is not a Parquet file, or is truncated\."):
        read_table(tmp_path / "runs.parquet")


def test_numbers_that_are_missing_are_no_numbers_to_a_report():
    """As in any table of numbers; words and truths that are missing stay so."""
    slips = _column([1e-3, None, 2])
    assert slips.dtype == float
    np.testing.assert_array_equal(slips, [1e-3, np.nan, 2.0])
    assert np.all(np.isnan(_column([None, None])))
    assert _column([True, None]).tolist() == [True, None]
    assert _column(["tips", None]).tolist() == ["tips", None]
    assert _column([3, 4]).dtype.kind == "i"
