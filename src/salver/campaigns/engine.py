"""Run a campaign: the missing runs in parallel, with a journal, then a table and a summary."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Callable, Generator, Sequence
from contextlib import closing
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from salver.campaigns import workers
from salver.campaigns.definition import (
    DEFAULT_FOLDER,
    STOPS_FOLDER,
    SUMMARY,
    Definition,
    define,
    definition_in,
    load_scenario,
)
from salver.campaigns.journal import Item, Journal
from salver.campaigns.runners import Context
from salver.campaigns.summary import read_table, summarise, table, write_table
from salver.display import Shown
from salver.errors import FileFormatError, SalverError
from salver.files import provenance, read_json, sealed, write_json
from salver.planning.plan import Plan
from salver.planning.round import MultiLegPlan, load
from salver.run_directory import known_stems
from salver.tables import pandas_module

if TYPE_CHECKING:
    import pandas

TABLE = "runs.parquet"
Progress = Callable[[int, int, Counter[tuple[str, str]]], None]


@dataclass(frozen=True, repr=False)
class Campaign(Shown):
    """A finished campaign.

    folder: holds campaign.json and runs.parquet. summary: content of campaign.json.
    """

    folder: Path
    definition: Definition
    summary: dict[str, Any]

    def facts(self) -> dict[str, str]:
        """Facts that a notebook shows."""
        outcomes = {
            stem: ", ".join(f"{name} {rate['count']} of {rate['of']}" for name, rate in plan["outcomes"].items())
            for stem, plan in self.summary["plans"].items()
        }
        return {"scenario": str(self.summary["provenance"]["scenario"]), **outcomes}

    def to_pandas(self) -> pandas.DataFrame:
        """The runs, one row each: parameters, outcome, peaks. Raises MissingDependencyError without pandas."""
        return pandas_module().DataFrame(read_table(self.folder / TABLE))


def run_campaign(
    directory: str | Path,
    n: int = 100,
    seed: int = 0,
    method: str = "uniform",
    stems: Sequence[str] | None = None,
    jobs: int | None = None,
    folder: str | None = None,
    progress: Progress | None = None,
    *,
    stops: bool = False,
) -> Campaign:
    """Run each plan of a run directory n times, all plans on the same samples; an interrupted campaign resumes.

    Args:
        stems: names of the plans to run; default: the first two of "plan", "baseline" and "nominal" that exist.
        jobs: processes; default: one for each core, or this process for at most 4 runs.
        folder: in the run directory; default: "campaign", or "stops" with stops.
        progress: called as progress(done, total, counts by (stem, outcome)) after each run.
        stops: stop each run at a random instant by the plan's own stops; only for plans with stops.

    Raises:
        SalverError: a mistake, or another campaign in the folder, which is not overwritten.
    """
    directory = Path(directory)
    folder = (STOPS_FOLDER if stops else DEFAULT_FOLDER) if folder is None else folder
    stems = _chosen(directory, stems or (), stops)
    if jobs is not None and jobs < 1:
        raise SalverError(f"The number of jobs is {jobs}; it must be at least 1.")
    definition = define(directory, stems, n, seed, method, folder, stops)
    for stem in stems:
        load(directory, stem)  # raises when it was edited, even if no run is missing
    place = directory / folder
    with Journal(place) as journal:
        previous = _claim(place, definition)
        if previous is None and journal.records:
            raise SalverError(f"{place} holds runs but no {SUMMARY} that describes them; use another --folder.")
        wanted = {(stem, run) for stem in stems for run in range(n)}
        journal.records = {item: record for item, record in journal.records.items() if item in wanted}
        counts = Counter((r["stem"], r["outcome"]) for r in journal.records.values())
        if progress:
            progress(len(journal.records), len(wanted), counts)
        context = Context(directory, definition)
        missing = sorted(wanted - journal.records.keys(), key=lambda item: (item[1], stems.index(item[0])))
        if missing and journal.records and previous is not None:
            _same_versions(place, previous.get("provenance"), _provenance(directory))
        if missing:
            head = {"complete": False, "definition": asdict(definition), "provenance": _provenance(directory)}
            write_json(place / SUMMARY, head)
        with closing(_results(context, missing, jobs)) as results:
            for record in results:
                journal.append(record)
                counts[record["stem"], record["outcome"]] += 1
                if progress:
                    progress(len(journal.records), len(wanted), counts)
        rows = table(journal.records, stems)
    summary = {
        "complete": True,
        "definition": asdict(definition),
        **summarise(rows, stems, directory, folder),
        "table_digest": write_table(place / TABLE, rows),
        "provenance": _provenance(directory),
    }
    write_json(place / SUMMARY, sealed(summary))
    return Campaign(place, definition, summary)


def _chosen(directory: Path, stems: Sequence[str], stops: bool) -> list[str]:
    """Names of the plans to run: `stems`, or the first two in the directory. Raises SalverError."""
    load_scenario(directory)  # raises without a scenario
    known = known_stems(directory)
    if stops:
        known = [stem for stem in known if _has_stops(load(directory, stem))]
        lacking = [stem for stem in stems if stem not in known]
        if lacking or not known:
            stem = lacking[0] if lacking else "plan"
            raise SalverError(f"{directory / stem}.npz holds no plan with stops; plan it with `salver plan --stops`.")
    chosen = list(dict.fromkeys(stems or known[:2]))
    if not chosen:
        raise SalverError(f"{directory} holds no plan; make one with `salver plan`.")
    return chosen


def _has_stops(plan: Plan | MultiLegPlan) -> bool:
    """Whether a plan, or every leg of one, can be stopped."""
    return all(each.stops is not None for each in ([plan] if isinstance(plan, Plan) else plan.legs))


def _claim(place: Path, definition: Definition) -> dict[str, Any] | None:
    """The content of an existing campaign.json. Raises SalverError unless this campaign continues that one."""
    path = place / SUMMARY
    if not path.is_file():
        return None
    previous = read_json(path)
    existing = definition_in(previous, path)
    if not definition.extends(existing):
        raise SalverError(
            f"{place} holds another campaign: {existing.in_words()}; the new one is {definition.in_words()}. "
            "Use another --folder to keep both."
        )
    return dict(previous)


def _same_versions(place: Path, before: Any, now: dict[str, Any]) -> None:
    """Raise SalverError when other versions began the campaign, because all its runs must use the same."""
    if not isinstance(before, dict) or not isinstance(before.get("versions"), dict):
        raise FileFormatError(f"{place / SUMMARY} does not say which versions made it; use another --folder.")
    old, new = ({"salver": p.get("salver"), **p["versions"]} for p in (before, now))
    changed = [f"{name} {old.get(name)} (now {new[name]})" for name in new if old.get(name) != new[name]]
    if changed:
        raise SalverError(
            f"{place} was begun with {', '.join(changed)}; continue with those versions, or use another --folder."
        )


def _provenance(directory: Path) -> dict[str, Any]:
    return provenance(load_scenario(directory))


def _cores() -> int:
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _results(
    context: Context, items: list[Item], jobs: int | None, few: int = 4
) -> Generator[dict[str, Any], None, None]:
    """Records of runs, in the order of the items or as they finish. few: runs up to which this process makes them
    unless `jobs` are given, because loading the engine in others takes as long."""
    jobs = min(jobs or (_cores() if len(items) > few else 1), len(items))
    if jobs <= 1:
        yield from (context.execute(*item) for item in items)
    else:
        yield from workers.processes(context, items, jobs)
