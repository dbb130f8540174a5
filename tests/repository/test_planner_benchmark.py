"""The benchmark of the paper's plan gives IPOPT the problem that is solved."""

import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parents[2] / "benchmarks"))

import bench_planner
from salver.planning.object.problem import Problem
from salver.planning.object.solvers import solve
from salver.scenario import load


def test_ipopt_finds_the_same_optimum_where_tubes_bind():
    problem = Problem(load("panda-cube").with_changes(motion__duration=1.0), 21)
    run, _ = bench_planner.ipopt(problem)
    assert run() == pytest.approx(solve(problem).cost, rel=1e-6)
