"""For all tests: what several files of them share, and what they fill the memory with before the first one runs."""

from __future__ import annotations

import functools
import gc
import shutil
import signal
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
import typer.testing

if TYPE_CHECKING:
    from driver_rig import Rig
    from salver.planning.fastest import TransportProblem
    from salver.planning.plan import Plan
    from salver.scenario import Scenario
    from salver.simulation.record import SimulationRecord

PATIENCE = 20.0  # s of processor time for an everyday test, ten times what the longest takes


@pytest.hookimpl(wrapper=True)
def pytest_runtest_protocol(item: pytest.Item) -> Iterator[None]:
    """An everyday test that searches for ever fails. Processor time: a busy machine ends nothing."""
    if item.get_closest_marker("slow") or threading.current_thread() is not threading.main_thread():
        return (yield)

    def late(*_: object) -> None:
        pytest.fail(f"takes more than {PATIENCE:g} s of processor time")

    before = signal.signal(signal.SIGPROF, late)
    signal.setitimer(signal.ITIMER_PROF, PATIENCE, 0.25 * PATIENCE)  # again, should it be caught
    try:
        return (yield)
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0.0)
        signal.signal(signal.SIGPROF, before)


@pytest.fixture(scope="session")
def cube() -> Scenario:
    """The paper's cube on a Panda."""
    from salver import scenario

    return scenario.load("panda-cube")


@pytest.fixture(scope="session")
def coffee() -> Scenario:
    """An open cup of coffee on a Panda."""
    from salver import scenario

    return scenario.load("panda-coffee")


@pytest.fixture(scope="session")
def bottle() -> Scenario:
    """The tall bottle on a Panda."""
    from salver import scenario

    return scenario.load("panda-tall-bottle")


@pytest.fixture(scope="session")
def rig(tmp_path_factory: pytest.TempPathFactory) -> Rig:
    """A plan of the paper's cube and an arm that follows it, at which faults can be thrown."""
    from driver_rig import Rig

    return Rig(tmp_path_factory.mktemp("rig") / "run")


@pytest.fixture(scope="session")
def safe(tmp_path_factory: pytest.TempPathFactory) -> Rig:
    """The same with stops that keep the load."""
    from driver_rig import Rig

    return Rig(tmp_path_factory.mktemp("safe") / "run", every=0.2)


@pytest.fixture(scope="session")
def fastest() -> Callable[[str], Plan]:
    """The fastest motion of a scenario, by its name: planned once, for full speed only, at which it leaves nothing."""
    from salver import scenario
    from salver.planning.fastest import plan_fastest

    return functools.cache(lambda name: plan_fastest(scenario.load(name).with_changes(motion__speeds="full")))


@pytest.fixture(scope="session")
def bottle_plan(fastest: Callable[[str], Plan]) -> Plan:
    """The fastest motion of the tall bottle, which turns the tray."""
    return fastest("panda-tall-bottle")


@pytest.fixture(scope="session")
def coffee_plan(fastest: Callable[[str], Plan]) -> Plan:
    """The fastest motion of the open cup of coffee."""
    return fastest("panda-coffee")


@pytest.fixture(scope="session")
def baseline() -> Plan:
    """The paper's cube along the straight line, not optimised."""
    from salver import scenario
    from salver.planning.make import make_plan

    return make_plan(scenario.load("panda-cube"), "baseline")


@pytest.fixture(scope="session")
def nominal(baseline: Plan) -> SimulationRecord:
    """What the engine makes of it with the parameters as they are said."""
    from salver.simulation.physics import simulate

    return simulate(baseline)


@pytest.fixture(scope="session")
def cube_plans(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run directory of the paper's cube with the plan and the baseline."""
    from salver import scenario
    from salver.planning.make import make_plan

    folder, case = tmp_path_factory.mktemp("cube") / "plans", scenario.load("panda-cube")
    make_plan(case, "robust").save(folder, "plan")
    make_plan(case, "baseline").save(folder, "baseline")
    return folder


@pytest.fixture(scope="session")
def cube_run(cube_plans: Path) -> Path:
    """The same with a simulation of both motions and a small campaign."""
    from salver.campaigns import run_campaign
    from salver.planning.plan import load_plan
    from salver.simulation.physics import simulate

    folder = cube_plans.parent / "run"
    shutil.copytree(cube_plans, folder)
    for stem in ("plan", "baseline"):
        simulate(load_plan(folder, stem)).save(folder, stem)
    run_campaign(folder, n=6, jobs=1)
    return folder


@pytest.fixture(scope="session")
def arch(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run directory of three objects of which one stands on the others, along the straight line, without an arm."""
    from salver import scenario
    from salver.planning.make import make_plan

    return make_plan(scenario.load("upright-arch"), "baseline").save(tmp_path_factory.mktemp("arch") / "run", "plan")


@pytest.fixture(scope="session")
def behind_a_post() -> TransportProblem:
    """The paper's cube, known exactly, which a post hinders from going straight."""
    from salver import scenario
    from salver.planning.fastest import transport_problem

    post = {"type": "capsule", "position": [0.55, -0.02, 0.35], "radius": 0.03, "length": 0.7}
    changes = {"objects__0__uncertainty": {}, "motion__orientation": "free", "obstacles": [post]}
    changes |= {"surroundings": {"floor": "none"}, "motion__speeds": "full"}
    return transport_problem(scenario.load("panda-cube").with_changes(**changes))


def pytest_configure() -> None:
    """Typer puts the command together again for each call of a test's runner, which takes 20 ms: once is enough.
    While modules are imported nothing is thrown away."""
    gc.disable()
    typer.testing._get_command = functools.cache(typer.testing._get_command)


def pytest_collection_finish() -> None:
    """Half a million objects of libraries stay to the end; looking through them takes 0.4 s, and each run of the driver
    asks for it."""
    gc.freeze()
    gc.enable()
    gc.set_threshold(20_000, 20, 20)
