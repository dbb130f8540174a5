"""Does the audit say what the engine shows? Random tray motions, each judged from a CSV file and run in physics.

    python benchmarks/audit_agreement.py [--motions 240] [--seed 0] [--json docs/data/audit-agreement.json]

Each motion is a random rest-to-rest polynomial of position and orientation, run at a random share of the pace at which
the audit says that its object just holds (0.85 to 1.15 of that duration), so that verdicts of both kinds come up and
many are close. The audit reads poses at 1 kHz with six decimals, as a recording would have them. The engine moves the
tray exactly. A disagreement is explained when
- near: the pace is within NEAR of the boundary (friction and tipping onset in the engine are right to a few per mille,
  and the audit's accelerations to about a per cent of their peak), or
- brief: the audit says it slides or tips, and the engine shows that it did, for an instant: a slip under the 0.5 mm,
  or a rocking under the 2 degrees, from which the engine's verdict counts it.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from collections import Counter
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from salver.auditing import audit
from salver.auditing.motion import AuditedMotion
from salver.auditing.verdict import Audit
from salver.geometry import invert, quat_wxyz_from_matrix
from salver.scenario import Scenario, load
from salver.simulation.physics import simulate_tray
from salver.trajectory import PolynomialReference, boundary_solution, position_boundary

NEAR = 0.02  # of the duration
SLIPPED = 2e-5  # m: more than the engine's creep
ROCKED = np.deg2rad(0.2)


@dataclass(frozen=True)
class Case:
    """One motion: what the audit said and what the engine showed. share: of the pace at which it just holds."""

    share: float
    audit: str
    engine: str
    slip: float
    tip: float

    @property
    def agree(self) -> bool:
        return (self.audit == "holds") == (self.engine == "holds")

    @property
    def reason(self) -> str:
        if self.agree:
            return "agree"
        if abs(self.share - 1) <= NEAR:
            return "near"
        if self.engine == "holds" and (self.slip > SLIPPED or self.tip > ROCKED):
            return "brief"
        return "unexplained"


def objects(rng: np.random.Generator) -> Scenario:
    """The paper's cube with a random height and friction: some slide, some tip."""
    height = float(rng.choice([0.04, 0.08, 0.16]))
    return load("panda-cube").with_changes(
        objects__0__shape={"type": "box", "size": [0.04, 0.04, height]},
        objects__0__inertia=None,
        objects__0__friction=round(float(rng.uniform(0.15, 0.6)), 3),
        objects__0__uncertainty={},
        contact__edges=16,
    )


def random_motion(rng: np.random.Generator, scenario: Scenario, duration: float) -> PolynomialReference:
    """Rest to rest over up to 0.6 m, degree 8, turning there and back by a few degrees about a random axis."""
    start, goal = rng.uniform(-0.3, 0.3, (2, 3)) + np.array([0.5, 0, 0.5])
    solution = boundary_solution(8, position_boundary(1.0, start, goal))
    free = 0.02 * rng.standard_normal((solution.null_space.shape[1], 3))
    # (1 - s^2)^2 times a random quadratic vanishes at both ends with its derivative: at rest, no angular acceleration.
    shape = np.polynomial.chebyshev.poly2cheb(np.array([1, 0, -2, 0, 1]))
    rates = [np.polynomial.chebyshev.chebmul(shape, rng.normal(0, 0.4, 3)) for _ in range(3)]
    return PolynomialReference(
        duration, np.eye(3), solution.particular + solution.null_space @ free, np.stack(rates, axis=1) / duration
    )


def judged(scenario: Scenario, reference: PolynomialReference, folder: Path) -> Audit:
    """By way of a file."""
    t = np.arange(round(reference.duration * 1000) + 1) / 1000
    first = scenario.payload.first
    s = reference.sample(t).of_frame(*invert(first.p_EB, first.R_EB))
    path = folder / "motion.csv"
    rows = np.column_stack([t, s.p_SB, quat_wxyz_from_matrix(s.R_SB)])
    np.savetxt(path, rows, delimiter=",", header="t,x,y,z,qw,qx,qy,qz", comments="", fmt="%.6f")
    return audit(path, scenario)


def exact_pace(scenario: Scenario, reference: PolynomialReference) -> float | None:
    """Factor of the duration at which the motion itself, without file or smoothing, just holds."""
    first = scenario.payload.first
    s = reference.sample(np.linspace(0, reference.duration, 2001)).of_frame(*invert(first.p_EB, first.R_EB))
    return Audit(scenario, "exact", AuditedMotion(s)).speeds.pace.details["factor"]


def slower(reference: PolynomialReference, factor: float) -> PolynomialReference:
    """The same path in `factor` times the duration."""
    assert reference.angular_velocity is not None
    return PolynomialReference(
        reference.duration * factor, reference.R_start, reference.position, reference.angular_velocity / factor
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--motions", type=int, default=240)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", type=Path, help="write all cases here")
    options = parser.parse_args()
    rng = np.random.default_rng(options.seed)
    cases: list[Case] = []
    skipped, began = 0, time.perf_counter()
    with tempfile.TemporaryDirectory() as folder:
        while len(cases) < options.motions:
            scenario = objects(rng)
            path = random_motion(rng, scenario, 1.0)
            pace = exact_pace(scenario, path)
            if pace is None or not 0.3 < pace < 5:
                skipped += 1
                continue
            share = float(rng.uniform(0.85, 1.15))
            reference = slower(path, pace * share)
            said = judged(scenario, reference, Path(folder))
            record = simulate_tray(reference, scenario)
            worst = record.slip.max(), record.tip_angle.max()
            cases.append(Case(share, said.nominal.code, record.outcome, *map(float, worst)))
    report(cases, skipped)
    print(f"{time.perf_counter() - began:.0f} s")
    if options.json:
        options.json.parent.mkdir(parents=True, exist_ok=True)
        options.json.write_text(json.dumps([vars(case) for case in cases], indent=0) + "\n")


def report(cases: list[Case], skipped: int) -> None:
    count = Counter((case.audit, case.engine) for case in cases)
    print(f"{len(cases)} motions ({skipped} left out: tilted too far or no pace between 0.3 and 5 s)")
    for (said_code, seen), number in sorted(count.items()):
        print(f"  audit {said_code:7} engine {seen:7} {number:4}")
    reasons = Counter(case.reason for case in cases)
    print(
        f"agree {reasons['agree']}; disagree {len(cases) - reasons['agree']}: "
        + ", ".join(f"{name} {reasons[name]}" for name in ("near", "brief", "unexplained"))
    )
    for case in cases:
        if not case.agree:
            print(
                f"  {case.reason:11} at {case.share:.3f} of its pace: audit {case.audit}, engine {case.engine}, "
                f"slip {1e3 * case.slip:.3f} mm, tip {np.rad2deg(case.tip):.2f} deg"
            )


if __name__ == "__main__":
    main()
