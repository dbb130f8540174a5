"""From a scenario to a checked plan and one run in the physics engine.

Run: python examples/plan_in_ten_lines.py
"""

import salver as sv

scenario = sv.load_scenario("panda-cube", motion__duration=1.5)
plan = sv.plan(scenario)
print(plan.status)
print(plan.verify().sentence)
print(plan.arm_status)

run = sv.simulate(plan, parameters={"mass": 1.1 * scenario.objects[0].mass})
print(f"in the engine, 10 % heavier than believed: the cube {run.summary['outcome']}")
plan.save("runs/ten-lines")
