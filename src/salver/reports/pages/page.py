"""`salver report`: one self-contained page for a run directory, to be opened from disk without a network."""

from __future__ import annotations

import base64
import hashlib
import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from datetime import UTC, datetime
from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import quote

import numpy as np
from markupsafe import Markup, escape

from salver.files import output_file, versions, write_atomic
from salver.planning.plan_files import read_files
from salver.planning.round import has_legs
from salver.reports.pages import sections
from salver.reports.pages.cells import NOTHING, joined, table
from salver.reports.pages.charts import thin
from salver.reports.pages.replay import replay_scene
from salver.reports.pages.round import overview
from salver.reports.pages.sections import Sections
from salver.reports.pages.words import Headline, asked, outcome_in_words, true_parameters, verdict
from salver.reports.parameters import ranges
from salver.reports.run import ReportedMotion, ReportedRun, read_campaign, read_leg, read_run
from salver.reports.style import ROLE_COLOURS
from salver.scenario import Scenario
from salver.wording import listed

if TYPE_CHECKING:
    from salver.models.arm.arm import ArmModel


def write_report(
    directory: str | Path, path: str | Path | None = None, say: Callable[[str], None] = lambda text: None
) -> Path:
    """Write the page of a run directory, by default DIR/report.html. Returns where it is.

    Shows what the directory has: a plan alone, with a simulation, with a campaign. say: told what is left out and why.
    Another file that stands at `path` is kept, numbered. Raises FileFormatError when it is no run directory,
    SalverError when `path` is no place for the page.
    """
    target = output_file(path, (".html", ".htm")) if path is not None else Path(directory) / "report.html"
    if has_legs(directory):
        return _write_legs(Path(directory), target, say, keep=path is not None)
    run = read_run(directory)
    for note in run.notes:
        say(note)
    return write_atomic(target, page(run), keep=path is not None)


def _write_legs(directory: Path, target: Path, say: Callable[[str], None], *, keep: bool) -> Path:
    """The page of a task of several legs, and one of each leg beside it; returns the first."""
    files = read_files(directory)
    runs = [read_leg(directory, k + 1) for k in range(len(files.scenario.legs))]
    notes = [note for run in runs for note in run.notes]
    campaign, _ = read_campaign(directory, notes)
    for note in notes:
        say(note)
    places = [target.with_name(f"{target.stem}-leg{k + 1}{target.suffix}") for k in range(len(runs))]
    for k, (run, place) in enumerate(zip(runs, places, strict=True)):
        others = [("All legs", target), *((f"Leg {i + 1}", p) for i, p in enumerate(places) if i != k)]
        links = joined(Markup('<a href="{}">{}</a>').format(quote(path.name), name) for name, path in others)
        write_atomic(place, page(run, links), keep=keep)
    answer, made, task, shown = overview(files, runs, places, campaign)
    name, source = files.scenario.name, directory.name or str(directory)
    whole = filled(
        answer, made, None, name=name, asked=task, notes=[*warned(files.record), *notes], tiles=shown, source=source,
        scenarios=[run.scenario for run in runs],
    )  # fmt: skip
    return write_atomic(target, whole, keep=keep)


def page(run: ReportedRun, others: Markup = NOTHING) -> str:
    """The whole page as text. others: links to pages that belong to it."""
    moved = run.scenario.arm is not None and all("q" in m.arrays for m in run.motions)
    arm = run.scenario.load_arm() if moved else None
    made = sections.build(run, arm)
    return filled(
        verdict(run),
        made,
        replay(run, arm),
        name=run.scenario.name,
        asked=asked(run),
        notes=[*warned(run.plan.summary), *run.notes],
        tiles=sections.tiles(run),
        source=run.directory.name or str(run.directory),
        scenarios=[run.scenario],
        others=others,
    )


def warned(record: Mapping[str, Any]) -> list[str]:
    """The warnings that a plan's record holds, to stand before everything else."""
    return [f"Warning: {sentence}" for sentence in record.get("warnings", [])]


def filled(
    answer: Headline,
    made: Sections,
    shown: dict[str, Any] | None,
    *,
    name: str,
    asked: str,
    notes: Sequence[str],
    tiles: Iterable[sections.Tile],
    source: str,
    scenarios: Sequence[Scenario],
    others: Markup = NOTHING,
) -> str:
    """A page of salver: the template with all its parts. shown: its replay; None for a page of
    words and tables alone."""
    titles = made.titles if shown is not None else [title for title in made.titles if title[0] != "replay"]
    body = fill(
        asset("page.html"),
        name=name,
        level=answer.level,
        headline=answer.headline,
        detail=answer.detail,
        asked=asked,
        notes=joined(Markup('<p class="note">{}</p>').format(note) for note in notes),
        tiles=joined(Markup("<div><dt>{}</dt><dd>{}<small>{}</small></dd></div>").format(*tile) for tile in tiles),
        navigation=others + joined(Markup('<a href="#{}">{}</a>').format(key, title) for key, title in titles),
        replay=NOTHING if shown is None else Markup(asset("replay.html")),
        sections=made.html,
        review=review(scenarios),
        version=versions()["salver"],
        date=_today(),
        directory=source,
    )
    title = f"{name}: {answer.headline}"
    if shown is None:
        return framed(body, title, {}, "", asset("page.css"))
    script = asset("viewer.js") + asset("plots.js") + asset("main.js")
    return framed(body, title, {"replay": shown, "charts": made.specs}, script, asset("page.css"))


def framed(body: str, title: str, data: Any, script: str, css: str, asks: str = "'none'") -> str:
    """A whole page: the body in the frame of all pages, with the data that its script reads. asks: whom it may ask."""
    return fill(
        asset("frame.html"),
        title=title,
        css=Markup(css),
        policy=policy(script, asks),
        body=Markup(body),
        # "<" could end the script element, or begin a comment in it; in JSON "\\u003c" is the same text.
        data=Markup(json.dumps(data, separators=(",", ":"), allow_nan=False).replace("<", "\\u003c")),
        script=Markup(script),
    )


def review(scenarios: Sequence[Scenario]) -> Markup:
    """The part of a printed page for a safety review: ranges of the verdict, versions, a line to sign."""
    rows = dict.fromkeys(
        (name, f"{nominal} ± {half}") for s in scenarios for name, nominal, half in ranges(s.payload.uncertain)
    )
    known = (
        table(("The verdict is for", ""), rows) if rows else Markup("<p>The verdict is for the exact values alone.</p>")
    )
    lines = joined(Markup("<span>{}</span>").format(text) for text in ("Reviewed by", "Date", "Signature"))
    digests = listed(list(dict.fromkeys(s.digest for s in scenarios)))
    made = f"Scenario {digests}; page made by salver {versions()['salver']} on {_today()}."
    return Markup('{}<p>{}</p><div class="sign">{}</div>').format(known, made, lines)


def _today() -> str:
    return f"{datetime.now(UTC):%Y-%m-%d}"


def policy(script: str, asks: str) -> Markup:
    """The page's content security policy: only the page's own script may run. asks: whom it may ask."""
    digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
    return Markup(
        "default-src 'none'; style-src 'unsafe-inline'; script-src 'sha256-{}'; img-src data:; connect-src "
    ).format(digest) + Markup(asks)


def fill(template: str, **parts: str) -> str:
    """Replace each {{key}} of a template in one pass; inserted text is not searched again.

    What is not `Markup` is text.
    """
    pieces = template.split("{{")
    out = [pieces[0]]
    for piece in pieces[1:]:
        key, rest = piece.split("}}", 1)
        out += [escape(parts[key]), rest]
    return "".join(out)


def asset(name: str, package: str = "salver.reports") -> str:
    """A file of a page's template."""
    return resources.files(package).joinpath("assets", name).read_text(encoding="utf-8")


def replay(run: ReportedRun, arm: ArmModel | None) -> dict[str, Any]:
    """The 3-D scene, a caption for each motion, and friction in use over time (1 at its largest) for the scrubber."""
    scene = replay_scene(run, arm)
    used = []
    for motion, variant in zip(run.motions, scene["variants"], strict=True):
        variant["caption"] = _caption(run, motion)
        used.append(np.clip(np.nan_to_num(run.contact[motion.stem].friction, posinf=1.0), 0.0, 1.0))
    largest = max(float(np.max(share)) for share in used) or 1.0
    strips = []
    for motion, share in zip(run.motions, used, strict=True):
        t, y = thin(run.contact[motion.stem].t, share / largest)
        strips.append({"x": t, "y": y, "colour": ROLE_COLOURS[motion.stem]})
    scene["strips"] = strips
    return scene


def _caption(run: ReportedRun, motion: ReportedMotion) -> str:
    """Caption of the replay of a motion."""
    if motion.seen is None:
        return "as planned"
    summary = motion.seen.summary
    true = true_parameters(run, summary)
    source = "what if" if motion.seen is motion.what_if else summary.get("source", "physics engine")
    return f"{source}{f', {true}' if true else ''}: {outcome_in_words(str(summary.get('outcome', 'unknown')))}"
