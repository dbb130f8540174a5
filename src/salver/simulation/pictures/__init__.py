"""Pictures of a run in the physics engine."""
