"""The timed benchmarks: what they compare takes the same steps, and they report what they looked for."""

import math

import gymnasium as gym
import numpy as np
import pytest

import safe_wrappers as sw
from benchmarks import bench, env_step, many_envs, mujoco_drivers, peers, scaling, wrapper_cost
from benchmarks.cases import PROTECTED


def test_inactive_and_active_steps_are_told_apart():
    quiet = env_step.measure("Reacher-v5", env_step.gentle, sw.protect, active=False, steps=60)
    pushed = env_step.measure("Reacher-v5", mujoco_drivers.speed_seeking, sw.protect, active=True, steps=60)
    assert quiet.share == 1.0 and pushed.share > 0.5
    assert 1.0 < quiet.ratio < pushed.ratio
    assert 0.0 < quiet.without_us < quiet.with_us
    assert quiet.infeasible == 0.0 and math.isnan(quiet.correction) and pushed.correction > 0.1


def test_both_envs_take_the_same_steps(monkeypatch):
    made = []
    case = PROTECTED["Reacher-v5"]

    def make():
        made.append(gym.make(case.env_id))
        return made[-1]

    monkeypatch.setitem(env_step.PROTECTED, "Reacher-v5", FakeCase(make))
    env_step.measure("Reacher-v5", mujoco_drivers.pulse, sw.protect, active=True, steps=120)
    one, other = (env.unwrapped.data for env in made)
    assert np.array_equal(one.qpos, other.qpos) and np.array_equal(one.qvel, other.qvel)


class FakeCase:
    past_termination = False

    def __init__(self, make):
        self.make = make


def test_runners_get_a_lower_limit_and_nothing_else():
    env = gym.make("SafeAntVelocity-v0")
    (usual,), (lower,) = sw.protect(env).constraints, env_step.slower(0.3)(env).constraints
    assert lower.limit == 0.3 and usual.limit == 2.6222
    assert (lower.direction, lower.horizon, lower.margin) == (usual.direction, usual.horizon, usual.margin)


def test_every_timed_env_is_a_case():
    assert set(env_step.ACTIVE) <= set(PROTECTED)


def test_many_envs_are_timed_alike_and_the_attacking_driver_is_changed():
    quiet, attacked = (many_envs.measure(2, driver, steps=100) for driver in many_envs.DRIVEN)
    assert quiet[3] == 0.0 < attacked[3]
    assert min(quiet) >= 0.0 < min(attacked)


@pytest.mark.parametrize("active", [False, True])
def test_peers_get_problems_that_are_active_or_not(active):
    for u, normals, offsets, low, high in peers.problems(2, 8, active, count=20):
        status = sw.project(u, normals, offsets, low, high).status
        assert status == ("projected" if active else "inactive")
    env = peers.DoubleIntegrator()
    filtered = peers.wall_filter(env, constraints=2)
    for env.x, u in peers.states(active)[:20]:
        assert filtered.step(u)[4]["cbf/intervened"] == active


def test_a_row_of_the_table_compares_with_the_version_before():
    times = {"ours": 2.0, "other": 8.0}
    (row,) = bench.peer_rows(times, {"ours": 4.0, "other": 8.0}).values()
    old = row | {"inactive": 0.5, "active": 0.25}
    assert bench.line("a", "b", row, old) == "| a | b | 2 | 4 | 0.25 | 0.50 |  |  | 0.50 / 2.00 |"
    steps = row | {"infeasible": 0.125, "correction": 0.3}
    assert bench.line("a", "b", steps, None) == "| a | b | 2 | 4 | 0.25 | 0.50 | 12.5% | 0.3 |  |"


def test_rows_are_chosen_by_words(monkeypatch):
    monkeypatch.setattr(bench, "env_row", lambda name, steps: {"name": name})
    monkeypatch.setattr(bench.many_envs, "measure", lambda n, driver: (50.0, 1.5, 2.0, 0.25))
    (_, _, row), *_ = bench.measured(["64 envs"], 1)
    assert row["inactive_us"] == 75.0 and row["active"] == 1.5 and row["active_share"] == 0.25
    assert [row for row, _, _ in bench.measured(["Goal1-v0"], 1)] == [
        "SafePointGoal1-v0",
        "SafeCarGoal1-v0",
        "SafePointGoal1-v0, 64 envs",
    ]


@pytest.mark.parametrize("name", ["discs", "look-ahead"])
def test_decisions_are_timed_at_every_size(monkeypatch, name):
    monkeypatch.setattr(scaling, "STEPS", 20)
    measure, counts = scaling.GROWTH[name]
    assert min(measure(counts[0]), measure(counts[-1])) > 0.0


@pytest.mark.slow
def test_trainings_in_turn():
    pytest.importorskip("stable_baselines3")
    from benchmarks import training_time

    found = training_time.compare("pointgoal1_300k", steps=1)
    assert found["steps"] == 1024
    assert found["filtered_s"] > 0.0 and found["without_s"] > 0.0
    assert found["median"] == pytest.approx(found["filtered_s"] / found["without_s"])


@pytest.mark.filterwarnings("ignore:a command was held back")
@pytest.mark.parametrize(
    ("env_id", "name", "wrap"),
    wrapper_cost.ROWS,
    ids=[f"{env}: {name}" for env, name, _ in wrapper_cost.ROWS],
)
def test_every_wrapper_is_timed_per_control_step(env_id, name, wrap):
    without, with_it = wrapper_cost.measure(env_id, wrap, rounds=2, batch=16)
    assert min(without, with_it) > 0.0
    env = wrap(gym.make(env_id))
    step, steps = wrapper_cost.driver(env)
    step()
    counted = round(env.unwrapped.data.time / env.unwrapped.dt)
    assert counted == steps and name.startswith(type(env).__name__.replace("Outages", "LeaseExpiry"))


def test_random_chunks_all_need_their_blend():
    env = wrapper_cost.bounded("smoothstep")(gym.make("Reacher-v5"))
    env.reset(seed=0)
    env.action_space.seed(0)
    with pytest.warns(UserWarning, match="held back"):
        infos = [env.step(env.action_space.sample())[4] for _ in range(5)]
    assert all(info["handover/blend_time"] > 0.0 for info in infos[1:])
