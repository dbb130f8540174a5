"""An arm from a URDF carries the cube of the paper; what a URDF does not say is given in the scenario.

python examples/extending/urdf_arm.py [URDF FLANGE]
"""

import sys

import salver as sv
from salver.models.arm.known_arms import KNOWN_ARMS, robot_file

if __name__ == "__main__":
    urdf, flange = sys.argv[1:] or (robot_file(KNOWN_ARMS["ur5"]), "tool0")  # or any file of yours
    arm = {
        "model": str(urdf),
        "flange": flange,
        "limits": {"acceleration": 5.0, "jerk": 500.0},  # a URDF has neither; one number is for every joint
    }
    ends = {"motion__start__position": [0.4, -0.3, 0.35], "motion__goal__position": [0.4, 0.2, 0.35]}
    scenario = sv.load_scenario("panda-cube", arm=arm, **ends)
    print(sv.plan(scenario).arm_status)
    fastest = sv.plan(scenario, "fastest")
    print(f"{fastest.status} {fastest.arm_status}")
