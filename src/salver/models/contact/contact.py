"""Contacts between object and tray: frames, grasp matrix, friction cones, grasp map (paper, eqs 2-5)."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from salver.geometry import Array, adjoint, invert

# Point contact with friction: only forces cross the contact (eq 3, right).
SELECTION_BC: Array = np.vstack([np.eye(3), np.zeros((3, 3))])


@dataclass(frozen=True)
class ContactSet:
    """Point contacts with friction on one body.

    p_BC: (n_c, 3) contact points in B, m. R_BC: (n_c, 3, 3), z the inward normal.
    friction: (n_c,) Coulomb coefficients. edges: k >= 3 edges of each linearised cone (eq 4), inscribed.
    phase: angle of the first edge about the normal, rad. on_walls: the last so many points are on walls of a rim, the
    others on the base.
    """

    p_BC: Array
    R_BC: Array
    friction: Array
    edges: int = 4
    phase: float = 0.0
    on_walls: int = 0

    @property
    def count(self) -> int:
        return len(self.p_BC)

    @property
    def base(self) -> ContactSet:
        """The points on the base alone."""
        return self._only(slice(self.count - self.on_walls), 0)

    @property
    def walls(self) -> ContactSet:
        """The points on walls alone."""
        return self._only(slice(self.count - self.on_walls, None), self.on_walls)

    def _only(self, some: slice, on_walls: int) -> ContactSet:
        return replace(
            self, p_BC=self.p_BC[some], R_BC=self.R_BC[some], friction=self.friction[some], on_walls=on_walls
        )

    def joined(self, walls: ContactSet) -> ContactSet:
        """A contact set with these points, then those on walls, all with the cone edges of this set."""
        p_BC, R_BC = np.concatenate([self.p_BC, walls.p_BC]), np.concatenate([self.R_BC, walls.R_BC])
        friction = np.concatenate([self.friction, walls.friction])
        return replace(self, p_BC=p_BC, R_BC=R_BC, friction=friction, on_walls=walls.count)

    def of_friction(self, friction: float) -> ContactSet:
        """The points with another friction of the base."""
        return replace(self.base, friction=np.full(self.count - self.on_walls, friction)).joined(self.walls)

    @property
    def grasp_matrix(self) -> Array:
        """G (6, 3 n_c): stacked contact forces in their frames to the wrench at B (eq 2)."""
        p_CB, R_CB = invert(self.p_BC, self.R_BC)
        blocks = np.swapaxes(adjoint(p_CB, R_CB), -1, -2) @ SELECTION_BC
        return np.concatenate(list(blocks), axis=1)

    @property
    def cone_edges(self) -> Array:
        """F-hat (3 n_c, n_c k), block diagonal: coefficients Lambda to contact forces (eq 5)."""
        matrix = np.zeros((3 * self.count, self.edges * self.count))
        for i, mu in enumerate(self.friction):
            rows, columns = slice(3 * i, 3 * i + 3), slice(self.edges * i, self.edges * (i + 1))
            matrix[rows, columns] = cone_edges(mu, self.edges, self.phase)
        return matrix

    @property
    def grasp_map(self) -> Array:
        """G F-hat (6, n_c k): cone coefficients to the wrench at B."""
        return self.grasp_matrix @ self.cone_edges


def cone_edges(friction: float, edges: int = 4, phase: float = 0.0) -> Array:
    """Unit edges (3, k) of a pyramid inscribed in the friction cone about z (eq 4)."""
    angle = phase + 2 * np.pi * np.arange(edges) / edges
    rays = np.stack([friction * np.cos(angle), friction * np.sin(angle), np.ones(edges)])
    return rays / np.sqrt(1 + friction**2)


def support_contacts(
    points_B: npt.ArrayLike, friction: float | npt.ArrayLike, edges: int = 4, phase: float = 0.0
) -> ContactSet:
    """Contacts at support points (n_c, 3) of an object standing on a plane parallel to B's xy plane."""
    points = np.asarray(points_B, dtype=float)
    mu = np.broadcast_to(np.asarray(friction, dtype=float), (len(points),)).copy()
    return ContactSet(points, np.broadcast_to(np.eye(3), (len(points), 3, 3)).copy(), mu, edges, phase)
