"""Cells and tables of the page, as HTML."""

from __future__ import annotations

from collections.abc import Iterable
from html import escape

import numpy as np

from salver.report.style import GREY, OUTCOME_COLOURS, ROLE_COLOURS


def table(head: Iterable[str], rows: Iterable[Iterable[str]], numeric: Iterable[int] = ()) -> str:
    """HTML table; cells are HTML already, headings are text; columns of `numeric` are set right."""
    right = set(numeric)
    style = [' class="n"' if i in right else "" for i in range(64)]
    top = "".join(f"<th{style[i]}>{escape(cell)}</th>" for i, cell in enumerate(head))
    body = "".join(
        "<tr>" + "".join(f"<td{style[i]}>{cell}</td>" for i, cell in enumerate(row)) + "</tr>" for row in rows
    )
    return f"<table><thead><tr>{top}</tr></thead><tbody>{body}</tbody></table>"


def outcome_cell(word: str) -> str:
    """How a run ended, with its colour."""
    return _named(OUTCOME_COLOURS.get(word, GREY), word)


def percent(share: float) -> str:
    return f"{100 * share:.1f} %"


def number(value: float, digits: int, unit: str = "", otherwise: str = "–") -> str:
    """A number with a fixed number of digits and its unit; words when it is not finite."""
    return f"{value:.{digits}f}{unit}".replace("-", "−") if np.isfinite(value) else otherwise


def motion_cell(stem: str, label: str) -> str:
    """A motion's name with its colour."""
    return _named(ROLE_COLOURS[stem], label)


def _named(colour: str, text: str) -> str:
    return f'<span class="name"><span class="dot" style="background:{colour}"></span>{escape(text)}</span>'
