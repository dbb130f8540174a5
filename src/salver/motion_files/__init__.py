"""Reading and writing of motion files: CSV, ROS messages as YAML and JSON (also of MoveIt), ROS bags.

`read` returns samples of the tray or of the joints; `write` writes a `MotionSeries`.
"""

from salver.motion_files.motion import MotionSeries
from salver.motion_files.readers import of_columns, read, read_path
from salver.motion_files.samples import JointSamples, Samples, TraySamples
from salver.motion_files.writers import ENDINGS, form_of, write

__all__ = [
    "ENDINGS",
    "JointSamples",
    "MotionSeries",
    "Samples",
    "TraySamples",
    "form_of",
    "of_columns",
    "read",
    "read_path",
    "write",
]
