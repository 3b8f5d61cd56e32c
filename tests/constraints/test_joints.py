"""Limits on joints, in their ranges, by the plant's own prediction; SingularityMargin against MuJoCo's Jacobians."""

import re

import gymnasium as gym
import mujoco
import numpy as np
import pytest
from asking import asked
from judged_loops import manipulability
from scenes import Scene, make

import safe_wrappers as sw
from safe_wrappers import constraints as of
from safe_wrappers.control.barriers import validated_threshold
from safe_wrappers.errors import ConfigurationError

LINKAGE = """
<mujoco><compiler autolimits="true"/><worldbody>
  <body><joint name="crank" axis="0 1 0"/><geom type="capsule" size=".02" fromto="0 0 0 .2 0 0" mass="1"/>
    <site name="tip" pos=".2 0 0"/>
    <body pos=".2 0 0"><joint name="rod" axis="0 1 0"/><geom size=".03" mass="1"/><site name="end"/></body></body>
  <body name="other" pos="0 1 0"><joint name="rocker" axis="0 1 0"/><geom size=".05" mass="1"/>
    <site name="far" pos=".1 0 0"/></body>
  <body pos="0 2 0"><joint name="loose" axis="0 1 0"/><geom size=".05" mass="1" pos=".1 0 0"/></body>
</worldbody>
<tendon><spatial name="cable" {cable}><site site="tip"/><site site="far"/></spatial>
  <fixed name="one"><joint joint="crank" coef="1"/></fixed><fixed name="two"><joint joint="rod" coef="1"/></fixed>
</tendon>
<equality>{equality}</equality>
<actuator><motor joint="crank" ctrlrange="-1 1"/></actuator></mujoco>
"""
LEG = """
<mujoco><worldbody><geom type="plane" size="5 5 .1"/><body name="trunk" pos="0 0 .5"><freejoint/>
  <geom size=".1" mass="1"/><body name="leg"><joint name="hip" range="-1 1" limited="true" axis="0 1 0"/>
  <geom type="capsule" size=".02" fromto="0 0 0 0 0 -.4"/><body pos="0 0 -.4">
  <joint name="ankle" range="-1 1" limited="true" axis="0 1 0"/><geom name="foot" size=".05"/></body></body></body>
  </worldbody><tendon><fixed name="t"><joint joint="ankle" coef="1"/></fixed></tendon>
  <actuator><motor joint="hip" ctrlrange="-1 1"/><motor tendon="t" ctrlrange="-1 1"/></actuator></mujoco>
"""
BALL_LEG = (
    LEG.replace(
        'name="ankle" range="-1 1" limited="true" axis="0 1 0"',
        'name="ankle" type="ball" range="0 1" limited="true"',
    )
    .replace('<joint joint="ankle" coef', '<joint joint="hip" coef')
    .replace('<motor tendon="t"', '<motor joint="ankle" gear="0 1 0"')
)


def linkage(equality="", cable=""):
    return Scene(LINKAGE.format(equality=equality, cable=cable))


def fetch():
    return make("FetchPickAndPlace-v4")


FINGERS = {"robot0:l_gripper_finger_joint", "robot0:r_gripper_finger_joint"}
WHEELS, STEERING = {"front_left", "front_right", "rear_left", "rear_right"}, {"steer_left", "steer_right"}
TIED = {"crank"}, {"rod", "rocker", "loose"}
LEFT_OUT = {
    "an arm that is pulled by its hand": (
        fetch,
        FINGERS,
        {"robot0:shoulder_pan_joint", "robot0:wrist_roll_joint"},
    ),
    "a body that is pushed at a site": (lambda: gym.make("SafePointGoal0-v0"), {"z"}, {"x", "y"}),
    "wheels that tendons steer": (lambda: gym.make("SafeRover-v0"), WHEELS, STEERING),
    "a joint tied to a joint": (lambda: linkage('<joint joint1="rocker" joint2="crank"/>'), *TIED),
    "a tendon tied to a tendon": (lambda: linkage('<tendon tendon1="one" tendon2="two"/>'), *TIED),
    "a site tied to a site": (lambda: linkage('<connect site1="end" site2="far"/>'), *TIED),
    "a cable that has a range": (lambda: linkage(cable='range="0 2"'), *TIED),
    "a cable that is a spring": (lambda: linkage(cable='stiffness="10"'), *TIED),
    "an ankle that a tendon drives": (lambda: Scene(LEG), {"hip"}, {"ankle"}),
    "an ankle that is a ball": (lambda: Scene(BALL_LEG), {"hip"}, {"ankle"}),
}


def listed(error):
    """Both lists of the message."""
    found = re.search(r"Covered would be: (.*)\. Not covered: (.*?)\. ", str(error.value))
    return [part.split(", ") for part in found.groups()]


@pytest.mark.parametrize("case", LEFT_OUT)
def test_driven_joints_are_named_where_a_limit_would_leave_some_out(case):
    make, covered, rest = LEFT_OUT[case]
    limits = [lambda **more: of.JointSpeedLimit(3.0, **more)]
    if make is fetch:
        limits.append(lambda **more: of.JointPositionLimit(-7.0, 7.0, horizon=1, **more))
    for limit in limits:
        with pytest.raises(ConfigurationError, match=r"Name those that you mean: joints=\[") as caught:
            sw.CBFActionFilter(make(), [limit()])
        found = listed(caught)
        assert set(found[0]) == covered and (
            set(found[1]) >= rest if make is fetch else set(found[1]) == rest
        )
        if "ankle" not in rest:
            for named in (*found, [*found[0], *found[1]]):
                assert sw.CBFActionFilter(make(), [limit(joints=named)]).constraints[0].joints == named
    if "ankle" in rest:
        with pytest.raises(
            ConfigurationError, match="joint_tolerance=None leaves all joints alone"
        ) as caught:
            sw.WholeBodyFilter(make())
        assert [set(names) for names in listed(caught)] == [covered, rest]
        sw.WholeBodyFilter(make(), joint_tolerance=None)


@pytest.mark.parametrize("equality", ["", '<joint joint1="rocker" joint2="crank" active="false"/>'])
def test_joints_that_nothing_drives_are_left_out(equality):
    assert sw.CBFActionFilter(linkage(equality), [of.JointSpeedLimit(3.0)])


# Values and rows ----------------------------------------------------------------------------------------------


def reacher(qpos, qvel):
    env = gym.make("Reacher-v5")
    env.reset(seed=0)
    env.unwrapped.data.qpos[:2], env.unwrapped.data.qvel[:2] = qpos, qvel
    return env


@pytest.mark.parametrize("most", [1.0, 5.0])
def test_value_and_rows_of_a_speed_are_the_plants_own_prediction(most):
    env = reacher([0.0, 0.0], [3.5, -3.0])
    env.unwrapped.model.actuator_ctrlrange[:] = -most, most
    env.unwrapped.model.actuator_gear[:] /= most
    env.unwrapped.action_space = gym.spaces.Box(-most, most, (2,), np.float32)
    limit = asked(env, of.JointSpeedLimit(4.0, margin=0.1))
    np.testing.assert_allclose(limit.value(), [0.5, 1.0])
    rows, plant = limit.rows(), limit.plant
    drift, effect = plant.acceleration
    for u in np.random.default_rng(0).uniform(-most, most, (50, 2)):
        after = plant.qvel[:2] + plant.control_dt * (drift + effect @ u)[:2]
        assert (rows.normals @ u <= rows.offsets).all() == (np.abs(after) <= 3.9).all()


@pytest.mark.parametrize(
    ("arguments", "left"),
    [
        ({}, [2.0, 4.0]),  # joint0 turns without end, joint1 from -3 to 3
        ({"upper": 2.0}, [2.0, 1.5, 3.0]),
        ({"lower": -2.0, "upper": 1.0}, [2.5, 1.0, 0.5, 2.0]),
        ({"lower": [-3.0, -1.0], "upper": [0.0, np.inf], "joints": ["joint1", "joint0"]}, [2.0, 1.5, 1.0]),
        ({"lower": -np.inf, "upper": 2.0, "joints": ["joint0"]}, [1.5]),
    ],
)
def test_one_value_per_bound_of_a_position_that_there_is(arguments, left):
    limit = asked(reacher([0.5, -1.0], [0.0, 0.0]), of.JointPositionLimit(**arguments))
    np.testing.assert_allclose(limit.value(), left, atol=1e-12)


# SingularityMargin --------------------------------------------------------------------------------------------

CHAIN = """<mujoco><compiler angle="radian"/><option timestep="0.002"><flag contact="disable"/></option><worldbody>
<body name="base" pos=".1 0 1" euler="20 10 30"><joint name="rail" type="slide" axis="1 .2 0" range="-.5 .5"
  limited="true"/><geom size=".05"/>
<body name="upper" pos="0 .1 .1"><joint name="a" axis="0 1 0"/><joint name="b" axis=".3 0 1" pos=".1 0 0"/>
<geom type="capsule" fromto="0 0 0 .3 .1 0" size=".02"/>
<body name="lower" pos=".3 .1 0" euler="20 30 40"><joint name="c" axis="1 .2 0" range="-2 2" limited="true"/>
<geom name="shin" type="box" pos=".1 .05 .02" quat=".5 .5 .1 .2" size=".05 .02 .03"/>
<body name="hand" pos=".2 0 .1"><joint name="d" axis="0 0 1"/><geom size=".03"/>
<site name="tip" pos=".2 -.1 .05" euler="10 0 70"/></body></body></body></body></worldbody>
<actuator><motor joint="rail" ctrlrange="-50 50"/><motor joint="a" ctrlrange="-9 9"/>
<motor joint="b" ctrlrange="-9 9"/><motor joint="c" ctrlrange="-3 3"/></actuator></mujoco>"""
"""A slide and hinges, two in one body and off its origin, frames turned against each other; d has no motor."""
DRIVEN = ["rail", "a", "b", "c"]


TASKS = {
    "a site, all directions": ({"site": "tip"}, {}),
    "a geom, two directions": ({"geom": "shin", "directions": "zx"}, {"directions": "zx"}),
    "as many joints as directions": (
        {"site": "tip", "joints": ["a", "b", "c"]},
        {"joints": ["a", "b", "c"]},
    ),
}


@pytest.mark.parametrize("task", TASKS)
def test_w_is_that_of_mujoco_s_jacobian_now_and_ahead(task):
    arguments, truth = TASKS[task]
    env, threshold = Scene(CHAIN), 1e-3
    limit = asked(env, of.SingularityMargin(threshold, horizon=2, **arguments))
    plant = limit.plant
    kind = next(k for k in ("site", "body", "geom") if k in arguments)
    rng, still = np.random.default_rng(0), mujoco.MjData(env.model)

    def expected(qpos):
        still.qpos[:] = qpos
        mujoco.mj_kinematics(env.model, still)
        return (
            manipulability(env.model, still, kind, arguments[kind], **{"joints": DRIVEN, **truth}) / threshold
            - 1.0
        )

    for _ in range(8):
        env.data.qpos[:], env.data.qvel[:] = rng.uniform(-1.5, 1.5, (2, 5))
        plant.observe()
        assert limit.value() == pytest.approx(expected(env.data.qpos), rel=1e-9, abs=1e-9)
        forecast = plant.rollout(rng.uniform(-3.0, 3.0, 4), 2)
        room = limit.h_along(forecast)
        assert room.shape == (10, 1)
        for k in range(10):
            # Beyond a singular pose a square task counts as negative; the difference has a test of its own.
            assert abs(room[k, 0] + 1.0) == pytest.approx(
                expected(forecast.qpos[k]) + 1.0, rel=1e-8, abs=1e-8
            )


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_a_square_task_is_not_passed_through_its_singular_pose(side):
    spec = of.SingularityMargin(0.003, body="fingertip", directions="xy")
    limit = asked(reacher([0.3, side * 0.5], [0.0, -side * 40.0]), spec)
    assert limit.value() == pytest.approx(0.011 * np.sin(0.5) / 0.003 - 1.0)
    forecast = limit.plant.rollout(np.zeros(2), 2)
    crossing = side * forecast.qpos[:, 1]
    assert crossing.min() < -0.2  # it does pass through, to where w is large again
    np.testing.assert_allclose(limit.h_along(forecast)[:, 0], 0.011 * np.sin(crossing) / 0.003 - 1.0)
    assert not limit.admits(np.zeros(2))


# A validated threshold ----------------------------------------------------------------------------------------


def test_a_validated_threshold_is_that_of_the_sampled_configurations():
    env = Scene(CHAIN)
    limit = asked(env, of.SingularityMargin(site="tip", task_speed=0.1, rate_limit=2.0))
    # Of a second draw, by MuJoCo's Jacobians.
    rng, data, jacobians = np.random.default_rng(5), mujoco.MjData(env.model), np.zeros((2000, 3, 5))
    for jacobian in jacobians:
        data.qpos[:] = rng.uniform([-0.5, -np.pi, -np.pi, -2.0, -np.pi], [0.5, np.pi, np.pi, 2.0, np.pi])
        mujoco.mj_kinematics(env.model, data)
        mujoco.mj_comPos(env.model, data)
        mujoco.mj_jacSite(env.model, data, jacobian, None, env.model.site("tip").id)
    found = limit.spec.validated
    assert validated_threshold(jacobians[:, :, :4], 0.1, 2.0) == pytest.approx(found, rel=0.2)
    given = asked(env, of.SingularityMargin(found, site="tip"))
    assert given.spec.validated is None and given.value() == limit.value()


def test_a_pose_with_a_position_that_is_no_number_has_no_manipulability():
    env = gym.make("Reacher-v5")
    limit = asked(env, of.SingularityMargin(1e-4, body="fingertip", directions="xy"))
    path = limit.plant.rollout(np.zeros(2), 2)
    path.qpos[:3] = [0.3, 0.8, 0.1, 0.1]
    # The target's position, which does not carry the arm, and the arm's own.
    path.qpos[1, 2], path.qpos[2, 0] = np.nan, np.inf
    found = limit.h_along(path)[:3, 0]
    assert found[0] == pytest.approx(0.1 * 0.11 * np.sin(0.8) / 1e-4 - 1.0) and np.isnan(found[1:]).all()
