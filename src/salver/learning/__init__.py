"""The load's parameters from logs of carrying it: ranges that cover the truth, not points."""

from salver.learning.load.identify import Identified, identify
from salver.learning.load.ranges import Range
from salver.learning.load.systematic import SensorBounds
from salver.learning.logs import Log, read_log

__all__ = ["Identified", "Log", "Range", "SensorBounds", "identify", "read_log"]
