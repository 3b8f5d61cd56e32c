"""What the filter makes of constraints at the edges of their contract."""

import warnings
from dataclasses import dataclass

import gymnasium as gym
import gymnasium_robotics  # noqa: F401 - its envs
import numpy as np
import pytest

import safe_wrappers as sw
from safe_wrappers.errors import ConfigurationError
from safe_wrappers.plants.plant import Model, Trajectory

PUSH = np.ones(2, np.float32)


def reacher(*constraints, **options):
    env = sw.CBFActionFilter(gym.make("Reacher-v5"), constraints, **options)
    env.reset(seed=0)
    return env


@dataclass
class Shaped(sw.Constraint):
    """As many columns now, and instants and columns along a trajectory, as is said."""

    now: int
    instants: int
    columns: int
    horizon: int = 3
    max_decrease: float | None = None

    def h_along(self, path):
        return np.ones((1, self.now) if path.control is None else (self.instants, self.columns))


def test_nothing_near_admits_everything_and_no_instant_is_an_error():
    assert not reacher(Shaped(0, 6, 0)).step(PUSH)[4]["cbf/intervened"]
    with pytest.raises(ConfigurationError, match="at least one instant"):
        reacher(Shaped(0, 0, 1))


@dataclass
class Counted(sw.Constraint, Model):
    """A model of one's own that does not count its control intervals."""

    horizon: int = 5

    def rollout(self, control, horizon=1):
        ahead = np.zeros(1) if control is None else control[0] * np.arange(1.0, 6.0)
        return Trajectory(control, ahead[:, None])

    def h_along(self, path):
        return 2.0 - np.abs(path.states)


def test_a_model_need_not_count_its_intervals():
    info = reacher(Counted()).step(PUSH)[4]
    assert info["cbf/intervened"] and not info["cbf/infeasible"]
    assert 0.35 < info["executed_action"][0] <= 0.4 + 1e-6


def test_a_state_that_is_not_a_number_admits_nothing():
    env = reacher(sw.constraints.JointSpeedLimit(limit=4.0))
    env.observe()
    assert env.filter.admits(np.zeros(2))
    env.unwrapped.data.qvel[0] = np.nan
    env.observe()
    assert not env.filter.admits(np.zeros(2))


def test_a_broken_max_decrease_stays_broken():
    env = reacher(sw.constraints.JointSpeedLimit(limit=4.0, max_decrease=0.01))
    with pytest.warns(UserWarning, match="farther than the declared max_decrease"):
        for _ in range(6):
            env.step(PUSH)
    with warnings.catch_warnings(action="error"):
        for _ in range(6):
            env.step(-PUSH)
    assert env.filter.bound[0].max_decrease is None


def test_nothing_near_at_first_breaks_no_max_decrease():
    env = reacher(Shaped(0, 6, 0, max_decrease=50.0))
    env.step(PUSH)
    env.filter.bound[0].spec.now = 1
    with warnings.catch_warnings(action="error"):
        env.step(PUSH)


def fetch(watched):
    env = sw.protect(gym.make("FetchReach-v4"))
    return sw.FilterObservation(env) if watched else env


def test_who_looks_on_changes_nothing_where_slopes_are_kept():
    rng = np.random.default_rng(3)
    pushes = np.clip([1.0, 0.3, -1.0, 0.0] + 0.3 * rng.normal(size=(25, 4)), -1.0, 1.0).astype(np.float32)
    executed = []
    for watched in (False, True):
        env = fetch(watched)
        env.reset(seed=0)
        executed.append([env.step(push)[4]["executed_action"] for push in pushes])
    np.testing.assert_array_equal(*executed)


@pytest.mark.parametrize("fingers", [0.0, 0.5])
def test_a_step_of_a_blocked_gripper_is_compared_whatever_the_fingers_were_told(fingers):
    env = fetch(watched=False)
    env.reset(seed=0)
    inner = env.unwrapped.step

    def disturbed(action):
        answer = inner(action)
        env.unwrapped.data.qpos[0] += 0.01
        return answer

    action = np.array([1.0, 0.3, -1.0, fingers], np.float32)
    assert not env.step(action)[4]["cbf/mismatch"]
    env.unwrapped.step = disturbed
    with pytest.warns(UserWarning, match="from its forecast"):
        assert env.step(action)[4]["cbf/mismatch"]


def test_features_without_a_filter_are_of_what_the_env_has_returned():
    shield = sw.constraints.PredictiveShield(lambda x: 0.2 - abs(x[2]), horizon=3, backup=[0, 1])
    plant = sw.SimulatorPlant(control_dt=0.02, check_steps=0)
    env = sw.ActionShield(gym.make("CartPole-v1"), [shield], plant=plant)
    assert env.reset(seed=0)[1]["cbf/margin"] > 0.0
    pendulum = gym.make("Pendulum-v1")
    slow = sw.constraints.PredictiveShield(lambda x: 8.0 - abs(x[2]), horizon=3, backup="zero")
    env = sw.FilterObservation(pendulum, [slow], sw.SimulatorPlant(control_dt=0.05, check_steps=0))
    assert env.reset(seed=0)[0].size > pendulum.observation_space.shape[0]
    assert np.isfinite(env.step(np.zeros(1, np.float32))[0]).all()
