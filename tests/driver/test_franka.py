"""A Franka Research 3 driven through the real pylibfranka, against franky-sim's server of libfranka's protocol."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from salver import scenario
from salver.driver import execute
from salver.driver.live import run_live
from salver.errors import SalverError
from salver.files import load_npz
from salver.models.arm.arm import load_arm
from salver.planning.make import make_plan
from salver.planning.plan import Plan, load_plan
from salver.planning.stops import plan_stops, stop_problem

for needed in ("pylibfranka", "franky_sim"):
    pytest.importorskip(needed, reason=f"{needed} is not installed (pip install --group franka-test)")

SERVER = Path(__file__).parents[1] / "helpers" / "franka_server.py"
CASE = scenario.load("panda-cube").with_changes(arm__model="fr3", arm__start_posture=None)


@pytest.fixture(scope="module")
def directory(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("fr3")
    plan = make_plan(CASE, "fastest")
    assert plan.joint is not None
    replace(plan, stops=plan_stops(stop_problem(plan), plan.joint, 0.1, plan.space)).save(folder)
    return folder


class Arm:
    """The server of a run in a process of its own. address: where it is."""

    def __init__(self, run: Path, record: Path, *given: str) -> None:
        self._record = record
        self._process = subprocess.Popen(
            [sys.executable, str(SERVER), str(run), "--record", str(record), *given],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        assert self._process.stdout is not None
        self.address = self._process.stdout.readline().strip()

    def seen(self) -> dict[str, Any]:
        """What the arm did while it was driven: q, dq, sent (T, 7), and the load's place on the tray p_EB (T, 3)."""
        self.close()
        return dict(np.load(self._record))

    def close(self) -> None:
        self._process.communicate()


Make = Callable[..., Arm]


@pytest.fixture
def arm(directory: Path, tmp_path: Path) -> Iterator[Make]:
    made: list[Arm] = []

    def make(*given: str) -> Arm:
        made.append(Arm(directory, tmp_path / "seen.npz", *given))
        return made[-1]

    yield make
    for each in made:
        each.close()


def run(directory: Path, arm: Arm, **options: Any) -> execute.Execution:
    return execute.run_plan(directory, "franka", arm.address, realtime=False, **options)


def kept_and_within_limits(seen: dict[str, Any], plan: Plan) -> None:
    """The load stayed within 0.3 mm, and torques beyond gravity within the limits of their rate."""
    assert np.abs(seen["p_EB"] - seen["p_EB"][0]).max() < 3e-4
    limits = load_arm(plan.scenario.arm, plan.scenario.tray).limits  # type: ignore[arg-type]
    rates = np.diff(seen["sent"], axis=0) / 1e-3
    assert np.all(np.abs(rates) <= limits.torque_rate)
    assert np.all(np.abs(seen["sent"]) <= limits.torque)


@pytest.mark.slow
@pytest.mark.parametrize("away", [0.0, 0.05])
def test_an_arm_follows_the_plan_with_its_load(directory: Path, arm: Make, away: float) -> None:
    """From its start, or from beside it, where it is taken first."""
    robot, plan = arm("--away", str(away)), load_plan(directory)
    if away:
        with pytest.raises(SalverError, match="--move-to-start"):
            run(directory, robot)
    result = run(directory, robot, move_to_start=bool(away))
    assert result.achieved
    assert result.summary["joint_error_peak"] < 2e-3
    assert result.summary["timing"]["missed"] < 20  # until the arm waits for its first command
    seen = robot.seen()
    kept_and_within_limits(seen, plan)
    assert np.abs(seen["q"][0] - plan.joint.q[0]).max() < 1e-4  # type: ignore[union-attr]
    assert np.abs(seen["q"][-1] - plan.joint.q[-1]).max() < 1e-3  # type: ignore[union-attr]
    assert np.abs(seen["p_EB"] - seen["p_EB"][0]).max() > 1e-5  # it is loose


@pytest.mark.slow
def test_ctrl_c_stops_the_arm_with_its_load(directory: Path, arm: Make) -> None:
    robot = arm("--interrupt", "0.3")
    result = run(directory, robot)
    assert result.summary["stopped"].startswith("Interrupted at t = 0.1")
    assert result.summary["load_kept_in_stop"] is True
    seen = robot.seen()
    assert np.abs(seen["dq"][300]).max() > 0.3
    assert np.abs(seen["dq"][-1]).max() < 0.02
    kept_and_within_limits(seen, load_plan(directory))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("fault", "words"),
    [
        ("--reflex", 'Move command aborted: motion aborted by reflex! ["joint_reflex"].'),
        ("--die", "UDP receive: Timeout. franka at ADDRESS could not be told to stop (NetworkException: libfranka: "),
    ],
)
def test_an_arm_that_stops_by_itself_or_is_gone_is_a_sentence(
    directory: Path, arm: Make, fault: str, words: str
) -> None:
    robot = arm(fault, "0.3")
    result = run(directory, robot)
    address = robot.address
    assert result.summary["stopped"].startswith(f"The arm at {address} says: " + words.replace("ADDRESS", address))
    assert result.summary["load_kept_in_stop"] is None
    log = load_npz(result.path, ("t", "q", "dq", "tau"))
    assert 0.08 < log["t"][-1] < 0.12
    assert all(np.all(np.isfinite(log[name])) for name in ("t", "q", "dq", "tau"))


@pytest.mark.slow
def test_goals_and_a_stop_are_carried_out_while_it_moves(directory: Path, arm: Make, tmp_path: Path) -> None:
    robot = arm()
    lines = ['{"t": 0.0, "goto": [0.5, -0.2, 0.45]}', '{"t": 2.5, "twist": [0.1, 0.1, 0, 0], "for": 0.3}']
    result = run_live(CASE, [*lines, '{"t": 3.0, "stop": true}'], tmp_path / "live", "franka", robot.address,
                      realtime=False)  # fmt: skip
    assert result.achieved
    assert result.summary["requests"] == {"accepted": 3, "refused": 0, "dropped": 0}
    seen = robot.seen()
    assert np.abs(seen["q"][-1] - seen["q"][0]).max() > 0.1
    assert np.abs(seen["dq"][-1]).max() < 1e-3
    kept_and_within_limits(seen, load_plan(directory))
