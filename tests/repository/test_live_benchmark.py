"""The benchmark of live motions: what is written is not made again, and only what hit is searched for a way out."""

import sys
from argparse import Namespace
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parents[2] / "benchmarks"))

import live
from lines import write

HIT = {"what": "ball", "would": True, "hit": 0.4, "announced": 0.003, "look": 1.0, "load": 0.5, "cores": 2}


@pytest.fixture
def asked(tmp_path):
    return Namespace(path=tmp_path / "live.jsonl", n=12, liquids=None, engine=1)


def told(asked, kind, number, **found):
    write(asked.path, {"name": "ur3-cup", "kind": kind, "number": number} | found)


def test_runs_whose_lines_are_there_are_not_made_again(asked):
    every = {(name, *numbers) for *_, name, _, numbers in live.missing(asked, "faults", 0.0)}
    told(asked, "faults", 7, worst=-1.0)
    left = {(name, *numbers) for *_, name, _, numbers in live.missing(asked, "faults", 0.0)}
    assert len(every) == 12 * len(live.LOADS)
    assert every - left == {("ur3-cup", 7)}


def test_a_session_with_obstacles_goes_on_where_it_was_cut(asked):
    for number in range(6):
        told(asked, "obstacles", number, **HIT)
    sessions = [numbers for *_, name, _, numbers in live.missing(asked, "obstacles", 0.0) if name == "ur3-cup"]
    assert sessions == [[6, 7, 8, 9, 10], [11]]


def test_a_way_out_is_searched_only_where_something_hit(asked):
    told(asked, "obstacles", 0, **HIT)
    told(asked, "obstacles", 1, **HIT | {"hit": None})
    told(asked, "obstacles", 2, **HIT | {"would": False})
    told(asked, "virtual", 3, **HIT)
    assert [(kind, numbers) for *_, kind, numbers in live.missing(asked, "ways", 0.0)] == [("ways", [0])]


def test_hits_with_a_way_out_are_counted_among_those_that_were_searched(asked):
    for number in range(4):
        told(asked, "obstacles", number, **HIT)
    told(asked, "ways", 1, way=True)
    told(asked, "ways", 2, way=False)
    told(asked, "obstacles", 4, **HIT | {"hit": None})
    runs = live.gathered(live.read(asked.path))["live-obstacles"]
    assert "| 1 of 2 |" in live.told_of("live-obstacles", runs)
