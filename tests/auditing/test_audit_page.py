"""The page of an audit says what the audit says, in a real browser, and shows the motion that was given."""

import re
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

import browser
import salver as sv
from recorded_motions import series_of
from salver.cli import app
from salver.motion_files import JointSamples, write
from salver.motion_files.samples import tray_samples

JOINTS = tuple(f"panda_joint{k}" for k in range(1, 8))
UNCERTAIN = {"mass": "10%", "friction": "30%"}


def shape(s):
    return s**3 * (10 - 15 * s + 6 * s**2)


@pytest.fixture(scope="module")
def tray_file(tmp_path_factory):
    """A level quintic of 0.3 m in a time in which it needs 0.4 of friction: 0.5 is there, 0.35 is sure."""
    duration = float(np.sqrt(10 * 0.3 / (np.sqrt(3) * 0.4 * 9.81)))
    t = np.linspace(0, duration, 400)
    p = np.column_stack([np.full(400, 0.45), 0.3 * shape(t / duration), np.full(400, 0.4)])
    samples = tray_samples(t, p, np.tile([1.0, 0, 0, 0], (400, 1)), "made")
    return write(series_of(samples), tmp_path_factory.mktemp("page") / "<b>motion.csv")[0]


@pytest.fixture(scope="module")
def joint_file(tmp_path_factory):
    s = np.linspace(0, 1, 50)[:, None]
    q0 = np.array([0.08, 1.04, -0.78, -1.68, -2.2, 0.84, 1.12])
    q, dq = q0 + 0.3 * shape(s) * np.eye(7)[0], 0.3 * 30 * s**2 * (1 - s) ** 2 / 3 * np.eye(7)[0]
    samples = JointSamples(3 * s[:, 0], JOINTS, q, dq, None, "made", commanded=True)
    return write(series_of(samples), tmp_path_factory.mktemp("page") / "motion.yaml")[0]


@pytest.mark.slow
def test_the_verdict_of_the_page_is_that_of_the_audit(tray_file, joint_file):
    scenario = sv.load_scenario("panda-cube", objects__0__uncertainty=UNCERTAIN)
    for path, words, level in (
        (tray_file, "It holds for the nominal load, and not for everything that it may be", "bad"),
        (joint_file, "Everything stays where it is", "good"),
    ):
        audit = sv.audit(path, scenario)
        html = sv.report(audit).html
        assert words in html
        assert f'<div class="verdict {level}"' in html
        assert audit.arm.sentence.startswith("Not checked: ")
        assert html.index(audit.arm.sentence) < html.index(audit.worst.sentence)
        assert f"{audit.speeds_worst.pace.details['factor']:.3f}" in html
        assert audit.speeds_worst.sentence in html
        assert f"{datetime.now(UTC):%Y-%m-%d}" in html
        assert audit.scenario.digest in html
        for name, half in (("mass", "25.6 g (10 %)"), ("friction", "0.15 (30 %)")):
            assert re.search(rf"± {name}</t[hd]>\s*<td[^>]*>{re.escape(half)}<", html)


def test_a_name_in_a_file_is_text_and_a_page_that_stands_there_is_kept(tray_file, tmp_path):
    page = tmp_path / "page.html"
    page.write_text("somebody's")
    done = CliRunner().invoke(app, ["report", str(tray_file), "-s", "panda-cube", "-o", str(page)])
    assert done.exit_code == 0, done.output
    assert "&lt;b&gt;motion.csv" in page.read_text()
    assert "<b>motion.csv" not in page.read_text()
    assert (tmp_path / "page-1.html").read_text() == "somebody's"
    done = CliRunner().invoke(app, ["report", str(tray_file), "-s", "panda-cube", "-o", str(tmp_path / "page.csv")])
    assert done.exit_code == 2
    assert "it must end in .html" in done.stderr


@pytest.mark.slow
@pytest.mark.skipif(browser.missing() is not None, reason=str(browser.missing()))
def test_in_a_browser_the_arm_moves_as_it_was_told(joint_file, tmp_path):
    written = sv.report(sv.audit(joint_file, "panda-cube"), path=tmp_path / "page.html").path
    with browser.chromium(390, 844) as page:
        page.open(Path(written))
        page.wait_for("document.querySelector('#names b')")
        assert page.script("return document.querySelector('#names').innerText").split("\n")[:2] == [
            "Given", "as it was read",
        ]  # fmt: skip
        assert page.script("return document.querySelectorAll('[data-chart] svg').length") == 7
        assert page.script("return document.documentElement.scrollWidth") <= 390
        assert page.script("return data.replay.joints") == 8
        assert page.script("return data.replay.duration") == pytest.approx(3.0)
        assert not [entry for entry in page.log("browser") if entry["level"] == "SEVERE"]
        assert all(url.startswith(("file:", "data:")) for url in page.requests())


def test_of_a_file_alone_the_command_asks_what_is_carried(tray_file):
    done = CliRunner().invoke(app, ["report", str(tray_file)])
    assert done.exit_code == 2
    assert done.stderr.rstrip().endswith(".csv is a file; for a motion file, name the scenario too: --scenario.")
