"""A constraint on a plant at the edges of its contract: outside, inside the margin, far away, and without numbers."""

import warnings
from dataclasses import dataclass

import gymnasium as gym
import gymnasium_robotics  # noqa: F401 - its envs
import numpy as np
import pytest

import safe_wrappers as sw
from safe_wrappers.errors import ConfigurationError
from safe_wrappers.filter.engine import SafetyFilter
from safe_wrappers.plants.displacement import DisplacementPlant
from safe_wrappers.plants.plant import Model, Trajectory


class Rail(gym.Env):
    """Its place is set by hand; nothing is there where it is None."""

    dt, x = 0.1, 0.0
    action_space = gym.spaces.Box(-2.0, 2.0, (2,), np.float64)
    observation_space = gym.spaces.Box(-1.0, 1.0, (1,), np.float64)


@dataclass
class Shifted(sw.Constraint, Model):
    """h is the place, and 0.4 farther; two controls shift it by themselves: one on the way, the other at the end."""

    margin: float = 0.0
    horizon: int = 3
    max_decrease: float | None = None
    backup: tuple[float, float] | None = None
    most: float | None = None
    """Of the first control, by a row."""
    instants: int = 2
    recovery_s: float = 0.3

    @property
    def rows_decide(self):
        return self.most is not None

    def rows(self):
        return None if self.most is None else sw.HalfSpaces(np.array([[1.0, 0.0]]), np.array([self.most]))

    def rollout(self, control, horizon=1):
        shifts = np.zeros((1, 1)) if control is None else control[: self.instants, None]
        return Trajectory(control, self.plant.state + shifts)

    def h_along(self, path):
        return path.states[:, :0] if (path.states > 100.0).any() else path.states + np.array([0.0, 0.4])

    def proposals(self, control):
        return [] if control is not None or self.backup is None else [np.array(self.backup)]


def filtered(x, **options):
    """A filter at a place, and how it gets to another one."""
    env, plant = Rail(), sw.AnalyticPlant(lambda x: 0.0 * x, lambda x: np.ones((1, 2)), lambda env: [env.x])
    plant.bind(env)
    safety = SafetyFilter(plant, [Shifted(**options)], "zero", *np.outer([-2.0, 2.0], np.ones(2)))

    def go(x):
        env.x = 999.0 if x is None else x
        safety.observe()
        safety.executed(np.zeros(2))

    env.x = 999.0 if x is None else x
    safety.start()
    return safety, go


WORSE, BETTER = {"backup": (-0.3, 0.2)}, {"backup": (0.5, 0.9)}
LOSES_IT = {"margin": 0.5, "backup": (-0.3, -0.3)}


@pytest.mark.parametrize(
    ("x", "options", "control", "admitted"),
    [
        (0.2, {}, (-0.19, -0.19), True),
        (0.2, {}, (-0.21, 0.5), False),
        (0.2, {}, (0.5, -0.21), False),
        (0.2, {"margin": 0.1}, (-0.11, 0.0), False),
        (0.2, {"most": 0.4}, (0.39, 0.0), True),  # rows decide too
        (0.2, {"most": 0.4}, (0.41, 0.0), False),
        (0.2, {"most": 0.4}, (0.0, -0.21), False),
        (None, {}, (-2.0, -2.0), True),  # nothing is near
        # From outside: no farther out, and at the end back but for exp(-1).
        (-1.0, {}, (0.0, 0.64), True),
        (-1.0, {}, (0.0, 0.62), False),
        (-1.0, {}, (-0.01, 0.7), False),
        # As far as the backup does; a better one asks for no more.
        (-1.0, WORSE, (-0.29, 0.21), True),
        (-1.0, WORSE, (-0.31, 0.21), False),
        (-1.0, WORSE, (-0.29, 0.19), False),
        (-1.0, BETTER, (0.0, 0.64), True),
        (-1.0, BETTER, (-0.01, 0.64), False),
        # A limit that is kept now is not lost, whatever the backup does.
        (0.2, LOSES_IT, (-0.19, -0.19), True),
        (0.2, LOSES_IT, (-0.21, 0.0), False),
        (0.2, LOSES_IT, (0.0, -0.21), False),
        # So far inside that nothing is forecast.
        (1.0, {"max_decrease": 0.9}, (-2.0, -2.0), True),
        (1.0, {"max_decrease": 0.9, "margin": 0.2}, (-2.0, -2.0), False),
        (1.0, {"max_decrease": 1.1}, (-2.0, -2.0), False),
    ],
)
def test_what_is_admitted(x, options, control, admitted):
    assert filtered(x, **options)[0].admits(np.array(control)) == admitted


@pytest.mark.parametrize(
    ("x", "options", "shift", "keeps"),
    [
        (0.2, {}, 0.0, True),
        (0.2, {}, 0.1, True),
        (0.2, {}, -0.05, False),
        (0.6, {}, -0.2, False),
        (-0.1, {}, 0.2, False),
        (0.2, {"recovery_s": 0.0}, 0.1, False),
        (0.2, {"most": 1.0}, 0.1, False),
    ],
)
def test_inside_the_margin_a_refused_control_may_keep_the_limit_and_lose_nothing(x, options, shift, keeps):
    bound = filtered(x, margin=0.5, **options)[0].bound[0]
    assert bound.keeps_limit(np.full(2, shift)) == keeps


@pytest.mark.parametrize("max_decrease", [None, 0.1])
def test_a_state_that_is_not_a_number_admits_nothing(max_decrease):
    safety, go = filtered(0.5, max_decrease=max_decrease)
    assert safety.admits(np.zeros(2))
    go(np.nan)
    assert not safety.admits(np.zeros(2))


def test_no_instant_is_an_error():
    with pytest.raises(ConfigurationError, match="at least one instant"):
        filtered(0.5, instants=0)


def test_a_model_need_not_count_its_intervals():
    decision = filtered(0.2)[0].filter(np.array([0.5, -0.5]))  # horizon=3 of one interval
    np.testing.assert_allclose(decision.control, [0.5, -0.2], atol=1e-2)
    assert decision.changed and not decision.infeasible


def test_a_max_decrease_is_checked_within_the_horizon_and_stays_broken():
    safety, go = filtered(None, max_decrease=0.5)  # nothing near at first breaks nothing
    with warnings.catch_warnings(action="error"):
        for x in (1.7, 1.6, 1.5, 1.4, 1.3, 1.2, 1.1, 1.0, 1.1):
            go(x)
    with pytest.warns(
        UserWarning, match="fell by 0.6 units of h within 3 .* farther than the declared max_decrease"
    ):
        go(0.5)
    with warnings.catch_warnings(action="error"):
        go(2.0)
        go(0.1)
    assert safety.bound[0].max_decrease is None


def test_slopes_are_kept_for_some_steps_and_who_looks_on_changes_nothing(monkeypatch):
    rng, made, sketch = np.random.default_rng(3), [], DisplacementPlant.sketch
    monkeypatch.setattr(DisplacementPlant, "sketch", lambda *asked: made.append(asked) or sketch(*asked))
    pushes = np.clip([1.0, 0.3, -1.0, 0.0] + 0.3 * rng.normal(size=(25, 4)), -1.0, 1.0).astype(np.float32)
    executed = []
    for watched in (False, True):
        env = sw.protect(gym.make("FetchReach-v4"))
        env = sw.FilterObservation(env) if watched else env
        env.reset(seed=0)
        executed.append([env.step(push)[4]["executed_action"] for push in pushes])
    np.testing.assert_array_equal(*executed)
    assert 80 < len(made) < 150  # in two episodes; a fifth of what they were if each step had its own


@pytest.mark.parametrize("fingers", [0.0, 0.5])
def test_a_step_of_a_blocked_gripper_is_compared_whatever_the_fingers_were_told(fingers):
    env = sw.protect(gym.make("FetchReach-v4"))
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
    pendulum = gym.make("Pendulum-v1")
    slow = sw.constraints.PredictiveShield(lambda x: 8.0 - abs(x[2]), horizon=3, backup="zero")
    env = sw.FilterObservation(pendulum, [slow], sw.SimulatorPlant(control_dt=0.05, check_steps=0))
    assert env.reset(seed=0)[0].size > pendulum.observation_space.shape[0]
    assert np.isfinite(env.step(np.zeros(1, np.float32))[0]).all()
