"""The page of the studio and its requests: every answer depends only on the text that a window sends, so that two
windows share only the file in which they save."""

from __future__ import annotations

import json
import os
import shutil
import tempfile
import threading
from collections.abc import Generator, Mapping
from dataclasses import replace
from itertools import count
from pathlib import Path
from shlex import quote
from types import TracebackType
from typing import TYPE_CHECKING, Any, Self

from salver.errors import SalverError, ScenarioError
from salver.export import FORMATS, write_export
from salver.files import versions, write_atomic
from salver.planning.round import has_legs
from salver.reports.pages.cells import speed_bar
from salver.reports.pages.page import asset, fill, framed, write_report
from salver.reports.pages.replay import replay_scene
from salver.reports.run import ReportedRun, read_leg, read_run
from salver.scenario import Scenario
from salver.studio.local_page import HTML, LocalPage, Shown
from salver.studio.look import change, look
from salver.studio.parts import LOADS, OBSTACLES
from salver.studio.planner import PlanningProcess, motions
from salver.studio.text import LONGEST, checked
from salver.studio.words import PLANNING

if TYPE_CHECKING:
    from salver.studio.live_mode import LiveMode


class Studio:
    """The page is served while it is entered."""

    def __init__(
        self,
        text: str,
        place: Path,
        folder: Path,
        *,
        saved: bool = False,
        live: bool = False,
        true: Mapping[str, float] | None = None,
        port: int = 0,
    ) -> None:
        """text: the scenario that a window begins with. place: the file in which it is saved. folder: in which files
        are that the scenario names. saved: whether the text is what stands in the file. live: begin in the live mode.
        true: values there of parameters that are not nominal.

        Raises SalverError when the port is taken.
        """
        self.text, self.place, self._folder, self._begins_live = text, place, folder, live
        self._saved, self._true = saved, true
        self._looking, self._numbers = threading.Lock(), count()
        self._planners, self._plans = dict[str, PlanningProcess](), dict[str, tuple[str, Path]]()  # of windows
        self.lives: dict[str, LiveMode] = {}
        self._room = tempfile.TemporaryDirectory(prefix="salver-studio-")
        self._served = LocalPage(self._show, self._say, port, 2 * LONGEST)

    @property
    def url(self) -> str:
        return self._served.url

    def __enter__(self) -> Self:
        self._served.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        for window in {*self._planners, *self.lives}:
            self._close(window)
        self._served.close()
        self._room.cleanup()

    def _close(self, window: str, live: bool = True) -> None:
        """End what runs for a window. live: its live mode too."""
        for running in (self._planners.pop(window, None), self.lives.pop(window, None) if live else None):
            if running is not None:
                running.close()

    # --- what is shown

    def _show(self, what: str) -> Shown:
        if what == "":
            return self._page(), HTML
        kind, _, rest = what.partition("/")
        window, _, page = rest.partition("/")
        if kind == "frames" and window in self.lives:
            return self._frames(window)
        if window not in self._plans or kind not in ("report", *FORMATS):
            return None
        _, directory = self._plans[window]
        try:
            with self._looking:
                if page.startswith("report-leg"):
                    known = {f"report-{leg}.html" for leg in motions(directory)}
                    return ((directory / page).read_bytes(), HTML) if page in known else None
                if kind == "report":
                    return write_report(directory).read_bytes(), HTML
                return self._export(directory, kind)
        except SalverError as error:
            return str(error).encode(), "text/plain; charset=utf-8"

    def _frames(self, window: str) -> Generator[bytes]:
        """The world of a window's live mode runs while somebody watches it."""
        mine = self.lives[window]
        try:
            for frame in mine.frames():
                if self.lives.get(window) is not mine:
                    return
                yield json.dumps(frame, separators=(",", ":")).encode()
        finally:
            if self.lives.get(window) is mine:
                self._close(window)

    def _export(self, directory: Path, kind: str) -> tuple[bytes, str]:
        """The motion in a format; a folder as a ZIP file."""
        with tempfile.TemporaryDirectory() as room:
            target = Path(room) / f"motion{FORMATS[kind]}"
            write_export(directory, kind, target, "plan", None)
            if target.is_file():
                return target.read_bytes(), "application/octet-stream"
            return Path(shutil.make_archive(str(target), "zip", room, target.name)).read_bytes(), "application/zip"

    def _page(self) -> bytes:
        data = {
            "text": self.text,
            "saved": self._saved,
            "live": self._begins_live,
            "place": str(self.place),
            "command": f"salver plan {quote(str(self.place))}",
            "loads": LOADS,
            "obstacles": OBSTACLES,
            "formats": FORMATS,
            "planning": PLANNING,
        }
        own = "salver.studio"
        script = "".join([asset("viewer.js"), asset("plots.js"), asset("studio.js", own), asset("live.js", own)])
        body = fill(asset("studio.html", own), version=versions()["salver"])
        css = asset("page.css") + asset("studio.css", own)
        return framed(body, f"{self.place.name}, studio", data, script, css, "'self'").encode()

    # --- what is said

    def _say(self, message: Any) -> dict[str, Any]:
        """{"do": "look" | "plan" | "run" | "stops" | "campaign" | "save" | "live" | "hand" | "end" | "close",
        "text": ..., "window": ...}; to look, "changes", "near", "arm", "leg" and "coarse"; to save, "over"; of a hand,
        "say". Each answer has a "problem" when it could not be done."""
        try:
            if not isinstance(message, dict):
                raise ScenarioError("A message must be a JSON object.")
            do, text, window = (str(message.get(key, "")) for key in ("do", "text", "window"))
            if len(text.encode()) > LONGEST:
                raise ScenarioError(f"The text has more than {LONGEST // 1000} kB.")
            match do:
                case "look":
                    return self._look(message, text, window)
                case "plan":
                    return self._plan(text, window)
                case "run" | "stops" | "campaign":
                    return self._more(do, window)
                case "save":
                    return self._save(text, message.get("over"))
                case "live":
                    return self._live(text, window)
                case "hand" if window in self.lives:
                    status = self.lives[window].say(message.get("say"))
                    return {"ok": status.ok, "sentence": status.sentence}
                case "end" | "close":
                    self._close(window, live=do == "close")
                    return {}
            raise ScenarioError(f'There is no message "{do[:40]}".')
        except SalverError as error:
            return {"problem": str(error)}
        except Exception as error:  # one message that fails is no reason to end
            return {"problem": f"It failed ({type(error).__name__}: {error})."}

    def _look(self, message: dict[str, Any], text: str, window: str) -> dict[str, Any]:
        try:
            changes = [(list(key), value) for key, value in message.get("changes", [])]
        except (TypeError, ValueError):
            raise ScenarioError("changes is a list of keys and values.") from None
        with self._looking:  # the arm's work space is one
            after = change(text, self._folder, changes) if changes else text
            if window in self._plans and self._plans[window][0] != after:
                self._forget(window)
            leg = message.get("leg", 0)
            if not isinstance(leg, int):
                raise ScenarioError("leg is a whole number.")
            return look(
                after, self._folder, message.get("near"), str(message.get("arm", "")), leg, bool(message.get("coarse"))
            )

    def _forget(self, window: str) -> None:
        """The plan of a window: its text is no more."""
        _, directory = self._plans.pop(window, ("", None))
        if directory is not None:
            shutil.rmtree(directory, ignore_errors=True)

    def _plan(self, text: str, window: str) -> dict[str, Any]:
        scenario = self._checked(text)
        directory = Path(self._room.name) / str(next(self._numbers)) / scenario.name
        found = self._planners.setdefault(window, PlanningProcess()).plan(scenario, directory)
        if found is None:
            return {"ended": True}
        if "duration" not in found:
            return found
        self._forget(window)
        self._plans[window] = text, directory
        legs = self._replayed(directory)
        if any("plan" not in (variant["key"] for variant in shown.get("variants", [])) for shown in legs):
            level, head, detail = found["verdict"]
            instead = "Shown is the straight line." if legs[0] else "The arm cannot make it."
            found["verdict"] = level, head, f"{detail} {instead}"
        return {**found, "speed_bar": str(speed_bar(found["speeds"])) if "speeds" in found else "", "legs": legs}

    def _checked(self, text: str) -> Scenario:
        scenario = checked(text, self._folder)
        if isinstance(scenario, list):
            raise ScenarioError(f"Line {scenario[0].line}: {scenario[0].sentence}")
        return scenario

    def _more(self, what: str, window: str) -> dict[str, Any]:
        if window not in self._plans:
            raise ScenarioError("Nothing is planned yet; plan first.")
        _, directory = self._plans[window]
        found = self._planners.setdefault(window, PlanningProcess()).more(what, directory)
        return {"ended": True} if found is None else {**found, "legs": self._replayed(directory)}

    def _replayed(self, directory: Path) -> list[dict[str, Any]]:
        """For the viewer, of each leg of a run directory."""
        if not has_legs(directory):
            return [self._shown(read_run(directory))]
        return [self._shown(read_leg(directory, k + 1)) for k in range(len(motions(directory)))]

    def _shown(self, run: ReportedRun) -> dict[str, Any]:
        """Motions that the arm can make, as planned or as the engine has them, and from when to when; nothing where
        there are none."""
        can = [motion for motion in run.motions if run.scenario.arm is None or "q" in motion.arrays]
        if not can:
            return {}
        with self._looking:
            arm = None if run.scenario.arm is None else run.scenario.load_arm()
            scene = replay_scene(replace(run, motions=can), arm)
        return {"variants": scene["variants"], "start": scene["start"], "end": scene["duration"]}

    def _live(self, text: str, window: str) -> dict[str, Any]:
        from salver.studio.live_mode import LiveMode

        scenario = self._checked(text)
        self._close(window)
        with self._looking:
            self.lives[window] = LiveMode(scenario, self._true)
        return {"frame": self.lives[window].frame()}

    def _save(self, text: str, over: Any) -> dict[str, Any]:
        """Written at once or not at all. over: what the window takes to stand in the file, None for nothing: what
        somebody else has written there meanwhile is kept, and so is a file that may not be written."""
        place = self.place
        if place.exists():
            if not place.is_file() or not place.stat().st_mode & 0o222 or not os.access(place, os.W_OK):
                raise ScenarioError(f"{place} may not be written; allow that, or move it away.")
            if place.read_text(encoding="utf-8", errors="replace") not in (over, text):
                raise ScenarioError(
                    f"{place} has changed since it was opened or saved in this window; move it away, or open it again."
                )
        write_atomic(place, text)
        self.text, self._saved = text, True
        return {"saved": str(place)}
