"""Identification of the load from logs: ranges of its parameters that contain the true values."""

from salver.learning.load.identify import Identified, identify
from salver.learning.load.ranges import Range
from salver.learning.load.systematic import SensorBounds
from salver.learning.logs import Log, read_log

__all__ = ["Identified", "Log", "Range", "SensorBounds", "identify", "read_log"]
