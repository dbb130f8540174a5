"""How long must it take? The planner's answer and the physics engine's, for one object on shorter and shorter times.

The cube of the paper on a smoother tray: friction 0.2, known to 25 %. For each duration both motions, the robust one
and the straight line, say whether they are safe for every mass and friction in their ranges; a campaign then runs them
with perturbed parameters, the extreme ones first. Outcomes: holds, slides, limit (the arm cannot do it), ...
Stopped half way, the same command goes on where it was.

Run: python examples/campaign.py [-n 12] [-o runs/how-long]
"""

from __future__ import annotations

import argparse
from pathlib import Path

import salver as sv
from salver.campaigns import run_campaign


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-n", type=int, default=12, help="runs for each duration")
    parser.add_argument("-o", "--out", type=Path, default=Path("runs/how-long"))
    options = parser.parse_args()

    for duration in (1.5, 1.3, 1.1):
        scenario = sv.load_scenario(
            "panda-cube",
            motion__duration=duration,
            motion__speed_rate=0.0,  # at every constant speed: for one that changes 1.3 s are too short
            contact__condition="exact",
            objects__0__friction=0.2,
            objects__0__uncertainty={"mass": "10%", "friction": "25%"},
        )
        directory = options.out / f"{duration:g}s"
        plans = {"plan": sv.plan(scenario), "baseline": sv.plan(scenario, "baseline")}
        for stem, plan in plans.items():
            plan.save(directory, stem)
        campaign = run_campaign(directory, options.n, method="corners")
        for stem, plan in plans.items():
            outcomes = campaign.summary["plans"][stem]["outcomes"]
            counts = ", ".join(f"{name} {rate['count']}" for name, rate in outcomes.items() if rate["count"])
            print(
                f"{duration:g} s, {plan.method}: planned {'safe' if plan.ok else 'not safe'}; in the engine: {counts}"
            )


if __name__ == "__main__":
    main()
