"""Driving an arm along a plan: checks before, the loop, what is logged after."""
