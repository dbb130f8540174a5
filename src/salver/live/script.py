"""What is wished of a live motion, written down: a line of JSON for each wish, said at its time.

    {"t": 0.0, "goto": [0.45, 0.1, 0.5]}                      first object's frame B, m in S; any heading
    {"t": 0.0, "goto": [...], "quat_wxyz": [1, 0, 0, 0]}      and its orientation; "queued": true: after goals before
    {"t": 1.0, "posture": [0.1, -0.8, ...]}                   rad; "queued" likewise
    {"t": 2.0, "twist": [0.1, 0, 0, 0.2], "for": 0.5}         m/s in S and rad/s about the vertical, or six numbers
    {"t": 3.0, "chunk": [0.1, 0.2], "positions": [[...], [...]]}   s from then; or "postures", rad; "quats_wxyz"
    {"t": 4.0, "stop": true}

t is in s from when the motion may begin, and never less than in the line before; without it the wish follows the one
before at once. A twist is said again and again for so long; without "for", once.
"""

from __future__ import annotations

import json
import queue
import threading
from collections import deque
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from salver.errors import SalverError, Status
from salver.geometry import matrix_from_quat_wxyz
from salver.live.live import Live
from salver.live.wishes import numbers

AGAIN = 0.02  # s after which a twist that lasts is said again
KEYS = {
    "goto": {"quat_wxyz", "queued"},
    "posture": {"queued"},
    "twist": {"for"},
    "chunk": {"positions", "quats_wxyz", "postures"},
    "stop": set(),
}
LONGEST = 3600.0  # s


@dataclass(frozen=True)
class Said:
    """One wish, at time t, s; None: at once. line: where it stands. Its numbers are judged by who is asked."""

    t: float | None
    line: int
    words: dict[str, Any]

    def to(self, live: Live) -> Status:
        """Wish it."""
        words = self.words
        queued = bool(words.get("queued", False))
        if "goto" in words:
            turned = words.get("quat_wxyz")
            pose = words["goto"] if turned is None else (words["goto"], _rotation(turned))
            return live.goto(pose, queued=queued)
        if "posture" in words:
            return live.goto(q=words["posture"], queued=queued)
        if "twist" in words:
            v, turn = words["twist"][:3], words["twist"][3:]
            return live.twist(v, turn if len(turn) == 3 else (0.0, 0.0, turn[0] if turn else 0.0))
        if "chunk" in words:
            if "postures" in words:
                return live.chunk(words["chunk"], joints=words["postures"])
            places, turned = words.get("positions"), words.get("quats_wxyz")
            poses: Any = places if turned is None else (places, [_rotation(quat) for quat in turned])
            return live.chunk(words["chunk"], poses)
        return live.stop()

    @property
    def lasts(self) -> float:
        """s for which it is said again and again."""
        return float(self.words.get("for", 0.0))


def _rotation(quat: Any) -> Any:
    found = numbers(quat, (4,), "a quaternion")
    if isinstance(found, Status) or not np.linalg.norm(found) > 0:
        return np.full((3, 3), np.nan)  # refused as a rotation that is none
    return matrix_from_quat_wxyz(found / np.linalg.norm(found))


def understood(text: str, line: int, source: str, last: float) -> Said:
    """A line of a script. last: time of the line before. Raises SalverError."""

    def wrong(what: str) -> SalverError:
        return SalverError(f"{source}, line {line}: {what}.")

    try:
        words = json.loads(text)
    except ValueError:
        raise wrong(f'{text[:60]!r} is no JSON; a line is like {{"t": 0.5, "goto": [0.45, 0.1, 0.5]}}') from None
    if not isinstance(words, dict):
        raise wrong("it is no object of JSON with names and values")
    found = [key for key in KEYS if key in words]
    if len(found) != 1:
        raise wrong(f"it has {' and '.join(found) or 'none'} of {', '.join(KEYS)}; a line has one of them")
    t = words.pop("t", None)
    unknown = sorted(set(words) - {found[0]} - KEYS[found[0]])
    if unknown:
        raise wrong(f'nobody knows what "{unknown[0]}" means beside {found[0]}')
    if t is not None and not (isinstance(t, int | float) and last <= t <= LONGEST):
        raise wrong(f"t is {t}; it must be a number of seconds from {last:g} on, the time of the line before")
    lasts = words.get("for", 0.0)
    if not (isinstance(lasts, int | float) and 0 <= lasts <= LONGEST):
        raise wrong(f"for is {lasts}; it must be a number of seconds, at least 0")
    twist = words.get("twist", [])
    if not (isinstance(twist, list) and len(twist) in (0, 3, 4, 6) and ("twist" not in words or twist)):
        raise wrong("twist must be three numbers, m/s, or those and one or three more, rad/s")
    return Said(None if t is None else float(t), line, words)


def script(lines: Iterable[str], source: str, first: int = 1) -> Iterator[Said]:
    """The wishes of a script, line by line, the first of which has that number; empty lines and those that begin with
    # say nothing. Raises SalverError."""
    last = 0.0
    for number, text in enumerate(lines, first):
        if not text.strip() or text.lstrip().startswith("#"):
            continue
        said = understood(text, number, source, last)
        last = last if said.t is None else said.t
        yield said


@dataclass
class Prompter:
    """Says what is wished at its time, one wish in a period, and notes what came of it.

    notes: {"t", "line", "said", "answer"} of each wish, and {"t", "answer"} of what was refused later on.
    """

    live: Live
    notes: list[dict[str, Any]] = field(default_factory=list)

    def __post_init__(self) -> None:
        self._coming: queue.SimpleQueue[Said | str | None] = queue.SimpleQueue()
        self._next: Said | None = None
        self._lasting: deque[tuple[Said, float]] = deque(maxlen=1)  # a twist, and until when
        self._again = 0.0
        self._ended = False
        self._refused = ""

    def of(self, wishes: Iterable[Said]) -> Prompter:
        """All of it is known."""
        for said in wishes:
            self._coming.put(said)
        self._coming.put(None)
        return self

    def listening(self, lines: Iterable[str], source: str) -> Prompter:
        """It comes while the arm moves; a line that cannot be understood is noted, and no more."""

        def listen() -> None:
            for number, text in enumerate(lines, 1):
                try:
                    for said in script([text], source, number):
                        self._coming.put(said)
                except SalverError as error:
                    self._coming.put(str(error))
            self._coming.put(None)

        threading.Thread(target=listen, name="salver-script", daemon=True).start()
        return self

    def period(self, t: float) -> None:
        """What is due at time t, s. From the robot's loop: it waits for nobody and never raises."""
        if self._next is None and not self._ended:
            try:
                coming = self._coming.get_nowait()
            except queue.Empty:
                coming = ""
            if coming is None:
                self._ended = True
            elif isinstance(coming, Said):
                self._next = coming
            elif coming:
                self.notes.append({"t": t, "answer": coming})
        said = self._next
        if said is not None and (said.t is None or t >= said.t - 1e-9) and t >= 0:
            self._next = None
            self._lasting.clear()
            self._say(said, t, noted=True)
            if said.lasts:
                self._lasting.append((said, t + said.lasts))
                self._again = t + AGAIN
        elif self._lasting and t >= self._again - 1e-9:
            said, until = self._lasting[0]
            self._again = t + AGAIN
            if t > until:
                self._lasting.clear()
            else:
                self._say(said, t, noted=False)
        told = self.live.refused
        if told != self._refused:
            self._refused = told
            if told and (not self.notes or self.notes[-1]["answer"] != told):
                self.notes.append({"t": t, "answer": told})

    def _say(self, said: Said, t: float, noted: bool) -> None:
        try:
            status = said.to(self.live)
        except Exception as error:  # what nobody foresaw in a wish is no reason to stop
            status = Status("refused", f"It could not be wished ({type(error).__name__}).", False)
        if noted or not status.ok:
            self._refused = self.live.refused
            words = status.sentence if status.ok else self.live.refused or status.sentence
            self.notes.append({"t": t, "line": said.line, "said": said.words, "answer": words})

    @property
    def over(self) -> bool:
        """Whether nothing more will be said."""
        return self._ended and self._next is None and not self._lasting
