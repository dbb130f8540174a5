"""What the two examples share: tubes from the sensitivity engine, held against nonlinear motions."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from salver.models.uncertain.parameters import UncertainSet
from salver.sensitivity.engine import ClosedLoop, Motions, Sensitivity, sensitivity, simulate
from salver.sensitivity.tubes import excess, radius


@dataclass(frozen=True)
class Example:
    """A closed loop, its nominal start, its uncertain parameters, and the names of its states and inputs."""

    name: str
    loop: ClosedLoop
    x0: np.ndarray
    xi0: np.ndarray
    uncertain: UncertainSet
    states: tuple[str, ...]
    inputs: tuple[str, ...]
    t: np.ndarray


@dataclass(frozen=True)
class TubeCheck:
    """Sensitivities along the nominal motion, n nonlinear motions, and how these lie in the first-order tubes.

    quantities: names of states, then inputs. nominal, radius: (T, c). excess: (n, c) the largest
    |value - nominal| - radius over time, negative for a motion that stays in the tube. difference_error: of Pi and
    Theta against central differences of nonlinear motions over the ranges of the parameters, as a share of each tube.
    """

    example: Example
    sensitivity: Sensitivity
    motions: Motions
    nominal: np.ndarray
    radius: np.ndarray
    excess: np.ndarray
    difference_error: float

    @property
    def samples(self) -> np.ndarray:
        """(n, T, c) states, then inputs."""
        return np.concatenate([self.motions.x, self.motions.u], axis=2)

    @property
    def quantities(self) -> tuple[str, ...]:
        return (*self.example.states, *self.example.inputs)


def check(example: Example, n: int, seed: int) -> TubeCheck:
    """Sensitivities, tubes, n motions with parameters uniform in their box and at its corners."""
    p = example.uncertain
    result = sensitivity(example.loop, p.nominal, example.t, example.x0, example.xi0)
    reaction = np.concatenate([result.state_sensitivity, result.input_sensitivity], axis=1)
    nominal, tube = np.concatenate([result.x, result.u], axis=1), radius(reaction, p)
    loop, t, x0, xi0 = example.loop, example.t, example.x0, example.xi0
    motions = simulate(loop, scattered(p, n, seed), p.nominal, t, x0, xi0, tolerance=1e-6)
    records = np.concatenate([motions.x, motions.u], axis=2)

    step = 1e-3 * p.half_range
    pairs = simulate(
        loop, p.nominal + np.vstack([np.diag(step), -np.diag(step)]), p.nominal, t, x0, xi0, tolerance=1e-10
    )
    ahead, behind = np.split(np.concatenate([pairs.x, pairs.u], axis=2), 2)
    difference = np.moveaxis((ahead - behind) / (2 * step[:, None, None]), 0, -1)
    error = float((np.abs((difference - reaction) * p.half_range).max(axis=(0, 2)) / tube.max(axis=0)).max())
    return TubeCheck(example, result, motions, nominal, tube, excess(records, nominal, tube).max(axis=1), error)


def scattered(p: UncertainSet, n: int, seed: int) -> np.ndarray:
    """(n, n_p) parameters: the corners of their box, then uniform in it."""
    inside = np.random.default_rng(seed).uniform(-1, 1, (n, p.size))
    corners = np.stack(np.meshgrid(*[[-1.0, 1.0]] * p.size), axis=-1).reshape(-1, p.size)
    return p.nominal + np.vstack([corners, inside])[:n] * p.half_range


def report(check: TubeCheck) -> str:
    """A table of each quantity's tube and what the motions did in it."""
    p = check.example.uncertain
    ranges = ", ".join(f"{n} = {v:g} +- {d:g}" for n, v, d in zip(p.names, p.nominal, p.half_range, strict=True))
    peak = check.radius.max(axis=0)
    seen = np.abs(check.samples - check.nominal).max(axis=(0, 1))
    lines = [
        f"{check.example.name}: {ranges}",
        f"central differences of nonlinear motions differ from Pi and Theta by {check.difference_error:.1e} of a tube",
        f"{'quantity':>14} {'tube radius':>12} {'seen':>10} {'left by':>9} {'worst excess':>13}",
    ]
    for i, name in enumerate(check.quantities):
        beyond = check.excess[:, i] / peak[i]
        left = np.sum(beyond > 1e-6)  # less is the accuracy of the motions
        lines.append(f"{name:>14} {peak[i]:12.4g} {seen[i]:10.4g} {left:5d}/{len(beyond)} {max(0, beyond.max()):12.1%}")
    lines.append("(radius and deviation: largest over time; excess: beyond the tube, share of that radius)")
    return "\n".join(lines)


def plot(check: TubeCheck, path: Path) -> None:
    """Deviation of perturbed motions from the nominal one, and the first-order tube, of every quantity."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    t, deviation, count = check.example.t, check.samples - check.nominal, len(check.quantities)
    figure, axes = plt.subplots((count + 2) // 3, 3, figsize=(11, 2.3 * ((count + 2) // 3)), layout="constrained")
    for axis in axes.flat[count:]:
        axis.axis("off")
    for i, axis in enumerate(axes.flat[:count]):
        axis.plot(t, deviation[:60, :, i].T, color="0.75", linewidth=0.5)
        axis.plot(t, check.radius[:, i], "k--", t, -check.radius[:, i], "k--", linewidth=0.9)
        axis.set_title(f"deviation of {check.quantities[i]}", fontsize=9)
        axis.set_xlabel("t [s]", fontsize=8)
    figure.savefig(path, dpi=130)
    plt.close(figure)
