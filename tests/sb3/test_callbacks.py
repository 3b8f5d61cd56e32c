"""What a callback logs of filter, lease, handover and faults; and the price on cost, against its definition."""

from types import SimpleNamespace

import gymnasium as gym
import numpy as np
import pytest
from stable_baselines3 import PPO, SAC
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import configure
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecNormalize
from stable_baselines3.her.her_replay_buffer import HerReplayBuffer
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from test_replay_buffers import GoalLine

import safe_wrappers as sw
from safe_wrappers import info as keys
from safe_wrappers.errors import ConfigurationError
from safe_wrappers.sb3 import InterventionCallback, LagrangianMultiplier
from safe_wrappers.wrappers.faults import RepeatedCommands


class EveryFourthStep(gym.Wrapper):
    """Stands for a filter that corrects every fourth step by 0.5, in a task with cost 1 there."""

    def reset(self, *, seed=None, options=None):
        self.steps = 0
        return self.env.reset(seed=seed, options=options)

    def step(self, action):
        observation, reward, terminated, truncated, info = self.env.step(action)
        self.steps += 1
        hit = self.steps % 4 == 0
        info.update(dict.fromkeys(keys.CBF_BOOLS, False))
        info.update(dict.fromkeys(keys.CBF_FLOATS, 0.0))
        info[keys.CBF_INTERVENED] = hit
        info[keys.CBF_CORRECTION] = 0.5 * hit
        info[keys.COST] = info[keys.COST_SUBSTEP] = float(hit)
        return observation, reward, terminated, truncated, info


def corrected():
    return EveryFourthStep(gym.make("Pendulum-v1", max_episode_steps=16))


def cart():
    """Without a filter, in a task that reports no cost."""
    return gym.make("InvertedPendulum-v5", max_episode_steps=16)


def leased():
    rail = [sw.constraints.Plane([-0.9], [1]), sw.constraints.Plane([0.9], [-1])]
    clearance = sw.constraints.Clearance(rail, bodies=["cart"], braking=8.0)
    return sw.RecordInterventions(sw.LeaseExpiry(cart(), sw.StoppingBudget(clearance, acceleration=1.0)))


def logged(folder, env, steps=32):
    """Tag -> values, of what a PPO wrote about interventions."""
    model = PPO("MlpPolicy", env, n_steps=32, n_epochs=1, batch_size=32, device="cpu", seed=0)
    model.set_logger(configure(str(folder), ["tensorboard", "stdout"]))
    model.learn(steps, callback=InterventionCallback())
    events = EventAccumulator(str(folder))
    events.Reload()
    tags = [tag for tag in events.Tags()["scalars"] if tag.startswith("interventions/")]
    return {tag.removeprefix("interventions/"): [each.value for each in events.Scalars(tag)] for tag in tags}


STEPS = {"step_rate": 0.25, "step_correction": 0.125, "step_cost": 0.25}
EPISODES = {
    "rate": 0.25,
    "correction_mean": 0.125,
    "correction_p95": 0.5,
    "infeasible": 0.0,
    "cost": 4.0,
    "cost_substep": 4.0,
    "violations": 4.0,
}


@pytest.mark.parametrize("vec_env", [DummyVecEnv, SubprocVecEnv])
def test_rollouts_reach_tensorboard_and_stdout(tmp_path, vec_env, capsys):
    envs = vec_env([lambda: Monitor(sw.RecordInterventions(corrected()))] * 2)
    found = logged(tmp_path, envs, 128)
    envs.close()
    for tag, value in (STEPS | EPISODES).items():
        assert found[tag] == pytest.approx([value, value]), tag
    assert "| interventions/" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("make", "names"),
    [
        (lambda: sw.RecordInterventions(cart()), ()),
        (leased, ("lease_refused", "lease_braking", "step_lease_refused", "step_lease_braking")),
    ],
    ids=["bare", "leased"],
)
def test_layers_and_judges_that_are_not_there_log_no_zeros(tmp_path, make, names):
    assert set(logged(tmp_path, make())) == set(names)


def test_handover_lease_and_faults_reach_tensorboard(tmp_path):
    # The whole stack, whose policy is never heard at all.
    found = logged(tmp_path, RepeatedCommands(sw.ChunkHandover(leased(), 8, 4, rate_limit=10.0), share=1.0))
    assert found["step_fault"] == found["step_lease_braking"] == [1.0]
    assert found["step_starved"] == [4.0]  # all control steps of a chunk
    assert found["lease_braking"] == [16.0]
    for name in ("step_lease_refused", "step_peak_jerk", "step_limited"):
        assert np.isfinite(found[name]).all()


def test_a_step_without_a_judgement_does_not_hide_the_mean_of_the_others(tmp_path):
    logger, callback = configure(str(tmp_path), []), InterventionCallback()
    callback.model = SimpleNamespace(logger=logger, num_timesteps=3)
    callback.update_locals({"infos": [{keys.COST: cost} for cost in (0.5, keys.NOT_JUDGED, 1.0)]})
    callback.on_step()
    assert logger.name_to_value["interventions/step_cost"] == 0.75


# A price on cost --------------------------------------------------------------------------------------------------

LENGTH = 5


class Toll(gym.Env):
    """Reward 1 and some cost for an action above 0, nothing otherwise; episodes of five steps."""

    action_space = gym.spaces.Box(-1.0, 1.0, (1,), np.float32)
    observation_space = gym.spaces.Box(-1.0, 1.0, (1,), np.float32)

    def __init__(self, cost=2.0):
        self.cost, self.steps, self.made = cost, 0, []

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.steps = 0
        return np.zeros(1, np.float32), {}

    def step(self, action):
        self.steps += 1
        taken = float(action[0] > 0.0)
        info = {} if self.cost is None else {keys.COST: self.cost * taken}
        self.made.append((taken, info.get(keys.COST)))
        return np.zeros(1, np.float32), taken, False, self.steps == LENGTH, info


def expected(made, limit, rate, multiplier=0.0):
    """What is stored of each step, and the multiplier after the last one, from the definition."""
    stored, total = [], 0.0
    for step, (reward, cost) in enumerate(made, start=1):
        stored.append((reward - multiplier * cost) / (1.0 + multiplier))
        total += cost
        if step % LENGTH == 0:
            multiplier, total = max(0.0, multiplier + rate * (total - limit)), 0.0
    return stored, multiplier


class Stored(BaseCallback):
    """Of an on-policy learner: the rewards of all rollouts, before they are thrown away."""

    def __init__(self):
        super().__init__()
        self.rewards = []

    def _on_step(self):
        return True

    def _on_rollout_end(self):
        self.rewards += self.model.rollout_buffer.rewards[:, 0].tolist()


def ppo(env):
    """It stores rewards as they are: nothing is bootstrapped at a time limit."""
    return PPO("MlpPolicy", env, n_steps=20, batch_size=20, n_epochs=1, gamma=0.0, device="cpu", seed=0)


def sac(env, policy="MlpPolicy", **more):
    return SAC(policy, env, learning_starts=30, buffer_size=30, device="cpu", seed=0, **more)


def test_the_reward_less_the_price_of_cost_is_stored_and_the_price_follows_every_episode(tmp_path):
    task, stored = Toll(), Stored()
    model = ppo(Monitor(task))
    model.lagrangian_multiplier = 0.1
    model.learn(60, callback=[LagrangianMultiplier(cost_limit=3.0, rate=0.05), stored])
    rewards, multiplier = expected(task.made, 3.0, 0.05, 0.1)
    assert any(cost for _, cost in task.made) and len(stored.rewards) == 60
    np.testing.assert_allclose(stored.rewards, rewards, atol=1e-6)
    assert 0.1 != multiplier == pytest.approx(model.lagrangian_multiplier)
    # Monitor has the task's own returns.
    returns = [sum(reward for reward, _ in task.made[i : i + LENGTH]) for i in range(0, 60, LENGTH)]
    assert [episode["r"] for episode in model.ep_info_buffer] == returns

    # A saved model goes on with it.
    model.lagrangian_multiplier = 0.7
    model.save(tmp_path / "model")
    task, stored = Toll(), Stored()
    again = PPO.load(tmp_path / "model", env=task, device="cpu")
    again.learn(20, callback=[LagrangianMultiplier(0.0, 0.05), stored], reset_num_timesteps=False)
    rewards, multiplier = expected(task.made, 0.0, 0.05, 0.7)
    np.testing.assert_allclose(stored.rewards, rewards, atol=1e-6)
    assert 0.7 != multiplier == pytest.approx(again.lagrangian_multiplier)


def test_sac_replays_what_was_stored_at_the_multiplier_of_that_time():
    task = Toll()
    model = sac(task)
    model.learn(30, callback=LagrangianMultiplier(cost_limit=0.0, rate=0.05))
    rewards, multiplier = expected(task.made, 0.0, 0.05)
    np.testing.assert_allclose(model.replay_buffer.rewards[:30, 0], rewards, atol=1e-6)
    assert 0.0 < multiplier == pytest.approx(model.lagrangian_multiplier)


@pytest.mark.parametrize(
    ("make", "arguments", "named"),
    [
        (None, {"cost_limit": -1.0}, "cost_limit"),
        (None, {"rate": 0.0}, "rate"),
        (lambda: ppo(Toll(cost=None)), {}, "CostFunction"),
        (lambda: ppo(Toll(cost=np.nan)), {}, "must be finite"),
        (lambda: sac(GoalLine(), "MultiInputPolicy", replay_buffer_class=HerReplayBuffer), {}, "hindsight"),
        (lambda: sac(VecNormalize(DummyVecEnv([Toll]))), {}, "VecNormalize"),
    ],
)
def test_what_makes_no_price_is_refused(make, arguments, named):
    with pytest.raises(ConfigurationError, match=named):
        callback = LagrangianMultiplier(**{"cost_limit": 1.0, **arguments})
        make().learn(20, callback=callback)
