"""A live motion that is steered by hand, with the load in the physics engine."""

from salver.playground.world import World

__all__ = ["World"]
