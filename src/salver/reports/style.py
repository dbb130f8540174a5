"""Colours and type of figures and pages, in one place.

A plan and what it is compared with take two colours of Okabe and Ito's set (distinct to every kind of colour vision),
and the latter is dashed besides: figures survive a black-and-white printer.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

BLUE = "#0072B2"
VERMILION = "#D55E00"
GREEN = "#009E73"
AMBER = "#E69F00"
SKY = "#56B4E9"
MAUVE = "#CC79A7"
BLACK = "#1b2430"
GREY = "#7a8490"

ROLE_COLOURS = {"plan": BLUE, "baseline": VERMILION, "nominal": VERMILION}
ROLE_DASHES = {"plan": "-", "baseline": (0, (5, 2)), "nominal": (0, (5, 2))}
CYCLE = (BLUE, VERMILION, GREEN, AMBER, MAUVE, SKY, BLACK, GREY)
OUTCOME_COLOURS = {
    "holds": GREEN,
    "slides": AMBER,
    "spills": AMBER,
    "swings": AMBER,
    "tips": VERMILION,
    "lifts": MAUVE,
    "lost": BLACK,
    "limit": GREY,
    "error": GREY,
}
TRAY_COLOUR = "#3c4753"
OBSTACLE_COLOUR = "#a5816b"
OBJECT_COLOURS = (AMBER, SKY, GREEN, MAUVE)

COLUMN = 3.45  # in, width of a column of a two-column paper
PAGE = 7.1  # in, width of its page

RC: dict[Any, Any] = {
    "font.size": 8,
    "font.family": "DejaVu Sans",
    "mathtext.fontset": "dejavusans",
    "axes.titlesize": 8,
    "axes.labelsize": 8,
    "xtick.labelsize": 7,
    "ytick.labelsize": 7,
    "legend.fontsize": 7,
    "legend.frameon": False,
    "legend.handlelength": 1.8,
    "axes.linewidth": 0.6,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "grid.color": "#e6e9ec",
    "grid.linewidth": 0.5,
    "axes.axisbelow": True,
    "xtick.major.width": 0.6,
    "ytick.major.width": 0.6,
    "lines.linewidth": 1.2,
    "figure.dpi": 100,
    "savefig.dpi": 220,
    "savefig.bbox": "tight",
    "savefig.pad_inches": 0.03,
    "pdf.fonttype": 42,  # text stays text: journals ask for embedded TrueType
    "svg.fonttype": "none",
    "svg.hashsalt": "salver",  # same data, same file
}


def rgb(colour: str) -> list[float]:
    """Hexadecimal colour to three numbers from 0 to 1."""
    return [round(int(colour[i : i + 2], 16) / 255, 4) for i in (1, 3, 5)]


@contextmanager
def paper_style() -> Iterator[None]:
    """matplotlib's settings for the figures of a paper, restored afterwards. Figures are made without pyplot, so
    no display is needed and nothing global is left behind."""
    import matplotlib

    with matplotlib.rc_context(RC):
        yield
