"""The scenario as a whole, with the checks that concern several of its tables."""

from __future__ import annotations

import math
from collections.abc import Mapping
from copy import deepcopy
from functools import cached_property
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Self

import numpy as np
from pydantic import Field, ValidationError, model_validator

from salver.display import Shown
from salver.errors import ScenarioError
from salver.fields import Model, Text, Whole
from salver.files import digest_of
from salver.geometry import lean
from salver.models.arm.tables import Arm
from salver.models.bodies import Body, bodies
from salver.models.contact_rows import MOST_GENERATORS
from salver.models.described import Floor, Obstacle, Tray, Wall
from salver.models.payload import Payload
from salver.models.uncertain.parameters import UncertainSet
from salver.scenario.cell import Physics, Surroundings
from salver.scenario.legs import Leg, fixed_to_tray, loads
from salver.scenario.objects import CarriedObject, UncertaintySet
from salver.scenario.task import Contact, Control, Motion, Planning, Pose, SensitivityWeighting
from salver.validation import sentences

if TYPE_CHECKING:
    from salver.models.arm.arm import ArmModel


class Scenario(Shown, Model):
    """A task: everything that a plan depends on. Equal scenarios with equal seeds give equal plans."""

    name: Annotated[
        str,
        Field(
            pattern=r"^[A-Za-z0-9][A-Za-z0-9_.-]*$",
            max_length=64,
            description="letters, digits, points, - and _, a letter or digit first, at most 64",
        ),
    ]
    summary: Text = ""
    source: Text = ""
    seed: Annotated[Whole, Field(ge=0, le=2**63 - 1)] = 0
    motion: Motion
    legs: list[Leg] = Field(default=[], max_length=20)
    objects: Annotated[list[CarriedObject], Field(min_length=1, max_length=20)]
    uncertainty: UncertaintySet = UncertaintySet()
    contact: Contact = Contact()
    control: Control = Control()
    objective: SensitivityWeighting = SensitivityWeighting()
    plan: Planning = Planning()
    tray: Tray = Tray()
    arm: Arm | None = None
    obstacles: list[Obstacle] = Field(default=[], max_length=100)
    surroundings: Surroundings = Surroundings()
    physics: Physics = Physics()

    def facts(self) -> dict[str, str]:
        """Facts that a notebook shows."""
        motion, uncertain = self.motion, self.uncertain
        ends = [motion.start, *(leg.goal for leg in self.legs)] if self.legs else [motion.start, motion.goal]
        distance = sum(math.dist(one.position, other.position) for one, other in pairwise(ends))
        return {
            "name": self.name,
            "carried": ", ".join(f"{o.name} {o.mass:g} kg, friction {o.friction:g}" for o in self.objects),
            "arm": Path(self.arm.model).stem if self.arm else "none",
            **({"legs": str(len(self.legs))} if self.legs else {}),
            "way": f"{distance:.3g} m in {f'{motion.duration:g} s' if motion.duration else 'the shortest safe time'}",
            "uncertain": ", ".join(
                f"{name} ±{half:.3g}" for name, half in zip(uncertain.names, uncertain.half_range, strict=True)
            )
            or "nothing",
            "summary": self.summary,
        }

    @model_validator(mode="before")
    @classmethod
    def _ends_with_its_last_leg(cls, data: Any) -> Any:
        """Set a missing motion.goal to the goal of the last leg."""
        try:
            motion, goal = data["motion"], data["legs"][-1]["goal"]
            return data if "goal" in motion else {**data, "motion": {**motion, "goal": goal}}
        except (KeyError, IndexError, TypeError):
            return data

    @model_validator(mode="after")
    def _consistent(self) -> Scenario:
        if not self.legs:
            return self._consistent_leg()
        if self.motion.through:
            raise ValueError("motion.through is given with legs; give it for a leg: legs[0].through")
        if self.motion.goal != self.legs[-1].goal:
            raise ValueError("motion.goal is not the goal of the last leg; leave it out, or make it the same")
        if self.uncertainty.correlation:
            raise ValueError("uncertainty.correlation does not work with legs; leave one of the two out")
        for k, leg in enumerate(self.each_leg):
            try:
                leg._consistent_leg()
            except ValueError as error:
                raise ValueError(f"legs[{k}]: {error}") from None
        self._left_standing()
        return self

    def _left_standing(self) -> None:
        """Raise ValueError when the load that is on the tray after the last leg cannot stand there."""
        last = self.each_leg[-1]
        left = loads(self.objects, self.legs)[-1]
        if left and left != last.objects:
            try:
                self._leg(last.name, last.motion.goal, [], self.motion.goal, left)._consistent_leg()
            except ValueError as error:
                raise ValueError(f"after legs[{len(self.legs) - 1}]: {error}") from None

    def _consistent_leg(self) -> Scenario:
        self._bounded()
        self._check_floor()
        self.payload.check()
        self._check_inner_limits()
        for key, pose in (("start", self.motion.start), ("goal", self.motion.goal)):
            tilt = np.rad2deg(lean(pose.rotation))
            for body in self.payload.bodies:
                if body.walls is not None:
                    continue  # the rim may hold it: plans check that exactly
                least = self.payload.least_friction(body)
                holds = np.rad2deg(np.arctan(least))
                if tilt > holds + 1e-6:
                    raise ValueError(
                        f"motion.{key} tilts the tray by {tilt:.4g} deg, at which {body.name} slides even at rest; "
                        f"its least friction of {least:.4g} holds it up to {holds:.4g} deg"
                    )
        return self

    def _check_floor(self) -> None:
        """Raise ValueError when the floor is to be that of a base which is not upright."""
        if self.arm is not None and self.surroundings.floor == "base" and any(self.arm.base_rpy_deg[:2]):
            tilt = np.rad2deg(lean(self.arm.R_base))
            raise ValueError(
                f"arm.base_rpy_deg = {list(self.arm.base_rpy_deg)} tilts the base by {tilt:.4g} deg, and the floor is "
                'no longer the plane through it; give surroundings.floor, the floor\'s height in S, m, or "none"'
            )

    def _check_inner_limits(self) -> None:
        """Raise ValueError when a liquid or pendulum exceeds its limit even at rest, or its model does not apply."""
        for item in self.objects:
            if item.inner is None:
                continue
            place, tilts = item.uncertainty.position or (), self.uncertainty.tilt_deg or ()
            near = next(b for n in self.payload.networks if item.name in (b := [x.name for x in n.bodies]))
            if any(place) and len(near) > 1:
                raise ValueError(
                    f"uncertainty.position = {list(place)} of {item.name} works with the {item.inner.noun} in it only "
                    f"if it stands on the tray by itself, not with {' and '.join(x for x in near if x != item.name)}; "
                    "leave the range out, or put it elsewhere"
                )
            if any(tilts):
                raise ValueError(
                    f"uncertainty.tilt_deg = {list(tilts)} does not work with the {item.inner.noun} in {item.name}, "
                    "whose model does not know it; leave one of the two out"
                )
            inner, still = item.inner.dynamics(item.shape.solid().height), np.zeros((1, 2))
            half = item.uncertainty.ranges(item.loose(), True)
            most = inner.value + next((h for p, _, h in half if p.kind == inner.quantity), 0.0)
            for key, pose in (("start", self.motion.start), ("goal", self.motion.goal)):
                up = pose.rotation[2]
                away = float(inner.away(most, still, np.abs(up[:2])[None] / max(float(up[2]), 1e-9))[0])
                if away > inner.room(most):
                    tilt = np.rad2deg(lean(pose.rotation))
                    raise ValueError(
                        f"motion.{key} tilts the tray by {tilt:.4g} deg, which moves the {inner.noun} in {item.name} "
                        f"by {1e3 * away:.3g} mm even at rest; it has room for {1e3 * inner.room(most):.3g} mm"
                    )

    def _bounded(self, most_values: float = 5e7, most_steps: float = 1e6, checks: int = 10) -> None:
        """Raise ValueError when a plan or a run would take excessive memory or time.

        most_values: numbers in the largest array of a plan, 0.4 GB, which has so many checks for each node. most_steps:
        engine steps of one run, minutes.
        """
        for item, body in zip(self.objects, self.payload.bodies, strict=True):
            count = body.contacts.count * self.contact.edges
            if count > MOST_GENERATORS:
                raise ValueError(
                    f"{item.name} has {body.contacts.count} contact points with contact.edges = {self.contact.edges} "
                    f"each, which makes {count} cone coefficients; at most {MOST_GENERATORS} are accepted"
                )
            values = checks * self.motion.nodes * count * (2 + self.payload.uncertain.size)
            if values > most_values:
                raise ValueError(
                    f"motion.nodes = {self.motion.nodes} with {count} cone coefficients and "
                    f"{self.payload.uncertain.size} uncertain parameters makes {values:.2g} numbers; at most "
                    f"{most_values:.2g} are accepted: give fewer nodes or contact.edges"
                )
        if self.arm is not None:
            if self.arm.base is not None and self.physics.robot.control == "torque":
                raise ValueError(
                    'physics.robot.control = "torque" does not move arm.base, which takes velocities; give "position"'
                )
            self.control.check_held(self.physics.command_period)
            self.physics.robot.check_held(self.physics.command_period)
        steps = self.physics.steps(self.motion.duration)
        if steps > most_steps:
            raise ValueError(
                f"physics.timestep = {self.physics.timestep:g} s makes {steps:.2g} steps of a run; at most "
                f"{most_steps:.2g} are accepted: give a longer one, or a shorter motion"
            )

    @cached_property
    def each_leg(self) -> tuple[Scenario, ...]:
        """The legs of the task in order, each a scenario with the load of that leg; itself if it has only one."""
        if not self.legs:
            return (self,)
        found: list[Scenario] = []
        poses = [self.motion.start, *(leg.goal for leg in self.legs)]
        at: Body | None = None  # the body whose frame B the poses of the task are for
        for k, load in enumerate(loads(self.objects, self.legs)[:-1]):
            begin, *through, end = (poses[k], *self.legs[k].through, poses[k + 1])
            if any(one.same_as(other) for one, other in pairwise((begin, *through, end))):
                raise ValueError(
                    f"legs[{k}] has the same pose twice in a row; leave one out (a stop may both take and put objects)"
                )
            leg = self._leg(f"{self.name[:57]}-leg{k + 1}", begin, through, end, load)
            if at is None:
                at = leg.payload.first
            elif fixed_to_tray(end, at, leg.payload.first) != end:
                if self.motion.goal_yaw == "free":
                    raise ValueError(
                        f'motion.goal_yaw = "free": on legs[{k}] the first object is {load[0].name}, about which the '
                        f'tray would turn instead of about {at.name}; give goal_yaw = "fixed", or list first what is '
                        "carried on all legs"
                    )
                begin, *through, end = (fixed_to_tray(pose, at, leg.payload.first) for pose in (begin, *through, end))
                leg = self._leg(leg.name, begin, through, end, load)
            if k and leg.arm is not None:  # it starts in the posture in which the leg before ends
                leg = leg.model_copy(update={"arm": leg.arm.model_copy(update={"start_posture": None})})
            found.append(leg)
        return tuple(found)

    def _leg(self, name: str, start: Pose, through: list[Pose], goal: Pose, load: list[CarriedObject]) -> Scenario:
        ends = {"start": start, "through": through, "goal": goal, "duration": None}
        if start is not self.motion.start:  # it starts with the heading in which the leg before ends
            ends["start_yaw"] = None
        motion = self.motion.model_copy(update=ends)
        return self.model_copy(update={"name": name, "motion": motion, "legs": [], "objects": load})

    def check_one_leg(self, what: str) -> None:
        """Raise ScenarioError when there are several legs or via poses, because `what` supports only one motion from
        start to goal."""
        if self.motion.through:
            raise ScenarioError(
                f"{self.name}: motion.through has via poses, which {what} does not support; write the task as "
                "[[legs]], each with goal and through."
            )
        if self.legs:
            raise ScenarioError(
                f"{self.name} is a task of {len(self.legs)} legs, and {what} takes one motion with one load; "
                "salver plan and sv.plan_legs plan all legs, and --plan leg1 names one of a plan."
            )

    @property
    def bodies(self) -> tuple[Body, ...]:
        """The bodies carried on any leg, each where it stands when it is first carried."""
        found: dict[str, Body] = {}
        for leg in self.each_leg:
            found = {body.name: body for body in leg.payload.bodies} | found
        return tuple(found[item.name] for item in self.objects if item.name in found)

    def load_arm(self) -> ArmModel:
        """The arm with its tray. Raises ScenarioError without an arm, and as `salver.models.arm.arm.load_arm`."""
        if self.arm is None:
            raise ScenarioError(f"{self.name} has no arm, and this needs one; give it a table [arm].")
        from salver.models.arm.arm import load_arm

        return load_arm(self.arm, self.tray)

    @property
    def floor(self) -> float | None:
        """Height of the floor in S, m; None without a floor or without an arm."""
        given = self.surroundings.floor
        if self.arm is None or given == "none":
            return None
        return self.arm.base_position[2] if given == "base" else given

    @property
    def around(self) -> tuple[Obstacle | Wall, ...]:
        """Everything that arm, tray and load must not touch: the obstacles, the faces of the keep-in box, the floor."""
        floor, box = self.floor, self.surroundings.keep_in
        floors = () if floor is None else (Floor((0.0, 0.0, floor), (0.0, 0.0, 1.0)),)
        return (*self.obstacles, *(() if box is None else box.walls), *floors)

    @cached_property
    def uncertain(self) -> UncertainSet:
        """The uncertain parameters of all objects and of the tray, on any leg."""
        return self.uncertainty.around(self.objects, [item.loose() for item in self.objects], self.tray)

    @cached_property
    def payload(self) -> Payload:
        """The load: bodies, their contacts, their uncertain parameters. Raises ScenarioError for a task of several
        legs, because each leg has its own load."""
        if self.legs:
            self.check_one_leg("this")
        loose = [item.loose() for item in self.objects]
        standing = bodies(loose, self.contact.edges, float(np.deg2rad(self.contact.edge_phase_deg)), self.tray)
        uncertain, tray = self.uncertainty.around(self.objects, loose, self.tray), self.tray
        return Payload(standing, uncertain, 0.5 * np.array(tray.size), tray.rim_height)

    def model_copy(self, *, update: Mapping[str, Any] | None = None, deep: bool = False) -> Self:
        """Pydantic's method, with cached properties cleared. It does not validate: prefer `with_changes`."""
        copy = super().model_copy(update=update, deep=deep)
        for made in ("payload", "uncertain", "each_leg"):
            copy.__dict__.pop(made, None)
        return copy

    @property
    def digest(self) -> str:
        """Content hash: 12 hexadecimal digits of the resolved scenario."""
        return digest_of(self.model_dump(mode="json"))[:12]

    def with_changes(self, **changes: Any) -> Scenario:
        """A validated copy with keys replaced, named by paths with `__` for the dots: `motion__duration=1.5`."""
        data = self.model_dump(mode="json", exclude_none=True)
        for path, value in changes.items():
            *parents, last = path.split("__")
            target: Any = data
            try:
                for key in parents:
                    target = target[int(key)] if key.isdigit() else target.setdefault(key, {})
                if value is None:
                    target.pop(last, None)
                else:
                    target[last] = deepcopy(value)  # a later change may be inside it
            except (AttributeError, IndexError, TypeError):
                raise ScenarioError(
                    f"{path} is no place in {self.name}; write it as in motion__duration or objects__0__mass."
                ) from None
        return parse(data, "the changed scenario")


def parse(data: dict[str, Any], where: str) -> Scenario:
    """The scenario of a dictionary of keys. Raises ScenarioError, one sentence for each mistake."""
    try:
        return Scenario.model_validate(data)
    except ValidationError as error:
        raise ScenarioError("\n".join(sentences(error, Scenario, data, where))) from None
