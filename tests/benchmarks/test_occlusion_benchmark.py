"""The occlusion benchmark: its counts against a second count, its statistics against known ones, its files."""

import json
import sys
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import safe_wrappers as sw
from benchmarks import occlusion, occlusion_cost
from benchmarks.crossing_drivers import DRIVERS
from benchmarks.occlusion import Episode, Job, collisions_job, consistency_table, episode, phases, violations
from benchmarks.tracked import CROSSING, PATROLLED, crossing
from safe_wrappers.envs.occluded_crossing import CAR_ACCELERATION_NOISE, CAR_SPEED_STD, CAR_TIME_CONSTANT_S

CONFIG = Path(__file__).parents[2] / "configs" / "occluded_crossing_ppo.yaml"


def test_the_tracks_are_those_of_the_trainings_and_of_the_tasks():
    yaml = pytest.importorskip("yaml")
    trained = yaml.safe_load(CONFIG.read_text(encoding="utf-8"))["env"]["occlusion"]
    assert trained == CROSSING
    for track in CROSSING["tracks"]:
        assert track["acceleration_noise"] == [pytest.approx(CAR_ACCELERATION_NOISE), 0]
        assert (track["reversion_s"], track["start_velocity_std"][0]) == (CAR_TIME_CONSTANT_S, CAR_SPEED_STD)


def test_the_patrols_tracks_are_the_tasks():
    pytest.importorskip("gymnasium_robotics")
    from safe_wrappers.envs.patrolled_maze import PATROL_ACCELERATION_NOISE, PATROL_REVERSION_S

    (track,) = PATROLLED["tracks"]
    assert track["acceleration_noise"] == [pytest.approx(PATROL_ACCELERATION_NOISE), 0]
    assert track["reversion_s"] == PATROL_REVERSION_S


def test_an_episode_is_the_envs_truth_less_the_wrappers_estimate():
    found = episode(3, scheduled=False, steps=40)
    env = crossing(gym.make("OccludedCrossing-v0"))
    raw = env.unwrapped
    env.reset(seed=3)
    act = DRIVERS["goal-seeking"](raw, np.random.default_rng(3))
    for step in range(40):
        info = env.step(act())[4]
        for car in range(6):
            at = raw.data.joint(f"car{car}").qpos[0]
            assert found.error[step, car, 0] == at - env.tracking.positions[car, 0]
            assert found.covariance[step, car, 1, 0] == env.tracking.covariance[car, 2, 0]
        assert (found.visible[step] == info["occlusion/visible"]).all()
    assert found.visible.any() and not found.visible.all()


def test_turned_away_it_sees_nothing_and_before_it_does():
    found = episode(1, scheduled=True, steps=175)
    turned = round((occlusion.TURNED_AT_S + occlusion.TURNED_S) / found.step_s)
    assert not found.visible[turned:].any() and found.visible[: turned - 25].any()


def made_up(n=4000, seed=0, scale=1.0):
    """Errors that have the covariance, times a scale, seen by turns of 20 steps."""
    rng = np.random.default_rng(seed)
    covariance = np.broadcast_to([[0.04, 0.01], [0.01, 0.09]], (n, 6, 2, 2))
    error = scale * rng.multivariate_normal(np.zeros(2), covariance[0, 0], (n, 6))
    visible = np.broadcast_to((np.arange(n) // 20 % 2 == 0)[:, None], (n, 6))
    return Episode(error, covariance, visible, 0.04)


def test_shares_beyond_k_sigma_are_those_of_normal_errors():
    for seen, *beyond in violations(made_up()).values():
        shares = np.array(beyond) / max(seen, 1)
        if seen:
            np.testing.assert_allclose(shares, [0.3173, 0.0455, 0.0027], atol=0.01)
    counts = {name: row[0] for name, row in violations(made_up()).items()}
    # 20 steps of 40 ms: 12 and a half of them are later than 0.3 s, none later than 0.8 s.
    assert counts["seen"] == counts["unseen"] == 12_000
    assert counts["unseen for more than 0.5 s"] == 12_000 * 8 / 20
    assert counts["unseen for more than 1 s"] == 0


def test_normalised_errors_are_taken_where_they_are_said_to_be():
    found = made_up(n=100)
    samples = occlusion.nees_samples(found, np.random.default_rng(2))
    track = np.random.default_rng(2).permutation(6)[0]
    # Seen from step 40 on (the first turn is not known to begin at 0), unseen from 20 on.
    for name, index in (("seen for 0.04 s", 40), ("seen for 0.2 s", 44), ("unseen for 0.5 s", 31)):
        error, covariance = found.error[index, track], found.covariance[index, track]
        assert samples[name] == pytest.approx(error @ np.linalg.inv(covariance) @ error)
    assert "unseen for 1 s" not in samples


@pytest.mark.parametrize("scale, inside", [(1.0, "yes"), (1.15, "**no**"), (0.85, "**no**")])
def test_the_band_tells_right_from_wrong_covariances(scale, inside):
    rows = []
    for seed in range(400):
        found = made_up(n=60, seed=seed, scale=scale)
        error = found.error[0, 0]
        nees = error @ np.linalg.solve(found.covariance[0, 0], error)
        row = {"nees": {"unseen for 1 s": float(nees)}, "violations": violations(found)}
        rows.append(row | {"seen_when_turned_away": 0})
    line = next(line for line in consistency_table(rows).splitlines() if line.startswith("| unseen for 1 s"))
    assert line.split("|")[5].strip() == inside


def test_phases():
    visible = np.array([1, 1, 0, 0, 0, 1, 0], dtype=bool)
    assert phases(visible) == [(2, 3, False), (5, 1, True), (6, 1, False)]
    assert phases(visible[:2]) == []


def test_the_closed_form_of_a_reverting_velocity_is_the_moment_equations_solution():
    start = np.array([[0.02, 0.004], [0.004, 0.01]])
    a, q = np.array([[0.0, 1.0], [0.0, -0.5]]), np.diag([0.0, 0.0225])
    times = np.array([0.04, 0.4, 3.0, 12.0])

    def rate(_, flat):
        p = flat.reshape(2, 2)
        return (a @ p + p @ a.T + q).ravel()

    solved = solve_ivp(rate, (0.0, 12.0), start.ravel(), t_eval=times, rtol=1e-11, atol=1e-14).y
    np.testing.assert_allclose(
        occlusion.reverting_sigma(start, 0.0225, 2.0, times), np.sqrt(solved[0]), rtol=1e-9
    )


def test_growth_is_the_closed_form():
    rows = occlusion.growth_job(0)
    assert {row["motion"] for row in rows} == {"reverting velocity", "double integrator"}
    assert all(row["worst"] < 1e-10 and row["steps"] > 100 and row["longest_s"] > 2.0 for row in rows)


def test_collisions_are_the_envs():
    (row,) = collisions_job(Job("pulse", "no filter", 1200, 1))
    env = gym.make("OccludedCrossing-v0")
    act, done, episodes, collisions, cost_steps = None, True, 0, 0, 0
    for _ in range(1200):
        if done:
            env.reset(seed=100_000 + episodes)
            episodes += 1
        act = act or DRIVERS["pulse"](env.unwrapped, np.random.default_rng(1))
        *_, done, info = env.step(act())
        collisions += info["collisions"]
        cost_steps += info["cost"] > 0.0
    assert (row["collisions"], row["cost_steps"]) == (collisions, cost_steps)
    assert collisions > 2 and row["flagged"] == row["intervened"] == 0


def test_every_filter_keeps_clear_of_what_it_is_said_to():
    attributes = {}
    for arm, options in occlusion.ARMS.items():
        if options is not None:
            env = sw.protect(crossing(gym.make("OccludedCrossing-v0")), **options)
            first = env.constraints[0].obstacles[0]
            attributes[arm] = (first.attribute, getattr(first, "sigmas", None))
    assert attributes == {
        "last seen": ("last_seen_positions", None),
        "true state": ("car_tracks", 3.0),
        **{f"estimate, k = {k}": ("tracking", float(k)) for k in (1, 2, 3)},
    }


@pytest.mark.slow
def test_the_command_keeps_the_other_parts_rows(monkeypatch, capsys, tmp_path):
    def command(*words):
        monkeypatch.setattr(sys, "argv", ["occlusion", "--workers", "1", "--results", str(tmp_path), *words])
        occlusion.main()
        rows = [json.loads(line) for line in (tmp_path / "occlusion.jsonl").read_text().splitlines()]
        return [row["part"] for row in rows], capsys.readouterr().out

    parts, _ = command("growth", "--episodes", "1")
    assert parts == ["growth"] * 2
    parts, out = command("collisions", "--steps", "3")
    assert parts == ["growth"] * 2 + ["collisions"] * 18
    assert (tmp_path / "occlusion.md").read_text() == out
    assert "| estimate, k = 2 | all | 9 |" in out and "largest relative error" in out
    assert command("growth", "--episodes", "1")[0] == ["collisions"] * 18 + ["growth"] * 2
    with pytest.raises(SystemExit):
        command("groth")


# What it costs ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("count", occlusion_cost.COUNTS)
def test_rays_in_one_call_say_what_single_ones_do(count):
    both = occlusion_cost.rays(count)
    together, singly = both["one call"](), both["singly"]()
    assert together.shape == (count,) and (together == singly).all()


def test_so_many_tracks_are_timed():
    for count in occlusion_cost.COUNTS:
        env = occlusion_cost.make(count)
        env.reset(seed=0)
        assert env.step(env.action_space.sample())[4]["occlusion/sigma"].shape == (count,)
    us = occlusion_cost.tracking_us(rounds=2, batch=4)
    assert set(us) == {"bare", "1 tracks", "4 tracks", "16 tracks"} and min(us.values()) > 0.0


def test_changed_and_unchanged_steps_are_told_apart():
    found = occlusion_cost.filter_us(300)
    assert sum(steps for steps, _, _ in found.values()) == 300
    assert all(steps > 20 and 0.0 < without < with_it for steps, without, with_it in found.values())
