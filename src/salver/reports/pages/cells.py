"""Cells and tables of the page, as HTML.

HTML is `Markup`, whose `format`, `join` and `+` escape whatever is not: no value reaches the page but as text.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

from markupsafe import Markup

from salver.reports.style import GREY, OUTCOME_COLOURS, ROLE_COLOURS

NOTHING = Markup("")


def table(head: Iterable[object], rows: Iterable[Iterable[object]], numeric: Iterable[int] = ()) -> Markup:
    """HTML table; cells that are not `Markup` are text; columns of `numeric` are set right."""
    right = set(numeric)

    def row(kind: str, cells: Iterable[object]) -> Markup:
        made = (
            Markup("<{0}{1}>{2}</{0}>").format(Markup(kind), Markup(' class="n"') if i in right else "", cell)
            for i, cell in enumerate(cells)
        )
        return Markup("<tr>{}</tr>").format(joined(made))

    body = joined(row("td", cells) for cells in rows)
    return Markup("<table><thead>{}</thead><tbody>{}</tbody></table>").format(row("th", head), body)


def joined(parts: Iterable[object]) -> Markup:
    """Parts one after the other."""
    return NOTHING.join(parts)  # type: ignore[arg-type]


def outcome_cell(word: object) -> Markup:
    """The outcome of a run, with its colour."""
    return _named(OUTCOME_COLOURS.get(str(word), GREY), word)


def percent(share: float) -> str:
    return f"{100 * share:.1f} %"


def motion_cell(stem: str, label: str) -> Markup:
    """A motion's name with its colour."""
    return _named(ROLE_COLOURS[stem], label)


def speed_bar(speeds: Mapping[str, Any] | None) -> Markup:
    """At which constant shares of full speed a motion keeps its load. speeds: as `SafeSpeeds.summary`; nothing for
    None."""
    if speeds is None:
        return NOTHING
    held = joined(
        Markup('<i style="left:{:.2f}%;width:{:.2f}%"></i>').format(100 * low, 100 * max(high - low, 0.004))
        for low, high in speeds["intervals"]
    )
    ticks = joined(Markup("<span>{} %</span>").format(share) for share in (0, 25, 50, 75, 100))
    note = f"{speeds['sentence']} Green: constant speeds at which the load stays; red: it does not."
    return Markup(
        '<div class="speeds"><h3>Speeds at which it holds</h3><p class="note">{}</p><div class="scale">{}</div>'
        '<div class="ticks">{}</div></div>'
    ).format(note, held, ticks)


def _named(colour: str, text: object) -> Markup:
    return Markup('<span class="name"><span class="dot" style="background:{}"></span>{}</span>').format(colour, text)
