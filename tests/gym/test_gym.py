"""salver/Carry-v0, with the real engine and the real planner."""

import warnings
from typing import Any

import numpy as np
import pytest

from salver.errors import SalverError, ScenarioError
from salver.playground.unprotected import Unprotected

gymnasium = pytest.importorskip("gymnasium")

from gymnasium.utils.env_checker import check_env  # noqa: E402

import salver.gym as gym  # noqa: E402


def rolled(env: Any, seed: int, steps: int, act: Any) -> list[np.ndarray]:
    """Observations with rewards."""
    seen, _ = env.reset(seed=seed)
    out, over, k = [np.append(seen, 0.0)], False, 0
    while not over and k < steps:
        seen, reward, over, _, _ = env.step(act(k))
        out.append(np.append(seen, reward))
        k += 1
    return out


@pytest.mark.parametrize(
    "options",
    [
        {},
        pytest.param({"shield": True}, marks=pytest.mark.slow),
        pytest.param({"actions": "joints", "scenario": "panda-coffee"}, marks=pytest.mark.slow),
    ],
)
def test_it_is_an_environment_as_gymnasium_checks_it(options: dict[str, Any]) -> None:
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message=".*infinity")  # of bounds: who falls goes anywhere
        made = gymnasium.make("salver/Carry-v0", **options).unwrapped
        check_env(made)
    assert isinstance(made, gym.Carry)


@pytest.mark.parametrize(
    "options",
    [{}, *(pytest.param({"shield": True, **more}, marks=pytest.mark.slow) for more in ({}, {"actions": "joints"}))],
)
def test_the_same_seed_gives_the_same_episode_and_another_another(options: dict[str, Any]) -> None:
    env = gym.Carry("panda-tall-bottle", **options)
    actions = np.random.default_rng(1).uniform(-1.0, 1.0, (4, len(env.most)))
    first, again, other = (rolled(env, seed, 4, actions.__getitem__) for seed in (3, 3, 4))
    assert np.array_equal(first, again)
    assert not np.array_equal(first[: len(other)], other[: len(first)])


def test_loads_are_drawn_from_the_ranges_of_the_scenario() -> None:
    env = gym.Carry("panda-tall-bottle")
    drawn = [env.reset(seed=seed)[1]["parameters"] for seed in range(10)]
    for name, parameter in zip(
        env.scenario.payload.uncertain.names, env.scenario.payload.uncertain.parameters, strict=True
    ):
        values = np.array([one[name] for one in drawn])
        assert np.ptp(values) > 0, parameter
    mass = np.array([one["mass"] for one in drawn])
    assert (np.abs(mass / 0.256 - 1.0) <= 0.4).all()  # 40 %
    assert np.abs(mass / 0.256 - 1.0).max() > 0.2
    assert env.reset(options={"parameters": {"mass": 0.3}})[1]["parameters"] == {"mass": 0.3}


def straight(env: Any) -> Any:
    """Towards the goal, as fast as may be."""

    def act(k: int) -> np.ndarray:
        away = env.goal - env.plant.p_SB()
        return np.append(away * min(4.0, 1.0 / float(np.linalg.norm(away))), 0.0)

    return act


@pytest.mark.slow
def test_the_shield_keeps_what_the_same_actions_lose_without_it() -> None:
    ends = {}
    for shield in (False, True):
        env = gym.Carry("panda-tall-bottle", shield=shield)
        env.reset(seed=0)
        over, k, told = False, 0, {}
        act = straight(env)
        while not over and k < 250:
            _, reward, over, _, told = env.step(act(k))
            k += 1
        ends[shield] = told["became"]["bottle"], told["arrived"], reward > 0.9, reward < -0.9
    assert ends[False] == ("fallen", False, False, True)
    assert ends[True] == ("", True, True, False)


@pytest.mark.parametrize("shield", [False, True])
def test_a_twist_moves_the_tray_as_it_says(shield: bool) -> None:
    """0.3 s upwards at a tenth of 1 m/s, from rest."""
    env = gym.Carry("panda-cube", shield=shield)
    seen = rolled(env, 0, 15, lambda k: np.array([0.0, 0.0, 0.1, 0.0]))
    moved = seen[-1][env.parts["p_SE"]] - seen[0][env.parts["p_SE"]]
    assert 0.015 < moved[2] < 0.031
    assert np.abs(moved[:2]).max() < 0.003
    assert np.ptp([one[env.parts["p_EB"]] for one in seen], axis=0).max() < 1e-3  # the cube stays on the tray
    rises = -np.diff([one[env.parts["to_goal"]][2] for one in seen])
    assert rises.sum() == pytest.approx(moved[2], abs=1e-3)


@pytest.mark.parametrize("shield", [False, True])
def test_an_action_of_a_joint_turns_that_joint(shield: bool) -> None:
    env = gym.Carry("panda-cube", actions="joints", shield=shield)
    seen = rolled(env, 0, 10, lambda k: 0.05 * np.eye(7)[0])
    turned = seen[-1][env.parts["q"]] - seen[0][env.parts["q"]]
    assert 0.008 < turned[0] < 0.05 * 2.175 * 0.2 + 1e-3  # rad: of 2.175 rad/s, for 0.2 s
    assert np.abs(turned[1:]).max() < 0.3 * turned[0]


def test_a_reward_is_progress_towards_the_goal() -> None:
    env = gym.Carry("panda-cube")
    env.reset(seed=0)
    before = env._away()
    rewards = [env.step(np.array([0.0, 0.1, 0.0, 0.0]))[1] for _ in range(15)]
    assert sum(rewards) == pytest.approx(before - env._away(), abs=1e-12)
    assert sum(rewards) > 0.01


def test_jogging_joints_keep_their_limits() -> None:
    arm = gym.Carry("panda-cube").arm
    servo = Unprotected(arm, np.array([0.0, 0.0, 0.0, -1.5, 0.0, 1.5, 0.0]), np.zeros(7))
    for _ in range(4000):
        servo.turn(np.full(7, 10.0), 1e-3)
        assert (np.abs(servo.dq) <= arm.limits.velocity + 1e-9).all()
        assert (np.abs(servo.ddq) <= arm.limits.acceleration + 1e-9).all()
    assert (servo.q <= arm.limits.q_max).all()


@pytest.mark.parametrize(
    ("options", "told"),
    [
        ({"scenario": "prisma-cube"}, "has no arm"),
        ({"scenario": "waiters-round"}, "several legs"),
        ({"actions": "torques"}, 'actions is "torques"; it must be twist or joints'),
    ],
)
def test_what_cannot_be_is_told(options: dict[str, Any], told: str) -> None:
    with pytest.raises(ScenarioError, match=told):
        gym.Carry(**options)


@pytest.mark.parametrize("action", [[0.1, 0.0, 0.0], [[0.1, 0.0, 0.0, 0.0]], [np.nan, 0, 0, 0], "left", None])
def test_what_is_no_action_is_refused_and_moves_nothing(action: Any) -> None:
    env = gym.Carry("panda-cube")
    env.reset(seed=0)
    before = env.plant.q
    with pytest.raises(SalverError, match="it must be 4 finite numbers from -1 to 1"):
        env.step(action)
    assert np.array_equal(env.plant.q, before)


def test_a_load_at_no_known_place_is_lost() -> None:
    env = gym.Carry("panda-cube")
    env.reset(seed=0)
    i = env.plant.scene.qpos_ids[0]
    env.plant.data.qpos[i : i + 3] = np.nan
    assert env.plant.became(env.fallen) == ["lost"]


@pytest.mark.parametrize("parameters", [{"mass": "x"}, {"weight": 1.0}, 5])
def test_loads_that_cannot_be_are_told(parameters: Any) -> None:
    with pytest.raises(ScenarioError):
        gym.Carry("panda-cube").reset(options={"parameters": parameters})
