"""The judges of closed loops, on states made by hand; every recipe has a case, and every script is found."""

import importlib
import subprocess
import sys

import gymnasium as gym
import mujoco
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from benchmarks import judges
from benchmarks.__main__ import names
from benchmarks.cases import CASES, PROTECTED
from benchmarks.judges import Replay, Reported
from safe_wrappers.wrappers.recipes import RECIPES


def test_every_recipe_has_a_case():
    def family(env_id):
        plain = env_id.rpartition("-v")[0].partition("_")[0]
        return plain.removeprefix("Safe").removesuffix("Velocity") if plain.endswith("Velocity") else plain

    assert {family(case.env_id) for case in PROTECTED.values()} == set(RECIPES)


def test_every_script_is_found_and_what_is_no_name_is_an_error():
    for name in names():
        if "train" in name or name in ("table", "endurance", "moving_picture"):
            pytest.importorskip("stable_baselines3")
        if name != "bench":  # which needs its peers
            assert callable(importlib.import_module(f"benchmarks.{name}").main)
    done = subprocess.run([sys.executable, "-m", "benchmarks", "no_such"], capture_output=True, text=True)
    assert done.returncode == 1 and "golden_traces" in done.stdout


def placed(env, qpos, qvel=None):
    """The unwrapped env in a state that is zero but for what is given: {joint: number}."""
    raw = env.unwrapped
    for given_, values, address in ((qpos, raw.data.qpos, "qposadr"), (qvel or {}, raw.data.qvel, "dofadr")):
        values[:] = 0.0
        for joint, value in given_.items():
            values[getattr(raw.model.joint(joint), address)] = value
    mujoco.mj_forward(raw.model, raw.data)
    return raw


def judged_step(raw, judge, acted, told):
    judge.before()
    raw.do_simulation(np.asarray(acted), raw.frame_skip)
    return judge.after(np.asarray(told), {})


@pytest.fixture(scope="module")
def reacher():
    env = gym.make("Reacher-v5")
    env.reset(seed=0)
    return env


def test_a_violation_between_two_samples_is_seen_and_another_action_than_the_executed_one_refused():
    env = gym.make("InvertedPendulum-v5")
    env.reset(seed=0)
    # Full force against 0.4 m/s: after the first substep 3 mm farther, after the second back inside.
    raw = placed(env, {"slider": 0.949}, {"slider": 0.4})
    judge = Replay(raw, judges.joint_beyond(raw.model, "slider", 0.95))
    assert judge.start() < 0.0
    assert judged_step(raw, judge, [-3.0], [-3.0]) > 0.001
    assert raw.data.qpos[0] < 0.95
    with pytest.raises(RuntimeError, match="does not end where the env's did"):
        judged_step(placed(env, {"slider": 0.9}), judge, [3.0], [2.9])
    for x, beyond in ((0.9501, True), (-0.9499, False), (-0.9501, True)):  # a rail has two ends
        missed = PROTECTED["InvertedPendulum-v5, on after the fall"].judge(placed(env, {"slider": x})).start()
        assert (missed > 0.0) == beyond and abs(missed) == pytest.approx(1e-4, rel=1e-6)


@given(st.floats(-3.1, 3.1), st.floats(-2.9, 2.9), st.floats(-9.0, 9.0), st.floats(-9.0, 9.0))
def test_a_fingertip_in_a_disc_or_a_joint_with_a_motor_that_is_too_fast(reacher, shoulder, elbow, one, other):
    raw = placed(
        reacher, {"joint0": shoulder, "joint1": elbow}, {"joint0": one, "joint1": other, "target_x": 99.0}
    )
    both, fast = shoulder + elbow, max(abs(one), abs(other)) - 5.0
    x, y = 0.1 * np.cos(shoulder) + 0.11 * np.cos(both), 0.1 * np.sin(shoulder) + 0.11 * np.sin(both)
    inside = 0.05 - np.hypot(x + 0.1, y - 0.1)
    assert PROTECTED["Reacher-v5"].judge(raw).start() == pytest.approx(fast)
    missed = CASES["Reacher-v5, with a disc"].judge(raw).start()
    assert missed == pytest.approx(max(inside, fast), abs=1e-9)


@pytest.mark.parametrize(("gap", "touches"), [(0.005, False), (0.001, True), (-0.01, True)])
def test_a_ball_at_a_wall(gap, touches):
    pytest.importorskip("gymnasium_robotics")
    env = PROTECTED["PointMaze_UMaze-v3"].make()
    env.reset(seed=0)
    raw = env.unwrapped
    # The wall inside the U covers x from -1.5 to 0.5 and y from -0.5 to 0.5; its end is free.
    diagonal = 0.5 + (0.1 + gap) / np.sqrt(2.0)
    for place in ((0.6 + gap, 0.2), (diagonal, diagonal)):
        raw.data.qpos[:], raw.data.qvel[:] = place, 0.0
        assert (PROTECTED["PointMaze_UMaze-v3"].judge(raw).start() > 0.0) == touches


@pytest.mark.parametrize(("x", "y", "plane", "violated"), [
    (2.01, 0.0, False, True), (1.99, 9.0, False, False), (-9.0, 0.0, False, False),
    (-1.5, 1.5, True, True), (-1.4, 1.4, True, False), (np.nan, 0.0, False, True),
])  # fmt: skip
def test_a_published_speed(x, y, plane, violated):
    missed = Reported(judges.faster_than(2.0, plane)).after(np.zeros(1), {"x_velocity": x, "y_velocity": y})
    assert (not missed <= 0.0) == violated
