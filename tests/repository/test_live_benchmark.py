"""The benchmark of live motions: what is written is not made again, and only what hit is searched for a way out."""

import sys
from argparse import Namespace
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parents[2] / "benchmarks"))

import live
from lines import write
from live_obstacles import read_situation, way_out, write_situation
from salver.live import Live, Moving
from salver.live.replanning.obstacles import predicted

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


def test_a_kept_situation_is_that_of_the_encounter(tmp_path):
    """A ball that flies away from the arm, which is on its way; the search that reads it finds a way out."""
    live = Live("ur3-cup")
    live.command(0.0)
    body = live.problem.items[0]
    p, _ = live.problem.arm.object_pose(live.committed.motion.q[0], body.p_EB, body.R_EB)
    assert live.goto(p + np.array([0.0, 0.1, 0.05])).ok
    live.plan(60.0)
    for k in range(400):
        live.command(1e-3 * k)
    base, now = live.committed, live.now
    assert now < base.ends
    ball = Moving("ball", "sphere", p + np.array([0.4, 0.1, 0.3]), [1.0, 0.0, 0.0], radius=0.05)
    write_situation(tmp_path / "seen.npz", (base, now, ball))
    again, when, seen = read_situation(tmp_path / "seen.npz")
    t = now + 0.1
    np.testing.assert_array_equal(again.state(t), base.state(t))
    np.testing.assert_array_equal(again.deviation_at(t, live.problem), base.deviation_at(t, live.problem))
    np.testing.assert_array_equal(predicted(seen, when).at(np.array([t])), predicted(ball, now).at(np.array([t])))
    assert way_out("ur3-cup", tmp_path / "seen.npz")
