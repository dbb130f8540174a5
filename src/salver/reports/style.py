"""Colours of pages and figures: of Okabe and Ito's set, distinct to every kind of colour vision."""

from __future__ import annotations

BLUE = "#0072B2"
VERMILION = "#D55E00"
GREEN = "#009E73"
AMBER = "#E69F00"
SKY = "#56B4E9"
MAUVE = "#CC79A7"
BLACK = "#1b2430"
GREY = "#7a8490"

ROLE_COLOURS = {"plan": BLUE, "baseline": VERMILION, "nominal": VERMILION}
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


def rgb(colour: str) -> list[float]:
    """Hexadecimal colour to three numbers from 0 to 1."""
    return [round(int(colour[i : i + 2], 16) / 255, 4) for i in (1, 3, 5)]
