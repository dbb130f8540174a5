"""From poses to slip, lift, tip, lost and the word for it: hand-made motions whose figures are known beforehand."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from salver import scenario as scenarios
from salver.geometry import exp
from salver.scenario import parse
from salver.simulation import creep
from salver.simulation.outcome import Behaviour, Thresholds, _rate, behaviour, inner_motions, judge
from salver.simulation.scene.loads import true_world
from salver.simulation.scene.scene import Scene, build
from salver.simulation.trace import Trace

T = np.array([-0.2, -0.1, 0.0, 0.1, 0.2, 0.3])  # the motion starts at the third instant
COUNT = len(T)
UPRIGHT = np.eye(3)
TRAY = (0.3, 0.2)


def cube() -> Scene:
    """The paper's cube: 4 cm, at the middle of the tray, B 2 cm above it."""
    case = scenarios.load("panda-cube").with_changes(arm=None)
    return build(case, true_world(case))


def stack(yaw_deg: float = 0.0) -> Scene:
    """A cube of 4 cm on a slab of 6 x 6 x 3 cm that is turned on the tray, 1 cm off the slab's centre."""
    data = scenarios.load("panda-cube").model_dump(mode="json", exclude_none=True)
    data.pop("arm")
    data["objects"] = [
        {"name": "slab", "shape": {"type": "box", "size": [0.06, 0.06, 0.03]}, "mass": 0.4, "friction": 0.5}
        | {"yaw_deg": yaw_deg},
        {"name": "cube", "shape": {"type": "box", "size": [0.04, 0.04, 0.04]}, "mass": 0.1, "friction": 0.3}
        | {"on": "slab", "at": [0.01, 0.0]},
    ]
    case = parse(data, "stack")
    return build(case, true_world(case))


def still(scene: Scene) -> tuple[np.ndarray, np.ndarray]:
    """Poses (N, m, 3), (N, m, 3, 3) on the tray of objects that stay where they were put."""
    return (
        np.tile([load.p_EB for load in scene.loads], (COUNT, 1, 1)),
        np.tile([load.R_EB for load in scene.loads], (COUNT, 1, 1, 1)),
    )


def run(p_EB: np.ndarray, R_EB: np.ndarray, p_XE: np.ndarray, R_XE: np.ndarray) -> Trace:
    m, none = p_EB.shape[1], np.empty((COUNT, 0))
    return Trace(
        t=T, q=none, dq=none, tau=none, p_XE=p_XE, R_XE=R_XE,
        p_XB=p_XE[:, None] + np.einsum("tij,tmj->tmi", R_XE, p_EB), R_XB=R_XE[:, None] @ R_EB,
        foot_force_B=np.zeros((COUNT, 4 * m, 3)), force_X=np.zeros((COUNT, m, 3)),
        touches=np.ones((COUNT, m), bool), collides=np.zeros(COUNT, bool),
    )  # fmt: skip


def seen(scene: Scene, p_EB: np.ndarray, R_EB: np.ndarray, bias: creep.TrayBias | None = None) -> Behaviour:
    """What is made of these poses while the tray itself flies and tumbles, which must not matter."""
    rng = np.random.default_rng(1)
    trace = run(p_EB, R_EB, rng.normal(size=(COUNT, 3)), exp(rng.normal(size=(COUNT, 3))))
    return behaviour(scene, trace, bias or creep.still_bias(COUNT), TRAY)


def test_an_object_that_stays_has_done_nothing():
    found = seen(cube(), *still(cube()))
    for values in (found.slip, found.lift, found.tip_angle, found.slip_E, found.creep_E):
        np.testing.assert_allclose(values, 0, atol=1e-12)
    assert not found.lost.any()


def test_slip_is_the_way_along_the_tray_since_the_motion_began():
    p, R = still(cube())
    p[:2, 0, 0] -= 0.01  # where it was before it came to rest is of no concern to the motion
    p[3, 0] += [3e-4, 0, 0]
    p[4, 0] += [3e-4, -4e-4, 0]
    found = seen(cube(), p, R)
    np.testing.assert_allclose(found.slip[2:, 0], [0, 3e-4, 5e-4, 0], atol=1e-12)
    np.testing.assert_allclose(found.slip_E[4, 0], [3e-4, -4e-4, 0], atol=1e-12)
    np.testing.assert_allclose(found.slip[0, 0], 0.01, atol=1e-12)
    np.testing.assert_allclose(found.lift, 0, atol=1e-12)


def test_a_turn_on_the_spot_slips_by_its_corners():
    """By the chord of 1 degree at the corner, 2 cm times root 2 out, though the middle has not moved."""
    p, R = still(cube())
    R[4, 0] = exp(np.array([0, 0, np.deg2rad(1)]))
    found = seen(cube(), p, R)
    assert found.slip[4, 0] == pytest.approx(2 * np.sin(np.deg2rad(0.5)) * 0.02 * np.sqrt(2), rel=1e-9)
    np.testing.assert_allclose(found.slip_E[4, 0], 0, atol=1e-12)
    assert found.tip_angle[4, 0] == pytest.approx(0, abs=1e-9)


@pytest.mark.parametrize("axis", [[1, 0, 0], [0, 1, 0], [-0.6, 0.8, 0]])
@pytest.mark.parametrize("degrees", [1.0, 30.0, 120.0])
def test_tip_is_the_angle_off_the_normal_whatever_the_yaw(axis, degrees):
    p, R = still(cube())
    R[4, 0] = exp(np.deg2rad(degrees) * np.array(axis)) @ exp(np.array([0, 0, 0.7]))
    assert seen(cube(), p, R).tip_angle[4, 0] == pytest.approx(np.deg2rad(degrees), rel=1e-9)


def test_lift_is_of_the_whole_base():
    """Raised by 1.5 mm it has lifted; turned about an edge of its base, which stays down, it has not."""
    p, R = still(cube())
    p[3, 0, 2] += 1.5e-3
    turn = exp(np.array([0, np.deg2rad(5), 0]))
    edge = np.array([0.02, 0, 0])
    p[4, 0], R[4, 0] = edge + turn @ (p[4, 0] - edge), turn
    p[5, 0, 2] -= 1e-4  # pressed into the tray
    np.testing.assert_allclose(seen(cube(), p, R).lift[:, 0], [0, 0, 0, 1.5e-3, 0, 0], atol=1e-12)


@pytest.mark.parametrize(
    ("place", "lost"),
    [
        ([0.149, 0.099, 0.02], False),  # the tray is 0.3 by 0.2 m
        ([0.151, 0, 0.02], True),
        ([-0.151, 0, 0.02], True),
        ([0, 0.101, 0.02], True),
        ([0, -0.101, 0.02], True),
        ([0, 0, 0.5], False),  # thrown up, it may come down again
        ([0, 0, -0.001], True),  # below the tray
    ],
)
def test_lost_is_beyond_the_edge_or_below_the_tray(place, lost):
    p, R = still(cube())
    p[4, 0] = place
    np.testing.assert_array_equal(seen(cube(), p, R).lost[:, 0], [False] * 4 + [lost, False])


def test_what_rides_on_a_sliding_object_does_not_slide_itself():
    """The slab moves and turns on the tray with the cube on it as if glued: all slip is the slab's."""
    scene = stack(yaw_deg=20.0)
    p, R = still(scene)
    turn, shift = exp(np.array([0, 0, 0.1])), np.array([0.004, -0.003, 0])
    centre = p[4, 0].copy()
    for k in range(2):
        p[4, k], R[4, k] = centre + shift + turn @ (p[4, k] - centre), turn @ R[4, k]
    found = seen(scene, p, R)
    corners = 0.03 * np.array([[1, 1, 0], [-1, 1, 0], [-1, -1, 0], [1, -1, 0]]) @ scene.loads[0].R_EB.T
    moved = shift + corners @ turn.T - corners
    assert found.slip[4, 0] == pytest.approx(np.hypot(moved[:, 0], moved[:, 1]).max(), rel=1e-9)
    np.testing.assert_allclose(found.slip[:, 1], 0, atol=1e-12)
    np.testing.assert_allclose(found.tip_angle, 0, atol=1e-9)


def test_slip_and_lift_of_an_upper_object_are_measured_on_the_lower_one():
    scene = stack(yaw_deg=20.0)
    p, R = still(scene)
    p[3, 1] += [1e-3, 0, 2e-3]
    p[4, 0] += [1e-3, 0, 0]  # the slab is pulled away from under it
    p[5, :, 2] += 3e-3  # both rise together: the slab has lifted off the tray, the cube not off the slab
    found = seen(scene, p, R)
    np.testing.assert_allclose(found.slip[2:, 1], [0, 1e-3, 1e-3, 0], atol=1e-12)
    np.testing.assert_allclose(found.lift[2:], [[0, 0], [0, 2e-3], [0, 0], [3e-3, 0]], atol=1e-12)


def test_tip_of_an_upper_object_is_measured_on_the_lower_one():
    """The slab leans by 10 degrees with the cube on it; the cube then leans by 5 more about an axis of its own."""
    scene = stack(yaw_deg=20.0)
    p, R = still(scene)
    lean = exp(np.deg2rad([10, 0, 0]))
    for k in range(2):
        p[4, k], R[4, k] = lean @ p[4, k], lean @ R[4, k]
    p[5], R[5] = p[4], R[4]
    R[5, 1] = R[4, 1] @ exp(np.deg2rad([3, 4, 0]))
    found = seen(scene, p, R)
    np.testing.assert_allclose(np.rad2deg(found.tip_angle[3:]), [[0, 0], [10, 0], [10, 5]], atol=1e-6)


def test_creep_is_taken_off_slip():
    """A tray whose contacts are biased by a constant acceleration: the object creeps against it, and has not slid."""
    scene = cube()
    a = np.array([3.0, -2.0, 5.0])
    bias = replace(creep.still_bias(COUNT), linear=np.tile(a, (COUNT, 1)))
    gain = 0.5 * 0.95 * scene.contact_time - 0.5 * scene.model.opt.timestep  # s, docs of creep.py
    expected = -gain * T[:, None] * (a * [1, 1, 0])
    p, R = still(scene)
    p[:, 0] += expected
    found = seen(scene, p, R, bias)
    np.testing.assert_allclose(found.creep_E[:, 0], expected, atol=1e-12)
    np.testing.assert_allclose(found.slip, 0, atol=1e-12)
    np.testing.assert_allclose(seen(scene, *still(scene), bias).slip[4, 0], gain * 0.2 * np.hypot(3, 2), rtol=1e-9)


def test_creep_of_a_stack_adds_up_and_is_outwards_on_a_turning_tray():
    """At 2 rad/s every contact creeps outwards at gain w^2 times the distance between the bodies' origins.

    The slab's centre is at the tray's; the cube is 1 cm beside it, on a slab that is itself turned by 30 degrees.
    """
    scene = stack(yaw_deg=30.0)
    omega = np.tile([0, 0, 2.0], (COUNT, 1))
    bias = replace(creep.still_bias(COUNT), omega=omega)
    gain = 0.5 * 0.95 * scene.contact_time - 0.5 * scene.model.opt.timestep
    apart = scene.loads[1].p_EB - scene.loads[0].p_EB
    assert np.linalg.norm(apart[:2]) == pytest.approx(0.01)
    outwards = gain * 4.0 * T[:, None] * (apart * [1, 1, 0])
    p, R = still(scene)
    p[:, 1] += outwards
    found = seen(scene, p, R, bias)
    np.testing.assert_allclose(found.creep_E[:, 1], outwards, atol=1e-12)
    np.testing.assert_allclose(found.creep_E[:, 0], 0, atol=1e-12)
    np.testing.assert_allclose(found.slip, 0, atol=1e-12)
    # and the slab's own creep takes the cube along
    shifted = replace(bias, linear=np.tile([1.0, 0, 0], (COUNT, 1)))
    both = seen(scene, p, R, shifted).creep_E
    np.testing.assert_allclose(both[:, 1] - both[:, 0], outwards, atol=1e-12)
    np.testing.assert_allclose(both[:, 0], -gain * T[:, None] * [1, 0, 0], atol=1e-12)


# ---- the word for it ------------------------------------------------------------------------------------------

LIMITS = Thresholds(slip=0.5, tip=0.5, lift=0.5)


def quiet(m: int = 1) -> dict[str, np.ndarray]:
    """Nothing happens to m objects."""
    zero = np.zeros((COUNT, m))
    return {
        "p_EB": np.zeros((COUNT, m, 3)),
        "R_EB": np.zeros((COUNT, m, 3, 3)),
        "slip_E": np.zeros((COUNT, m, 3)),
        "creep_E": np.zeros((COUNT, m, 3)),
        "slip": zero.copy(),
        "lift": zero.copy(),
        "tip_angle": zero.copy(),
        "lost": zero.astype(bool),
    }


def judged(fields, touches=None, names=("a",), thresholds=LIMITS):
    touches = np.ones((COUNT, len(names)), bool) if touches is None else touches
    loads = [SimpleNamespace(name=name, value=None) for name in names]
    return judge(T, Behaviour(**fields), touches, thresholds, loads, np.zeros((COUNT, len(names), 3)))


def test_nothing_happened_holds():
    found = judged(quiet())
    assert found["outcome"] == "holds"
    assert not found["slides_at_rest"]
    (one,) = found["objects"]
    assert [one[key] for key in ("first_slip", "first_lift", "first_tip", "lost_at")] == [None] * 4
    assert [one[key] for key in ("peak_slip", "final_slip", "peak_lift", "peak_tip_angle", "contact_lost")] == [0] * 5


@pytest.mark.parametrize(
    ("field", "event", "word"),
    [
        ("slip", "first_slip", "slides"),
        ("lift", "first_lift", "lifts"),
        ("tip_angle", "first_tip", "tips"),
        ("lost", "lost_at", "lost"),
    ],
)
def test_each_event_has_its_word_and_its_time(field, event, word):
    fields = quiet()
    fields[field][3, 0] = 0.4  # below the threshold (and any number but zero is true)
    if field == "lost":
        fields[field][3, 0] = False
    fields[field][4:, 0] = 0.6
    found = judged(fields)
    assert found["outcome"] == found["objects"][0]["outcome"] == word
    events = {key: found["objects"][0][key] for key in ("first_slip", "first_lift", "first_tip", "lost_at")}
    assert events == dict.fromkeys(events, None) | {event: pytest.approx(0.2)}


def test_before_the_motion_only_sliding_at_rest_counts():
    fields = quiet()
    for field in ("slip", "lift", "tip_angle"):
        fields[field][1, 0] = 0.6
    found = judged(fields)
    assert found["outcome"] == "holds"
    assert found["slides_at_rest"]
    assert found["objects"][0]["peak_slip"] == 0
    fields["slip"][1, 0], fields["slip"][3, 0] = 0.4, 0.6
    assert not judged(fields)["slides_at_rest"]


def test_the_worst_word_wins_of_one_object_and_of_all():
    """Tips before lifts before lost before slides before holds."""
    fields = quiet()
    words = []
    for field, when in (("slip", 3), ("lost", 4), ("lift", 3), ("tip_angle", 3)):
        fields[field][when, 0] = 1
        words.append(judged(fields)["outcome"])
    assert words == ["slides", "lost", "lifts", "tips"]
    fields = quiet(3)
    fields["slip"][4, 0] = fields["tip_angle"][4, 2] = 1
    found = judged(fields, names=("a", "b", "c"))
    assert [one["outcome"] for one in found["objects"]] == ["slides", "holds", "tips"]
    assert (found["outcome"], found["worst_object"]) == ("tips", "c")


def test_figures_end_when_an_object_is_lost():
    """What falls past the tray's edge slips and turns without end; that says nothing of the carrying."""
    fields = quiet()
    fields["slip"][:, 0] = [0, 0, 0.1, 0.2, 9, 9]
    fields["lost"][4, 0] = True  # and back over the tray, in free fall, at the last instant
    fields["tip_angle"][5, 0] = 3
    fields["creep_E"][2:4, 0] = [3e-6, -4e-6, 0]
    fields["creep_E"][5, 0] = 1
    found = judged(fields)
    assert found["outcome"] == "lost"
    (one,) = found["objects"]
    assert (one["peak_slip"], one["final_slip"], one["peak_tip_angle"]) == (0.2, 0.2, 0)
    assert one["first_slip"] is None
    assert one["peak_creep"] == pytest.approx(5e-6)


def test_final_and_peak_are_told_apart():
    fields = quiet()
    fields["slip"][:, 0] = [7, 7, 0, 0.4, 0.2, 0.1]
    (one,) = judged(fields)["objects"]
    assert (one["peak_slip"], one["final_slip"]) == (0.4, 0.1)


def test_time_without_contact_is_counted_during_the_motion():
    touches = np.array([[False, True], [True, True], [True, True], [False, True], [False, True], [True, True]])
    found = judged(quiet(2), touches, ("a", "b"))
    assert [one["contact_lost"] for one in found["objects"]] == [pytest.approx(0.2), 0]
    assert found["outcome"] == "holds"


def test_default_thresholds_are_those_that_are_documented():
    """docs/engine.md: half a millimetre along the tray, 2 degrees, one millimetre up."""
    found = judged(quiet(), thresholds=Thresholds())["thresholds"]
    assert found == {"slip": 5e-4, "tip_angle": pytest.approx(np.pi / 90), "lift": 1e-3}


def test_contacts_that_chatter_are_not_waves():
    """A mean over an interval: exact for a steady push; a jolt of speed counts as spread over it."""
    t = np.arange(0, 0.2, 0.001)
    steady = _rate(t, np.outer(t, [3.0, -1.0]), 0.02)
    np.testing.assert_allclose(steady, np.tile([3.0, -1.0], (len(t), 1)), atol=1e-12)
    jolt = _rate(t, 0.01 * (t[:, None] > 0.1), 0.02)
    assert jolt.max() == pytest.approx(0.01 / 0.02)
    assert np.count_nonzero(jolt) == 20


def test_a_cup_that_is_tilted_fast_raises_its_liquid():
    """By 1.3 Omega^2 R^2 / g of its angular velocity across its axis, R its 40 mm; about it, by nothing."""
    case = scenarios.load("panda-coffee").with_changes(arm=None)
    scene = build(case, true_world(case))
    standing = run(*still(scene), np.zeros((COUNT, 3)), np.tile(UPRIGHT, (COUNT, 1, 1)))
    modes = len(scene.swings[0].qpos_ids)
    for omega, across in (([2.0, -1.0, 0.0], 5.0), ([0.0, 0.0, 3.0], 0.0)):
        turned = replace(
            standing,
            swung=np.zeros((COUNT, 1, modes, 2)),
            moved=np.zeros((COUNT, 1, 3)),
            turned=np.tile(omega, (COUNT, 1, 1)),
            pulled=np.tile([0.0, 0.0, -9.81], (COUNT, 1, 1)),
        )
        highest = inner_motions(scene, turned)[:, 0, 2]
        np.testing.assert_allclose(highest, 1.3 * across * 0.04**2 / 9.81, atol=1e-9)
