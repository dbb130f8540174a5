"""The parameters of a load from logs: sensors, excitation trajectories, estimates, ranges."""
