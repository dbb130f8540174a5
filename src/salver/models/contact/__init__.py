"""Contact: grasp maps, friction and wrench cones, internal wrenches of objects on several supports."""
