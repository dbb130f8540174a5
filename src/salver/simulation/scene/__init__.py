"""The scene in the physics engine: arm, tray, true loads, obstacles, liquids."""
