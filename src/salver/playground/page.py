"""The page of the playground: the viewer of the reports, with a hand in it."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from salver.reports.pages.local_page import filled
from salver.reports.pages.replay import joint_poses, stage, still, viewpoint
from salver.reports.style import BLUE

if TYPE_CHECKING:
    from salver.playground.world import World


def page(world: World) -> bytes:
    """The whole page; all that it asks for is on this machine."""
    name = world.scenario.name
    return filled("salver.playground", "live", _scene(world), title=f"{name}, live", name=name)


def _scene(world: World) -> dict[str, Any]:
    arm, bodies, base = world.arm, world.scenario.payload.bodies, world.arm.base_position
    joints, tray = joint_poses(world.begin[None], arm)[0], arm.tray_pose(world.begin)
    corners = np.vstack([joints[:, :3], base, tray[0]])
    return {
        **stage(world.scenario, bodies, arm),
        "variants": [still("live", BLUE, bodies, tray, joints, [base.tolist(), base.tolist()])],
        **viewpoint(corners, base, tray[0], world.scenario.floor),
        "first": world.frame(),
    }
