"""Upright: heights and tilts by hand, falls that are refused, and what is refused at construction."""

import gymnasium as gym
import mujoco
import numpy as np
import pytest
from asking import asked
from hypothesis import given, settings
from hypothesis import strategies as st
from judged_loops import DRIVERS, Scene, check_inactive, drive
from scipy.spatial.transform import Rotation

import safe_wrappers as sw
from safe_wrappers.errors import ConfigurationError, UnknownNameError

BOX = """<mujoco><option timestep="0.01"/><worldbody><body name="box"><freejoint/><geom type="box" size=".1 .2 .3"/>
<body name="tail"><joint name="t" axis="0 1 0"/><geom size=".01" pos="0 0 .4"/></body></body></worldbody>
<actuator><motor joint="t" ctrlrange="-1 1"/></actuator></mujoco>"""


@settings(max_examples=40)
@given(
    height=st.floats(-2.0, 3.0),
    turn=st.lists(st.floats(-1.0, 1.0), min_size=4, max_size=4).filter(lambda q: np.linalg.norm(q) > 0.1),
)
def test_height_and_tilt_of_any_pose(height, turn):
    env = Scene(BOX)
    env.data.qpos[:7] = [0.3, -0.2, height, *(np.array(turn) / np.linalg.norm(turn))]
    mujoco.mj_forward(env.model, env.data)
    limit = sw.constraints.Upright("box", lowest=-1.0, highest=2.0, tilt=0.5)
    w, x, y, z = turn
    up = Rotation.from_quat([x, y, z, w]).apply([0.0, 0.0, 1.0])
    angle = np.arctan2(np.hypot(up[0], up[1]), up[2])
    # arccos of a cosine near one loses half of the digits
    np.testing.assert_allclose(
        asked(env, limit).value(), [height + 1.0, 2.0 - height, 0.5 - angle], atol=1e-7
    )


def test_the_forecast_is_followed_substep_by_substep():
    env = Scene(BOX)
    env.data.qpos[:4] = [0.0, 0.0, 2.0, 1.0]
    env.data.qvel[3] = 2.0  # turning about x at 2 rad/s, and falling
    mujoco.mj_forward(env.model, env.data)
    limit = asked(env, sw.constraints.Upright("box", lowest=1.0, tilt=1.0, horizon=4))
    room = limit.room(limit.plant.forecast(np.zeros(1), 4))
    assert room.shape == (20, 2)
    data = mujoco.MjData(env.model)
    mujoco.mj_copyData(data, env.model, env.data)
    for k in range(20):
        mujoco.mj_step(env.model, data)
        x, y, z = data.qpos[4:7]
        up = Rotation.from_quat([x, y, z, data.qpos[3]]).apply([0.0, 0.0, 1.0])
        expected = [data.qpos[2] - 1.0, 1.0 - np.arctan2(np.hypot(up[0], up[1]), up[2])]
        np.testing.assert_allclose(room[k], expected, atol=1e-7)


CASES = {
    "poles": (
        "InvertedDoublePendulum-v5",
        sw.constraints.Upright("pole2", lowest=0.5),
        lambda model, data: data.body("pole2").xpos[2] - 0.5,
    ),
    "a hopper": (
        "Hopper-v5",
        sw.constraints.Upright("torso", lowest=0.9, tilt=0.15),
        lambda model, data: np.array(
            [data.body("torso").xpos[2] - 0.9, 0.15 - abs(data.qpos[2])]  # rooty turns about y alone
        ),
    ),
}


def check_closed_loop(case, driver, steps, seeds):
    env_id, limit, room = CASES[case]
    filtered = sw.CBFActionFilter(gym.make(env_id, disable_env_checker=True), [limit])
    seen = drive(filtered, room, driver, steps, seeds)
    assert seen["intervened"] > 0
    if case == "poles":
        assert seen["outside"] <= seen["flagged"] <= 0.02 * seen["steps"]


@pytest.mark.filterwarnings("ignore::safe_wrappers.UnsafeStateWarning")
@pytest.mark.parametrize("driver", DRIVERS)
@pytest.mark.parametrize("case", CASES)
def test_no_step_that_is_not_flagged_falls(case, driver):
    check_closed_loop(case, driver, 40, [0])


def test_an_upright_robot_is_left_alone_bit_for_bit():
    check_inactive("Humanoid-v5", sw.constraints.Upright("torso", lowest=-5.0, tilt=np.pi), 0.4, 15)


@pytest.mark.parametrize(
    ("arguments", "error", "message"),
    [
        ({}, ConfigurationError, r"give at least one of lowest \(m\), highest \(m\) and tilt \(rad\)"),
        ({"lowest": "low"}, ConfigurationError, "lowest is a height in m or None, got 'low'"),
        (
            {"tilt": 3.2},
            ConfigurationError,
            r"tilt is an angle above the margin \(0.0\) and at most pi, got 3.2",
        ),
        (
            {"body": "head", "tilt": 1.0},
            UnknownNameError,
            "no body 'head'; give another by body=; it has: world, torso",
        ),
    ],
)
def test_nonsense_is_refused(arguments, error, message):
    with pytest.raises(error, match=message):
        sw.CBFActionFilter(gym.make("Walker2d-v5"), [sw.constraints.Upright(**arguments)])
