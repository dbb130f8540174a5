"""Laws that margins obey whatever the load: refinement, symmetry, similarity, order; and bounds over nasty sets."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose

import odd_loads
import sampled_sets
from salver.contact_margins import Margins, margins
from salver.geometry import Array
from salver.scenario import Scenario
from salver.trajectory import MotionSamples

LOADS = {"single": odd_loads.single, "stack": odd_loads.stack, "pair": odd_loads.pair}
SOME = [("single", "box"), ("stack", "ellipsoid"), ("pair", "ellipsoid")]
FEW = settings(max_examples=3, derandomize=True, deadline=None)
seeds = st.integers(0, 2**31)


def along(made: Scenario, tray: MotionSamples, **options: object) -> Margins:
    """Margins of a motion of the tray, with the scenario's own pyramids unless others are asked for."""
    first = made.payload.first
    return margins(made, tray.of_frame(first.p_EB, first.R_EB), **{"edges": made.contact.edges} | options)


def by_name(whole: Margins, quantity: str) -> dict[str, Array]:
    return {m.name: getattr(m, quantity) for m in whole.interfaces}


QUANTITIES = ("exact", "exact_worst", "sliding_worst", "tipping_worst", "friction_needed", "tip_over", "tip_over_worst")


def assert_same(
    first: Margins, second: Margins, rename: dict[str, str] | None = None, lengths: float = 1.0, atol: float = 1e-9
) -> None:
    """Every margin of every interface, those in m up to a scale."""
    assert first.interfaces
    for quantity in QUANTITIES:
        scale = lengths if quantity.startswith("tip_over") else 1.0
        other = by_name(second, quantity)
        for name, value in by_name(first, quantity).items():
            found = other[name if rename is None else rename.get(name, name)]
            assert_allclose(found, scale * value, rtol=1e-7, atol=atol * scale, err_msg=f"{quantity} of {name}")


# Refinement ----------------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize(("name", "kind"), SOME)
@FEW
@given(seed=seeds)
def test_a_finer_friction_pyramid_never_gives_less(name: str, kind: str, seed: int) -> None:
    """4 edges within 8 within 16: more wrenches are possible, less friction is needed, and the way out is longer."""
    made, tray = LOADS[name](kind), odd_loads.tray_motion(3, seed)
    coarse, fine = (along(made, tray, edges=edges) for edges in (4, 8))
    for before, after in zip(coarse.interfaces, fine.interfaces, strict=True):
        for quantity in ("exact", "exact_worst"):
            # Outside a cone the largest of its facets is no distance.
            more, less = getattr(after, quantity), getattr(before, quantity)
            assert np.all(more[less > 0] >= less[less > 0] - 1e-9), quantity
        assert_allclose(after.tip_over, before.tip_over, atol=1e-12)
        finite = np.isfinite(before.friction_needed)
        assert np.all(after.friction_needed[finite] <= before.friction_needed[finite] * (1 + 1e-9))
        # An inscribed pyramid of k edges holds the round cone shrunk by cos(pi / k).
        assert np.all(after.friction_needed[finite] >= before.friction_needed[finite] * np.cos(np.pi / 4) - 1e-9)


@pytest.mark.slow
@pytest.mark.parametrize(("name", "kind"), SOME)
@FEW
@given(seed=seeds, share=st.floats(0.1, 0.9))
def test_a_smaller_set_never_has_a_smaller_margin(name: str, kind: str, seed: int, share: float) -> None:
    made, tray = LOADS[name](kind), odd_loads.tray_motion(3, seed)
    whole, less = along(made, tray), along(odd_loads.small(made, share), tray)
    for large, small in zip(whole.interfaces, less.interfaces, strict=True):
        assert np.all(small.exact_worst >= large.exact_worst - 1e-9)
        assert np.all(large.exact_worst <= large.exact + 1e-9)
        assert np.all(large.tip_over_worst <= large.tip_over + 1e-12)


# Symmetry ------------------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize(("name", "kind"), SOME)
@FEW
@given(seed=seeds, angle=st.floats(-3.0, 3.0))
def test_a_turn_of_the_world_about_the_vertical_changes_nothing(name: str, kind: str, seed: int, angle: float) -> None:
    made, tray = LOADS[name](kind), odd_loads.tray_motion(3, seed)
    turn = odd_loads.rotation([0.0, 0.0, angle])
    turned = replace(tray, p_SB=tray.p_SB @ turn.T, v_S=tray.v_S @ turn.T, a_S=tray.a_S @ turn.T, R_SB=turn @ tray.R_SB)
    assert_same(along(made, tray), along(made, turned))


def turned_tray(made: Scenario, degrees: float) -> Scenario:
    """The same objects, all turned about the tray's centre; nothing that has a direction of its own is uncertain."""
    turn = odd_loads.rotation([0, 0, np.deg2rad(degrees)])[:2, :2]
    changes: dict[str, object] = {"contact__edge_phase_deg": 0.0}
    for k, item in enumerate(made.objects):
        changes[f"objects__{k}__at"] = (turn @ item.at).tolist()
        changes[f"objects__{k}__yaw_deg"] = item.yaw_deg + degrees
        changes[f"objects__{k}__uncertainty__position"] = None
    return made.with_changes(**changes, uncertainty__tilt_deg=None, uncertainty__correlation={})


@pytest.mark.slow
@pytest.mark.parametrize("name", ["single", "pair"])
def test_a_turned_arrangement_on_a_turned_tray_is_the_same(name: str) -> None:
    """Objects turned on the tray by some angle, and the tray turned back by it: contacts turn with their object."""
    made, tray = LOADS[name]("box", tray__size=[0.4, 0.4]), odd_loads.tray_motion(4, 8)
    before, after = turned_tray(made, 0.0), turned_tray(made, 50.0)
    back = odd_loads.rotation([0, 0, np.deg2rad(-50.0)])
    turned = replace(tray, R_SB=tray.R_SB @ back, omega_B=tray.omega_B @ back, alpha_B=tray.alpha_B @ back)
    assert_same(along(before, tray), along(after, turned))


def mirrored(made: Scenario) -> Scenario:
    """Seen in a mirror across the tray's x axis: y and what is odd in it change sign."""
    changes: dict[str, object] = {}
    for k, item in enumerate(made.objects):
        x, y, z = item.com
        xx, xy, yy, xz, yz, zz = item.inertia
        changes |= {
            f"objects__{k}__at": [item.at[0], -item.at[1]],
            f"objects__{k}__yaw_deg": -item.yaw_deg,
            f"objects__{k}__com": [x, -y, z],
            f"objects__{k}__inertia": [xx, -xy, yy, xz, -yz, zz],
        }
    odd = ("com_y", "inertia_xy", "inertia_yz", "position_y", "tilt_x")
    correlation = {
        pair: value * np.prod([-1.0 if part.rpartition(".")[2] in odd else 1.0 for part in pair.split(",")])
        for pair, value in made.uncertainty.correlation.items()
    }
    return made.with_changes(**changes, uncertainty__correlation=correlation)


@pytest.mark.slow
@pytest.mark.parametrize(("name", "kind"), SOME)
@FEW
@given(seed=seeds)
def test_a_mirror_image_has_the_same_margins(name: str, kind: str, seed: int) -> None:
    """Vectors change the sign of y, axial vectors that of x and z; pyramids with an edge along x are symmetric."""
    made, tray = LOADS[name](kind), odd_loads.tray_motion(3, seed)
    flip = np.diag([1.0, -1.0, 1.0])
    image = replace(
        tray,
        a_S=tray.a_S @ flip,
        R_SB=flip @ tray.R_SB @ flip,
        omega_B=-tray.omega_B @ flip,
        alpha_B=-tray.alpha_B @ flip,
    )
    # A tilt is cut off after its second order, on one side of zero: tilt^3 of what presses.
    assert_same(along(made, tray), along(mirrored(made), image), atol=1e-4)


# Similarity: other units -----------------------------------------------------------------------------------------


def larger(made: Scenario, length: float, mass: float) -> Scenario:
    """The same arrangement in a unit of length and of mass that are so many times smaller."""
    changes: dict[str, object] = {"tray__size": [length * x for x in made.tray.size]}
    for k, item in enumerate(made.objects):
        u = item.uncertainty
        changes |= {
            f"objects__{k}__shape__size": [length * x for x in item.shape.size],
            f"objects__{k}__mass": mass * item.mass,
            f"objects__{k}__com": [length * x for x in item.com],
            f"objects__{k}__inertia": [mass * length**2 * x for x in item.inertia],
            f"objects__{k}__at": [length * x for x in item.at],
            f"objects__{k}__uncertainty": {
                "mass": mass * u.mass.relative * item.mass,
                "com": [length * x for x in u.com],
                "inertia": [mass * length**2 * x for x in u.inertia],
                "friction": u.friction,
                "position": [length * x for x in u.position],
            },
        }
    return made.with_changes(**changes)


@pytest.mark.slow
@pytest.mark.parametrize(("name", "kind"), SOME)
@FEW
@given(seed=seeds, length=st.floats(0.3, 4.0), mass=st.floats(0.1, 20.0))
def test_margins_know_no_units(name: str, kind: str, seed: int, length: float, mass: float) -> None:
    """Froude's similarity: lengths by l, times by sqrt(l), so that gravity stays; shares of the weight stay too."""
    made, tray = LOADS[name](kind), odd_loads.tray_motion(3, seed)
    slower = replace(tray, omega_B=tray.omega_B / np.sqrt(length), alpha_B=tray.alpha_B / length)
    assert_same(along(made, tray), along(larger(made, length, mass), slower), lengths=length)


# Order -----------------------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["box", "ellipsoid"])
def test_the_order_of_objects_does_not_matter(kind: str) -> None:
    """The motion is that of the tray, whichever object comes first in the file."""
    made, tray = odd_loads.pair(kind), odd_loads.tray_motion(5, 9)
    swapped = made.with_changes(objects=[o.model_dump(mode="json", exclude_none=True) for o in made.objects[::-1]])
    assert [o.name for o in swapped.objects] == ["beside", "lower"]
    assert swapped.payload.uncertain.names != made.payload.uncertain.names
    assert_same(along(made, tray), along(swapped, tray))


@pytest.mark.slow
@pytest.mark.parametrize(("name", "kind"), SOME)
def test_names_of_objects_do_not_matter(name: str, kind: str) -> None:
    made, tray = LOADS[name](kind), odd_loads.tray_motion(4, 10)
    new = {item.name: f"z{k}-{item.name[::-1]}" for k, item in enumerate(made.objects)}
    objects = []
    for item in made.objects:
        data = item.model_dump(mode="json", exclude_none=True)
        objects.append(data | {"name": new[item.name], "on": new.get(data["on"], data["on"])})
    correlation = {}
    for pair, value in made.uncertainty.correlation.items():
        for old, other in new.items():
            pair = pair.replace(f"{old}.", f"{other}.")
        correlation[pair] = value
    renamed = made.with_changes(objects=objects, uncertainty__correlation=correlation)
    names = {f"{i.name} on {i.on}": f"{new[i.name]} on {new.get(i.on, i.on)}" for i in made.objects}
    assert_same(along(made, tray), along(renamed, tray), names)


# Bounds over nasty sets -------------------------------------------------------------------------------------------


def to_the_edge(base: Array, wrench: Array) -> Array:
    """(T,) distance of the point where the pressure acts from the nearest edge of a base (n, 3) in B, negative outside.

    Where the moment about the horizontal axes vanishes, in the plane of the base.
    """
    depth = base[0, 2]
    point = np.column_stack([-wrench[:, 4] + depth * wrench[:, 0], wrench[:, 3] + depth * wrench[:, 1]])
    point = point / wrench[:, 2:3]
    edge = np.roll(base, -1, axis=0) - base
    out = np.column_stack([edge[:, 1], -edge[:, 0]]) / np.linalg.norm(edge[:, :2], axis=1)[:, None]
    return (np.einsum("ei,ei->e", out, base[:, :2]) - point @ out.T).min(axis=1)


def test_zero_moment_point_by_hand() -> None:
    """The upper box stands where two turned rectangles overlap: a base without any symmetry."""
    sure = {f"objects__{k}__uncertainty__position": None for k in range(2)}
    made, tray = odd_loads.stack(**sure), odd_loads.tray_motion(60, 15, push=3.0)  # some far off the base
    wrenches = odd_loads.interface_wrenches(made, {}, odd_loads.felt(tray))
    for m, item, wrench in zip(along(made, tray).interfaces, made.objects, wrenches, strict=True):
        assert_allclose(m.wrench_B, wrench, atol=1e-9)
        distance = to_the_edge(odd_loads.sure_points_B(made, item.name), wrench)
        assert_allclose(m.tip_over, np.where(wrench[:, 2] > 0, distance, -np.inf), atol=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize(("name", "kind"), SOME)
def test_zero_moment_point_of_every_sample_is_within_the_worst_tip_over(name: str, kind: str) -> None:
    """The point where the pressure acts, by hand from the true wrench, against the edges of the base that is sure."""
    made, tray = LOADS[name](kind), odd_loads.tray_motion(8, 11)
    w, uncertain, whole = odd_loads.felt(tray), made.payload.uncertain, along(made, tray)
    nearest = {m.name: np.full(len(w), np.inf) for m in whole.interfaces}
    for change in sampled_sets.samples(uncertain, 150, 3):
        for item, wrench in zip(made.objects, odd_loads.interface_wrenches(made, change, w), strict=True):
            distance = to_the_edge(odd_loads.sure_points_B(made, item.name), wrench)
            key = f"{item.name} on {item.on}"
            nearest[key] = np.minimum(nearest[key], distance)
    for m in whole.interfaces:
        radius = m.tip_over - m.tip_over_worst
        assert np.all(nearest[m.name] >= m.tip_over_worst - 1e-5)
        # Corners reach half of the tube of so many parameters, random directions of a ball a tenth.
        assert np.median((m.tip_over - nearest[m.name]) / radius) > (0.4 if kind == "box" else 0.1)


@pytest.mark.parametrize(("name", "kind"), SOME)
def test_worst_parameters_are_where_the_worst_case_is(name: str, kind: str) -> None:
    """The load with those parameters, and the least friction, has the margin that the whole set has."""
    made = odd_loads.small(LOADS[name](kind), 1e-3)
    place = {f"objects__{k}__uncertainty__position": [3e-6, 2e-6] for k in range(len(made.objects))}
    made = made.with_changes(**place)
    tray, uncertain, rows = odd_loads.tray_motion(5, 13), made.payload.uncertain, odd_loads.TrueRows(made)
    whole = along(made, tray)
    worst, k = whole.worst_parameters(), int(np.argmin(whole.exact_worst))
    assert list(worst) == list(uncertain.names)
    w = odd_loads.felt(tray)[k : k + 1]
    change = {n: worst[n] - x for n, x in zip(uncertain.names, uncertain.nominal, strict=True)}
    for n, half in zip(uncertain.names, uncertain.half_range, strict=True):
        assert abs(change[n]) <= half * (1 + 1e-9)
        if n.endswith("friction"):
            assert change[n] == pytest.approx(-half)
    nominal, reached = -rows.worst({}, w)[0], -rows.worst(change, w, {} if kind == "ellipsoid" else None)[0]
    assert (nominal - reached) / (nominal - whole.exact_worst[k]) == pytest.approx(1.0, abs=4e-3)


@pytest.mark.slow
@pytest.mark.parametrize(("name", "kind"), [("single", "box"), ("stack", "ellipsoid"), ("pair", "ellipsoid")])
def test_friction_needed_in_the_worst_case_is_that_of_no_less_a_load(name: str, kind: str) -> None:
    """With that much friction no load of the set slides, with a little less one of them does."""
    made = odd_loads.small(LOADS[name](kind), 1e-3)
    place = {f"objects__{k}__uncertainty__position": [3e-6, 2e-6] for k in range(len(made.objects))}
    made = made.with_changes(**place)
    tray, uncertain = odd_loads.tray_motion(4, 14, push=0.7), made.payload.uncertain
    w, whole = odd_loads.felt(tray), along(made, tray)
    for k, m in enumerate(whole.interfaces):
        needed = m.friction_needed_worst
        assert 0.05 < needed < 5.0
        for friction, slides in ((needed + 2e-4, False), (needed - 1e-3, True)):
            other = made.with_changes(
                **{f"objects__{k}__friction": friction, f"objects__{k}__uncertainty__friction": None}
            )
            rows = odd_loads.TrueRows(other)
            own = [
                rows.at(change, w)[k].max()
                for change in [*sampled_sets.samples(uncertain, 20), *aimed(rows, uncertain, w, k)]
            ]
            assert (max(own) > 0) == slides, (m.name, friction, max(own))


def aimed(rows: odd_loads.TrueRows, uncertain: odd_loads.UncertainSet, w: Array, k: int) -> list[dict[str, float]]:
    """Deviations to where the largest row of object k rises most, at each instant."""
    names, half = uncertain.names, uncertain.half_range
    ends = [[rows.at({n: s * h}, w)[k] for s in (1, -1)] for n, h in zip(names, half, strict=True)]
    slope = np.array([(up - down) / (2 * h) for (up, down), h in zip(ends, half, strict=True)])
    found = []
    for t in range(len(w)):
        for f in np.argsort(rows.at({}, w)[k][t])[-3:]:
            point = sampled_sets.steepest(slope[:, t, f], uncertain)
            found.append(dict(zip(names, point, strict=True)))
    return found


# The verdict -----------------------------------------------------------------------------------------------------


def pushed(*accelerations: float) -> MotionSamples:
    """A level tray that accelerates along x, in shares of g, a tenth of a second apart."""
    count = len(accelerations)
    zero = np.zeros((count, 3))
    a = np.column_stack([odd_loads.G * np.array(accelerations), zero[:, 1:]])
    return MotionSamples(0.1 * np.arange(count), zero, zero, a, np.tile(np.eye(3), (count, 1, 1)), zero, zero)


def tall(name: str, x: float, width: float, friction: float) -> dict:
    shape = {"type": "box", "size": [width, 0.1, 0.2]}
    return {"name": name, "shape": shape, "mass": 0.5, "friction": friction, "at": [x, 0.0]}


def test_verdict_is_of_the_first_that_fails_and_of_the_worst_that_it_does() -> None:
    """At 0.3 g a box of 6 cm with its centre of mass 10 cm up tips; friction 0.2 slides at 0.2 g."""
    made = odd_loads.scenario([tall("tips", -0.06, 0.06, 0.8), tall("slides", 0.05, 0.09, 0.2)])
    made = made.with_changes(uncertainty__tilt_deg=None)
    cases = [
        ((0.1, 0.25, 0.5), "slides", "slides on tray", 0.1),
        ((0.1, 0.5, 0.25), "tips", "tips on tray", 0.1),
        ((0.1, 0.15, -0.31), "tips", "tips on tray", 0.2),  # both at once: the one listed first
        ((0.1, 0.19, -0.15), "holds", "slides on tray", 0.1),
    ]
    for accelerations, code, interface, time in cases:
        for worst in (False, True):
            verdict = along(made, pushed(*accelerations), edges=32).verdict(worst=worst)
            assert verdict.code == code, accelerations
            assert verdict.details["interface"] == interface
            assert verdict.details["time"] == pytest.approx(time)
    # One that tips and slides at the same instant tips; one that nothing presses lifts.
    alone = odd_loads.scenario([tall("tips", 0.0, 0.06, 0.4)]).with_changes(uncertainty__tilt_deg=None)
    assert along(alone, pushed(0.0, 0.5)).verdict().code == "tips"
    falling = pushed(0.0, 0.0)
    falling.a_S[1, 2] = -1.01 * odd_loads.G
    assert along(alone, falling).verdict().code == "lifts"
    assert along(alone, falling).verdict(worst=True).code == "lifts"


@pytest.mark.parametrize(("edges", "used"), [(3, 9), (4, 8), (5, 10), (8, 8), (12, 12)])
def test_margins_take_pyramids_that_hold_the_plans(edges: int, used: int) -> None:
    made = odd_loads.single(contact__edges=edges)
    first = made.payload.first
    whole = margins(made, odd_loads.tray_motion(2).of_frame(first.p_EB, first.R_EB))
    assert whole.model.edges == used
    assert {m.interface.contacts.edges for m in whole.interfaces} == {used}


def test_phase_of_the_edges_by_hand() -> None:
    """Along an edge of the pyramid friction counts in full, between two of four only by cos 45 degrees."""
    slab = {"name": "slab", "shape": {"type": "box", "size": [0.1, 0.1, 0.02]}, "mass": 0.5, "friction": 0.5}
    for phase, needed in ((0.0, 0.2), (45.0, 0.2 * np.sqrt(2)), (90.0, 0.2), (30.0, 0.2 * (np.cos(0.5236) + 0.5))):
        made = odd_loads.scenario([slab], contact__edge_phase_deg=phase).with_changes(uncertainty__tilt_deg=None)
        (m,) = along(made, pushed(0.2)).interfaces
        assert m.friction_needed[0] == pytest.approx(needed, rel=1e-5)
