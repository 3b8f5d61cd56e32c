"""The examples for envs without MuJoCo: what they promise holds in closed loop, against hostile drivers."""

import doctest
import runpy
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest

import safe_wrappers as sw

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


def of_page(page):
    return PAGES["run"](page, until="plant")


def of_docstring():
    names = {}
    for example in doctest.DocTestParser().get_examples(sw.AnalyticPlant.__doc__):
        exec(example.source, names)
    return names


SOURCES = {
    "quickstart": lambda: of_page("quickstart.md"),
    "AnalyticPlant": of_docstring,
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
    filtered = SOURCES["quickstart"]()["env"]
    free = gym.make(filtered.unwrapped.spec.id, **filtered.unwrapped.spec.kwargs)
    violated = 0
    for seed in range(5):
        speeds, flagged = drive(filtered, driver, seed)
        assert (speeds.max(), flagged) <= (LIMIT, 0) and len(speeds) == 200
        violated += (drive(free, driver, seed)[0] > LIMIT).sum()
    assert violated > 200  # of 1,000 without the filter


@pytest.mark.parametrize("source", SOURCES)
def test_it_is_the_same_example_everywhere(source):
    shown, first = SOURCES[source](), SOURCES["quickstart"]()
    assert shown["env"].unwrapped.spec.kwargs == first["env"].unwrapped.spec.kwargs
    rng = np.random.default_rng(0)
    for x in rng.uniform(-3.0, 3.0, (20, 2)):
        assert shown["slow"].h(x) == first["slow"].h(x)
        np.testing.assert_array_equal(shown["plant"].drift(x), first["plant"].drift(x))
        np.testing.assert_array_equal(shown["plant"].effect(x), first["plant"].effect(x))
        # And it is this pendulum's: its env makes the step that the plant predicts.
        env = first["env"].unwrapped
        env.reset(seed=0)
        env.state, u = x.copy(), rng.uniform(-2.0, 2.0, 1)
        env.step(u)
        assert env.state[1] == pytest.approx(
            x[1] + 0.05 * (first["plant"].drift(x)[1] + 3.0 * u[0]), abs=1e-9
        )


@pytest.mark.parametrize("driver", ["bang-bang", "faster"])
def test_the_readmes_limit_holds_by_simulation(driver):
    filtered = PAGES["run"]("../README.md", until="slow")["env"]
    free, violated = gym.make("Pendulum-v1"), 0
    for seed in range(2):
        speeds, flagged = drive(filtered, driver, seed)
        assert (speeds.max(), flagged) <= (6.0, 0) and len(speeds) == 200
        violated += (drive(free, driver, seed)[0] > 6.0).sum()
    assert violated > 20
