"""The run directory: which files belong to a plan, and how replaced plans are kept."""

from __future__ import annotations

import fcntl
import itertools
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from salver.errors import FileFormatError, SalverError, reason
from salver.files import digest_of, read_json, save_result

EARLIER = "earlier"  # folder of replaced plans, numbered, each with its results
SCENARIO = "scenario.toml"
CERTIFICATE = "certificate"  # key of a plan's record
STEMS = ("plan", "baseline", "nominal")  # names of the motions: the plan, and those that it is compared with
RECORDS = ("simulation", "execution")  # folders with one record for each motion
_LEG = re.compile(r"leg([1-9][0-9]?)")
_SHARED_RESULTS = ("report.html", "export", "film.mp4", "film.gif")


def leg_number(stem: str) -> int | None:
    """Number of the leg that a stem names, 1 for "leg1"; None if it names no leg."""
    found = _LEG.fullmatch(stem)
    return None if found is None else int(found[1])


def file_stem(directory: Path, stem: str) -> str:
    """Stem of the files that hold the motion `stem`: "plan" for a leg, because a plan's files hold all its legs."""
    own = (directory / f"{stem}.npz").is_file()
    return stem if own or leg_number(stem) is None else STEMS[0]


def scenario_of(directory: Path) -> Path:
    """Path of the scenario in a run directory. Raises FileFormatError if `directory` is not a run directory."""
    path = directory / SCENARIO
    if path.is_file():
        return path
    if directory.is_file() and (directory.parent / SCENARIO).is_file():
        raise FileFormatError(f"{directory} is a file of a run directory; give the directory: {directory.parent}.")
    why = f"it holds no {SCENARIO}" if directory.is_dir() else "it is a file" if directory.exists() else "there is none"
    raise FileFormatError(f"{directory} is not a run directory: {why}; make one with `salver plan SCENARIO -o DIR`.")


def check_writable(directory: Path, advice: str) -> None:
    """Make a directory if it is missing; raise SalverError, ending in `advice`, if it cannot be written to."""
    try:
        directory.mkdir(parents=True, exist_ok=True)
        probe = directory / f".{SCENARIO}.probe"
        probe.touch()
        probe.unlink()
    except OSError as error:
        raise SalverError(f"{directory} cannot be written to: {reason(error)}; {advice}.") from None


def check_free(directory: Path) -> None:
    """Raise SalverError when a plan cannot be written there, or would replace files that salver did not write.

    Call it before a plan is computed, so that no plan is lost because it cannot be saved.
    """
    if directory.exists() and not directory.is_dir():
        raise SalverError(f"{directory} is a file; a plan needs a directory: name another with -o.")
    ours = (directory / SCENARIO).is_file()
    for stem in STEMS:
        arrays, summary = directory / f"{stem}.npz", directory / f"{stem}.json"
        for path in (arrays, summary):
            if path.exists() and not (ours and arrays.is_file()):
                raise SalverError(
                    f"{path} exists already and is not from a plan of salver; name another directory with -o."
                )
    check_writable(directory, "name another directory with -o")


def make_room(directory: Path, stem: str, with_scenario: bool = False) -> Path | None:
    """Move a plan and all its results to the folder DIRECTORY/earlier/N.

    Args:
        stem: name of the plan; "plan" also moves "baseline" and "nominal".
        with_scenario: also move scenario.toml and all other plans.

    Returns:
        The folder, or None if there was nothing to move.

    Raises:
        SalverError: one of its campaigns is running, or a file cannot be moved.
    """
    found = _belongings(directory, stem)
    if with_scenario:
        found += [directory / f"{name}{end}" for name in known_stems(directory) for end in (".json", ".npz")]
        found.append(directory / SCENARIO)
    old = [path for path in dict.fromkeys(found) if path.exists()]
    if not old:
        return None
    for path in old:
        _check_idle(path)
    place = next(p for k in itertools.count(1) if not (p := directory / EARLIER / str(k)).exists())
    try:
        for path in old:
            target = place / path.relative_to(directory)
            target.parent.mkdir(parents=True, exist_ok=True)
            path.rename(target)
    except OSError as error:
        raise SalverError(f"{path} cannot be moved to {place}: {error.strerror}.") from None
    return place


def _belongings(directory: Path, stem: str) -> list[Path]:
    """Files and folders of a plan and its results; the plan is last, so that an interrupted move can be repeated."""
    stems = STEMS if stem == "plan" else (stem,)
    pages = sorted(directory.glob("report-leg*.html"))
    results = [directory / name for name in _SHARED_RESULTS] + pages + campaign_folders(directory)
    for folder in RECORDS:
        if stem == "plan":
            results.append(directory / folder)
        else:
            results += [*(directory / folder).glob(f"{stem}.*"), *(directory / folder).glob(f"{stem}-*")]
    return results + [directory / f"{name}{ending}" for name in stems[::-1] for ending in (".json", ".npz")]


def plan_digest(directory: Path, stem: str) -> str:
    """Digest of a plan, which its results record: that of its certificate (`salver.planning.certificate`) without the
    record of how it was planned. Raises SalverError when there is no such plan, FileFormatError when it has no
    certificate."""
    stem = file_stem(directory, stem)
    path = directory / f"{stem}.json"
    if not _holds(directory, stem):
        known = ", ".join(known_stems(directory)) or "none"
        raise SalverError(f'{directory} has no plan "{stem}" ({stem}.npz and .json); it has {known}.')
    record = read_json(path)
    certified = record.get(CERTIFICATE) if isinstance(record, dict) else None
    if not isinstance(certified, dict):
        raise FileFormatError(f"{path} has no certificate, which results need to name their plan; plan again.")
    return digest_of({key: value for key, value in certified.items() if key != "record"})[:12]


def _holds(directory: Path, stem: str) -> bool:
    stem = file_stem(directory, stem)
    return all((directory / f"{stem}{ending}").is_file() for ending in (".npz", ".json"))


def known_stems(directory: Path) -> list[str]:
    """Names of the plans in a run directory: those in `STEMS` first, then others."""
    found = {path.stem for path in directory.glob("*.npz")}
    first = [stem for stem in STEMS if stem in found]
    return first + sorted(found - set(first))


def save_record(
    directory: Path, folder: str, stem: str, arrays: Mapping[str, Any], summary: Mapping[str, Any], kind: str = ""
) -> Path:
    """Write the record of a run of the plan `stem` to DIRECTORY/FOLDER/STEM.npz and .json, with the plan's digest.

    kind: added to the file name if the run was not of the whole plan, so that it is not shown as one.
    Existing records of other runs are kept as STEM-1, STEM-2, ...
    """
    of_plan, verdict = {}, ""
    if _holds(directory, stem):
        verdict = plan_verdict(directory, stem)
        of_plan = {"plan_digest": plan_digest(directory, stem), "plan_verdict": verdict}
    return save_result(directory / folder / f"{stem}{kind}", {**arrays, "verdict": verdict}, {**summary, **of_plan})


def plan_verdict(directory: Path, stem: str) -> str:
    """The recorded verdict on the plan or leg `stem`; empty if there is none."""
    record, number = read_json(directory / f"{file_stem(directory, stem)}.json"), leg_number(stem)
    legs = record.get("legs") if number is not None else None
    return str((legs[number - 1] if legs and number else record).get("verdict", ""))


def check_digest(summary: Mapping[str, Any], path: Path, directory: Path, stem: str) -> None:
    """Raise FileFormatError when the summary at `path` is of another plan than the present plan `stem`."""
    if _holds(directory, stem) and summary.get("plan_digest") != plan_digest(directory, stem):
        raise FileFormatError(f"{path} is of another plan than {directory / stem}.npz; make it again.")


def campaign_folders(directory: Path) -> list[Path]:
    """Folders of a run directory that hold a campaign, finished or not."""
    return sorted({path.parent for name in ("journal.jsonl", "campaign.json") for path in directory.glob(f"*/{name}")})


def _check_idle(folder: Path) -> None:
    """Raise SalverError if a campaign holds the lock of `salver.campaigns.journal` in a folder."""
    lock = folder / "lock"
    if not lock.is_file():
        return
    with open(lock) as file:
        try:
            fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
        except OSError:
            raise SalverError(f"A campaign is running in {folder}; wait until it ends or stop it.") from None
