"""Uncertain parameters, the set they lie in, and the worst case over it."""
