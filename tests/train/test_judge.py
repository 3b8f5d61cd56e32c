"""Who judges a task that reports no cost: nobody, a function, or the filter's own limits."""

import csv
import io
import json

import numpy as np
import pytest
from rich.console import Console
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

import safe_wrappers as sw
from safe_wrappers import info as keys
from safe_wrappers.train.config import EnvConfig, FilterConfig, parse_experiment
from safe_wrappers.train.evaluation.evaluate import evaluate_run
from safe_wrappers.train.evaluation.summary import summarize, write_summary
from safe_wrappers.train.files import read_rows
from safe_wrappers.train.report import comparison_table, verdict, write_report
from safe_wrappers.train.run import Progress, train_run
from safe_wrappers.train.run.stack import make_stack

SILENT = Progress(lambda steps: None, pytest.fail)
HERE = __name__
SHORT = ("seeds=[0]", "total_steps=128", "evaluation.episodes=2")


# Filters that a config can name -----------------------------------------------------------------------------------


def slow_joints(env, limit=4.0, mass=1.0, delay_s=0.0):
    plant = sw.MujocoPlant(delay_s=delay_s)
    plant.perturb(mass=mass)
    return sw.CBFActionFilter(env, [sw.constraints.JointSpeedLimit(limit)], plant=plant, margin=0.5)


def slow_pendulum(env, delay_s=0.0):
    plant = sw.AnalyticPlant(
        f=lambda x: np.array([x[1], 15 * np.sin(x[0])]),
        g=lambda x: np.array([[0.0], [3.0]]),
        state=lambda env: env.state,
        control_dt=0.05,
        delay_s=delay_s,
    )
    return sw.CBFActionFilter(
        env, [sw.constraints.Barrier(lambda x: 4.0 - x[1] ** 2, alpha=2.0)], plant=plant
    )


class RowsOnly(sw.Constraint):
    """A constraint without an h."""

    def rows(self):
        return None


def without_h(env):
    return sw.CBFActionFilter(env, [sw.constraints.JointSpeedLimit(4.0), RowsOnly()])


# ------------------------------------------------------------------------------------------------------------------


def judged(env_id, factory, action_filter=None, **kwargs):
    judge = FilterConfig(factory=f"{HERE}:{factory}", kwargs=kwargs)
    return make_stack(EnvConfig(env_id, judge=judge), action_filter or FilterConfig())


def drive(env, speeds, steps=50):
    """Bang-bang; the costs, and the true speeds after the steps."""
    env.reset(seed=0)
    costs, seen = [], []
    rng = np.random.default_rng(0)
    for _ in range(steps):
        info = env.step(rng.choice([env.action_space.low, env.action_space.high]))[4]
        assert type(info[keys.COST]) is float
        costs.append(info[keys.COST])
        seen.append(speeds(env.unwrapped).copy())
    return np.array(costs), np.array(seen)


def reacher_speeds(env):
    return env.data.qvel[:2]


def test_the_filters_limits_judge_the_true_state_in_the_unfiltered_arm():
    costs, speeds = drive(judged("Reacher-v5", "slow_joints"), reacher_speeds)
    # To the limit itself: the filter's margin is not taken off.
    over = (np.abs(speeds) > 4.0 + 1e-6).any(axis=1)
    np.testing.assert_array_equal(costs, over)
    assert over.any() and not over.all()


def test_they_judge_the_same_whatever_model_and_delay_the_filter_has():
    wrong = judged("Reacher-v5", "slow_joints", mass=2.0, delay_s=0.02)
    costs, speeds = drive(wrong, reacher_speeds)
    np.testing.assert_array_equal(costs, (np.abs(speeds) > 4.0 + 1e-6).any(axis=1))


def test_a_task_without_a_simulator_is_judged_through_the_plant_of_the_user():
    costs, speeds = drive(judged("Pendulum-v1", "slow_pendulum"), lambda env: env.state[1:])
    over = speeds[:, 0] ** 2 > 4.0 + 1e-6
    np.testing.assert_array_equal(costs, over)
    assert over.any() and not over.all()


@pytest.mark.parametrize(
    ("env_id", "factory", "kwargs", "message"),
    [
        (
            "Reacher-v5",
            "without_h",
            {},
            r"env.judge: RowsOnly has no h \(`h_along`\) and cannot judge; use env.cost",
        ),
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
    judge = FilterConfig(factory=factory if ":" in factory else f"{HERE}:{factory}", kwargs=kwargs)
    with pytest.raises(sw.SafeWrappersError, match=message):
        make_stack(EnvConfig(env_id, judge=judge), FilterConfig())


SETTINGS = {
    "name": "x",
    "env": "Reacher-v5",
    "algorithm": "PPO",
    "total_steps": 64,
    "seeds": [0],
    "arms": {"bare": {}, "safe": {"filter": {"factory": f"{HERE}:slow_joints", "lease": {}}}},
}


def test_limits_cannot_judge_where_there_is_no_filter():
    settings = SETTINGS | {"env": {"id": "Reacher-v5", "judge": "constraints"}, "arms": {"bare": {}}}
    with pytest.raises(
        sw.SafeWrappersError, match=r"env\.judge: there is no filter whose constraints could be used"
    ):
        parse_experiment(settings)
    given = parse_experiment(settings | {"evaluation": {"filter": "protect"}})
    assert given.arms[0].env.judge == FilterConfig(protect={})


# ------------------------------------------------------------------------------------------------------------------


def run(experiment):
    for arm in experiment.arms:
        for seed in experiment.seeds:
            folder = experiment.run_folder(arm, seed)
            train_run(arm, seed, folder, SILENT)
            evaluate_run(arm, seed, folder, experiment.evaluation, experiment.evaluation_filter, SILENT)
    summary = summarize(experiment)
    write_summary(summary, experiment.folder)
    console = Console(file=io.StringIO(), width=200)
    console.print(comparison_table(experiment, summary))
    page = write_report(experiment, summary).read_text()
    return summary, " ".join(console.file.getvalue().split()), page


def tags(folder):
    events = EventAccumulator(str(folder / "tensorboard"))
    events.Reload()
    return {tag for tag in events.Tags()["scalars"] if tag.startswith(("interventions/", "evaluation"))}


def test_what_nobody_judged_is_nowhere_zero(fake_experiment):
    experiment = fake_experiment("env=fake_task:SilentGoal-v0", *SHORT)
    summary, table, page = run(experiment)
    for arm in experiment.arms:
        folder = experiment.run_folder(arm, 0)
        for path in (folder / "episodes.csv", folder / "evaluation" / "filter_off.csv"):
            for row in read_rows(path):
                assert not {"cost", "cost_substep", "violations", "collisions", "spin_outs"} & row.keys()
                assert not {"lease_refused", "lease_braking"} & row.keys()
                assert row["length"] == 20
        written = tags(folder)
        assert {"interventions/goals_reached", "evaluation_filter_off/return"} <= written
        assert not [tag for tag in written if "cost" in tag or "violations" in tag or "lease" in tag]
        filtered = {
            tag for tag in written if tag.endswith(("infeasible", "fallback", "unsafe", "correction_mean"))
        }
        assert ("interventions/infeasible" in filtered) == (arm.name == "filtered")
        assert "evaluation_filter_on/infeasible" in filtered
        assert not [tag for tag in filtered if tag.startswith("evaluation_filter_off")]
    with (experiment.folder / "per_seed.csv").open() as file:
        assert all(row["violations"] == row["cost"] == "" for row in csv.DictReader(file))
    text = (experiment.folder / "summary.json").read_text()
    assert "cost" not in text and "NaN" not in text and json.loads(text)
    assert not summary.judged
    assert "Steps in violation, total │ not judged │ not judged" in table
    assert "Violations are not judged: the task reports no cost." in table
    assert "Violations are not judged: the task reports no cost." in " ".join(verdict(experiment, summary))
    assert "Violations are not judged" in page and "of 40 steps in violation" not in page


def test_a_cost_function_judges_training_and_evaluation_as_the_task_would(fake_experiment):
    own = fake_experiment("name=own", *SHORT)
    silent = "{id: 'fake_task:SilentGoal-v0', cost: 'fake_task:in_hazard'}"
    given = fake_experiment("name=given", f"env={silent}", *SHORT)
    expected, _, page = run(own)
    summary, table, own_page = run(given)
    label = "Violations are judged by fake_task:in_hazard at the end of each step"
    names = ("violations", "violations_per_1000", "cost", "return")
    for arm, conditions in expected.table.items():
        for condition, cell in conditions.items():
            for name in names:
                assert summary.table[arm][condition][name] == cell[name]
    assert sum(row["violations"] for row in summary.per_seed) > 0
    assert "Cost in substeps" not in table and "not judged" not in table  # it judges the ends of steps
    assert label in table and label in own_page and label in " ".join(verdict(given, summary))
    assert label not in page


def test_a_judge_that_reads_the_observation_is_given_it():
    protect = FilterConfig(protect={})
    env = make_stack(EnvConfig("Pendulum-v1", judge=protect), FilterConfig())
    env.reset(seed=0)
    for _ in range(25):  # full torque one way takes it beyond the recipe's 6 rad/s
        observation, *_, info = env.step(np.array([2.0], np.float32))
        assert info[keys.COST] == float(abs(observation[2]) > 6.0)
