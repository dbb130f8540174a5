"""Margins of motions: by hand on a level tray, worst cases, verdicts, and the tube of the tracking error."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from armless_scenarios import scenario
from salver.contact_margins import Margins, margin_model, margins
from salver.geometry import Array
from salver.models.rigid_body import inertia_matrix
from salver.models.tray_motion import at_rest
from salver.models.uncertain.parameters import inertial_vector
from salver.scenario import Scenario, load
from salver.trajectory import MotionSamples, min_jerk_line

G = 9.81
CUBE = load("panda-cube").with_changes(objects__0__uncertainty="none", arm=None)


def tall_box(**more: object) -> dict:
    return {"name": "tall", "shape": {"type": "box", "size": [0.06, 0.1, 0.2]}, "mass": 0.5, "friction": 0.4, **more}


def level(accelerations: Array) -> MotionSamples:
    a = np.atleast_2d(np.asarray(accelerations, dtype=float))
    zero = np.zeros_like(a)
    return MotionSamples(0.1 * np.arange(len(a)), zero, zero, a, np.tile(np.eye(3), (len(a), 1, 1)), zero, zero)


def moved(made: Scenario, duration: float, instants: int = 401) -> Margins:
    start, goal = (np.array(p.position) for p in (made.motion.start, made.motion.goal))
    line = min_jerk_line(duration, start, goal, made.motion.start.rotation, made.motion.goal.rotation)
    return margins(made, line.sample(np.linspace(0, duration, instants)))


def test_level_tray_by_hand() -> None:
    """Acceleration a: friction a/g, zero-moment point h a/g behind the centre."""
    a = np.array([0.0, 1.0, 2.0, 3.0, 4.9, 4.91])
    (m,) = margins(CUBE, level(np.column_stack([a, 0 * a, 0 * a]))).interfaces
    assert m.name == "cube on tray"
    assert_allclose(m.friction_needed, a / G, atol=1e-12)
    assert_allclose(m.tip_over, 0.02 - 0.02 * a / G, atol=1e-12)
    assert list(m.exact >= 0) == [True] * 5 + [False]
    assert_allclose(m.wrench_B[1], [0.256, 0, 0.256 * G, 0, 0, 0], atol=1e-12)


def test_nothing_uncertain_leaves_worst_and_nominal_the_same() -> None:
    whole = moved(CUBE, 1.0)
    assert_allclose(whole.exact_worst, whole.exact, atol=1e-12)
    (m,) = whole.interfaces
    assert_allclose(m.tip_over_worst, m.tip_over, atol=1e-12)
    assert_allclose(m.friction_needed_worst, m.friction_needed.max(), atol=1.1e-4)


def test_verdict_changes_within_half_a_percent_of_a_round_cone() -> None:
    """A min-jerk line over d in T needs at most 10 d / (sqrt(3) T^2); it slides when that exceeds mu g."""
    d = np.linalg.norm(np.subtract(CUBE.motion.goal.position, CUBE.motion.start.position))
    critical = np.sqrt(10 * d / (np.sqrt(3) * 0.5 * G))
    holds, slides = moved(CUBE, critical * 1.0025).verdict(), moved(CUBE, critical * 0.9995).verdict()
    assert holds.ok
    assert holds.code == "holds"
    assert slides.code == "slides"
    # Largest acceleration of a min-jerk line at t / T = (1 - 1 / sqrt(3)) / 2.
    assert_allclose(slides.details["time"] / critical, 0.5 - 0.5 / np.sqrt(3), atol=0.02)
    assert "needs friction up to 0.50" in slides.sentence
    # Pyramids with the default edges alone would have said otherwise: the line is not along an edge.
    assert moved(CUBE, critical * 1.0025).exact.min() < 0


def test_tall_box_tips_before_it_slides() -> None:
    """Half width 3 cm, centre of mass 10 cm up: tips at 0.3 g, slides at 0.4 g."""
    made = scenario([tall_box()])
    assert margins(made, level([[0.299 * G, 0, 0]])).verdict().ok
    verdict = margins(made, level([[0, 0, 0], [0.305 * G, 0, 0]])).verdict()
    assert verdict.code == "tips"
    assert "0.5 mm beyond the edge" in verdict.sentence
    assert "at 0.100 s" in verdict.sentence
    assert margins(made, level([[0, 0.41 * G, 0]])).verdict().code == "slides"  # wider in y
    assert margins(made, level([[0, 0, -1.01 * G]])).verdict().code == "lifts"


def test_worst_tip_over_by_hand() -> None:
    """Level acceleration a, centre of mass anywhere within (dx, dy, dz): exact on a tray that does not turn."""
    made = scenario([tall_box(uncertainty={"com": [0.004, 0.002, 0.02], "mass": "10%"})])
    a = np.array([0.0, 1.0, 2.0])
    (m,) = margins(made, level(np.column_stack([a, 0 * a, 0 * a]))).interfaces
    expected = np.minimum(0.03 - 0.004 - 0.12 * a / G, 0.05 - 0.002)
    assert_allclose(m.tip_over_worst, expected, atol=1e-12)
    assert_allclose(m.tip_over, np.minimum(0.03 - 0.1 * a / G, 0.05), atol=1e-12)


def test_worst_friction_on_a_tilted_tray() -> None:
    made = scenario([tall_box(friction=0.6)], uncertainty={"tilt_deg": [3.0, 0.0]}, contact={"edges": 32})
    (m,) = margins(made, level([[0, 0, 0]])).interfaces
    assert_allclose(m.friction_needed_worst, np.tan(np.deg2rad(3)), atol=2e-4)
    assert m.friction_needed[0] < 1e-12


def test_mass_alone_costs_nothing_and_friction_does() -> None:
    made = CUBE.with_changes(objects__0__uncertainty={"mass": "20%", "com": [0.003, 0, 0], "friction": 0.05})
    costs = moved(made, 1.0).costs()
    assert list(costs) == ["mass", "com_x", "friction"]
    assert abs(costs["mass"]) < 1e-12
    assert costs["friction"] > costs["com_x"] >= 0
    m = moved(made, 1.0).interfaces[0]
    assert_allclose(m.least_friction, 0.45)


def test_worst_verdict_is_about_the_least_friction() -> None:
    made = CUBE.with_changes(objects__0__uncertainty={"friction": 0.1})
    critical = 0.79 * np.sqrt(0.5 / 0.4)
    assert moved(made, 0.85).verdict().ok
    worst = moved(made, 0.8).verdict(worst=True)
    assert worst.code == "slides"
    assert "the least in the ranges is 0.400" in worst.sentence
    assert moved(made, critical * 1.06).verdict(worst=True).ok


def test_worst_parameters_are_those_of_the_worst_case() -> None:
    """A scenario with these parameters as nominal ones has the worst-case margin as its own."""
    ranges = {"com": [0.004, 0.002, 0.02], "mass": "10%", "friction": 0.05}
    whole = margins(scenario([tall_box(friction=0.8, uncertainty=ranges)]), level([[1.0, 0.5, 0.2], [0, 3.0, 0]]))
    worst = whole.worst_parameters()
    assert worst["friction"] == pytest.approx(0.75)
    assert [worst[k] for k in ("com_y", "com_z")] == pytest.approx([-0.002, 0.02])
    com = [worst[k] for k in ("com_x", "com_y", "com_z")]
    fixed = scenario([tall_box(com=com, mass=worst["mass"], friction=worst["friction"])])
    assert_allclose(margins(fixed, level([[0, 3.0, 0]])).exact.min(), whole.exact_worst.min(), atol=0.02)
    assert margins(fixed, level([[0, 3.0, 0]])).verdict().code == whole.verdict(worst=True).code


def test_each_object_has_its_own_verdict() -> None:
    slippery = tall_box(
        name="slippery", friction=0.1, at=[0.06, 0.0], shape={"type": "box", "size": [0.05, 0.05, 0.05]}
    )
    whole = margins(scenario([tall_box(at=[-0.05, 0.0]), slippery]), level([[0.2 * G, 0, 0]]))
    assert [m.object for m in whole.interfaces] == ["tall", "slippery"]
    assert whole.of("tall")[0].failure(worst=False) is None
    assert whole.of("slippery")[0].failure(worst=False) is not None
    assert "Slippery on tray slides at 0.000 s" in whole.verdict().sentence
    assert_allclose(whole.exact, np.minimum(*(m.exact for m in whole.interfaces)))


def test_stack_by_hand() -> None:
    """Two cubes of side s: the lower interface sees the common centre of mass at height s, the upper at s / 2."""
    side = 0.065
    cube = {"shape": {"type": "box", "size": [side] * 3}, "mass": 0.02, "friction": 0.54}
    made = scenario([cube | {"name": "lower"}, cube | {"name": "upper", "on": "lower"}])
    lower, upper = margins(made, level([[2.0, 0, 0]])).interfaces
    assert_allclose(lower.tip_over, side / 2 - side * 2 / G, atol=1e-12)
    assert_allclose(upper.tip_over, side / 2 - side / 2 * 2 / G, atol=1e-12)
    assert_allclose([lower.friction_needed[0], upper.friction_needed[0]], 2 / G, atol=1e-12)
    assert margins(made, level([[0.51 * G, 0, 0]])).verdict().details["interface"] == "lower on tray"


def test_position_that_may_miss_the_support() -> None:
    cube = {"shape": {"type": "box", "size": [0.02] * 3}, "mass": 0.02, "friction": 0.5}
    unsure = cube | {"name": "upper", "on": "lower", "uncertainty": {"position": [0.011, 0]}}
    made = scenario([cube | {"name": "lower"}, unsure])
    verdict = margins(made, level([[0, 0, 0]])).verdict(worst=True)
    assert not verdict.ok
    assert "upper on lower may stand beside it" in verdict.sentence


def test_arch_holds_at_rest_and_slides_when_fast() -> None:
    post, lintel = [0.038, 0.09, 0.103], [0.103, 0.09, 0.038]
    block = {"mass": 0.18, "friction": 0.3}
    made = scenario(
        [
            block | {"name": "left", "shape": {"type": "box", "size": post}, "at": [-0.0325, 0]},
            block | {"name": "right", "shape": {"type": "box", "size": post}, "at": [0.0325, 0]},
            block
            | {"name": "top", "shape": {"type": "box", "size": lintel}, "on": ["left", "right"], "friction": 0.42},
        ]
    )
    # All three are pushed along y: the posts slide on the tray at 0.3 g, before the lintel does (0.42 g) and before
    # anything tips (half of 9 cm over the common centre of mass at 7.5 cm: 0.6 g).
    whole = margins(made, level([[0.0, 0, 0], [0, 1.0, 0], [0, 0.2999 * G, 0]]))
    assert [m.name for m in whole.of("top")] == ["top on left", "top on right"]
    assert whole.verdict().ok
    verdict = margins(made, level([[0, 0.3001 * G, 0]])).verdict()
    assert verdict.code == "slides"
    assert verdict.details["interface"] in ("left on tray", "right on tray")  # mirror images of each other


def test_a_worst_case_is_never_better_than_nominal_however_forces_are_shared() -> None:
    """What the lintel of an arch needs of each pillar depends on how they push against one another."""
    made = load("upright-arch")
    lines = [min_jerk_line(d, np.zeros(3), np.array([0.0, 0.4, 0.0]), np.eye(3), np.eye(3)) for d in (2.5, 1.2)]
    for line, duration in zip(lines, (2.5, 1.2), strict=True):
        for m in margins(made, line.sample(np.linspace(0.0, duration, 101))).interfaces:
            assert m.friction_needed_worst > 0.99 * m.friction_needed.max()
            assert np.all(m.tip_over_worst <= m.tip_over)


def test_model_is_made_once_for_a_scenario() -> None:
    assert margin_model(CUBE) is margin_model(CUBE.model_copy())
    assert margin_model(CUBE) is not margin_model(CUBE, edges=12)
    assert_allclose(margin_model(CUBE, edges=4).nominal[0].worst(at_rest()[None]).max(), -1 / 3, atol=1e-12)


def test_inertia_matters_only_where_the_tray_turns() -> None:
    made = scenario([tall_box(uncertainty={"inertia": "50%"})])
    body = made.payload.first
    assert_allclose(inertia_matrix(inertial_vector(body.inertial)[4:]), body.inertial.inertia_com)
    straight = margins(made, level([[1.0, 0, 0]]))
    assert_allclose(straight.exact_worst, straight.exact, atol=1e-12)
    still = level([[1.0, 0, 0]])
    turning = MotionSamples(
        *(getattr(still, k) for k in ("t", "p_SB", "v_S", "a_S", "R_SB", "omega_B")), np.array([[0, 5.0, 0]])
    )
    assert margins(made, turning).exact_worst[0] < margins(made, turning).exact[0] - 1e-3


@pytest.mark.parametrize("known", [("mass", "10%"), ("friction", "10%"), ("fill", "30%")])
def test_what_a_parameter_of_a_liquids_cup_costs_is_what_it_costs_where_it_alone_is_uncertain(
    coffee: Scenario, known: tuple[str, str]
) -> None:
    """For the whole motion, and for some of its instants."""
    exact = coffee.with_changes(arm=None, objects__0__liquid__damping=[0.01, 0.01])
    every, alone = (moved(case, 1.2, 61) for case in (exact, exact.with_changes(objects__0__uncertainty=dict([known]))))
    assert every.costs()[known[0]] == pytest.approx(alone.costs()[known[0]], abs=1e-12)
    (parameter,) = (p for p in every.model.uncertain.parameters if p.kind == known[0])
    payload, some = every.model.with_only(parameter).payload, np.array([10, 30, 31])
    assert every.loads is not None
    both = every.loads.at(some).only(payload), every.loads.only(payload).at(some)
    for one, other in zip(*(x.worst["cup"] for x in both), strict=True):
        assert_allclose(one.wrench, other.wrench)
