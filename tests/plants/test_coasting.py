"""Coasting: a held control and then none until rest, against the env itself."""

import gymnasium as gym
import mujoco
import numpy as np
import pytest
from asking import bound

from safe_wrappers.errors import ConfigurationError, UnsupportedEnvError
from safe_wrappers.plants.mujoco.coasting import Coasting

RADIUS = 0.22


def car(level, steps, seed=0):
    """An env with a car that has been driven with changing torques, vases far away, and its plant."""
    env = gym.make(f"SafeCarGoal{level}-v0").unwrapped
    layout = {"agent": [0.0, 0.0, 0.4], "goal": [9.0, 9.0], **({"vases": [[8.0, 8.0]]} if level else {})}
    env.reset(seed=1, options={"layout": layout})
    plant, rng = bound(env), np.random.default_rng(seed)
    for t in range(steps):
        if t % 8 == 0:
            action = rng.choice([-1.0, 0.3, 1.0], 2)
        env.step(action)
    plant.observe()
    return env, plant


@pytest.mark.parametrize("level", [0, 1])
@pytest.mark.parametrize("seed", range(4))
def test_the_forecast_is_what_the_env_then_does_to_its_rest(level, seed):
    env, plant = car(level, 20 + 5 * seed, seed)
    control = np.random.default_rng(seed).uniform(-1.0, 1.0, 2)
    coasting = Coasting(plant, "agent", env.robot_model)
    course, long = (coasting.run(control, 15, radius) for radius in (RADIUS, np.inf))
    assert course.rests and not long.rests  # no speed is small enough of what is infinitely far
    np.testing.assert_array_equal(long.places[: len(course.places)], course.places)
    start = coasting.start()
    np.testing.assert_allclose(start.places, [env.agent_position], atol=1e-12)
    env.data.ctrl[:] = control
    for k, (place, ahead) in enumerate(zip(long.places, long.ahead, strict=True)):
        if k == env.frame_skip:
            env.data.ctrl[:] = 0.0
        mujoco.mj_step(env.model, env.data)
        if k < len(course.places):
            np.testing.assert_allclose(place, env.agent_position, rtol=0, atol=2e-4)
            # The heading is along the body's -y axis: a quarter turn from x.
            across = [-np.sin(env.agent_heading), np.cos(env.agent_heading)]
            np.testing.assert_allclose(ahead, across, rtol=0, atol=2e-3)
        else:  # what is left of the way at rest is under a millimetre
            assert np.linalg.norm(env.agent_position - course.places[-1]) < 1e-3


def test_a_car_that_stands_for_an_instant_while_it_reverses_does_not_rest():
    """It tips back and rolls on by 4 mm; a state that an attacker found."""
    env, plant = car(0, 0)
    tilted, wheels = [-0.9594, 0.0017, -0.0012, -0.2821], [333.0, 195.8]
    caster = [-0.9104, -0.142, 0.2321, 0.3116]
    body = [0.0731, -0.0907, -0.0261, -0.2886, 0.5017, -0.2943]
    env.set_state(
        np.array([0.0, 0.0, 0.0995, *tilted, *wheels, *caster]),
        np.array([*body, 1.312, 8.8369, 2.4305, 0.3726, -1.078]),
    )
    plant.observe()
    runs = [Coasting(plant, "agent").run(np.array([-0.01, -0.02]), 15, radius) for radius in (RADIUS, np.inf)]
    course, long = (run.places for run in runs)
    assert runs[0].rests and np.linalg.norm(long[len(course) :] - course[-1], axis=1).max() < 1e-3


def test_the_machine_alone_takes_over_what_the_plant_has_wrong_on_purpose():
    env, plant = car(1, 25)
    right = Coasting(plant, "agent", env.robot_model).run(np.ones(2), 12, RADIUS).places
    plant.perturb(mass=2.0, damping=0.5)
    plant.model.geom_friction[:, 0] *= 0.5
    plant.observe()
    wrong, whole = (
        Coasting(plant, "agent", alone).run(np.ones(2), 12, RADIUS).places
        for alone in (env.robot_model, None)
    )
    k = min(len(right), len(wrong))
    assert np.abs(right[:k] - wrong[:k]).max() > 5e-3
    np.testing.assert_allclose(wrong, whole, rtol=0, atol=1e-5)


def test_another_machine_is_refused():
    env, plant = car(0, 0)
    with pytest.raises(UnsupportedEnvError, match=r"body 'goal' must move freely \(a free joint\)"):
        Coasting(plant, "goal")
    alone = env.robot_model
    alone.opt.timestep *= 2.0
    with pytest.raises(ConfigurationError, match=r"physics steps of 0.004 s, it has 0.008 s"):
        Coasting(plant, "agent", alone)
