"""Makes the film at the top of the README: python docs/make_film.py. Needs OpenGL (EGL or OSMesa).

The second half of `salver demo`: the tall bottle with its two motions, and the same true bottle filmed with both.
"""

from __future__ import annotations

import tempfile
from pathlib import Path

from salver.cli.plans.demo import BOTTLE, experiment
from salver.reports.film import write_film

FILM = Path(__file__).parent / "images" / "bottle.gif"


def main() -> None:
    with tempfile.TemporaryDirectory() as name:
        found = experiment(BOTTLE, "fastest", "nominal", Path(name), n=20, seed=0, quiet=True)
        FILM.unlink(missing_ok=True)  # or it would be kept beside the new one
        film = write_film(name, FILM, rate=20, speed=0.5, width=360, height=300)
    for stem, plan in found["campaign"]["plans"].items():
        print(stem, found[stem]["duration"], {name: rate["count"] for name, rate in plan["outcomes"].items()})
    print(f"{film.path}: {film.frames} pictures, {film.path.stat().st_size / 1e6:.1f} MB")


if __name__ == "__main__":
    main()
