import gymnasium as gym
import pytest

from safe_wrappers.envs import POINT_GOAL_IDS, register_envs

if not all(env_id in gym.registry for env_id in POINT_GOAL_IDS):
    register_envs()


@pytest.fixture(params=POINT_GOAL_IDS)
def env(request):
    """Each level in turn, with Gymnasium's usual wrappers."""
    env = gym.make(request.param)
    yield env
    env.close()


@pytest.fixture
def make_env():
    """A function (level) -> the bare env; closes what it made."""
    made = []

    def make(level):
        made.append(gym.make(POINT_GOAL_IDS[level]).unwrapped)
        return made[-1]

    yield make
    for env in made:
        env.close()
