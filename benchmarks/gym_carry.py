"""salver/Carry-v0 evaluated: policies without and with the shield, and salver's own plan, on the same drawn loads.

    python benchmarks/gym_carry.py -n 10 --scenario panda-tall-bottle

random: a new random twist every 0.2 s. straight: as fast as the actions allow towards the goal, which any beginner
writes. plan: `sv.plan`, run in the engine.
"""

from __future__ import annotations

import argparse
import time
from collections import Counter
from collections.abc import Callable

import gymnasium
import numpy as np

import salver as sv
import salver.gym  # registers it

Policy = Callable[[int, np.ndarray], np.ndarray]


def random(env: gymnasium.Env, seed: int) -> Policy:
    rng, held = np.random.default_rng(seed), {}
    return lambda k, seen: held.setdefault(k // 10, rng.uniform(-1.0, 1.0, env.action_space.shape))


def straight(env: gymnasium.Env, seed: int) -> Policy:
    where = env.unwrapped.parts["to_goal"]

    def act(k: int, seen: np.ndarray) -> np.ndarray:
        away = seen[where]
        return np.append(away * min(4.0, 1.0 / max(float(np.linalg.norm(away)), 1e-6)), 0.0)  # 4/s near the goal

    return act


def episode(env: gymnasium.Env, policy: Policy, seed: int) -> tuple[str, float, float]:
    """What became of it, s of the world, and return."""
    seen, told = env.reset(seed=seed)
    total, k, over = 0.0, 0, False
    while not over:
        seen, reward, ended, late, told = env.step(np.asarray(policy(k, seen), np.float32))
        total, k, over = total + reward, k + 1, ended or late
    became = next((word for word in told["became"].values() if word), "arrived" if told["arrived"] else "kept")
    return became, told["t"], total


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-n", type=int, default=10, help="episodes of each")
    parser.add_argument("--scenario", default="panda-tall-bottle")
    parser.add_argument("--seconds", type=float, default=5.0, help="of an episode at most")
    given = parser.parse_args()
    print(f"{given.scenario}, {given.n} loads, at most {given.seconds:g} s each")
    print(f"{'policy':<10}{'shield':<8}{'arrived':>8}{'kept':>6}{'lost':>6}{'s':>7}{'return':>8}{'wall s':>8}")
    for name, make in (("random", random), ("straight", straight)):
        for shield in (False, True):
            began = time.perf_counter()
            steps = round(given.seconds / salver.gym.STEP)
            env = gymnasium.make("salver/Carry-v0", steps, scenario=given.scenario, shield=shield)
            runs = [episode(env, make(env, seed), seed) for seed in range(given.n)]
            row(name, "on" if shield else "off", runs, began)
    began, plan = time.perf_counter(), sv.plan(given.scenario, "fastest")
    runs = []
    for seed in range(given.n):
        record = sv.simulate(plan, parameters=env.reset(seed=seed)[1]["parameters"])
        kept = record.outcome in ("holds", "limit")
        runs.append(("arrived" if kept else "lost", plan.reference.duration, np.nan))
    row("plan", "", runs, began)


def row(name: str, shield: str, runs: list[tuple[str, float, float]], began: float) -> None:
    count = Counter(became for became, _, _ in runs)
    lost = len(runs) - count["arrived"] - count["kept"]
    took = [t for became, t, _ in runs if became == "arrived"]
    s = f"{np.mean(took):.2f}" if took else "-"
    total = f"{np.mean([total for _, _, total in runs]):.2f}" if shield else "-"
    wall = time.perf_counter() - began
    print(f"{name:<10}{shield:<8}{count['arrived']:>8}{count['kept']:>6}{lost:>6}{s:>7}{total:>8}{wall:>8.0f}")


if __name__ == "__main__":
    main()
