"""A plan as a URScript program, for the controllers of Universal Robots.

The program streams joint positions with `servoj`, one line a period (Universal Robots, Script Manual, e-Series SW 5.20,
"servoj"). It was compared with the plan, line by line; it was not run on a robot.
"""

from __future__ import annotations

import numpy as np

from salver.errors import SalverError
from salver.geometry import Array
from salver.motion_files import MotionSeries
from salver.motion_files.verdict import warns

# The order in which `servoj` takes them; URDFs put a prefix before these.
JOINTS = ("shoulder_pan_joint", "shoulder_lift_joint", "elbow_joint", "wrist_1_joint", "wrist_2_joint", "wrist_3_joint")
RATE = 500.0  # Hz, the e-Series' own; a CB3 takes 125
LOOKAHEAD, GAIN = 0.03, 300.0  # s; the shortest lag that servoj takes, its default gain
NEAR = 0.01  # rad: further from the start no joint may be when the program begins
STOP = 2.0  # rad/s^2, of stopj; the arm rests by then

HEAD = """\
# {verdict}
# {name}: {duration:.4g} s, {samples} joint positions at {rate:g} Hz. Written by salver {version} from a plan.
# {slider}
# Set the payload to tray and load.
# servoj follows {lag:.0f} ms late or more and smooths: what the tray feels is not quite what was planned. Record a run
# with the load strapped to the tray (RTDE), and let `salver track` tell what that costs before you carry it loose.
def salver_motion():
  local start = {start}
  local q = get_actual_joint_positions()
  local k = 0
  while k < 6:
    if (q[k] - start[k] > {near}) or (start[k] - q[k] > {near}):
      popup("The arm is not at the start of this motion.", "salver", error=True, blocking=True)
      halt
    end
    k = k + 1
  end
"""
ANY_SPEED = (
    "Speed slider: the load is kept at any constant setting at which the controller runs all of this slower alike; how "
    "it does that was not tried."
)
FULL_SPEED = "Speed slider at 100 %, no reduced mode: run slower, this motion does not keep its load."
TAIL = """\
  stopj({stop})
end
salver_motion()
"""


def program(motion: MotionSeries, rate: float) -> str:
    """The program's text; every number with all its digits.

    Raises SalverError for a motion without the six joints of such an arm, base to wrist.
    """
    names = motion.joint_names
    if len(names) != len(JOINTS) or not all(map(str.endswith, names, JOINTS)):
        raise SalverError(
            f"URScript is for the arms of Universal Robots, with joints {', '.join(JOINTS)} in this order; this plan "
            f"has {', '.join(names) or 'none'}."
        )
    assert motion.q is not None
    about = motion.about
    head = HEAD.format(
        verdict=motion.verdict,
        slider=FULL_SPEED if warns(motion.verdict) else ANY_SPEED,
        name=about["scenario"]["name"].replace("\n", " "),
        duration=motion.t[-1],
        samples=len(motion.t),
        rate=rate,
        version=about["provenance"]["salver"],
        lag=LOOKAHEAD * 1e3,
        start=_listed(motion.q[0]),
        near=NEAR,
    )
    line = f"  servoj({{}}, t={1 / rate!r}, lookahead_time={LOOKAHEAD!r}, gain={GAIN!r})\n"
    # The first instant is where the arm stands; each line then holds for one period.
    return head + "".join(line.format(_listed(q)) for q in motion.q[1:]) + TAIL.format(stop=STOP)


def _listed(q: Array) -> str:
    return "[" + ", ".join(repr(float(x)) for x in np.asarray(q)) + "]"
