"""TeleopOperator: it does the task without a channel, is late by its reaction time, and its arm only absorbs."""

import gymnasium as gym
import numpy as np
import pytest

from safe_wrappers.envs.teleop_operator import REACTION_S, TeleopOperator
from safe_wrappers.errors import ConfigurationError


def episode(operator, seed=0, steps=6000):
    env = gym.make("TeleopContact-v0")
    observation, _ = env.reset(seed=seed)
    total, infos = 0.0, []
    for _ in range(steps):
        observation, reward, *_, info = env.step(operator.act(observation))
        total += reward
        infos.append(info)
    return total, infos, observation


def test_it_presses_sweeps_and_stops_before_the_clamp():
    total, infos, observation = episode(TeleopOperator(seed=0))
    assert infos[-1]["swept"] > 0.2 and 0.02 < infos[-1]["clearance"] < 0.05
    assert not any(info["cost"] or info["cost_force"] for info in infos)
    assert abs(infos[-1]["contact_force"] - observation[8]) < 0.5
    assert total > 5.0


def test_one_that_looks_away_does_not_stop():
    _, infos, _ = episode(TeleopOperator(seed=0, stops=False))
    assert any(info["cost"] for info in infos)


def test_it_sees_late_and_feels_at_once():
    operator = TeleopOperator(seed=0, reaction_s=0.2, tremor=0.0)
    free = np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.2, 10.0])
    for _ in range(500):
        operator.act(free)
    touching = free.copy()
    touching[6] = 5.0
    for k in range(201):
        assert operator.phase == "approach", k
        operator.act(touching)
    assert operator.phase == "press"
    operator.reset()
    assert operator.phase == "approach"
    held = free.copy()
    held[4] = 20.0
    assert operator.act(held)[0] < 0.0  # pushed back within one step


def test_the_arm_without_intentions_gives_out_no_energy():
    # Against any force: the work that the returned force does on the hand is stored in its mass or gone.
    operator = TeleopOperator(seed=0, approach_speed=0.0, tremor=0.0)
    rng = np.random.default_rng(0)
    seen = np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.2, 10.0])
    work = 0.0
    for k in range(3000):
        if k % 37 == 0:
            force = rng.uniform(-20, 20, 2)
        seen[4:6] = force
        before = np.array(operator._velocity)
        after = operator.act(seen)
        work += float(-force @ (before + after) / 2.0) * 0.001
        assert work >= 0.5 * 1.5 * float(after @ after) - 1e-6


def test_its_random_numbers_are_its_own():
    runs = [episode(TeleopOperator(seed=seed), steps=300)[2] for seed in (1, 1, 2)]
    assert np.array_equal(runs[0], runs[1]) and not np.array_equal(runs[0], runs[2])
    drawn = [TeleopOperator(seed).reaction_s for seed in range(30)]
    assert min(drawn) >= REACTION_S[0] and max(drawn) <= REACTION_S[1] and np.ptp(drawn) > 0.05


@pytest.mark.parametrize(
    "arguments", [{"mass": 0.0}, {"damping": -1.0}, {"step_s": np.nan}, {"reaction_s": -0.1}]
)
def test_what_cannot_be_is_refused(arguments):
    with pytest.raises(ConfigurationError):
        TeleopOperator(**arguments)
