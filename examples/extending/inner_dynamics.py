"""A load with inner dynamics: a lamp on a cord in its housing. Such a load is a `LoadDynamics`, here `Pendulum`."""

import numpy as np

import salver as sv
from salver.planning.fastest import fastest, transport_problem
from salver.scenario import Scenario


def lamp(length: float) -> Scenario:
    """On a cord of so many metres, which may swing by 20 degrees."""
    housing = {
        "name": "lamp",
        "shape": {"type": "cylinder", "radius": 0.05, "height": 0.16},
        "mass": 0.25,
        "friction": 0.4,
        "pendulum": {"mass": 0.15, "length": length, "pivot": 0.14, "widest_deg": 20.0},
        "uncertainty": "none",
    }
    return sv.load_scenario("panda-cube", objects=[housing], arm={"model": "panda"}, motion__orientation="fixed")


if __name__ == "__main__":
    for length in (0.005, 0.03, 0.12):
        found = fastest(transport_problem(lamp(length), robust=False))
        t = np.linspace(0, found.duration, 401)
        (inside,) = found.problem.at(t / t[-1], np.stack(found.sample(t)), found.duration).loads["lamp"]
        widest = np.rad2deg(inside.modes.height.max() / length)
        print(f"{length} m: {found.status.sentence} It swings by {widest:.1f} degrees.")
