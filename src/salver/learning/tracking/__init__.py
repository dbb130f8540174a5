"""Tracking of a plan by a robot: the executed motion, its deviation, the corrected command."""
