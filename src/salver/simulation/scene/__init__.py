"""The scene in the physics engine: arm, tray, true loads with liquids and pendulums, obstacles."""
