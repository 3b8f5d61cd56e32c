"""Paired evaluation: the same episodes for every arm, their recorded steps, who judges, what it comes to."""

import csv
import io
import itertools
import json
import re

import gymnasium as gym
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from rich.console import Console
from running import episode, evaluated, scalars, steps, trained, write_evaluation, write_training
from scipy import stats

import safe_wrappers as sw
from safe_wrappers import info as keys
from safe_wrappers.errors import RunStateError
from safe_wrappers.train.cli import main
from safe_wrappers.train.config.models import EnvConfig, FilterConfig
from safe_wrappers.train.evaluation import step_log
from safe_wrappers.train.evaluation.evaluate import compared_pairs, shown_episode
from safe_wrappers.train.evaluation.step_log import StepRecorder, coordinates_of, load_steps, pool, save_steps
from safe_wrappers.train.evaluation.summary import (
    Estimate,
    estimate,
    interquartile_mean,
    learning_curve,
    summarize,
    write_summary,
)
from safe_wrappers.train.files import read_rows
from safe_wrappers.train.report import comparison_table, verdict, write_report
from safe_wrappers.train.run import Progress
from safe_wrappers.train.run.stack import make_stack


def test_every_arm_sees_the_same_episodes_and_the_steps_agree_with_the_table(kept):
    starts, changed = [], 0
    for arm in kept.arms:
        folder = kept.run_folder(arm, 0)
        for condition in ("filter_off", "filter_on"):
            rows = read_rows(folder / "evaluation" / f"{condition}.csv")
            log = load_steps(folder / "evaluation" / f"{condition}_steps.npz")
            assert [row["episode_seed"] for row in rows] == [100, 101, 102]
            assert len(log) == sum(row["length"] for row in rows)
            assert all(("intervention_rate" in row) == (condition == "filter_on") for row in rows)
            for row in rows:
                at = log.episode_seed == row["episode_seed"]
                assert log.step[at].tolist() == list(range(int(row["length"])))
                assert log.intervened[at].mean() == pytest.approx(row.get("intervention_rate", 0))
                assert log.correction[at].mean() == pytest.approx(row.get("correction_mean", 0))
                assert log.violated[at].sum() == row["violations"]
                changed += log.intervened[at].sum()
            assert condition == "filter_off" or not log.violated.any()
            starts.append(log.coordinates[log.step == 0].tolist())
    assert starts == [starts[0]] * 4 and len({tuple(start) for start in starts[0]}) == 3
    assert changed > 0
    logged = scalars(folder)
    assert "evaluation_filter_off/cost" in logged
    mean = pytest.approx(np.mean([row["return"] for row in rows]))
    assert logged["evaluation_filter_on/return"] == [(512, mean)]


def test_it_is_done_once_and_again_when_its_settings_change_or_a_kill_left_a_half(finished, fake_experiment):
    folder = evaluated(finished())
    before = (folder / "filter_on.csv").stat().st_mtime_ns
    evaluated(finished())
    assert (folder / "filter_on.csv").stat().st_mtime_ns == before

    def kill(done):
        if done == 5:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):  # between the conditions
        evaluated(finished("evaluation.episodes=4"), progress=Progress(kill, pytest.fail))
    evaluated(finished())  # the first settings again: their rows are gone, so they are made anew
    assert len(read_rows(folder / "filter_off.csv")) == len(read_rows(folder / "filter_on.csv")) == 3
    evaluated(finished("evaluation.episodes=4"))
    assert len(read_rows(folder / "filter_on.csv")) == 4
    assert json.loads((folder / "evaluation.json").read_text())["settings"]["episodes"] == 4
    with pytest.raises(RunStateError, match="is not trained to its end"):
        evaluated(fake_experiment("name=untrained"))


# What is recorded of a step ---------------------------------------------------------------------------------------


def record(env, actions, seed=0):
    """Runs the actions; returns the log and the infos."""
    recorder, infos = StepRecorder(env), []
    observation, _ = env.reset(seed=seed)
    recorder.begin(seed)
    for action in actions:
        recorder.before(observation)
        observation, _, _, _, info = env.step(action)
        recorder.after(action, info)
        infos.append(info)
    return recorder.finish(), infos


def test_the_filters_word_is_taken_down_step_by_step(tmp_path):
    limits = [sw.constraints.JointSpeedLimit(limit=4.0), sw.constraints.JointSpeedLimit(limit=2.0)]
    env = sw.CBFActionFilter(gym.make("Reacher-v5"), limits)
    actions = np.random.default_rng(0).uniform(-1, 1, (40, 2)).astype(np.float32)
    log, infos = record(sw.RecordInterventions(env), actions)
    save_steps(tmp_path / "steps.npz", log)
    log = load_steps(tmp_path / "steps.npz")
    assert list(log.constraint_names) == env.constraint_names
    for name, key in (
        ("intervened", keys.CBF_INTERVENED),
        ("refused", keys.CBF_REFUSED),
        ("proposed", keys.PROPOSED_ACTION),
        ("correction", keys.CBF_CORRECTION),
    ):
        assert getattr(log, name) == pytest.approx(np.array([info[key] for info in infos])), name
    # The tighter limit refuses whatever the wider one refuses, and more.
    assert log.refused.shape == (40, 2) and log.refused[:, 1].sum() > log.refused[:, 0].sum()
    assert (log.refused.any(axis=1) == log.intervened).all()
    # The state in which the step began, not the one after it.
    assert log.coordinates[0, 4:6] == pytest.approx(env.unwrapped.init_qvel[:2], abs=0.01)
    assert (tmp_path / "steps.npz").stat().st_size < 20_000


def test_without_a_filter_nothing_was_done_and_what_is_beyond_the_cap_is_counted(monkeypatch):
    monkeypatch.setattr(step_log, "MOST_STEPS", 3)
    log, _ = record(gym.make("SafePointGoal1-v0"), np.full((5, 2), 0.5, np.float32))
    assert (len(log), log.left_out) == (3, 2)
    assert not (log.intervened.any() or log.violated.any()) and (log.proposed == 0.5).all()
    assert log.refused.shape == (3, 0) and len(log.constraint_names) == 0


def test_seeds_are_pooled_and_different_tasks_are_not():
    one, two = steps(10), steps(20, left_out=5)
    both = pool([one, two])
    assert (len(both), both.left_out) == (30, 5)
    assert both.coordinates[10:] == pytest.approx(two.coordinates)
    assert pool([]) is None
    assert pool([one, steps(10, coordinate_names=np.array(["a", "b", "c"]))]) is None
    assert pool([one, steps(10, constraint_names=np.array(["Other"]))]) is None


def test_coordinates_are_joints_by_name_with_the_turns_taken_off():
    env = gym.make("Reacher-v5")
    observation, _ = env.reset(seed=0)
    names, read = coordinates_of(env)
    positions = ["joint0, position (rad)", "joint1, position (rad)", "target_x, position (m)"]
    speeds = ["joint0, speed (rad/s)", "joint1, speed (rad/s)", "target_x, speed (m/s)"]
    assert (names[:3], names[4:7]) == (positions, speeds)
    qpos = np.array([0.3 + 4 * np.pi, 2.9, 0.1, -0.1])
    env.unwrapped.set_state(qpos, np.array([7.0, -3.0, 0.0, 0.0]))
    # joint1 has limits, so its angle stays as it is; joint0 has gone round twice.
    assert read(observation) == pytest.approx([0.3, 2.9, 0.1, -0.1, 7.0, -3.0, 0.0, 0.0])
    assert env.unwrapped.data.qpos == pytest.approx(qpos)  # looked at, not touched
    env = gym.make("Ant-v5")  # on a free joint, which is named part by part
    values, data = dict(zip(*told(env), strict=True)), env.unwrapped.data
    found = values["root, position 2"], values["root, speed 5"], values["hip_1, position (rad)"]
    assert found == pytest.approx((data.qpos[2], data.qvel[5], data.qpos[7]))
    assert len(values) == data.qpos.size + data.qvel.size


def told(env):
    """Names and values of the coordinates at a start."""
    observation, _ = env.reset(seed=0)
    names, read = coordinates_of(env)
    return names, read(observation)


def test_without_joints_they_are_a_place_the_observation_or_nothing():
    env = gym.make("SafePointGoal1-v0")
    names, values = told(env)
    assert list(names) == ["x (m)", "y (m)"] and values == pytest.approx(env.unwrapped.agent_position)
    env = gym.make("Pendulum-v1")
    names, values = told(env)
    assert list(names) == [f"observation {i}" for i in range(3)]
    assert values[2] == pytest.approx(env.unwrapped.state[1])
    names, values = told(gym.make("FrozenLake-v1"))
    assert len(names) == len(values) == 0


# Who judges a task that reports no cost: nobody, a function, or the filter's own limits ----------------------------


@pytest.mark.parametrize(
    ("env_id", "judge", "limit"),
    [
        # To the limit itself, the filter's margin not taken off; whatever model and delay the filter has.
        ("Reacher-v5", {"factory": "fake_task:slow_joints", "kwargs": {"mass": 2.0, "delay_s": 0.02}}, 4.0),
        ("Pendulum-v1", {"factory": "fake_task:slow_pendulum"}, 2.0),  # through the plant of the user
        ("Pendulum-v1", {"protect": {}}, 6.0),  # which reads the observation
    ],
)
def test_the_filters_limits_judge_the_true_state_in_the_unfiltered_arm(env_id, judge, limit):
    env = make_stack(EnvConfig(env_id, judge=FilterConfig(**judge)), FilterConfig())
    env.reset(seed=0)
    task, speeds, seen = env.unwrapped, np.ones(1), []
    for _ in range(50):  # pushed the way that it goes
        cost = env.step(np.where(speeds > 0, env.action_space.high, env.action_space.low))[4][keys.COST]
        speeds = task.state[1:] if env_id == "Pendulum-v1" else task.data.qvel[:2]
        assert type(cost) is float and cost == float((np.abs(speeds) > limit + 1e-6).any())
        seen.append(cost)
    assert set(seen) == {0.0, 1.0}


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


def test_what_nobody_judged_is_nowhere_zero(fake_experiment, capsys):
    experiment = fake_experiment("env=fake_task:SilentGoal-v0", *SHORT)
    summary, table, page = reported(experiment)
    for arm in experiment.arms:
        folder = experiment.run_folder(arm, 0)
        for path in (folder / "episodes.csv", folder / "evaluation" / "filter_off.csv"):
            for row in read_rows(path):
                assert not {"cost", "cost_substep", "violations", "collisions", "spin_outs"} & row.keys()
                assert not {"lease_refused", "lease_braking"} & row.keys() and row["length"] == 20
        written = {tag for tag in scalars(folder) if tag.startswith(("interventions/", "evaluation"))}
        assert {"interventions/goals_reached", "evaluation_filter_off/return"} <= written
        assert not [tag for tag in written if "cost" in tag or "violations" in tag or "lease" in tag]
        assert ("interventions/infeasible" in written) == (arm.name == "filtered")
        of_filter = {
            tag.removeprefix("evaluation_")
            for tag in written
            if re.search("infeasible|unsafe|correction", tag)
        }
        assert "filter_on/infeasible" in of_filter and not {tag for tag in of_filter if "filter_off" in tag}
    with (experiment.folder / "per_seed.csv").open() as file:
        assert all(row["violations"] == row["cost"] == "" for row in csv.DictReader(file))
    text = (experiment.folder / "summary.json").read_text()
    assert "cost" not in text and "NaN" not in text and json.loads(text) and not summary.judged
    assert "Steps in violation, total │ not judged │ not judged" in table
    said = "Violations are not judged: the task reports no cost."
    assert said in table and said in page and said in " ".join(verdict(experiment, summary))
    assert "No finished training episode" not in page  # there are, which nobody judged
    assert main(["enjoy", str(folder), "--episodes", "1"]) == 0
    told = capsys.readouterr().out
    assert "20 steps" in told and "in violation" not in told
    # The page's note; cost and violations of two arms in three conditions.
    assert page.partition("In numbers")[2].partition("The same episode")[0].count("not judged") == 1 + 2 * 6


def test_a_cost_function_judges_training_and_evaluation_as_the_task_would(fake_experiment):
    only = "arms={unfiltered: {filter: none}}"
    own = fake_experiment("name=own", only, *SHORT)
    silent = "{id: 'fake_task:SilentGoal-v0', cost: 'fake_task:in_hazard'}"
    given = fake_experiment("name=given", f"env={silent}", only, *SHORT)
    (expected, _, page), (summary, table, own_page) = reported(own), reported(given)
    for condition in ("training", "filter_off"):
        cell, there = summary.table["unfiltered"][condition], expected.table["unfiltered"][condition]
        for name in ("violations", "violations_per_1000", "cost", "return"):
            assert cell[name] == there[name]
    assert sum(row["violations"] for row in summary.per_seed) > 0
    assert "Cost in substeps" not in table and "not judged" not in table  # it judges the ends of steps
    label = "Violations are judged by fake_task:in_hazard at the end of each step"
    assert label in table and label in own_page and label not in page


# What is shown of it ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("returns", "typical"), [((1.0, 9.0, 5.0), 102), ((4.0, 3.0, 1.0, 2.0), 103), ((2.0, 2.0), 100)]
)
def test_the_episode_with_the_median_return_is_shown(fake_experiment, returns, typical):
    rows = [{**episode(), "return": value} for value in returns]
    experiment = fake_experiment()
    write_evaluation(experiment, 1, 0, "filter_on", rows)
    shown = shown_episode(experiment)
    assert (shown.seed, shown.episode_seed) == (0, typical)
    assert "“filtered” with the filter on" in shown.reason
    bare = fake_experiment("name=bare", "arms={one: {filter: none}, two: {filter: none}}")
    write_evaluation(bare, 0, 0, "filter_off", rows)
    assert shown_episode(bare).episode_seed == typical


def test_the_headline_compares_arms_of_one_env(fake_experiment):
    def names(*overrides):
        pairs = compared_pairs(fake_experiment(*overrides))
        return [(pair.bare.name, pair.filtered.name) for pair in pairs]

    bare = "arms={one: {filter: none}, two: {filter: none}}"
    assert names() == [("unfiltered", "filtered")]
    assert names("arms.unfiltered.env=Pendulum-v1") == [("filtered", "filtered")]
    assert names(bare) == []
    assert names(bare, "evaluation.filter={factory: 'fake_task:shield'}") == [("one", "one"), ("two", "two")]


# Numbers over seeds -----------------------------------------------------------------------------------------------


@given(st.lists(st.floats(-1e6, 1e6), min_size=1, max_size=20))
def test_the_interquartile_mean_is_that_of_the_middle_half(values):
    cut = len(values) // 4
    expected = np.mean(sorted(values)[cut : len(values) - cut])
    assert interquartile_mean(values) == pytest.approx(expected, abs=1e-6)
    assert interquartile_mean(np.array([values, values]), axis=1) == pytest.approx([expected] * 2, abs=1e-6)


@pytest.mark.parametrize("seeds", [3, 5])
def test_the_interval_has_95_percent_of_all_resamples(seeds):
    values = np.random.default_rng(seeds).normal(size=seeds)
    means = stats.trim_mean(list(itertools.product(values, repeat=seeds)), 0.25, axis=1)
    found = estimate(values)
    assert found.iqm == pytest.approx(stats.trim_mean(values, 0.25))
    for bound, share in ((found.low, 0.025), (found.high, 0.975)):  # but for what is drawn of them
        assert (means < bound - 1e-9).mean() - 0.005 <= share <= (means <= bound + 1e-9).mean() + 0.005
    assert estimate(values) == found  # not another interval at each look
    # The range of two, and none of one.
    assert estimate([0.0] * 3) == Estimate(0.0, 0.0, 0.0, 3)  # nothing that a bootstrap could draw
    assert estimate([3.0]) == Estimate(3.0, None, None, 1) and str(estimate([3.0])) == "3 [n/a]"
    assert estimate([1.0, 2.0]) == Estimate(1.5, 1.0, 2.0, 2) and str(estimate([1.0, 2.0])) == "1.5 [1, 2]"


def test_summary_of_rows(fake_experiment):
    experiment = fake_experiment()
    ten = {"length": 10}
    for seed, cost in ((0, 2.0), (1, 4.0)):
        rows = [
            episode(cost=cost, violations=3, timesteps=10, **ten),
            episode(violations=1, timesteps=20, **ten),
        ]
        write_training(experiment, 0, seed, rows)
        write_training(experiment, 1, seed, [episode(intervention_rate=0.5, timesteps=10, **ten)])
    write_evaluation(experiment, 0, 0, "filter_on", [episode(**{"return": 7})])
    summary = summarize(experiment)
    bare, filtered = summary.table["unfiltered"], summary.table["filtered"]
    assert bare["training"]["cost"] == Estimate(1.5, 1.0, 2.0, 2)  # mean over episodes, then over seeds
    assert bare["training"]["violations"].iqm == 4.0  # a total
    assert bare["training"]["violations_per_1000"].iqm == 1000.0 * 4 / 20  # over all steps, not over episodes
    assert not {"intervention_rate", "infeasible_per_1000"} & bare["training"].keys()  # no filter was on
    assert filtered["training"]["infeasible_per_1000"].iqm == 0.0
    assert filtered["training"]["intervention_rate"].iqm == 0.5
    assert bare["filter_on"]["return"] == Estimate(7.0, None, None, 1)
    assert filtered["filter_on"] == bare["filter_off"] == {}

    write_summary(summary, experiment.folder)
    with (experiment.folder / "per_seed.csv").open() as file:
        per_seed = list(csv.DictReader(file))
    assert [(row["arm"], row["seed"], row["condition"]) for row in per_seed] == [
        ("unfiltered", "0", "training"),
        ("unfiltered", "1", "training"),
        ("unfiltered", "0", "filter_on"),
        ("filtered", "0", "training"),
        ("filtered", "1", "training"),
    ]
    assert (per_seed[1]["cost"], per_seed[1]["steps"], per_seed[1]["episodes"]) == ("2.0", "20", "2")
    saved = json.loads((experiment.folder / "summary.json").read_text())["unfiltered"]["training"]["cost"]
    assert saved == {"iqm": 1.5, "low": 1.0, "high": 2.0, "seeds": 2, "spread": "range"}


def test_learning_curve(fake_experiment):
    experiment = fake_experiment()
    for seed in (0, 1):
        rows = [episode(timesteps=10 * t, cost=t + 2 * seed) for t in range(1, 101)]
        write_training(experiment, 0, seed, rows)
    curve = learning_curve(experiment, experiment.arms[0], "cost")
    assert len(curve.steps) == 40 and np.all(np.diff(curve.iqm) > 0)
    assert curve.iqm[0] == pytest.approx(1.5 + 1)  # episodes 1 and 2 of either seed
    assert curve.low[-1] == pytest.approx(curve.iqm[-1] - 1)
    assert curve.high[-1] == pytest.approx(curve.iqm[-1] + 1)
    # Fewer bins where a seed has few episodes; none at all where a seed has none.
    rows = [episode(timesteps=at, cost=cost) for at, cost in ((500, 1), (501, 5), (1000, 3))]
    write_training(experiment, 0, 1, rows)
    curve = learning_curve(experiment, experiment.arms[0], "cost")
    assert len(curve.steps) == 2 and curve.seeds[1] == pytest.approx([1, 4])  # a bin's right end is its own
    assert learning_curve(experiment, experiment.arms[1], "cost") is None
