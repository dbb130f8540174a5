"""What the load is, from logs of its being carried: ranges that cover the truth, not points."""

from salver.learning.identify import Identified, Range, identify
from salver.learning.logs import Log, read_log

__all__ = ["Identified", "Log", "Range", "identify", "read_log"]
