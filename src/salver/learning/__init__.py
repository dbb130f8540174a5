"""The load's parameters from logs of carrying it: ranges that cover the truth, not points."""

from salver.learning.identify import Identified, identify
from salver.learning.logs import Log, read_log
from salver.learning.ranges import Range
from salver.learning.systematic import SensorBounds

__all__ = ["Identified", "Log", "Range", "SensorBounds", "identify", "read_log"]
