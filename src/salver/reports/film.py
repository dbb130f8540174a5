"""`salver render`: a film of a run in the physics engine, made without a display."""

from __future__ import annotations

import io
import shutil
import subprocess
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from shlex import quote
from typing import TYPE_CHECKING

import numpy as np

from salver.errors import MissingDependencyError, SalverError, needs
from salver.files import put_in_place, write_atomic, writing
from salver.motion_files.verdict import UNSAFE
from salver.planning.plan import load_plan
from salver.planning.round import has_legs, load_round
from salver.run_directory import STEMS, leg_number, scenario_of
from salver.simulation.record import FOLDER, SimulationRecord, load_record

if TYPE_CHECKING:
    from salver.scenario import Scenario

LABELS = {"plan": "planned", "baseline": "straight line", "nominal": "planned for nominal values"}


@dataclass(frozen=True)
class Film:
    """path: the file. frames: how many. verdicts: on the plans of the runs, by stem."""

    path: Path
    frames: int
    verdicts: Mapping[str, str]


def write_film(
    directory: str | Path,
    path: str | Path,
    stem: str = "both",
    *,
    rate: float = 30.0,
    speed: float = 1.0,
    width: int = 960,
    height: int = 720,
    most: int = 10_000,
) -> Film:
    """Film of the simulations that a run directory holds; "both" shows plan and comparison side by side. The legs of a
    plan of several follow one another, as far as they were run.

    rate: pictures a second. speed: of time in the film; 0.25 shows it four times slower. width, height: of a picture.
    most: pictures, a few minutes of film.
    Formats by the ending of `path`: mp4 through ffmpeg, gif without it. Raises SalverError for what cannot be,
    MissingDependencyError when there is no encoder or no OpenGL.
    """
    path = Path(path)
    if path.suffix not in (".mp4", ".gif"):
        raise SalverError(f"{path} must end in .mp4 or .gif, or in .mcap for a recording that Foxglove shows.")
    if not (0.1 <= rate <= 120 and 1e-3 <= speed <= 10):
        raise SalverError(
            f"{rate:g} pictures a second at {speed:g} times the speed: it must be 0.1 to 120 pictures a second, "
            "at 0.001 to 10 times."
        )
    if min(width, height) < 16 or max(width, height) > 4096:
        raise SalverError(f"A picture of {width} x {height} pixels was asked for; each side must be from 16 to 4096.")
    with needs("engine", "A film"):
        import PIL  # noqa: F401
    width, height = width - width % 2, height - height % 2  # the encoder halves both
    save = _ffmpeg(path) if path.suffix == ".mp4" else _pillow(path)
    scenes = _scenes(Path(directory), stem)
    seconds = sum(scene.seconds for scene in scenes)
    if seconds * rate / speed > most:
        raise SalverError(
            f"{rate:g} pictures a second at {speed:g} times the speed make {seconds * rate / speed:.2g} pictures; at "
            f"most {most} are drawn."
        )
    times = [np.arange(0.0, scene.seconds + 1e-9, speed / rate) for scene in scenes]
    save(chain(*(_pictures(*each, width, height) for each in zip(scenes, times, strict=True))), rate)
    verdicts = {stem: verdict for scene in scenes for stem, verdict in scene.verdicts.items()}
    return Film(path, sum(map(len, times)), verdicts)


@dataclass(frozen=True)
class _Scene:
    """Runs that are shown side by side, by stem, and the verdicts on their plans."""

    scenario: Scenario
    records: Mapping[str, SimulationRecord]
    verdicts: Mapping[str, str]

    @property
    def seconds(self) -> float:
        return max(float(record.t[-1]) for record in self.records.values())


def _scenes(directory: Path, stem: str) -> list[_Scene]:
    """The scenes of the film, one after the other."""
    if stem not in (*STEMS, "both") and leg_number(stem) is None:
        raise SalverError(f'There is no motion "{stem}" to show; known are {", ".join(STEMS)} and both.')
    scenario_of(directory)
    legs = stem in ("plan", "both") and has_legs(directory)
    plans = load_round(directory).by_stem if legs else {}
    asked = plans or (STEMS if stem == "both" else (stem,))
    wanted = [s for s in asked if (directory / FOLDER / f"{s}.npz").is_file()]
    if not wanted:
        name = "plan" if stem == "both" else stem
        raise SalverError(
            f"{directory} holds no simulation of {name}; make one with `salver simulate "
            f"{quote(str(directory))} --plan {name}`."
        )
    plans = plans or {s: load_plan(directory, s) for s in wanted}
    records = {s: load_record(directory, s) for s in wanted}
    verdicts = {s: plans[s].verdict for s in wanted}
    if legs:
        return [_Scene(plans[s].scenario, {s: records[s]}, {s: verdicts[s]}) for s in wanted]
    return [_Scene(plans[wanted[0]].scenario, records, verdicts)]


def _pictures(scene: _Scene, times: np.ndarray, width: int, height: int) -> Iterator[np.ndarray]:
    """Pictures at `times`, the records side by side."""
    from salver.simulation.pictures import frames_at, painter

    records, verdicts = scene.records, scene.verdicts

    def film(record: SimulationRecord) -> Iterator[np.ndarray]:
        with painter(record, scene.scenario, width, height) as paint:
            for k in frames_at(record, times):
                yield paint(int(k))

    for row in zip(*(film(record) for record in records.values()), strict=True):
        titles = [
            f"{f'{UNSAFE}, ' if verdicts[stem].startswith(UNSAFE) else ''}{LABELS.get(stem, stem)}: {found.outcome}"
            for stem, found in records.items()
        ]
        yield _side_by_side([_titled(p, t) for p, t in zip(row, titles, strict=True)])


def _titled(picture: np.ndarray, title: str) -> np.ndarray:
    from PIL import Image, ImageDraw, ImageFont

    image = Image.fromarray(np.ascontiguousarray(picture))
    size = max(12, picture.shape[0] // 28)
    font = ImageFont.load_default(size)
    ImageDraw.Draw(image).text(
        (size, size // 2), title, font=font, fill="white", stroke_width=2, stroke_fill=(40, 45, 52)
    )
    return np.asarray(image)


def _side_by_side(pictures: list[np.ndarray], gap: int = 4) -> np.ndarray:
    """One picture of several, with a gap between two, pixels."""
    framed = [np.pad(picture, ((0, 0), (0, gap), (0, 0)), constant_values=255) for picture in pictures]
    return np.concatenate(framed, axis=1)[:, :-gap]


Save = Callable[[Iterator[np.ndarray], float], None]


def find_ffmpeg() -> str | None:
    """The program ffmpeg: on the path, or the one that the package imageio-ffmpeg brings."""
    found = shutil.which("ffmpeg")
    if found:
        return found
    try:
        import imageio_ffmpeg
    except ImportError:
        return None
    return str(imageio_ffmpeg.get_ffmpeg_exe())


def _ffmpeg(path: Path) -> Save:
    program = find_ffmpeg()
    if program is None:
        raise MissingDependencyError(
            ".mp4 needs ffmpeg, which is not here; install ffmpeg, or pip install 'salver[video]', or name a file that "
            "ends in .gif."
        )

    def save(pictures: Iterator[np.ndarray], rate: float) -> None:
        first = next(pictures)
        height, width = first.shape[:2]
        with writing(path):
            path.parent.mkdir(parents=True, exist_ok=True)
        temporary = path.with_name(f".{path.stem}.tmp{path.suffix}")
        raw = ["-f", "rawvideo", "-pix_fmt", "rgb24", "-s", f"{width}x{height}", "-r", f"{rate:g}", "-i", "-"]
        codec = ["-c:v", "libx264", "-crf", "20", "-pix_fmt", "yuv420p", "-movflags", "+faststart"]
        command = [program, "-y", "-loglevel", "error", *raw, *codec, str(temporary)]
        with subprocess.Popen(command, stdin=subprocess.PIPE, stderr=subprocess.PIPE) as process:
            assert process.stdin is not None
            assert process.stderr is not None
            try:
                for picture in (first, *pictures):
                    process.stdin.write(np.ascontiguousarray(picture).tobytes())
                process.stdin.close()
            except BrokenPipeError:
                pass
            said = process.stderr.read().decode(errors="replace").strip()
        if process.returncode:
            temporary.unlink(missing_ok=True)
            raise SalverError(f"ffmpeg could not write {path}: {said.splitlines()[-1] if said else 'no reason given'}.")
        with writing(path):
            put_in_place(temporary, path, keep=True)

    return save


def _pillow(path: Path) -> Save:
    def save(pictures: Iterator[np.ndarray], rate: float) -> None:
        from PIL import Image

        images = [Image.fromarray(np.ascontiguousarray(p)).quantize(96) for p in pictures]
        content = io.BytesIO()
        milliseconds = max(20, round(1e3 / rate))  # browsers slow down what is quicker
        images[0].save(
            content, "gif", save_all=True, append_images=images[1:], duration=milliseconds, loop=0, optimize=True
        )
        write_atomic(path, content.getvalue(), keep=True)

    return save
