"""The patrolled maze: its physics is PointMaze's, its patrols keep to their law, its judge misses nothing."""

import functools

import gymnasium as gym
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

import safe_wrappers as sw
from benchmarks.cases import patrolled
from safe_wrappers.errors import UnknownNameError

gym.register_envs(pytest.importorskip("gymnasium_robotics"))
from safe_wrappers.envs import patrolled_maze  # noqa: E402 (needs gymnasium_robotics)

CONTACT = 0.25


@functools.cache
def shared():
    return gym.make("PatrolledPointMaze-v0").unwrapped


def place(env, ball, velocity, along, speeds):
    """Ball (2,), its velocity (2,), and each patrol's way from its start and speed."""
    env.point_env.set_state(np.array(ball, dtype=float), np.array(velocity, dtype=float))
    env._gone, env._speeds = np.array(along, dtype=float), np.array(speeds, dtype=float)
    env._touching = np.zeros(len(along), dtype=bool)


def test_physics_observations_rewards_and_goals_are_point_mazes():
    ours = gym.make("PatrolledPointMaze-v0", reset_target=True)
    theirs = gym.make("PointMaze_UMaze-v3", reset_target=True, max_episode_steps=1000)
    rng = np.random.default_rng(0)
    goals = set()
    for seed in (3, None):
        (one, _), (other, _) = ours.reset(seed=seed), theirs.reset(seed=seed)
        for _ in range(400):
            for key in one:
                assert np.array_equal(one[key], other[key]), key
            goals.add(tuple(one["desired_goal"]))
            # To the goal and about: goals are reached, and drawn anew.
            action = np.clip(2 * (one["desired_goal"] - one["achieved_goal"]) + rng.normal(0, 0.6, 2), -1, 1)
            one, reward, *ends, _ = ours.step(action.astype(np.float32))
            other, expected, *others, _ = theirs.step(action.astype(np.float32))
            assert (reward, ends) == (expected, others)
    assert len(goals) > 1


def patrol_path(seed, steps=400, action=(0.0, 0.0)):
    env = shared()
    env.reset(seed=seed, options={"reset_cell": np.array([2, 3]), "goal_cell": np.array([1, 1])})
    found = []
    for _ in range(steps):
        env.step(np.array(action))
        found.append((env.patrol_positions, env.patrol_velocities))
    return [np.array(part) for part in zip(*found, strict=True)]


def test_a_patrol_keeps_to_its_way_turns_at_its_ends_and_its_velocity_is_that_of_its_position():
    turned = 0
    for seed in range(3):
        where, velocity = patrol_path(seed)
        assert (where[:, 0, 1] == 1.0).all() and (where[:, 1, 1] == -1.0).all()
        assert (np.abs(where[:, :, 0]) <= 1.0).all() and (velocity[:, :, 1] == 0.0).all()
        between = np.diff(where[:, :, 0], axis=0) / 0.01
        turns = np.sign(velocity[1:, :, 0]) != np.sign(velocity[:-1, :, 0])
        straight = ~turns
        # Within 10 ms the speed changes by about 0.015 m/s.
        np.testing.assert_allclose(between[straight], velocity[1:, :, 0][straight], atol=0.08)
        near_an_end = np.abs(where[1:, :, 0][turns]) > 0.99
        assert near_an_end.all() and np.abs(between).max() < 1.5
        turned += int(turns.sum())
    assert turned > 3


def test_the_seed_alone_decides_the_way_whatever_the_ball_does():
    first, pushed, other = (patrol_path(*a)[0] for a in ((5,), (5, 400, (1.0, -1.0)), (6,)))
    assert np.array_equal(first, pushed) and not np.array_equal(first, other)


@given(arrays(float, (5, 2), elements=st.floats(-2, 2)), arrays(float, (5, 2), elements=st.floats(-2, 2)))
def test_closest_approach_is_that_of_many_points_between(before, after):
    shares = np.linspace(0.0, 1.0, 2001)[:, None, None]
    sampled = np.linalg.norm(before + shares * (after - before), axis=2).min(axis=0)
    found = patrolled_maze.closest_approach(before, after)
    assert (found <= sampled + 1e-12).all()
    assert (sampled - found <= np.linalg.norm(after - before, axis=1) / 2000 + 1e-12).all()


def test_a_pass_within_one_step_costs_and_counts_once():
    env = shared()
    env.reset(seed=0)
    # Diagonally past the patrol at (0, 1): clear at both ends of the step, a hair too near in between.
    aside = (CONTACT - 5e-5) * np.array([1.0, -1.0]) / np.sqrt(2.0)
    way = 0.035 * np.array([1.0, 1.0]) / np.sqrt(2.0)
    for offset, cost in ((aside, 1.0), (aside * 1.001, 0.0)):
        place(env, np.array([0.0, 1.0]) + offset - way, way / 0.01 * 2.0, [1.0, 1.0], [0.0, 0.0])
        before = np.hypot(*(env.patrol_positions[0] - env.agent_position))
        info = env.step(np.zeros(2))[4]
        after = np.hypot(*(env.patrol_positions[0] - env.agent_position))
        assert min(before, after) > CONTACT + 1e-3
        assert (info["cost"], info["cost_substep"], info["collisions"]) == (cost, cost, int(cost))


def test_contact_that_lasts_costs_every_step_and_is_one_collision():
    env = shared()
    env.reset(seed=0)
    place(env, (0.0, 0.85), (0.0, 0.0), [0.6, 0.6], [0.5, 0.5])
    infos, inside = [], []
    for _ in range(150):
        infos.append(env.step(np.zeros(2))[4])
        inside.append(np.hypot(*(env.patrol_positions[0] - env.agent_position)) <= CONTACT)
    assert sum(inside) > 20
    assert sum(info["collisions"] for info in infos) == 1
    costs = np.array([info["cost"] for info in infos])
    assert (costs[inside] == 1.0).all() and abs(int(costs.sum()) - sum(inside)) <= 1


def test_no_patrol_starts_at_the_ball_and_a_tracker_knows_their_mean_square_speed():
    env, gaps, squares = shared(), [], []
    for seed in range(80):
        _, info = env.reset(seed=seed)
        assert info["cost"] == 0.0 and info["collisions"] == 0
        gaps.append(np.linalg.norm(env.patrol_positions - env.agent_position, axis=1).min())
        squares += np.square(env.patrol_velocities).sum(axis=1).tolist()
    assert CONTACT + 0.3 <= min(gaps) < CONTACT + 0.4
    known = patrolled_maze.PATROL_ACCELERATION_NOISE * patrolled_maze.PATROL_REVERSION_S / 2.0
    assert abs(np.mean(squares) - known) < 4.5 * np.std(squares) / np.sqrt(len(squares)) < 0.1


@pytest.mark.parametrize(
    ("ball", "patrols", "visible"),
    [
        ((0.0, 1.0), (-1.0, -1.0), [True, False]),
        ((0.0, -1.0), (1.0, 1.0), [False, True]),
        ((1.0, 0.0), (1.0, 1.0), [True, True]),
        ((1.0, 0.0), (-1.0, 0.6), [False, True]),
        ((1.0, 0.9), (-1.0, 0.6), [True, True]),
        ((1.0, 0.9), (-1.0, 0.1), [True, False]),
    ],
)
def test_walls_hide_patrols(ball, patrols, visible):
    """Between the corridors, at y = 1 and -1, a wall of 1 m ends at x = 0.5."""
    env = patrolled(gym.make("PatrolledPointMaze-v0"))
    env.reset(seed=0)
    place(env.unwrapped, ball, (0.0, 0.0), 1.0 + np.array(patrols), [0.0, 0.0])
    assert env.step(np.zeros(2, dtype=np.float32))[4]["occlusion/visible"].tolist() == visible


def test_protect_knows_it():
    bare = sw.protect(gym.make("PatrolledPointMaze-v0"))
    assert bare.constraints[1].obstacles[0].attribute == "patrol_tracks"
    for patrols, attribute in (("estimated", "tracking"), ("true", "patrol_tracks"), ("", "tracking")):
        env = sw.protect(patrolled(gym.make("PatrolledPointMaze-v0")), patrols=patrols, sigmas=2.0)
        (tracked,) = env.constraints[1].obstacles
        assert (tracked.attribute, tracked.sigmas, tracked.radius) == (attribute, 2.0, 0.15)
    last = sw.protect(patrolled(gym.make("PatrolledPointMaze-v0")), patrols="last_seen")
    assert last.constraints[1].obstacles[0].attribute == "last_seen_positions"
    with pytest.raises(UnknownNameError, match="true, last_seen, estimated"):
        sw.protect(gym.make("PatrolledPointMaze-v0"), patrols="all")
