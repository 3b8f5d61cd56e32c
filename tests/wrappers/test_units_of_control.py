"""The unit of the control is the user's choice: in N or in MN the filtered machine does the same."""

import functools
from types import SimpleNamespace

import gymnasium as gym
import numpy as np
import pytest

import safe_wrappers as sw
from safe_wrappers.constraints.rollout import BoundRollout, RolloutMemory


class Sled(gym.Env):
    """x'' = u / unit in the plane, exact; the action space is the box of `unit` on both axes."""

    observation_space = gym.spaces.Box(-np.inf, np.inf, (4,), np.float64)
    dt = 0.05

    def __init__(self, unit):
        self.unit = unit
        self.action_space = gym.spaces.Box(-unit, unit, (2,), np.float64)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.state = np.zeros(4)
        return self.state.copy(), {}

    def step(self, action):
        x, v, a = self.state[:2], self.state[2:], np.asarray(action) / self.unit
        self.state = np.concatenate([x + v * self.dt + 0.5 * a * self.dt**2, v + a * self.dt])
        return self.state.copy(), 0.0, False, False, {}


def sled_plant(unit):
    return sw.AnalyticPlant(
        f=lambda x: np.array([x[2], x[3], 0.0, 0.0]),
        g=lambda x: np.vstack([np.zeros((2, 2)), np.eye(2) / unit]),
        state=lambda env: env.state,
        control_dt=Sled.dt,
    )


def corner():
    """A wedge of two oblique walls, and a third one behind: their rows meet at a corner that the policy heads for."""
    planes = [
        sw.constraints.Plane([0.6, 0.0], [-1.0, 0.1]),
        sw.constraints.Plane([0.0, 0.4], [-0.2, -1.0]),
        sw.constraints.Plane([-0.5, 0.0], [1.0, 0.0]),
    ]
    return sw.constraints.Clearance(planes, braking=0.5, position=[0, 1], velocity=[2, 3])


def speed():
    return sw.constraints.Barrier(lambda x: 0.09 - x[2] ** 2 - x[3] ** 2, alpha=5.0)


@functools.cache
def drive(unit, *constraints):
    """Positions, what was executed in shares of the box, and what the filter said, at every step."""
    env = sw.CBFActionFilter(Sled(unit), [build() for build in constraints], plant=sled_plant(unit))
    env.reset(seed=0)
    rng = np.random.default_rng(0)
    seen = []
    wanted = np.ones(2)
    for step in range(100):
        if step % 25 == 0:
            wanted = rng.uniform(-0.5, 1.5, 2)
        observation, _, _, _, info = env.step(np.clip(wanted, -1.0, 1.0) * unit)
        said = [info["cbf/margin"], info["cbf/intervened"], info["cbf/fallback"], info["cbf/infeasible"]]
        seen.append(np.concatenate([observation, info["executed_action"] / unit, said]))
    return np.array(seen)


@pytest.mark.parametrize("unit", [1e-7, 1e-4, 1e7])
@pytest.mark.parametrize("constraints", [(corner,), (corner, speed)], ids=["rows", "rows and a barrier"])
def test_the_unit_of_the_control_does_not_matter(unit, constraints):
    one, other = drive(1.0, *constraints), drive(unit, *constraints)
    margin, intervened, fallback = one[:, 6], one[:, 7], one[:, 8]
    assert intervened.mean() > 0.2 and not fallback.any() and margin.min() > -1e-9
    assert margin.min() < 0.01  # it did come to the walls
    np.testing.assert_allclose(other, one, atol=1e-6)


class Forecasting(BoundRollout):
    """What is left is linear in the control, in shares of its box."""

    def __init__(self, unit):
        self.unit_of_control = unit

    def now(self):
        return np.array([1.0])

    def room(self, forecast):
        return np.array([[0.3 - forecast @ np.array([1.0, 0.5]) / self.unit_of_control]])


@pytest.mark.parametrize("unit", [1e-7, 1e7])
def test_rows_of_a_forecast_keep_a_share_of_the_box_for_rounding(unit):
    def row(unit):
        plant = SimpleNamespace(
            has_acceleration=False,
            lower=-unit * np.ones(2),
            upper=unit * np.ones(2),
            control_dt=0.1,
            observation_id=0,
            braking=lambda: np.zeros(2),
            forecast=lambda control, horizon: control,
        )
        constraint = Forecasting(unit)
        constraint.spec, constraint.plant = SimpleNamespace(margin=0.0, horizon=1), plant
        constraint.max_decrease = None
        constraint.observe(RolloutMemory())
        rows = constraint.rows()
        return np.append(rows.normals[0] * unit, rows.offsets[0])

    np.testing.assert_allclose(row(unit), row(1.0), rtol=0.0, atol=1e-10)
    assert row(1.0)[2] < 0.3 - 1e-6
