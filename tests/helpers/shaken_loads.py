"""What tests of waves have in common: a box of water or a lamp in place of the cup, and a tray that is shaken."""

from __future__ import annotations

import numpy as np

from salver.models.tray_motion import at_rest

BOX_IN = {"kind": "water", "size": [0.09, 0.06], "fill": 0.05, "brim": 0.08}
BOX = {"objects__0__shape": {"type": "box", "size": [0.1, 0.07, 0.085]}, "objects__0__liquid": BOX_IN}
LAMP = {
    "name": "lamp",
    "shape": {"type": "cylinder", "radius": 0.04, "height": 0.16},
    "mass": 0.25,
    "friction": 0.4,
    "pendulum": {"mass": 0.15, "length": 0.10, "pivot": 0.14, "widest_deg": 15.0, "damping": [0.0, 0.02]},
    "uncertainty": {"length": "2%", "mass": "5%", "friction": "5%"},
}


def shaken(t: np.ndarray, yaw: float = 25.0) -> np.ndarray:
    """What a tray feels that lifts, tilts and turns, from rest to rest."""
    s = t / t[-1]
    w = np.tile(at_rest(), (len(t), 1))
    w[:, 0], w[:, 1] = 3 * np.sin(2 * np.pi * s), 1.5 * np.sin(3 * np.pi * s) ** 3
    w[:, 2] += 2 * np.sin(9 * t) * np.sin(np.pi * s) ** 2
    w[:, 3], w[:, 4], w[:, 5] = 4 * np.sin(2 * np.pi * s), -5 * np.sin(4 * np.pi * s), yaw * np.sin(2 * np.pi * s)
    w[:, 6] = np.sin(np.pi * s) ** 2
    w[:, 8] = 0.3 * w[:, 6]
    return w
