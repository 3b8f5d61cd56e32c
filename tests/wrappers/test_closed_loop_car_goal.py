"""SafeCarGoal under protect and adversarial drivers: no violation at any physics substep, judged by the task.

The drivers are written here and not shared with the benchmark that reports the long runs.
"""

import copy
import math
import warnings

import gymnasium as gym
import numpy as np
import pytest

import safe_wrappers as sw

STEPS = 300


def steer(raw, target, strength=1.0):
    offset = np.asarray(target) - raw.agent_position
    bearing = math.remainder(math.atan2(offset[1], offset[0]) - raw.agent_heading, math.tau)
    return 0.02 * strength * np.clip([1.0 + 2.0 * bearing, 1.0 - 2.0 * bearing], -0.2, 1.0)


def obstacles(raw):
    return np.concatenate([raw.hazard_positions, raw.vase_positions])


class GoalSeeking:
    def __init__(self, rng):
        self.rng = rng

    def __call__(self, raw, k):
        return steer(raw, raw.goal_position)


class ObstacleSeeking(GoalSeeking):
    """At one of the nearest obstacles, or backwards into it."""

    def __call__(self, raw, k):
        if k % 60 == 0:
            self.pick, self.back = self.rng.integers(3), self.rng.random() < 0.4
        distance = np.linalg.norm(obstacles(raw) - raw.agent_position, axis=1)
        target = obstacles(raw)[np.argsort(distance)[min(self.pick, len(distance) - 1)]]
        if self.back:
            return -steer(raw, 2.0 * raw.agent_position - target)[::-1]
        return steer(raw, target)


class FullThrottle(GoalSeeking):
    """Top speed at an obstacle, then any kick of the wheels."""

    def __call__(self, raw, k):
        phase = k % 45
        if phase == 0:
            distance = np.linalg.norm(obstacles(raw) - raw.agent_position, axis=1)
            self.target = obstacles(raw)[np.argsort(distance)[self.rng.integers(3)]]
            self.run, self.kick = self.rng.integers(15, 45), self.rng.choice([-1.0, 0.0, 1.0], 2)
        return 50.0 * steer(raw, self.target) if phase < self.run else self.kick


DRIVERS = [GoalSeeking, ObstacleSeeking, FullThrottle]


def drive(env, driver, steps=STEPS, seed=0):
    """Totals over `steps` steps in episodes of at most 150; every layout is another one."""
    total = dict.fromkeys(("cost_substep", "infeasible", "fallback", "unsafe", "intervened", "reward"), 0.0)
    total["margin"] = math.inf
    rng = np.random.default_rng([seed, len(driver.__name__)])
    act = driver(rng)
    for k in range(steps):
        if k % 150 == 0:
            env.reset(seed=int(rng.integers(2**31)))
        action = np.asarray(np.clip(act(env.unwrapped, k), -1.0, 1.0), np.float32)
        _, reward, _, _, info = env.step(action)
        total["reward"] += reward
        total["cost_substep"] += info["cost_substep"]
        total["margin"] = min(total["margin"], info.get("cbf/margin", 0.0))
        for key in ("infeasible", "fallback", "unsafe", "intervened"):
            total[key] += info.get(f"cbf/{key}", False)
    return total


@pytest.mark.parametrize("level", [1, 2])
@pytest.mark.parametrize("driver", DRIVERS)
def test_no_violation_at_any_substep(driver, level):
    with warnings.catch_warnings(action="error"):  # nothing unsafe, and no reach broken
        total = drive(sw.protect(gym.make(f"SafeCarGoal{level}-v0")), driver, seed=level)
    assert total["cost_substep"] == total["infeasible"] == total["fallback"] == total["unsafe"] == 0, total
    assert total["intervened"] > 0
    assert total["margin"] > 0.003  # of the 5 mm


@pytest.mark.parametrize("driver", DRIVERS)
def test_the_drivers_do_violate_without_the_filter(driver):
    assert drive(gym.make("SafeCarGoal2-v0"), driver, 600)["cost_substep"] > 20


def head_on(env, hazard=1.5):
    """Drive from rest straight into a hazard at full torque; steps in violation."""
    layout = {"agent": [0.0, 0.0, 0.0], "goal": [9.0, 9.0], "hazards": [[hazard, 0.0]], "vases": []}
    env.reset(seed=0, options={"layout": layout})
    violations = 0
    with warnings.catch_warnings(action="ignore"):
        for _ in range(120):
            violations += int(env.step(np.array([1.0, 1.0], np.float32))[4]["cost_substep"])
    return violations


@pytest.mark.parametrize("known", [True, False])
def test_a_mispredicted_stop_violates(known):
    """On ice the car takes longer to stop than a filter believes that goes on with the dry model."""
    raw = gym.make("SafeCarGoal1-v0")
    plant = sw.MujocoPlant(model=None if known else copy.copy(raw.unwrapped.model))
    env = sw.CBFActionFilter(
        raw, sw.protect(gym.make("SafeCarGoal1-v0"), detour=False).constraints, plant=plant
    )
    raw.unwrapped.model.geom_friction[:, 0] *= 0.25
    assert (head_on(env) == 0) == known


def test_the_goal_is_still_reached():
    kept = drive(sw.protect(gym.make("SafeCarGoal1-v0")), GoalSeeking, 600, seed=5)
    free = drive(gym.make("SafeCarGoal1-v0"), GoalSeeking, 600, seed=5)
    assert kept["cost_substep"] == 0 < free["cost_substep"]
    assert kept["reward"] > 0.35 * free["reward"], (kept["reward"], free["reward"])
