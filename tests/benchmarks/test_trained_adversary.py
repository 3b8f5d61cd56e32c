"""`python -m benchmarks.trained_adversary` pays for what its judges see, counts it, and trains no env twice."""

import dataclasses
import json
import sys

import numpy as np
import pytest

import safe_wrappers as sw
from benchmarks import trained_adversary
from benchmarks.cases import CASES
from benchmarks.trained_adversary import Adversary, Job, Tally, nearness, run
from safe_wrappers.errors import UnsafeStateWarning

pytest.importorskip("stable_baselines3")
ENV = "Reacher-v5"


def driven(adversary, steps=50):
    """Full torque for an episode: the rewards."""
    adversary.reset(seed=0)
    return [adversary.step(adversary.action_space.high)[1] for _ in range(steps)]


def protected_by(limit):
    """A Reacher whose filter keeps another limit than its judge."""
    return dataclasses.replace(
        CASES[ENV],
        protect=lambda env: sw.CBFActionFilter(env, [sw.constraints.JointSpeedLimit(limit, margin=0.01)]),
    )


def test_nearness_is_worth_as_much_in_the_last_millimetre_as_in_the_last_metre():
    assert nearness(3.0, 2.0) == nearness(2.0, 2.0) == 0.0
    assert nearness(0.2, 2.0) == pytest.approx(0.25) and nearness(0.002, 2.0) == pytest.approx(0.75)
    assert nearness(0.0, 2.0) == nearness(-1.0, 2.0) == pytest.approx(1.0)


@pytest.mark.parametrize("env", trained_adversary.SCALES)
def test_every_env_has_a_judge_and_runs_through_its_filter(env):
    adversary = Adversary(env)
    adversary.reset(seed=0)
    info = adversary.step(adversary.action_space.high)[4]
    tally = adversary.tally
    assert tally.steps == 1 and tally.smallest == info["cbf/margin"] > 0.0


def test_without_a_filter_each_violation_is_paid_and_nothing_else():
    adversary = Adversary(ENV, filtered=False)
    rewards = driven(adversary)
    assert set(rewards) == {0.0, 1.0} and sum(rewards) == adversary.tally.violations > 20
    assert adversary.tally.smallest is None and adversary.tally.unflagged == 0


def test_through_the_recipe_s_filter_only_nearness_is_paid():
    adversary = Adversary(ENV)
    rewards = driven(adversary)
    assert adversary.tally.violations == 0 < adversary.tally.intervened
    assert 0.0 < max(rewards) <= trained_adversary.NEARNESS


def test_a_violation_that_no_flag_tells_of_is_counted_and_can_be_made_again(monkeypatch):
    monkeypatch.setitem(CASES, ENV, protected_by(limit=9.0))
    adversary = Adversary(ENV)
    rewards = driven(adversary)
    tally = adversary.tally
    assert tally.unflagged == tally.violations > 20
    assert max(rewards) > 1.0 and len(tally.examples) == 20
    example, raw = tally.examples[0], adversary.unwrapped
    raw.set_state(np.array(example["qpos"]), np.array(example["qvel"]))
    raw.do_simulation(np.array(example["executed"]), raw.frame_skip)
    assert np.abs(raw.data.qvel[:2]).max() - 5.0 > 0.0 and example["missed"] > 0.0


def test_a_flagged_violation_is_none_of_the_unflagged():
    adversary = Adversary(ENV)
    adversary.reset(seed=0)
    adversary.unwrapped.set_state(np.zeros(4), np.array([8.0, 8.0, 0.0, 0.0]))
    with pytest.warns(UnsafeStateWarning):
        info = adversary.step(adversary.action_space.high)[4]
    assert info["cbf/unsafe"]
    assert adversary.tally.violations == 1 and adversary.tally.unflagged == 0 and not adversary.tally.examples


def test_tallies_add_up():
    one, other = Tally(steps=3, violations=1, smallest=0.2), Tally(steps=2, unsafe=1, smallest=0.1)
    both = one.plus(other)
    assert (both.steps, both.violations, both.unsafe, both.smallest) == (5, 1, 1, 0.1)
    assert one.plus(Tally()).smallest == 0.2 and Tally().plus(Tally()).smallest is None


def test_the_same_seed_is_the_same_training():
    rows = [run(Job(ENV, 2048, 3), episodes=1) for _ in range(2)]
    assert rows[0] | {"seconds": 0.0} == rows[1] | {"seconds": 0.0}
    assert rows[0]["training"]["steps"] == 2048 and rows[0]["deterministic"]["steps"] == 50
    # Judged without the filter, the policy does what it was after.
    assert rows[0]["unfiltered"]["violations"] > 20 and rows[0]["unfiltered"]["smallest"] is None


def test_a_deadline_ends_the_training_where_it_stands():
    row = run(Job(ENV, 1_000_000, 0), minutes=0.02, episodes=1)
    assert 0 < row["training"]["steps"] < 50_000 and row["steps"] == 1_000_000


def test_a_finished_env_is_not_trained_again(monkeypatch, capsys, tmp_path):
    trained = []

    def counting(job, minutes, episodes):
        trained.append((job.env, job.seed))
        tally = dataclasses.asdict(Tally(steps=1000, intervened=250, smallest=0.0042))
        parts = ("training", "deterministic", "stochastic", "unfiltered")
        return dataclasses.asdict(job) | dict.fromkeys(parts, tally)

    def command(*words):
        monkeypatch.setattr(sys, "argv", ["adversary", "--results", str(tmp_path), *words])
        trained_adversary.main()
        return capsys.readouterr().out

    monkeypatch.setattr(trained_adversary, "run", counting)
    first = command("--env", ENV)
    assert command("--env", ENV) == first and trained == [(ENV, 0)]
    command("--env", ENV, "--seed", "1")
    command("--env", ENV, "--seed", "1", "--anew")
    assert trained == [(ENV, 0), (ENV, 1), (ENV, 1)]
    command("--env", ENV, "--seed", "1", "--minutes", "2")
    command("--env", ENV, "--seed", "1", "--minutes", "2")
    assert len(trained) == 4  # what a time limit has cut is not what has none
    whole = command("--seed", "1")
    assert {env for env, _ in trained} == set(trained_adversary.SCALES) and len(trained) == 8
    head, _, *rows = [line.strip("|").split("|") for line in whole.splitlines() if line.startswith("|")]
    assert len(rows) == 16 and all(len(row) == len(head) for row in rows)
    assert (tmp_path / "trained_adversary.md").read_text() == whole
    kept = json.loads((tmp_path / f"trained_adversary_{ENV}.json").read_text())
    assert kept["seed"] == 1 and "25.0%" in whole and "0.0042" in whole
