"""A motion that may be changed at any time and never drops its load.

At every moment a motion is committed that was verified (`salver.planning.verdict.verify`) and ends at rest. Only
another such motion that continues it can replace it. So no error of planners, users or networks can endanger the load:
a motion that is not verified is not committed, and when no new one comes the arm comes to rest.

The robot's loop calls `command` (`salver.live.commanded`), users make requests (`salver.live.requested`), and the
planning thread calls `plan`, here.
"""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Callable, Container, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import numpy.typing as npt

from salver.errors import ScenarioError, Status
from salver.live.committed.commit import verified
from salver.live.committed.motion import Committed, resting
from salver.live.committed.seal import sealed
from salver.live.history import CommandHistory
from salver.live.options import LiveOptions
from salver.live.reader import Reader
from salver.live.replanning.lead import Lead
from salver.live.replanning.lookout import Lookout
from salver.live.replanning.objective import JointsWanted
from salver.live.replanning.obstacles import Moving, Predicted, predicted
from salver.live.replanning.planner import Answer, Job, Planner
from salver.live.replanning.wishes import (
    ACCEPTED,
    OPERATOR,
    PRIORITY,
    Evade,
    Follow,
    Goal,
    Halt,
    Refused,
    Retime,
    Source,
    Wish,
    id_of,
    known,
    numbers,
    shown,
)
from salver.live.requested import Requested, answers
from salver.live.running import Running
from salver.live.standing import live_scenario, standing
from salver.live.state import LIMITING, State
from salver.models.arm.arm import with_load
from salver.planning.fastest import TransportProblem, transport_problem
from salver.scenario import Scenario, load
from salver.trajectory import JointMotion

EVADE = Evade()


class Live(Requested):
    """A motion that changes while the arm moves, and never drops its load (docs/howto/live.md).

    Examples:
        >>> sv.Live("panda-cube").goto((0.45, 0.1, 0.5)).ok
        True
    """

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
        options = options or LiveOptions()
        problem, rest = standing(transport_problem(live_scenario(scenario), robust=robust), q)
        running = Running.first(rest, problem)
        super().__init__(options, problem, running, _reader_of(running, problem))
        self._robust, self._permit = robust, permit
        self._given_lead, self._planning = lead, threading.Lock()
        self._tried = -np.inf  # live time, s, when it was tried last to run what is committed at another factor
        self._failed: tuple[Wish | None, int] = (None, 0)  # whose motion was not found the last times, and how often
        self._anew = threading.Lock()  # of whoever reports obstacles, another load or another posture
        self._seen: list[Predicted] = []  # as it was reported last
        self._standing: dict[str, tuple[Predicted, Source]] = {}  # and who put it there
        # From which motion nothing more can be done, as of which news of what passes.
        self._resigned: tuple[Running | None, int] = (None, 0)
        self._believe(problem)
        self._look(running)

    def _believe(self, problem: TransportProblem) -> None:
        """Plan, verify and look out for the load of a problem from now on."""
        self._problem, self._planner = problem, Planner(problem, self.options.planner)
        self._lookout = Lookout(problem, self.options.lookout)
        # The same for the loop's thread: planners have work space that two threads must not share.
        out = problem.keep_out
        self._beside = replace(problem, keep_out=None if out is None else replace(out, parts=out.parts.apart()))
        self._lead = Lead(self._given_lead, bool(self._inside), self.options.lead)

    @property
    def _inside(self) -> str:
        return " and ".join(body.inside for body in self._problem.payload.dynamic)

    @answers("What was seen")
    def obstacles(self, seen: Sequence[Moving]) -> Status:
        """Report all moving obstacles as they are seen now.

        Report them again whenever the prediction changes; an obstacle that is not reported counts as gone when its
        prediction ends. The committed motion is checked against them before this returns: `state.passing`.
        """
        if not isinstance(seen, Sequence) or not all(isinstance(one, Moving) for one in seen):
            raise Refused("it must be a list of Moving")
        with self._anew:
            names = [one.name for one in seen]
            self._seen = [self._predicted(one, [*self._standing, *names[:k]]) for k, one in enumerate(seen)]
            self._sight()
        return ACCEPTED

    @answers("The obstacle")
    def put(self, obstacle: Moving, *, source: Source = OPERATOR) -> Status:
        """Add an obstacle that stands still, or move the one of that name; it stays until `remove`, so that a cell can
        be edited while the arm moves. `obstacles` does not change it; a policy may not move what an operator put."""
        if not isinstance(obstacle, Moving):
            raise Refused("it must be a Moving")
        with self._anew:
            found = self._predicted(obstacle, [x.name for x in self._seen]).standing()
            self._may_change(found.name, source)
            self._standing[found.name] = found, source
            self._sight()
        return ACCEPTED

    @answers("To remove an obstacle")
    def remove(self, name: str, *, source: Source = OPERATOR) -> Status:
        """Remove the obstacle that was `put` under a name; a policy, only one that a policy put."""
        with self._anew:
            if not isinstance(name, str) or name not in self._standing:
                raise Refused(f"there is no {shown(name)}; there are {', '.join(self._standing) or 'none'}")
            self._may_change(name, source)
            del self._standing[name]
            self._sight()
        return ACCEPTED

    def _may_change(self, name: str, source: Source) -> None:
        """Raises Refused where a source must not move or remove the obstacle of a name."""
        by = self._standing[name][1] if name in self._standing else source
        if PRIORITY[known(source)] < PRIORITY[by]:
            raise Refused(f"{name} was put there by the {by}; the {source} must not change it")

    def _predicted(self, seen: Moving, others: Container[str]) -> Predicted:
        """others: names that it must not have."""
        if not self._lookout.sees:
            raise Refused("the arm has no geometry that could keep clear of it")
        if not isinstance(seen.name, str):
            raise Refused(f"its name must be text, not {shown(seen.name)}")
        if seen.name in others:
            raise Refused(f"each obstacle must have a name of its own, and another one is {shown(seen.name)}")
        return predicted(seen, self._now, self._last, self.options.obstacles)

    def _sight(self) -> None:
        """Check the commanded path against the present obstacles."""
        sighting = self._sighting.then([*self._seen, *(one for one, _ in self._standing.values())], self._now)
        for running in (self._running, self._offer):
            if running is not None:
                running.outlook = self._lookout.outlook(running.looked, sighting, self._now)
        self._sighting = sighting
        self._look(self._running)  # if it is another one by now

    def _look(self, running: Running) -> None:
        """The clearance of a path at the newest sighting."""
        while running.outlook.sighting is not (sighting := self._sighting):
            running.outlook = self._lookout.outlook(running.looked, sighting, self._now)

    @answers("A restart")
    def restart(self, q: npt.ArrayLike, *, calm: bool = False) -> Status:
        """Start again from rest at q (n,), rad, where something else put the arm; pending requests are dropped.

        Call it from the robot's loop between two commands, which jump to q. A latched stop stays latched. Refused while
        the committed motion moves, and where the load is not safe at rest. calm: states that the liquid or pendulum in
        the load is at rest; required if there is one.
        """
        posture = numbers(q, (self._problem.n,), "the posture")
        if self._now < self.committed.ends and not self.committed.at_rest:
            raise Refused(f"the arm is at rest only in {self.committed.ends - self._now:.2f} s")
        if self._inside and not calm:
            raise Refused(f"{self._inside} may still move; say calm=True when it stands still")
        with self._anew:
            rest = verified(self._beside, resting(posture), self._now, None)
            if rest.committed is None:
                raise Refused(f"the load is not safe at rest there: {rest.sentence}")
            self._begin(rest.committed, "the arm was started again elsewhere")
            self._reader.take(self._running.pieces)
            self._reader.read(self._now)
        return ACCEPTED

    def _begin(self, rest: Committed, why: str) -> None:
        """Rest, with nothing requested any more but a stop or a hold."""
        self._drop(why)
        self._wish, self._done, self._refused = None, None, ""
        self._unknown, self._astray = False, ""
        if isinstance(self._asked, Halt):  # the stop or the hold that is latched
            self._done = self._asked
        self._heard.clear()
        self._offer = self._offered = None
        running = Running.first(rest, self._problem)
        self._look(running)
        self._running = running
        self._history = CommandHistory(self.options.record, self._now, running.path, running.since)

    @answers("The load")
    def load(self, scenario: Scenario | str | Path, *, calm: bool = False) -> Status:
        """Carry another load from now on, while the arm rests; it is accepted only if it is verified to be safe in this
        posture.

        Call it when something was taken off or put on, and stands still: from any thread but the robot's loop, because
        it waits for a verdict. Pending requests are dropped. A refused load changes nothing.

        Args:
            scenario: the same arm and tray with the new load, given as to `Live`.
            calm: states that the liquid or pendulum in the load is at rest; required if there is one.

        Returns:
            A Status that says whether the load is accepted, or why not.

        Raises:
            ScenarioError: there is no such scenario.
        """
        mine = self._problem.scenario
        other = live_scenario(scenario if isinstance(scenario, Scenario) else load(scenario))
        if (other.arm, other.tray) != (mine.arm, mine.tray):
            raise Refused("the scenario has another arm or another tray")
        if other.payload.dynamic and not calm:
            raise Refused("something moves inside it; say calm=True when it stands still")
        if not self._planning.acquire(blocking=False):
            raise Refused("a motion is being planned; wait until it is committed")
        try:
            if not self.settled:
                raise Refused("the arm moves, or is about to; wait until it rests")
            if self._astray:
                raise Refused(self._astray)
            running, q = self._running, self.committed.motion.q[-1]
            problem, rest = standing(transport_problem(other, robust=self._robust), q, self._now)
            with self._anew:
                if self._running is not running:
                    raise Refused("the arm was started again elsewhere meanwhile")
                self._believe(problem)
                self._begin(rest, "another load is carried")
                reader = _reader_of(self._running, problem)
                reader.read(self._now)  # before the loop has it
                self._reader = reader
        except ScenarioError as error:
            raise Refused(str(error)) from None
        finally:
            self._planning.release()
        return ACCEPTED

    def plan(self, budget: float = 2.0, answer: Callable[[Job], Answer] | None = None) -> State:
        """Plan one step towards the request. Never raises; any thread may call it, one at a time.

        Args:
            budget: approximate time that the step may take, s.
            answer: function that plans elsewhere; default: plan in this thread. Its proposal is verified here, unless
                it carries a valid seal (`salver.live.committed.seal`).
        """
        if self._planning.acquire(blocking=False):
            wish = None
            try:
                self._look(self._running)
                self._history.fold()
                wish = self._due()
                if wish is not None and self._offer is None:
                    self._step(wish, budget, answer or self._planner.answer)
            except Exception as error:  # the committed motion does not depend on it
                self._refused = f"The planner failed ({type(error).__name__}: {error}); what was committed goes on."
                if isinstance(wish, Evade):
                    self._resigned = (self._running, self._sighting.news)
                elif isinstance(wish, Goal | Follow):  # a stop is tried again
                    self._give_up(wish, f"the planner failed ({type(error).__name__})")
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
            running, base = self._running, self.committed
            begins = self._hand_over(base, "motion", max(self._now + self.lead, self._ready.due(base)))
            over = begins >= base.ends - self._ready.options.every
            if over or self._offer is not None or isinstance(self._asked, Follow | Halt):
                return False
            self._ready.looked_at(begins)
            job = Job(Halt(), base, begins, budget, self._sighting.obstacles)
            found = (answer or self._planner.answer)(job).found
            if found is not None and sealed(found, base, self._problem) and not self._denied(found):
                stop = running.then(found, Halt(), self._now, self._problem)
                self._look(stop)
                self._ready.add(stop, base)
            return True
        except Exception:  # a stop less; what is committed does not depend on it
            return False
        finally:
            self._planning.release()

    def _denied(self, found: Committed) -> str:
        """Why a motion is not to be done though it was verified; nothing when it is."""
        return "" if self._permit is None else self._permit(found.motion)

    @property
    def settled(self) -> bool:
        """Whether the arm rests and no request is left."""
        idle = self._asked in (None, self._done) and not self._queue and self._offer is None and self._halt is None
        return idle and (self._now >= self.committed.ends or self.committed.at_rest)

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
        slow = "" if self._factor == 1.0 else f"Goals are gone to at {100 * self._factor:.3g} % of full speed."
        speed = " ".join(filter(None, ("" if self._held is None else str(self._held), slow)))
        granted, withheld = self._granted, ""
        if granted < 0.995:  # a whole percent
            near = "it still changes, or the tray is kept level" if margin >= LIMITING else f"limited by {limit}"
            why = near if self._held is None and not passing else str(self._held or passing).rstrip(".")
            withheld = f"{100 * granted:.0f} % of the requested velocity: {why}."
        return State(
            doing, rests_in, limit, margin, self._refused, self._clock, self.lead, passing, self.stopped,
            self._refusals, speed, self._requests.each, granted, withheld,
        )  # fmt: skip

    @property
    def _granted(self) -> float:
        """Share of the requested velocities that the arm has now; 1 where none are requested."""
        wish, reader = self._wish if self._stopped is None else None, self._reader
        if not (isinstance(wish, Follow) and isinstance(wish.wanted, JointsWanted) and self._now <= wish.until):
            return 1.0
        weights = self.options.planner.weights
        return wish.wanted.granted(self._problem.arm, reader.q.copy(), reader.dq.copy(), self._now, weights)

    @property
    def robust(self) -> bool:
        """Whether motions are verified for the whole uncertain set."""
        return self._robust

    @property
    def lead(self) -> float:
        """Time from the beginning of planning to the hand-over, s."""
        return self._lead.of(_kind(self._asked))

    def _due(self) -> Wish | None:
        """The request that is to be planned for now."""
        wish, offered = self._asked, self._offered
        if self._halt is not None:  # whether it comes in time the loop decides
            return None
        if isinstance(wish, Halt) and isinstance(self._running.wish, Halt):
            self._done = wish  # by a stop that was ready
        if offered is not None and self._offer is None:
            self._offered = None
            if self._running is offered and not isinstance(offered.wish, Follow | Evade):
                self._done = offered.wish
        running = self._running
        resigned = self._resigned == (running, self._sighting.news)
        free = self._stopped is None and self._held is None
        # One tick for each hand-over: with several from the same state fewer obstacles are evaded.
        early = self._hand_over(self.committed, "tick") <= self.committed.begins + 1e-9
        if running.outlook.sentence(self._now) and not resigned and free and self._offer is None:
            return None if early else EVADE
        if wish is not None and wish is not self._done:
            return None if early and isinstance(wish, Follow) else wish
        if not free:
            return None
        if isinstance(running.wish, Goal) and self._now < running.committed.ends:
            another = (
                running.committed.run.to != self._factor and self._now >= self._tried + self.options.planner.speed.again
            )
            return Retime(self._factor) if another else None
        if self._now >= self.committed.ends:
            with contextlib.suppress(IndexError):  # none is queued, or not any more
                self._arrived()
                self._wish = self._queue.popleft()
                return self._wish
        return None

    def _step(self, wish: Wish, budget: float, answer: Callable[[Job], Answer]) -> None:
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
            found, status = self._verified(found, found.begins, base)
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
            began = time.perf_counter()
            found, status = self._verified(found, self._hand_over(base, "speed"), base)  # a verdict is most of that too
            self._lead.took("speed", time.perf_counter() - began)
        offered = None
        if found is not None:
            same = running.wish if isinstance(wish, Retime) else None  # as before, at another speed
            offered = running.then(found, same or wish, self._now, self._problem)
            offered.resigned = isinstance(wish, Halt | Evade)
            self._look(offered)
            if not offered.keeps_clear:
                status, offered = Status("refused", offered.outlook.sentence(self._now), False), None
        if offered is None and status.code != "unreachable" and self._sighting.news != sighting.news:
            return  # it was planned for another world, and is planned again for this one
        if isinstance(wish, Evade):
            if answered.done or denied:
                self._resigned = (running, sighting.news)
            if offered is not None:
                self._offered = self._offer = offered
                self._done = None if isinstance(self._wish, Goal | Follow) else self._wish
        elif offered is not None:
            if not isinstance(wish, Halt):  # of a stop it stays said why the arm is stopped
                self._refused = ""
            self._offered = self._offer = offered
        elif wish is not self._done and kind == "motion":
            failed, times = self._failed
            self._failed = wish, times + 1 if failed is wish else 1
            resting = begins >= base.ends and not late
            if status.code == "unreachable" or resting or self._failed[1] >= self.options.attempts:
                self._give_up(wish, status.sentence.rstrip("."))
                self._refuse(status.sentence, f"The goal {wish.what}" if isinstance(wish, Goal) else "The stop")

    def _verified(self, found: Committed, begins: float, base: Committed) -> tuple[Committed | None, Status]:
        """A proposed motion from another instant on, if it passes the verdict here; or why it does not."""
        profile = None if found.profile is None else replace(found.profile, begins=begins)
        again = verified(self._problem, found.motion, begins, base, profile=profile)
        return again.committed, Status("refused", again.sentence, False)

    def _give_up(self, wish: Wish, why: str) -> None:
        """Drop a request, which neither a release nor an evasion brings back."""
        self._done = wish
        self._requests.becomes(id_of(wish), "dropped", why)
        if self._wish is wish:
            self._wish = None

    def _fits(self, base: Committed) -> float:
        """Live time, s, from which on the committed motion is no faster than the requested speed factor for goals."""
        run = base.run
        return base.ends if run.to > self._factor else min(run.settled, base.ends)

    def _hand_over(self, base: Committed, kind: str, earliest: float | None = None) -> float:
        """Live time of the next hand-over: the next tick, or where the base's deviation is known exactly."""
        begins = max(self._now + self._lead.of(kind) if earliest is None else earliest, base.begins)
        if kind == "tick":
            tick = self.options.planner.steering.tick
            return tick * float(np.ceil(begins / tick - 1e-9))
        k = int(np.searchsorted(base.nodes, begins))
        return float(base.nodes[k]) if k < len(base.nodes) else begins


def _reader_of(running: Running, problem: TransportProblem) -> Reader:
    return Reader(with_load(problem.arm, problem.items).pin_model, running.pieces)


def _kind(wish: Wish | None) -> str:
    """Which lead it has."""
    if isinstance(wish, Retime):
        return "speed"
    return "tick" if isinstance(wish, Follow | Evade) else "motion"
