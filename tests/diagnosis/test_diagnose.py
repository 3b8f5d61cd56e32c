"""diagnose: what was planted ranks first and is treated; what is healthy has no symptom; the env stays as it was."""

import itertools
import math
import warnings

import gymnasium as gym
import mujoco
import numpy as np
import pytest

import safe_wrappers as sw
from safe_wrappers import diagnosis
from safe_wrappers.diagnosis import SYMPTOMS, Finding, attacker, diagnose, policy_driver, record
from safe_wrappers.errors import ActionError, ConfigurationError, UnsupportedEnvError

pytest.importorskip("gymnasium_robotics")
from tests.diagnosis.planted import CART, HEALTHY, PLANTED, STOPPED, Bench, waving

pytestmark = pytest.mark.filterwarnings("ignore")


def found(*driven, **options):
    """The findings by the name of their symptom, the most severe first."""
    return {finding.symptom: finding for finding in diagnose(*driven, **options)}


@pytest.mark.parametrize("name", PLANTED)
def test_a_planted_fault_ranks_first_and_its_lines_halve_the_figure(name):
    symptom, steps, make = PLANTED[name]
    first = diagnose(*make(), steps=steps)[0]
    assert first.present and first.symptom == symptom
    env, policy = make()
    scope = {"env": env, "sw": sw}
    exec(first.code, scope)
    assert found(scope["env"], policy, steps)[symptom].figure <= 0.5 * first.figure


@pytest.mark.parametrize("name", HEALTHY)
def test_a_healthy_env_has_no_symptom(name):
    assert not any(finding.present for finding in diagnose(*HEALTHY[name](), steps=200))


def test_the_env_is_left_as_it_was_and_two_diagnoses_are_the_same():
    env = gym.make("Swimmer-v5")
    stack = str(env)
    first, second = (str(diagnose(env, steps=50, seed=3)) for _ in range(2))
    assert first == second and str(env) == stack
    observation, _ = env.reset(seed=5)
    plain = gym.make("Swimmer-v5")
    assert np.array_equal(observation, plain.reset(seed=5)[0])
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
        finding = found(env, steps=300)["limits"]
    scope = {"env": env, "sw": sw}
    exec(finding.code, scope)
    assert "PredictiveShield" in finding.code
    assert found(scope["env"], steps=300)["limits"].figure < finding.figure
    stopping = lambda seen: [np.clip(-10.0 * seen[1], -1.0, 1.0)]  # noqa: E731
    shield = sw.constraints.PredictiveShield("cost", horizon=10, backup=stopping)
    filtered = sw.CBFActionFilter(gym.wrappers.TimeLimit(Drifting(), 100), [shield])
    assert found(filtered, steps=200)["limits"].figure == 0.0
    assert filtered.env.env is filtered.unwrapped, "what looked on is gone"


def test_an_env_without_physics_says_what_is_missing_and_judges_commands_and_costs():
    env = gym.make("Pendulum-v1")
    jumping = iter(range(10_000))
    seen = found(env, lambda observation: np.array([2.0 * (-1) ** next(jumping)]), steps=60)
    assert [name for name, finding in seen.items() if finding.present] == ["command_steps"]
    assert seen["command_steps"].figure == pytest.approx(1.0)
    for name in ("limits", "contact_forces", "wheel_slip"):
        assert "MuJoCo" in seen[name].missing, name
    assert math.isnan(seen["limits"].figure) and not seen["limits"].present


def test_without_a_policy_its_symptoms_are_not_measured():
    for name, finding in found(gym.make("Swimmer-v5"), steps=30).items():
        assert ("give a policy" in finding.missing) == SYMPTOMS[name].policies_only, name


def test_the_policy_counts_where_there_is_one():
    env = Bench(STOPPED)
    still = found(env, lambda observation: np.zeros(1), steps=400)
    assert still["limits"].figure == 0.0 < found(env, steps=400)["limits"].figure


def test_what_treats_a_symptom_is_refused_with_the_reason():
    jumping = iter(range(10_000))
    seen = found(Drifting(), lambda observation: np.array([(-1.0) ** next(jumping)]), steps=60)
    code = seen["command_steps"].code
    assert code.startswith("# ChunkHandover(") and "is refused: " in code and "has no attribute dt" in code


def test_what_hits_without_a_name_is_found_all_the_same():
    env = Bench(CART.format(stiffness=20_000).replace('name="cart"', ""))
    finding = found(env, lambda observation: np.array([20.0]), steps=200)["contact_forces"]
    assert finding.present and finding.code.startswith("# Limit the speed of what hits")


def test_an_error_in_a_measurement_is_not_taken_for_a_refusal(monkeypatch):
    def broken(recording):
        raise ConfigurationError("of a bug")

    monkeypatch.setitem(SYMPTOMS, "limits", SYMPTOMS["limits"]._replace(measure=broken))
    with pytest.raises(ConfigurationError, match="of a bug"):
        diagnose(gym.make("Swimmer-v5"), steps=2)


def test_bad_input_is_refused_by_name():
    env = gym.make("Swimmer-v5")
    with pytest.raises(
        UnsupportedEnvError, match=r"takes one env, as gym\.make returns it; got 'Swimmer-v5'"
    ):
        diagnose("Swimmer-v5")
    with pytest.raises(UnsupportedEnvError, match="needs a Box action space"):
        diagnose(gym.make("CartPole-v1"))
    with pytest.raises(ConfigurationError, match="policy is a function of the observation"):
        diagnose(env, policy=3)
    with pytest.raises(ActionError, match="an action of 2 finite numbers, got array"):
        diagnose(env, policy=lambda observation: np.zeros(3))
    with pytest.raises(ConfigurationError, match="steps"):
        diagnose(env, steps=1)


class Remembers:
    """A policy with a memory: what it has been asked since its last reset."""

    def __init__(self):
        self.asked = 0

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


def test_a_simulation_that_diverges_is_found_though_mujoco_resets_it():
    xml = CART.format(stiffness=20_000).replace('timestep="0.002"', 'timestep="0.002" integrator="Euler"')
    wild = xml.replace('type="slide" axis', 'type="slide" stiffness="1e9" axis')
    env = Bench(wild)
    finding = diagnose(env, steps=60)[0]
    assert finding.symptom == "contact_forces" and finding.present and finding.figure == math.inf
    assert finding.code.startswith("# The simulation diverged: a shorter timestep")


class Model:
    """A policy as Stable-Baselines3 has it."""

    def predict(self, observation, deterministic=True):
        assert deterministic
        return np.zeros(2, np.float32), None


def test_a_model_with_predict_is_a_policy():
    assert found(gym.make("Swimmer-v5"), Model(), steps=20)["command_steps"].figure == 0.0


def test_findings_are_ranked_and_told():
    env = Bench(STOPPED)
    seen = diagnose(env, waving(env, 0.5, 100.0), steps=300)
    ranks = [2 * finding.present + (not finding.missing) for finding in seen]
    assert ranks == sorted(ranks, reverse=True) and {0, 1, 3} == set(ranks)
    assert str(Finding("wheel_slip", 0.5, "env = env\n# b")).splitlines() == [
        "  FOUND     wheel_slip        wheels that spin or lock: 50 % (a symptom from 5 % on)",
        "      env = env",
        "      # b",
    ]
    assert str(Finding("balance", missing="no model")) == "  unknown   balance           no model"
    assert str(Finding("contact_forces", 6.0)).endswith("6 weights (a symptom from 60 weights on)")


def test_what_presses_all_the_time_is_no_impact():
    env = Bench(CART.format(stiffness=20_000).replace("-20 20", "-700 700"), [0.95])
    pushes = itertools.chain(np.linspace(0.0, 700.0, 100), itertools.repeat(700.0))  # N, on a cart of 9.8 N
    finding = found(env, lambda observation: np.array([next(pushes)]), steps=300)["contact_forces"]
    assert finding.figure < 10.0 and not finding.present


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
    model = mujoco.MjModel.from_xml_string(ROVER)
    rolling = diagnosis.wheels(model)
    assert [model.joint(j).name for j in rolling] == ["wheel"] and list(rolling.values()) == [0.1]

    class Seen:
        qpos = np.tile(model.qpos0, (8, 1))
        qvel = np.zeros((8, model.nv))

    Seen.model = model
    Seen.qpos[4:, 3:7] = [np.cos(0.6), 0.0, 0.0, np.sin(0.6)]  # turned round by 1.2 rad
    Seen.qvel[:4, 0], Seen.qvel[4:, :2] = 1.0, [np.cos(1.2), np.sin(1.2)]
    driven, braked = (
        [10.0 / (1.0 - slip) for slip in (0.19, 0.21)],
        [10.0 * (1.0 - s) for s in (0.19, 0.21)],
    )
    Seen.qvel[:, 6] = [*driven, *braked] * 2
    assert SYMPTOMS["wheel_slip"].measure(Seen) == 0.5  # each second one is above 0.2


def test_command_steps_are_not_counted_over_resets():
    class Seen:
        env = gym.Env()
        executed = np.array([[0.0], [0.1], [0.2], [-1.0], [-0.9], [-0.8]])
        first = np.array([True, False, False, True, False, False])

    Seen.env.action_space = gym.spaces.Box(-1.0, 1.0, (1,))
    assert SYMPTOMS["command_steps"].measure(Seen) == pytest.approx(0.05)


def test_the_attacker_is_seeded_and_holds_corners():
    env = gym.make("Reacher-v5")
    first, second = ([attacker(env, 4)(None) for _ in range(2)] for _ in range(2))
    assert np.array_equal(first, second)
    act = attacker(env, 0)
    taken = np.array([act(None) for _ in range(45)])
    assert (np.abs(taken) == 1.0).all()
    assert all(len(np.unique(taken[k : k + 15], axis=0)) == 1 for k in (0, 15, 30))


def test_what_the_env_was_given_is_seen_inside_of_wrappers():
    class Half(gym.ActionWrapper):
        def action(self, action):
            return 0.5 * action

    env = Half(gym.make("Swimmer-v5"))
    recording = record(env, attacker(env, 0), 20, 0)
    act = attacker(env, 0)
    assert np.allclose(recording.executed, [0.5 * act(None) for _ in range(20)])


def test_a_horizon_covers_the_time_to_brake():
    class Seen:
        qvel = np.linspace(0.0, 4.0, 30)[:, None]
        first = np.zeros(30, bool)

    assert diagnosis._braking(Seen) == 29
    Seen.qvel = 0.0 * Seen.qvel
    assert diagnosis._braking(Seen) == 5
