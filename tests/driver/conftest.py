"""For the tests of robots that are driven over the wire, each against a controller that speaks its protocol.

Their files say `ROBOT`, a name of `wire.CASES`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

import wire
from salver.driver import execute
from salver.driver.preflight import Check, check_plan
from salver.planning.plan import Plan, load_plan


@pytest.fixture(scope="module")
def directory(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return wire.planned(request.module.ROBOT, tmp_path_factory.mktemp(request.module.ROBOT))


@pytest.fixture(scope="module")
def plan(directory: Path) -> Plan:
    return load_plan(directory)


@pytest.fixture(scope="module")
def checks(plan: Plan) -> list[Check]:
    return check_plan(plan, plan.scenario.load_arm(), plan.scenario.payload.bodies)


@pytest.fixture
def controller(
    request: pytest.FixtureRequest, plan: Plan, checks: list[Check], monkeypatch: pytest.MonkeyPatch
) -> Iterator[Callable[..., Any]]:
    """Makes one, of a robot whose plan was checked already."""
    monkeypatch.setattr(execute, "check_plan", lambda *args: list(checks))
    made: list[Any] = []

    def make(**options: Any) -> Any:
        options = {"q": plan.joint.q[0]} | options  # type: ignore[union-attr]
        made.append(wire.controller(request.module.ROBOT, **options))
        for owner, name, port in wire.ports(request.module.ROBOT, made[-1]):
            monkeypatch.setattr(owner, name, port)
        return made[-1]

    yield make
    for each in made:
        each.close()
        assert each.failed is None
