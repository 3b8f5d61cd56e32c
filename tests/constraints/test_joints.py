"""Limits on all joints: what an action moves without an actuator on the joint is not left out in silence."""

import re

import gymnasium as gym
import mujoco
import numpy as np
import pytest
from gymnasium.envs.mujoco import MujocoEnv

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


def test_named_the_arm_keeps_its_limit():
    speeds = {}
    for named in (True, False):
        env = fetch("FetchPickAndPlace-v4")
        model, raw = env.unwrapped.model, env.unwrapped
        arm = [
            model.joint(j).name for j in range(model.njnt) if model.jnt_type[j] == mujoco.mjtJoint.mjJNT_HINGE
        ]
        fingers = ["robot0:l_gripper_finger_joint", "robot0:r_gripper_finger_joint"]
        env = sw.CBFActionFilter(
            env, [sw.constraints.JointSpeedLimit(3.0, joints=arm if named else fingers, margin=0.02)]
        )
        env.reset(seed=0)
        dofs = [int(model.joint(name).dofadr[0]) for name in arm]
        speeds[named] = 0.0
        for way in np.random.default_rng(0).choice([-1.0, 1.0], size=(6, 4)).repeat(4, axis=0):
            info = env.step(way.astype(np.float32))[-1]
            assert not info["cbf/infeasible"]
            speeds[named] = max(speeds[named], float(np.abs(raw.data.qvel[dofs]).max()))
    assert speeds[True] <= 3.0 < speeds[False]


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


def test_passive_joints_of_a_machine_driven_at_its_joints_need_no_names():
    for env_id, driven in (("InvertedDoublePendulum-v5", 1), ("Pusher-v5", 7), ("Ant-v5", 8)):
        filtered = sw.CBFActionFilter(gym.make(env_id), [sw.constraints.JointSpeedLimit(3.0)])
        filtered.reset(seed=0)
        assert filtered.filter.bound[0].value().size == driven


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
  <spatial name="across"  {across}><site site="tip"/><site site="end"/></spatial>
  <fixed name="one"><joint joint="crank" coef="1"/></fixed><fixed name="two"><joint joint="rod" coef="1"/></fixed>
</tendon>
<equality>{equality}</equality>
<actuator><motor joint="crank" ctrlrange="-1 1"/></actuator></mujoco>
"""
TIES = [
    ('<joint joint1="rocker" joint2="crank"/>', "", ["rocker"]),
    ('<tendon tendon1="one" tendon2="two"/>', "", ["rod"]),
    ('<connect site1="end" site2="far"/>', "", ["rod", "rocker"]),
    ('<weld body1="other"/>', "", []),  # to the world: the drive does not move it
    ('<joint joint1="rocker"/>', "", []),
    ('<joint joint1="rocker" joint2="crank" active="false"/>', "", []),
    ("", 'range="0 2"', ["rocker"]),
    ("", 'stiffness="10"', ["rocker"]),
    ("", "", []),
    ("", "across", []),  # from the driven link to the next one: the drive moves both
]


@pytest.mark.parametrize(("equality", "cable", "rest"), TIES)
def test_joints_that_are_tied_to_driven_ones_are_not_left_out(tmp_path, equality, cable, rest):
    path = tmp_path / "linkage.xml"
    tendons = {"cable": "", "across": 'range="0 2"'} if cable == "across" else {"cable": cable, "across": ""}
    path.write_text(LINKAGE.format(equality=equality, **tendons))
    if not rest:
        assert sw.CBFActionFilter(Leg(path), [sw.constraints.JointSpeedLimit(3.0)])
        return
    with pytest.raises(ConfigurationError) as caught:
        sw.CBFActionFilter(Leg(path), [sw.constraints.JointSpeedLimit(3.0)])
    assert listed(caught) == [["crank"], rest]
    assert str(caught.value).endswith("joints=['crank', 'rod', 'rocker', 'loose']")


def test_a_hand_s_last_finger_joints_hang_on_tendons():
    with pytest.raises(ConfigurationError) as caught:
        sw.CBFActionFilter(fetch("HandReach-v3"), [sw.constraints.JointSpeedLimit(3.0)])
    assert listed(caught)[1] == [f"robot0:{finger}J0" for finger in ("FF", "MF", "RF", "LF")]


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


class Leg(MujocoEnv):
    """A trunk on a leg; the ankle's actuator is not on a hinge."""

    metadata = {"render_modes": ["human", "rgb_array", "depth_array", "rgbd_tuple"], "render_fps": 100}  # noqa: RUF012

    def __init__(self, path):
        space = gym.spaces.Box(-np.inf, np.inf, (1,))
        super().__init__(str(path), 5, space)

    def reset_model(self):
        return np.zeros(1)

    def step(self, action):
        self.do_simulation(action, self.frame_skip)
        return np.zeros(1), 0.0, False, False, {}


@pytest.mark.parametrize("kind", LEGS)
@pytest.mark.parametrize("contacts", ["forecast", "pyramid"])
def test_stops_that_would_not_be_guarded_are_refused(tmp_path, kind, contacts):
    ankle, tendon, motor = LEGS[kind]
    path = tmp_path / "leg.xml"
    path.write_text(LEG.format(ankle=ankle, tendon=tendon, motor=motor))
    with pytest.raises(ConfigurationError, match="joint_tolerance=None leaves all joints alone") as caught:
        sw.WholeBodyFilter(Leg(path), contacts=contacts)
    assert listed(caught) == [["hip"], ["ankle"]]
    sw.WholeBodyFilter(Leg(path), contacts=contacts, joint_tolerance=None)
    with pytest.raises(ConfigurationError, match="leaves all joints alone"):
        sw.CBFActionFilter(Leg(path), [sw.constraints.Stance()])
    sw.CBFActionFilter(Leg(path), [sw.constraints.Stance(joint_tolerance=None)])
    with pytest.raises(ConfigurationError, match="Name those that you mean") as caught:
        sw.CBFActionFilter(Leg(path), [sw.constraints.JointSpeedLimit(3.0)])
    assert listed(caught) == [["hip"], ["ankle"]]


def test_a_finger_is_not_the_whole_arm_of_a_singularity_margin():
    env = fetch("FetchPickAndPlace-v4")
    finger = {"body": "robot0:r_gripper_finger_link", "threshold": 1e-6}
    with pytest.raises(ConfigurationError, match="Name those that do the task: joints=") as caught:
        sw.CBFActionFilter(env, [sw.constraints.SingularityMargin(**finger)])
    arm = [name for name in listed(caught)[1] if "_joint" in name and "torso" not in name]
    assert len(arm) == 7
    sw.CBFActionFilter(
        fetch("FetchPickAndPlace-v4"), [sw.constraints.SingularityMargin(**finger, joints=arm)]
    )
