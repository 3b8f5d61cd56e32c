"""Coasting: a held control and then none until rest, against the env itself."""

import gymnasium as gym
import mujoco
import numpy as np
import pytest

import safe_wrappers as sw
from safe_wrappers.plants.mujoco.coasting import Coasting

RADIUS = 0.22


def car(level, alone=True, model=None, **layout):
    """An env with a car in motion, its plant and its coasting."""
    env = gym.make(f"SafeCarGoal{level}-v0").unwrapped
    env.reset(seed=1, options={"layout": {"agent": [0.0, 0.0, 0.4], "goal": [9.0, 9.0], **layout}})
    plant = sw.MujocoPlant(model=model)
    plant.bind(env)
    return env, plant, Coasting(plant, "agent", env.robot_model if alone else None)


def gather_speed(env, plant, steps, seed=0):
    """Drive with changing torques; the vases stand far away."""
    rng = np.random.default_rng(seed)
    for t in range(steps):
        if t % 8 == 0:
            action = rng.choice([-1.0, 0.3, 1.0], 2)
        env.step(action)
    plant.observe()


@pytest.mark.parametrize("level", [0, 1])
@pytest.mark.parametrize("seed", range(4))
def test_the_forecast_is_what_the_env_then_does(level, seed):
    far = {} if level == 0 else {"vases": [[8.0, 8.0]]}
    env, plant, coasting = car(level, **far)
    gather_speed(env, plant, 20 + 5 * seed, seed)
    control = np.random.default_rng(seed).uniform(-1.0, 1.0, 2)
    course = coasting.run(control, 12, RADIUS)
    assert course.rests
    env.data.ctrl[:] = control
    for k, (place, ahead) in enumerate(zip(course.places, course.ahead, strict=True)):
        if k == env.frame_skip:
            env.data.ctrl[:] = 0.0
        mujoco.mj_step(env.model, env.data)
        np.testing.assert_allclose(place, env.agent_position, rtol=0, atol=2e-4)
        # The heading is along the body's -y axis: a quarter turn from x.
        across = [-np.sin(env.agent_heading), np.cos(env.agent_heading)]
        np.testing.assert_allclose(ahead, across, rtol=0, atol=2e-3)


def test_rest_is_rest():
    """What is left of the way after the course has ended is under a millimetre."""
    env, plant, coasting = car(0)
    for seed in range(6):
        gather_speed(env, plant, 30, seed)
        course = coasting.run(np.array([1.0, -1.0]) * (-1.0) ** seed, 15, RADIUS)
        long = coasting.run(np.array([1.0, -1.0]) * (-1.0) ** seed, 15, np.inf)  # never at rest
        assert course.rests and not long.rests
        k = len(course.places)
        np.testing.assert_array_equal(long.places[:k], course.places)
        assert np.linalg.norm(long.places[k:] - course.places[-1], axis=1).max(initial=0.0) < 1e-3


def test_the_machine_alone_takes_over_what_the_plant_has_wrong_on_purpose():
    env, plant, alone = car(1, vases=[[8.0, 8.0]])
    gather_speed(env, plant, 25)
    right = alone.run(np.ones(2), 12, RADIUS).places
    plant.perturb(mass=2.0, damping=0.5)
    plant.model.geom_friction[:, 0] *= 0.5
    plant.observe()
    wrong = Coasting(plant, "agent", env.robot_model).run(np.ones(2), 12, RADIUS).places
    k = min(len(right), len(wrong))
    assert np.abs(right[:k] - wrong[:k]).max() > 5e-3
    whole = Coasting(plant, "agent").run(np.ones(2), 12, RADIUS).places
    np.testing.assert_allclose(wrong, whole, rtol=0, atol=1e-5)
