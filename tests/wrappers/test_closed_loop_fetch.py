"""The filter around Fetch arms in closed loop, judged on the env's own positions after every physics substep."""

import gymnasium as gym
import numpy as np
import pytest

import safe_wrappers as sw

gym.register_envs(pytest.importorskip("gymnasium_robotics"))
from benchmarks.fetch import FetchJudge, drivers, obstacles  # noqa: E402 (the benchmark needs gymnasium_robotics)

pytestmark = [
    pytest.mark.filterwarnings("ignore::safe_wrappers.errors.UnsafeStateWarning"),
    pytest.mark.filterwarnings("error:.*declared reach"),
]


def fetch(env_id, steps=50):
    return gym.make(env_id, max_episode_steps=steps)


def drive(env, driver, steps, seed=0, ball=False):
    """Violations, flagged or not, and what the filter reported, over episodes judged at every substep."""
    judge, act = (
        FetchJudge(env.unwrapped, ball),
        drivers(ball)[driver](env.unwrapped, np.random.default_rng(seed)),
    )
    count = dict.fromkeys(("violations", "unflagged", "intervened", "infeasible", "unsafe"), 0)
    over, episode = True, seed
    for _ in range(steps):
        if over:
            env.reset(seed=episode)
            assert judge.start() <= 0.0
            episode += 1
        action = np.asarray(act(), dtype=np.float32)
        judge.before()
        *_, over, info = env.step(action)
        violated = not judge.after(action, info) <= 0.0
        count["violations"] += violated
        if "cbf/infeasible" in info:
            flagged = info["cbf/infeasible"] or info["cbf/fallback"] or info["cbf/unsafe"]
            count["unflagged"] += violated and not flagged
            for name in ("intervened", "infeasible", "unsafe"):
                count[name] += info[f"cbf/{name}"]
    return count


# Adversaries --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("env_id, driver", [
    ("FetchReach-v4", "table-seeking"),
    ("FetchReach-v4", "margin-reading"),
    ("FetchPush-v4", "corner-seeking"),
    ("FetchSlide-v4", "side-seeking"),
    ("FetchPickAndPlace-v4", "ball-seeking"),
])  # fmt: skip
def test_no_driver_gets_the_gripper_out_or_down(env_id, driver):
    bare = fetch(env_id, 100)
    env = sw.protect(bare, keep_out=obstacles(bare.unwrapped))
    count = drive(env, driver, 100, ball=True)
    assert count["violations"] == 0
    assert count["infeasible"] <= 1
    if driver != "margin-reading":
        assert drive(fetch(env_id, 100), driver, 100, ball=True)["violations"] > 20
        assert count["intervened"] > 20


# Tasks stay solvable ------------------------------------------------------------------------------------------


def go(observation, target, fingers=0.0, gain=10.0):
    return np.append(np.clip(gain * (target - observation["observation"][:3]), -1.0, 1.0), fingers)


def reach(observation, memory):
    return go(observation, observation["desired_goal"])


def push(observation, memory):
    """Behind the block, down, and straight on; again from above when it slips off."""
    gripper, block, goal = (
        observation["observation"][:3],
        observation["achieved_goal"],
        observation["desired_goal"],
    )
    left = float(np.linalg.norm((goal - block)[:2]))
    way = (goal - block)[:2] / max(left, 1e-6)
    if left < 0.015:
        return np.zeros(4)
    beside = gripper[:2] - block[:2]
    behind = np.append(block[:2] - 0.07 * way, 0.43)
    if not memory.get("down"):
        if np.linalg.norm(gripper[:2] - behind[:2]) > 0.02:
            return go(observation, np.append(behind[:2], 0.52))
        if gripper[2] > 0.45:
            return go(observation, behind)
    memory["down"] = abs(beside[0] * way[1] - beside[1] * way[0]) <= 0.03 and beside @ way <= 0.0
    return go(observation, np.append(block[:2] + way * min(0.02, left), 0.43), gain=8.0)


def pick(observation, memory):
    """Above the block, down with open fingers, close them, and off to the goal."""
    gripper, block, goal = (
        observation["observation"][:3],
        observation["achieved_goal"],
        observation["desired_goal"],
    )
    if "closing" not in memory:
        if np.linalg.norm((gripper - block)[:2]) > 0.008:
            return go(observation, np.append(block[:2], 0.53), 1.0)
        if gripper[2] > block[2] + 0.008:
            return go(observation, block, 1.0)
        memory["closing"] = 6
    if memory["closing"]:
        memory["closing"] -= 1
        return np.array([0.0, 0.0, 0.0, -1.0])
    return go(observation, goal + gripper - block, -1.0)


@pytest.mark.parametrize("env_id, policy, steps", [
    ("FetchReach-v4", reach, 20),
    ("FetchPush-v4", push, 60),
    ("FetchPickAndPlace-v4", pick, 40),
])  # fmt: skip
def test_a_task_is_solved_as_well_as_without_the_filter(env_id, policy, steps):
    solved = {False: 0, True: 0}
    for filtered in (False, True):
        env = sw.protect(fetch(env_id, steps)) if filtered else fetch(env_id, steps)
        for episode in range(4):
            observation, _ = env.reset(seed=episode)
            over, memory = False, {}
            while not over:
                observation, _, _, over, info = env.step(policy(observation, memory).astype(np.float32))
            solved[filtered] += int(info["is_success"])
    assert solved == {False: 4, True: 4}
