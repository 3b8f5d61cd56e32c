"""JointSpeedLimit: adversarial closed loops judged at every physics substep on the env's own data."""

import gymnasium as gym
import mujoco
import numpy as np
import pytest
from asking import Asked, bound

import safe_wrappers as sw
from safe_wrappers.errors import ConfigurationError


class Judge:
    """Sees every mj_step of the env's own data, and keeps the largest speeds."""

    def __init__(self, monkeypatch, env, dofs):
        self.largest = np.zeros(len(dofs))
        self.substeps = 0
        real = mujoco.mj_step

        def watched(model, data, nstep=1):
            for _ in range(nstep):
                real(model, data)
                if data is env.unwrapped.data:
                    self.substeps += 1
                    self.largest = np.maximum(self.largest, np.abs(data.qvel[dofs]))

        monkeypatch.setattr(mujoco, "mj_step", watched)


def pump(env, k, rng):
    v = env.unwrapped.data.qvel[: env.action_space.shape[0]]
    return np.where(v >= 0.0, env.action_space.high, env.action_space.low)


def bang_bang(env, k, rng):
    return np.where(np.random.default_rng(k // 12).normal(size=env.action_space.shape) > 0, 1, -1) * (
        env.action_space.high
    )


def full(env, k, rng):
    return env.action_space.high


def opposed(env, k, rng):
    return env.action_space.high * np.resize([1.0, -1.0], env.action_space.shape)


def at_random(env, k, rng):
    return rng.uniform(env.action_space.low, env.action_space.high)


CASES = {"Reacher-v5": ([0, 1], 4.0, 400), "InvertedPendulum-v5": ([0], 0.5, 250)}


@pytest.mark.parametrize("driver", [pump, bang_bang, full, opposed, at_random], ids=lambda d: d.__name__)
@pytest.mark.parametrize("env_id", CASES)
def test_no_substep_is_too_fast(monkeypatch, env_id, driver):
    dofs, limit, steps = CASES[env_id]
    filtered = sw.CBFActionFilter(gym.make(env_id), [sw.constraints.JointSpeedLimit(limit)])
    judge = Judge(monkeypatch, filtered, dofs)
    rng = np.random.default_rng(0)
    intervened = infeasible = 0
    for seed in range(2):
        filtered.reset(seed=seed)
        for k in range(steps):
            # InvertedPendulum's episode ends when the pole falls; the cart's limit holds on
            info = filtered.step(driver(filtered, k, rng).astype(np.float32))[4]
            intervened += info["cbf/intervened"]
            infeasible += info["cbf/infeasible"]
    assert judge.substeps == 2 * steps * filtered.unwrapped.frame_skip
    assert intervened > 0
    if env_id == "Reacher-v5" or not infeasible:
        assert infeasible == 0
        assert (judge.largest <= limit + 1e-6).all(), judge.largest
    assert judge.largest.max() > 0.95 * limit  # and it is used to the full


def test_without_the_filter_it_is_too_fast(monkeypatch):
    env = gym.make("Reacher-v5")
    judge = Judge(monkeypatch, env, [0, 1])
    env.reset(seed=0)
    for k in range(100):
        env.step(pump(env, k, None).astype(np.float32))
    assert (judge.largest > 10.0).any()


def test_a_margin_is_kept_free_and_covers_a_wrong_mass(monkeypatch):
    env = gym.make("Reacher-v5")
    filtered = sw.CBFActionFilter(env, [sw.constraints.JointSpeedLimit(4.0, margin=0.5)])
    filtered.plant.perturb(mass=1.2, damping=0.8)
    judge = Judge(monkeypatch, filtered, [0, 1])
    rng = np.random.default_rng(0)
    filtered.reset(seed=0)
    for k in range(400):
        filtered.step(bang_bang(filtered, k, rng).astype(np.float32))
    assert (judge.largest <= 4.0).all()
    assert judge.largest.max() > 3.0


def test_each_joint_has_its_own_limit(monkeypatch):
    filtered = sw.CBFActionFilter(
        gym.make("Reacher-v5"), [sw.constraints.JointSpeedLimit([2.0, 6.0], joints=["joint1", "joint0"])]
    )
    judge = Judge(monkeypatch, filtered, [0, 1])
    filtered.reset(seed=0)
    for k in range(300):
        filtered.step(bang_bang(filtered, k, None).astype(np.float32))
    assert judge.largest[0] <= 6.0 + 1e-6 and judge.largest[1] <= 2.0 + 1e-6
    assert judge.largest[0] > 3.0 and judge.largest[1] > 1.8


def test_a_start_that_is_too_fast_slows_down():
    filtered = sw.CBFActionFilter(gym.make("Reacher-v5"), [sw.constraints.JointSpeedLimit(4.0)])
    filtered.reset(seed=0)
    raw = filtered.unwrapped
    raw.set_state(raw.data.qpos.copy(), np.array([9.0, -7.0, 0.0, 0.0]))
    speeds = [9.0]
    with pytest.warns(sw.UnsafeStateWarning):
        for _ in range(40):
            filtered.step(np.array([1.0, -1.0], np.float32))
            speeds.append(np.abs(raw.data.qvel[:2]).max())
    assert speeds[-1] <= 4.0 + 1e-6
    assert speeds[1] < speeds[0]


def test_value_and_rows_against_the_plants_own_prediction():
    env = gym.make("Reacher-v5")
    env.reset(seed=0)
    env.unwrapped.set_state(env.unwrapped.data.qpos.copy(), np.array([3.5, -3.0, 0.0, 0.0]))
    plant = bound(env)
    limit = sw.constraints.JointSpeedLimit(4.0, margin=0.1)
    limit = Asked(limit, plant)
    plant.observe()
    np.testing.assert_allclose(limit.value(), [0.5, 1.0])
    rows = limit.rows()
    drift, effect = plant.acceleration
    rng = np.random.default_rng(0)
    for u in rng.uniform(-1, 1, (50, 2)):
        after = plant.qvel[:2] + plant.control_dt * (drift + effect @ u)[:2]
        linear = bool((np.abs(after) <= 3.9).all())
        assert bool((rows.normals @ u <= rows.offsets).all()) == linear


def test_a_free_or_undriven_model_asks_for_names():
    filtered = sw.CBFActionFilter(gym.make("Ant-v5"), [sw.constraints.JointSpeedLimit(4.0)])
    filtered.reset(seed=0)
    assert len(filtered.filter.bound[0].value()) == 8  # the driven ones, not the free root
    with pytest.raises(ConfigurationError, match="joint 'root' is neither a hinge nor a slide"):
        sw.CBFActionFilter(gym.make("Ant-v5"), [sw.constraints.JointSpeedLimit(4.0, joints=["root"])])
    with pytest.raises(
        ConfigurationError, match=r"no actuator drives a hinge or slide directly: name the joints.*: x, y, z"
    ):
        filtered = sw.CBFActionFilter(site_driven(), [sw.constraints.JointSpeedLimit(4.0)])


def site_driven():
    """SafePointGoal's robot with its turning actuator turned into a second one at the site."""
    env = gym.make("SafePointGoal0-v0")
    m = env.unwrapped.model
    m.actuator_trntype[1], m.actuator_trnid[1] = m.actuator_trntype[0], m.actuator_trnid[0]
    return env


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"limit": 0.0}, "limit must be a finite number > 0 in rad/s or m/s, got 0.0"),
        ({"limit": -4.0}, "limit must be a finite number > 0 in rad/s or m/s, got -4.0"),
        ({"limit": np.inf}, "limit must be a finite number > 0"),
        ({"limit": [4.0, -1.0]}, "limit must be a finite number > 0 .* got -1.0"),
        ({"limit": "fast"}, "limit must be a number in rad/s or m/s"),
        ({"limit": []}, "limit is one number, or a list with one per joint"),
        ({"limit": 4.0, "margin": -0.1}, "margin must be a finite number >= 0 in rad/s or m/s, got -0.1"),
        ({"limit": 4.0, "margin": 4.0}, "the margin 4.0 leaves nothing of the limit 4.0"),
        (
            {"limit": 4.0, "joints": "joint0"},
            "joints is a list of names, or None for every driven joint; got 'joint0'",
        ),
        ({"limit": 4.0, "joints": []}, "joints is a list of names, or None"),
    ],
)
def test_constructor_refuses_nonsense(arguments, message):
    with pytest.raises(ConfigurationError, match=message):
        limit = sw.constraints.JointSpeedLimit(**arguments)
        sw.CBFActionFilter(gym.make("Reacher-v5"), [limit])


def test_as_many_limits_as_joints():
    with pytest.raises(ConfigurationError, match=r"expected one limit or 2, got \[1.0, 2.0, 3.0\]"):
        sw.CBFActionFilter(gym.make("Reacher-v5"), [sw.constraints.JointSpeedLimit([1.0, 2.0, 3.0])])


def test_at_the_limit_the_actions_rounding_is_not_called_unsafe():
    filtered = sw.CBFActionFilter(gym.make("Reacher-v5"), [sw.constraints.JointSpeedLimit(4.0)])
    filtered.reset(seed=0)
    infos = [filtered.step(full(filtered, k, None).astype(np.float32))[4] for k in range(400)]
    assert not any(i["cbf/unsafe"] for i in infos)
