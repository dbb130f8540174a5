"""The definition of a campaign: everything that its runs depend on, such as plans, number of runs and samples."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from salver import sampling, scenario
from salver.errors import FileFormatError, SalverError
from salver.files import read_json
from salver.geometry import Array
from salver.run_directory import plan_digest, scenario_of

SUMMARY = "campaign.json"
DEFAULT_FOLDER = "campaign"
STOPS_FOLDER = "stops"  # default folder of a campaign with stops


@dataclass(frozen=True)
class Definition:
    """A campaign: n runs of each plan, with the samples that method and seed give.

    plans: name of the plan -> its digest. scenario: digest of the resolved scenario.
    stops: whether each run is stopped at a random instant.
    """

    scenario: str
    plans: Mapping[str, str]
    n: int
    seed: int
    method: str
    stops: bool = False

    def extends(self, other: Definition) -> bool:
        """Whether the runs of `other` are the first runs of this one."""
        return other.n <= self.n and {**asdict(self), "n": 0} == {**asdict(other), "n": 0}

    def stop_at(self, run: int, duration: float) -> float | None:
        """Time of the stop request of run number `run` of a plan, s, from 0 to its duration; None without stops."""
        return float(np.random.default_rng([self.seed, run, 2]).uniform(0.0, duration)) if self.stops else None

    def in_words(self) -> str:
        return (
            f"{self.n} runs of {' and '.join(self.plans)} (scenario {self.scenario}), method {self.method}, "
            f"seed {self.seed}{', with stops' if self.stops else ''}"
        )


def define(
    directory: Path,
    stems: Sequence[str],
    n: int,
    seed: int,
    method: str,
    folder: str,
    stops: bool,
    most: int = 200_000,
) -> Definition:
    """Check and make the definition of a campaign in a run directory. Raises SalverError for a mistake.

    most: runs of all plans together, about 5 kB each.
    """
    if n < 1:
        raise SalverError(f"The number of runs is {n}; it must be at least 1.")
    if n * len(stems) > most:
        raise SalverError(
            f"{n} runs of {len(stems)} plans are more than the {most} that fit into the memory; use several "
            "folders with other seeds."
        )
    if seed < 0:
        raise SalverError(f"The seed is {seed}; it must be 0 or more.")
    if method not in sampling.METHODS:
        raise SalverError(f'There is no sampling method "{method}"; known are {", ".join(sampling.METHODS)}.')
    if Path(folder).name != folder or folder in ("", ".."):
        raise SalverError(f'The folder is "{folder}"; it must be one name, for a folder in {directory}.')
    case = load_scenario(directory)
    if case.legs and list(stems) != ["plan"]:
        raise SalverError(
            f"{case.name} is a task of {len(case.legs)} legs; a run of its campaign runs all of them: leave out --plan."
        )
    if not case.uncertain.size and not stops:
        raise SalverError(f"{case.name} has no uncertain parameters, so that all runs are equal; use salver simulate.")
    return Definition(case.digest, {stem: plan_digest(directory, stem) for stem in stems}, n, seed, method, stops)


def load_scenario(directory: Path) -> scenario.Scenario:
    """The resolved scenario of a run directory."""
    return scenario.load(scenario_of(directory))


def samples(directory: Path, definition: Definition) -> tuple[tuple[str, ...], Array]:
    """Names of the uncertain parameters, and their true values (n, n_p) in SI units."""
    case = load_scenario(directory)
    if case.digest != definition.scenario:
        raise SalverError(
            f"{directory / 'scenario.toml'} has the digest {case.digest}, the campaign {definition.scenario}; the "
            "scenario was changed since the campaign."
        )
    method: Any = definition.method
    drawn = sampling.draw(case.uncertain, definition.n, definition.seed, method, case.bodies)
    return case.uncertain.names, drawn


def seed_of_run(seed: int, run: int) -> int:
    """Seed of the sensor noise of run number `run`, equal for all plans."""
    return int(np.random.default_rng([seed, run, 1]).integers(2**31))


def read_definition(directory: str | Path, folder: str = DEFAULT_FOLDER) -> Definition:
    """Read the definition of a campaign from a run directory. Raises SalverError when there is none."""
    path = Path(directory) / folder / SUMMARY
    if not path.is_file():
        raise SalverError(f"{Path(directory)} holds no campaign ({folder}/{SUMMARY}); make one with `salver campaign`.")
    return definition_in(read_json(path), path)


def definition_in(summary: Any, path: Path) -> Definition:
    """The definition in the content of a campaign.json. Raises FileFormatError when there is none."""
    found = summary.get("definition") if isinstance(summary, dict) else None
    kinds = {"scenario": str, "plans": dict, "n": int, "seed": int, "method": str, "stops": bool}
    if not isinstance(found, dict) or {key: type(value) for key, value in found.items()} != kinds:
        raise FileFormatError(f"{path} has no definition of a campaign; move it away, or use another --folder.")
    return Definition(**found)


def parameters_of_run(directory: str | Path, run: int, folder: str = DEFAULT_FOLDER) -> tuple[dict[str, float], int]:
    """True parameters by name, in SI units, and seed of run number `run`, from 0, of a directory's campaign."""
    definition = read_definition(directory, folder)
    if not 0 <= run < definition.n:
        raise SalverError(f"There is no run {run}; the campaign has the runs 0 to {definition.n - 1}.")
    names, values = samples(Path(directory), definition)
    return dict(zip(names, map(float, values[run]), strict=True)), seed_of_run(definition.seed, run)
