"""Live motion: a motion that may be changed while it runs and never drops its load (`Live`), and a worker that plans
it."""

from salver.live.course import LiveCourse
from salver.live.live import Live
from salver.live.options import LiveOptions
from salver.live.replanning.obstacles import Moving
from salver.live.state import State
from salver.live.worker import Worker

__all__ = ["Live", "LiveCourse", "LiveOptions", "Moving", "State", "Worker"]
