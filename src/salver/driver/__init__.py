"""Driving an arm along a plan: checks before the motion, the control loop, the log."""
