"""Audits: verdicts derived by hand, and what the command says of them."""

import json
import re

import numpy as np
import pytest
from typer.testing import CliRunner

from recorded_motions import GOAL, JOINTS, START, joint_motion, line, tray_csv, write_csv
from salver import scenario as scenarios
from salver.auditing import Audit, audit
from salver.auditing.motion import AuditedMotion
from salver.auditing.verdict import AT_ONCE
from salver.cli import app
from salver.geometry import exp
from salver.trajectory import MotionSamples, min_jerk_line

PEAK = 10 / np.sqrt(3) * 0.5  # of the min-jerk acceleration over 0.5 m, times T^2


# Verdicts -----------------------------------------------------------------------------------------------------


def case(friction=0.3, height=0.04, friction_range=None):
    data = scenarios.load("panda-cube").model_dump(mode="json", exclude_none=True)
    data["objects"][0] |= {
        "friction": friction,
        "uncertainty": {"friction": friction_range} if friction_range else {},
    }
    data["objects"][0]["shape"] = {"type": "box", "size": [0.04, 0.04, height]}
    data["objects"][0].pop("inertia")
    return scenarios.parse(data, "test")


def of_line(duration):
    return AuditedMotion(line(duration))


def test_the_friction_that_a_level_move_needs_is_its_peak_acceleration_over_gravity():
    duration = 1.2
    result = Audit(case(friction=0.3), "motion", of_line(duration))
    needed = PEAK / duration**2 / 9.81
    assert result.nominal.code == "holds"
    assert result.margins.interfaces[0].friction_needed.max() == pytest.approx(needed, rel=1e-4)
    assert result.margins.interfaces[0].friction_needed_worst == pytest.approx(needed, rel=1e-3)


def test_it_slides_when_the_acceleration_passes_friction_times_gravity():
    duration = 0.9
    result = Audit(case(friction=0.3), "motion", of_line(duration))
    s = line(duration)
    first = s.t[np.argmax(np.abs(s.a_S[:, 1]) > 0.3 * 9.81)]
    assert result.nominal.code == "slides"
    assert result.nominal.details["time"] == pytest.approx(first, abs=1e-3)
    assert result.speeds.pace.details["factor"] == pytest.approx(np.sqrt(PEAK / duration**2 / (0.3 * 9.81)), rel=1e-4)
    assert not result.ok


def test_of_very_many_instants_those_that_decide_are_looked_at():
    """The least margins of the whole, and the first instants at which they fail, are among them. It accelerates most
    upwards, which presses the cube on, soon after it slides."""
    t = np.linspace(0, 1, 10_001)
    zero, still = np.zeros((len(t), 3)), np.tile(np.eye(3), (len(t), 1, 1))
    sideways, upwards = (size * np.exp(-(((t - at) / 0.02) ** 2)) for at, size in ((0.1, 3.2), (0.25, 8.0)))
    motion = MotionSamples(t, zero, zero, np.stack([sideways, 0 * t, upwards], axis=1), still, zero, zero)
    result = Audit(case(friction=0.3, friction_range="10%"), "motion", AuditedMotion(motion))
    few, (nominal, worst) = result.margins, result.reserves
    assert len(few.t) < AT_ONCE < len(nominal)
    for least, every in ((few.exact, nominal), (few.exact_worst, worst)):
        assert least.min() == pytest.approx(every.min(), abs=1e-12)
        assert few.t[np.argmax(least < 0)] == result.motion.samples.t[np.argmax(every < 0)]
    assert few.t[[0, -1]] == pytest.approx([0.0, 1.0])


def test_a_tall_box_tips_where_its_base_ends():
    # Base half-width 2 cm, centre of mass 10 cm up: it tips at a = g / 5, well below friction 0.8.
    duration = 1.0
    result = Audit(case(friction=0.8, height=0.2), "motion", of_line(duration))
    s = line(duration)
    first = s.t[np.argmax(np.abs(s.a_S[:, 1]) > 9.81 / 5)]
    assert result.nominal.code == "tips"
    assert result.nominal.details["time"] == pytest.approx(first, abs=1e-3)
    assert result.speeds.pace.details["factor"] == pytest.approx(np.sqrt(PEAK * 5 / 9.81), rel=1e-4)
    assert result.margins.interfaces[0].tip_over.min() == pytest.approx(0.02 - 0.1 * PEAK / 9.81, rel=1e-3)


def test_run_at_its_pace_the_path_just_holds():
    uncertain = case(0.3, friction_range="10%")
    slow = Audit(uncertain, "motion", of_line(0.9)).speeds_worst.pace.details["factor"]
    assert Audit(uncertain, "motion", of_line(0.9 * slow * 1.001)).worst.code == "holds"
    assert Audit(uncertain, "motion", of_line(0.9 * slow * 0.999)).worst.code == "slides"


def test_what_holds_nominally_may_not_hold_in_the_worst_case():
    duration = np.sqrt(PEAK / (0.28 * 9.81))  # needs friction 0.28
    result = Audit(case(0.3, friction_range="10%"), "motion", of_line(duration))
    assert result.nominal.ok
    assert not result.worst.ok
    assert not result.ok
    assert result.speeds_worst.pace.details["factor"] == pytest.approx(np.sqrt(0.28 / 0.27), rel=1e-3)
    assert next(iter(result.costs)) == "friction"


@pytest.mark.slow
def test_what_passes_the_edge_by_less_than_its_acceleration_is_known_cannot_be_told():
    """Half a m/s^2 beyond friction times gravity at two peaks: known to 0.2 m/s^2 it slides, to 1 not."""
    duration = np.sqrt(PEAK / (0.3 * 9.81 + 0.5))
    for error, code in ((0.0, "slides"), (0.2, "slides"), (1.0, "cannot_tell")):
        assert Audit(case(0.3), "motion", AuditedMotion(line(duration), acceleration_error=error)).nominal.code == code
        missed = AuditedMotion(line(duration), acceleration_error=0.0, missed=np.full(len(line(duration).t), error))
        assert Audit(case(0.3), "motion", missed).nominal.code == code


# The command --------------------------------------------------------------------------------------------------


def run(*arguments):
    return CliRunner().invoke(app, ["audit", *map(str, arguments)])


@pytest.mark.slow
def test_the_exit_code_tells(tmp_path):
    held = run(tray_csv(tmp_path / "slow.csv", 2.5), "--scenario", "panda-cube")
    assert held.exit_code == 0
    assert "Everything holds" in held.stdout
    slid = run(tray_csv(tmp_path / "fast.csv", 0.6), "--scenario", "panda-cube")
    assert slid.exit_code == 3
    assert "slides at" in slid.stdout
    assert "times as long" in slid.stdout
    wrong = run(tmp_path / "none.csv", "--scenario", "panda-cube")
    assert wrong.exit_code == 2
    assert "does not exist" in wrong.stderr


def test_friction_that_is_needed_stands_beside_what_there_surely_is(tmp_path):
    """The peak acceleration of a level line over gravity, of 0.5 +- 10 %; where the tray falls away none suffices."""
    path = tmp_path / "cube.toml"
    path.write_text(
        """name = "cube"
        [motion]
        start.position = [0, 0, 0]
        goal.position = [0, 0.5, 0]
        [[objects]]
        shape = { type = "box", size = [0.06, 0.06, 0.04] }
        mass = 0.2
        friction = 0.5
        uncertainty = { friction = "10%" }
        [contact]
        condition = "exact"
        """
    )
    told = " ".join(run(tray_csv(tmp_path / "a.csv", 1.0), "--scenario", path).stdout.split())
    needed = re.search(r"friction needed (\S+) nominal, of 0.5, (\S+) worst case, of 0.45; tip-over", told)
    assert needed
    assert [float(x) for x in needed.groups()] == pytest.approx([PEAK / 9.81] * 2, rel=0.01)
    down = line(0.4)  # 18 m/s^2 at its peak
    p = down.p_SB[:, [0, 2, 1]] * [1, 1, -1]
    fallen = write_csv(tmp_path / "b.csv", "t,x,y,z,qw,qx,qy,qz", down.t, p, down.quat_SB_wxyz)
    told = " ".join(run(fallen, "-s", path).stdout.split())
    assert "friction needed (none suffices) nominal, of 0.5" in told
    assert "tip-over margin lifts nominal, lifts worst case" in told


def test_json_has_every_figure(tmp_path):
    result = run(tray_csv(tmp_path / "a.csv", 0.9, noise=1e-5), "--scenario", "panda-cube", "--json")
    found = json.loads(result.stdout)
    # 5.77 * 0.5 / 0.81 m/s^2; the cube has friction 0.5, and noise adds a little to the peak.
    assert found["interfaces"][0]["friction_needed"] == pytest.approx(PEAK / 0.81 / 9.81, rel=0.03)
    assert found["motion"]["recording"]["position_noise"] == pytest.approx(1e-5, rel=0.1)
    assert set(found["motion"]["recording"]) == {
        "rate", "highest", "position_noise", "orientation_noise", "resolution", "bandwidth", "acceleration_error",
        "hidden_slip", "hidden_frequency",
    }  # fmt: skip
    assert set(found["interfaces"][0]) == {
        "name", "friction", "friction_needed", "friction_needed_time", "friction_needed_worst_case", "tip_over_margin",
        "tip_over_margin_worst_case",
    }  # fmt: skip
    assert set(found["motion"]) == {
        "source", "duration", "instants", "peak_acceleration", "peak_tilt", "recording", "notes"
    }  # fmt: skip
    assert found["motion"]["peak_acceleration"] == pytest.approx(PEAK / 0.81, rel=0.03)
    assert found["holds"] is True
    assert found["pace"]["nominal"]["factor"] == pytest.approx(np.sqrt(PEAK / 0.81 / 9.81 / 0.5), rel=0.03)


def test_the_table_has_the_motion_as_it_was_understood_and_the_margins():
    s = min_jerk_line(1.0, START, GOAL, exp([0.0, 0.0, 0.4]), exp([0.03, -0.05, -0.2])).sample(np.linspace(0, 1, 51))
    found = Audit(case(friction_range="10%"), "motion", AuditedMotion(s))
    table, (nominal, worst) = found.to_xarray(), found.reserves
    expected = {"p_SE": s.p_SB, "v_S": s.v_S, "a_S": s.a_S, "omega_E": s.omega_B, "alpha_E": s.alpha_B}
    expected |= {"margin": nominal, "margin_worst_case": worst}
    assert set(table) == set(expected)
    for name, values in expected.items():
        assert np.array_equal(table[name], values), name
        assert np.ptp(values) > 0.01, name


def test_a_joint_file_of_the_scenarios_arm(tmp_path):
    t, q = joint_motion(duration=4.0)
    path = write_csv(tmp_path / "a.csv", "t," + ",".join(JOINTS), t, q)
    result = audit(path, scenarios.load("panda-cube"))
    assert result.nominal.ok
    assert result.summary()["motion"]["peak_tilt"] > 0.05
