"""The liquid in a container: its modes, which cases stand for it, what a scenario may ask."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.sparse import diags, identity, kron
from scipy.sparse.linalg import spsolve

from salver.dynamics.liquid.interiors import Rectangle, Round
from salver.dynamics.liquid.liquid import damping_of
from salver.dynamics.liquid.sloshing import Liquid
from salver.dynamics.load_cases import load_cases
from salver.errors import ScenarioError

CUP = Liquid(Round(0.04), 0.005, 0.06, 0.075, 1000.0, (0.0, 0.03))


def test_modes_of_a_cup_are_those_of_the_literature():
    modes = CUP.modes(0.06)
    # f_11 = sqrt(1.8412 g / R tanh(1.8412 h / R)) / 2 pi: by hand for R = 40, h = 60 mm.
    by_hand = np.sqrt(1.8411838 * 9.81 / 0.04 * np.tanh(1.8411838 * 1.5)) / (2 * np.pi)
    np.testing.assert_allclose(modes.omega[0, 0] / (2 * np.pi), by_hand, rtol=1e-6)
    total = 1000 * np.pi * 0.04**2 * 0.06
    np.testing.assert_allclose(
        modes.mass[0, 0] / total, 2 * np.tanh(1.8411838 * 1.5) / (1.8411838 * 1.5 * 2.3899577), rtol=1e-6
    )
    assert modes.frozen.mass == pytest.approx(total)


@pytest.mark.parametrize("round_", [True, False], ids=["cup", "box"])
def test_under_a_lid_the_liquid_turns_as_laplace_says(round_):
    """Kinetic energy of liquid in a closed container turned at 1 rad/s about its centre, by finite volumes.

    In a cylinder phi = u(r, z) cos(theta); in a box u(x, z), r standing for x.
    """
    liquid = CUP if round_ else Liquid(Rectangle(0.09, 0.06), 0.005, 0.05, 0.08, 1000.0, (0.0, 0.0))
    h, n = liquid.fill, 90
    R = float(liquid.inside.half(h)[0])
    dr, dz = R / n, h / n
    r, z = (np.arange(n) + 0.5) * dr, (np.arange(n) + 0.5) * dz - h / 2
    weight, edge = (r, np.arange(n + 1) * dr) if round_ else (np.ones(n), np.ones(n + 1))
    across = diags([edge[1:-1], -edge[1:] - edge[:-1], edge[1:-1]], [-1, 0, 1]).tolil()
    across[-1, -1] += edge[-1]  # no flux but what the wall pushes
    across[0, 0] -= edge[0]  # odd about the middle
    along = diags([np.ones(n - 1), np.r_[-1, -2 * np.ones(n - 2), -1], np.ones(n - 1)], [-1, 0, 1])
    own = diags(-1 / r if round_ else np.zeros(n))
    laplace = kron(across / dr**2 + own, identity(n)) + kron(diags(weight), along / dz**2)
    pushed = np.zeros((n, n))  # velocity of the walls: (z, -x)
    pushed[-1] += edge[-1] * z / dr
    pushed[:, -1] += weight * -r / dz
    pushed[:, 0] -= weight * -r / dz
    phi = spsolve(laplace.tocsc(), -pushed.ravel()).reshape(n, n)
    at_wall = phi[-1] + 0.5 * dr * z
    top, bottom = phi[:, -1] - 0.5 * dz * r, phi[:, 0] + 0.5 * dz * r
    energy = edge[-1] * at_wall @ z * dz + weight * (top - bottom) @ -r * dr
    per_volume = energy / (R**2 * h if round_ else R * h)  # over the circle as cos^2: half of it; over x: both halves
    frozen = liquid.modes(h).frozen
    assert frozen.inertia_com[1, 1] / frozen.mass == pytest.approx(per_volume, rel=5e-3)


@pytest.mark.parametrize("fill", [0.03, 0.06])
def test_moving_masses_and_the_rest_weigh_what_the_liquid_weighs(fill):
    modes = CUP.modes(fill)
    frozen, still, mass, z = modes.frozen, modes.still, modes.mass[:, 0], modes.height[:, 0]
    assert still.mass + mass.sum() == pytest.approx(frozen.mass)
    assert still.mass * still.com_B[2] + mass @ z == pytest.approx(frozen.mass * frozen.com_B[2])
    about = still.inertia_com[0, 0] + still.mass * still.com_B[2] ** 2 + mass @ z**2
    assert about == pytest.approx(frozen.inertia_com[0, 0] + frozen.mass * frozen.com_B[2] ** 2)


def test_cases_span_fill_and_damping(coffee):
    found = load_cases(coffee.payload.first, coffee.payload.uncertain)
    assert {round(case.value, 6) for case in found} >= {0.035, 0.065}
    assert len({case.damping for case in found}) == 2
    assert len(load_cases(coffee.payload.first, coffee.payload.nominal.uncertain)) == 1


def test_viscosity_damps_as_boundary_layers_do():
    assert damping_of(0.04, 0.06, 1e-6) == pytest.approx(0.79 * np.sqrt(1e-6 / np.sqrt(9.81 * 0.04**3)), rel=0.05)


def liquid(**changes):
    return {"objects__0__liquid": {"kind": "water", "radius": 0.04, "fill": 0.05, "brim": 0.08, **changes}}


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        (liquid(fill=0.07), "stands above the brim"),
        (liquid(fill=0.085, brim=0.08), "stands above the brim"),
        (liquid(fill=0.02), "too shallow for this model"),
        (liquid(viscosity=0.01), "too viscous for the sloshing model"),
        (liquid(radius=0.05), "the inside must be smaller"),
        (liquid(brim=0.09), "is only 0.085 m high"),
        (liquid(size=[0.05, 0.05]), "radius of a cylinder, radius and brim_radius of a cone, or size of a box"),
        (liquid(damping=[0.02, 0.01]), "give the smaller share of critical damping first"),
        (
            liquid(damping=[0.0, 0.9]),
            r"damping = \[0.0, 0.9\] of critical; the sloshing model is valid up to 0.2",
        ),
        (liquid(damping=[0.15, 0.18]), "too viscous for the sloshing model"),
        (
            liquid(viscosity=4e-4),
            "0.0004 m.2/s, damping 0.[0-9]+ to 0.[0-9]+ of critical; the sloshing model is valid",
        ),
        (liquid(settled_within=0.5), "needs settled_wave"),
        ({"objects__0__uncertainty__fill": 0.06}, "must be less than fill"),
        ({"uncertainty__tilt_deg": [1.0, 0.0]}, "does not work with the liquid in"),
        (
            {"motion__goal": {"position": [0.44, 0.1, 0.411], "rpy_deg": [19.7, 0, 0]}},
            "mm even at rest; it has room",
        ),
        ({"objects__0__liquid": None}, "needs a liquid"),
    ],
)
def test_what_cannot_be_is_told_in_one_sentence(coffee, changes, words):
    with pytest.raises(ScenarioError, match=words) as caught:
        coffee.with_changes(**changes)
    assert str(caught.value).count("\n") == 0
