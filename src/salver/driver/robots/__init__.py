"""Robots that can be driven: what a robot is to the loop, and those that are known by name."""
