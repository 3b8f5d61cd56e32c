"""OcclusionPenalty: what is not seen is estimated as declared; sensors, inertial units, permissions, penalties."""

import gymnasium as gym
import mujoco
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from oracles import blind_covariance
from scenes import Scene
from scipy.spatial.transform import Rotation

import safe_wrappers as sw
from benchmarks.cases import crossing
from safe_wrappers.errors import ConfigurationError, SafeWrappersError
from safe_wrappers.wrappers.occlusion import Imu, Sensor, Track

TEXT = """
<mujoco>
  <option timestep="0.01" gravity="0 0 0"/>
  <default><geom contype="0" conaffinity="0"/></default>
  <worldbody>
    <geom type="box" pos="2 0 {wall}" size="0.1 3 1"/>
    <body name="robot" pos="0.2 -0.1 0.5">
      <joint name="turn" axis="0 0 1"/><geom size="0.05" mass="1"/>
      <site name="eye" pos="{arm}" euler="30 40 50"/>
    </body>
    <body name="thing" pos="0 0 0.5">
      <joint type="slide" axis="1 0 0"/><joint type="slide" axis="0 1 0"/><geom size="0.1" mass="1"/>
      <site name="elsewhere"/>
    </body>
    <body name="thing2" pos="0 0 0.5">
      <joint type="slide" axis="1 0 0"/><joint type="slide" axis="0 1 0"/><geom size="0.1" mass="1"/>
    </body>
  </worldbody>
  <actuator><motor joint="turn" ctrlrange="-1 1"/></actuator>
</mujoco>"""
HIGH, LEVEL = 9.0, 0.5
"""Where the wall stands: above everything, or between the robot and what is beyond 2 m."""


class Turning(Scene):
    """A robot that turns, things that drive straight on, and a wall between.

    `start` is qpos and qvel at every reset: heading, thing's x and y, thing2's x and y.
    """

    spots = np.array([[1.0, 0.0], [0.0, 1.0]])

    def __init__(self, start=((0, 1, 0, -1, 0), (0, 0, 0, 0, 0)), wall=HIGH, arm="0.4 0 0"):
        self.start = start
        self.build(TEXT.format(wall=wall, arm=arm))

    def build(self, text):
        super().__init__(text, frame_skip=4)
        self.observation_space = gym.spaces.Box(-np.inf, np.inf, (1,), np.float64)


STILL = np.zeros(1)
EYE, BLIND = Sensor(site="eye", position_std=0.05), Sensor(site="eye", range_m=0.01)


def straight(bodies="thing", **options):
    """A track of what drives straight on, without noise in its motion."""
    return Track(
        bodies, **{"acceleration_noise": 0.0, "start_position_std": 0.3, "start_velocity_std": 0.3} | options
    )


def looking(world, track, sensor=EYE, tolerance=1.0, **options):
    env = sw.OcclusionPenalty(world, [track], sensor, tolerance, **options)
    env.reset(seed=0)
    return env


def steps(env, count, seed=0):
    rng = np.random.default_rng(seed)
    low, high = env.action_space.low, env.action_space.high
    for _ in range(count):
        yield env.step(rng.uniform(low, high).astype(env.action_space.dtype))


# What is estimated ------------------------------------------------------------------------------------------------


def test_errors_have_the_covariances_that_are_given_seen_and_unseen():
    env = crossing(gym.make("OccludedCrossing-v0"))
    raw, squared = env.unwrapped, {True: [], False: []}
    for seed in range(60):
        env.reset(seed=seed)
        for k, (*_, info) in enumerate(steps(env, 50, seed)):
            if k in (9, 29, 49):
                error = raw.data.qpos[3:] - env.tracking.positions[:, 0]
                ratio = error**2 / env.tracking.position_covariances[:, 0, 0]
                for seen, value in zip(info["occlusion/visible"], ratio, strict=True):
                    squared[bool(seen)].append(value)
        np.testing.assert_allclose(env.tracking.positions[:, 1], raw.car_positions[:, 1], atol=1e-9)
    # Chi-square with one degree of freedom: mean 1, variance 2; samples of a car share some of their noise.
    for values in squared.values():
        assert len(values) > 100
        assert abs(np.mean(values) - 1.0) < 5.0 * np.sqrt(2.0 * 3 / len(values)), np.mean(values)
        assert 0.6 < np.mean(np.array(values) < 1.0) < 0.77  # 68 %


@pytest.mark.parametrize("arm", ["0.4 0 0", "0.1 -0.3 0.2"])
def test_a_sharp_sensor_on_a_lever_arm_sees_the_truth(arm):
    sure = straight(start_position_std=10.0, start_velocity_std=10.0, acceleration_noise=1e6)
    spin = Turning(((0.3, 2.0, -1.0, -1, 0), (3.0, 0.5, 0.2, 0, 0)), arm=arm)
    env = looking(spin, sure, Sensor(site="eye", position_std=1e-6, velocity_std=1e-6))
    for _ in range(30):
        env.step(np.array([0.5]))
        truth = np.concatenate([spin.data.qpos[1:3], spin.data.qvel[1:3]])
        np.testing.assert_allclose(env.tracking.mean[0], truth, atol=2e-5)


def test_velocities_alone_leave_positions_unresolved_and_it_says_so():
    env = looking(Turning(), straight("thing*"), Sensor(site="eye", position_std=None, velocity_std=0.1))
    assert env.unobservable == {"thing": ["x", "y"], "thing2": ["x", "y"]}
    assert crossing(gym.make("OccludedCrossing-v0")).unobservable == {f"car{i}": [] for i in range(6)}
    fix = env.last_seen_positions.copy()
    for _ in range(100):
        info = env.step(STILL)[4]
    assert info["occlusion/visible"].all() and (info["occlusion/sigma"] >= 0.3).all()
    assert (env.last_seen_positions == fix).all()
    assert np.sqrt(env.tracking.covariance[:, 2, 2]).max() < 0.02


def test_a_wall_hides_last_seen_stays_and_permission_comes_back_in_sight():
    # One comes out from behind the wall, one drives behind it.
    world = Turning(((0, 2.5, 2.0, 1.5, 0), (0, 0, 1.0, 1.0, 0)), LEVEL)
    env = looking(world, straight("thing*", acceleration_noise=0.2, start_position_std=1.0), tolerance=0.5)
    for k in range(80):
        before = env.last_seen_positions.copy()
        info = env.step(STILL)[4]
        visible = info["occlusion/visible"]
        assert (env.last_seen_positions == before).all(axis=1).tolist() == (~visible).tolist()
        assert visible[1] == (1.5 + 0.04 * (k + 1) < 2.0)  # its ball sticks out until then
        if k == 0:
            assert info["occlusion/expired"].tolist() == [True, False] == (~visible).tolist()
    assert visible[0] and not info["occlusion/expired"][0]


def test_published_points_that_are_no_number_are_not_seen_and_other_points_are_refused():
    world = Turning()
    env = looking(world, Track(published="spots", acceleration_noise=0.1))
    assert env.track_names == ["spots[0]", "spots[1]"]
    world.spots = np.array([[np.nan, 0.0], [0.0, 1.0]])
    observation, _, _, _, info = env.step(STILL)
    assert info["occlusion/visible"].tolist() == [False, True] and np.isfinite(observation).all()
    world.spots = np.zeros((3, 2))
    with pytest.raises(ConfigurationError, match="had 2 points when the wrapper was made, and has 3 now"):
        env.step(STILL)


def test_another_model_is_looked_at_from_the_next_reset_on_if_it_has_the_same_things():
    world = Turning(wall=LEVEL)
    env = looking(world, straight("thing*"))
    world.start = ((0, 2.5, 0, -1, 0), (0, 0, 0, 0, 0))
    assert env.reset(seed=0)[1]["occlusion/visible"].tolist() == [False, True]
    world.build(TEXT.format(wall=HIGH, arm="0.4 0 0"))
    assert env.reset(seed=0)[1]["occlusion/visible"].all()
    world.build(world.xml.replace("thing2", "thingy"))
    with pytest.raises(ConfigurationError, match="other things: thing, thingy and not thing, thing2"):
        env.reset(seed=0)


# Time, and permissions --------------------------------------------------------------------------------------------


@given(
    q=st.floats(1e-3, 5.0),
    tolerance=st.floats(0.5, 3.0),
    sigmas=st.floats(0.5, 4.0),
    reversion=st.sampled_from([None, 0.3, 3.0]),
)
@settings(max_examples=12)
def test_sigma_is_the_closed_form_and_permission_ends_in_the_step_before_the_bound_crosses(
    q, tolerance, sigmas, reversion
):
    track = straight(acceleration_noise=q, reversion_s=reversion)
    env = looking(Turning(), track, BLIND, tolerance, sigmas=sigmas)
    info = env.reset(seed=0)[1]
    a, _, noise = track.motion(2).matrices()

    def bound(time_s):
        return sigmas * np.sqrt(blind_covariance(np.diag([0.09] * 4), a, noise, time_s)[0, 0])

    now, expired = 0.3 * sigmas, False
    for k in range(1, 40):
        assert sigmas * info["occlusion/sigma"][0] == pytest.approx(now, rel=1e-9)
        if expired:
            break
        now, expired = bound(0.04 * k), info["occlusion/expired"][0]
        assert now > tolerance * (1 - 1e-12) if expired else now <= tolerance * (1 + 1e-12)
        info = env.step(STILL)[4]


@pytest.mark.parametrize("jump_s", [-0.04, 0.0, 0.3])
def test_what_counts_is_the_time_of_the_simulation(jump_s):
    env = looking(Turning(), straight(acceleration_noise=0.2), BLIND)
    env.unwrapped.data.time += jump_s
    a, _, noise = straight(acceleration_noise=0.2).motion(2).matrices()
    variance = blind_covariance(np.diag([0.09] * 4), a, noise, 0.04 + jump_s)[0, 0]
    assert env.step(STILL)[4]["occlusion/sigma"][0] == pytest.approx(np.sqrt(variance), rel=1e-9)


def test_time_that_runs_backwards_is_an_error():
    env = looking(Turning(), straight())
    env.unwrapped.data.time -= 0.05
    with pytest.raises(
        SafeWrappersError, match=r"backwards by 0\.01 s within a step\. Reset the env instead"
    ):
        env.step(STILL)


# Reward and observation -------------------------------------------------------------------------------------------


def test_the_penalty_is_what_it_says_is_taken_off_and_not_counted_as_the_task_s():
    env = crossing(gym.make("OccludedCrossing-v0"), tolerance=0.8, weight=0.3)
    env = sw.RecordInterventions(gym.wrappers.TimeLimit(env, 150))
    bare, tracking = gym.make("OccludedCrossing-v0"), env.get_wrapper_attr("tracking")
    env.reset(seed=3)
    bare.reset(seed=3)
    near_all, seen, total = [], [], 0.0
    for (_, reward, _, _, info), (_, task, *_) in zip(steps(env, 150, 1), steps(bare, 150, 1), strict=True):
        heading = env.unwrapped.agent_heading
        eye = env.unwrapped.data.qpos[:2] + 0.15 * np.array([np.cos(heading), np.sin(heading)])
        near = np.linalg.norm(tracking.positions - eye, axis=1) <= 6.0
        share = np.minimum(1.0, 3.0 * info["occlusion/sigma"] / 0.8) ** 2
        expected = 0.3 * share[near].mean() if near.any() else 0.0
        assert info["occlusion/penalty"] == pytest.approx(expected, abs=1e-12)
        assert reward == pytest.approx(task - expected, abs=1e-12)
        near_all.append(near.all())
        seen.append(info["occlusion/visible"].mean())
        total += task
    assert not all(near_all)
    assert info["interventions"]["return"] == pytest.approx(total, abs=1e-9)
    assert info["interventions"]["seen"] == pytest.approx(np.mean(seen)) and 0.0 < np.mean(seen) < 1.0


@pytest.mark.parametrize("axes", ["xy", "xyz"])
def test_the_observation_gains_the_estimates_relative_to_the_robot(axes):
    d = len(axes)
    cars = [Track("car*", acceleration_noise=0.1)]
    env = sw.OcclusionPenalty(gym.make("OccludedCrossing-v0"), cars, "eye", 1.0, axes=axes)
    bare = gym.make("OccludedCrossing-v0")
    seen = [env.reset(seed=2)[0], *(s[0] for s in steps(env, 20))]
    plain = [bare.reset(seed=2)[0], *(s[0] for s in steps(bare, 20))]
    assert env.observation_space.shape == (17 + 6 * 3 * d,)
    for mine, theirs in zip(seen, plain, strict=True):
        assert mine[:17].tobytes() == theirs.tobytes() and env.observation_space.contains(mine)
    table = seen[-1][17:].reshape(6, 3, d)
    robot = np.array([*env.unwrapped.agent_position, 0.0])[:d]
    np.testing.assert_allclose(table[:, 0], env.tracking.positions - robot, atol=1e-12)
    np.testing.assert_array_equal(table[:, 1], env.tracking.velocities)
    deviations = np.sqrt(np.einsum("nii->ni", env.tracking.position_covariances))
    np.testing.assert_allclose(table[:, 2], deviations, atol=1e-12)


# Inertial units ---------------------------------------------------------------------------------------------------

PUSH = np.full(1, 0.004)  # about 4 rad/s²


def reckoning(position_std=1e-3, **options):
    sensor = Sensor(site="eye", position_std=position_std, imu=Imu("eye", **options))
    return looking(Turning(), straight("thing*", acceleration_noise=1e6), sensor, tolerance=0.5)


def test_its_readings_are_those_of_mujocos_sensors():
    env = reckoning()
    raw = env.unwrapped
    spec = mujoco.MjSpec.from_string(raw.xml)
    for kind in (mujoco.mjtSensor.mjSENS_ACCELEROMETER, mujoco.mjtSensor.mjSENS_GYRO):
        spec.add_sensor(type=kind, objtype=mujoco.mjtObj.mjOBJ_SITE, objname="eye")
    model = spec.compile()
    data = mujoco.MjData(model)
    for action in (PUSH, -PUSH, 0.3 * PUSH, PUSH):
        data.qpos[:], data.qvel[:], data.ctrl[:] = raw.data.qpos, raw.data.qvel, action
        mujoco.mj_forward(model, data)
        forces, before = [], data.site("eye").xmat.reshape(3, 3).copy()
        for _ in range(raw.frame_skip):
            mujoco.mj_forward(model, data)
            forces.append(data.site("eye").xmat.reshape(3, 3) @ data.sensordata[:3])
            mujoco.mj_step(model, data)
        mujoco.mj_forward(model, data)
        env.step(action)
        np.testing.assert_allclose(env.ego_motion.rate, data.sensordata[3:], atol=1e-12)
        turn = Rotation.from_matrix(before.T @ data.site("eye").xmat.reshape(3, 3))
        middle = before @ Rotation.from_rotvec(0.5 * turn.as_rotvec()).as_matrix()
        expected = np.mean(forces, axis=0) @ middle
        np.testing.assert_allclose(env.ego_motion.specific_force, expected, rtol=0.05, atol=0.03)
        assert np.linalg.norm(env.ego_motion.specific_force) > 0.3


def test_what_is_seen_is_put_where_the_reckoned_pose_has_it():
    env = reckoning(1e-6, accelerometer_std=1.0, gyro_std=0.5)
    for _ in range(40):
        observation = env.step(PUSH)[0]
    ego, raw = env.ego_motion, env.unwrapped
    mujoco.mj_kinematics(raw.model, raw.data)  # poses lag a substep behind after a step
    truth = raw.data.body("robot")
    turned = ego.orientation * Rotation.from_matrix(truth.xmat.reshape(3, 3)).inv()
    assert turned.magnitude() > 0.01 and np.linalg.norm(ego.position - truth.xpos) > 0.01
    for name, seen in zip(env.track_names, env.tracking.positions, strict=True):
        apparent = ego.position + turned.apply(raw.data.body(name).xpos - truth.xpos)
        np.testing.assert_allclose(seen, apparent[:2], atol=2e-5)
    np.testing.assert_allclose(observation[1:3] + ego.position[:2], env.tracking.positions[0], atol=1e-9)


def reckoned(env):
    """By how much position, m, velocity, m/s, and orientation, rad, of the body are off, shape (3, 3)."""
    ego, raw = env.ego_motion, env.unwrapped
    mujoco.mj_kinematics(raw.model, raw.data)
    truth, six = raw.data.body("robot"), np.zeros(6)
    mujoco.mj_objectVelocity(raw.model, raw.data, mujoco.mjtObj.mjOBJ_XBODY, truth.id, six, 0)
    turned = ego.orientation * Rotation.from_matrix(truth.xmat.reshape(3, 3)).inv()
    return np.array([ego.position - truth.xpos, ego.velocity - six[3:], turned.as_rotvec()])


def test_the_errors_of_a_step_are_those_of_its_readings():
    env, off, rate = reckoning(accelerometer_std=1.0, gyro_std=0.5), [], []
    for seed in range(200):
        env.reset(seed=seed)
        env.step(STILL)
        off.append(reckoned(env))
        rate.append(env.ego_motion.rate)
    deviation = np.std(off, axis=0)
    across = np.hypot(0.04, 0.4 * 0.5)  # on an arm of 0.4 m the turn rate matters, too
    np.testing.assert_allclose(deviation[1], [0.04, across, across], rtol=0.2)
    np.testing.assert_allclose(deviation[2], 0.5 * 0.04, rtol=0.2)
    np.testing.assert_allclose(np.std(rate, axis=0), 0.5, rtol=0.2)


def test_errors_add_up_until_the_next_fix():
    env, off = reckoning(accelerometer_std=1.0, gyro_std=0.5, fix_every_s=0.4), []
    for _ in range(30):
        env.step(PUSH)
        off.append(np.abs(reckoned(env)[[0, 2]]).max())
    assert (np.array(off) < 1e-9).nonzero()[0].tolist() == [9, 19, 29]
    assert max(off) > 1e-3


def test_a_unit_on_another_body_is_refused():
    sensor = Sensor(site="eye", imu=Imu("elsewhere"))
    with pytest.raises(
        ConfigurationError, match="is on the body 'thing' and not on 'robot', as the sensor is"
    ):
        looking(Turning(), straight(), sensor)
