"""The scene in the physics engine: arm, tray, true loads, what swings in them, obstacles."""
