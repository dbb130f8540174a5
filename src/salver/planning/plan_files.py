"""The files of a plan (scenario, arrays and record): where they may be written; writing, certifying and reading
them."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from salver.errors import FileFormatError, ScenarioError
from salver.files import load_npz, npz_bytes, read_json, to_json, write_atomic, write_json
from salver.geometry import Array
from salver.planning import certificate
from salver.run_directory import (
    CERTIFICATE,
    SCENARIO,
    check_free,
    file_stem,
    known_stems,
    leg_number,
    make_room,
    scenario_of,
)
from salver.scenario import Pose, Scenario

NEEDED = ("t", "p_SB", "v_S", "a_S", "quat_SB_wxyz", "omega_B", "alpha_B")


def save_files(
    scenario: Scenario, arrays: Mapping[str, Array], summary: Mapping[str, Any], directory: Path, stem: str
) -> Path:
    """Write a plan's files with their certificate, as `Plan.save`; returns the directory."""
    record = json.loads(to_json(summary))
    check_place(scenario, directory)
    write_scenario(scenario, directory)
    content, path = npz_bytes(arrays), directory / f"{stem}.npz"
    if path.is_file() and path.read_bytes() != content:
        make_room(directory, stem)
    write_atomic(path, content)
    certified = certificate.certificate(scenario, arrays, record)
    write_json(directory / f"{stem}.json", {**record, CERTIFICATE: certified})
    return directory


def check_place(scenario: Scenario, directory: Path, *, edited: bool = False, force: bool = False) -> bool:
    """Whether plans in the directory must be moved away (`make_way`) before this scenario's are written.

    Call it before planning, which may take long. edited: plans of a scenario of the same name may be moved; force:
    those of any scenario. Raises ScenarioError when the directory belongs to another scenario, SalverError when it has
    other files.
    """
    from salver.scenario import load

    check_free(directory)
    path = directory / SCENARIO
    if not path.is_file():
        return False
    planned = bool(known_stems(directory))
    try:
        existing = load(path)
    except ScenarioError:
        if force and planned:
            return True
        raise
    if existing.digest == scenario.digest:
        return False
    if planned and (force or (edited and existing.name == scenario.name)):
        return True
    ways = " replace its plans with --force," if edited and planned else ""
    raise ScenarioError(
        f"{directory} holds the plan of another scenario ({existing.name}, {existing.digest}; this one is "
        f"{scenario.name}, {scenario.digest}); choose another directory with -o,{ways} or remove that one."
    )


def make_way(scenario: Scenario, directory: Path, *, force: bool = False) -> None:
    """Move the plans of an earlier version of the scenario, with their scenario and results, to DIRECTORY/earlier/N.

    force: those of any other scenario too. Raises as `check_place`.
    """
    if check_place(scenario, directory, edited=True, force=force):
        make_room(directory, "plan", with_scenario=True)


def write_scenario(scenario: Scenario, directory: Path) -> None:
    """Write the resolved scenario, unless the directory has the same one already: the user's file stays as it is."""
    import tomli_w

    path = directory / "scenario.toml"
    if not path.is_file():
        write_atomic(path, tomli_w.dumps(scenario.model_dump(mode="json", exclude_none=True)))


@dataclass(frozen=True)
class PlanFiles:
    """Content of a plan's files, checked against their certificate. record: that of plan.json."""

    scenario: Scenario
    arrays: dict[str, Array]
    record: dict[str, Any]


def read_plan(directory: str | Path, stem: str = "plan", required: tuple[str, ...] = NEEDED) -> PlanFiles:
    """Read a plan's files; of a plan of several legs, those of the leg that `stem` names ("leg2").

    Raises FileFormatError or ScenarioError when they are missing, damaged, or edited since.
    """
    found = read_files(directory, stem, required)
    legs = found.record.get("legs")
    number = leg_number(stem)
    if legs is None:
        if number is not None and file_stem(Path(directory), stem) != stem:
            raise FileFormatError(
                f"{Path(directory) / 'plan'}.npz is a plan of one motion and has no {stem}; name plan."
            )
        return found
    if number is None or number > len(legs):
        raise FileFormatError(
            f"{Path(directory) / 'plan'}.npz is a plan of {len(legs)} legs, where a plan of one motion is needed; "
            f"name a leg, leg1 to leg{len(legs)} (--plan leg1), or give another plan."
        )
    return leg_files(found, number)


def leg_files(whole: PlanFiles, number: int) -> PlanFiles:
    """The files of one leg (1 for the first) of a plan of several."""
    prefix = f"leg{number}."
    arrays = {name.removeprefix(prefix): a for name, a in whole.arrays.items() if name.startswith(prefix)}
    scenario = whole.scenario.each_leg[number - 1]
    if number > 1 and scenario.motion.goal_yaw == "free":  # it begins with the heading in which the leg before it ended
        scenario = begun_at(scenario, arrays["p_SB"][0], arrays["quat_SB_wxyz"][0])
    return PlanFiles(scenario, arrays, whole.record["legs"][number - 1])


def begun_at(scenario: Scenario, p_SB: Array, quat_SB_wxyz: Array) -> Scenario:
    """The scenario with another start pose of the first object, whose heading is not free."""
    start = Pose.model_validate({"position": p_SB.tolist(), "quat_wxyz": quat_SB_wxyz.tolist()})
    return scenario.model_copy(
        update={"motion": scenario.motion.model_copy(update={"start": start, "start_yaw": None})}
    )


def read_files(directory: str | Path, stem: str = "plan", required: tuple[str, ...] = ()) -> PlanFiles:
    """Read a plan's files, of all legs together if it has several. Raises as `read_plan`."""
    from salver.scenario import load

    directory = Path(directory)
    scenario = load(scenario_of(directory))
    stem, known = file_stem(directory, stem), known_stems(directory)
    if known and stem not in known:
        raise FileFormatError(f'{directory} has no motion "{stem}"; it has {", ".join(known)}.')
    if scenario.legs:
        required = tuple(f"leg{k + 1}.{name}" for k in range(len(scenario.legs)) for name in required)
    arrays = load_npz(directory / f"{stem}.npz", required)
    record = read_json(directory / f"{stem}.json")
    if not isinstance(record, dict):
        raise FileFormatError(f"{directory / stem}.json is not a record of a plan; write it again with `salver plan`.")
    certificate.check(directory, stem, scenario, arrays, record)
    legs = record.get("legs")
    if (legs is not None) != bool(scenario.legs) or len(legs or ()) != len(scenario.legs):
        raise FileFormatError(f"{directory / stem}.json is not of as many legs as scenario.toml has; plan again.")
    return PlanFiles(scenario, arrays, record)
