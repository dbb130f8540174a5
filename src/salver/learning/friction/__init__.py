"""Friction from logs, and tilts that test it."""
