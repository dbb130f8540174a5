"""Commands that learn from logs: calibration, the load, the tracking of an arm."""
