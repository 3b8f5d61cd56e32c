"""The judges of the benchmarks, on states made by hand: they say "violated" exactly when it is."""

import gymnasium as gym
import mujoco
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from benchmarks import judges
from benchmarks.cases import HARD, PROTECTED
from benchmarks.judges import Replay, Reported


def placed(env, qpos, qvel=None):
    """The unwrapped env in a state that is zero but for what is given: {joint: number}."""
    raw = env.unwrapped
    for given_, values, address in ((qpos, raw.data.qpos, "qposadr"), (qvel or {}, raw.data.qvel, "dofadr")):
        values[:] = 0.0
        for joint, value in given_.items():
            values[getattr(raw.model.joint(joint), address)] = value
    mujoco.mj_forward(raw.model, raw.data)
    return raw


def verdict_of_step(raw, judge, action):
    judge.before()
    raw.do_simulation(np.asarray(action), raw.frame_skip)
    return judge.after(np.asarray(action), {})


@pytest.fixture(scope="module")
def reacher():
    env = gym.make("Reacher-v5")
    env.reset(seed=0)
    return env


@pytest.fixture(scope="module")
def pendulum():
    env = gym.make("InvertedPendulum-v5")
    env.reset(seed=0)
    return env


@pytest.mark.parametrize("x, beyond", [(0.9499, False), (0.9501, True), (-0.9499, False), (-0.9501, True)])
def test_a_rail_has_two_ends(pendulum, x, beyond):
    raw = placed(pendulum, {"slider": x})
    missed = PROTECTED["InvertedPendulum-v5, on after the fall"].judge(raw).start()
    assert (missed > 0.0) == beyond and abs(missed) == pytest.approx(1e-4, rel=1e-6)


def test_a_violation_between_two_samples_is_seen(pendulum):
    # Full force against 0.4 m/s: after the first substep 3 mm farther, after the second back inside.
    raw = placed(pendulum, {"slider": 0.949}, {"slider": 0.4})
    judge = Replay(raw, judges.joint_beyond(raw.model, "slider", 0.95))
    assert judge.start() < 0.0
    assert verdict_of_step(raw, judge, [-3.0]) > 0.001
    assert raw.data.qpos[0] < 0.95


def test_the_replayed_action_is_the_one_executed(pendulum):
    raw = placed(pendulum, {"slider": 0.9})
    judge = Replay(raw, judges.joint_beyond(raw.model, "slider", 0.95))
    judge.before()
    raw.do_simulation(np.array([3.0]), raw.frame_skip)
    with pytest.raises(RuntimeError, match="does not end where the env's did"):
        judge.after(np.array([2.9]), {})


@pytest.mark.parametrize("speeds, missed", [((4.9, -4.9), -0.1), ((5.1, 0.0), 0.1), ((0.0, -5.2), 0.2)])
def test_the_fastest_joint_counts(reacher, speeds, missed):
    raw = placed(reacher, {}, dict(zip(("joint0", "joint1"), speeds, strict=True)))
    assert PROTECTED["Reacher-v5"].judge(raw).start() == pytest.approx(missed)


def test_joints_without_a_motor_do_not_count(reacher):
    raw = placed(reacher, {}, {"target_x": 99.0})
    assert PROTECTED["Reacher-v5"].judge(raw).start() == pytest.approx(-5.0)


@given(st.floats(-3.1, 3.1), st.floats(-2.9, 2.9))
def test_a_fingertip_in_a_disc(reacher, shoulder, elbow):
    raw = placed(reacher, {"joint0": shoulder, "joint1": elbow})
    tip = 0.1 * np.array([np.cos(shoulder), np.sin(shoulder)]) + 0.11 * np.array(
        [np.cos(shoulder + elbow), np.sin(shoulder + elbow)]
    )
    truth = Replay(raw, judges.inside_disc(raw.model, "fingertip", (-0.1, 0.1), 0.05))
    assert truth.start() == pytest.approx(0.05 - np.hypot(*(tip - [-0.1, 0.1])), abs=1e-9)


def test_two_requirements_are_missed_if_one_is(reacher):
    judge = HARD["Reacher-v5, with a disc"].judge
    in_the_disc = {"joint0": 2.3562 - 0.83, "joint1": 1.66}
    assert judge(placed(reacher, {})).start() < 0.0
    assert judge(placed(reacher, in_the_disc)).start() > 0.0
    assert judge(placed(reacher, {}, {"joint0": 5.5})).start() > 0.0


def test_the_tip_over_the_table():
    env = gym.make("Pusher-v5")
    env.reset(seed=0)
    rng = np.random.default_rng(0)
    outside = 0
    for _ in range(200):
        joints = [env.unwrapped.model.joint(j).name for j in range(7)]
        limits = env.unwrapped.model.jnt_range[:7]
        raw = placed(env, dict(zip(joints, rng.uniform(*limits.T), strict=True)))
        x, y, z = raw.data.body("tips_arm").xpos
        inside = -0.2 <= x <= 0.9 and -1.2 <= y <= 0.15 and -0.3 <= z <= 0.4
        assert (PROTECTED["Pusher-v5"].judge(raw).start() <= 0.0) == inside
        outside += not inside
    assert 20 < outside < 180


@pytest.mark.parametrize("gap, touches", [(0.02, False), (0.005, False), (0.001, True), (-0.01, True)])
@pytest.mark.parametrize("corner", [False, True])
def test_a_ball_at_a_wall(gap, touches, corner):
    pytest.importorskip("gymnasium_robotics")
    env = PROTECTED["PointMaze_UMaze-v3"].make()
    env.reset(seed=0)
    raw = env.unwrapped
    # The wall inside the U covers x from -1.5 to 0.5 and y from -0.5 to 0.5; its end is free.
    diagonal = (0.1 + gap) / np.sqrt(2.0)
    place = (0.5 + diagonal, 0.5 + diagonal) if corner else (0.6 + gap, 0.2)
    raw.data.qpos[:], raw.data.qvel[:] = place, 0.0
    assert (PROTECTED["PointMaze_UMaze-v3"].judge(raw).start() > 0.0) == touches


def test_a_maze_that_clips_the_speed_is_replayed_with_the_clip():
    pytest.importorskip("gymnasium_robotics")
    env = PROTECTED["PointMaze_UMaze-v3"].make()
    raw = env.unwrapped
    action = np.array([1.0, -1.0])
    bare = Replay(raw, judges.touches_wall(raw.model, "particle_geom"))
    for judge, right in ((PROTECTED["PointMaze_UMaze-v3"].judge(raw), True), (bare, False)):
        env.reset(seed=0)
        raw.data.qvel[:] = [7.0, -9.0]
        judge.before()
        raw.step(action)
        if right:
            assert np.isfinite(judge.after(action, {}))
        else:
            with pytest.raises(RuntimeError, match="does not end where the env's did"):
                judge.after(action, {})


@pytest.mark.parametrize("gap, near", [(0.41, False), (0.39, True), (-0.1, True)])
def test_an_ant_at_a_wall(gap, near):
    pytest.importorskip("gymnasium_robotics")
    env = PROTECTED["AntMaze_UMaze-v5"].make()
    env.reset(seed=0)
    raw = env.unwrapped
    raw.data.qpos[:2] = (2.0 + gap, 0.5)  # the same wall, four times as large
    assert (PROTECTED["AntMaze_UMaze-v5"].judge(raw).start() > 0.0) == near


@pytest.mark.parametrize("x, y, plane, violated", [
    (2.01, 0.0, False, True),
    (1.99, 9.0, False, False),
    (-9.0, 0.0, False, False),
    (-1.5, 1.5, True, True),
    (-1.4, 1.4, True, False),
    (np.nan, 0.0, False, True),
])  # fmt: skip
def test_a_published_speed(x, y, plane, violated):
    judge = Reported(judges.faster_than(2.0, plane))
    assert judge.start() <= 0.0
    missed = judge.after(np.zeros(1), {"x_velocity": x, "y_velocity": y})
    assert (not missed <= 0.0) == violated


@pytest.mark.parametrize("cost", [0.0, 1.0])
def test_a_cost_at_some_substep_is_a_violation(cost):
    missed = Reported(judges.costs).after(np.zeros(2), {"cost": 0.0, "cost_substep": cost})
    assert (missed > 0.0) == bool(cost)
