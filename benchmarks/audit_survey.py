"""Can the audit be fooled? Random recordings, violent and gentle, each judged from a file and run in the engine.

    python benchmarks/audit_survey.py [-n 2000] [--seed 1] [--json cases.json]
    python benchmarks/audit_survey.py --defects [-n 10] [--only jittering_stamps] [--json damaged.json]
    python benchmarks/audit_survey.py --docs development.json held-out.json [damaged.json]

Each recording is a shake (0.5 to 50 Hz), a jolt (10 to 200 ms) or a chirp, alone, on a transfer or on a sway, of the
tray or of the arm's joints, scaled so that its peak needs 0.1 to 3 times the friction. It is sampled at 50 to 2000 Hz,
with noise of 0 to 1 mm (a joint's noise moves the tray as far), and written in one of the formats that the audit reads.
The engine moves the tray exactly as the motion was before it was sampled (`simulate_tray`, in the frame of the tray;
test_physics_calibration.py holds it against a tray that is driven). Counted are

- wrong "holds": it said so, and the engine lost the load;
- among those that need less than 0.8 of the friction, with noise below a tenth of the motion (half its range): wrong
  "does not hold", and "cannot tell"; and of which of them the samples allow another motion that loses the load
  (`audit_rivals`): nobody can tell those.

Seeds below 100 were looked at while the audit was made; 100 and above were not.
"""

from __future__ import annotations

import argparse
import json
import re
import tempfile
import time
from collections import Counter
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass, replace
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np

from audit_defects import DEFECTS, FOURTH, HELD_OUT, JOINTS_ONLY, LATER, LISTED, POSES_ONLY, record
from audit_recordings import JOINTS, POSES, draw, write
from audit_rivals import loses, outcome_of
from salver.auditing import audit
from salver.errors import SalverError

ROOT = Path(__file__).parent.parent
PAGE, DATA = ROOT / "docs" / "howto" / "audit.md", ROOT / "docs" / "data" / "audit-survey.json"
GENTLE, CLEAN = 0.8, 0.1


@dataclass(frozen=True)
class Case:
    """One recording: what it was, what the audit said, what the engine showed ("" where it cannot lose the load)."""

    kind: str
    base: str
    format: str
    frequency: float
    rate: float
    noise: float
    motion: float
    need: float
    said: str
    reasons: str
    hidden: float
    engine: str
    rival: bool = False

    @property
    def wrong(self) -> bool:
        return self.said == "holds" and self.engine not in ("", "holds")

    @property
    def counted(self) -> bool:
        return self.need < GENTLE and self.noise < CLEAN * self.motion


def case(seed: int, index: int, engine: str = "lost") -> Case:
    """The recording `index` of a seed. engine: "lost" runs it where the load could be lost, "doubt" only where that
    could make the audit wrong."""
    rng = np.random.default_rng([seed, index])
    scenario, motion, kind, base, frequency, need = draw(rng)
    rate = float(np.round(np.exp(rng.uniform(np.log(50), np.log(2000))), 1))
    noise = 0.0 if rng.random() < 0.2 else float(10 ** rng.uniform(-6, -3))
    form = str(rng.choice(JOINTS if motion.arm is not None else POSES))
    s = motion.tray(np.linspace(0, motion.duration, 2001))
    size = 0.5 * float(np.ptp(s.p_SB, axis=0).max())
    with tempfile.TemporaryDirectory() as folder:
        result = audit(write(rng, motion, rate, noise, form, Path(folder)), scenario)
    nominal = result.nominal  # nothing is uncertain: the worst case is the same
    said = nominal.code if nominal.code in ("holds", "cannot_tell") else "does_not_hold"
    reasons = ",".join(nominal.details.get("reasons", ()))
    hidden = result.hidden()[0].distance
    seen = ""
    if need > 0.95 and (engine == "lost" or said == "holds" or reasons == "noise"):
        seen = outcome_of(motion, scenario)
    made = Case(kind, base, form, frequency, rate, noise, size, need, said, reasons, hidden, seen)
    return replace(made, rival=made.counted and loses(scenario, motion, rate, noise))


@dataclass(frozen=True)
class Damaged:
    """One recording with a defect: what it was, what the audit said of it, what the engine showed ("" if not run)."""

    defect: str
    joints: bool
    need: float
    rate: float
    noise: float
    said: str
    reasons: str
    sentence: str
    engine: str

    @property
    def wrong(self) -> bool:
        return (self.said == "holds" and self.engine not in ("", "holds")) or (
            self.said == "does_not_hold" and self.need < 1
        )


def damaged(seed: int, names: tuple[str, ...], index: int) -> Damaged:
    """The recording `index` of a seed; defects take turns. The engine runs where the audit could be wrong."""
    defect = names[index % len(names)]
    rng = np.random.default_rng([seed, list(DEFECTS).index(defect), index // len(names)])
    while True:
        scenario, motion, *_, need = draw(rng)
        if defect not in (JOINTS_ONLY if motion.arm is None else POSES_ONLY):
            break
    seen = ""
    with tempfile.TemporaryDirectory() as folder:
        path, rate, noise = record(rng, motion, defect, Path(folder))
        try:
            nominal = audit(path, scenario).nominal
            said, sentence = nominal.code, nominal.sentence
            reasons = ",".join(nominal.details.get("reasons", ()))
        except SalverError as error:
            said, reasons, sentence = "refused", "", str(error)
    if said not in ("holds", "cannot_tell", "refused"):
        said = "does_not_hold"
    if said == "holds" and need > 0.95:
        seen = outcome_of(motion, scenario)
    return Damaged(defect, motion.arm is not None, need, rate, noise, said, reasons, sentence, seen)


def table_of_defects(cases: list[Damaged]) -> str:
    """A row for each defect; first those that were listed."""
    lines = [
        "| defect | recordings | holds | does not hold | cannot be told, or refused | wrong |",
        "| --- | --- | --- | --- | --- | --- |",
    ]

    def row(title: str, some: list[Damaged]) -> str:
        count = Counter(c.said for c in some)
        open_ = count["cannot_tell"] + count["refused"]
        wrong = sum(c.wrong for c in some)
        return f"| {title} | {len(some)} | {count['holds']} | {count['does_not_hold']} | {open_} | {wrong} |"

    for title, kinds in (("looked at", LISTED), ("others", HELD_OUT), ("third set", LATER), ("fourth set", FOURTH)):
        names = [kind.__name__ for kind in kinds]
        lines += [
            row(name.replace("_", " "), some) for name in names if (some := [c for c in cases if c.defect == name])
        ]
        if some := [c for c in cases if c.defect in names]:
            lines.append(row(f"**{title}**", some))
    return "\n".join(lines)


def report(cases: list[Case]) -> dict[str, Any]:
    lost = [c for c in cases if c.engine not in ("", "holds")]
    gentle = [c for c in cases if c.counted]
    return {
        "recordings": len(cases),
        "lost": len(lost),
        "wrong_holds": sum(c.wrong for c in cases),
        "lost_said": dict(Counter(c.said for c in lost)),
        "gentle": len(gentle),
        "gentle_said": dict(Counter(c.said for c in gentle)),
        "gentle_with_rival": dict(Counter(c.said for c in gentle if c.rival)),
        "cannot_tell_share": _fraction(gentle),
        "cannot_tell_share_without_rivals": _fraction([c for c in gentle if not c.rival]),
        "gentle_reasons": dict(Counter(c.reasons for c in gentle if c.said == "cannot_tell")),
    }


def _fraction(cases: list[Case]) -> float:
    """Of these, what could not be told."""
    return round(sum(c.said == "cannot_tell" for c in cases) / max(1, len(cases)), 4)


def read_cases(path: Path) -> list[Case]:
    return [Case(**json.loads(line)) for line in path.read_text().splitlines()]


def table(*reports: dict[str, Any]) -> str:
    """Of the seed looked at and of the held-out one."""
    rows = [
        ("recordings", lambda r: r["recordings"]),
        ("that the engine loses, of those it ran", lambda r: r["lost"]),
        ("wrong: holds, and the engine loses it", lambda r: r["wrong_holds"]),
        ("gentle: need under 0.8 of the friction, noise under a tenth of the motion", lambda r: r["gentle"]),
        ("of these: holds", lambda r: _share(r, "holds")),
        ("of these: cannot be told", lambda r: _share(r, "cannot_tell")),
        ("and another motion that the samples allow loses the load", lambda r: _share(r, "cannot_tell", True)),
        ("cannot be told, of those for which no such motion is shown", _share_without_rivals),
        ("of these, wrong: does not hold", lambda r: _share(r, "does_not_hold")),
        ("of these: holds, although another motion loses the load", lambda r: _share(r, "holds", True)),
    ]
    lines = ["| | looked at | held out |", "| --- | --- | --- |"]
    return "\n".join([*lines, *(f"| {name} | {' | '.join(str(of(r)) for r in reports)} |" for name, of in rows)])


def _share(found: dict[str, Any], said: str, rival: bool = False) -> str:
    count = found.get("gentle_with_rival" if rival else "gentle_said", {}).get(said, 0)
    return f"{count} ({100 * count / max(1, found['gentle']):.1f} %)"


def _share_without_rivals(found: dict[str, Any]) -> str:
    """Of the gentle ones without those for which a losing rival is shown."""
    rivals = found.get("gentle_with_rival", {})
    count = found["gentle_said"].get("cannot_tell", 0) - rivals.get("cannot_tell", 0)
    return f"{count} ({100 * count / max(1, found['gentle'] - sum(rivals.values())):.1f} %)"


def _write_page(name: str, text: str) -> None:
    old = PAGE.read_text()
    PAGE.write_text(re.sub(rf"(<!-- written: {name} -->\n).*?(<!-- end -->)", rf"\1{text}\n\2", old, flags=re.S))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-n", type=int, default=2000)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("-j", "--jobs", type=int, default=1, help="processes")
    parser.add_argument("--engine", choices=["lost", "doubt"], default="lost")
    parser.add_argument("--json", type=Path, help="add the cases to this file, a line each")
    parser.add_argument("--defects", action="store_true", help="recordings with defects; -n of each")
    parser.add_argument("--only", choices=[*DEFECTS, "listed", "held_out", "later", "fourth"], help="only such defects")
    parser.add_argument(
        "--docs", type=Path, nargs="+", help="write such files (of a seed, of a held-out one, of defects) to the page"
    )
    options = parser.parse_args()
    if options.docs:
        DATA.write_text(json.dumps([report(read_cases(path)) for path in options.docs[:2]], indent=1) + "\n")
        _write_page("survey", table(*json.loads(DATA.read_text())))
        for path in options.docs[2:]:
            lines = path.read_text().splitlines()
            _write_page("defects", table_of_defects([Damaged(**json.loads(line)) for line in lines]))
        return
    began = time.perf_counter()
    if options.defects:
        groups = {"listed": LISTED, "held_out": HELD_OUT, "later": LATER, "fourth": FOURTH}
        kinds = tuple(kind.__name__ for kind in groups.get(options.only, ()))
        names = kinds or ((options.only,) if options.only else tuple(DEFECTS))
        found = []
        with ProcessPoolExecutor(options.jobs, mp_context=get_context("spawn")) as pool:
            for d in pool.map(partial(damaged, options.seed, names), range(options.n * len(names))):
                found.append(d)
                if options.json:
                    with open(options.json, "a") as file:
                        file.write(json.dumps(asdict(d)) + "\n")
                if d.wrong:
                    print(f"{len(found) - 1}: {asdict(d)}", flush=True)
        print(table_of_defects(found))
        print(f"{time.perf_counter() - began:.0f} s")
        return
    cases = []
    with ProcessPoolExecutor(options.jobs, mp_context=get_context("spawn")) as pool:
        for c in pool.map(partial(case, options.seed, engine=options.engine), range(options.n)):
            cases.append(c)
            if options.json:
                with open(options.json, "a") as file:
                    file.write(json.dumps(asdict(c)) + "\n")
            if c.wrong or (c.counted and c.said == "does_not_hold"):
                print(f"{len(cases) - 1}: {asdict(c)}", flush=True)
    print(json.dumps(report(cases), indent=1))
    print(f"{time.perf_counter() - began:.0f} s")


if __name__ == "__main__":
    main()
