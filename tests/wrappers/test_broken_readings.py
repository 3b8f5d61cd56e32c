"""A state or an obstacle that is not a number: nothing passes in silence, and nothing non-finite reaches the env."""

import gymnasium as gym
import numpy as np
import pytest

import safe_wrappers as sw
from safe_wrappers.constraints.obstacles import Discs

pytestmark = pytest.mark.filterwarnings("ignore")

POINT = [sw.constraints.HeadingDriveClearance([Discs("hazard_positions", 0.2)], detour=True)]


class Given(gym.Wrapper):
    """Keeps what the env was given; the physics stands still, so that a broken state cannot crash it."""

    def step(self, action):
        self.given = np.array(action)
        return self.observation_space.sample(), 0.0, False, False, {}


class Published(gym.Wrapper):
    """Publishes hazards of our own."""

    hazards = np.array([[0.5, 0.0]])


def executed(filtered, action):
    info = filtered.step(np.array(action, np.float32))[4]
    given = filtered.env.given
    assert np.isfinite(given).all() and filtered.action_space.contains(given.astype(np.float32))
    assert info["cbf/fallback"] and info["cbf/unsafe"] and info["cbf/intervened"], info
    assert all(np.isfinite(v).all() for v in info.values())


@pytest.mark.parametrize("fallback", ["brake", "hold", "zero", lambda plant: [np.nan, np.inf]])
@pytest.mark.parametrize("broken", [np.nan, np.inf])
@pytest.mark.parametrize(
    ("env_id", "constraints"),
    [
        ("SafePointGoal1-v0", POINT),
        ("Reacher-v5", [sw.constraints.JointSpeedLimit(4.0)]),
        (
            "Reacher-v5",
            [sw.constraints.Clearance([sw.constraints.Plane([-1.0], [1.0])], 1.0, bodies=["fingertip"])],
        ),
    ],
)
def test_a_broken_state_runs_the_fallback(env_id, constraints, broken, fallback):
    filtered = sw.CBFActionFilter(Given(gym.make(env_id)), constraints, fallback=fallback)
    filtered.reset(seed=0)
    filtered.unwrapped.data.qpos[0] = filtered.unwrapped.data.qvel[0] = broken
    executed(filtered, [1.0, 1.0])


@pytest.mark.parametrize("kind", ["heading drive", "clearance"])
def test_a_broken_obstacle_runs_the_fallback(kind):
    discs = Discs("hazards", 0.2)
    limit = (
        sw.constraints.HeadingDriveClearance([discs])
        if kind == "heading drive"
        else sw.constraints.Clearance([discs], 1.0, bodies=["agent"])
    )
    env = Published(gym.make("SafePointGoal1-v0"))
    filtered = sw.CBFActionFilter(Given(env), [limit])
    filtered.reset(seed=0)
    env.hazards = np.array([[0.5, 0.0], [np.nan, 0.0]])
    executed(filtered, [1.0, 0.0])


def test_a_broken_state_is_not_hidden_by_the_prediction_over_a_delay():
    plant = sw.MujocoPlant(delay_s=0.02)
    filtered = sw.CBFActionFilter(
        Given(gym.make("Reacher-v5")), [sw.constraints.JointSpeedLimit(4.0)], plant=plant
    )
    filtered.reset(seed=0)
    filtered.step(np.zeros(2, np.float32))
    filtered.unwrapped.data.qvel[0] = np.nan
    executed(filtered, [1.0, 1.0])
