"""A motion that may be changed at any time, and never drops what it carries.

At every moment a motion is committed that was verified (`salver.planning.verdict.verify`) and ends at rest. It is only
ever replaced by another such motion that goes on from it. So nothing that planners, users or networks do, or fail to
do, can bring the load into danger: what is not verified is not committed, and when nothing new comes the arm comes to
rest.

Requests have a source. While what a source of higher priority requested is carried out, others are refused. A stop
latches: until it is lifted by `resume`, nothing but a motion to rest is committed, and every other request is refused.
A hold brings the arm to rest too, and keeps the requests: on `release` they are gone on with.

Two threads meet here, and neither waits for the other. The robot's loop calls `command`; whoever plans calls `plan`. A
new motion is laid before the loop, which alone decides whether it still comes in time.
"""

from __future__ import annotations

import contextlib
import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import numpy.typing as npt

from salver.errors import ScenarioError, Status
from salver.geometry import Array
from salver.live.committed.commit import verified
from salver.live.committed.motion import Committed, resting
from salver.live.committed.profile import STANDARD as SPEED
from salver.live.committed.seal import sealed
from salver.live.history import CommandHistory
from salver.live.reader import Reader
from salver.live.ready import Ready
from salver.live.replanning.lead import Lead
from salver.live.replanning.lookout import Lookout, LookoutOptions, Sighting
from salver.live.replanning.obstacles import Moving, ObstacleOptions, predicted
from salver.live.replanning.planner import Answer, Job, Planner
from salver.live.replanning.steer import TICK
from salver.live.replanning.wishes import (
    ACCEPTED,
    OPERATOR,
    PRIORITY,
    Evade,
    Follow,
    Goal,
    Halt,
    Pose,
    RequestOptions,
    Retime,
    Source,
    Wish,
    chunk_wish,
    factor_of,
    id_of,
    is_flag,
    is_source,
    numbers,
    pose_goal,
    posture_goal,
    refused,
    shown,
    twist_wish,
)
from salver.live.requests import Requests
from salver.live.running import Running
from salver.live.standing import live_scenario, standing
from salver.live.state import State
from salver.live.stopped import Hold, Stopped
from salver.models.arm.arm import with_load
from salver.planning.fastest import TransportProblem, transport_problem
from salver.scenario import Scenario, load
from salver.trajectory import JointMotion

EVADE = Evade()


@dataclass(frozen=True)
class LiveOptions:
    """What a live motion takes for an error, and for how long it tries.

    Attributes:
        longest_gap: s between two commands; a longer one is taken for a jump of the clock.
        strayed: rad or m by which a joint may be elsewhere than it was commanded to be, as measured.
        calming: s after a twist or a chunk has ended in which the motion is still steered, to rest; then it runs out.
            After hostile twists the tray goes on for 6 cm and 0.84 s (means); at 0, for 11 cm and 0.59 s.
        queued: goals at most.
        attempts: at a goal while the arm moves; once more from rest.
        record: s of the commanded motion that are kept, up to now, for `save`.
        requests, obstacles: what is accepted of these.
        lookout: at which instants the commanded motion is compared with moving obstacles.
    """

    longest_gap: float = 0.05
    strayed: float = 0.05
    calming: float = 0.3
    queued: int = 100
    attempts: int = 4
    record: float = 120.0
    requests: RequestOptions = field(default_factory=RequestOptions)
    obstacles: ObstacleOptions = field(default_factory=ObstacleOptions)
    lookout: LookoutOptions = field(default_factory=LookoutOptions)


class Live:
    """A motion that changes while the arm moves, and never drops its load (docs/howto/live.md)."""

    def __init__(
        self,
        scenario: Scenario | str | Path,
        q: npt.ArrayLike | None = None,
        *,
        robust: bool = True,
        lead: float | None = None,
        permit: Callable[[JointMotion], str] | None = None,
        options: LiveOptions | None = None,
    ) -> None:
        """Start at rest.

        Args:
            scenario: a Scenario with an arm, the name of a ready-made one, or the path of a TOML file.
            q: (n,) rad, the arm's posture; default: the scenario's start posture.
            robust: verify for the whole uncertain set; False: for the nominal parameters.
            lead: s from the beginning of planning to the hand-over; learnt from planning times if None.
            permit: called with a verified motion; returns why it must not be executed, or an empty text.
            options: what counts as an error, and for how long something is tried or kept.

        Raises:
            ScenarioError: the load is not safe at rest there, or the scenario has no arm.
        """
        scenario = scenario if isinstance(scenario, Scenario) else load(scenario)
        problem, rest = standing(transport_problem(live_scenario(scenario), robust=robust), q)
        self.options, self._robust, self._permit = options or LiveOptions(), robust, permit
        self._given_lead, self._planning = lead, threading.Lock()
        self._believe(problem)
        # Written by the loop alone.
        self._running = Running.first(rest, problem)
        self._reader = self._reader_of(self._running)
        self._history = CommandHistory(self.options.record, 0.0, self._running.path, self._running.since)
        self._now = 0.0  # live time of the last command
        self._last: float | None = None  # the clock then
        self._clock = ""
        # Written by whoever plans, taken by the loop.
        self._offer: Running | None = None
        self._offered: Running | None = None
        self._ready = Ready()
        # Written by whoever requests.
        self._stopped: Stopped | None = None  # read by the loop too, which takes nothing but a stop while there is one
        self._held: Hold | None = None  # read by the loop too
        self._factor = self._most = 1.0  # of full speed; and the most that the operator allows
        self._tried = -np.inf  # live time, s, when it was tried last to run what is committed at another factor
        self._astray = ""  # why the arm is not where it was commanded to be, as it was measured last
        self._refusals = 0
        self._halt: Running | None = None
        self._wish: Wish | None = None
        self._requests = Requests()
        self._queue: deque[Goal] = deque()
        self._heard: deque[tuple[float, Array]] = deque(maxlen=200)
        self._done: Wish | None = None
        self._attempts = 0
        self._refused = ""
        # What is predicted to pass. Nothing but a stop is committed that was not looked at in the newest sighting.
        self._sighting = Sighting()
        self._anew = threading.Lock()  # of whoever reports obstacles, another load or another posture
        # From which motion nothing more can be done, as of which news of what passes.
        self._resigned: tuple[Running | None, int] = (None, 0)
        self._unknown = False  # whether how it moves inside is not known any more
        self._look(self._running)
        self._reader.read(0.0)

    def _believe(self, problem: TransportProblem) -> None:
        """Plan, verify and look out for the load of a problem from now on."""
        self._problem, self._planner, self._lookout = problem, Planner(problem), Lookout(problem, self.options.lookout)
        # The same for the loop's thread: planners have work space that two threads must not share.
        out = problem.keep_out
        self._beside = replace(problem, keep_out=None if out is None else replace(out, parts=out.parts.apart()))
        self._inside = " and ".join(body.inside for body in problem.payload.dynamic)
        self._lead = Lead(self._given_lead, bool(self._inside))

    def _reader_of(self, running: Running) -> Reader:
        return Reader(with_load(self._problem.arm, self._problem.items).pin_model, running.pieces)

    # --- the robot's loop

    def command(self, t: float) -> tuple[Array, Array, Array, Array]:
        """Return the command at time t, s, of any clock that advances. Never waits and never raises.

        Times that go back, stand still, jump by more than `LiveOptions.longest_gap` or are not finite do not move the
        arm: the motion continues from where it was when the clock does.

        Returns:
            q, dq, ddq (n,) in rad, and the torque (n,) in N m with the nominal load; the next call overwrites them.
        """
        reader = self._reader
        try:
            last = self._last
            if last is None:
                if t - t == 0.0:
                    self._last = t
            else:
                step = t - last
                if 0.0 <= step <= self.options.longest_gap:
                    self._last = t
                    now = self._now + step
                    offer = self._halt or self._offer
                    if offer is not None:
                        in_time = offer.after is self._running.committed and self._now <= offer.committed.begins
                        wanted = in_time and self._wanted(offer.wish)
                        seen = isinstance(offer.wish, Halt) or offer.outlook.sighting is self._sighting
                        if wanted and seen and offer.keeps_clear:
                            reader.take(offer.pieces)
                            self._running = offer
                            self._history.take(now, offer.path, offer.since)
                            self._requests.becomes(id_of(offer.wish), "followed")
                        elif not in_time:
                            self._requests.becomes(id_of(offer.wish), "late")
                        if offer is self._halt:
                            self._halt = None
                        elif seen or not wanted:  # else it is being looked at
                            self._offer = None
                    reader.read(now)
                    self._now = now
                elif t - t == 0.0:
                    self._last = t
                    self._clock = "The clock jumped; the motion went on from where it was."
                    self._lose_sight()
                else:
                    self._clock = "A time was no number; the arm kept what it was told last."
        except Exception as error:  # what was commanded last stays commanded
            self._clock = f"A command failed ({type(error).__name__}); the arm kept what it was told last."
        return reader.q, reader.dq, reader.ddq, reader.tau

    def _wanted(self, wish: Wish | None) -> bool:
        """Whether a motion that was planned for a request may still be committed."""
        if isinstance(wish, Halt):
            return True
        if self._stopped is not None or self._held is not None:
            return False
        now = self._wish
        if wish is None or now is None or isinstance(wish, Evade):
            return True
        return not isinstance(now, Halt) and PRIORITY[wish.source] >= PRIORITY[now.source]

    # --- whoever requests

    def _unable(self, source: Source) -> str:
        """Why a request from a source cannot be carried out now, or nothing."""
        if not is_source(source):
            return f"source is {shown(source)}; it must be one of {', '.join(PRIORITY)}"
        stopped, wish = self._stopped, self._wish
        if stopped is not None:
            stopped.refused += 1
        if self._unknown:
            return self._lost
        if stopped is not None:
            why = f" ({stopped.reason.rstrip('.')})" if stopped.reason else ""
            return f"the arm was stopped by the {stopped.source}{why}; resume() comes first"
        if wish is None or PRIORITY[source] >= PRIORITY[wish.source]:
            return ""
        over = wish is self._done and not self._queue and self._now >= self.committed.ends
        return "" if over else f"what the {wish.source} requested is carried out first"

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
            A Status that says whether the goal is tried, or why not; `state` says what became of it.
        """
        if (pose is None) == (q is None):
            return self._refuse("a goal is a pose or a posture q, one of them", "The goal")
        if not is_flag(queued):
            return self._refuse(f"queued is {shown(queued)}; it must be True or False", "The goal")
        if unable := self._unable(source):
            return self._refuse(unable, "The goal")
        problem = self._problem
        goal = posture_goal(problem, q) if q is not None else pose_goal(problem, pose, self.options.requests)  # type: ignore[arg-type]
        if isinstance(goal, Status):
            return self._refuse(goal.sentence, "The goal")
        if queued and len(self._queue) >= self.options.queued:
            return self._refuse(f"{self.options.queued} goals are queued already, which is the most", "The goal")
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
        stopped, halt = self._stopped, Halt(source)
        if stopped is None:
            self._stopped = Stopped(str(reason), source, self._now, halt)
        else:
            pending = stopped.halt is not self._done
            self._stopped = stopped.again(str(reason), source, stopped.halt if pending else halt)
        self._drop(f"the {source} stopped the arm")
        self._halt = self._ready.soonest(self.committed, self._now)
        return ACCEPTED

    def resume(self, *, source: Source = OPERATOR) -> Status:
        """Lift the latched stop, without moving: requests are accepted again.

        Refused to a policy if the operator or the monitor stopped the arm, while the arm is not where it was commanded
        to be, and with what moves inside a load in an unknown state.
        """
        stopped = self._stopped
        if stopped is None:
            return ACCEPTED
        if not is_source(source):
            return self._refuse(self._unable(source), "To resume")
        if PRIORITY[source] < PRIORITY[stopped.source]:
            return self._refuse(f"the {stopped.source} stopped the arm", "To resume")
        if self._astray or self._unknown:
            return self._refuse(self._astray or self._lost, "To resume")
        self._refused = ""
        self._wish = stopped.halt  # to rest, until something else is requested
        self._stopped = None
        return ACCEPTED

    def hold(self, *, source: Source = OPERATOR) -> Status:
        """Come to rest as soon as the load allows, as `stop` does, and stay there until `release`; requests are kept.

        Requests that come meanwhile are carried out after it. A hold is never refused; an unknown source counts as the
        operator. A stop drops what is kept, and is lifted by `resume` alone.
        """
        source, held = source if is_source(source) else OPERATOR, self._held
        if held is not None:
            if PRIORITY[source] > PRIORITY[held.halt.source]:
                self._held = Hold(replace(held.halt, source=source), held.at)
            return ACCEPTED
        self._held = Hold(Halt(source), self._now)
        self._halt = self._ready.soonest(self.committed, self._now)
        if self._halt is not None:  # what was requested is to be planned anew, however soon it is released
            self._done = self._held.halt
        return ACCEPTED

    def release(self, *, source: Source = OPERATOR) -> Status:
        """End the hold: what was requested is gone on with, goals from where the arm is, a chunk with what is left.

        Refused to a policy if the operator holds the arm, and while a stop is latched.
        """
        held = self._held
        if self._stopped is not None or not is_source(source):
            return self._refuse(self._unable(source), "To release")
        if held is None:
            return ACCEPTED
        if PRIORITY[source] < PRIORITY[held.halt.source]:
            return self._refuse(f"the {held.halt.source} holds the arm", "To release")
        if isinstance(wish := self._wish, Follow):
            self._wish = wish.later(self._now - held.at)
        self._refused, self._held = "", None
        return ACCEPTED

    def override(self, factor: float, *, source: Source = OPERATOR) -> Status:
        """Go to goals at a factor of full speed, 0.05 to 1; twists and the times of chunks are scaled likewise.

        The motion to a goal that is under way changes its speed along its own path, as soon as the load allows; twists
        and chunks from the next one on. Stops and evasions are as fast as the load allows.
        """
        found = factor_of(factor)
        if unable := self._unable(source):
            return self._refuse(unable, "The override")
        if isinstance(found, Status):
            return self._refuse(found.sentence, "The override")
        if PRIORITY[source] >= PRIORITY[OPERATOR]:
            self._most = found
        elif found > self._most:
            return self._refuse(f"the operator allows {self._most:g} at most", "The override")
        self._refused, self._factor = "", found
        return ACCEPTED

    def twist(self, v: npt.ArrayLike, omega: npt.ArrayLike = (0.0, 0.0, 0.0), *, source: Source = OPERATOR) -> Status:
        """Move the tray at v_S (3,), m/s, and omega_S (3,), rad/s, as closely as safety allows.

        Repeat it: after 0.1 s of silence the tray comes to rest. source: as of `goto`.
        """
        if unable := self._unable(source):
            return self._refuse(unable, "The twist")
        wish = twist_wish(list(self._heard), v, omega, self._now, self._factor, self.options.requests)
        if isinstance(wish, Status):
            return self._refuse(wish.sentence, "The twist")
        before = self._wish
        goes_on = isinstance(before, Follow) and before.twist and before.source == source and self._now <= before.until
        wish = replace(wish, source=source, id=id_of(before) if goes_on else self._requests.new("twists"))
        self._heard.append((self._now, wish.wanted.twist))  # type: ignore[attr-defined]
        return self._follow(wish)

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
            source: as of `goto`.
        """
        if unable := self._unable(source):
            return self._refuse(unable, "The chunk")
        wish = chunk_wish(self._problem, times, poses, joints, self._now, self._factor, self.options.requests)
        if isinstance(wish, Status):
            return self._refuse(wish.sentence, "The chunk")
        wish = replace(wish, source=source, id=self._requests.new("a chunk"))
        answer = self._follow(wish)
        if isinstance(wish.ends, Goal):
            self._queue.append(replace(wish.ends, source=source, id=wish.id))
        elif wish.ends is not None:
            return replace(answer, sentence=f"Accepted, but for its end: {wish.ends.sentence.rstrip('.')}.")
        return answer

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

    def obstacles(self, seen: Sequence[Moving]) -> Status:
        """Report all moving obstacles as they are seen now.

        Report them again whenever the prediction changes; an obstacle that is not reported counts as gone when its
        prediction ends. The committed motion is checked against them before this returns: `state.passing`.
        """
        if not isinstance(seen, Sequence) or not all(isinstance(one, Moving) for one in seen):
            return self._refuse("it must be a list of Moving", "What was seen")
        if len({one.name for one in seen}) < len(seen):
            return self._refuse("each Moving must have a name of its own", "What was seen")
        if seen and not self._lookout.sees:
            return self._refuse("the arm has no geometry that could keep clear of it", "What was seen")
        with self._anew:
            now, clock, found = self._now, self._last, []
            for one in seen:
                prediction = predicted(one, now, clock, self.options.obstacles)
                if isinstance(prediction, Status):
                    return self._refuse(prediction.sentence, "What was seen")
                found.append(prediction)
            sighting = self._sighting.then(found, now)
            for running in (self._running, self._offer):
                if running is not None:
                    running.outlook = self._lookout.outlook(running.looked, sighting, now)
            self._sighting = sighting
            self._look(self._running)  # if it is another one by now
        return ACCEPTED

    def _look(self, running: Running) -> None:
        """Whether it keeps clear, as of the newest sighting."""
        while running.outlook.sighting is not (sighting := self._sighting):
            running.outlook = self._lookout.outlook(running.looked, sighting, self._now)

    def measured(self, q: npt.ArrayLike) -> Status:
        """Report the measured posture q (n,), rad.

        An arm too far from its command is stopped, until it is there again and `resume` is called; where something
        moves inside, whose state is then unknown, `restart` must come first.
        """
        seen = numbers(q, (self._problem.n,), "the measured posture")
        if isinstance(seen, Status):
            return self._refuse(seen.sentence, "A measurement")
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
        return refused(f"{astray}; the arm is stopped.")

    def restart(self, q: npt.ArrayLike, *, calm: bool = False) -> Status:
        """Start again from rest at q (n,), rad, where something else put the arm; pending requests are dropped.

        Call it from the robot's loop between two commands, which jump to q. A latched stop stays latched. Refused while
        the committed motion moves, and where the load is not safe at rest. calm: what moves inside is at rest; required
        where something does.
        """
        posture = numbers(q, (self._problem.n,), "the posture")
        if isinstance(posture, Status):
            return self._refuse(posture.sentence, "A restart")
        if self._now < self.committed.ends and not self.committed.at_rest:
            return self._refuse(f"the arm is at rest only in {self.committed.ends - self._now:.2f} s", "A restart")
        if self._inside and not calm:
            return self._refuse(f"{self._inside} may still move; say calm=True when it stands still", "A restart")
        with self._anew:
            rest = verified(self._beside, resting(posture), self._now, None)
            if rest.committed is None:
                return self._refuse(f"the load is not safe at rest there: {rest.sentence}", "A restart")
            self._begin(rest.committed, "the arm was started again elsewhere")
            self._reader.take(self._running.pieces)
            self._reader.read(self._now)
        return ACCEPTED

    def _begin(self, rest: Committed, why: str) -> None:
        """Rest, with nothing requested any more but a stop or a hold."""
        self._drop(why)
        self._wish, self._done, self._refused, self._attempts = None, None, "", 0
        self._unknown, self._astray = False, ""
        if isinstance(self._asked, Halt):  # the stop or the hold that is latched
            self._done = self._asked
        self._heard.clear()
        self._offer = self._offered = None
        running = Running.first(rest, self._problem)
        self._look(running)
        self._running = running
        self._history = CommandHistory(self.options.record, self._now, running.path, running.since)

    def load(self, scenario: Scenario | str | Path, *, calm: bool = False) -> Status:
        """Carry another load from now on, where the arm rests; it is believed only if it is verified to be safe there.

        Call it when something was taken off or put on, and stands still: from any thread but the robot's loop, because
        it waits for a verdict. Requests that are pending then are dropped. What is refused changes nothing.

        Args:
            scenario: the same arm and tray, with what is carried now; as of `Live`.
            calm: what moves inside it is at rest; required where something does.

        Returns:
            A Status that says whether it is believed, or why not.

        Raises:
            ScenarioError: there is no such scenario.
        """
        mine, what = self._problem.scenario, "The load"
        other = live_scenario(scenario if isinstance(scenario, Scenario) else load(scenario))
        if (other.arm, other.tray) != (mine.arm, mine.tray):
            return self._refuse("the arm or the tray of the scenario is another one", what)
        if other.payload.dynamic and not calm:
            return self._refuse("something moves inside it; say calm=True when it stands still", what)
        if not self._planning.acquire(blocking=False):
            return self._refuse("a motion is being planned; it comes after that", what)
        try:
            if not self.settled:
                return self._refuse("the arm moves, or is about to; it comes after that", what)
            if self._astray:
                return self._refuse(self._astray, what)
            running, q = self._running, self.committed.motion.q[-1]
            problem, rest = standing(transport_problem(other, robust=self._robust), q, self._now)
            with self._anew:
                if self._running is not running:
                    return self._refuse("the arm was started again elsewhere meanwhile", what)
                self._believe(problem)
                self._begin(rest, "another load is carried")
                reader = self._reader_of(self._running)
                reader.read(self._now)  # before the loop has it
                self._reader = reader
        except ScenarioError as error:
            return self._refuse(str(error), what)
        finally:
            self._planning.release()
        return ACCEPTED

    def save(self, path: str | Path, *, since: float = 0.0, rate: float = 1000.0) -> list[Path]:
        """Write what was commanded, up to now, as a motion file, which `salver audit` and `salver report` open.

        Args:
            path: ends in .csv, .json or .yaml, or in nothing (a ROS 2 bag); another file there is kept.
            since: live time, s, at which it begins; no more than `LiveOptions.record` s are kept.
            rate: samples a second; an audit of a fast motion needs 1000.

        Returns:
            The files. After `restart` or `load` the motion begins there.

        Raises:
            SalverError: nothing was commanded since then, another ending, or a rate that is not from 1 to 10000.
        """
        return self._history.save(path, self._problem, since, self._now, rate)

    def commanded(self, since: float = 0.0) -> JointMotion | None:
        """The commanded motion from a live time, s, to now; as much of it as is kept, None for nothing."""
        return self._history.motion(since, self._now)

    # --- whoever plans

    def plan(self, budget: float = 2.0, answer: Callable[[Job], Answer] | None = None) -> State:
        """Plan one step towards the request. Never raises; any thread may call it, one at a time.

        Args:
            budget: s that the step may take, roughly.
            answer: plans elsewhere; default: in this thread. Its proposal is verified here, unless it carries a valid
                seal (`salver.live.committed.seal`).
        """
        if self._planning.acquire(blocking=False):
            try:
                self._look(self._running)
                self._history.fold()
                self._step(budget, answer or self._planner.answer)
            except Exception as error:  # the committed motion does not depend on it
                self._refused = f"The planner failed ({type(error).__name__}: {error}); what was committed goes on."
                self._done = self._asked
                self._requests.becomes(id_of(self._done), "dropped", f"the planner failed ({type(error).__name__})")
            finally:
                self._planning.release()
        return self.state

    def prepare(self, budget: float = 2.0, answer: Callable[[Job], Answer] | None = None) -> bool:
        """Plan one more stop ahead, which `stop` takes without planning. Never raises; call it where `plan` is called.

        Returns:
            False when no stop is left to plan.
        """
        if not self._planning.acquire(blocking=False):
            return False
        try:
            return self._prepare(budget, answer or self._planner.answer)
        except Exception:  # a stop less; what is committed does not depend on it
            return False
        finally:
            self._planning.release()

    def _prepare(self, budget: float, answer: Callable[[Job], Answer]) -> bool:
        running, base = self._running, self.committed
        begins = self._hand_over(base, "motion", max(self._now + self.lead, self._ready.due(base)))
        if (
            self._offer is not None
            or isinstance(self._asked, Follow | Halt)
            or begins >= base.ends - self._ready.options.every
        ):
            return False
        self._ready.looked_at(begins)
        found = answer(Job(Halt(), base, begins, budget, self._sighting.obstacles)).found
        if found is not None and sealed(found, base, self._problem) and not self._denied(found):
            stop = running.then(found, Halt(), self._now, self._problem)
            self._look(stop)
            self._ready.add(stop, base)
        return True

    def _denied(self, found: Committed) -> str:
        """Why a motion is not to be done though it was verified; nothing when it is."""
        return "" if self._permit is None else self._permit(found.motion)

    @property
    def settled(self) -> bool:
        """Whether the arm rests and no request is left."""
        idle = self._asked in (None, self._done) and not self._queue and self._offer is None and self._halt is None
        return idle and (self._now >= self.committed.ends or self.committed.at_rest)

    @property
    def stray(self) -> Array:
        """(n,) rad, bound on each joint's deviation from the command under the uncertain set."""
        return self._running.allowed

    @property
    def idle(self) -> bool:
        """Whether there is nothing to plan until the loop has taken the last plan."""
        seen = self._running.outlook.sighting is self._sighting
        return seen and (self._offer is not None or self._due() is None)

    @property
    def state(self) -> State:
        """The State: resting, following or stopping, in words and figures."""
        committed, now = self.committed, self._now
        self._arrived()
        rests_in = max(0.0, committed.ends - now)
        margin, limit = committed.margins.from_(now)
        doing = (
            "resting"
            if not rests_in or committed.at_rest
            else "stopping"
            if isinstance(self._asked, Halt)
            else "following"
        )
        passing = self._running.outlook.sentence(now)
        stopped = "" if self._stopped is None else str(self._stopped)
        slow = "" if self._factor == 1.0 else f"Goals are gone to at {100 * self._factor:.3g} % of full speed."
        speed = " ".join(filter(None, ("" if self._held is None else str(self._held), slow)))
        return State(
            doing, rests_in, limit, margin, self._refused, self._clock, self.lead, passing, stopped, self._refusals,
            speed, self._requests.each,
        )  # fmt: skip

    @property
    def refused(self) -> str:
        """The last refused request, and why; empty when it was accepted."""
        return self._refused

    @property
    def stopped(self) -> str:
        """By whom and why the arm is stopped; empty without a latched stop."""
        return "" if self._stopped is None else str(self._stopped)

    @property
    def now(self) -> float:
        """Live time of the last command, s: that of the loop's clock that was commanded, from its first command on."""
        return self._now

    @property
    def committed(self) -> Committed:
        """The committed motion."""
        return self._running.committed

    @property
    def path(self) -> tuple[JointMotion, float]:
        """What is commanded from now to rest, and the live time of its own beginning, s, which is past."""
        return self._running.path, self._running.since

    @property
    def problem(self) -> TransportProblem:
        """The constraints by which motions are judged."""
        return self._problem

    @property
    def robust(self) -> bool:
        """Whether motions are verified for the whole uncertain set."""
        return self._robust

    @property
    def lead(self) -> float:
        """s from the beginning of planning to the hand-over."""
        return self._lead.of(_kind(self._asked))

    @property
    def _asked(self) -> Wish | None:
        """What is to be carried out: the stop that is latched, or the hold, else what was requested last."""
        stopped, held = self._stopped, self._held
        return stopped.halt if stopped is not None else held.halt if held is not None else self._wish

    def _due(self) -> Wish | None:
        """What is to be planned for now."""
        wish, offered = self._asked, self._offered
        if isinstance(wish, Halt) and (self._halt is not None or isinstance(self._running.wish, Halt)):
            self._done = wish  # by a stop that was ready
        if offered is not None and self._offer is None:
            self._offered = None
            if self._running is offered and not isinstance(offered.wish, Follow | Evade):
                self._done, self._attempts = offered.wish, 0
        running = self._running
        resigned = self._resigned == (running, self._sighting.news)
        free = self._stopped is None and self._held is None
        if running.outlook.sentence(self._now) and not resigned and free and self._offer is None:
            return EVADE
        if wish is not None and wish is not self._done:
            early = isinstance(wish, Follow) and self._hand_over(self.committed, "tick") <= self.committed.begins + 1e-9
            return None if early else wish
        if not free:
            return None
        if isinstance(running.wish, Goal) and self._now < running.committed.ends:
            another = running.committed.run.to != self._factor and self._now >= self._tried + SPEED.again
            return Retime(self._factor) if another else None
        if self._now >= self.committed.ends:
            with contextlib.suppress(IndexError):  # none is queued, or not any more
                self._arrived()
                self._wish = self._queue.popleft()
                return self._wish
        return None

    def _step(self, budget: float, answer: Callable[[Job], Answer]) -> None:
        wish = self._due()
        if wish is None or self._offer is not None:
            return
        running, began, kind = self._running, time.perf_counter(), _kind(wish)
        base, begins = running.committed, self._hand_over(running.committed, kind)
        if isinstance(wish, Goal):
            begins = self._hand_over(base, kind, max(begins, self._fits(base)))
        if isinstance(wish, Retime):
            self._tried = self._now
            if begins >= base.ends:
                return
        sighting, threats = self._sighting, running.outlook.near
        if isinstance(wish, Follow) and self._now > wish.until + self.options.calming:
            self._done = wish  # what is committed ends at rest
            if not isinstance(wish.ends, Goal):
                self._requests.ended(wish.id, "no safe motion towards it was found in time")
            return
        if isinstance(wish, Halt) and begins >= base.ends:
            self._done = wish
            return
        answered = answer(Job(wish, base, begins, budget, sighting.obstacles, threats, self._now, self._factor))
        found, status = answered.found, answered.status
        if found is not None and not sealed(found, base, self._problem):  # whoever proposed it
            again = verified(self._problem, found.motion, found.begins, base, profile=found.profile)
            found, status = again.committed, Status("refused", again.sentence, False)
        denied = "" if found is None else self._denied(found)
        if denied:
            found, status = None, Status("refused", denied, False)
        self._lead.took(kind, time.perf_counter() - began)
        if answered.done and not isinstance(wish, Evade):
            self._done = wish
        late = found is not None and found.begins < self._now and base.ends <= found.begins
        if late and found is not None:
            # It came late, but the arm was at rest and is: the same motion, from a little later on; unless swings,
            # which go on, are then such that it would not do.
            later = self._hand_over(base, "tick")
            profile = None if found.profile is None else replace(found.profile, begins=later)
            again = verified(self._problem, found.motion, later, base, profile=profile)
            found, status = again.committed, Status("refused", again.sentence, False)
        offered = None
        if found is not None:
            same = running.wish if isinstance(wish, Retime) else None  # as before, at another speed
            offered = running.then(found, same or wish, self._now, self._problem)
            offered.resigned = isinstance(wish, Halt | Evade)
            self._look(offered)
            if not offered.keeps_clear:
                if offered.outlook.sighting.news != sighting.news:
                    return  # it was planned for another world
                status, offered = Status("refused", offered.outlook.sentence(self._now), False), None
        if isinstance(wish, Evade):
            if answered.done or denied:
                self._resigned = (running, sighting.news)
            if offered is not None:
                self._offered = self._offer = offered
                self._done = None if isinstance(self._wish, Goal) else self._wish
        elif offered is not None:
            if not isinstance(wish, Halt):  # of a stop it stays said why the arm is stopped
                self._refused = ""
            self._offered = self._offer = offered
        elif wish is not self._done and kind == "motion":
            self._attempts += 1
            resting = begins >= base.ends and not late
            last = status.code == "unreachable" or resting or self._attempts >= self.options.attempts
            if last:
                self._done, self._attempts = wish, 0
                what = f"The goal {wish.what}" if isinstance(wish, Goal) else "The stop"
                self._requests.becomes(id_of(wish), "dropped", status.sentence.rstrip("."))
                self._refuse(status.sentence, what)

    def _fits(self, base: Committed) -> float:
        """Live time, s, from which on what is committed is no faster than goals are to be gone to."""
        run = base.run
        return base.ends if run.to > self._factor else min(run.settled, base.ends)

    def _hand_over(self, base: Committed, kind: str, earliest: float | None = None) -> float:
        """Live time of the next hand-over: the next tick, or where the base's deviation is known exactly."""
        begins = max(self._now + self._lead.of(kind) if earliest is None else earliest, base.begins)
        if kind == "tick":
            return TICK * float(np.ceil(begins / TICK - 1e-9))
        k = int(np.searchsorted(base.nodes, begins))
        return float(base.nodes[k]) if k < len(base.nodes) else begins

    def _refuse(self, reason: str, what: str) -> Status:
        self._refusals += 1
        self._refused = f"{what} is refused: {reason.rstrip('.')}."
        return refused(self._refused)


def accepted(number: int) -> Status:
    """The Status of a request that has a number."""
    return Status("accepted", "Accepted.", True, {"request": number})


def _kind(wish: Wish | None) -> str:
    """Which lead it has."""
    if isinstance(wish, Retime):
        return "speed"
    return "tick" if isinstance(wish, Follow | Evade) else "motion"
