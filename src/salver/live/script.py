"""A script of requests to a live motion: a line of JSON for each, which is made at its time.

    {"t": 0.0, "goto": [0.45, 0.1, 0.5]}                      first object's frame B, m in S; any heading
    {"t": 0.0, "goto": [...], "quat_wxyz": [1, 0, 0, 0]}      and its orientation; "queued": true: after goals before
    {"t": 1.0, "posture": [0.1, -0.8, ...]}                   rad; "queued" likewise
    {"t": 2.0, "twist": [0.1, 0, 0, 0.2], "for": 0.5}         m/s in S and rad/s about the vertical, or six numbers
    {"t": 2.6, "twist": [0.1, 0, 0], "frame": "tray"}         likewise, in the tray's own frame
    {"t": 2.8, "jog": [0.1, 0, ...], "for": 0.2}              joint velocities, rad/s or m/s
    {"t": 3.0, "chunk": [0.1, 0.2], "positions": [[...], [...]]}   s from then; or "postures", rad; "quats_wxyz"
    {"t": 4.0, "stop": true, "reason": "a hand is near"}      latches: every other request is refused until
    {"t": 5.0, "resume": true}
    {"t": 6.0, "override": 0.5}                               half of full speed, for goals, twists and chunks
    {"t": 7.0, "hold": true}                                  to rest; requests are kept, and gone on with after
    {"t": 8.0, "release": true}
    {"t": 9.0, "put": {"name": "crate", "type": "box", "position": [...], "size": [...]}}    stands there until
    {"t": 9.5, "remove": "crate"}

Each may have a "source": "operator" (the default) or "policy". t is in s from the instant at which the motion may
begin, and never less than in the line before; without it the request follows the one before at once. A twist is
repeated for the time "for", s, or until a line requests another motion or a rest; without "for" it is sent once. A stop
waits for no line before it: lines that were not carried out by then are dropped.
"""

from __future__ import annotations

import json
import threading
from collections import deque
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from itertools import takewhile
from typing import Any

import numpy as np

from salver.errors import SalverError, Status
from salver.geometry import matrix_from_quat_wxyz
from salver.live.live import Live
from salver.live.replanning.obstacles import Moving
from salver.live.replanning.wishes import OPERATOR, PRIORITY, Refused, is_flag, is_source, numbers

# What may stand beside each request, with "t" and "source".
KEYS = {
    "goto": {"quat_wxyz", "queued"},
    "posture": {"queued"},
    "twist": {"for", "frame"},
    "jog": {"for"},
    "chunk": {"positions", "quats_wxyz", "postures"},
    "stop": {"reason"},
    "resume": set(),
    "override": set(),
    "hold": set(),
    "release": set(),
    "put": set(),
    "remove": set(),
}
BESIDE = {"override", "put", "remove"}  # change what a motion must keep, and request none


@dataclass(frozen=True)
class ScriptOptions:
    """Limits of a script that is accepted.

    Attributes:
        again: s between repetitions of a twist.
        longest: s, largest time in a line.
        waiting: largest number of waiting lines, of those that come while the arm moves.
        notes: number of notes on the outcomes of lines that are kept.
        deepest: largest depth of nested lists in a line.
        shown: number of characters of a wrong value that a message quotes.
    """

    again: float = 0.02
    longest: float = 3600.0
    waiting: int = 1000
    notes: int = 10_000
    deepest: int = 3
    shown: int = 60


STANDARD = ScriptOptions()


@dataclass(frozen=True)
class Said:
    """One request, at time t, s; None: at once. line: its line in the script. `Live` checks its numbers."""

    t: float | None
    line: int
    words: dict[str, Any]

    def to(self, live: Live) -> Status:
        """Make the request."""
        words = self.words
        queued, source = words.get("queued", False), words.get("source", OPERATOR)
        if "goto" in words:
            turned = words.get("quat_wxyz")
            pose = words["goto"] if turned is None else (words["goto"], _rotation(turned))
            return live.goto(pose, queued=queued, source=source)
        if "posture" in words:
            return live.goto(q=words["posture"], queued=queued, source=source)
        if "twist" in words:
            v, turn = words["twist"][:3], words["twist"][3:]
            omega = turn if len(turn) == 3 else (0.0, 0.0, turn[0] if turn else 0.0)
            return live.twist(v, omega, frame=words.get("frame", "world"), source=source)
        if "jog" in words:
            return live.jog(words["jog"], source=source)
        if "chunk" in words:
            if "postures" in words:
                return live.chunk(words["chunk"], joints=words["postures"], source=source)
            places, turned = words.get("positions"), words.get("quats_wxyz")
            poses: Any = places if turned is None else (places, [_rotation(quat) for quat in turned])
            return live.chunk(words["chunk"], poses, source=source)
        if "override" in words:
            return live.override(words["override"], source=source)
        if "put" in words:
            return live.put(_obstacle(words["put"]), source=source)
        if "remove" in words:
            return live.remove(words["remove"], source=source)
        for say in (live.resume, live.hold, live.release):
            if say.__name__ in words:
                return say(source=source)
        return live.stop(words.get("reason", ""), source=source)

    @property
    def stops(self) -> bool:
        return "stop" in self.words

    @property
    def lasts(self) -> float:
        """Time for which it is repeated, s."""
        return float(self.words.get("for", 0.0))


def _obstacle(words: Any) -> Moving:
    known = {"name", "type", "position", "radius", "length", "size", "uncertainty"}
    if not isinstance(words, dict) or not {"name", "type"} <= set(words) <= known or not isinstance(words["name"], str):
        raise Refused(f"an obstacle has a name, a type and some of {', '.join(sorted(known - {'name', 'type'}))}")
    return Moving(**words)


def _rotation(quat: Any) -> Any:
    found = numbers(quat, (4,), "a quaternion")
    if not np.linalg.norm(found) > 0:
        raise Refused("a quaternion is zero")
    return matrix_from_quat_wxyz(found / np.linalg.norm(found))


def understood(text: str, line: int, source: str, last: float, options: ScriptOptions = STANDARD) -> Said:
    """A line of a script. last: time of the line before. Raises SalverError."""

    def wrong(what: str) -> SalverError:
        return SalverError(f"{source}, line {line}: {what}.")

    def shown(value: Any) -> str:
        """A value of JSON as it stands there, or its beginning."""
        text = json.dumps(value)
        return text if len(text) <= options.shown else f"{text[: options.shown]}..."

    def seconds(key: str, low: float, what: str) -> float | None:
        value = words.get(key)
        number = isinstance(value, int | float) and not is_flag(value)
        if value is not None and not (number and low <= value <= options.longest):
            raise wrong(f"{key} is {shown(value)}; it must be {what}, at most {options.longest:g}")
        return None if value is None else float(value)

    try:
        words = json.loads(text)
    except (ValueError, RecursionError):
        raise wrong(
            f'{text[: options.shown]!r} is not JSON; a line is like {{"t": 0.5, "goto": [0.45, 0.1, 0.5]}}'
        ) from None
    if not isinstance(words, dict):
        raise wrong("it is not a JSON object")
    if _deep(words, options.deepest):
        raise wrong("it is nested deeper than any request is")
    found = [key for key in KEYS if key in words]
    if len(found) != 1:
        raise wrong(f"it has {' and '.join(found) or 'none'} of {', '.join(KEYS)}; a line has one of them")
    t = seconds("t", last, f"a number of seconds from {last:g} on, the time of the line before")
    unknown = sorted(set(words) - {found[0], "t", "source"} - KEYS[found[0]])
    if unknown:
        raise wrong(f'"{unknown[0][: options.shown]}" is not a key of a line with {found[0]}')
    seconds("for", 0.0, "a number of seconds, at least 0")
    for key in ("stop", "resume", "hold", "release"):
        if key in words and words[key] is not True:
            raise wrong(f"{key} is {shown(words[key])}; it must be true")
    if not is_flag(words.get("queued", False)):
        raise wrong(f"queued is {shown(words['queued'])}; it must be true or false")
    if not isinstance(words.get("reason", ""), str):
        raise wrong(f"reason is {shown(words['reason'])}; it must be a text")
    if not is_source(by := words.get("source", OPERATOR)):
        raise wrong(f"source is {shown(by)}; it must be one of {', '.join(PRIORITY)}")
    twist = words.get("twist", [])
    if not (isinstance(twist, list) and len(twist) in (0, 3, 4, 6) and ("twist" not in words or twist)):
        raise wrong("twist must be three numbers, m/s, or those and one or three more, rad/s")
    words.pop("t", None)
    return Said(t, line, words)


def _deep(value: Any, most: int) -> bool:
    """Whether it is nested deeper than so."""
    inside = value.values() if isinstance(value, dict) else value if isinstance(value, list) else ()
    return most < 0 or any(_deep(one, most - 1) for one in inside)


def script(lines: Iterable[str], source: str, first: int = 1, options: ScriptOptions = STANDARD) -> Iterator[Said]:
    """The requests of a script, line by line; the first line has the number `first`. Empty lines and lines that begin
    with # are skipped. Raises SalverError."""
    last = 0.0
    for number, text in enumerate(lines, first):
        if not text.strip() or text.lstrip().startswith("#"):
            continue
        said = understood(text, number, source, last, options)
        last = last if said.t is None else said.t
        yield said


@dataclass
class Prompter:
    """Makes requests at their times, one in a period, and notes their outcomes. A stop comes first.

    notes: {"t", "line", "said", "answer"} of each request, and {"t", "answer"} of each later refusal; no more than
    `ScriptOptions.notes`. accepted, refused: numbers of requests; dropped: number of lines that a stop overtook, or
    that came when too many waited.
    """

    live: Live
    options: ScriptOptions = STANDARD
    notes: list[dict[str, Any]] = field(default_factory=list)
    accepted: int = 0
    refused: int = 0
    dropped: int = 0

    def __post_init__(self) -> None:
        # Filled by whoever listens, emptied by the loop: requests, and sentences about lines that cannot be understood.
        self._waiting: deque[Said | str] = deque()
        self._stops: deque[Said] = deque()  # those of them that wait for their time alone
        self._lasting: tuple[Said, float] | None = None  # a twist, and until when
        self._again = 0.0
        self._ended = False
        self._refusal = ""

    def of(self, wishes: Iterable[Said]) -> Prompter:
        """A prompter for a script that is known as a whole."""
        for said in wishes:
            self._add(said)
        self._ended = True
        return self

    def listening(self, lines: Iterable[str | bytes], source: str) -> Prompter:
        """A prompter for lines that come while the arm moves; a line that cannot be read is only noted."""

        def heard(text: str | bytes, number: int) -> list[Said | str]:
            try:
                return list(script([text.decode() if isinstance(text, bytes) else text], source, number, self.options))
            except UnicodeDecodeError:
                return [f"{source}, line {number}: it is no text in UTF-8."]
            except SalverError as error:
                return [str(error)]
            except Exception as error:  # what nobody foresaw in a line is no reason not to hear the next
                return [f"{source}, line {number}: it cannot be understood ({type(error).__name__})."]

        def listen() -> None:
            try:
                for number, text in enumerate(lines, 1):
                    for one in heard(text, number):
                        if self._full and not (isinstance(one, Said) and one.stops):
                            self.dropped += 1
                        else:
                            self._add(one)
            except Exception as error:
                self._add(f"{source} cannot be read any more ({type(error).__name__}: {error}).")
            self._ended = True

        threading.Thread(target=listen, name="salver-script", daemon=True).start()
        return self

    @property
    def _full(self) -> bool:
        """Whether too many lines wait; those that a stop overtakes at once do not count."""

        def kept(one: Said | str) -> bool:
            return not (isinstance(one, Said) and one.stops and one.t is None)

        return sum(1 for _ in takewhile(kept, reversed(tuple(self._waiting)))) >= self.options.waiting

    def _add(self, one: Said | str) -> None:
        """From one thread."""
        self._waiting.append(one)
        if isinstance(one, Said) and one.stops:
            self._stops.append(one)

    def period(self, t: float) -> None:
        """Make the request that is due at time t, s. For the robot's loop: never waits and never raises."""
        stop = next((one for one in tuple(self._stops) if t >= (one.t or 0.0) - 1e-9), None)
        if stop is not None:
            while self._stops.popleft() is not stop:
                pass
            while (one := self._waiting.popleft()) is not stop:
                if isinstance(one, str):
                    self._misunderstood(one, t)
                else:
                    self.dropped += 1
            self._begin(stop, t)
        elif self._waiting and self._due(self._waiting[0], t):
            one = self._waiting.popleft()
            if isinstance(one, str):
                self._misunderstood(one, t)
            else:
                self._begin(one, t)
        elif self._lasting is not None and t >= self._again - 1e-9:
            said, until = self._lasting
            self._again = t + self.options.again
            if t > until:
                self._lasting = None
            else:
                self._say(said, t, noted=False)
        told = self.live.refused
        if told != self._refusal:
            self._refusal = told
            if told and (not self.notes or self.notes[-1]["answer"] != told):
                self._note({"t": t, "answer": told})

    def _due(self, one: Said | str, t: float) -> bool:
        """Whether a waiting line is due at time t, s. Stops are not asked for here: only their own time counts."""
        return isinstance(one, str) or (not one.stops and t >= (one.t or 0.0) - 1e-9)

    def _misunderstood(self, sentence: str, t: float) -> None:
        self.refused += 1
        self._note({"t": t, "answer": sentence})

    def _note(self, note: dict[str, Any]) -> None:
        if len(self.notes) < self.options.notes:
            self.notes.append(note)

    def _begin(self, said: Said, t: float) -> None:
        """Make a request; one for a motion or a rest ends a twist that lasts."""
        if BESIDE.isdisjoint(said.words):
            self._lasting = (said, t + said.lasts) if said.lasts else None
            self._again = t + self.options.again
        self._say(said, t, noted=True)

    def _say(self, said: Said, t: float, noted: bool) -> None:
        try:
            status = said.to(self.live)
        except Refused as reason:
            status = Status("refused", f"The request is refused: {reason}.", False)
        except Exception as error:  # what nobody foresaw in a request is no reason to stop
            status = Status("refused", f"It could not be requested ({type(error).__name__}).", False)
        if noted:
            self.accepted, self.refused = self.accepted + status.ok, self.refused + (not status.ok)
        if noted or not status.ok:
            self._refusal = self.live.refused
            self._note({"t": t, "line": said.line, "said": said.words, "answer": status.sentence})

    @property
    def over(self) -> bool:
        """Whether no further request will come."""
        return self._ended and not self._waiting and self._lasting is None
