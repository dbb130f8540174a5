"""Requests to a live motion: which source may make them, how they are carried out, and their outcomes.

Requests have a source. While a request of a source with higher priority is carried out, others are refused. A stop
latches: until it is lifted by `resume`, nothing but a motion to rest is committed, and every other request is refused.
A hold brings the arm to rest too, and keeps the requests, which `release` continues.
"""

from __future__ import annotations

from abc import abstractmethod
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import wraps
from typing import Any, TypeVar

import numpy as np
import numpy.typing as npt

from salver.errors import Status
from salver.geometry import Array
from salver.live.commanded import Commanded
from salver.live.options import LiveOptions
from salver.live.reader import Reader
from salver.live.ready import Ready
from salver.live.replanning.objective import JointsWanted, TwistWanted
from salver.live.replanning.wishes import (
    ACCEPTED,
    OPERATOR,
    PRIORITY,
    Follow,
    Frame,
    Goal,
    Halt,
    Pose,
    Refused,
    Source,
    UserWish,
    Wish,
    chunk_wish,
    factor_of,
    id_of,
    is_flag,
    is_source,
    known,
    numbers,
    pose_goal,
    posture_goal,
    rates_of,
    shown,
    stream_wish,
    twist_of,
)  # fmt: skip
from salver.live.requests import Request
from salver.live.running import Running
from salver.live.stopped import Hold, Stopped
from salver.planning.fastest import TransportProblem

Requesting = TypeVar("Requesting", bound=Callable[..., Status])


def answers(what: str) -> Callable[[Requesting], Requesting]:
    """A decorator for requests: their Status says why if they raise `Refused`. what: name of the refused request."""

    def of(request: Requesting) -> Requesting:
        @wraps(request)
        def answered(self: Requested, *given: Any, **named: Any) -> Status:
            try:
                return request(self, *given, **named)
            except Refused as reason:
                return self._refuse(str(reason), what)

        return answered  # type: ignore[return-value]

    return of


class Requested(Commanded):
    """The commanded motion and the requests that change it."""

    def __init__(self, options: LiveOptions, problem: TransportProblem, running: Running, reader: Reader) -> None:
        super().__init__(options, problem, running, reader)
        # Written by whoever requests.
        self._stopped: Stopped | None = None  # read by the loop too, which takes nothing but a stop while there is one
        self._held: Hold | None = None  # read by the loop too
        self._factor = self._most = 1.0  # of full speed; and the most that the operator allows
        self._astray = ""  # why the arm is not where it was commanded to be, as it was measured last
        self._unknown = False  # whether how it moves inside is not known any more
        self._refused, self._refusals = "", 0
        self._wish: UserWish | None = None
        self._queue: deque[Goal] = deque()
        self._heard: deque[tuple[float, Array]] = deque(maxlen=200)
        # Written by whoever plans.
        self._ready = Ready(self.options.ready)
        self._offered: Running | None = None
        self._done: Wish | None = None

    @property
    @abstractmethod
    def _inside(self) -> str:
        """The liquid or pendulum in the load, in words."""

    def _wanted(self, running: Running) -> bool:
        wish, now = running.wish, self._wish
        if isinstance(wish, Halt):
            return True
        if self._stopped is not None or self._held is not None:
            return False
        if now is None or not isinstance(wish, Goal | Follow):
            return True
        return not isinstance(now, Halt) and PRIORITY[wish.source] >= PRIORITY[now.source]

    def _check(self, source: Source) -> None:
        """Raises Refused where a request from a source cannot be carried out now."""
        known(source)
        stopped, wish = self._stopped, self._wish
        if stopped is not None:
            stopped.refused += 1
        if self._unknown:
            raise Refused(self._lost)
        if stopped is not None:
            why = f" ({stopped.reason.rstrip('.')})" if stopped.reason else ""
            raise Refused(f"the arm was stopped by the {stopped.source}{why}; call resume() first")
        pending: list[UserWish] = list(self._queue)
        if wish is not None and not (wish is self._done and self._now >= self.committed.ends):
            pending.append(wish)
        for one in pending:
            if PRIORITY[source] < PRIORITY[one.source]:
                raise Refused(f"a request of the {one.source} is carried out first")

    @answers("The goal")
    def goto(
        self,
        pose: Pose | None = None,
        *,
        q: npt.ArrayLike | None = None,
        queued: bool = False,
        source: Source = OPERATOR,
    ) -> Status:
        """Request a goal at rest.

        Args:
            pose: position p_SB (3,), m, of the first object's frame B, with any heading; or (p_SB, R_SB).
            q: (n,) rad, a posture instead of a pose.
            queued: after the goals before; False: instead of them.
            source: "operator" or "policy".

        Returns:
            A Status that says whether the goal is accepted, or why not; `state` has its outcome.
        """
        if (pose is None) == (q is None):
            raise Refused("a goal is a pose or a posture q, one of them")
        if not is_flag(queued):
            raise Refused(f"queued is {shown(queued)}; it must be True or False")
        self._check(source)
        problem = self._problem
        goal = posture_goal(problem, q) if q is not None else pose_goal(problem, pose, self.options.requests)  # type: ignore[arg-type]
        if queued and len(self._queue) >= self.options.queued:
            raise Refused(f"{self.options.queued} goals are queued already, the most that are accepted")
        goal = replace(goal, source=source, id=self._requests.new(f"to {goal.what}"))
        self._refused = ""
        if queued:
            self._queue.append(goal)
        else:
            self._drop(f"request {goal.id} came instead")
            self._wish = goal
        return accepted(goal.id)

    def stop(self, reason: str = "", *, source: Source = OPERATOR) -> Status:
        """Come to rest as soon as the load allows, and refuse every other request until `resume`.

        A stop that is ready (`prepare`) begins in the next period; else one is planned. The committed motion ends at
        rest in any case. A stop is never refused; an unknown source counts as the operator.
        """
        source = source if is_source(source) else OPERATOR
        reason = reason if isinstance(reason, str) else shown(reason)
        stopped, halt = self._stopped, Halt(source)
        if stopped is None:
            self._stopped = Stopped(reason, source, halt)
        else:
            pending = stopped.halt is not self._done
            self._stopped = stopped.again(reason, source, stopped.halt if pending else halt)
        self._drop(f"the {source} stopped the arm")
        self._halt = self._ready.soonest(self.committed, self._now, self._sighting)
        return ACCEPTED

    @answers("To resume")
    def resume(self, *, source: Source = OPERATOR) -> Status:
        """Lift the latched stop, without moving: requests are accepted again.

        Refused to a policy if the operator or the monitor stopped the arm; to all while the arm is not where it was
        commanded to be, or the state of a liquid or pendulum is unknown.
        """
        stopped = self._stopped
        if stopped is None:
            return ACCEPTED
        if PRIORITY[known(source)] < PRIORITY[stopped.source]:
            raise Refused(f"the {stopped.source} stopped the arm")
        if self._astray or self._unknown:
            raise Refused(self._astray or self._lost)
        self._refused = ""
        self._wish = stopped.halt  # to rest, until something else is requested
        self._stopped = None
        return ACCEPTED

    def hold(self, *, source: Source = OPERATOR) -> Status:
        """Come to rest as soon as the load allows, as `stop` does, and stay there until `release`; requests are kept.

        Requests that come meanwhile are carried out after it. A hold is never refused; an unknown source counts as the
        operator. A stop drops the kept requests, and only `resume` lifts it.
        """
        source, held = source if is_source(source) else OPERATOR, self._held
        if held is not None:
            if PRIORITY[source] > PRIORITY[held.halt.source]:
                self._held = Hold(replace(held.halt, source=source), held.at)
            return ACCEPTED
        self._held = Hold(Halt(source), self._now)
        self._halt = self._ready.soonest(self.committed, self._now, self._sighting)
        if self._halt is not None:  # what was requested is to be planned anew, however soon it is released
            self._done = None
        return ACCEPTED

    @answers("To release")
    def release(self, *, source: Source = OPERATOR) -> Status:
        """End the hold and continue the requests: a goal from where the arm is, a chunk with its remaining part.

        Refused to a policy if the operator holds the arm, and while a stop is latched.
        """
        held = self._held
        if self._stopped is not None:
            self._check(source)
        if held is None:
            return ACCEPTED
        if PRIORITY[known(source)] < PRIORITY[held.halt.source]:
            raise Refused(f"the {held.halt.source} holds the arm")
        if isinstance(wish := self._wish, Follow):
            self._wish = wish.later(self._now - held.at)
        self._refused, self._held = "", None
        return ACCEPTED

    @answers("The override")
    def override(self, factor: float, *, source: Source = OPERATOR) -> Status:
        """Set the share of full speed, 0.05 to 1, for motions to goals; twists and the times of chunks are scaled
        likewise.

        A motion to a goal changes its speed along its own path as soon as the load allows; twists and chunks are scaled
        from the next one on. Stops and evasions are as fast as the load allows.
        """
        self._check(source)
        found = factor_of(factor, self.options.planner.speed.least)
        if PRIORITY[source] >= PRIORITY[OPERATOR]:
            self._most = found
        elif found > self._most:
            raise Refused(f"the operator allows {self._most:g} at most")
        self._refused, self._factor = "", found
        return ACCEPTED

    @answers("The twist")
    def twist(
        self,
        v: npt.ArrayLike,
        omega: npt.ArrayLike = (0.0, 0.0, 0.0),
        *,
        frame: Frame = "world",
        source: Source = OPERATOR,
    ) -> Status:
        """Move the tray at v (3,), m/s, and omega (3,), rad/s, as closely as safety allows.

        Repeat it: after 0.1 s of silence the tray comes to rest.

        Args:
            v, omega: velocity, m/s, and angular velocity, rad/s, of the tray's centre.
            frame: "world": both in S. "tray": in the tray's own frame E, as it is commanded now.
            source: as in `goto`.
        """
        self._check(source)
        if not isinstance(frame, str) or frame not in ("world", "tray"):
            raise Refused(f"frame is {shown(frame)}; it must be world or tray")
        R = self._problem.arm.tray_rotation(self._reader.q) if frame == "tray" else None
        return self._stream(twist_of(v, omega, R, self.options.requests), TwistWanted, "twists", source)

    @answers("The jogging")
    def jog(self, dq: npt.ArrayLike, *, source: Source = OPERATOR) -> Status:
        """Move the joints at dq (n,), rad/s or m/s, as closely as safety allows.

        Repeat it: after 0.1 s of silence the arm comes to rest. source: as in `goto`.
        """
        self._check(source)
        return self._stream(
            rates_of(self._problem, dq, self.options.requests), JointsWanted, "joint velocities", source
        )

    def _stream(self, latest: Array, kind: type[JointsWanted], what: str, source: Source) -> Status:
        """Follow velocities (m,) of a kind, unless others come: one request while they follow one another."""
        before, now, wanted = self._wish, self._now, self._factor * latest
        goes_on = isinstance(before, Follow) and type(before.wanted) is kind and before.source == source
        goes_on = goes_on and now <= before.until  # type: ignore[union-attr]
        if not goes_on:
            self._heard.clear()
        wish = stream_wish(list(self._heard), wanted, now, kind, self.options.requests)
        wish = replace(wish, source=source, id=id_of(before) if goes_on else self._requests.new(what))
        self._heard.append((now, wanted))
        return self._follow(wish)

    @answers("The chunk")
    def chunk(
        self,
        times: npt.ArrayLike,
        poses: npt.ArrayLike | tuple[npt.ArrayLike, npt.ArrayLike] | None = None,
        *,
        joints: npt.ArrayLike | None = None,
        source: Source = OPERATOR,
    ) -> Status:
        """Follow a chunk of poses or postures as closely as safety allows, and hold the last one.

        If the last one could not be reached in time, it becomes a goal.

        Args:
            times: (C,) s from now.
            poses: of the first object's frame B: p_SB (C, 3) with the tray level, or (p_SB, R_SB (C, 3, 3)).
            joints: (C, n) rad, postures instead of poses.
            source: as in `goto`.
        """
        self._check(source)
        wish = chunk_wish(self._problem, times, poses, joints, self._now, self._factor, self.options.requests)
        wish = replace(wish, source=source, id=self._requests.new("a chunk"))
        answer = self._follow(wish)
        if isinstance(wish.ends, Goal):
            self._queue.append(replace(wish.ends, source=source, id=wish.id))
            return answer
        return replace(answer, sentence=f"Accepted, but for its end: {wish.ends}.")

    @answers("A measurement")
    def measured(self, q: npt.ArrayLike) -> Status:
        """Report the measured posture q (n,), rad.

        An arm that is too far from its command is stopped, until it is back there and `resume` is called. With a liquid
        or pendulum, whose state is then unknown, `restart` must come first.
        """
        seen = numbers(q, (self._problem.n,), "the measured posture")
        away = np.abs(seen - self._reader.q)
        if away.max() <= self.options.strayed:
            self._astray = ""
            return ACCEPTED
        arm, j = self._problem.arm, int(np.argmax(away))
        astray = f"{arm.joint_names[j]} is {away[j]:.3f} {arm.unit(j)} from where it was commanded to be"
        if not self._astray:  # the reason is that of the first time
            self.stop(astray, source="monitor")
            self._lose_sight()
        self._astray = astray
        return Refused(f"{astray}; the arm is stopped.").status

    @property
    def _lost(self) -> str:
        return f"how {self._inside} moves is not known any more; restart(q, calm=True) when it stands still"

    def _lose_sight(self) -> None:
        """How loads move inside is not known any more: the arm is to come to rest, and to wait for `restart`."""
        if self._inside:
            self._unknown = True
            self.stop(self._lost, source="monitor")

    def _follow(self, wish: Follow) -> Status:
        held, self._refused = self._held, ""
        if id_of(self._wish) != wish.id:
            self._drop(f"request {wish.id} came instead")
        # On release it is put off by the whole hold, of which only the rest is to come.
        self._wish = wish if held is None else wish.later(held.at - self._now)
        return accepted(wish.id)

    def _drop(self, why: str) -> None:
        """Nothing that was requested is carried out any more."""
        self._arrived()
        for wish in (self._wish, *self._queue):
            if isinstance(wish, Follow) and not isinstance(wish.ends, Goal):
                self._requests.ended(wish.id, why)
            else:
                self._requests.becomes(id_of(wish), "dropped", why)
        self._queue.clear()

    def _arrived(self) -> None:
        """Note it when the arm rests where it was to go."""
        wish, taken = self._wish, self._offered is self._running  # such as a hold that followed on it
        if isinstance(wish, Goal) and wish is self._done and self._now >= self.committed.ends and not taken:
            self._requests.becomes(wish.id, "reached")

    def outcomes(self) -> Iterator[list[Request]]:
        """Each `next` returns the requests that are new, or whose outcome has changed, since the call before; it never
        waits. Of more than 200 requests between two calls only the latest 200 are known."""
        known: dict[int, Request] = {}
        while True:
            self._arrived()
            each = self._requests.each
            yield [one for one in each if known.get(one.id) != one]
            known = {one.id: one for one in each}

    @property
    def refused(self) -> str:
        """The last refused request, and why; empty when it was accepted."""
        return self._refused

    @property
    def stopped(self) -> str:
        """Who stopped the arm, and why; empty without a latched stop."""
        return "" if self._stopped is None else str(self._stopped)

    @property
    def _asked(self) -> Wish | None:
        """The request to carry out: the latched stop, or the hold, or else the latest request."""
        stopped, held = self._stopped, self._held
        return stopped.halt if stopped is not None else held.halt if held is not None else self._wish

    def _refuse(self, reason: str, what: str) -> Status:
        self._refusals += 1
        self._refused = f"{what} is refused: {reason.rstrip('.')}."
        return Status("refused", self._refused, False)


def accepted(number: int) -> Status:
    """The Status of an accepted request, with its number."""
    return Status("accepted", "Accepted.", True, {"request": number})
