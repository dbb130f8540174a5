"""Robots that can be driven: the interface of a robot, and the robots that are known by name."""
