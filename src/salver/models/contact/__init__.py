"""Contact: grasp maps, friction and wrench cones, internal wrenches of what stands on several supports."""
