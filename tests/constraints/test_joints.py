"""Limits on joints: which joints are meant, in which ranges, and rows that are the plant's own prediction."""

import re

import gymnasium as gym
import numpy as np
import pytest
from asking import asked
from scenes import Scene

import safe_wrappers as sw
from safe_wrappers.errors import ConfigurationError

LIMITS = {
    "JointSpeedLimit": lambda **more: sw.constraints.JointSpeedLimit(3.0, **more),
    "JointPositionLimit": lambda **more: sw.constraints.JointPositionLimit(-7.0, 7.0, horizon=1, **more),
}


def listed(error):
    """Both lists of the message."""
    found = re.search(r"Covered would be: (.*)\. Not covered: (.*?)\. ", str(error.value))
    return [part.split(", ") for part in found.groups()]


def fetch(env_id):
    gym.register_envs(pytest.importorskip("gymnasium_robotics"))
    return gym.make(env_id)


@pytest.mark.parametrize("limit", LIMITS)
def test_an_arm_that_is_pulled_by_its_hand_is_not_left_out(limit):
    env = fetch("FetchPickAndPlace-v4")
    with pytest.raises(ConfigurationError, match=r"Name those that you mean: joints=\['robot0:") as caught:
        sw.CBFActionFilter(env, [LIMITS[limit]()])
    covered, rest = listed(caught)
    assert sorted(covered) == ["robot0:l_gripper_finger_joint", "robot0:r_gripper_finger_joint"]
    assert {"robot0:shoulder_pan_joint", "robot0:wrist_roll_joint"} <= set(rest) and len(rest) == 13
    for named in (rest, covered, covered + rest):
        filtered = sw.CBFActionFilter(fetch("FetchPickAndPlace-v4"), [LIMITS[limit](joints=named)])
        assert filtered.constraints[0].joints == named


@pytest.mark.parametrize(
    ("env_id", "covered", "rest"),
    [
        ("SafePointGoal0-v0", {"z"}, {"x", "y"}),  # pushed at a site
        (
            "SafeRover-v0",
            {"front_left", "front_right", "rear_left", "rear_right"},
            {"steer_left", "steer_right"},
        ),
    ],
)
def test_sites_and_tendons_move_joints_too(env_id, covered, rest):
    with pytest.raises(ConfigurationError) as caught:
        sw.CBFActionFilter(gym.make(env_id), [sw.constraints.JointSpeedLimit(3.0)])
    assert [set(names) for names in listed(caught)] == [covered, rest]


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
TIES = [
    ('<joint joint1="rocker" joint2="crank"/>', "", True),
    ('<tendon tendon1="one" tendon2="two"/>', "", True),
    ('<connect site1="end" site2="far"/>', "", True),
    ('<joint joint1="rocker" joint2="crank" active="false"/>', "", False),
    ("", 'range="0 2"', True),
    ("", 'stiffness="10"', True),
    ("", "", False),
]


@pytest.mark.parametrize(("equality", "cable", "tied"), TIES)
def test_joints_that_are_tied_to_driven_ones_are_not_left_out(equality, cable, tied):
    linkage = Scene(LINKAGE.format(equality=equality, cable=cable))
    if not tied:
        assert sw.CBFActionFilter(linkage, [sw.constraints.JointSpeedLimit(3.0)])
        return
    with pytest.raises(ConfigurationError) as caught:
        sw.CBFActionFilter(linkage, [sw.constraints.JointSpeedLimit(3.0)])
    assert listed(caught) == [["crank"], ["rod", "rocker", "loose"]]
    assert str(caught.value).endswith("joints=['crank', 'rod', 'rocker', 'loose']")


LEG = """
<mujoco><worldbody><geom type="plane" size="5 5 .1"/><body name="trunk" pos="0 0 .5"><freejoint/>
  <geom size=".1" mass="1"/><body name="leg"><joint name="hip" range="-1 1" limited="true" axis="0 1 0"/>
  <geom type="capsule" size=".02" fromto="0 0 0 0 0 -.4"/><body pos="0 0 -.4">{ankle}
  <geom name="foot" size=".05"/></body></body></body></worldbody>
  <tendon><fixed name="t">{tendon}</fixed></tendon>
  <actuator><motor joint="hip" ctrlrange="-1 1"/>{motor}</actuator></mujoco>
"""

ANKLE = '<joint name="ankle" range="-1 1" limited="true" axis="0 1 0"/>'

LEGS = {
    "tendon": (ANKLE, '<joint joint="ankle" coef="1"/>', '<motor tendon="t" ctrlrange="-1 1"/>'),
    "ball": ('<joint name="ankle" type="ball" range="0 1" limited="true"/>', '<joint joint="hip" coef="1"/>',
             '<motor joint="ankle" gear="0 1 0" ctrlrange="-1 1"/>'),
}  # fmt: skip


@pytest.mark.parametrize("kind", LEGS)
def test_stops_that_would_not_be_guarded_are_refused(kind):
    ankle, tendon, motor = LEGS[kind]
    leg = Scene(LEG.format(ankle=ankle, tendon=tendon, motor=motor))
    with pytest.raises(ConfigurationError, match="joint_tolerance=None leaves all joints alone") as caught:
        sw.WholeBodyFilter(leg)
    assert listed(caught) == [["hip"], ["ankle"]]
    sw.WholeBodyFilter(leg, joint_tolerance=None)
    with pytest.raises(ConfigurationError, match="Name those that you mean") as caught:
        sw.CBFActionFilter(leg, [sw.constraints.JointSpeedLimit(3.0)])
    assert listed(caught) == [["hip"], ["ankle"]]


# Values and rows ----------------------------------------------------------------------------------------------


def reacher(qpos, qvel):
    env = gym.make("Reacher-v5")
    env.reset(seed=0)
    env.unwrapped.data.qpos[:2], env.unwrapped.data.qvel[:2] = qpos, qvel
    return env


def test_value_and_rows_of_a_speed_are_the_plants_own_prediction():
    limit = asked(reacher([0.0, 0.0], [3.5, -3.0]), sw.constraints.JointSpeedLimit(4.0, margin=0.1))
    np.testing.assert_allclose(limit.value(), [0.5, 1.0])
    rows, plant = limit.rows(), limit.plant
    drift, effect = plant.acceleration
    for u in np.random.default_rng(0).uniform(-1, 1, (50, 2)):
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
    limit = asked(reacher([0.5, -1.0], [0.0, 0.0]), sw.constraints.JointPositionLimit(**arguments))
    np.testing.assert_allclose(limit.value(), left, atol=1e-12)
