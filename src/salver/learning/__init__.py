"""What the load is, from logs of its being carried: ranges that cover the truth, not points."""

from salver.learning.identify import Identified, identify
from salver.learning.logs import Log, read_log
from salver.learning.ranges import Ellipsoid, Range

__all__ = ["Ellipsoid", "Identified", "Log", "Range", "identify", "read_log"]
