"""The patrolled maze: its physics is PointMaze's, its patrols keep to their law, its judge misses nothing."""

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


def make():
    return gym.make("PatrolledPointMaze-v0")


def test_physics_observations_rewards_and_goals_are_point_mazes():
    ours = gym.make("PatrolledPointMaze-v0", reset_target=True)
    theirs = gym.make("PointMaze_UMaze-v3", reset_target=True, max_episode_steps=1000)
    rng, goals = np.random.default_rng(0), set()
    for seed in (3, None):
        (one, _), (other, _) = ours.reset(seed=seed), theirs.reset(seed=seed)
        for _ in range(400):
            assert all(np.array_equal(one[key], other[key]) for key in one)
            goals.add(tuple(one["desired_goal"]))
            # To the goal and about: goals are reached, and drawn anew.
            action = np.clip(2 * (one["desired_goal"] - one["achieved_goal"]) + rng.normal(0, 0.6, 2), -1, 1)
            one, *result, _ = ours.step(action.astype(np.float32))
            other, *expected, _ = theirs.step(action.astype(np.float32))
            assert result == expected
    assert len(goals) > 1


def patrol_path(seed, action=(0.0, 0.0), steps=400):
    env, found = make().unwrapped, []
    env.reset(seed=seed, options={"reset_cell": np.array([2, 3]), "goal_cell": np.array([1, 1])})
    for _ in range(steps):
        env.step(np.array(action))
        found.append((env.patrol_positions, env.patrol_velocities))
    return [np.array(part) for part in zip(*found, strict=True)]


def test_a_patrol_keeps_to_its_way_turns_at_its_ends_and_its_velocity_is_that_of_its_position():
    paths = [patrol_path(seed) for seed in range(3)]
    for where, velocity in paths:
        assert (where[:, :, 1] == [1.0, -1.0]).all() and (np.abs(where[:, :, 0]) <= 1.0).all()
        between, now = np.diff(where, axis=0) / 0.01, velocity[1:]
        turns = np.sign(velocity[1:, :, 0]) != np.sign(velocity[:-1, :, 0])
        # Within 10 ms the speed changes by about 0.015 m/s.
        np.testing.assert_allclose(between[~turns], now[~turns], atol=0.08)
        assert (np.abs(where[1:, :, 0][turns]) > 0.99).all() and np.abs(between).max() < 1.5
        assert turns.any() and not velocity[:, :, 1].any()
    # The seed alone decides it, whatever the ball does.
    assert np.array_equal(patrol_path(2, (1.0, -1.0)), paths[2]) and not np.array_equal(*paths[1:])


def least_of_many(before, after):
    """Of the straight ways between offsets, shapes (k, 2), by many points on them, and the error of that."""
    shares = np.linspace(0.0, 1.0, 2001)[:, None, None]
    sampled = np.linalg.norm(before + shares * (after - before), axis=2).min(axis=0)
    return sampled, np.linalg.norm(after - before, axis=1) / 2000 + 1e-12


@given(arrays(float, (5, 2), elements=st.floats(-2, 2)), arrays(float, (5, 2), elements=st.floats(-2, 2)))
def test_closest_approach_is_that_of_many_points_between(before, after):
    sampled, error = least_of_many(before, after)
    found = patrolled_maze.closest_approach(before, after)
    assert (found <= sampled + 1e-12).all() and (sampled - found <= error).all()


def test_an_overlap_anywhere_in_a_step_costs_and_is_a_collision_once():
    env, rng, kinds = make().unwrapped, np.random.default_rng(0), set()
    env.reset(seed=0)
    was = np.zeros(2, bool)
    for step in range(1500):
        # Thrown at a patrol, or past it, at full speed; or it comes to a ball that stands still.
        at, speed = CONTACT * rng.uniform(0.9, 1.1), 5.0 * (step % 50 < 35)
        if step % 50 < 36:
            angle, course = rng.uniform(0.0, 2.0 * np.pi, 2)
            place = env.patrol_positions[0] + at * np.array([np.cos(angle), np.sin(angle)])
            env.point_env.set_state(place, speed * np.array([np.cos(course), np.sin(course)]))
        before = env.patrol_positions - env.agent_position
        info = env.step(np.zeros(2))[4]
        after = env.patrol_positions - env.agent_position
        least, error = least_of_many(before, after)
        touched, now = least <= CONTACT, np.linalg.norm(after, axis=1) <= CONTACT
        if (np.abs(least - CONTACT) > error).all():
            assert info["cost"] == info["cost_substep"] == float(touched.any())
            assert info["collisions"] == (touched & ~was).sum()
            kinds.add((info["cost"], bool(now[0]), info["collisions"], bool(was[0])))
        was = now
    # Among them: passed within one step; begun; going on; over.
    assert kinds >= {
        (1.0, False, 1, False),
        (1.0, True, 1, False),
        (1.0, True, 0, True),
        (0.0, False, 0, True),
    }


def test_no_patrol_starts_at_the_ball_and_a_tracker_knows_their_mean_square_speed():
    env, gaps, squares = make().unwrapped, [], []
    for seed in range(80):
        _, info = env.reset(seed=seed)
        assert info["cost"] == 0.0 and info["collisions"] == 0
        gaps.append(np.linalg.norm(env.patrol_positions - env.agent_position, axis=1).min())
        squares += np.square(env.patrol_velocities).sum(axis=1).tolist()
    assert CONTACT + 0.3 <= min(gaps) < CONTACT + 0.4
    known = patrolled_maze.PATROL_ACCELERATION_NOISE * patrolled_maze.PATROL_REVERSION_S / 2.0
    assert abs(np.mean(squares) - known) < 4.5 * np.std(squares) / np.sqrt(len(squares)) < 0.1


def test_walls_hide_patrols():
    """Between the corridors, at y = 1 and -1, a wall of 1 m ends at x = 0.5."""
    env, rng, seen = patrolled(make()), np.random.default_rng(0), set()
    env.reset(seed=0)
    for _ in range(300):
        ball = rng.choice([(-0.9, 1.0), (0.9, 1.0), (0.9, 0.0), (0.9, -1.0)]) + rng.uniform(-0.1, 0.1, 2)
        env.unwrapped.point_env.set_state(ball, np.zeros(2))
        visible = env.step(np.zeros(2, dtype=np.float32))[4]["occlusion/visible"]
        ball = env.unwrapped.agent_position
        between = np.linspace(ball, env.unwrapped.patrol_positions, 200)
        into = np.minimum(0.5 - between[..., 0], 0.5 - np.abs(between[..., 1])).max(axis=0)
        for deep, sees in zip(into, visible, strict=True):
            if abs(deep) > 0.02:
                assert sees == (deep < 0.0), (ball, deep)
                seen.add(bool(sees))
    assert seen == {False, True}


def test_protect_knows_it():
    bare = sw.protect(make())
    assert bare.constraints[1].obstacles[0].attribute == "patrol_tracks"
    for patrols, attribute in (("estimated", "tracking"), ("true", "patrol_tracks"), ("", "tracking")):
        env = sw.protect(patrolled(make()), patrols=patrols, sigmas=2.0)
        (tracked,) = env.constraints[1].obstacles
        assert (tracked.attribute, tracked.sigmas, tracked.radius) == (attribute, 2.0, 0.15)
    last = sw.protect(patrolled(make()), patrols="last_seen")
    assert last.constraints[1].obstacles[0].attribute == "last_seen_positions"
    with pytest.raises(UnknownNameError, match="true, last_seen, estimated"):
        sw.protect(make(), patrols="all")
