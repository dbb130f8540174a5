"""Plans of several legs: a plan for each leg, with the load of that leg, in one set of files."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from salver.display import Shown
from salver.errors import FileFormatError, Status
from salver.files import provenance
from salver.geometry import Array
from salver.motion_files.verdict import SPEED, UNSAFE, one_line
from salver.planning.plan import Plan, load_plan, plan_of, status_from, status_record
from salver.planning.plan_files import leg_files, read_files, save_files
from salver.scenario import Scenario
from salver.scenario.warnings import warnings_of

SAME_POSTURE = 1e-9  # rad, m: largest difference between a leg's start posture and the end posture of the one before


@dataclass(frozen=True, repr=False)
class MultiLegPlan(Shown):
    """A plan of several legs (docs/howto/legs.md). Between legs the arm rests while objects are taken off the tray or
    put on it; a leg starts in the posture in which the one before it ended.

    scenario: the whole task. legs: their plans, in order. status: how planning ended. solver: record of the search.
    """

    scenario: Scenario
    legs: tuple[Plan, ...]
    status: Status
    solver: Mapping[str, Any] = field(default_factory=dict)

    @property
    def method(self) -> str:
        return self.legs[0].method

    @property
    def duration(self) -> float:
        """Duration of all motions together, s, without the time at stops."""
        return sum(leg.duration for leg in self.legs)

    @property
    def by_stem(self) -> dict[str, Plan]:
        """The legs by their names in commands: "leg1" and so on."""
        return {f"leg{k}": leg for k, leg in enumerate(self.legs, 1)}

    @property
    def apart(self) -> float:
        """Largest difference between a leg's start posture and the end posture of the one before it; rad, m."""
        joints = [leg.joint for leg in self.legs]
        return max(
            (
                float(np.abs(one.q[-1] - other.q[0]).max()) if one is not None and other is not None else np.inf
                for one, other in pairwise(joints)
            ),
            default=0.0,
        )

    @property
    def ok(self) -> bool:
        """Whether every leg is safe in its own model, the arm can follow it, and each begins where the last ended."""
        return self.status.ok and all(leg.ok for leg in self.legs) and self.apart <= SAME_POSTURE

    @property
    def verdict(self) -> str:
        """The verdict in its files, in one line, as `Plan.verdict`."""
        failing = [f"leg {k}: {leg.verdict}" for k, leg in enumerate(self.legs, 1) if not leg.ok]
        if not self.status.ok:
            failing.insert(0, self.status.sentence)
        if self.apart > SAME_POSTURE:
            failing.append(f"A leg begins {self.apart:.2g} rad or m from where the one before it ended.")
        if failing:
            return one_line(f"{UNSAFE}: {' '.join(failing)}")
        slow = [f"leg {k}: {leg.speeds.verdict}" for k, leg in enumerate(self.legs, 1) if not leg.speeds.every]
        only = f"{SPEED}: {' '.join(slow)} " if slow else ""
        return one_line(f"{only}Not checked: {'; '.join(self.unchecked)}. {self.status.sentence}")

    @cached_property
    def warnings(self) -> tuple[str, ...]:
        """Warnings of the whole task, as `Plan.warnings`."""
        return warnings_of(self.scenario)

    @property
    def unchecked(self) -> tuple[str, ...]:
        """What the verdict does not cover, in words; state it before any claim of safety."""
        stops = ("what happens at the stops while objects are taken off and put on",) if len(self.legs) > 1 else ()
        return tuple(dict.fromkeys((*stops, *(what for leg in self.legs for what in leg.unchecked))))

    def facts(self) -> dict[str, str]:
        """Facts that a notebook shows."""
        carried = (", ".join(item.name for item in leg.scenario.objects) for leg in self.legs)
        return {
            "scenario": self.scenario.name,
            "method": self.method,
            "duration": f"{self.duration:.4g} s, without its stops",
            "ok": "yes" if self.ok else "no",
            "status": self.status.sentence,
            **{
                f"leg {k}": f"{leg.duration:.4g} s with {load}: {leg.verification.sentence}"
                for k, (leg, load) in enumerate(zip(self.legs, carried, strict=True), 1)
            },
        }

    def summary(self) -> dict[str, Any]:
        """Content of `plan.json`: that of each leg under `legs`."""
        return {
            "verdict": self.verdict,
            "method": self.method,
            "ok": self.ok,
            "warnings": list(self.warnings),
            "unchecked": list(self.unchecked),
            "status": status_record(self.status),
            "duration": self.duration,
            "apart": self.apart,
            "solver": dict(self.solver),
            "legs": [leg.summary() for leg in self.legs],
            "provenance": provenance(self.scenario),
        }

    def arrays(self) -> dict[str, Array]:
        """Content of `plan.npz`: the arrays of each leg, with "leg1." and so on in front."""
        return {f"leg{k}.{name}": a for k, leg in enumerate(self.legs, 1) for name, a in leg.arrays().items()}

    def save(self, directory: str | Path, stem: str = "plan") -> Path:
        """Write plan.npz, plan.json and scenario.toml into a run directory, as `Plan.save` does."""
        return save_files(self.scenario, self.arrays(), self.summary(), Path(directory), stem)


def load_round(directory: str | Path) -> MultiLegPlan:
    """Read a plan of several legs. Raises FileFormatError or ScenarioError. No code from the files is executed."""
    path = Path(directory) / "plan"
    files = read_files(directory)
    if not files.scenario.legs:
        raise FileFormatError(f"{path}.npz is a plan of one leg.")
    try:
        legs = [plan_of(leg_files(files, k + 1), path) for k in range(len(files.scenario.legs))]
        return MultiLegPlan(files.scenario, tuple(legs), status_from(files.record["status"]), files.record["solver"])
    except (KeyError, TypeError, ValueError, IndexError):
        raise FileFormatError(f"{path}.npz and .json are not those of a plan; plan again.") from None


def load(directory: str | Path, stem: str = "plan") -> Plan | MultiLegPlan:
    """Read the plan in a run directory, of one leg or of several. Raises FileFormatError or ScenarioError."""
    return load_round(directory) if stem == "plan" and has_legs(directory) else load_plan(directory, stem)


def has_legs(directory: str | Path) -> bool:
    """Whether the scenario in a run directory has several legs. Raises ScenarioError."""
    from salver.scenario import load

    path = Path(directory) / "scenario.toml"
    return path.is_file() and bool(load(path).legs)
