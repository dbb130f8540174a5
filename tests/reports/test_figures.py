"""Figures and tables: what is drawn against the arrays it is drawn from; the film against the simulation."""

from __future__ import annotations

import csv
import re
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from salver import scenario
from salver.errors import MissingDependencyError, SalverError
from salver.planning.make import make_plan
from salver.planning.plan import load_plan
from salver.reports import perturbed
from salver.reports.pictures import figures, film
from salver.reports.run import read_run
from salver.reports.style import RC, ROLE_COLOURS, paper_style, rgb
from salver.reports.tables import numbers_table, scenario_rows, write_table
from salver.simulation.physics import simulate

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def directory(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("run")
    case = scenario.load("panda-cube").with_changes(physics__settle_before=0.05, physics__settle_after=0.1)
    make_plan(case, "robust").save(folder, "plan")
    make_plan(case, "baseline").save(folder, "baseline")
    return folder


def _lines(axes: Any) -> list[tuple[np.ndarray, np.ndarray]]:
    return [(np.asarray(line.get_xdata()), np.asarray(line.get_ydata())) for line in axes.get_lines()]


def test_every_figure_of_the_paper(directory: Path, tmp_path: Path) -> None:
    shutil.copytree(directory, tmp_path / "run")
    paths = figures.write_figures(tmp_path / "run", "svg", n=2, physics=False)
    drawn = [p for p in paths if p.suffix == ".svg"]
    assert [p.stem for p in drawn] == [
        "fig3-trajectories",
        "fig4-coefficients",
        "fig5-perturbed-plan",
        "fig6-perturbed-baseline",
    ]
    assert {p.name for p in paths if p not in drawn} == {
        "table1-parameters.csv",
        "table1-parameters.md",
        "numbers.csv",
        "numbers.md",
    }
    text = (tmp_path / "run" / "figures" / "fig3-trajectories.svg").read_text()
    assert "time [s]" in text
    assert text.count("[m]") >= 3
    with pytest.raises(SalverError, match='no figure format "jpeg"; known are pdf, svg, png'):
        figures.write_figures(directory, "jpeg")


@pytest.mark.parametrize(("file_format", "magic"), [("pdf", b"%PDF"), ("svg", b"<?xml"), ("png", b"\x89PNG")])
def test_same_data_same_file_in_every_format(directory: Path, file_format: str, magic: bytes) -> None:
    assert file_format in figures.FORMATS
    run = read_run(directory)
    with paper_style():
        first, second = (figures.render(figures.coefficients(run.motions), file_format) for _ in range(2))
    assert first.startswith(magic)
    assert first == second


def test_style_leaves_matplotlib_as_it_was() -> None:
    import matplotlib

    before = dict(matplotlib.rcParams)
    with paper_style():
        assert matplotlib.rcParams["font.size"] == RC["font.size"]
    assert dict(matplotlib.rcParams) == before


def test_fig3_draws_the_positions(directory: Path) -> None:
    run = read_run(directory)
    with paper_style():
        figure = figures.trajectories(run.motions)
    for axis, axes in enumerate(figure.axes[:3]):
        assert re.search(r"\[m\]", axes.get_ylabel())
        for (t, y), motion in zip(_lines(axes), run.motions, strict=True):
            assert np.array_equal(t, motion.t)
            assert np.array_equal(y, motion.arrays["p_SB"][:, axis])
    assert figure.axes[2].get_xlabel() == "time [s]"
    styles = [line.get_linestyle() for line in figure.axes[0].get_lines()]
    assert len(set(styles)) == 2  # told apart without colour


def test_fig4_draws_all_coefficients_on_one_scale(directory: Path) -> None:
    run = read_run(directory)
    with paper_style():
        figure = figures.coefficients(run.motions)
    for axes, motion in zip(figure.axes, run.motions, strict=True):
        drawn = np.stack([y for _, y in _lines(axes)[:16]], axis=1)
        assert np.array_equal(drawn, motion.arrays["cone_coefficients"])
        least = 1e3 * motion.arrays["cone_coefficients"].min()
        assert f"{least:.0f} mN" in axes.get_title(loc="left")
    assert figure.axes[0].get_ylim() == figure.axes[1].get_ylim()


def test_perturbed_rollouts_by_hand(directory: Path) -> None:
    """Corners come first: least and largest mass. Where nothing accelerates, m g = m_n (g + kp e)."""
    run = read_run(directory)
    runs = perturbed.perturbed_rollouts(run, "baseline", 6, 0)
    assert runs.rollout.cone_coefficients.shape == (6, 601, 16)
    settled = runs.rollout.deviation[:, 300, 2]  # half way the acceleration is zero
    for mass_ratio, error in ((0.9, settled[0]), (1.1, settled[1])):
        assert error == pytest.approx((1 - mass_ratio) * 9.81 / 500, rel=1e-3)
    low, high = perturbed.envelope(np.array([[1.0, 5.0]]), np.array([[2.0, 1.0]]))
    assert (low, high) == (-1.0, 6.0)


def test_figs_5_and_6_lie_in_the_tubes(directory: Path) -> None:
    run = read_run(directory)
    runs = perturbed.perturbed_rollouts(run, "plan", 20, 0)
    with paper_style():
        figure = figures.perturbed_figure(run.plan, runs)
    low, high = perturbed.envelope(run.plan.arrays["cone_coefficients"], run.plan.arrays["cone_radius"])
    drawn = _lines(figure.axes[0])
    assert any(np.array_equal(y, low) for _, y in drawn if len(y))
    assert any(np.array_equal(y, high) for _, y in drawn if len(y))
    bodies = [y for t, y in drawn if len(t) == 601 and not (np.array_equal(y, low) or np.array_equal(y, high))]
    assert len(bodies) == 4 * 20
    widest = run.plan.arrays["cone_radius"].max()
    assert all(np.all(y > low - 0.1 * widest) and np.all(y < high + 0.1 * widest) for y in bodies)  # first order


def test_fig8_draws_both_cases(directory: Path) -> None:
    run = read_run(directory)
    plans = {m.stem: load_plan(directory, m.stem) for m in run.motions}
    nominal = {stem: perturbed.heavier(plan, 0.0) for stem, plan in plans.items()}
    more = {stem: perturbed.heavier(plan) for stem, plan in plans.items()}
    assert dict(more["plan"].parameters) == {"mass": pytest.approx(0.306)}
    with paper_style():
        figure = figures.tracking(run.motions, nominal, more)
    assert [ax.get_title(loc="left") for ax in figure.axes[:2]] == ["(a) nominal", "(b) +50 g"]
    for axes, records, key in zip(
        figure.axes, (nominal, more, nominal, more), ("e_p", "e_p", "e_o", "e_o"), strict=True
    ):
        drawn = _lines(axes)
        for (_, y), motion in zip(drawn, run.motions, strict=False):
            assert np.allclose(y, 1e3 * getattr(records[motion.stem], key))
        assert axes.get_ylim()[1] >= max(y.max() for _, y in drawn[:2])
    assert more["plan"].e_p.max() > 2 * nominal["plan"].e_p.max()


def test_fig7_shows_the_same_instants_of_both(directory: Path) -> None:
    run = read_run(directory)
    record = perturbed.heavier(load_plan(directory, "plan"), 0.0)
    with paper_style():
        figure = figures.snapshots(run, {"plan": record})
    assert len(figure.axes) == 4
    assert [ax.get_title(loc="left") for ax in figure.axes] == ["0.00 s", "0.83 s", "1.67 s", "2.50 s"]
    assert figure.axes[0].get_ylabel() == "Robust"
    first, last = (np.asarray(figure.axes[k].get_images()[0].get_array()).astype(int) for k in (0, 3))
    assert (np.abs(first - last).max(axis=2) > 30).sum() > 1000  # the arm has moved


def test_tables(directory: Path, tmp_path: Path) -> None:
    run = read_run(directory)
    rollouts = {m.stem: perturbed.perturbed_rollouts(run, m.stem, 4, 0) for m in run.motions}
    table = numbers_table(run, rollouts)
    rows = {row[0]: row[1:] for row in table[1:]}
    assert table[0] == ("quantity", "robust", "baseline")
    assert float(rows["length of the path [m]"][1]) == pytest.approx(np.hypot(0.098098, 0.471148), rel=1e-5)
    assert float(rows["highest above the straight line [m]"][1]) == pytest.approx(0.0, abs=1e-12)
    least = float(run.plan.cone_floor.min())
    assert float(rows["least cone coefficient, lower edge of its tube [N]"][0]) == pytest.approx(least, rel=1e-5)
    # At rest 4 x 4 coefficients share the weight: 0.256 g sqrt(1 + 0.5^2) / 16.
    assert run.plan.arrays["cone_coefficients"][0] == pytest.approx(0.256 * 9.81 * np.sqrt(1.25) / 16)
    csv_path, markdown = write_table(tmp_path / "numbers", table)
    with open(csv_path, newline="") as file:
        assert list(csv.reader(file)) == [list(row) for row in table]
    assert markdown.read_text().count("\n") == len(table) + 1
    asked = dict(scenario_rows(run))
    assert asked["± mass"] == "25.6 g (10 %)"
    assert asked["gains K_p"].startswith("500, 300")


def test_colours_of_motions_differ_in_brightness_or_dash() -> None:
    def brightness(colour: str) -> float:
        r, g, b = rgb(colour)
        return 0.2126 * r + 0.7152 * g + 0.0722 * b

    assert len({round(brightness(c), 2) for c in ROLE_COLOURS.values()}) == 2


@pytest.fixture(scope="module")
def simulated(directory: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("film") / "run"
    shutil.copytree(directory, folder)
    for stem in ("plan", "baseline"):
        simulate(load_plan(folder, stem)).save(folder, stem)
    return folder


def test_film_without_an_encoder_moves(simulated: Path, tmp_path: Path) -> None:
    from PIL import Image

    made = film.write_film(simulated, tmp_path / "film.gif", rate=1.0, width=96, height=72)
    assert made.frames == 3  # at 0, 1 and 2 s
    with Image.open(made.path) as image:
        assert image.size == (96 + 4 + 96, 72)
        assert image.n_frames == 3
        assert image.info["duration"] == 1000
        first = np.asarray(image.convert("RGB")).astype(int)
        image.seek(2)
        later = np.asarray(image.convert("RGB")).astype(int)
    assert (np.abs(later - first).max(axis=2) > 30).sum() > 50
    single = film.write_film(simulated, tmp_path / "one.webp", "plan", rate=1.0, speed=2.0, width=64, height=48)
    assert single.frames == 2  # at 0 and 2 s


def test_film_by_ffmpeg(simulated: Path, tmp_path: Path) -> None:
    if film.find_ffmpeg() is None:
        pytest.skip("no ffmpeg: neither on the path nor by imageio-ffmpeg (pip install 'salver[video]')")
    made = film.write_film(simulated, tmp_path / "film.mp4", "plan", rate=1.0, width=97, height=73)
    content = made.path.read_bytes()
    assert content[4:8] == b"ftyp"
    assert list(tmp_path.iterdir()) == [made.path]  # nothing half-written is left


def test_film_without_ffmpeg_says_what_to_do(simulated: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(film, "find_ffmpeg", lambda: None)
    with pytest.raises(
        MissingDependencyError, match=r"install ffmpeg, or pip install 'salver\[video\]', or name a file"
    ):
        film.write_film(simulated, tmp_path / "film.mp4")


def test_films_that_cannot_be(directory: Path, simulated: Path, tmp_path: Path) -> None:
    with pytest.raises(SalverError, match=r"ends in none of \.mp4, \.mkv"):
        film.write_film(simulated, tmp_path / "film.avi")
    with pytest.raises(SalverError, match="holds no simulation of plan; make one with `salver simulate"):
        film.write_film(directory, tmp_path / "film.gif")
    with pytest.raises(SalverError, match='no motion "other"'):
        film.write_film(simulated, tmp_path / "film.gif", "other")
    with pytest.raises(SalverError, match="0 pictures a second"):
        film.write_film(simulated, tmp_path / "film.gif", rate=0.0)
    with pytest.raises(SalverError, match="8 x 8 pixels"):
        film.write_film(simulated, tmp_path / "film.gif", width=8, height=8)
