"""A plan as a URScript program, for the controllers of Universal Robots.

The program streams joint positions with `servoj`, one line a period (Universal Robots, Script Manual, e-Series SW 5.20,
"servoj"). Of a plan with stops, a thread watches a digital input, and the program leaves the motion for the next stop
when the input was low. Tests run the program period by period; it was not run on a robot.
"""

from __future__ import annotations

import numpy as np

from salver.errors import SalverError
from salver.geometry import Array
from salver.models.arm.known_arms import UR_JOINTS
from salver.motion_files import MotionSeries
from salver.motion_files.verdict import one_line, warns

RATES = (500.0, 250.0, 125.0)  # Hz at which controllers take positions: an e-Series all of them, a CB3 the last

HEAD = """\
# {verdict}
# {name}: {duration:.4g} s, {samples} joint positions at {rate:g} Hz. Written by salver {version} from a plan.
# For the arm {arm} only: the same joint angles take the tray of another model elsewhere (a UR5e is no UR5). {series}
# {slider}
# {stops}
# Set the payload to tray and load.
# servoj follows {lag:.0f} ms late or more and smooths: what the tray feels is not quite what was planned. Record a run
# with the load strapped to the tray (RTDE), and let `salver track` tell what that costs before you carry it loose.
def salver_motion():
{watch}  local start = {start}
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
WATCH = """\
  global salver_stop = False
  if not get_standard_digital_in({stop_input}):
    popup("Digital input {stop_input} is low: it is the stop, and must be high.", "salver", error=True, blocking=True)
    halt
  end
  thread salver_watch():
    while not salver_stop:
      salver_stop = not get_standard_digital_in({stop_input})
      sync()
    end
  end
  run salver_watch()
"""
LEAVE = """\
  if salver_stop:
{lines}    stopj({stop})
    halt
  end
"""
NO_STOPS = "No stops: whatever ends this program stops the arm without regard to the load. Plan with --stops."
STOPS = (
    "Digital input {stop_input} is the stop: when it goes low, the arm is brought to rest with the load kept, within "
    "{longest:.2f} s. Checked at full speed only."
)
ANY_SPEED = (
    "Speed slider: the load is kept at any constant setting at which the controller runs all of this slower alike; how "
    "it does that was not tried."
)
FULL_SPEED = "Speed slider at 100 %, no reduced mode: run slower, this motion does not keep its load."
E_SERIES = "For an e-Series controller: a CB3 would be slower (salver export --rate 125)."
ANY_SERIES = "Controllers of both series, CB3 and e-Series, take positions at this rate."
TAIL = """\
  stopj({stop})
end
salver_motion()
"""


def program(
    motion: MotionSeries,
    rate: float,
    stop_input: int = 0,
    *,
    lookahead: float = 0.03,
    gain: float = 300.0,
    near: float = 0.01,
    deceleration: float = 2.0,
) -> str:
    """The program's text; every number with all its digits.

    stop_input: the standard digital input that stops it. lookahead, gain: of servoj; the shortest lag that it takes, s,
    and its default gain. near: rad; further from the start no joint may be when the program begins. deceleration: of
    stopj, rad/s^2; the arm rests by then. Raises SalverError for a motion without the six joints of such an arm, base
    to wrist, and for a rate at which its controller does not take positions.
    """
    if rate not in RATES:
        raise SalverError(
            f"A URScript of {rate:g} positions per second was asked for; the rate must be 500, 250 or, for a CB3, 125."
        )
    names = motion.joint_names
    if len(names) != len(UR_JOINTS) or not all(map(str.endswith, names, UR_JOINTS)):
        raise SalverError(
            f"URScript is for the arms of Universal Robots, with joints {', '.join(UR_JOINTS)} in this order; this "
            f"plan has {', '.join(names) or 'none'}."
        )
    assert motion.q is not None
    about = motion.about
    leaves = np.array([leave for leave, _ in motion.stops], dtype=np.int64)
    rests = np.array([leave + stop.ns[-1] for leave, stop in motion.stops] + [motion.ns[-1]])
    asked = np.append(0, leaves)  # at the latest: just after the instant before
    ends = np.array([*(stop.q[-1] for _, stop in motion.stops if stop.q is not None), motion.q[-1]])
    there = (motion.q[np.searchsorted(motion.ns, asked)] == ends).all(axis=1)  # in a pause it rests already
    longest = 1e-9 * (rests - asked)[~there].max()
    head = HEAD.format(
        verdict=motion.verdict,
        slider=FULL_SPEED if warns(motion.verdict) else ANY_SPEED,
        name=about["scenario"],
        arm=one_line(about["arm"]),
        series=ANY_SERIES if rate == RATES[-1] else E_SERIES,
        duration=motion.t[-1],
        samples=len(motion.t),
        rate=rate,
        version=about["salver"],
        lag=lookahead * 1e3,
        start=_listed(motion.q[0]),
        near=near,
        watch=WATCH.format(stop_input=stop_input) if motion.stops else "",
        stops=STOPS.format(stop_input=stop_input, longest=longest) if motion.stops else NO_STOPS,
    )
    line = f"  servoj({{}}, t={1 / rate!r}, lookahead_time={lookahead!r}, gain={gain!r})\n"
    text = [head]
    # The first instant is where the arm stands; each line then holds for one period.
    for k, q in enumerate(motion.q):
        if k:
            text.append(line.format(_listed(q)))
        until = motion.ns[k + 1] if k + 1 < len(motion.ns) else np.inf
        for n in np.flatnonzero((leaves >= motion.ns[k]) & (leaves < until)):
            stop = motion.stops[n][1]
            assert stop.q is not None
            lines = "".join("  " + line.format(_listed(x)) for x in stop.q[1:])
            text.append(LEAVE.format(lines=lines, stop=deceleration))
    return "".join(text) + TAIL.format(stop=deceleration)


def _listed(q: Array) -> str:
    return "[" + ", ".join(repr(float(x)) for x in np.asarray(q)) + "]"
