"""Conical cups: their modes against closed forms, harmonic polynomials and pressures; statics; what a scenario says."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
from scipy.linalg import eigh
from scipy.special import jnp_zeros

from potential_flow import cone, simulate_cone
from salver import load_scenario
from salver.dynamics.liquid.axisymmetric import sloshing
from salver.dynamics.liquid.drawn_surface import DrawnSurface
from salver.dynamics.liquid.interiors import Round
from salver.dynamics.liquid.sloshing import Liquid, SloshingResponse
from salver.dynamics.liquid.surface import SurfaceMotion
from salver.dynamics.load_cases import LoadCase
from salver.errors import ScenarioError
from salver.geometry import GRAVITY
from salver.models.shapes import shapes
from salver.models.tray_motion import at_rest


@pytest.mark.parametrize("depth", [0.3, 0.5, 1.0, 1.5, 3.0, 6.0])
def test_an_upright_wall_gives_the_closed_forms_of_the_cylinder(depth):
    """Ibrahim 2005, with the roots of J1'; the inertia under a lid by its series, of 4000 terms."""
    R, rho = 0.04, 998.0
    h = depth * R
    xi = jnp_zeros(1, 4000)
    modes, tanh = Round(R).modes(h, rho), np.tanh(xi * depth)
    total = rho * np.pi * R**2 * h
    for found, known in (
        (modes.omega, np.sqrt(GRAVITY * xi * tanh / R)),
        (modes.mass, total * 2 * R * tanh / (xi * h * (xi**2 - 1))),
        (modes.height, -2 * R / xi * np.tanh(0.5 * xi * depth)),
        (modes.rise, 2 * R / (xi**2 - 1)),
    ):
        np.testing.assert_allclose(found, np.repeat(known[:2, None], 2, axis=1), rtol=1e-9)
    assert modes.following == pytest.approx(np.sqrt(GRAVITY * xi[2] * tanh[2] / R), rel=1e-6)
    series = np.sum(np.tanh(0.5 * xi * depth) / (xi**3 * (xi**2 - 1)))
    inertia = total * (R**2 / 4 + h**2 / 3 - R**2 + 16 * R**3 / h * series)
    frozen = modes.frozen
    assert frozen.mass == pytest.approx(total)
    assert frozen.com_B == pytest.approx([0, 0, -0.5 * h])
    assert frozen.inertia_com[0, 0] + total * (0.5 * h) ** 2 == pytest.approx(inertia, rel=3e-7)


@pytest.mark.parametrize("slope", [0.0, 0.1, 0.4])
def test_all_modes_together_make_the_plane(slope):
    """sum of b_n = R."""
    assert sloshing(0.04, slope, 0.05, 8).rise.sum() == pytest.approx(0.04, rel=1e-9)


def test_a_cone_of_45_degrees_sloshes_as_is_known_exactly():
    """phi = r z cos(theta) over the apex: the surface stays a plane, omega^2 R / g = 1 (Levin 1963)."""
    modes = Round(1e-9, 1.0).modes(0.05, 1000.0)
    assert modes.omega[0] ** 2 * 0.05 / GRAVITY == pytest.approx(1.0, rel=1e-6)
    assert modes.rise[0] == pytest.approx(0.05, rel=1e-4)  # the other modes have no part in a plane
    # kappa lambda^2 / N = pi R^3 / 4, of a liquid of pi R^3 / 3
    assert modes.mass[0] / modes.frozen.mass == pytest.approx(0.75, rel=1e-4)


@dataclass(frozen=True)
class Harmonic:
    """Harmonic polynomials of cos(theta) and their outward derivatives at points (P,) of the boundary of a liquid under
    its level, with weights r ds; the surface first."""

    r: np.ndarray
    z: np.ndarray
    normal: np.ndarray
    weight: np.ndarray
    value: np.ndarray
    outward: np.ndarray
    surface: slice

    @classmethod
    def of(cls, R: float, slope: float, h: float, degree: int, points: int = 80) -> Harmonic:
        x, w = np.polynomial.legendre.leggauss(points)
        x, w = 0.5 * (x + 1), 0.5 * w
        bottom, side = R - slope * h, np.hypot(1, slope)
        r = np.concatenate([R * x, bottom * x, R - slope * h * x])
        z = np.concatenate([0 * x, 0 * x - h, -h * x])
        normal = np.repeat([[0, 1], [0, -1], [1 / side, -slope / side]], points, axis=0)
        weight = r * np.concatenate([R * w, bottom * w, h * side * w])
        size, up = np.hypot(R, 0.5 * h), z + 0.5 * h
        r_, up = r / size, up / size
        # (l - m + 1) H_(l+1) = (2 l + 1) z H_l - (l + m) rho^2 H_(l-1), m = 1; dH_l/dz = (l + m) H_(l-1)
        H, by_r = [0 * r_, r_], [0 * r_, np.ones_like(r_)]
        for k in range(1, degree):
            H.append(((2 * k + 1) * up * H[k] - (k + 1) * (r_**2 + up**2) * H[k - 1]) / k)
            less = (r_**2 + up**2) * by_r[k - 1] + 2 * r_ * H[k - 1]
            by_r.append(((2 * k + 1) * up * by_r[k] - (k + 1) * less) / k)
        by_z = [(k + 1) * H[k - 1] for k in range(1, degree + 1)]
        outward = (normal[:, :1] * np.array(by_r[1:]).T + normal[:, 1:] * np.array(by_z).T) / size
        return cls(r, z, normal, weight, np.array(H[1:]).T, outward, slice(0, points))

    @property
    def levers(self) -> tuple[np.ndarray, np.ndarray]:
        """n_x and z n_x - x n_z (P,), over cos(theta)."""
        return self.normal[:, 0], self.z * self.normal[:, 0] - self.r * self.normal[:, 1]

    def solved(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """kappa (2,), traces of the modes on the boundary (P, 2), and that of the Stokes-Joukowski potential (P,)."""
        on = self.surface
        energy = self.value.T @ (self.weight[:, None] * self.outward)
        energy = 0.5 * (energy + energy.T)
        height = self.value[on].T @ (self.weight[on, None] * self.value[on])
        scale = 1 / np.sqrt(np.diag(energy))
        energy, height = (scale[:, None] * m * scale for m in (energy, height))
        mu, vectors = eigh(height, energy)
        modes = self.value @ (scale[:, None] * vectors[:, :-3:-1])
        pushed = scale * (self.value.T @ (self.weight * self.levers[1]))
        return 1 / mu[:-3:-1], modes, self.value @ (scale * np.linalg.solve(energy, pushed))


CUPS = [(0.04, 0.1, 0.065), (0.036, 0.02, 0.03), (0.045, 0.35, 0.05)]  # R of the surface, slope, fill


@pytest.mark.parametrize(("R", "slope", "h"), CUPS)
def test_pressures_of_harmonic_polynomials_give_the_wrench_of_the_modes(R, slope, h):
    """Lukovsky's and Gavrilyuk's method: potentials of harmonic polynomials. Under a lid that moves with two modes the
    pressure is -rho (f_x x + alpha Psi + sum c_n' phi_n + g z); at random states its integrals over the boundary are
    the force and moment that the modes and the frozen liquid need (`salver.models.load_dynamics`)."""
    rho, rng = 998.0, np.random.default_rng(41)
    modes = Round(R - slope * h, slope).modes(h, rho)
    at = Harmonic.of(R, slope, h, 18)
    kappa, phi, psi = at.solved()
    assert np.all(np.abs(modes.omega[:, 0] ** 2 / GRAVITY / kappa - 1) < 1e-6)
    surface, (along, about) = at.surface, at.levers
    weight = np.pi * at.weight
    norm = phi[surface].T ** 2 @ weight[surface]
    lever, turned = (phi[surface].T @ (weight * x)[surface] for x in (at.r, psi))
    mass, frozen, z = modes.mass[:, 0], modes.frozen, modes.height[:, 0]
    about_O = frozen.inertia_com[1, 1] + frozen.mass * frozen.com_B[2] ** 2
    for _ in range(20):
        f, alpha = rng.uniform(-3, 3), rng.uniform(-20, 20)
        eta = rng.uniform(-0.1, 0.1, 2) * lever / norm  # of the modes, times their traces
        rate = -GRAVITY * eta - (f * lever + alpha * turned) / norm
        pressed = f * at.r + alpha * psi + phi @ rate
        force = rho * weight @ (pressed * along)
        moment = rho * (weight @ (pressed * about) - GRAVITY * eta @ lever)
        r = eta * norm / (kappa * lever)
        second = -(modes.omega[:, 0] ** 2) * r - f - alpha * z
        expected = frozen.mass * (f + alpha * frozen.com_B[2]) + mass @ second
        turning = about_O * alpha + frozen.mass * frozen.com_B[2] * f + mass @ (z * second - r * GRAVITY)
        assert force == pytest.approx(expected, rel=1e-5, abs=1e-5 * frozen.mass)
        assert moment == pytest.approx(turning, rel=1e-5, abs=1e-5 * frozen.mass * R)


@pytest.mark.parametrize("duration", [1.4, 1.25])
def test_waves_in_a_paper_cup_are_those_of_nonlinear_potential_flow(duration):
    """On the straight min-jerk line over 0.48 m; heights at the radius of the level, which is lower than the real ones
    by more than the two differ."""
    body, fill = load_scenario("panda-paper-cups").payload.first, 0.065
    inside = body.inner.inside
    level = float(inside.half(fill)[0]) / inside.slope

    def push(t: float) -> float:
        x = min(t / duration, 1.0)
        return 0.48 / duration**2 * (60 * x - 180 * x**2 + 120 * x**3)

    t, times = np.linspace(0, duration, 201), np.arange(0, duration, 0.0015)
    w = np.tile(at_rest(), (len(t), 1))
    w[:, 0] = [push(x) for x in t]
    crest = SurfaceMotion.along((LoadCase(body, fill, 0.005),), t, w).crest.max()
    flow = cone(np.arctan(inside.slope), level, 1 - fill / level)
    seen = simulate_cone(flow, lambda x: (push(x), GRAVITY), times, 0.005).max()
    assert crest == pytest.approx(inside.level_rise(fill, seen), rel=0.005)
    assert crest < 0.995 * seen


@pytest.mark.parametrize("depth", [0.5, 1.0])
def test_free_waves_crest_lower_in_a_cone_than_in_the_cylinder_of_its_depth(depth):
    """Nonlinear potential flow of the first mode, up to its first crest: in a cone that is nearly upright, and in
    cones that lean out more and more."""
    R, steep = 0.04, 0.1
    found = []
    for slope in (0.01, 0.1, 0.25):
        inside, h = Round(R - slope * depth * R, slope), depth * R
        modes, level = inside.modes(h, 998.0), R / slope
        flow, omega = cone(np.arctan(slope), level, 1 - h / level), modes.omega[0, 0]
        begin, times = np.zeros(len(flow.nu)), np.linspace(0, 2.5 / omega, 200)
        begin[6] = R * GRAVITY / omega  # of the first function with m = 1, which is nearly the mode
        small, high = (
            simulate_cone(flow, lambda t: (0.0, GRAVITY), times, 0.005, a * begin).max() for a in (1e-3, steep)
        )
        a = 1e3 * steep * small
        found.append((inside.level_rise(h, high) / a - 1) * R / a)
        assert 0 < found[-1] < 0.75 * modes.peaking[0]
    assert found[0] > 1.1 * found[1] > 1.1**2 * found[2]


@pytest.mark.parametrize("slope", [0.1, 0.45])
def test_the_plane_in_a_cone_touches_the_brim_when_the_room_is_used_up(slope):
    """A plane through a point of the brim that keeps the volume; its inclination times R is the linear height."""
    liquid = Liquid(Round(0.03, slope), 0.002, 0.05, 0.075, 1000.0, (0.0, 0.0))
    R, above, t = 0.03 + slope * 0.05, 0.03 / slope + 0.05, slope  # above: of the level over the apex
    a = liquid.edge(0.05) / R
    # A plane that cuts a cone at a height Z on its axis holds pi t^2 Z^3 / (3 (1 - a^2 t^2)^(3/2)).
    Z = above * np.sqrt(1 - (a * t) ** 2)
    assert Z / (1 - a * t) - above == pytest.approx(0.075 - 0.05)
    assert liquid.edge(0.05) < 0.025
    upright = Liquid(Round(0.03), 0.002, 0.05, 0.075, 1000.0, (0.0, 0.0))
    assert upright.edge(0.05) == pytest.approx(0.025)


@pytest.mark.parametrize("slope", [0.1, 0.3])
def test_the_surface_that_is_drawn_is_a_plane_that_keeps_the_volume(coffee, slope):
    shape = {"type": "cone", "radius": 0.03, "top_radius": 0.03 + 0.1 * slope, "height": 0.1}
    inside = {"radius": 0.029, "brim_radius": 0.029 + 0.095 * slope, "fill": 0.06, "brim": 0.095}
    body = coffee.with_changes(objects__0__shape=shape, objects__0__liquid=inside).payload.first
    surface = DrawnSurface.of_heights(body, 0.06, np.array([[0.0, 0.0], [0.012, -0.009]]), None)
    held = []
    for k in range(2):
        a, b, c = np.moveaxis(surface.triangles_B(k) - surface.bottom_B.mean(axis=0), 1, 0)
        held.append(np.sum(a * np.cross(b, c)) / 6)
    assert held[0] == pytest.approx(shapes.cone(0.029, 0.029 + 0.06 * slope, 0.06).volume, rel=0.01)  # 32 corners
    assert held[1] == pytest.approx(held[0], rel=2e-4)
    # It cuts the axis lower, by the volume of a cone's part below a plane as in the test above.
    lean = slope * np.linalg.norm(surface.slope[1])
    lower = (surface.level_B - surface.centre_B(1))[2]
    assert lower == pytest.approx((1 - np.sqrt(1 - lean**2)) / surface.widening)
    ring = surface.ring_B(1) - surface.centre_B(1)
    np.testing.assert_allclose(ring[:, 2], ring[:, :2] @ surface.slope[1], atol=1e-12)
    height = ring[:, 2] + surface.centre_B(1)[2] - surface.bottom_B[0, 2]
    np.testing.assert_allclose(np.linalg.norm(ring[:, :2], axis=1), 0.029 + slope * height, rtol=1e-9)


def test_a_cone_as_a_solid_is_what_its_slices_are():
    a, b, h = 0.03, 0.04, 0.1
    z = (np.arange(20000) + 0.5) / 20000 * h
    r, solid = a + (b - a) * z / h, shapes.cone(a, b, h, 16)
    share = r**2 / np.sum(r**2)
    centre = share @ z
    across = share @ (r**2 / 4 + (z - centre) ** 2)
    assert solid.volume == pytest.approx(np.pi * h * np.mean(r**2), rel=1e-6)
    assert solid.centroid_G[2] == pytest.approx(centre - h / 2, rel=1e-6)
    np.testing.assert_allclose(np.diag(solid.unit_inertia), [across, across, share @ r**2 / 2], rtol=1e-6)
    np.testing.assert_allclose(np.linalg.norm(solid.base_polygon, axis=1), a)
    np.testing.assert_allclose(np.linalg.norm(solid.top_polygon, axis=1), b)


def paper_cup(coffee, liquid=(), **shape):
    return coffee.with_changes(
        objects__0__shape={"type": "cone", "radius": 0.03, "top_radius": 0.04, "height": 0.1} | shape,
        objects__0__liquid={"radius": 0.0295, "brim_radius": 0.0395, "fill": 0.06, "brim": 0.098} | dict(liquid),
        objects__0__uncertainty={"fill": 0.006},
    )


def test_a_cup_stands_on_its_base_and_weighs_what_its_wall_and_bottom_do(coffee):
    body = paper_cup(coffee).payload.first
    assert np.linalg.norm(body.contacts.p_BC[:, :2], axis=1).max() == pytest.approx(0.03 - 0.005 / np.cos(np.pi / 8))
    volume = shapes.cone(0.0295, 0.0295 + 0.06 * 0.01 / 0.098, 0.06).volume
    assert body.inertial.mass == pytest.approx(0.25 + 975 * volume * 998 / 975, rel=1e-6)
    # The empty cup's centre of mass over its base: of the outer cone less the inner one.
    outer, inner = shapes.cone(0.03, 0.04, 0.1), shapes.cone(0.0295, 0.0395, 0.098)
    levers = outer.volume * (0.05 + outer.centroid_G[2]) - inner.volume * (0.002 + 0.049 + inner.centroid_G[2])
    over_base = levers / (outer.volume - inner.volume)
    assert (body.com_G + body.own.com_B)[2] + 0.05 == pytest.approx(over_base)


def test_a_wave_that_must_settle_is_as_high_at_the_leaning_wall(coffee):
    """As the room up to the brim, and the highest wave, are."""
    cup = paper_cup(coffee, {"settled_wave": 0.006}).payload.first
    t = np.linspace(0, 1, 21)
    waves = SurfaceMotion.along((LoadCase(cup, 0.06, 0.01),), t, np.tile(at_rest(), (len(t), 1)))
    part = SloshingResponse.of(waves)
    wanted = cup.inner.inside.level_rise(0.06, 0.006)
    assert wanted < 0.00595
    assert SloshingResponse.verdict("cup", (part,)).settled == pytest.approx(wanted)
    (limit,) = (each for each in part.limits() if each.name == "settled waves")
    assert limit.most == pytest.approx([wanted])


def test_a_very_deep_liquid_needs_no_more_than_its_surface_does():
    """A wave does not feel the bottom 200 R below: omega^2 R / g is the root of J1'; found in 0.1 s, not in 8 s."""
    deep = sloshing(0.01, 0.0, 2.0, 3)
    np.testing.assert_allclose(deep.kappa[:2] * 0.01, jnp_zeros(1, 2), rtol=1e-5)
    np.testing.assert_allclose(deep.inertia, np.pi * 0.01**2 * 2.0**3 / 3, rtol=1e-3)


@pytest.mark.parametrize(
    ("liquid", "shape", "words"),
    [
        ({"brim_radius": 0.02}, {}, "narrows upwards"),
        ({"brim_radius": 0.0405}, {}, "at its brim it is .* the inside must be smaller"),
        ({"radius": 0.031}, {}, "at its bottom it is .* the inside must be smaller"),
        ({"brim_radius": 0.14}, {"top_radius": 0.142}, "leans out by 48.4 deg"),
        ({"radius": None, "brim_radius": 0.03, "size": [0.05, 0.05]}, {}, "radius and brim_radius of a cone"),
        ({"radius": None, "brim_radius": None, "size": [0.05, 0.05]}, {}, "needs an inside radius"),
        ({"fill": 0.02}, {}, "too shallow"),
        # The engine's pendulum of the second mode would hang 0.5 m over this one: it "rose" by 338 m.
        (
            {"radius": 0.001, "brim_radius": 0.048, "fill": 0.04, "brim": 0.05},
            {"top_radius": 0.05, "height": 0.06},
            "leans out by 43.2 deg.* at most 26.6 deg",
        ),
    ],
)
def test_what_no_conical_cup_can_be_is_said_in_one_sentence(coffee, liquid, shape, words):
    with pytest.raises(ScenarioError, match=words):
        paper_cup(coffee, liquid, **shape)
