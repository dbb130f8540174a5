"""Liquids in cups and boxes that do not stand exactly at their place on the tray."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from salver.dynamics.liquid.sloshing import SloshingResponse
from salver.dynamics.liquid.surface import SurfaceMotion
from salver.dynamics.load_cases import LoadCase
from salver.dynamics.load_rows import LoadRows
from salver.dynamics.payload_response import PayloadResponse
from salver.errors import ScenarioError
from salver.models.contact_rows import _RowModel, cone_rows, network_rows
from salver.models.interfaces import sure_contacts
from salver.models.uncertain.parameters import Parameter
from salver.planning.trajopt.problem import transport_problem
from salver.scenario import Scenario
from salver.sensitivity.arm.compliance import of_cases
from shaken_loads import BOX, shaken

T = np.linspace(0.0, 0.9, 181)
CONE = {
    "objects__0__shape": {"type": "cone", "radius": 0.036, "top_radius": 0.048, "height": 0.1},
    "objects__0__liquid": {"kind": "coffee", "radius": 0.033, "brim_radius": 0.045, "fill": 0.06, "brim": 0.095},
}
SHAPES = pytest.mark.parametrize("shape", [{}, BOX, CONE], ids=["cylinder", "box", "cone"])
PLACED = {
    "objects__0__at": [0.03, -0.045],
    "objects__0__yaw_deg": 35.0,
    "tray__size": [0.3, 0.3],
    "objects__0__uncertainty": {"mass": "10%", "fill": 0.005, "position": [0.004, 0.006]},
}


def placed(coffee: Scenario, shape: dict, **changes: object) -> Scenario:
    return coffee.with_changes(**shape, **(PLACED | changes))


@SHAPES
def test_a_cup_beside_its_place_is_one_that_stands_there(coffee, shape):
    here, aside = placed(coffee, shape), (0.007, -0.004)
    there = placed(coffee, shape, objects__0__at=[0.037, -0.049])
    one, moved, other = (
        SurfaceMotion.along((LoadCase(scenario.payload.first, 0.05, 0.01, off),), T, shaken(T))
        for scenario, off in ((here, (0.0, 0.0)), (here, aside), (there, (0.0, 0.0)))
    )
    for name in ("crest", "free", "r", "second", "force"):
        np.testing.assert_allclose(getattr(moved, name), getattr(other, name), rtol=1e-9, atol=1e-12)
    assert np.abs(moved.crest - one.crest).max() > 2e-4  # of a tray that turns
    # Contact moves with the cup.
    rows = [
        network_rows(s.payload.networks[0], s.payload.nominal.uncertain, s.payload.tray_half) for s in (here, there)
    ]
    added = [m.wrench[0] @ r.wrench[0].T for m, r in zip((moved, other), rows, strict=True)]
    np.testing.assert_allclose(*added, rtol=1e-8, atol=1e-9 * np.abs(added[0]).max())


@SHAPES
def test_no_place_in_the_range_has_a_higher_wave_than_its_corners(coffee, shape):
    payload = placed(coffee, shape).payload
    found = PayloadResponse.along(payload, T, shaken(T))
    (part,) = found.worst[payload.first.name]
    cases, half = part.modes.cases.each, np.array([0.004, 0.006])
    assert {case.aside for case in cases} == {(a, b) for a in (-0.004, 0.004) for b in (-0.006, 0.006)}
    rng = np.random.default_rng(7)
    for value, damping in {(case.value, case.damping) for case in cases}:
        own = np.array([case.value == value and case.damping == damping for case in cases])
        places = [LoadCase(payload.first, value, damping, tuple(half * rng.uniform(-1, 1, 2))) for _ in range(12)]
        inside = SloshingResponse.of(SurfaceMotion.along(places, T, shaken(T)))
        worst = part.crest[own].max(axis=0)
        assert (inside.crest <= worst + 1e-9).all()
        assert (inside.left() <= part.left()[own].max() + 1e-9).all()
        centre = SurfaceMotion.along((LoadCase(payload.first, value, damping),), T, shaken(T))
        assert worst.max() > centre.crest.max() + 1e-4


@SHAPES
def test_contact_at_no_place_is_worse_than_its_worst_case(coffee, shape):
    """Place, mass and fill away from nominal at once, with the wrench of the waves where the cup then stands."""
    payload, w = placed(coffee, shape).payload, shaken(T)
    (network,), body = payload.networks, payload.first
    rows = network_rows(network, payload.uncertain, payload.tray_half)
    assert not len(rows.wrench_by_place)  # the waves' wrench moves with the cup: a second time would be too careful
    response = PayloadResponse.along(payload, T, w)
    model = _RowModel(network, [cone_rows(c) for c in sure_contacts(network, payload.tray_half, payload.uncertain)])
    weights = [model.weights({p: s * payload.uncertain.ranges[p]}) for p in rows.masses for s in (-1, 1)]
    each = (rows.worst(w) + LoadRows.of(rows, response.worst).values).reshape(len(T), len(weights), -1)
    bound = (each * weights).max(axis=1)  # N
    rng, half = np.random.default_rng(3), payload.uncertain.ranges
    nearest = np.inf
    for corner in range(24):
        draw = np.sign(rng.uniform(-1, 1, 8)) if corner < 16 else rng.uniform(-1, 1, 8)
        deviation = {p: h * s for (p, h), s in zip(half.items(), draw, strict=False)}
        there, fill = replace(body, p_EB=body.place_at(deviation)), body.inner_value(deviation)
        damping = body.inner.nominal_damping + deviation[Parameter(body.name, "damping")]
        waves = SurfaceMotion.along((LoadCase(there, fill, damping),), T, w)
        exact = w @ model.rows(deviation).T + waves.wrench[0] @ model.facets_at_tray(deviation)[0].T
        assert (exact <= bound + 1e-9 * np.abs(bound).max()).all()
        nearest = min(nearest, (bound - exact).max(axis=1).min())
    assert nearest < 0.1 * np.abs(bound).max()


def test_contact_of_a_cup_on_a_box_beside_its_place_is_not_worse_than_its_worst_case(coffee):
    """The box's edges move, and with them the moment of the waves about these, by .4 % of the weight."""
    cup = coffee.objects[0].model_dump(mode="json", exclude_none=True) | {"uncertainty": {"mass": "10%"}, "on": "box"}
    shape = {"type": "box", "size": [0.12, 0.12, 0.05]}
    box = {"name": "box", "shape": shape, "mass": 0.1, "friction": 0.5, "uncertainty": {"position": [0.015, 0.015]}}
    payload, w = coffee.with_changes(objects=[box, cup]).payload, shaken(T)
    (network,), uncertain, half = payload.networks, payload.uncertain, payload.uncertain.ranges
    rows = network_rows(network, uncertain, payload.tray_half)
    added = LoadRows.of(rows, PayloadResponse.along(payload, T, w).worst).values
    model = _RowModel(network, [cone_rows(c) for c in sure_contacts(network, payload.tray_half, uncertain)])
    mass = Parameter("cup", "mass")
    weights = [model.weights({mass: sign * half[mass]}) for sign in (-1, 1)]
    bound = ((rows.worst(w) + added).reshape(len(T), 2, -1) * weights).max(axis=1)  # N
    body = next(body for body in network.bodies if body.inner is not None)
    for signs in np.random.default_rng(3).choice([-1.0, 1.0], (16, len(half))):
        deviation = {p: h * sign for (p, h), sign in zip(half.items(), signs, strict=True)}
        damping = body.inner.nominal_damping + deviation[Parameter("cup", "damping")]
        waves = SurfaceMotion.along((LoadCase(body, body.inner.value, damping),), T, w).wrench[0]
        k = network.bodies.index(body)
        held = [facets @ network.share[e, k] for e, facets in enumerate(model.facets_at_tray(deviation))]
        exact = w @ model.rows(deviation).T + waves @ np.concatenate(held).T
        assert (exact <= bound + 1e-9 * np.abs(bound).max()).all()


def test_a_case_knows_what_its_place_does_to_the_arm(coffee):
    """Of a place and a fill everything is sure, products too, and with them what a mass still may do."""
    problem, rng = transport_problem(placed(coffee, {}, arm__start_posture=None)), np.random.default_rng(4)
    load_, body = problem.tracking.load, problem.items[0]
    mass, fill, *place = (Parameter("cup", *kind) for kind in (("mass",), ("fill",), *(("position", a) for a in "xy")))
    dw = rng.normal(size=(5, 12, len(load_.terms)))
    assert {frozenset({place[0], mass}), frozenset({place[0], fill})} <= {frozenset(factors) for factors in load_.terms}
    sure, unsure = of_cases([LoadCase(body, 0.05 - 0.002, 0.01, (0.004, -0.003))], load_, dw)
    others = [p for p in load_.uncertain.parameters if p not in (fill, *place)]
    assert unsure.shape == (1, 5, 12, len(others))
    values = {mass: 0.6, fill: -0.4, place[0]: 1.0, place[1]: -0.5}
    whole = sum(
        dw[:, :, k] * np.prod([values.get(p, 0.0) for p in factors])
        for k, factors in enumerate(load_.terms)
        if factors != (mass, mass)
    )
    np.testing.assert_allclose(sure[0] + 0.6 * unsure[0, ..., others.index(mass)], whole, atol=1e-12)


def test_a_cup_with_something_on_it_is_told_that_its_place_must_be_exact(coffee):
    lid = {"name": "lid", "shape": {"type": "cylinder", "radius": 0.04, "height": 0.01}, "mass": 0.05, "friction": 0.4}
    items = [item.model_dump(mode="json", exclude_none=True) for item in coffee.objects]
    with pytest.raises(ScenarioError, match="only if it stands on the tray by itself, not with lid"):
        coffee.with_changes(objects=[*items, lid | {"on": "cup"}], objects__0__uncertainty__position=[0.002, 0.0])
