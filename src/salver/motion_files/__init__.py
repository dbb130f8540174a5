"""One family of motion files: CSV, JSON, YAML and JSON of ROS messages (MoveIt's too), ROS bags; read and written.

`read` gives samples of the tray or of the joints; `write` writes a `MotionSeries`: what is known at the same instants.
"""

from salver.motion_files.motion import MotionSeries
from salver.motion_files.readers import is_motion_file, of_columns, read, read_path
from salver.motion_files.samples import JointSamples, Samples, TraySamples
from salver.motion_files.writers import ENDINGS, form_of, write

__all__ = [
    "ENDINGS",
    "JointSamples",
    "MotionSeries",
    "Samples",
    "TraySamples",
    "form_of",
    "is_motion_file",
    "of_columns",
    "read",
    "read_path",
    "write",
]
