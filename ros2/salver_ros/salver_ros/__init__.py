"""A node that carries loose objects on a tray through ros2_control. `carrier` is its logic, without middleware."""
