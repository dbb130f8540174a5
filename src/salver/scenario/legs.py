"""A task of several legs: the goal of each, and the objects taken off the tray and put on it there."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated

from pydantic import Field

from salver.fields import Model
from salver.geometry import quat_wxyz_from_matrix
from salver.models.bodies import Body
from salver.scenario.objects import CarriedObject
from salver.scenario.task import Pose
from salver.wording import listed

Some = str | Annotated[list[str], Field(min_length=1, max_length=20)]
_NAMES = "the name of an object, or a list of names"


class Leg(Model):
    """A motion from rest to rest at `goal`, where objects are then taken off the tray and others put on it.

    through: via poses, passed in this order without a stop.
    All poses of a task are poses of one frame fixed to the tray: frame B of the first object of the first leg, even
    after that object has been taken off.
    """

    goal: Pose
    through: list[Pose] = Field(default=[], max_length=10)
    take: Some | None = Field(default=None, description=_NAMES)
    put: Some | None = Field(default=None, description=_NAMES)

    @property
    def taken(self) -> list[str]:
        return _listed(self.take)

    @property
    def added(self) -> list[str]:
        return _listed(self.put)

    @property
    def handling(self) -> str:
        """Handling at the end of a leg, in words: "cup taken off; plate put on"."""
        done = ((self.taken, "taken off"), (self.added, "put on"))
        return "; ".join(f"{listed(names)} {what}" for names, what in done if names) or "nothing taken off or put on"


def loads(objects: Sequence[CarriedObject], legs: Sequence[Leg]) -> list[list[CarriedObject]]:
    """The load on each leg, and after the last leg; each in the order of `objects`.

    An object is on the tray from the start unless its first handling is to be put on. Raises ValueError, one sentence,
    when an object to be taken is not on the tray or carries another, or an object to be put on is on the tray already
    or lacks its support.
    """
    named = {item.name: item for item in objects}
    if len(named) < len(objects):
        twice = next(item.name for i, item in enumerate(objects) if item.name in {o.name for o in objects[:i]})
        raise ValueError(f'objects: the name "{twice}" is used twice; each object needs its own')
    first: dict[str, str] = {}
    for i, leg in enumerate(legs):
        for key, names in (("take", leg.taken), ("put", leg.added)):
            for k, name in enumerate(names):
                where = f'legs[{i}].{key} = "{name}"'
                if name not in named:
                    raise ValueError(f"{where}: there is no such object; there are {', '.join(named)}")
                if name in names[:k] or (key == "put" and name in leg.taken):
                    raise ValueError(f"{where}: it is named twice at this stop; name it once")
                first.setdefault(name, key)
    here = {name for name in named if first.get(name) != "put"}
    found = [_standing(objects, here, "when the first leg begins")]
    for i, leg in enumerate(legs):
        on_it = ", ".join(item.name for item in found[-1]) or "nothing"
        for name in leg.taken:
            if name not in here:
                raise ValueError(f'legs[{i}].take = "{name}": it is not on the tray then; the tray holds {on_it}')
        for name in leg.added:
            if name in here:
                raise ValueError(f'legs[{i}].put = "{name}": it is on the tray already; the tray holds {on_it}')
        here = (here - set(leg.taken)) | set(leg.added)
        found.append(_standing(objects, here, f"after legs[{i}]"))
    for i, load in enumerate(found[:-1]):
        if not load:
            where = "the first leg begins" if i == 0 else f"legs[{i - 1}].take leaves the tray"
            raise ValueError(
                f"{where} {'with an empty tray' if i == 0 else 'empty, and a leg follows'}: salver plans only legs "
                "with a load; plan the others with any motion planner"
            )
    return found


def fixed_to_tray(pose: Pose, at: Body, body: Body) -> Pose:
    """The pose of a body's frame B when the frame B of the body `at`, fixed to the same tray, is at `pose`."""
    if body.p_EB.tolist() == at.p_EB.tolist() and body.R_EB.tolist() == at.R_EB.tolist():
        return pose
    R_SE = pose.rotation @ at.R_EB.T
    p_SB = pose.position + R_SE @ (body.p_EB - at.p_EB)
    quat_wxyz = quat_wxyz_from_matrix(R_SE @ body.R_EB).tolist()
    return Pose.model_validate({"position": p_SB.tolist(), "quat_wxyz": quat_wxyz})


def _listed(names: str | list[str] | None) -> list[str]:
    return [names] if isinstance(names, str) else list(names or ())


def _standing(objects: Sequence[CarriedObject], names: set[str], when: str) -> list[CarriedObject]:
    """The objects with these names, in order. Raises ValueError when the support of one is not on the tray."""
    for item in objects:
        for support in [item.on] if isinstance(item.on, str) else item.on:
            if item.name in names and support in {o.name for o in objects} - names:
                raise ValueError(
                    f'{item.name} stands on "{support}", which is not on the tray {when}; take {item.name} off before '
                    "it or with it, or put it on after it or with it"
                )
    return [item for item in objects if item.name in names]
