"""The page of the playground: the viewer of the reports, with a hand in it."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any

import numpy as np
from markupsafe import Markup

from salver.files import versions
from salver.reports.pages.page import asset, fill, policy
from salver.reports.pages.replay import joint_poses, liquid, stage
from salver.reports.style import BLUE, rgb

if TYPE_CHECKING:
    from salver.playground.world import World

OURS = "salver.playground"


def page(world: World) -> str:
    """The whole page as text; all that it asks for is on this machine."""
    script = asset("viewer.js") + asset("plots.js") + asset("live.js", OURS)
    return fill(
        asset("live.html", OURS),
        title=f"{world.scenario.name}, live",
        name=world.scenario.name,
        css=Markup(asset("page.css") + asset("live.css", OURS)),
        policy=policy(script, "'self'"),
        version=versions()["salver"],
        # "<" could end the script element, or begin a comment in it; in JSON "\\u003c" is the same text.
        data=Markup(json.dumps(_scene(world), separators=(",", ":"), allow_nan=False).replace("<", "\\u003c")),
        script=Markup(script),
    )


def _scene(world: World) -> dict[str, Any]:
    arm, first = world.arm, world.frame()
    links = joint_poses(world.begin[None], arm)[0, :, :3]
    base, tray = arm.base_position, np.array(first["tray"][:3])
    out = tray[:2] - base[:2]
    corners = np.vstack([links, base, tray])
    return {
        **stage(world.scenario, world.scenario.payload.bodies, arm),
        "variants": [
            {
                "key": "live",
                "colour": rgb(BLUE),
                "t": [0.0],
                "joints": "",
                "tray": "",
                "objects": "",
                "contactCount": 0,
                "contacts": "",
                "forces": "",
                "friction": 0.0,
                "metresPerNewton": 0.0,
                "liquids": [surface and liquid(surface, np.array([0])) for surface in world.liquids.shown],
                "path": [base.tolist(), base.tolist()],
            }
        ],
        "bounds": [(corners.min(axis=0) - [0.2, 0.2, 0]).tolist(), (corners.max(axis=0) + 0.2).tolist()],
        "floor": float(base[2]) if world.scenario.floor is None else world.scenario.floor,
        "azimuth": float(np.arctan2(out[1], out[0])) + 0.6,  # rad off the way in which the arm reaches
        "first": first,
    }
