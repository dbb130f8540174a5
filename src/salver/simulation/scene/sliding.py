"""Kinetic friction of the engine's contacts: a share of their static friction while they slide.

MuJoCo has one coefficient for each pair of geoms. Before each command, the coefficient of each pair that touches is set
by the largest sliding velocity at its contacts. Contacts that hold creep more slowly than `SLIDES`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Self

import numpy as np

from salver.geometry import Array, Indices
from salver.simulation.scene.engine import mujoco

SLIDES = 5e-3  # m/s, from which on a contact has kinetic friction


@dataclass(frozen=True)
class Sliding:
    """Friction of the pairs of geoms of a model.

    share: kinetic over static friction. static: (n_pairs, 5) coefficients of MuJoCo. pairs: index of the pair of two
    geoms.
    """

    share: float
    static: Array
    pairs: dict[tuple[int, int], int]

    @classmethod
    def of(cls, model: Any, share: float) -> Self:
        each = np.sort(np.column_stack([model.pair_geom1, model.pair_geom2]), axis=1)
        return cls(share, model.pair_friction.copy(), {(a, b): k for k, (a, b) in enumerate(each.tolist())})

    def apply(self, model: Any, data: Any) -> None:
        """Set the friction of the pairs that touch by the velocities in `data`; feet that chatter keep theirs."""
        if not data.ncon:
            return
        geoms, place = np.sort(data.contact.geom, axis=1), data.contact.pos
        first, second = (_velocity(model, data, geoms[:, k], place) for k in (0, 1))
        normal = data.contact.frame[:, :3]
        past = second - first
        past -= np.einsum("ci,ci->c", past, normal)[:, None] * normal
        slides = (np.linalg.norm(past, axis=1) > SLIDES).tolist()
        for sliding, one, other in sorted(zip(slides, *geoms.T.tolist(), strict=True)):  # the contacts that slide last
            if (pair := self.pairs.get((one, other))) is not None:
                model.pair_friction[pair] = self.static[pair] * (self.share if sliding else 1.0)


def _velocity(model: Any, data: Any, geoms: Indices, place: Array) -> Array:
    """Velocities (K, 3) of points (K, 3) that move with the bodies of geoms."""
    found = np.empty((len(geoms), 3))
    twist = np.empty(6)  # angular and linear velocity at the body's origin, in the world's axes
    for k, body in enumerate(model.geom_bodyid[geoms]):
        mujoco.mj_objectVelocity(model, data, mujoco.mjtObj.mjOBJ_XBODY, body, twist, 0)
        found[k] = twist[3:] + np.cross(twist[:3], place[k] - data.xpos[body])
    return found
