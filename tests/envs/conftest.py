import gymnasium as gym
import pytest

from safe_wrappers.envs import register_envs

register_envs()


@pytest.fixture
def make_env():
    """A function (robot, level) -> a goal task's bare env; closes what it made."""
    made = []

    def make(robot, level):
        made.append(gym.make(f"Safe{robot}Goal{level}-v0").unwrapped)
        return made[-1]

    yield make
    for env in made:
        env.close()
