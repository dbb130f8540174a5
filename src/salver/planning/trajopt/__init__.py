"""Trajectory optimisation of one motion: variables, objectives, constraints and the solver."""
