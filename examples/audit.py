"""Will it slip? The verdict on a motion from somewhere else, and how much slower it would have to be.

The motion here is a trapezoidal velocity profile along a straight line, as many robot controllers make it, written to
a CSV file of tray poses. Its corners are where objects slide.

Run: python examples/audit.py [-o trapezoid.csv]
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

import salver as sv
from salver.auditing import audit


def trapezoid(distance: float, duration: float, ramp: float, rate: float = 250.0) -> tuple[np.ndarray, np.ndarray]:
    """Times and travelled distances of a motion that speeds up and slows down for `ramp` seconds each."""
    t = np.linspace(0, duration, round(duration * rate) + 1)
    speed = distance / (duration - ramp)
    velocity = speed * np.clip(np.minimum(t, duration - t) / ramp, 0, 1)
    return t, np.concatenate([[0.0], np.cumsum(0.5 * (velocity[1:] + velocity[:-1]) * np.diff(t))])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-o", "--out", type=Path, default=Path("trapezoid.csv"))
    options = parser.parse_args()

    t, y = trapezoid(distance=0.6, duration=1.0, ramp=0.2)
    pose = np.column_stack(
        [t, np.full_like(t, 0.5), y - 0.3, np.full_like(t, 0.4), np.tile([1.0, 0, 0, 0], (len(t), 1))]
    )
    np.savetxt(options.out, pose, delimiter=",", header="t,x,y,z,qw,qx,qy,qz", comments="")

    result = audit(
        options.out, sv.load_scenario("panda-cube", objects__0__uncertainty={"mass": "10%", "friction": "20%"})
    )
    print("believed:  ", result.nominal)
    print("worst case:", result.worst)
    print("slower:    ", result.speeds_worst.pace)


if __name__ == "__main__":
    main()
