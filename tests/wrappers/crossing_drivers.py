"""Drivers that try to be hit on the crossing, and what came of it."""

import gymnasium as gym
import numpy as np

import safe_wrappers as sw

CARS = [
    {
        "bodies": f"car[{names}]",
        "acceleration_noise": [0.0225, 0.0],
        "reversion_s": 2.0,
        "mean_velocity": [speed, 0.0],
        "start_position_std": [0.3, 0.0],
        "start_velocity_std": [0.15, 0.0],
    }
    for names, speed in (("012", 1.0), ("345", -1.0))
]
EYE = sw.occlusion.Sensor("eye", view_deg=120, range_m=6.0)


def crossing(cars="estimated", tolerance=0.5, **protect):
    """The task under the filter that the recipe makes; `cars` None: without a filter."""
    env = sw.OcclusionPenalty(gym.make("OccludedCrossing-v0"), CARS, EYE, tolerance)
    return env if cars is None else sw.protect(env, cars=cars, **protect)


class Random:
    """New controls at every step."""

    def __init__(self, raw, rng):
        self.raw, self.rng = raw, rng

    def __call__(self, k):
        return self.rng.uniform(-1.0, 1.0, 3)


class BangBang(Random):
    """Full controls, held for a while."""

    def __call__(self, k):
        if k == 0 or self.rng.random() < 0.06:
            self.held = self.rng.choice([-1.0, 1.0], 3)
        return self.held


class GoalSeeking(Random):
    """Fast and straight at the goal, blind to cars, looking where it drives."""

    def __call__(self, k):
        raw = self.raw
        way = raw.goal_position - raw.agent_position
        turn = np.arctan2(way[1], way[0]) - raw.agent_heading
        return np.clip([*(4.0 * way), 2.0 * np.sin(turn)], -1.0, 1.0)


class CarSeeking(Random):
    """Into the way of the nearest car."""

    def __call__(self, k):
        raw = self.raw
        ahead = raw.car_positions + 0.7 * raw.car_velocities
        way = ahead[np.linalg.norm(ahead - raw.agent_position, axis=1).argmin()] - raw.agent_position
        turn = np.arctan2(way[1], way[0]) - raw.agent_heading
        return np.clip([*(4.0 * way), 2.0 * np.sin(turn)], -1.0, 1.0)


class OnTheRoad(Random):
    """Waits in the middle of a lane."""

    def __call__(self, k):
        y = 0.8 if (k // 150) % 2 else -0.8
        x, now = self.raw.agent_position
        vx, vy = self.raw.agent_velocity
        return np.clip([-4.0 * x - 2.0 * vx, 6.0 * (y - now) - 2.0 * vy, 0.3], -1.0, 1.0)


DRIVERS = (Random, BangBang, GoalSeeking, CarSeeking, OnTheRoad)


def drive(env, driver, episodes, steps=500, seed=0, watch=None):
    """Counts over some episodes; a step is flagged where the filter says infeasible, fallback or unsafe."""
    raw, rng = env.unwrapped, np.random.default_rng(seed)
    told = dict.fromkeys(("steps", "collisions", "unflagged", "flagged", "changed", "goals"), 0)
    for _ in range(episodes):
        env.reset(seed=int(rng.integers(2**31)))
        act, flags = driver(raw, rng), [True] * 3  # a start may be unsafe
        for k in range(steps):
            action = act(k).astype(np.float32)
            info = env.step(action)[4]
            if watch is not None:
                watch(env, action, info)
            flag = any(info.get(f"cbf/{name}", False) for name in ("infeasible", "fallback", "unsafe"))
            flags = [*flags[-2:], flag]
            told["steps"] += 1
            told["flagged"] += flag
            told["changed"] += bool(info.get("cbf/intervened", False))
            told["collisions"] += info["collisions"]
            # What hits it was let come so near in the last steps.
            told["unflagged"] += bool(info["collisions"]) and not any(flags)
        told["goals"] += info["goals_reached"]
    return told
