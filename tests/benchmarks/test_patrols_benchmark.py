"""The patrols' benchmark: its counts against the env's own, and its bound against a normal one."""

import numpy as np
import pytest

pytest.importorskip("gymnasium_robotics")

from benchmarks import patrols, tracked, turns
from benchmarks.patrol_drivers import patrol_seeking


def test_what_is_counted_is_what_the_env_reports():
    import gymnasium as gym

    found = patrols.drive("no filter", 400)
    env = tracked.patrolled(gym.make("PatrolledPointMaze-v0"))
    env.reset(seed=0)
    act = patrol_seeking(env.unwrapped, np.random.default_rng(0))
    collisions = sum(env.step(act())[4]["collisions"] for _ in range(400))
    assert found["collisions"] == collisions > 0
    assert (found["judged"], found["judged_ahead"]) == (800, 2 * (400 - 50))
    filtered = patrols.drive("speed goes back in 0.25 s", 400)
    assert filtered["collisions"] == 0 < filtered["changed"]
    lines = patrols.table([found, filtered]).splitlines()
    assert lines[2].startswith(f"| no filter | 400 | {collisions} | - |") and "| 0 | 0 |" in lines[3]


def test_outside_is_beyond_three_sigma_along_the_corridor():
    covariance = np.tile(np.diag([0.01, 0.0]), (3, 1, 1))
    truth = np.array([[0.29, 5.0], [0.31, 0.0], [-0.31, 0.0]])
    assert patrols._outside(truth, np.zeros((3, 2)), covariance) == 2


def test_the_other_patrols_tracks_have_the_same_spread_of_speeds_in_the_long_run():
    for settings in (tracked.PATROLLED, tracked.PATROLS_AT_ONCE, tracked.PATROLS_TURNING):
        (track,) = settings["tracks"]
        assert track["acceleration_noise"][0] * track["reversion_s"] / 2 == pytest.approx(0.2725, rel=1e-3)


def test_a_simulated_target_turns():
    start = np.array([[0.0, 0.0, 1.0, 0.0, 2.0]] * 500)
    end = turns.moved(np.random.default_rng(0), start, 0.5)
    # around a circle of half a metre by one radian, and the noises' sizes
    np.testing.assert_allclose(
        end[:, :2].mean(axis=0), [0.5 * np.sin(1.0), 0.5 * (1 - np.cos(1.0))], atol=0.02
    )
    np.testing.assert_allclose(end[:, 4].std(), np.sqrt(0.05 * 0.5), rtol=0.1)
