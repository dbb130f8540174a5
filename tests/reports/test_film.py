"""The film against the simulation."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from salver.errors import MissingDependencyError, SalverError
from salver.reports import film
from salver.reports.style import ROLE_COLOURS, rgb

pytestmark = pytest.mark.slow


def test_colours_of_motions_differ_in_brightness_or_dash() -> None:
    def brightness(colour: str) -> float:
        r, g, b = rgb(colour)
        return 0.2126 * r + 0.7152 * g + 0.0722 * b

    assert len({round(brightness(c), 2) for c in ROLE_COLOURS.values()}) == 2


def test_film_without_an_encoder_moves(cube_run: Path, tmp_path: Path) -> None:
    from PIL import Image

    made = film.write_film(cube_run, tmp_path / "film.gif", rate=1.0, width=96, height=72)
    assert made.frames == 4  # at 0, 1, 2 and 3 s
    with Image.open(made.path) as image:
        assert image.size == (96 + 4 + 96, 72)
        assert image.n_frames == 4
        assert image.info["duration"] == 1000
        first = np.asarray(image.convert("RGB")).astype(int)
        image.seek(2)
        later = np.asarray(image.convert("RGB")).astype(int)
    assert (np.abs(later - first).max(axis=2) > 30).sum() > 50
    single = film.write_film(cube_run, tmp_path / "one.gif", "plan", rate=1.0, speed=2.0, width=64, height=48)
    assert single.frames == 2  # at 0 and 2 s


def test_film_by_ffmpeg(cube_run: Path, tmp_path: Path) -> None:
    if film.find_ffmpeg() is None:
        pytest.skip("no ffmpeg: neither on the path nor by imageio-ffmpeg (pip install 'salver[video]')")
    made = film.write_film(cube_run, tmp_path / "film.mp4", "plan", rate=1.0, width=97, height=73)
    content = made.path.read_bytes()
    assert content[4:8] == b"ftyp"
    assert list(tmp_path.iterdir()) == [made.path]  # nothing half-written is left


def test_film_without_ffmpeg_says_what_to_do(cube_run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(film, "find_ffmpeg", lambda: None)
    with pytest.raises(
        MissingDependencyError, match=r"install ffmpeg, or pip install 'salver\[video\]', or name a file"
    ):
        film.write_film(cube_run, tmp_path / "film.mp4")


def test_films_that_cannot_be(cube_plans: Path, cube_run: Path, tmp_path: Path) -> None:
    with pytest.raises(SalverError, match=r"must end in \.mp4 or \.gif"):
        film.write_film(cube_run, tmp_path / "film.avi")
    with pytest.raises(SalverError, match="holds no simulation of plan; make one with `salver simulate"):
        film.write_film(cube_plans, tmp_path / "film.gif")
    with pytest.raises(SalverError, match='no motion "other"'):
        film.write_film(cube_run, tmp_path / "film.gif", "other")
    with pytest.raises(SalverError, match="0 pictures a second"):
        film.write_film(cube_run, tmp_path / "film.gif", rate=0.0)
    with pytest.raises(SalverError, match="8 x 8 pixels"):
        film.write_film(cube_run, tmp_path / "film.gif", width=8, height=8)
