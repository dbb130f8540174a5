"""Campaigns: many perturbed runs of several plans on the same samples, in parallel, resumable, each reproducible.

`run_campaign(directory, ...)` runs one; `parameters_of_run(directory, k)` and `seed_of_run` give the parameters and the
seed of run k, so that `salver simulate DIR --run k` repeats it.
"""

from salver.campaigns.definition import Definition, parameters_of_run, read_definition, seed_of_run
from salver.campaigns.engine import Campaign, run_campaign

__all__ = [
    "Campaign",
    "Definition",
    "parameters_of_run",
    "read_definition",
    "run_campaign",
    "seed_of_run",
]
