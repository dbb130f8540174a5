"""Joint motions: the tray goes where the object goes, derivatives belong together, limits are told of rightly."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.polynomial import Chebyshev

from salver import scenario
from salver.errors import ScenarioError
from salver.geometry import GRAVITY_S, exp, log
from salver.models.arm.arm import load_arm
from salver.models.arm.arm_geometry import arm_geometry
from salver.models.arm.arm_limits import VelocityByPosition
from salver.planning.follow.limits import peaks, torques, verdict
from salver.planning.follow.motion import follow, follow_scenario
from salver.planning.follow.redundancy import Usage, first_choice, solve_path, tray_path
from salver.planning.make import make_plan, plan_pair
from salver.planning.postures import PoseTarget, candidate_postures, postures_along, start_posture
from salver.trajectory import JointMotion, PolynomialReference, min_jerk_line
from sampled_sets import object_jacobian

CUBE = scenario.load("panda-cube")
START, GOAL = np.array(CUBE.motion.start.position), np.array(CUBE.motion.goal.position)
POSTURE = np.array(CUBE.arm.start_posture)
UPRIGHT = np.eye(3)


@pytest.fixture(scope="module")
def panda():
    return load_arm(CUBE.arm, CUBE.tray)


@pytest.fixture(scope="module")
def cube():
    return CUBE.payload.first


def line(duration=2.5, goal=GOAL, start=START):
    return min_jerk_line(duration, start, goal, UPRIGHT, UPRIGHT)


def tumbling(duration=2.0):
    """A curved path with rotation about changing axes: min-jerk plus random polynomials at rest at both ends."""
    base = min_jerk_line(duration, START, GOAL, UPRIGHT, exp(np.array([0.1, -0.2, 0.5])))
    rng = np.random.default_rng(0)
    hump = Chebyshev([0.5, 0, -0.5])  # 1 - s^2
    wiggle = np.stack([(hump**3 * Chebyshev(rng.normal(size=4) * 0.05)).coef for _ in range(3)], axis=1)
    turn = np.stack([(hump**2 * Chebyshev(rng.normal(size=4) * 0.3)).coef for _ in range(3)], axis=1)
    position = wiggle + np.pad(base.position, ((0, 4), (0, 0)))
    return PolynomialReference(duration, UPRIGHT, position, turn + np.pad(base.angular_velocity, ((0, 3), (0, 0))))


def start_posture_of(arm, path):
    """One that puts the tray at the beginning of a path."""
    return candidate_postures(arm, PoseTarget(path.p_SE[0], path.R_SE[0]))[0]


PLACES = [
    (np.array([0.0, 0.0, 0.02]), UPRIGHT),
    (np.array([0.04, -0.03, 0.06]), exp(np.array([0.0, 0.0, 0.7]))),
]


@pytest.mark.slow
@pytest.mark.parametrize("place", PLACES, ids=["centred", "off-centre and turned"])
@pytest.mark.parametrize("name", ["panda", "ur10"])
def test_tray_carries_the_object_along_the_reference(name, place):
    arm = load_arm(scenario.Arm(model=name, base_position=(-0.4, 0, 0) if name == "ur10" else (0, 0, 0)), CUBE.tray)
    reference, (p_EB, R_EB) = tumbling(), place
    motion, status = follow(arm, reference, p_EB, R_EB)
    assert status.ok, status
    t = np.random.default_rng(1).uniform(0, reference.duration, 100)
    q, dq, ddq = motion.sample(t)
    wanted = reference.sample(t)
    for k in range(len(t)):
        p, rotation = arm.object_pose(q[k], p_EB, R_EB)
        assert p == pytest.approx(wanted.p_SB[k], abs=1e-9)
        assert np.linalg.norm(log(rotation.T @ wanted.R_SB[k])) < 1e-9
        jacobian = object_jacobian(arm, q[k], p_EB, R_EB)
        twist = jacobian @ dq[k]
        assert rotation @ twist[:3] == pytest.approx(wanted.v_S[k], abs=1e-7)
        assert twist[3:] == pytest.approx(wanted.omega_B[k], abs=1e-7)
        h = 1e-6
        rate = jacobian @ ddq[k] + (
            (object_jacobian(arm, q[k] + h * dq[k], p_EB, R_EB) - object_jacobian(arm, q[k] - h * dq[k], p_EB, R_EB))
            @ dq[k]
        ) / (2 * h)
        acceleration = rotation @ (rate[:3] + np.cross(twist[3:], twist[:3]))
        assert acceleration == pytest.approx(wanted.a_S[k], abs=1e-6)
        assert rate[3:] == pytest.approx(wanted.alpha_B[k], abs=1e-6)


def test_samples_are_exact_derivatives_of_each_other(panda, cube):
    motion, _ = follow(panda, tumbling(), cube.p_EB, cube.R_EB, q_start=POSTURE)
    h = motion.t[1] - motion.t[0]
    # Central differences of fourth order: what is left is the sixth derivative of a slow polynomial.
    q, dq = motion.q, motion.dq
    assert (q[:-4] - 8 * q[1:-3] + 8 * q[3:-1] - q[4:]) / (12 * h) == pytest.approx(dq[2:-2], abs=1e-6)
    assert (dq[:-4] - 8 * dq[1:-3] + 8 * dq[3:-1] - dq[4:]) / (12 * h) == pytest.approx(motion.ddq[2:-2], abs=1e-5)


def test_starts_and_ends_at_rest_where_it_was_told(panda, cube):
    motion, status = follow(panda, line(), cube.p_EB, cube.R_EB, bodies=[cube], q_start=POSTURE)
    assert status.ok, status
    assert motion.q[0] == pytest.approx(POSTURE, abs=1e-5)
    assert (motion.t[0], motion.t[-1]) == (0.0, 2.5)
    assert np.diff(motion.t).max() == pytest.approx(0.005, rel=1e-9)  # 5 ms are promised; 2.5 s are 500 of them
    for k in (0, -1):
        assert motion.dq[k] == pytest.approx(np.zeros(7), abs=1e-12)
        assert motion.ddq[k] == pytest.approx(np.zeros(7), abs=1e-12)


def test_redundancy_brings_speeds_down(cube):
    """At T = 0.8 s the paper's posture needs over 2.3 rad/s of joint 1 (limit 2.175) if the arm moves with least joint
    speed; a swivel of the elbow brings that down, where a small tray leaves room for it."""
    arm = load_arm(CUBE.arm, scenario.Tray(size=(0.1, 0.1)))
    path = tray_path(line(0.8), cube.p_EB, cube.R_EB, np.linspace(0, 0.8, 81))
    least_speed, _ = postures_along(arm, path.p_SE, path.R_SE, POSTURE)
    assert np.abs(np.gradient(least_speed[:, 0], path.t)).max() > 2.3
    motion, _ = follow(arm, line(0.8), cube.p_EB, cube.R_EB, q_start=POSTURE)
    assert np.abs(motion.dq[:, 0]).max() < 2.175
    assert max(peak.share for peak in peaks(arm, motion)) < 1.03


EVENLY = {"sharpness": 2}  # every share counts, not only the largest
SINGULAR = {"singular": 10.0}
BY_POSITION: dict[str, float] = {"sharpness": 4}  # with velocity limits that fall towards the ends of the range


@pytest.mark.parametrize(
    ("duration", "order", "weights"),
    [
        *(
            (0.6, 0, {}),
            (0.6, 1, {}),
            (0.6, 2, {}),
            (2.0, 0, {}),
            (0.6, 0, SINGULAR),
            (0.6, 1, EVENLY),
            (0.6, 2, EVENLY),
        ),
        *((0.6, 0, BY_POSITION), (0.6, 1, BY_POSITION)),
    ],
)
def test_how_the_use_of_the_redundancy_changes_what_is_used_of_the_limits(panda, duration, order, weights):
    """The derivative by s, s', s'' of C q = s(t), where the tray's motion stays, against differences: of a motion near
    the limits of speed and torque, of a slow one with a ball behind the elbow, where singular postures are what matters
    most, and where everything matters."""
    arm = panda
    if weights is BY_POSITION:
        ends = VelocityByPosition(arm.limits.q_min - 0.1, arm.limits.q_max + 0.1, np.full(7, 2.0), np.full(7, 0.1))
        arm = replace(arm, planning_limits=replace(arm.planning_limits, velocity_by_position=ends))
    path = tray_path(tumbling(duration), *PLACES[1], np.linspace(0, duration, 31))
    postures, reached = postures_along(arm, path.p_SE, path.R_SE, start_posture_of(arm, path))
    assert reached == 31
    behind = arm.link_pose(postures[15], "panda_link4")[0] - [0.15, 0, 0]
    around = [scenario.Obstacle(type="sphere", radius=0.05, position=behind.tolist())] if duration > 1 else []
    parts = arm_geometry(arm, (), around)
    choice = first_choice(arm, parts, path, postures)
    profile = choice.profile(path.t)
    joints = solve_path(arm, path, choice.path.q, choice.rows, profile)
    usage = Usage(arm, parts, joints, **weights)
    if around:
        assert usage.cost > 1.1 * Usage(arm, arm_geometry(panda), joints, **weights).cost
    gradient = usage.gradient(choice.rows)[order]
    rng = np.random.default_rng(order)
    direction = rng.normal(size=gradient.shape)
    costs = []
    for h in (-1e-5, 1e-5):
        changed = tuple(x + h * direction * (k == order) for k, x in enumerate(profile))
        joints = solve_path(arm, path, choice.path.q, choice.rows, changed)
        costs.append(Usage(arm, parts, joints, **weights).cost)
    scale = np.linalg.norm(gradient) * np.linalg.norm(direction)
    assert np.vdot(gradient, direction) == pytest.approx((costs[1] - costs[0]) / 2e-5, abs=1e-4 * scale)
    assert scale > 1e-3


@pytest.mark.slow
def test_a_chosen_start_is_no_worse_than_the_given_one(panda, cube):
    def worst(q_start):
        motion, status = follow(panda, line(), cube.p_EB, cube.R_EB, bodies=[cube], q_start=q_start)
        assert status.ok, status
        smallest = min(np.linalg.svd(panda.body_jacobian(q))[1][-1] for q in motion.q[::20])
        assert smallest > 0.1
        return max(peak.share for peak in peaks(panda, motion, [cube]))

    assert worst(None) <= worst(POSTURE)


def test_a_joint_that_turns_more_than_once_is_as_near_to_the_middle_of_its_range_as_it_can():
    case = scenario.load("ur10-bottle")
    arm = load_arm(case.arm, case.tray)
    twice = arm.limits.q_max - arm.limits.q_min > 2 * np.pi
    found = candidate_postures(arm, PoseTarget(np.array(case.motion.start.position), UPRIGHT))
    assert twice.all()
    assert len(found) > 3
    assert np.abs(np.array(found)).max() <= np.pi


def test_candidates_are_different_and_reach(panda):
    p, rotation = START - np.array([0, 0, 0.02]), UPRIGHT
    found = candidate_postures(panda, PoseTarget(p, rotation), seed=5)
    assert len(found) > 3
    for i, q in enumerate(found):
        assert panda.tray_pose(q)[0] == pytest.approx(p, abs=1e-10)
        assert np.all((q > panda.limits.q_min) & (q < panda.limits.q_max))
        assert all(np.abs(q - other).max() > 0.01 for other in found[:i])


@pytest.mark.slow
def test_scenario_brings_its_posture_and_its_load(panda, cube):
    motion, status = follow_scenario(CUBE, line())
    alone, _ = follow(panda, line(), cube.p_EB, cube.R_EB, bodies=[cube], obstacles=CUBE.around, q_start=POSTURE)
    assert status.ok
    assert np.array_equal(motion.q, alone.q)
    elsewhere, _ = follow_scenario(CUBE, line(), panda, q_start=motion.q[0])
    assert elsewhere.q[0] == pytest.approx(motion.q[0], abs=1e-12)
    with pytest.raises(ScenarioError, match="has no arm"):
        follow_scenario(CUBE.with_changes(arm=None), line())


def test_what_one_motion_begins_with_beyond_a_limit_is_no_wrong_key(panda):
    """Another one is not made to begin there: nobody gave that posture."""
    motion, status = follow_scenario(CUBE, line(), panda)
    beyond = motion.q[0].copy()
    beyond[3] = panda.limits.q_max[3] + 0.1
    again, same = follow_scenario(CUBE, line(), panda, q_start=beyond)
    assert np.array_equal(again.q, motion.q)
    assert same.sentence == status.sentence


@pytest.mark.slow
def test_scenario_brings_the_seed_of_its_start(panda, cube):
    free, _ = follow_scenario(CUBE.with_changes(arm__start_posture=None, seed=1), line())
    same, other = (
        follow(panda, line(), cube.p_EB, cube.R_EB, bodies=[cube], obstacles=CUBE.around, seed=seed)[0]
        for seed in (1, 0)
    )
    assert np.array_equal(free.q, same.q)
    assert np.abs(free.q[0] - other.q[0]).max() > 1e-3


# ---- the verdict ----------------------------------------------------------------------------------------------


def min_jerk_of_one_joint(joint, distance, duration, n=7, count=401):
    u = np.linspace(0, 1, count)
    quintic = np.polynomial.Polynomial([0, 0, 0, 10, -15, 6])
    q, dq, ddq = (np.zeros((count, n)) + (POSTURE if d == 0 else 0) for d in range(3))
    for d, x in enumerate((q, dq, ddq)):
        x[:, joint] += distance * (quintic.deriv(d)(u) if d else quintic(u)) / duration**d
    return JointMotion(u * duration, q, dq, ddq)


@pytest.mark.parametrize("count", [2, 3, 12, 401])
def test_peaks_of_a_min_jerk_move_by_hand(panda, count):
    """1.875 d/T at T/2; 10 d/(sqrt(3) T^2) at T (3 - sqrt 3)/6; 60 d/T^3 at both ends. However few samples say so."""
    distance, duration, joint = 0.9, 0.5, 2
    motion, fine = (min_jerk_of_one_joint(joint, distance, duration, count=n) for n in (count, 4001))
    found, finely = ({peak.kind: peak for peak in peaks(panda, x)} for x in (motion, fine))
    for kind, within in (("torque", 1e-3), ("torque rate", 0.02)):
        assert found[kind].share == pytest.approx(finely[kind].share, rel=within)
    limits = panda.planning_limits
    velocity, acceleration, jerk = found["velocity"], found["acceleration"], found["jerk"]
    assert velocity.joint == acceleration.joint == jerk.joint == "panda_joint3"
    assert velocity.share == pytest.approx(1.875 * distance / duration / limits.velocity[joint], rel=1e-6)
    assert velocity.time == pytest.approx(duration / 2)
    assert velocity.limit == pytest.approx(0.98 * 2.175)
    assert abs(acceleration.value) == pytest.approx(10 * distance / np.sqrt(3) / duration**2, rel=1e-4)
    early = duration * (3 - np.sqrt(3)) / 6
    assert min(abs(acceleration.time - early), abs(acceleration.time - (duration - early))) < 2e-3
    assert jerk.share == pytest.approx(60 * distance / duration**3 / (0.95 * 5000), rel=1e-6)
    later = {peak.kind: peak for peak in peaks(panda, replace(motion, t=motion.t + 100.0))}
    for kind, peak in found.items():
        assert later[kind].share == pytest.approx(peak.share, rel=1e-6)
    assert later["velocity"].time == pytest.approx(100.0 + duration / 2)
    assert found["position"].share == pytest.approx(2.197384 / 2.8973)


def test_verdict_names_joint_time_and_excess(panda):
    motion = min_jerk_of_one_joint(2, 0.9, 0.5)
    status = verdict(panda, motion)
    assert not status.ok
    assert status.code == "limit_exceeded"
    excess = 100 * (1.875 * 0.9 / 0.5 / (0.98 * 2.175) - 1)
    assert f"velocity of panda_joint3 reaches 3.375 rad/s at t = 0.25 s, {excess:.3g} % over" in status.sentence
    assert "acceleration of panda_joint3" in status.sentence
    assert "torque of" not in status.sentence
    slow = verdict(panda, min_jerk_of_one_joint(2, 0.9, 2.0))
    assert slow.ok
    assert slow.details["velocity"]["share"] == pytest.approx(1.875 * 0.9 / 2 / (0.98 * 2.175), rel=1e-6)


def test_position_beyond_its_limit(panda):
    status = verdict(panda, min_jerk_of_one_joint(3, 2.0, 5.0))
    assert "position of panda_joint4 reaches 0.3219 rad at t = 5.00 s" in status.sentence


def test_load_counts_in_the_torque(panda, cube):
    motion = min_jerk_of_one_joint(0, 0.0, 1.0)
    extra = torques(panda, motion, [cube])[0] - torques(panda, motion)[0]
    v = object_jacobian(panda, POSTURE, cube.p_EB, cube.R_EB)[:3]
    _, rotation = panda.object_pose(POSTURE, cube.p_EB, cube.R_EB)
    assert extra == pytest.approx(-v.T @ rotation.T @ (0.256 * GRAVITY_S), abs=1e-12)
    heavy = CUBE.with_changes(objects__0__mass=40.0, objects__0__inertia=[0.1, 0.1, 0.1])
    status = verdict(panda, motion, heavy.payload.bodies)
    assert "torque of" in status.sentence


def test_too_fast_says_so_and_still_returns_the_motion(panda, cube):
    motion, status = follow(panda, line(0.4), cube.p_EB, cube.R_EB, q_start=POSTURE)
    assert motion is not None
    assert status.code == "limit_exceeded"
    assert not status.ok


# ---- collision ------------------------------------------------------------------------------------------------

FOREARM_THROUGH_TRAY = np.array([-0.5135, -0.9086, 1.5225, 0.957, -1.5708, 2.0843])


def test_a_posture_with_the_tray_in_the_forearm_is_told():
    arm = load_arm(scenario.Arm(model="ur10"), scenario.Tray(size=(0.285, 0.285)))
    still = JointMotion(
        np.array([0.0, 1.0]), *(np.tile(x, (2, 1)) for x in (FOREARM_THROUGH_TRAY, np.zeros(6), np.zeros(6)))
    )
    status = verdict(arm, still)
    assert status.code == "collision"
    assert status.sentence == "ur10 cannot follow: forearm_link and tray touch at t = 0.00 s."
    small = load_arm(scenario.Arm(model="ur10"), scenario.Tray(size=(0.04, 0.04)))
    assert verdict(small, still).ok


def test_redundancy_keeps_the_tray_out_of_the_forearm(panda, cube):
    """With least joint speed the paper's posture would take a tray 5 cm over the flange 2 cm into link 5."""
    parts = arm_geometry(panda, [cube])
    path = tray_path(line(), cube.p_EB, cube.R_EB, np.linspace(0, 2.5, 31))
    least_speed, reached = postures_along(panda, path.p_SE, path.R_SE, POSTURE)
    assert reached == 31
    assert parts.clearance(least_speed).min() < -0.015
    touch = parts.first_touch(least_speed)
    assert (touch.first, touch.second) == ("panda_link5", "tray")
    motion, status = follow(panda, line(), cube.p_EB, cube.R_EB, bodies=[cube], q_start=POSTURE)
    assert status.ok, status
    assert parts.clearance(motion.q).min() > 0.005


def test_an_obstacle_is_told_and_kept_clear_of_where_the_elbow_can(panda, cube):
    free, _ = follow(panda, line(), cube.p_EB, cube.R_EB, bodies=[cube], q_start=POSTURE)
    elbow, _ = panda.link_pose(free.q[len(free.q) // 2], "panda_link4")
    near_elbow = scenario.Obstacle(
        type="sphere", radius=0.02, position=tuple(elbow + np.array([0, 0, 0.11])), name="lamp"
    )
    in_the_way = scenario.Obstacle(type="box", size=(0.1, 0.1, 0.1), position=(0.5, -0.13, 0.4), name="post")
    parts = arm_geometry(panda, [cube], [near_elbow])
    assert parts.first_touch(free.q).second == "lamp"
    motion, status = follow(panda, line(), cube.p_EB, cube.R_EB, bodies=[cube], q_start=POSTURE, obstacles=[near_elbow])
    assert status.ok, status
    assert parts.clearance(motion.q).min() > 0
    _, status = follow(panda, line(), cube.p_EB, cube.R_EB, bodies=[cube], q_start=POSTURE, obstacles=[in_the_way])
    assert status.code == "collision"
    assert "and post touch at t = " in status.sentence


def test_a_chosen_start_stays_above_the_base():
    """A small tray at 0.7 m, which a UR10 could also carry with its links 0.14 m under the table it stands on."""
    bottle = scenario.load("ur10-bottle")
    arm, carried = load_arm(bottle.arm, scenario.Tray(size=(0.1, 0.1))), bottle.payload.first
    reference = min_jerk_line(2.0, np.array([0.4, -0.2, 0.7]), np.array([0.4, 0.2, 0.7]), UPRIGHT, UPRIGHT)
    motion, status = follow(arm, reference, carried.p_EB, carried.R_EB, obstacles=bottle.around, seed=1)
    assert status.ok, status
    links = [link for link in arm.link_names if link not in ("world", "base_link", "shoulder_link")]
    heights = [arm.link_pose(q, link)[0][2] for q in motion.q[::20] for link in links]
    assert min(heights) > arm.base_position[2]


@pytest.mark.parametrize("name", [pytest.param(x, marks=pytest.mark.slow) for x in ("ur10-bottle", "panda-cube")])
def test_plan_and_baseline_keep_the_arms_limits_from_one_start_posture(name):
    plans = plan_pair(scenario.load(name).with_changes(arm__start_posture=None))
    for plan in plans:
        assert plan.status.ok, plan.status
        assert plan.arm_status.ok, plan.arm_status
    assert plans[0].joint.q[0] == pytest.approx(plans[1].joint.q[0], abs=1e-12)


# ---- out of reach, wrong start --------------------------------------------------------------------------------


@pytest.mark.parametrize("q_start", [None, POSTURE], ids=["chosen start", "given start"])
def test_goal_out_of_reach_tells_where_and_when(panda, cube, q_start):
    motion, status = follow(panda, line(goal=[1.2, 0.1, 0.4]), cube.p_EB, cube.R_EB, q_start=q_start)
    assert motion is None
    assert status.code == "unreachable"
    assert "panda cannot put its tray at (" in status.sentence
    assert "at t = " in status.sentence
    assert 0.7 < status.details["p_SE"][0] < 1.2


def test_start_out_of_reach(panda, cube):
    _, status = follow(panda, line(start=[2.0, 0.0, 0.4]), cube.p_EB, cube.R_EB)
    assert status.code == "unreachable"
    assert "(2.000, 0.000, 0.380) m, where the motion starts" in status.sentence


HERE = PoseTarget(START - np.array([0, 0, 0.02]), UPRIGHT)


@pytest.mark.parametrize(
    ("posture", "words"),
    [
        (POSTURE[:6], ["arm.start_posture has 6 values", "7 joints"]),
        (POSTURE + np.array([0, 0.8, 0, 0, 0, 0, 0]), ["arm.start_posture[1] = 1.83963", "[-1.763, 1.763]"]),
        (POSTURE + np.array([0.1, 0, 0, 0, 0, 0, 0]), ["mm and 5.73 deg", "from (0.542, -0.371, 0.380) m", "5 mm"]),
        (POSTURE + np.array([0, 0, 0, 0, 0, 0, 0.5]), ["mm and 28.6 deg, about the vertical"]),
    ],
)
def test_wrong_start_postures(panda, posture, words):
    with pytest.raises(ScenarioError) as caught:
        start_posture(panda, posture, HERE)
    assert all(word in str(caught.value) for word in words), caught.value


@pytest.mark.slow
def test_every_plan_accepts_the_same_start_postures():
    """One tolerance: 4.4 mm are put right, 5.5 mm are refused, whether the arm follows or is itself planned."""
    arm = load_arm(CUBE.arm, CUBE.tray)
    p = arm.tray_pose(POSTURE)[0]
    lever = np.linalg.norm(arm.tray_pose(POSTURE + 1e-4 * np.eye(7)[0])[0] - p) / 1e-4
    for away, accepted in ((4.4e-3, True), (5.5e-3, False)):
        moved = POSTURE + away / lever * np.eye(7)[0]
        scenario = CUBE.with_changes(arm__start_posture=moved.tolist())
        for method in ("baseline", "fastest"):
            if accepted:
                assert make_plan(scenario, method).joint is not None
            else:
                with pytest.raises(ScenarioError, match=r"arm.start_posture puts"):
                    make_plan(scenario, method)


def test_a_nearly_right_start_posture_is_corrected(panda):
    nearly = POSTURE + 5e-4
    exact = start_posture(panda, nearly, HERE)
    assert np.abs(exact - nearly).max() < 5e-3
    assert panda.tray_pose(exact)[0] == pytest.approx(START - np.array([0, 0, 0.02]), abs=1e-10)
