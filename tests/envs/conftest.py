import gymnasium as gym
import pytest

from safe_wrappers.envs import register_envs

POINT_GOAL_IDS, CAR_GOAL_IDS = (
    tuple(f"Safe{robot}Goal{level}-v0" for level in range(3)) for robot in ("Point", "Car")
)

if not all(env_id in gym.registry for env_id in POINT_GOAL_IDS + CAR_GOAL_IDS):
    register_envs()


@pytest.fixture(params=POINT_GOAL_IDS + CAR_GOAL_IDS)
def env(request):
    """Each robot and level in turn, with Gymnasium's usual wrappers."""
    env = gym.make(request.param)
    yield env
    env.close()


@pytest.fixture
def make_env():
    """A function (level) -> the bare env with the point; closes what it made."""
    yield from _maker(POINT_GOAL_IDS)


@pytest.fixture
def make_car():
    """A function (level) -> the bare env with the car; closes what it made."""
    yield from _maker(CAR_GOAL_IDS)


def _maker(ids):
    made = []

    def make(level):
        made.append(gym.make(ids[level]).unwrapped)
        return made[-1]

    yield make
    for env in made:
        env.close()
