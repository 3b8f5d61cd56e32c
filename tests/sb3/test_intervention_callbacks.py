from types import SimpleNamespace

import gymnasium as gym
import numpy as np
import pytest
from stable_baselines3 import PPO
from stable_baselines3.common.logger import configure
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

import safe_wrappers as sw
from safe_wrappers import info as keys
from safe_wrappers.sb3 import InterventionCallback
from safe_wrappers.wrappers.faults import RepeatedCommands
from safe_wrappers.wrappers.recording import RecordInterventions


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


def make_env():
    env = RecordInterventions(EveryFourthStep(gym.make("Pendulum-v1", max_episode_steps=16)))
    return Monitor(env)


def scalars(folder):
    events = EventAccumulator(str(folder))
    events.Reload()
    return {tag: [event.value for event in events.Scalars(tag)] for tag in events.Tags()["scalars"]}


EXPECTED = {
    "interventions/step_rate": 0.25,
    "interventions/step_correction": 0.125,
    "interventions/step_cost": 0.25,
    "interventions/rate": 0.25,
    "interventions/correction_mean": 0.125,
    "interventions/correction_p95": 0.5,
    "interventions/infeasible": 0.0,
    "interventions/cost": 4.0,
    "interventions/cost_substep": 4.0,
    "interventions/violations": 4.0,
}


@pytest.mark.parametrize("leased", [False, True])
def test_layers_and_judges_that_are_not_there_log_no_zeros(tmp_path, leased):
    env = gym.make("InvertedPendulum-v5", max_episode_steps=16)  # reports no cost
    if leased:
        rail = [sw.constraints.Plane([-0.9], [1]), sw.constraints.Plane([0.9], [-1])]
        env = sw.LeaseExpiry(
            env,
            sw.StoppingBudget(sw.constraints.Clearance(rail, bodies=["cart"], braking=8.0), acceleration=1.0),
        )
    model = PPO("MlpPolicy", RecordInterventions(env), n_steps=32, n_epochs=1, batch_size=32, device="cpu")
    model.set_logger(configure(str(tmp_path), ["tensorboard"]))
    model.learn(32, callback=InterventionCallback())
    logged = {tag for tag in scalars(tmp_path) if tag.startswith("interventions/")}
    names = ("refused", "braking") if leased else ()
    expected = {f"interventions/{prefix}lease_{name}" for name in names for prefix in ("", "step_")}
    assert logged == expected


def lost_now_and_then():
    """The whole stack, whose policy is never heard at all."""
    cart = gym.make("InvertedPendulum-v5", max_episode_steps=16)
    rail = [sw.constraints.Plane([-0.9], [1]), sw.constraints.Plane([0.9], [-1])]
    lease = sw.LeaseExpiry(
        cart,
        sw.StoppingBudget(sw.constraints.Clearance(rail, bodies=["cart"], braking=8.0), acceleration=1.0),
    )
    stack = sw.ChunkHandover(sw.RecordInterventions(lease), 8, 4, rate_limit=10.0)
    return Monitor(RepeatedCommands(stack, share=1.0))


def test_handover_lease_and_faults_reach_tensorboard(tmp_path):
    model = PPO("MlpPolicy", lost_now_and_then(), n_steps=32, n_epochs=1, batch_size=32, device="cpu", seed=0)
    model.set_logger(configure(str(tmp_path), ["tensorboard"]))
    model.learn(32, callback=InterventionCallback())
    logged = scalars(tmp_path)
    assert logged["interventions/step_fault"] == [1.0]
    assert logged["interventions/step_starved"] == [4.0]  # all control steps of a chunk
    assert logged["interventions/step_lease_braking"] == [1.0]
    assert logged["interventions/lease_braking"] == [16.0]
    for name in ("step_lease_refused", "step_peak_jerk", "step_limited"):
        assert np.isfinite(logged[f"interventions/{name}"]).all()


@pytest.mark.parametrize("vec_env", [DummyVecEnv, SubprocVecEnv])
def test_rollouts_reach_tensorboard_and_stdout(tmp_path, vec_env, capsys):
    envs = vec_env([make_env] * 2)
    model = PPO("MlpPolicy", envs, n_steps=32, n_epochs=1, batch_size=32, device="cpu", seed=0)
    model.set_logger(configure(str(tmp_path), ["tensorboard", "stdout"]))
    model.learn(128, callback=InterventionCallback())
    envs.close()
    logged = scalars(tmp_path)
    for tag, value in EXPECTED.items():
        assert logged[tag] == pytest.approx([value, value]), tag
    assert "| interventions/" in capsys.readouterr().out


def test_without_recorder_the_step_values_are_logged(tmp_path):
    model = PPO(
        "MlpPolicy", EveryFourthStep(gym.make("Pendulum-v1")), n_steps=32, n_epochs=1, device="cpu", seed=0
    )
    model.set_logger(configure(str(tmp_path), ["tensorboard"]))
    model.learn(32, callback=InterventionCallback())
    logged = scalars(tmp_path)
    assert logged["interventions/step_rate"] == pytest.approx([0.25])
    assert "interventions/rate" not in logged


def test_a_step_without_a_judgement_does_not_hide_the_mean_of_the_others(tmp_path):
    logger = configure(str(tmp_path), ["tensorboard"])
    callback = InterventionCallback()
    callback.model = SimpleNamespace(logger=logger)
    callback.locals = {"infos": [{keys.COST: 0.5}, {keys.COST: keys.NOT_JUDGED}, {keys.COST: 1.0}]}
    callback._on_step()
    assert logger.name_to_value["interventions/step_cost"] == 0.75
    logger.close()
