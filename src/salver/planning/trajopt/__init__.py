"""Optimal control of one motion: what is unknown, what is made small, what must hold, and the solver for all of it."""
