"""The examples for envs without MuJoCo: what they promise holds in closed loop, against hostile drivers."""

import runpy
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest

PAGES = runpy.run_path(str(Path(__file__).parents[2] / "docs" / "pages.py"))
LIMIT = 2.0
DRIVERS = {
    "random": lambda rng, k, angle, speed: rng.uniform(-2.0, 2.0),
    "bang-bang": lambda rng, k, angle, speed: 2.0 if k // 7 % 2 else -2.0,
    "pulse": lambda rng, k, angle, speed: rng.choice([-2.0, 2.0]),
    "faster": lambda rng, k, angle, speed: np.copysign(2.0, speed),
    "one way": lambda rng, k, angle, speed: 2.0,
    "with gravity": lambda rng, k, angle, speed: np.copysign(2.0, np.sin(angle)),
}


def drive(env, driver, seed):
    """Speeds after every step of one episode, and how many of its steps were flagged."""
    env.reset(seed=seed)
    rng = np.random.default_rng(seed)
    speeds, flagged, truncated, k = [], 0, False, 0
    while not truncated:
        action = np.array([DRIVERS[driver](rng, k, *env.unwrapped.state)], np.float32)
        *_, truncated, info = env.step(action)
        speeds.append(abs(env.unwrapped.state[1]))
        flagged += bool(info.get("cbf/infeasible") or info.get("cbf/fallback"))
        k += 1
    return np.array(speeds), flagged


@pytest.mark.parametrize("driver", DRIVERS)
def test_the_limit_holds(driver):
    filtered = PAGES["run"]("quickstart.md", until="plant")["env"]
    free = gym.make(filtered.unwrapped.spec.id, **filtered.unwrapped.spec.kwargs)
    violated = 0
    for seed in range(5):
        speeds, flagged = drive(filtered, driver, seed)
        assert (speeds.max(), flagged) <= (LIMIT, 0) and len(speeds) == 200
        violated += (drive(free, driver, seed)[0] > LIMIT).sum()
    assert violated > 200  # of 1,000 without the filter


@pytest.mark.parametrize("driver", ["bang-bang", "faster"])
def test_the_readmes_limit_holds_by_simulation(driver):
    filtered = PAGES["run"]("../README.md", until="slow")["env"]
    free, violated = gym.make("Pendulum-v1"), 0
    for seed in range(2):
        speeds, flagged = drive(filtered, driver, seed)
        assert (speeds.max(), flagged) <= (6.0, 0) and len(speeds) == 200
        violated += (drive(free, driver, seed)[0] > 6.0).sum()
    assert violated > 20
