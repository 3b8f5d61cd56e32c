"""What a config puts around the task and beside the learning: each layer in its place, in training and evaluation."""

import csv
import io
import json
import subprocess
import sys

import gymnasium as gym
import numpy as np
import pytest
from rich.console import Console
from running import SILENT, evaluated, finish, trained
from stable_baselines3.common.callbacks import BaseCallback
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

import safe_wrappers as sw
from safe_wrappers import info as keys
from safe_wrappers.errors import ConfigurationError, UnknownNameError
from safe_wrappers.plants.env_checks import wrappers_of
from safe_wrappers.train.config import (
    EnvConfig,
    EvaluationConfig,
    FilterConfig,
    LearnerConfig,
    parse_experiment,
)
from safe_wrappers.train.evaluation.evaluate import evaluate_run, evaluated_steps, evaluation_folder
from safe_wrappers.train.evaluation.summary import summarize, write_summary
from safe_wrappers.train.files import read_rows
from safe_wrappers.train.report import comparison_table, verdict, write_report
from safe_wrappers.train.run import train_run, training
from safe_wrappers.train.run.checkpoint import latest_checkpoint, load_model
from safe_wrappers.train.run.policy import TrainedPolicy
from safe_wrappers.train.run.stack import make_stack, make_vec_env
from safe_wrappers.train.run.training import finished_checkpoint

LEASE = {"budget": {"closing_speed": 3.0}, "min_lease_s": 0.02}
POINT = EnvConfig("SafePointGoal1-v0")


# Layers ---------------------------------------------------------------------------------------------------------


def test_the_stack_has_every_layer_in_its_place():
    outages = {"mean_between_s": 0.2, "mean_length_s": 0.2}
    faults = {"Outages": outages, "RepeatedCommands": {"share": 0.1}}
    filtered = FilterConfig(protect={"margin": 0.1}, lease=LEASE, escape={"progress": 0.1})
    learner = LearnerConfig("adaption_penalty", penalty=2.0)
    stack = make_stack(EnvConfig("SafePointGoal1-v0", {}, faults), filtered, learner)
    assert stack.penalty == 2.0
    kinds = [type(wrapper).__name__ for wrapper in wrappers_of(stack)]
    order = ["AdaptionPenalty", "Monitor", "RepeatedCommands", "Outages", "RecordInterventions"]
    order += ["StuckEscape", "LeaseExpiry", "CBFActionFilter"]
    assert [kind for kind in kinds if kind in order] == order
    stack.reset(seed=0)
    infos = [stack.step(np.array([0.3, 0.1], np.float32))[4] for _ in range(100)]
    assert any(i["fault/active"] for i in infos) and any(i["lease/remaining_s"] > 0.02 for i in infos)
    assert not any(i["cost"] for i in infos)
    assert stack.get_wrapper_attr("filter_time_us") > 0
    (clearance,) = stack.get_wrapper_attr("filter").constraints
    assert clearance.margin == pytest.approx(
        sw.protect(gym.make("SafePointGoal1-v0")).constraints[0].margin + 0.1
    )


@pytest.mark.parametrize(
    ("env", "used", "message"),
    [
        (
            EnvConfig("Reacher-v5", {}, {"Outage": {}}),
            {},
            "env.faults: .*'Outage'. Did you mean 'Outages'",
        ),
        (EnvConfig("Reacher-v5", {}, {"Outages": {}}), {}, "env.faults.Outages.*mean_between_s"),
        (EnvConfig("OccludedCrossing-v0", {}, {}, {}), {}, "env.occlusion.*tracks"),
        (POINT, {"protect": {}, "lease": {"budget": {"closing": 1.0}}}, "closing"),
        (EnvConfig("Pusher-v5"), {"protect": {}, "lease": LEASE}, "2 constraints; say which one"),
    ],
)
def test_arguments_of_layers_that_are_missing_or_wrong_are_named(env, used, message):
    with pytest.raises((ConfigurationError, UnknownNameError), match=message):
        make_stack(env, FilterConfig(**used))


def test_a_penalty_needs_a_filter_of_ours():
    learner = LearnerConfig("adaption_penalty", penalty=1.0)
    with pytest.raises(ConfigurationError, match="AdaptionPenalty needs a CBFActionFilter inside"):
        make_stack(EnvConfig("fake_task:FakeGoal-v0"), FilterConfig(factory="fake_task:shield"), learner)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::safe_wrappers.UnsafeStateWarning")
def test_the_occlusion_penalty_is_inside_the_filter_and_the_recorder_counts_what_it_tells():
    occlusion = {
        "tracks": [{"bodies": "car*", "acceleration_noise": [0.0225, 0], "start_position_std": [0.3, 0]}],
        "sensor": {"camera": "eye", "range_m": 6},
        "tolerance": 0.5,
        "weight": 0.1,
    }
    env = EnvConfig("OccludedCrossing-v0", {}, {}, occlusion)
    stack = make_stack(env, FilterConfig(protect={"cars": "estimated"}))
    stack.reset(seed=0)
    total, taken, info, done = 0.0, 0.0, {}, False
    while not done:
        _, reward, _, done, info = stack.step(np.array([0.0, 1.0, 0.2], np.float32))
        total, taken = total + reward, taken + info["occlusion/penalty"]
    assert info["interventions"]["return"] == pytest.approx(total + taken)
    assert info["episode"]["r"] == pytest.approx(total, abs=1e-5)  # Monitor's holds the penalty
    assert info["interventions"]["return"] > total and "collisions" in info["interventions"]


SEEN = {
    "name": "seen",
    "env": {"id": "SafePointGoal1-v0", "observation": "constraints", "kwargs": {"max_episode_steps": 50}},
    "algorithm": "PPO",
    "hyperparameters": {"n_steps": 16, "batch_size": 16, "n_epochs": 1},
    "total_steps": 16,
    "action_repeat": 4,
    "arms": {"unfiltered": {"filter": "none"}, "filtered": {"filter": "protect"}},
    "seeds": [0],
}


def test_all_arms_observe_the_same_features():
    alone = sw.FilterObservation(sw.protect(gym.make("SafePointGoal1-v0"))).reset(seed=3)[0]
    for arm in parse_experiment(SEEN).arms:
        for used in (arm.filter, FilterConfig()):
            np.testing.assert_array_equal(make_stack(arm.env, used).reset(seed=3)[0], alone)


def test_a_policy_acts_in_evaluation_as_it_was_trained(tmp_path):
    """Beside SB3's own `predict` in a loop over ActionRepeat."""
    arm = parse_experiment(SEEN).arms[1]
    envs = make_vec_env(arm)
    envs.reset()
    dones = [envs.step(np.zeros((1, 2), dtype=np.float32))[2][0] for _ in range(13)]
    assert dones[-1] and not any(dones[:-1])  # its steps are the policy's
    train_run(arm, 0, tmp_path, SILENT)
    evaluate_run(arm, 0, tmp_path, EvaluationConfig(episodes=2, seed=7), arm.filter, SILENT)
    rows = read_rows(evaluation_folder(tmp_path) / "filter_on.csv")
    policy = TrainedPolicy(arm, finished_checkpoint(arm, 0, tmp_path).folder)
    env = sw.FilterObservation(sw.protect(gym.make("SafePointGoal1-v0", max_episode_steps=50)))
    env = sw.ActionRepeat(sw.RecordInterventions(env), 4)
    for seed, row in zip((7, 8), rows, strict=True):
        observation, _ = env.reset(seed=seed)
        truncated = False
        while not truncated:
            action = policy.model.predict(observation, deterministic=True)[0]
            observation, _, _, truncated, info = env.step(action)
        assert float(row["return"]) == pytest.approx(info["interventions"]["return"], abs=1e-12)
        assert float(row["length"]) == 50
    held = evaluated_steps(tmp_path, "filter_on").proposed[:48].reshape(12, 4, 2)
    assert (held == held[:, :1]).all()
    policy.deterministic = False
    policy.reset()
    first = policy(observation)
    policy.reset()
    assert not np.array_equal(policy(observation), first)


def test_fetch_reach_is_trained_and_evaluated_by_its_plain_id(fake_experiment):
    pytest.importorskip("gymnasium_robotics")
    experiment = fake_experiment(
        "env=FetchReach-v4",
        "arms={filtered: {filter: {protect: {}}}}",
        "hyperparameters={n_steps: 50, batch_size: 50, n_epochs: 1}",
        "total_steps=100",
        "evaluation.episodes=1",
    )
    folder = trained(experiment, 0)
    (row,) = read_rows(evaluated(experiment, 0) / "filter_on.csv")
    assert finish(folder)["timesteps"] == 100 and row["length"] == 50
    model = load_model(latest_checkpoint(folder / "checkpoints").folder, "PPO", "cpu")
    assert type(model.policy).__name__ == "MultiInputActorCriticPolicy"  # its observations are dicts
    code = (  # a new process registers the id when it is asked for
        "import gymnasium as gym; from safe_wrappers.train.config import check_env_id;"
        "assert 'FetchReach-v4' not in gym.registry; check_env_id('FetchReach-v4');"
        "assert 'FetchReach-v4' in gym.registry"
    )
    subprocess.run([sys.executable, "-c", code], check=True, timeout=60)


# A price on cost that changes in training -------------------------------------------------------------------------

LIMIT = "arms.unfiltered.learner={cost_limit: 0, multiplier_rate: 0.01}"


def test_the_price_on_cost_rises_where_there_is_a_limit_and_goes_on_from_a_checkpoint(
    fake_experiment, monkeypatch
):
    found = {}

    class Watch(BaseCallback):
        def _on_step(self):
            found[self.num_timesteps] = self.model.lagrangian_multiplier
            return True

    made = training.learner_callbacks
    monkeypatch.setattr(training, "learner_callbacks", lambda arm: [*made(arm), Watch()])
    trained(fake_experiment(LIMIT, "total_steps=384"), 0)
    stood = found[max(found)]
    assert stood > 0.0
    found.clear()
    trained(fake_experiment(LIMIT, "total_steps=512"), 0)
    assert found[min(found)] == stood


# Who judges a task that reports no cost: nobody, a function, or the filter's own limits ----------------------------


def slow_joints(env, mass=1.0, delay_s=0.0):
    plant = sw.MujocoPlant(delay_s=delay_s)
    plant.perturb(mass=mass)
    return sw.CBFActionFilter(env, [sw.constraints.JointSpeedLimit(4.0)], plant=plant, margin=0.5)


def slow_pendulum(env, delay_s=0.0):
    plant = sw.AnalyticPlant(
        f=lambda x: np.array([x[1], 15 * np.sin(x[0])]),
        g=lambda x: np.array([[0.0], [3.0]]),
        state=lambda env: env.state,
        control_dt=0.05,
        delay_s=delay_s,
    )
    constraint = sw.constraints.Barrier(lambda x: 4.0 - x[1] ** 2, alpha=2.0)
    return sw.CBFActionFilter(env, [constraint], plant=plant)


class RowsOnly(sw.Constraint):
    """A constraint without an h."""

    def rows(self):
        return None


def without_h(env):
    return sw.CBFActionFilter(env, [sw.constraints.JointSpeedLimit(4.0), RowsOnly()])


def judged(env_id, factory, **kwargs):
    judge = FilterConfig(factory=factory if ":" in factory else f"{__name__}:{factory}", kwargs=kwargs)
    return make_stack(EnvConfig(env_id, judge=judge), FilterConfig())


@pytest.mark.parametrize(
    ("env_id", "factory", "kwargs", "limit"),
    [
        # To the limit itself, the filter's margin not taken off; whatever model and delay the filter has.
        ("Reacher-v5", "slow_joints", {"mass": 2.0, "delay_s": 0.02}, 4.0),
        ("Pendulum-v1", "slow_pendulum", {}, 2.0),  # through the plant of the user
    ],
)
def test_the_filters_limits_judge_the_true_state_in_the_unfiltered_arm(env_id, factory, kwargs, limit):
    env = judged(env_id, factory, **kwargs)
    env.reset(seed=0)
    rng, seen = np.random.default_rng(0), []
    for _ in range(50):
        cost = env.step(rng.choice([env.action_space.low, env.action_space.high]))[4][keys.COST]
        task = env.unwrapped
        speeds = task.state[1:] if env_id == "Pendulum-v1" else task.data.qvel[:2]
        assert type(cost) is float and cost == float((np.abs(speeds) > limit + 1e-6).any())
        seen.append(cost)
    assert set(seen) == {0.0, 1.0}


def test_a_judge_that_reads_the_observation_is_given_it():
    env = make_stack(EnvConfig("Pendulum-v1", judge=FilterConfig(protect={})), FilterConfig())
    env.reset(seed=0)
    for _ in range(25):  # full torque one way takes it beyond the recipe's 6 rad/s
        observation, *_, info = env.step(np.array([2.0], np.float32))
        assert info[keys.COST] == float(abs(observation[2]) > 6.0)


@pytest.mark.parametrize(
    ("env_id", "factory", "kwargs", "message"),
    [
        ("Reacher-v5", "without_h", {}, r"env.judge: RowsOnly has no h .* cannot judge; use env.cost"),
        (
            "Pendulum-v1",
            "slow_pendulum",
            {"delay_s": 0.05},
            "env.judge: the filter's plant looks 0.05 s ahead",
        ),
        ("Pendulum-v1", "gymnasium:Wrapper", {}, "env.judge: the filter has no constraints and plant"),
    ],
)
def test_what_cannot_judge_is_refused(env_id, factory, kwargs, message):
    with pytest.raises(sw.SafeWrappersError, match=message):
        judged(env_id, factory, **kwargs)


def reported(experiment):
    """An experiment's summary, its table on the terminal, and its page, once it has run."""
    for at in range(len(experiment.arms)):
        trained(experiment, at)
        evaluated(experiment, at)
    summary = summarize(experiment)
    write_summary(summary, experiment.folder)
    console = Console(file=io.StringIO(), width=200)
    console.print(comparison_table(experiment, summary))
    return summary, " ".join(console.file.getvalue().split()), write_report(experiment, summary).read_text()


SHORT = ("seeds=[0]", "total_steps=128", "evaluation.episodes=2")


def test_what_nobody_judged_is_nowhere_zero(fake_experiment):
    experiment = fake_experiment("env=fake_task:SilentGoal-v0", *SHORT)
    summary, table, page = reported(experiment)
    for arm in experiment.arms:
        folder = experiment.run_folder(arm, 0)
        for path in (folder / "episodes.csv", folder / "evaluation" / "filter_off.csv"):
            for row in read_rows(path):
                assert not {"cost", "cost_substep", "violations", "collisions", "spin_outs"} & row.keys()
                assert not {"lease_refused", "lease_braking"} & row.keys() and row["length"] == 20
        events = EventAccumulator(str(folder / "tensorboard"))
        events.Reload()
        written = {
            tag for tag in events.Tags()["scalars"] if tag.startswith(("interventions/", "evaluation"))
        }
        assert {"interventions/goals_reached", "evaluation_filter_off/return"} <= written
        assert not [tag for tag in written if "cost" in tag or "violations" in tag or "lease" in tag]
        assert ("interventions/infeasible" in written) == (arm.name == "filtered")
        assert "evaluation_filter_on/infeasible" in written
        assert (
            not {f"evaluation_filter_off/{key}" for key in ("infeasible", "unsafe", "correction_mean")}
            & written
        )
    with (experiment.folder / "per_seed.csv").open() as file:
        assert all(row["violations"] == row["cost"] == "" for row in csv.DictReader(file))
    text = (experiment.folder / "summary.json").read_text()
    assert "cost" not in text and "NaN" not in text and json.loads(text)
    assert "Steps in violation, total │ not judged │ not judged" in table and not summary.judged
    said = "Violations are not judged: the task reports no cost."
    assert said in table and said in page and said in " ".join(verdict(experiment, summary))
    assert "of 40 steps in violation" not in page


def test_a_cost_function_judges_training_and_evaluation_as_the_task_would(fake_experiment):
    only = "arms={unfiltered: {filter: none}}"
    own = fake_experiment("name=own", only, *SHORT)
    silent = "{id: 'fake_task:SilentGoal-v0', cost: 'fake_task:in_hazard'}"
    given = fake_experiment("name=given", f"env={silent}", only, *SHORT)
    (expected, _, page), (summary, table, own_page) = reported(own), reported(given)
    names = ("violations", "violations_per_1000", "cost", "return")
    for condition in ("training", "filter_off"):
        cell, there = summary.table["unfiltered"][condition], expected.table["unfiltered"][condition]
        assert [cell[name] for name in names] == [there[name] for name in names]
    assert sum(row["violations"] for row in summary.per_seed) > 0
    assert "Cost in substeps" not in table and "not judged" not in table  # it judges the ends of steps
    label = "Violations are judged by fake_task:in_hazard at the end of each step"
    assert label in table and label in own_page and label not in page
