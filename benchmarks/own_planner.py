"""A user-defined planner in the benchmark: a trapezoid of speed along the line, its acceleration below the friction's.

python benchmarks/own_planner.py -n 20 --only "cube, friction 0.4" --planners trapezoid toppra
"""

import numpy as np

from fastest import law_motion
from peer_planners import GRAVITY, Motion, Task, planner
from peers import main


@planner("trapezoid", "tray's acceleration below 0.9 of the friction")
def trapezoid(task: Task) -> Motion:
    motion = task.scenario.motion
    length = float(np.linalg.norm(np.subtract(motion.goal.position, motion.start.position)))
    duration = np.sqrt(4.5 * length / (0.9 * task.friction * GRAVITY))  # a third each: speed up, go on, slow down
    t = np.linspace(0, duration, 401)
    speed = 1.5 * np.clip(3 * np.minimum(t, duration - t) / duration, 0, 1)
    u = np.concatenate([[0.0], np.cumsum(0.5 * (speed[1:] + speed[:-1]) * np.diff(t))]) / duration
    return law_motion(task.path, t, u / u[-1])


if __name__ == "__main__":
    main()
