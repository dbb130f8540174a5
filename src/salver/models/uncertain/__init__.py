"""Uncertain parameters, their set, and the worst case over it."""
