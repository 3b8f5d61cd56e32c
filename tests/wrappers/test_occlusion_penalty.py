"""What is not seen is estimated as declared: tracks, sensors, inertial units, penalties."""

import gymnasium as gym
import mujoco
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from occlusion_world import STILL, WALL, Turning, straight
from oracles import blind_covariance, double_integrator_covariance
from scipy.spatial.transform import Rotation

import safe_wrappers as sw

EYE = sw.occlusion.Sensor(site="eye", position_std=0.05)


def crossing(weight=0.0, tolerance=1.0, sensor=None, **options):
    cars = [
        sw.occlusion.Track(
            f"car[{names}]",
            acceleration_noise=[0.0225, 0.0],
            reversion_s=2.0,
            mean_velocity=[speed, 0.0],
            start_position_std=[0.3, 0.0],
            start_velocity_std=[0.15, 0.0],
        )
        for names, speed in (("012", 1.0), ("345", -1.0))
    ]
    sensor = sensor or sw.occlusion.Sensor("eye", view_deg=120, range_m=6.0)
    return sw.OcclusionPenalty(gym.make("OccludedCrossing-v0"), cars, sensor, tolerance, weight, **options)


def steps(env, count, seed=0):
    rng = np.random.default_rng(seed)
    low, high = env.action_space.low, env.action_space.high
    for _ in range(count):
        yield env.step(rng.uniform(low, high).astype(env.action_space.dtype))


# What is estimated ------------------------------------------------------------------------------------------------


def test_errors_have_the_covariances_that_are_given_seen_and_unseen():
    env = crossing()
    raw = env.unwrapped
    squared = {True: [], False: []}
    for seed in range(60):
        env.reset(seed=seed)
        info = None
        for k, (_, _, _, _, info) in enumerate(steps(env, 50, seed)):
            if k in (9, 29, 49):
                error = raw.data.qpos[3:] - env.tracking.positions[:, 0]
                ratio = error**2 / env.tracking.position_covariances[:, 0, 0]
                for seen, value in zip(info["occlusion/visible"], ratio, strict=True):
                    squared[bool(seen)].append(value)
        np.testing.assert_allclose(env.tracking.positions[:, 1], raw.car_positions[:, 1], atol=1e-9)
        assert (info["occlusion/sigma"] >= 0).all()
    # Chi-square with one degree of freedom: mean 1, variance 2; samples of a car share some of their noise.
    for values in squared.values():
        assert len(values) > 100
        assert abs(np.mean(values) - 1.0) < 5.0 * np.sqrt(2.0 * 3 / len(values)), np.mean(values)
        assert 0.6 < np.mean(np.array(values) < 1.0) < 0.77  # 68 %


def test_unseen_sigma_is_the_closed_form():
    blind = sw.occlusion.Sensor(site="eye", range_m=0.01)
    env = sw.OcclusionPenalty(Turning(), [straight(acceleration_noise=0.2)], blind, tolerance=100.0)
    env.reset(seed=0)
    start = np.diag([0.09, 0.09])
    for k in range(1, 80):
        info = env.step(STILL)[4]
        sigma = np.sqrt(double_integrator_covariance(start, 0.2, 0.04 * k)[0, 0])
        assert info["occlusion/sigma"][0] == pytest.approx(sigma, rel=1e-10)
        assert not info["occlusion/visible"].any()


def test_what_is_measured_has_the_declared_noise():
    env = sw.OcclusionPenalty(
        Turning(), [straight()], sw.occlusion.Sensor(site="eye", position_std=0.3), tolerance=1.0
    )
    env.reset(seed=0)
    noise = []
    for _ in range(2000):
        env.step(STILL)
        noise.append(env.last_seen_positions[0] - [1.0, 0.0])
    np.testing.assert_allclose(np.mean(noise, axis=0), 0.0, atol=5 * 0.3 / np.sqrt(2000))
    np.testing.assert_allclose(np.cov(np.transpose(noise)), np.diag([0.09, 0.09]), atol=0.015)
    noise = np.array(noise)
    assert abs((noise[1:] * noise[:-1]).mean(axis=0)).max() < 5 * 0.09 / np.sqrt(2000)  # white


SPIN = ((0.3, 2.0, -1.0, -1, 0), (3.0, 0.5, 0.2, 0, 0))


@pytest.mark.parametrize("arm", ["0.4 0 0", "0.1 -0.3 0.2"])
def test_with_the_lever_arm_the_estimate_is_the_truth(arm):
    sharp = {"position_std": 1e-6, "velocity_std": 1e-6}
    sure = straight(start_position_std=10.0, start_velocity_std=10.0, acceleration_noise=1e6)
    sharp_eye = sw.occlusion.Sensor(site="eye", **sharp)
    env = sw.OcclusionPenalty(Turning(SPIN, arm=arm), [sure], sharp_eye, tolerance=1.0)
    env.reset(seed=0)
    for _ in range(30):
        env.step(np.array([0.5]))
        truth = np.concatenate([env.unwrapped.data.qpos[1:3], env.unwrapped.data.qvel[1:3]])
        np.testing.assert_allclose(env.tracking.mean[0], truth, atol=2e-5)


def test_velocities_alone_leave_positions_unresolved_and_it_says_so():
    only = sw.occlusion.Sensor(site="eye", position_std=None, velocity_std=0.1)
    env = sw.OcclusionPenalty(Turning(), [straight("thing*")], only, tolerance=1.0)
    assert env.unobservable == {"thing": ["x", "y"], "thing2": ["x", "y"]}
    assert crossing().unobservable == {f"car{i}": [] for i in range(6)}
    env.reset(seed=0)
    fix = env.last_seen_positions.copy()
    for _ in range(100):
        info = env.step(STILL)[4]
    assert info["occlusion/visible"].all() and (info["occlusion/sigma"] >= 0.3).all()
    assert (env.last_seen_positions == fix).all()
    assert np.sqrt(env.tracking.covariance[:, 2, 2]).max() < 0.02


def test_a_wall_hides_and_last_seen_stays():
    env = sw.OcclusionPenalty(
        Turning(((0, 1.5, 0, -1, 0), (0, 1.0, 0, 0, 0)), world=WALL), [straight("thing*")], EYE, tolerance=1.0
    )
    env.reset(seed=0)
    visible = []
    for _ in range(40):
        before = env.last_seen_positions.copy()
        info = env.step(STILL)[4]
        visible.append(info["occlusion/visible"].copy())
        assert (env.last_seen_positions == before).all(axis=1).tolist() == (~visible[-1]).tolist()
    x = 1.5 + 0.04 * np.arange(1, 41)
    assert np.array(visible)[:, 0].tolist() == (x < 2.0).tolist()  # its ball sticks out until then
    assert np.array(visible)[:, 1].all()


def test_a_truth_that_is_no_number_is_not_seen():
    class Broken(Turning):
        spots = np.array([[1.0, 0.0]])

    env = sw.OcclusionPenalty(
        Broken(), [sw.occlusion.Track(published="spots", acceleration_noise=0.1)], EYE, tolerance=1.0
    )
    env.reset(seed=0)
    env.unwrapped.spots = np.array([[np.nan, 0.0]])
    observation, _, _, _, info = env.step(STILL)
    assert not info["occlusion/visible"].any() and np.isfinite(observation).all()


# Permissions ------------------------------------------------------------------------------------------------------


@given(
    q=st.floats(1e-3, 5.0),
    tolerance=st.floats(0.5, 3.0),
    sigmas=st.floats(0.5, 4.0),
    reversion=st.sampled_from([None, 0.3, 3.0]),
)
@settings(max_examples=12)
def test_a_permission_expires_before_the_bound_crosses_and_no_more_than_a_step_before(
    q, tolerance, sigmas, reversion
):
    blind = sw.occlusion.Sensor(site="eye", range_m=0.01)
    track = straight(acceleration_noise=q, reversion_s=reversion)
    env = sw.OcclusionPenalty(Turning(), [track], blind, tolerance, sigmas=sigmas)
    info = env.reset(seed=0)[1]
    start = np.diag([0.09] * 4)
    a, _, noise = track.motion(2).matrices()

    def bound(time_s):
        return sigmas * np.sqrt(blind_covariance(start, a, noise, time_s)[0, 0])

    for k in range(50):
        expired = bool(info["occlusion/expired"][0])
        soon = 0.04 * (k + 1)
        if not expired:
            assert bound(0.04 * k) <= tolerance and bound(soon) <= tolerance * (1 + 1e-12)
        else:
            assert bound(soon) > tolerance * (1 - 1e-12)
            break
        info = env.step(STILL)[4]


def test_a_permission_comes_back_when_the_thing_is_seen():
    # It comes out from behind the wall.
    env = sw.OcclusionPenalty(
        Turning(((0, 2.5, 2.0, -1, 0), (0, 0.0, 1.0, 0, 0)), world=WALL),
        [straight(acceleration_noise=0.2, start_position_std=1.0)],
        EYE,
        tolerance=0.5,
    )
    info = env.reset(seed=0)[1]
    assert info["occlusion/expired"].all()
    for _ in range(60):
        info = env.step(STILL)[4]
    assert info["occlusion/visible"].all() and not info["occlusion/expired"].any()


# Reward and observation -------------------------------------------------------------------------------------------


def test_the_penalty_is_what_it_says_and_is_taken_off():
    env, bare = crossing(weight=0.3, tolerance=0.8), gym.make("OccludedCrossing-v0")
    env.reset(seed=3)
    bare.reset(seed=3)
    near_none = False
    for (_, reward, _, _, info), (_, task, _, _, _) in zip(
        steps(env, 150, 1), steps(bare, 150, 1), strict=True
    ):
        eye = env.unwrapped.data.qpos[:2] + 0.15 * np.array(
            [np.cos(env.unwrapped.agent_heading), np.sin(env.unwrapped.agent_heading)]
        )
        near = np.linalg.norm(env.tracking.positions - eye, axis=1) <= 6.0
        share = np.minimum(1.0, 3.0 * info["occlusion/sigma"] / 0.8) ** 2
        expected = 0.3 * share[near].mean() if near.any() else 0.0
        near_none |= not near.all()
        assert info["occlusion/penalty"] == pytest.approx(expected, abs=1e-12)
        assert reward == pytest.approx(task - expected, abs=1e-12)
    assert near_none


def there_and_away(env):
    """Up to the road, looking at it; then it turns round and waits."""
    for k in range(200):
        yield env.step(np.array([0.0, 0.5 if k < 40 else 0.0, 1.0 if 60 <= k < 80 else 0.0]))


def test_the_recorder_counts_the_task_s_own_return_and_sight():
    env = sw.RecordInterventions(gym.wrappers.TimeLimit(crossing(weight=0.3, tolerance=0.6), 200))
    bare = gym.make("OccludedCrossing-v0")
    env.reset(seed=3)
    bare.reset(seed=3)
    seen, total = [], 0.0
    for (_, _, _, _, info), (_, task, _, _, _) in zip(there_and_away(env), there_and_away(bare), strict=True):
        total += task
        seen.append(info["occlusion/visible"].mean())
    summary = info["interventions"]
    assert summary["return"] == pytest.approx(total, abs=1e-9)
    assert summary["seen"] == pytest.approx(np.mean(seen)) and 0.0 < summary["seen"] < 1.0


@pytest.mark.parametrize("axes", ["xy", "xyz"])
def test_the_observation_gains_the_estimates_relative_to_the_robot(axes):
    d = len(axes)
    cars = [sw.occlusion.Track("car*", acceleration_noise=0.1)]
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


# What is refused --------------------------------------------------------------------------------------------------


PUSH = np.full(1, 0.004)  # about 4 rad/s²


def tracked(start_rate=0.0, world=None, **options):
    imu = sw.occlusion.Imu("eye", **options)
    sensor = sw.occlusion.Sensor(site="eye", position_std=1e-3, imu=imu)
    world = world or Turning(((0, 1, 0, -1, 0), (start_rate, 0, 0, 0, 0)))
    return sw.OcclusionPenalty(world, [straight("thing*")], sensor, tolerance=0.5)


def off(env):
    """Error of where the body is taken to be, m."""
    return np.linalg.norm(env.ego_motion.position - env.unwrapped.data.body("robot").xpos)


def test_its_readings_are_those_of_mujocos_sensors():
    env = tracked()
    raw = env.unwrapped
    spec = mujoco.MjSpec.from_string(_text(raw))
    for kind in (mujoco.mjtSensor.mjSENS_ACCELEROMETER, mujoco.mjtSensor.mjSENS_GYRO):
        spec.add_sensor(type=kind, objtype=mujoco.mjtObj.mjOBJ_SITE, objname="eye")
    model = spec.compile()
    data = mujoco.MjData(model)
    env.reset(seed=0)
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


def _text(raw):
    from occlusion_world import TEXT

    world, arm = raw.arguments
    return TEXT.format(world=world, arm=arm)


def test_what_is_seen_is_put_where_the_reckoned_pose_has_it():
    env = tracked(accelerometer_std=1.0, gyro_std=0.5)
    env.reset(seed=0)
    for _ in range(40):
        observation = env.step(PUSH)[0]
    ego, raw = env.ego_motion, env.unwrapped
    mujoco.mj_kinematics(raw.model, raw.data)  # poses lag a substep behind after a step
    truth = raw.data.body("robot")
    turned = ego.orientation * Rotation.from_matrix(truth.xmat.reshape(3, 3)).inv()
    assert turned.magnitude() > 0.01 and off(env) > 0.01
    for name in ("thing", "thing2"):
        apparent = ego.position + turned.apply(raw.data.body(name).xpos - truth.xpos)
        seen = env.sensor.measured(env._sight, 2, raw.data.body(name).xpos[None], None, ego)[0]
        np.testing.assert_allclose(seen, apparent[:2], atol=1e-9)
    shown = observation[1:3] + ego.position[:2]
    np.testing.assert_allclose(shown, env.tracking.positions[0], atol=1e-9)
