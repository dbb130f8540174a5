"""The page of the studio and what it asks for: every answer follows from the text that a window sends, so that two
windows have nothing in common but the file in which they save."""

from __future__ import annotations

import shutil
import tempfile
import threading
from dataclasses import asdict, replace
from itertools import count
from pathlib import Path
from shlex import quote
from types import TracebackType
from typing import Any, Self

from salver.errors import SalverError, ScenarioError
from salver.files import write_atomic
from salver.models.arm.arm import load_arm
from salver.reports.pages.local_page import HTML, LocalPage, Shown, filled
from salver.reports.pages.page import write_report
from salver.reports.pages.replay import replay_scene
from salver.reports.pages.speed_bar import speed_bar
from salver.reports.run import read_run
from salver.studio.look import change, look
from salver.studio.parts import LOADS, OBSTACLES
from salver.studio.planner import PlanningProcess
from salver.studio.text import checked

LONGEST = 200_000  # bytes of a text that is edited


class Studio:
    """The page is served while it is entered."""

    def __init__(self, text: str, place: Path, folder: Path, *, saved: bool = False, port: int = 0) -> None:
        """text: the scenario that a window begins with. place: the file in which it is saved. folder: in which files
        are that the scenario names. saved: whether the text is what stands in the file.

        Raises SalverError when the port is taken.
        """
        self.text, self.place, self._folder = text, place, folder
        self._on_disk = text if saved else None
        self._looking, self._planners, self._numbers = threading.Lock(), dict[str, PlanningProcess](), count()
        self._plans: dict[str, Path] = {}
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
        self._served.close()
        for planner in self._planners.values():
            planner.close()
        self._room.cleanup()

    # --- what is shown

    def _show(self, what: str) -> Shown:
        if what == "":
            return self._page(), HTML
        kind, _, window = what.partition("/")
        directory = self._plans.get(window)
        if directory is None or kind not in ("report", "csv"):
            return None
        try:
            with self._looking:
                if kind == "report":
                    return write_report(directory).read_bytes(), HTML
                return self._export(directory), "text/csv; charset=utf-8"
        except SalverError as error:
            return str(error).encode(), "text/plain; charset=utf-8"

    def _export(self, directory: Path) -> bytes:
        from salver.export import write_export

        (path, *_) = write_export(directory, "csv", directory / "motion.csv", "plan", None)
        return path.read_bytes()

    def _page(self) -> bytes:
        data = {
            "text": self.text,
            "saved": self._on_disk == self.text,
            "place": str(self.place),
            "command": f"salver plan {quote(str(self.place))}",
            "loads": LOADS,
            "obstacles": OBSTACLES,
        }
        return filled("salver.studio", "studio", data, title=f"{self.place.name}, studio")

    # --- what is said

    def _say(self, message: Any) -> dict[str, Any]:
        """{"do": "look" | "plan" | "run" | "save" | "close", "text": ..., "window": ...} and, to look, "changes",
        "near" and "arm". Each answer has a "problem" when it could not be done."""
        try:
            if not isinstance(message, dict):
                raise ScenarioError("A message is a table.")
            do, text, window = (str(message.get(key, "")) for key in ("do", "text", "window"))
            if len(text.encode()) > LONGEST:
                raise ScenarioError(f"The text has more than {LONGEST // 1000} kB.")
            match do:
                case "look":
                    return self._look(message, text)
                case "plan":
                    return self._plan(text, window)
                case "run":
                    return self._run(window)
                case "save":
                    return self._save(text)
                case "close":
                    planner = self._planners.pop(window, None)
                    if planner is not None:
                        planner.close()
                    return {}
            raise ScenarioError(f"Nobody knows what {do[:40]} means.")
        except SalverError as error:
            return {"problem": str(error)}
        except Exception as error:  # one message that fails is no reason to end
            return {"problem": f"It failed ({type(error).__name__}: {error})."}

    def _look(self, message: dict[str, Any], text: str) -> dict[str, Any]:
        try:
            changes = [(list(key), value) for key, value in message.get("changes", [])]
        except (TypeError, ValueError):
            raise ScenarioError("changes is a list of keys and values.") from None
        with self._looking:  # the arm's work space is one
            after = change(text, self._folder, changes) if changes else text
            return look(after, self._folder, message.get("near"), str(message.get("arm", "")))

    def _plan(self, text: str, window: str) -> dict[str, Any]:
        scenario = checked(text, self._folder)
        if isinstance(scenario, list):
            return {"mistakes": [asdict(one) for one in scenario]}
        directory = Path(self._room.name) / str(next(self._numbers)) / scenario.name
        found = self._planners.setdefault(window, PlanningProcess()).plan(scenario, directory)
        if found is None:
            return {"ended": True}
        if "duration" not in found:
            return found
        before, self._plans[window] = self._plans.get(window), directory
        if before is not None:
            shutil.rmtree(before, ignore_errors=True)
        shown = self._replayed(directory)
        if "plan" not in (variant["key"] for variant in shown.get("variants", [])):
            found["sentence"] += " Shown is the straight line." if shown else " The arm cannot make it."
        return {**found, "speed_bar": str(speed_bar(found["speeds"])), **shown}

    def _run(self, window: str) -> dict[str, Any]:
        directory = self._plans.get(window)
        if directory is None:
            raise ScenarioError("Nothing is planned yet; plan first.")
        found = self._planners.setdefault(window, PlanningProcess()).run(directory)
        return {"ended": True} if found is None else {**found, **self._replayed(directory)}

    def _replayed(self, directory: Path) -> dict[str, Any]:
        """For the viewer: motions of a run directory that the arm can make, as planned or as the engine has them, and
        from when to when; nothing where there are none."""
        run = read_run(directory)
        can = [motion for motion in run.motions if run.scenario.arm is None or "q" in motion.arrays]
        if not can:
            return {}
        with self._looking:
            arm = None if run.scenario.arm is None else load_arm(run.scenario.arm, run.scenario.tray)
            scene = replay_scene(replace(run, motions=can), arm)
        return {"variants": scene["variants"], "start": scene["start"], "end": scene["duration"]}

    def _save(self, text: str) -> dict[str, Any]:
        """Written at once or not at all; not over what somebody else has written there meanwhile."""
        there = self.place.read_text(encoding="utf-8") if self.place.is_file() else None
        if there not in (None, self._on_disk, text):
            raise ScenarioError(
                f"{self.place} has changed since it was opened or saved here; move it away, or open it again."
            )
        write_atomic(self.place, text)
        self._on_disk = text
        return {"saved": str(self.place)}
