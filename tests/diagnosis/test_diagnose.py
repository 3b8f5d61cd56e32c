"""diagnose: what was planted ranks first and is treated; what is healthy has no symptom; the env stays as it was."""

import dataclasses
import itertools
import math
import re
import warnings
from types import SimpleNamespace

import gymnasium as gym
import numpy as np
import pytest
from scenes import Scene

import safe_wrappers as sw
from safe_wrappers.diagnosis import SYMPTOMS, attacker, diagnose, policy_driver, record, wheels
from safe_wrappers.errors import ActionError, ConfigurationError, UnsupportedEnvError

gym.register_envs(pytest.importorskip("gymnasium_robotics"))
pytestmark = pytest.mark.filterwarnings("ignore")


def waving(share=0.3, period=60.0, seam=0):
    """Slow sines; with a `seam` another phase every so many steps, as chunks have that do not fit together."""

    def policy(env):
        high, rng = env.action_space.high.astype(float), np.random.default_rng(0)
        state = {"k": 0, "phase": 0.0}

        def act(observation):
            if seam and state["k"] % seam == 0:
                state["phase"] = rng.uniform(0.0, 2.0 * np.pi)
            state["k"] += 1
            angle = 2.0 * np.pi * state["k"] / period + state["phase"] + np.arange(high.size)
            return (share * high * np.sin(angle)).astype(env.action_space.dtype)

        return act

    return policy


CART = """
<mujoco><compiler autolimits="true"/><option timestep="0.002"/><worldbody>
  <geom type="box" name="wall" pos="1.05 0 0" size=".05 .3 .3" solref="-{stiffness} -20"/>
  <body name="cart"><joint name="slide" type="slide" axis="1 0 0"/>
    <geom size=".05" mass="1" solref="-{stiffness} -20"/></body>
  </worldbody><actuator><motor joint="slide" ctrlrange="-20 20"/></actuator></mujoco>
"""
STOPPED = """
<mujoco><compiler autolimits="true"/><option timestep="0.002" gravity="0 0 0"/><worldbody>
  <body><joint name="swing" axis="0 0 1" range="-60 60" damping=".01"/>
    <geom type="capsule" size=".02" fromto="0 0 0 .3 0 0" mass="1"/></body>
  </worldbody><actuator><motor joint="swing" ctrlrange="-4 4"/></actuator></mujoco>
"""


class Bench(Scene):
    """A machine of a few parts; the observation is its state."""

    def __init__(self, xml, at=None):
        super().__init__(xml)
        self.at = np.zeros(self.model.nq) if at is None else np.array(at)
        self.observation_space = gym.spaces.Box(-np.inf, np.inf, (2 * self.model.nq,), np.float64)

    def reset(self, *, seed=None, options=None):
        gym.Env.reset(self, seed=seed)
        self.start = self.at + self.np_random.uniform(-0.01, 0.01, self.model.nq), np.zeros(self.model.nv)
        super().reset()
        return np.concatenate([self.data.qpos, self.data.qvel]), {}

    def step(self, action):
        super().step(action)
        return np.concatenate([self.data.qpos, self.data.qvel]), 0.0, False, False, {}


def cart(stiffness=20_000):
    return CART.format(stiffness=stiffness)


PLANTED = {
    "chunks that do not fit together": ("command_steps", 100, "Swimmer-v5", waving(seam=10)),
    "chunks on joints that ring": ("command_steps", 200, "FlexJointReach-v0", waving(0.5, 200.0, seam=24)),
    "icy ground": ("wheel_slip", 100, "SafeRover-v0", None),
    "a stiff wall": ("contact_forces", 150, lambda: Bench(cart(40_000)), waving(0.5, 200.0)),
    "a maze with stiff walls": ("contact_forces", 200, "PointMaze_UMaze-v3", None),
    "a stop that is run into": ("limits", 150, lambda: Bench(STOPPED), waving(0.5, 100.0)),
    "hazards": ("limits", 400, "SafePointGoal1-v0", waving(0.5, 100.0)),
    "a speed limit": ("limits", 150, "SafeSwimmerVelocity-v0", waving(1.0, 25.0)),
}
"""What is planted, for how many steps it is looked at, the env and its policy."""
HEALTHY = {
    "Swimmer": ("Swimmer-v5", waving()),
    "FetchReach, slowly": ("FetchReach-v4", waving(0.2)),
    "SafeRover, slowly": (lambda: sw.protect(gym.make("SafeRover-v0")), waving(0.2, 200.0)),
    "swing": (lambda: Bench(STOPPED), waving(0.02, 60.0)),
    "SafePointGoal1, protected": (lambda: sw.protect(gym.make("SafePointGoal1-v0")), None),
    "Reacher": ("Reacher-v5", waving(0.05)),
    "FlexJointReach": ("FlexJointReach-v0", waving(0.15, 200.0)),
    "TeleopContact through waves, in the air": (
        lambda: sw.TeleopChannel(gym.make("TeleopContact-v0"), 0.1, 0.1, impedance=40.0),
        waving(0.02, 500.0),
    ),
}


def made(build, policy):
    env = gym.make(build) if isinstance(build, str) else build()
    return env, None if policy is None else policy(env)


def found(*driven, **options):
    """The findings by the name of their symptom, the most severe first."""
    return {finding.symptom: finding for finding in diagnose(*driven, **options)}


def treated(env, finding):
    """The env after the lines of a finding have been run."""
    scope = {"env": env, "sw": sw}
    exec(finding.code, scope)
    return scope["env"]


@pytest.mark.parametrize("name", PLANTED)
def test_a_planted_fault_ranks_first_and_its_lines_halve_the_figure(name):
    symptom, steps, *parts = PLANTED[name]
    seen = diagnose(*made(*parts), steps=steps)
    first = seen[0]
    assert first.present and first.symptom == symptom and str(first).endswith(first.code.splitlines()[-1])
    ranks = [2 * finding.present + (not finding.missing) for finding in seen]
    assert ranks == sorted(ranks, reverse=True)
    env, policy = made(*parts)
    assert found(treated(env, first), policy, steps)[symptom].figure <= 0.5 * first.figure


@pytest.mark.parametrize("name", HEALTHY)
def test_a_healthy_env_has_no_symptom(name):
    assert not any(finding.present for finding in diagnose(*made(*HEALTHY[name]), steps=120))


def test_the_env_is_left_as_it_was_and_two_diagnoses_are_the_same():
    env, plain = gym.make("Swimmer-v5"), gym.make("Swimmer-v5")
    stack = str(env)
    first, second = (found(env, steps=50, seed=3) for _ in range(2))
    assert str(first) == str(second) and str(env) == stack
    for name, finding in first.items():  # of an attacker, what only a policy has is not measured
        assert ("give a policy" in finding.missing) == SYMPTOMS[name].policies_only, name
    assert np.array_equal(env.reset(seed=5)[0], plain.reset(seed=5)[0])
    action = np.array([0.3, -0.2], np.float32)
    assert np.array_equal(env.step(action)[0], plain.step(action)[0])


class Drifting(gym.Env):
    """An env of one's own: a cost beyond 1 m; nothing says how long its step lasts."""

    action_space = gym.spaces.Box(-1.0, 1.0, (1,), np.float32)
    observation_space = gym.spaces.Box(-np.inf, np.inf, (2,), np.float64)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.at = np.array([self.np_random.uniform(-0.5, 0.5), 0.0])
        return self.at.copy(), {}

    def step(self, action):
        speed = np.clip(self.at[1] + 0.1 * float(action[0]), -0.2, 0.2)
        self.at = np.array([self.at[0] + 0.1 * speed, speed])
        return self.at.copy(), 0.0, False, False, {"cost": float(abs(self.at[0]) > 1.0)}


def test_an_env_of_ones_own_is_simulated_while_it_is_diagnosed_and_nothing_leaks():
    env = Drifting()
    with warnings.catch_warnings(action="error"):
        finding = found(env, steps=200)["limits"]
    assert "PredictiveShield" in finding.code
    assert found(treated(env, finding), steps=200)["limits"].figure < finding.figure
    stopping = lambda seen: [np.clip(-10.0 * seen[1], -1.0, 1.0)]  # noqa: E731
    shield = sw.constraints.PredictiveShield("cost", horizon=10, backup=stopping)
    filtered = sw.CBFActionFilter(gym.wrappers.TimeLimit(Drifting(), 100), [shield])
    assert found(filtered, steps=200)["limits"].figure == 0.0
    assert filtered.env.env is filtered.unwrapped, "what looked on is gone"


def jumping(observation, signs=itertools.cycle([1.0, -1.0])):  # noqa: B008
    return np.array([next(signs)])


def test_an_env_without_physics_says_what_is_missing_and_judges_commands_and_costs():
    seen = found(gym.make("Pendulum-v1"), lambda observation: 2.0 * jumping(observation), steps=60)
    assert [name for name, finding in seen.items() if finding.present] == ["command_steps"]
    assert seen["command_steps"].figure == pytest.approx(1.0)
    for name in ("limits", "contact_forces", "wheel_slip"):
        assert "MuJoCo" in seen[name].missing and "unknown" in str(seen[name]), name
    assert math.isnan(seen["limits"].figure) and not seen["limits"].present


def test_what_treats_a_symptom_is_refused_with_the_reason():
    code = found(Drifting(), jumping, steps=60)["command_steps"].code
    assert code.startswith("# ChunkHandover(") and "is refused: " in code and "has no attribute dt" in code


def test_what_hits_without_a_name_is_found_all_the_same():
    env = Bench(cart().replace('name="cart"', ""))
    finding = found(env, lambda observation: np.array([20.0]), steps=200)["contact_forces"]
    assert finding.present and finding.code.startswith("# Limit the speed of what hits")


def test_what_presses_all_the_time_is_no_impact():
    env = Bench(cart().replace("-20 20", "-700 700"), [0.95])
    pushes = itertools.chain(np.linspace(0.0, 700.0, 100), itertools.repeat(700.0))  # N, on a cart of 9.8 N
    finding = found(env, lambda observation: np.array([next(pushes)]), steps=300)["contact_forces"]
    assert finding.figure < 10.0 and not finding.present


def test_a_simulation_that_diverges_is_found_though_mujoco_resets_it():
    xml = cart().replace('timestep="0.002"', 'timestep="0.002" integrator="Euler"')
    wild = xml.replace('type="slide" axis', 'type="slide" stiffness="1e9" axis')
    finding = diagnose(Bench(wild), steps=60)[0]
    assert finding.symptom == "contact_forces" and finding.present and finding.figure == math.inf
    assert finding.code.startswith("# The simulation diverged: a shorter timestep")


@pytest.mark.parametrize(
    ("env_id", "options", "error", "says"),
    [
        ("Swimmer-v5", {"policy": 3}, ConfigurationError, "policy is a function of the observation"),
        ("Swimmer-v5", {"policy": lambda seen: np.zeros(3)}, ActionError, "2 finite numbers, got array"),
        ("Swimmer-v5", {"steps": 1}, ConfigurationError, "steps"),
        ("CartPole-v1", {}, UnsupportedEnvError, "needs a Box action space"),
        (None, {}, UnsupportedEnvError, r"takes one env, as gym\.make returns it; got None"),
    ],
)
def test_bad_input_is_refused_by_name(env_id, options, error, says):
    with pytest.raises(error, match=says):
        diagnose(env_id and gym.make(env_id), **options)


# What a policy is, and what is recorded of it ---------------------------------------------------------------------


class Remembers:
    """A policy with a memory: what it has been asked since its last reset."""

    asked = 0

    def reset(self):
        self.asked = 0

    def __call__(self, observation):
        self.asked += 1
        return np.full(2, np.sin(self.asked), np.float32)


def test_a_policy_with_a_memory_begins_its_first_episode_as_any_other():
    recording = record(gym.make("Swimmer-v5", max_episode_steps=4), policy_driver(Remembers()), 8, seed=0)
    expected = np.sin(np.tile(np.arange(1, 5), 2))
    assert np.allclose(recording.executed, expected[:, None], atol=1e-6)


def test_an_action_that_is_not_finite_never_reaches_the_env():
    env, calls = gym.make("Swimmer-v5"), []
    seen = env.unwrapped.step
    env.unwrapped.step = lambda action: calls.append(np.isfinite(action).all()) or seen(action)
    answers = iter([np.zeros(2, np.float32)] * 6)
    with pytest.raises(ActionError, match=r"2 finite numbers, got array\(\[nan, nan\].*; the env was not"):
        diagnose(env, lambda observation: next(answers, np.full(2, np.nan, np.float32)), steps=20)
    assert calls and all(calls)


def test_a_model_with_predict_is_a_policy_and_asked_deterministically():
    answers = {True: np.zeros(2, np.float32), False: np.full(2, np.nan)}
    model = SimpleNamespace(predict=lambda observation, deterministic: (answers[deterministic], None))
    assert found(gym.make("Swimmer-v5"), model, steps=20)["command_steps"].figure == 0.0


def test_the_attacker_is_seeded_and_holds_corners_and_what_the_env_was_given_is_recorded():
    plain = gym.make("Swimmer-v5")
    env = gym.wrappers.TransformAction(plain, lambda action: 0.5 * action, plain.action_space)
    act = attacker(env, 4)
    taken = np.array([act(None) for _ in range(45)])
    assert (np.abs(taken) == 1.0).all()
    assert all(len(np.unique(taken[k : k + 15], axis=0)) == 1 for k in (0, 15, 30))
    assert np.allclose(record(env, attacker(env, 4), 45, 0).executed, 0.5 * taken)


# Figures of what was recorded -------------------------------------------------------------------------------------


def recorded(env, **arrays):
    """A recording of an env with other numbers in it."""
    recording = record(env, attacker(env, 0), 2, 0)
    k = len(next(iter(arrays.values())))
    return dataclasses.replace(recording, infos=[{}] * k, **{"first": np.zeros(k, bool)} | arrays)


def test_an_error_in_a_measurement_is_not_taken_for_a_refusal(monkeypatch):
    def broken(recording):
        raise ConfigurationError("of a bug")

    monkeypatch.setitem(SYMPTOMS, "limits", SYMPTOMS["limits"]._replace(measure=broken))
    with pytest.raises(ConfigurationError, match="of a bug"):
        diagnose(gym.make("Swimmer-v5"), steps=2)


def test_command_steps_are_not_counted_over_resets():
    executed = np.array([[0.0], [0.1], [0.2], [-1.0], [-0.9], [-0.8]])
    first = np.array([True, False, False, True, False, False])
    recording = recorded(Drifting(), executed=executed, first=first)
    assert SYMPTOMS["command_steps"].measure(recording) == pytest.approx(0.05)


@pytest.mark.parametrize(("speeds", "horizon"), [(np.linspace(0.0, 4.0, 30), 29), (np.zeros(30), 5)])
def test_a_horizon_covers_the_time_to_brake(speeds, horizon):
    pressed = np.full((30, 1), 2.0)  # rad; the stop is at 60 degrees
    recording = recorded(Bench(STOPPED), qpos=pressed, qvel=speeds[:, None])
    assert re.findall(r"horizon=(\d+)", SYMPTOMS["limits"].tool(recording)) == [str(horizon)]


ROVER = """
<mujoco><worldbody><geom type="plane" size="9 9 1"/>
  <body name="chassis" pos="0 0 .1"><freejoint/><geom type="box" size=".2 .1 .02" mass="5"/>
    <body name="wheel" pos=".1 .12 0"><joint name="wheel" axis="0 1 0"/>
      <geom type="cylinder" size=".1 .02" zaxis="0 1 0" mass=".5"/></body>
    <body name="foot" pos="-.1 .12 0"><joint name="foot" axis="0 1 0" range="-90 90" limited="true"/>
      <geom type="sphere" size=".1" mass=".5"/></body>
    <body name="mast" pos="0 0 .05"><joint name="mast" axis="0 0 1"/><geom type="sphere" size=".02" mass=".1"/></body>
  </body></worldbody><actuator><motor joint="wheel"/><motor joint="foot"/><motor joint="mast"/></actuator></mujoco>
"""


def test_wheels_are_what_rolls_and_their_slip_is_that_of_kinematics():
    env = Scene(ROVER)
    rolling = wheels(env.model)
    assert [env.model.joint(j).name for j in rolling] == ["wheel"] and list(rolling.values()) == [0.1]
    qpos, qvel = np.tile(env.model.qpos0, (8, 1)), np.zeros((8, env.model.nv))
    qpos[4:, 3:7] = [np.cos(0.6), 0.0, 0.0, np.sin(0.6)]  # turned round by 1.2 rad
    qvel[:4, 0], qvel[4:, :2] = 1.0, [np.cos(1.2), np.sin(1.2)]
    driven, braked = ([10.0 * (1.0 - slip) ** sign for slip in (0.19, 0.21)] for sign in (-1, 1))
    qvel[:, 6] = [*driven, *braked] * 2
    share = SYMPTOMS["wheel_slip"].measure(recorded(env, qpos=qpos, qvel=qvel))
    assert share == 0.5  # each second one is above 0.2
