"""Workspace: its points against MuJoCo's own, every bound and obstacle by hand, and attacked closed loops."""

import gymnasium as gym
import mujoco
import numpy as np
import pytest
from asking import asked
from judged_loops import DRIVERS, Scene, check_inactive, drive

import safe_wrappers as sw
from safe_wrappers.errors import ConfigurationError, UnknownNameError

# Where the points are -----------------------------------------------------------------------------------------

ARM = """<mujoco><option timestep="0.01"/><worldbody><body name="upper" pos="0 0 1" quat=".9 .1 .3 .2">
<joint name="a" axis="0 1 0"/>
<geom name="bone" type="capsule" fromto="0 0 0 .3 .1 0" size=".02"/>
<body name="lower" pos=".3 .1 0" euler="20 30 40"><joint name="b" axis=".3 0 1"/><joint name="c" axis="1 0 0"/>
<geom name="shin" type="box" pos=".1 .05 .02" quat=".5 .5 .1 .2" size=".05 .02 .03"/>
<site name="tip" pos=".2 -.1 .05" euler="10 0 70"/></body></body></worldbody>
<actuator><motor joint="a" ctrlrange="-1 1"/><motor joint="b" ctrlrange="-1 1"/></actuator></mujoco>"""
"""Frames that are turned against each other: bodies, geoms off their body's origin, a site."""


def true_points(data):
    """Of lower, upper (bodies), tip (site), bone, shin (geoms)."""
    return np.array(
        [
            data.body("lower").xpos,
            data.body("upper").xpos,
            data.site("tip").xpos,
            data.geom("bone").xpos,
            data.geom("shin").xpos,
        ]
    )


def test_bodies_sites_and_geoms_are_where_mujoco_has_them_now_and_ahead():
    env = Scene(ARM)
    names = {"bodies": ["lower", "upper"], "sites": ["tip"], "geoms": ["bone", "shin"]}
    limit = asked(env, sw.constraints.Workspace(low=[0.0, 0.0, 0.0], horizon=2, **names))
    plant = limit.plant
    rng = np.random.default_rng(0)
    truth = mujoco.MjData(env.model)
    for _ in range(10):
        env.data.qpos[:], env.data.qvel[:] = rng.uniform(-3.0, 3.0, (2, 3))
        plant.observe()
        truth.qpos[:] = env.data.qpos
        mujoco.mj_forward(env.model, truth)
        np.testing.assert_allclose(limit.value().reshape(5, 3), true_points(truth), atol=1e-12)
        forecast = plant.rollout(rng.uniform(-1.0, 1.0, 2), 2)
        room = limit.h_along(forecast)
        assert room.shape == (10, 15)
        for k in range(10):
            truth.qpos[:] = forecast.qpos[k]
            mujoco.mj_forward(env.model, truth)
            np.testing.assert_allclose(room[k].reshape(5, 3), true_points(truth), atol=1e-12)


def test_every_bound_that_there_is_and_every_obstacle_counts_by_itself():
    env = Scene(ARM)
    env.data.qpos[:] = [0.4, -0.7, 0.2]
    mujoco.mj_forward(env.model, env.data)
    (x, y, z), (p, q, r) = tip, bone = env.data.site("tip").xpos.copy(), env.data.geom("bone").xpos.copy()

    def left(**arguments):
        return asked(env, sw.constraints.Workspace(sites=["tip"], geoms=["bone"], **arguments)).value()

    np.testing.assert_allclose(left(low=[-1.0, None, None]), [x + 1.0, p + 1.0])
    np.testing.assert_allclose(
        left(low=[None, -1.0, None], high=[2.0, None, 3.0], radius=0.1),
        np.array([y + 1.0, q + 1.0, 2.0 - x, 3.0 - z, 2.0 - p, 3.0 - r]) - 0.1,
    )
    disc, ball = sw.constraints.Disc([0.1, 0.2], 0.05), sw.constraints.Sphere([0.1, 0.2, 0.9], 0.05)
    wall, block = (
        sw.constraints.Plane([0.0, 0.0, 0.5], [0.0, 3.0, 4.0]),
        sw.constraints.Box([9.0, 0.0, 0.0], [1.0, 99.0, 99.0]),
    )
    np.testing.assert_allclose(
        left(keep_out=[disc, ball, wall, block], radius=0.01),
        np.concatenate(
            [
                [np.hypot(a - 0.1, b - 0.2) - 0.05 for a, b in (tip[:2], bone[:2])],
                [np.linalg.norm(each - [0.1, 0.2, 0.9]) - 0.05 for each in (tip, bone)],
                [0.6 * each[1] + 0.8 * (each[2] - 0.5) for each in (tip, bone)],
                [8.0 - x, 8.0 - p],
            ]
        )
        - 0.01,
    )


# Closed loops -------------------------------------------------------------------------------------------------

FINGER_LOW, FINGER_HIGH = np.array([-0.22, -0.15]), np.array([0.22, 0.15])
TABLE_LOW, TABLE_HIGH = np.array([0.3, -0.8, -0.3]), np.array([0.9, 0.0, 0.3])


def in_box(body, low, high):
    def room(model, data):
        p = data.body(body).xpos[: low.size]
        return np.concatenate([p - low, high - p])

    return room


CASES = {
    "a box on Reacher": (
        "Reacher-v5",
        sw.constraints.Workspace([*FINGER_LOW, None], [*FINGER_HIGH, None], bodies=["fingertip"], horizon=10),
        in_box("fingertip", FINGER_LOW, FINGER_HIGH),
    ),
    "a disc on Reacher": (
        "Reacher-v5",
        sw.constraints.Workspace(
            keep_out=[sw.constraints.Disc([0.0, 0.15], 0.06)], geoms=["fingertip"], radius=0.01, horizon=10
        ),
        lambda model, data: np.linalg.norm(data.geom("fingertip").xpos[:2] - [0.0, 0.15]) - 0.07,
    ),
    "a box on Pusher": (
        "Pusher-v5",
        sw.constraints.Workspace(list(TABLE_LOW), list(TABLE_HIGH), bodies=["tips_arm"], horizon=8),
        in_box("tips_arm", TABLE_LOW, TABLE_HIGH),
    ),
}


def check_closed_loop(case, driver, steps, seeds):
    env_id, limit, room = CASES[case]
    filtered = sw.CBFActionFilter(gym.make(env_id, disable_env_checker=True), [limit])
    seen = drive(filtered, room, driver, steps, seeds)
    assert seen["intervened"] > 0 or driver != "bang_bang"  # the others may stay away from it
    assert seen["least"] > -5e-3  # infeasible steps may take it out, by a hair
    assert seen["outside"] <= seen["flagged"] <= 0.1 * seen["steps"]


@pytest.mark.parametrize("driver", DRIVERS)
@pytest.mark.parametrize("case", CASES)
def test_no_step_that_is_not_flagged_leaves_the_workspace(case, driver):
    check_closed_loop(case, driver, 60, [1])


def test_far_inside_the_actions_pass_bit_for_bit():
    limit = sw.constraints.Workspace(
        [-9.0] * 3, [9.0] * 3, [sw.constraints.Sphere([9.0, 0.0, 0.0], 1.0)], bodies=["tips_arm"]
    )
    check_inactive("Pusher-v5", limit, 2.0, 30)


# Plain data, and what is refused ------------------------------------------------------------------------------


FINGER = {"bodies": ["fingertip"]}


@pytest.mark.parametrize(
    ("arguments", "error", "message"),
    [
        (FINGER, ConfigurationError, r"give a bound in low or high \(m\), or something to keep_out of"),
        (
            {**FINGER, "low": [0.0, 1.0]},
            ConfigurationError,
            r"low is \[x, y, z\] in m, None where there is no",
        ),
        ({**FINGER, "high": [np.nan, 0.0, 0.0]}, ConfigurationError, "high must be finite"),
        (
            {**FINGER, "low": [0.0] * 3, "margin": np.nan},
            ConfigurationError,
            "margin must be a finite number >= 0",
        ),
        (
            {"bodies": "fingertip", "low": [0.0] * 3},
            ConfigurationError,
            "bodies is a list of names; got",
        ),
        ({"geoms": ["tip"], "low": [0.0] * 3}, UnknownNameError, "no geom 'tip'; it has: .*fingertip"),
    ],
)
def test_nonsense_is_refused(arguments, error, message):
    with pytest.raises(error, match=message):
        sw.CBFActionFilter(gym.make("Reacher-v5"), [sw.constraints.Workspace(**arguments)])


# A robot that pitches: what its body does after the wheels have stopped is not up to the actuators ---------------

PITCHING = """<mujoco><option timestep="0.005"/><worldbody><geom type="plane" size="9 9 .1"/>
<body name="chassis" pos="0 0 .145"><freejoint/><geom type="box" size=".15 .12 .03" mass="2"/>
<geom type="capsule" fromto="0 0 0 0 0 .45" size=".03" mass=".8"/>
<geom type="sphere" pos=".13 0 -.1" size=".045" friction="0 0 0" mass=".05"/>
<geom type="sphere" pos="-.13 0 -.1" size=".045" friction="0 0 0" mass=".05"/>
<body pos="0 .15 -.05"><joint name="left" axis="0 1 0"/>
<geom type="cylinder" size=".1 .02" euler="90 0 0" mass=".2"/></body>
<body pos="0 -.15 -.05"><joint name="right" axis="0 1 0"/>
<geom type="cylinder" size=".1 .02" euler="90 0 0" mass=".2"/></body>
</body></worldbody><actuator><velocity joint="left" kv="1" ctrlrange="-12 12" forcerange="-.6 .6"/>
<velocity joint="right" kv="1" ctrlrange="-12 12" forcerange="-.6 .6"/></actuator></mujoco>"""


@pytest.mark.parametrize("action", [0.0, 12.0])
def test_a_robot_parked_inside_the_margin_is_not_infeasible(action):
    env = Scene(PITCHING, frame_skip=10)
    env.reset()
    for _ in range(40):
        env.step(np.zeros(2))  # it settles on its springy contacts
    env.start = env.data.qpos.copy(), env.data.qvel.copy()
    limit = sw.constraints.Workspace(
        high=[float(env.data.body("chassis").xpos[0]) + 0.01, None, None], bodies=["chassis"], margin=0.02
    )
    filtered = sw.CBFActionFilter(env, [limit])
    filtered.reset()
    for _ in range(60):
        info = filtered.step(np.full(2, action))[4]
        assert not info["cbf/infeasible"] and not info["cbf/unsafe"]
        assert info["cbf/margin"] > 0.0099
