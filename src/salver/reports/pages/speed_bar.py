"""The bar of a page that shows at which constant shares of full speed a motion keeps its load."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from markupsafe import Markup

from salver.reports.style import GREEN, VERMILION

_RECT = Markup('<rect x="{:.2f}" y="4" width="{:.2f}" height="14" fill="{}"/>')
_TICK = Markup('<text x="{}" y="{}" text-anchor="middle" font-size="11" fill="currentColor">{}</text>')
_LEFT, _WIDTH = 20, 400  # of the bar in its drawing


def speed_bar(speeds: Mapping[str, Any] | None) -> Markup:
    """The bar, its axis in per cent, and the sentence. speeds: as `SafeSpeeds.summary`; nothing for None."""
    if speeds is None:
        return Markup("")
    bar = _RECT.format(_LEFT, _WIDTH, VERMILION)
    for low, high in speeds["intervals"]:
        bar += _RECT.format(_LEFT + _WIDTH * low, max(_WIDTH * (high - low), 1.5), GREEN)
    for percent in (0, 25, 50, 75, 100):
        bar += _TICK.format(_LEFT + _WIDTH * percent / 100, 32, percent)
    bar += _TICK.format(_LEFT + _WIDTH / 2, 47, "constant speed, % of full speed")
    return Markup(
        '<div class="speeds"><h3>Speeds at which it holds</h3><p class="note">{}</p>'
        '<svg viewBox="0 0 440 52" width="440" height="52" role="img" aria-label="{}">{}</svg></div>'
    ).format(f"{speeds['sentence']} Green: the load stays; red: it does not.", speeds["sentence"], bar)
