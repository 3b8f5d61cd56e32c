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
from safe_wrappers.sb3 import InterventionCallback, InterventionEvalCallback
from safe_wrappers.wrappers.faults import DroppedRefreshes
from safe_wrappers.wrappers.record_interventions import RecordInterventions


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
    names = ("expired", "refused", "braking") if leased else ()
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
    return Monitor(DroppedRefreshes(stack, share=1.0))


class InfosKept(gym.Wrapper):
    """Keeps the infos of a run, to compare with what was logged."""

    kept: list

    def step(self, action):
        *result, info = self.env.step(action)
        self.kept.append(info)
        return *result, info


def test_slips_spin_outs_and_contact_forces_reach_tensorboard(tmp_path):
    rover = sw.protect(gym.make("SafeRover-v0", max_episode_steps=16))
    env = InfosKept(sw.RecordInterventions(sw.ContactMonitor(rover)))
    env.kept = []
    model = PPO("MlpPolicy", Monitor(env), n_steps=32, n_epochs=1, batch_size=32, device="cpu", seed=0)
    model.set_logger(configure(str(tmp_path), ["tensorboard"]))
    with pytest.warns(UserWarning, match="made once more"):  # the rover's tyres push in every substep
        model.learn(32, callback=InterventionCallback())
    logged, infos = scalars(tmp_path), env.kept

    def mean(of):
        return [pytest.approx(np.mean([of(info) for info in infos]), rel=1e-5)]

    assert logged["interventions/step_slip"] == mean(lambda i: np.abs(i["slip/ratio"]).max())
    assert logged["interventions/step_slip_limited"] == mean(lambda i: i["slip/limited"].mean())
    assert logged["interventions/step_spin_out"] == mean(lambda i: i["spin_out"])
    assert logged["interventions/step_contact_force"] == mean(lambda i: i["contact/peak_force"])
    assert logged["interventions/step_slip"][0] > 0.0 and logged["interventions/step_contact_force"][0] > 20.0
    assert logged["interventions/spin_outs"] == [0.0]


def crossing(**more):
    """A robot among cars of which little is known, for 16 steps."""
    cars = [sw.occlusion.Track("car*", acceleration_noise=[0.5, 0.0], start_velocity_std=1.0)]
    task = gym.make("OccludedCrossing-v0", max_episode_steps=16)
    return sw.RecordInterventions(sw.OcclusionPenalty(task, cars, "eye", tolerance=0.5, **more))


def test_what_is_seen_and_what_it_costs_reaches_tensorboard(tmp_path):
    env = InfosKept(crossing(weight=0.1))
    env.kept = []
    model = PPO("MlpPolicy", Monitor(env), n_steps=32, n_epochs=1, batch_size=32, device="cpu", seed=0)
    model.set_logger(configure(str(tmp_path), ["tensorboard"]))
    model.learn(32, callback=InterventionCallback())
    logged, infos = scalars(tmp_path), env.kept

    def mean(of):
        return [pytest.approx(np.mean([of(info) for info in infos]), rel=1e-5)]

    assert logged["interventions/step_seen"] == mean(lambda i: i["occlusion/visible"].mean())
    assert logged["interventions/step_expired"] == mean(lambda i: i["occlusion/expired"].mean())
    assert logged["interventions/step_sigma"] == mean(lambda i: i["occlusion/sigma"].max())
    assert logged["interventions/step_occlusion_penalty"] == mean(lambda i: i["occlusion/penalty"])
    for name in ("seen", "expired"):
        assert 0.0 < logged[f"interventions/step_{name}"][0] < 1.0
    ended = [info[keys.EPISODE_SUMMARY] for info in infos if keys.EPISODE_SUMMARY in info]
    assert len(ended) == 2
    for name in ("collisions", "seen", "expiries"):
        assert logged[f"interventions/{name}"] == pytest.approx([np.mean([e[name] for e in ended])])
    assert logged["interventions/expiries"][0] > 0.0


def test_handover_lease_and_faults_reach_tensorboard(tmp_path):
    model = PPO("MlpPolicy", lost_now_and_then(), n_steps=32, n_epochs=1, batch_size=32, device="cpu", seed=0)
    model.set_logger(configure(str(tmp_path), ["tensorboard"]))
    model.learn(32, callback=InterventionCallback())
    logged = scalars(tmp_path)
    assert logged["interventions/step_fault"] == [1.0]
    assert logged["interventions/step_starved"] == [4.0]  # all control steps of a chunk
    assert logged["interventions/step_lease_braking"] == [1.0]
    assert logged["interventions/step_lease_expired"] == [0.0]  # there never was one
    assert logged["interventions/lease_braking"] == [16.0]
    for name in ("step_lease_refused", "step_peak_jerk", "step_blend_time", "step_limited"):
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


def test_evaluation_reaches_tensorboard_at_its_own_step(tmp_path):
    model = PPO("MlpPolicy", make_env(), n_steps=32, n_epochs=1, batch_size=32, device="cpu", seed=0)
    model.set_logger(configure(str(tmp_path), ["tensorboard"]))
    evaluation = InterventionEvalCallback(Monitor(make_env()), n_eval_episodes=2, eval_freq=20, verbose=0)
    model.learn(32, callback=evaluation)
    events = EventAccumulator(str(tmp_path))
    events.Reload()
    (event,) = events.Scalars("eval/interventions/rate")
    assert (event.step, event.value) == (20, 0.25)
    assert np.isclose(events.Scalars("eval/interventions/cost")[0].value, 4.0)
    assert events.Scalars("eval/mean_reward")[0].step == 20
