"""diagnose: what was planted ranks first and is treated; what is healthy has no symptom; the env stays as it was."""

import json
import math
import warnings

import gymnasium as gym
import numpy as np
import pytest

import safe_wrappers as sw
from safe_wrappers.diagnosis import SYMPTOMS, Diagnosis, Evidence, Finding, diagnose
from safe_wrappers.diagnosis.recording import policy_driver, record
from safe_wrappers.errors import ConfigurationError, UnknownNameError, UnsupportedEnvError

pytest.importorskip("gymnasium_robotics")
from planted import (
    ARM,
    CART,
    HEALTHY,
    LONGER,
    PLANTED,
    STOPPED,
    Bench,
    Late,
    balancing,
    tracing,
    waving,
)

pytestmark = pytest.mark.filterwarnings("ignore")


def found(finding):
    return finding.symptom, finding.present


QUICK = {
    "chunks that do not fit together": 200,
    "commands two steps late": 200,
    "a link that falls silent": 300,
    "a stop that is run into": 300,
    "a stiff wall": 300,
    "an IMU off the turning axis": 200,
    "a path through a singular pose": 800,
    "chunks on joints that ring": 300,
    "a ball behind a pillar": 450,
}


@pytest.mark.parametrize("name", QUICK)
def test_a_planted_fault_ranks_first_and_its_lines_halve_the_figure(name):
    symptom, make = PLANTED[name]
    diagnosis = diagnose(*make(), steps=QUICK[name])
    first = diagnosis.present[0]
    assert first.symptom == symptom
    assert first.advice if not first.code else first.after <= 0.5 * first.figure
    assert first.series is not None and len(first.series.values) == QUICK[name]


@pytest.mark.slow
@pytest.mark.parametrize("name", PLANTED)
def test_every_planted_fault_ranks_first(name):
    symptom, make = PLANTED[name]
    assert diagnose(*make(), steps=1000 * LONGER.get(name, 1)).present[0].symptom == symptom


@pytest.mark.parametrize(
    "name",
    [
        "InvertedPendulum, balanced",
        "swing, waving",
        "cart, held",
        "an IMU on the turning axis",
        "Swimmer, waving",
        "InvertedPendulum, balanced without seeing speeds",
        "chunks on stiff joints",
    ],
)
def test_a_healthy_env_has_no_symptom(name):
    assert not diagnose(*HEALTHY[name](), steps=200).present


@pytest.mark.slow
@pytest.mark.parametrize("name", HEALTHY)
def test_no_healthy_env_has_a_symptom(name):
    assert not diagnose(*HEALTHY[name](), steps=1000).present


def test_the_lines_that_are_shown_are_those_that_were_run():
    env = Bench(STOPPED)
    finding = diagnose(env, waving(env, 0.5, 100.0), steps=300, symptoms=["limits"]).finding("limits")
    scope = {"env": env, "sw": sw}
    exec(finding.code, scope)
    policy, beyond = waving(env, 0.5, 100.0), 0
    observation, _ = scope["env"].reset(seed=0)
    for _ in range(300):
        observation, *_ = scope["env"].step(policy(observation))
        beyond += abs(observation[0]) > math.radians(60.0) * 1.04
    assert finding.after == pytest.approx(beyond / 300, abs=0.01) and finding.figure > 0.05


def test_the_env_is_left_as_it_was_and_two_diagnoses_are_the_same():
    env = gym.make("Swimmer-v5")
    first, second = (diagnose(env, steps=50, seed=3).as_dict() for _ in range(2))
    assert first == second
    assert "step" not in vars(env.unwrapped)
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


def test_constraints_that_never_acted_with_any_driver_are_named():
    limits = [sw.constraints.JointSpeedLimit(4.0), sw.constraints.JointPositionLimit(-6.0, 6.0, ["joint0"])]
    env = sw.CBFActionFilter(gym.make("Reacher-v5"), limits)
    still = diagnose(env, lambda seen: np.zeros(2), steps=60, symptoms=["limits"])
    assert still.idle_constraints == ["JointPositionLimit"], "others than the policy made the first act"
    assert "Never acted, with any driver: JointPositionLimit." in str(still)
    assert still.as_dict()["idle_constraints"] == ["JointPositionLimit"]
    assert diagnose(gym.make("Reacher-v5"), steps=20, symptoms=["limits"]).idle_constraints == []


def test_an_env_of_ones_own_is_simulated_while_it_is_diagnosed_and_nothing_leaks():
    env = Drifting()
    with warnings.catch_warnings(action="error"):
        finding = diagnose(env, steps=300).finding("limits")
    assert "PredictiveShield" in finding.code and finding.after < finding.figure
    assert "step" not in vars(env)
    stopping = lambda seen: [np.clip(-10.0 * seen[1], -1.0, 1.0)]  # noqa: E731
    shield = sw.constraints.PredictiveShield("cost", horizon=10, backup=stopping)
    filtered = sw.CBFActionFilter(gym.wrappers.TimeLimit(Drifting(), 100), [shield])
    diagnosis = diagnose(filtered, steps=200)
    assert diagnosis.finding("limits").figure == 0.0
    assert diagnosis.finding("late_commands").missing or diagnosis.finding("late_commands").figure == 0.0
    assert filtered.env.env is filtered.unwrapped, "what looked on is gone"


def test_an_env_without_physics_says_what_is_missing_and_judges_commands_and_costs():
    env = gym.make("Pendulum-v1")
    jumping = iter(range(10_000))
    diagnosis = diagnose(env, lambda observation: np.array([2.0 * (-1) ** next(jumping)]), steps=60)
    assert [finding.symptom for finding in diagnosis.present] == ["command_steps"]
    assert diagnosis.finding("command_steps").figure == pytest.approx(1.0)
    for name in ("limits", "contact_forces", "wheel_slip", "loop_margin", "singular_poses"):
        assert "MuJoCo" in diagnosis.finding(name).missing, name
    assert math.isnan(diagnosis.finding("limits").figure) and not diagnosis.finding("limits").present


def test_without_a_policy_its_symptoms_are_not_measured():
    diagnosis = diagnose(gym.make("Swimmer-v5"), steps=30)
    assert diagnosis.drivers == ["random", "attacking"]
    for name, symptom in SYMPTOMS.items():
        told = "give a policy" in diagnosis.finding(name).missing
        assert told == symptom.policies_only, name


def test_the_policy_counts_where_there_is_one():
    env = Bench(STOPPED)
    finding = diagnose(env, lambda observation: np.zeros(1), steps=400, symptoms=["limits"]).finding("limits")
    assert finding.figure == finding.by_driver["policy"] == 0.0 < finding.by_driver["attacking"]


def test_lines_that_are_refused_are_told_with_the_reason(monkeypatch):
    env = Bench(STOPPED)
    monkeypatch.setattr(env, "action_space", gym.spaces.Box(-4.0, 4.0, (1,), np.float64))
    outer = sw.RecordInterventions(env)
    finding = diagnose(outer, waving(env, 0.5, 100.0), steps=200, symptoms=["limits"]).finding("limits")
    assert finding.present and not finding.code
    assert "RecordInterventions" in finding.advice


def test_bad_input_is_refused_by_name():
    env = gym.make("Swimmer-v5")
    with pytest.raises(UnknownNameError, match="no symptom is called 'slip'; there are limits, "):
        diagnose(env, symptoms=["slip"])
    with pytest.raises(
        UnsupportedEnvError, match=r"takes one env, as gym\.make returns it; got 'Swimmer-v5'"
    ):
        diagnose("Swimmer-v5")
    with pytest.raises(UnsupportedEnvError, match="needs a Box action space"):
        diagnose(gym.make("CartPole-v1"))
    with pytest.raises(ConfigurationError, match="policy is a function of the observation"):
        diagnose(env, policy=3)
    with pytest.raises(
        ConfigurationError, match=r"actions of shape \(3,\), Swimmer-v5 takes \(2,\)\. Is it this"
    ):
        diagnose(env, policy=lambda observation: np.zeros(3))
    with pytest.raises(
        ConfigurationError, match=r"raised IndexError for an observation of Swimmer-v5.*Is it this"
    ):
        diagnose(env, policy=lambda observation: observation[99])
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
    assert np.allclose(recording.actions, expected[:, None], atol=1e-6) and not recording.repeats


def test_a_reset_that_takes_arguments_is_refused_and_one_with_defaults_is_called():
    class Needs(Remembers):
        def reset(self, observation):
            raise AssertionError(observation)

    class Offers(Remembers):
        def reset(self, observation=None):
            self.asked = 0

    env = gym.make("Swimmer-v5")
    with pytest.raises(ConfigurationError, match=r"reset is called without arguments .* \(observation\)"):
        diagnose(env, Needs(), steps=10)
    assert record(env, policy_driver(Offers()), 1, seed=0).actions[0, 0] == pytest.approx(np.sin(1))


def test_an_action_that_is_not_finite_never_reaches_the_env():
    env, calls = gym.make("Swimmer-v5"), []
    seen = env.unwrapped.step
    env.unwrapped.step = lambda action: calls.append(np.isfinite(action).all()) or seen(action)
    answers = iter([np.zeros(2, np.float32)] * 6)
    with pytest.raises(
        ConfigurationError, match=r"control step \d+ is not finite: \[nan nan\]; the env was not given"
    ):
        diagnose(env, lambda observation: next(answers, np.full(2, np.nan, np.float32)), steps=20)
    assert calls and all(calls)


def test_a_simulation_that_diverges_is_found_though_mujoco_resets_it():
    xml = CART.format(stiffness=20_000).replace('timestep="0.002"', 'timestep="0.002" integrator="Euler"')
    wild = xml.replace('type="slide" axis', 'type="slide" stiffness="1e9" axis')
    env = Bench(wild)
    finding = diagnose(env, steps=60, symptoms=["contact_forces"]).findings[0]
    assert finding.present and finding.figure == math.inf and not finding.code
    assert finding.evidence[0].value >= 1.0 and "timestep" in finding.advice
    assert json.loads(Diagnosis("x", 60, [], [finding]).as_json())["findings"][0]["present"] is True
    with pytest.raises(
        UnknownNameError, match="no symptom 'limits' was looked for; there are contact_forces"
    ):
        Diagnosis("x", 60, [], [finding]).finding("limits")


class Model:
    """A policy as Stable-Baselines3 has it."""

    def predict(self, observation, deterministic=True):
        assert deterministic
        return np.zeros(2, np.float32), None


def test_a_model_with_predict_is_a_policy():
    assert "policy" in diagnose(gym.make("Swimmer-v5"), Model(), steps=20).drivers


def test_findings_are_ranked_and_json_has_no_nan():
    made = [
        Finding("a", "A", "1", 0.5, 1.0, "share"),
        Finding("b", "B", "1", missing="no model"),
        Finding(
            "c",
            "C",
            "1",
            3.0,
            1.0,
            "N",
            {"random": 3.0},
            [Evidence("x", math.inf, "m")],
            "env = env",
            after=1.0,
        ),
        Finding("d", "D", "1", 8.0, 4.0, "N", advice="Think."),
    ]
    diagnosis = Diagnosis("Env-v0", 10, ["random"], made)
    assert [one.symptom for one in diagnosis.findings] == ["c", "d", "a", "b"]
    assert [one.symptom for one in diagnosis.present] == ["c", "d"]
    there = json.loads(diagnosis.as_json())
    assert there["findings"][0]["evidence"][0]["value"] is None and there["findings"][3]["figure"] is None
    words = str(diagnosis)
    assert "with these lines: 1 N" in words and "Think." in words and "no model" in words and "50 %" in words


def test_delays_are_told_from_outages():
    env = gym.make("InvertedPendulum-v5")
    late = diagnose(Late(env, 2), balancing(env), steps=200)
    assert late.finding("late_commands").figure == 0.0
    assert dict((e.name, e.value) for e in late.finding("loop_margin").evidence)[
        "delay of commands"
    ] == pytest.approx(0.08)
    silent = sw.faults.Outages(gym.make("Swimmer-v5"), mean_length_s=0.4, mean_between_s=1.0)
    assert diagnose(silent, steps=200, symptoms=["late_commands"]).finding("late_commands").present


def test_an_arm_away_from_singular_poses_is_left_alone():
    env = Bench(ARM, [0.8, -1.6])
    finding = diagnose(env, tracing(env, 0.3, 0.08), steps=300, symptoms=["singular_poses"]).findings[0]
    assert finding.figure == 0.0 and finding.evidence[0].value > 0.4


def test_what_presses_all_the_time_is_no_impact():
    env = Bench(CART.format(stiffness=20_000), [0.955])
    finding = diagnose(
        env, lambda observation: np.array([20.0]), steps=300, symptoms=["contact_forces"]
    ).findings[0]
    assert finding.series.values[250:].max() < 0.1  # 20 N on a cart of 9.8 N
