"""The page of a run as an object: shown in a notebook, and written to a path."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING

from markupsafe import Markup

from salver.auditing import Audit
from salver.files import output_file, write_atomic
from salver.reports.pages.audit_page import audit_page
from salver.reports.pages.page import page, write_report
from salver.reports.run import read_run

if TYPE_CHECKING:
    from salver.planning.plan import Plan
    from salver.simulation.record import SimulationRecord


@dataclass(frozen=True, repr=False)
class Page:
    """html: the whole page, which needs no other file. path: where it was written, None if nowhere."""

    html: str
    path: Path | None = None

    def __repr__(self) -> str:
        where = "not written" if self.path is None else str(self.path)
        return f"<Page {where}, {len(self.html) / 1e6:.1f} MB>"

    def _repr_html_(self) -> str:
        """A frame of its own: the page's script sees nothing of the notebook."""
        frame = Markup('<iframe srcdoc="{}" sandbox="allow-scripts" style="width:100%;height:760px;border:0"></iframe>')
        return str(frame.format(self.html))


def page_of(of: Plan | Audit | str | Path, run: SimulationRecord | None = None, path: str | Path | None = None) -> Page:
    """The page of a run directory (written to `path`, by default DIR/report.html), or of a plan that need not be saved
    (written if there is a `path`), with a run of it in the engine; or that of an audit."""
    if isinstance(of, str | Path):
        written = write_report(of, path)
        return Page(written.read_text(encoding="utf-8"), written)
    target = None if path is None else output_file(path, (".html", ".htm"))
    if isinstance(of, Audit):
        html = audit_page(of)
        return Page(html, None if target is None else write_atomic(target, html, keep=True))
    with TemporaryDirectory() as folder:
        directory = Path(folder) / of.scenario.name
        of.save(directory)
        if run is not None:
            run.save(directory)
        html = page(read_run(directory))
    return Page(html, None if target is None else write_atomic(target, html, keep=True))
