"""The crossing: its robot against closed forms, its cars against their own equations."""

import math

import gymnasium as gym
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.linalg import expm

from safe_wrappers.envs.traffic import (
    CAR_ACCELERATION_NOISE,
    CAR_MEAN_SPEED,
    CAR_SPEED_STD,
    CAR_TIME_CONSTANT_S,
    Traffic,
    noise_covariance,
    transition,
)

FAR = 60.0
PILLARS = [[-2.5, -1.9], [2.5, -1.9], [-2.5, 1.9], [2.5, 1.9]]
OPEN = {"agent": [0.0, -2.9, math.pi / 2], "goal": [0.0, 2.9], "cars": [[FAR, 0.0]] * 6, "pillars": PILLARS}


@pytest.fixture
def env():
    return gym.make("OccludedCrossing-v0").unwrapped


def start(env, **layout):
    return env.reset(seed=0, options={"layout": {**OPEN, **layout}})


def push(x=0.0, y=0.0, turn=0.0):
    return np.array([x, y, turn])


def test_it_brakes_with_four_metres_per_second_squared_at_any_speed(env):
    env.frame_skip = 1
    for speed, heading in ((0.05, 3.0), (0.8, -1.0), (2.0, 0.5)):
        start(env, pillars=[[FAR, FAR]] * 4)
        qvel = np.zeros(9)
        qvel[0] = before = speed
        env.set_state(np.array([0.0, 0.0, heading, *[FAR] * 6]), qvel)
        while before > 0.0:
            env.step(push(-1.0))
            now = env.agent_velocity[0]
            assert (before - now) / 0.01 >= 4.0 - 1e-9
            before = now
        assert env.agent_position[0] <= speed**2 / 8.0


@pytest.mark.parametrize("angle", [0.2, 1.8, 4.1])
def test_pillars_are_solid_and_frictionless(env, angle):
    """Run into one at the largest speed and on with full force, from all sides; then past it, off its centre."""
    along = np.array([math.cos(angle), math.sin(angle)])
    control = push(*(along / np.abs(along).max()))
    pillar = np.array([0.0, 0.0])
    for aside in (0.0, 0.2):
        offset = aside * np.array([-along[1], along[0]])
        start(env, pillars=[[0.0, 0.0], *PILLARS[1:]])
        qvel = np.zeros(9)
        qvel[:2] = 2.0 * along / np.abs(along).max()
        env.set_state(np.array([*(-0.8 * along + offset), 0.0, *[FAR] * 6]), qvel)
        env.frame_skip = 1
        nearest = math.inf
        for _ in range(160):
            env.step(control)
            nearest = min(nearest, math.dist(env.agent_position, pillar))
        assert 0.55 - 0.02 < nearest < 0.551
        # Stuck only where it runs at the centre (and there only by rounding); never through it.
        if aside:
            assert (env.agent_position - pillar) @ along > 0.3
        # rad/s: contact points round, 3.3.7 to 2.2e-3
        assert env.data.qvel[2] == pytest.approx(0.0, abs=4e-3)
        env.frame_skip = 4


def test_camera_and_site_look_ahead_from_their_place_on_the_turning_robot(env):
    rng = np.random.default_rng(1)
    env.reset(seed=1)
    for _ in range(20):
        env.step(rng.uniform(-1.0, 1.0, 3))
        x, y, heading = env.data.qpos[:3]
        ahead = np.array([math.cos(heading), math.sin(heading), 0.0])
        eye = [x + 0.15 * ahead[0], y + 0.15 * ahead[1], 0.3]
        camera, site = env.data.cam("eye"), env.data.site("eye")
        np.testing.assert_allclose(camera.xpos, eye, atol=1e-12)
        np.testing.assert_allclose(site.xpos, eye, atol=1e-12)
        np.testing.assert_allclose(camera.xmat.reshape(3, 3)[:, 2], -ahead, atol=1e-12)
        np.testing.assert_allclose(camera.xmat.reshape(3, 3)[:, 1], [0, 0, 1], atol=1e-12)
        np.testing.assert_allclose(site.xmat.reshape(3, 3)[:, 2], ahead, atol=1e-12)
        assert env.agent_heading == pytest.approx(math.remainder(heading, math.tau))
        for i, body in enumerate(env.car_bodies):  # bodies stand where the truth says, this substep
            np.testing.assert_allclose(env.data.body(body).xpos[:2], env.car_positions[i], atol=1e-12)
            assert env.data.body(body).xpos[2] == 0.3
    assert env.model.cam("eye").fovy[0] == 100.0


def test_the_seed_alone_decides_the_cars_way(env):
    """Whatever the robot does, and where the physics is asked substep by substep."""
    paths, goals = [], []
    for drives, frame_skip in ((False, 4), (True, 4), (False, 1)):
        env.frame_skip = frame_skip
        env.reset(seed=3)
        path = []
        for step in range(4 * 400 // frame_skip):
            way = env.goal_position - env.agent_position
            info = env.step(np.clip(np.append(2.0 * way, 0.0), -1.0, 1.0) if drives else push())[4]
            if (step + 1) * frame_skip % 4 == 0:
                path.append(np.append(env.car_positions, env.car_velocities))
        paths.append(path)
        goals.append(info["goals_reached"])
    np.testing.assert_array_equal(*paths[:2])
    np.testing.assert_allclose(paths[2], paths[0], atol=1e-9)
    assert goals[0] == 0 < goals[1]


def test_cars_start_upstream_in_their_lanes_at_their_stationary_speed(env):
    speeds, arrivals = [], []
    for seed in range(40):
        env.reset(seed=seed)
        positions, velocities = env.car_positions, env.car_velocities
        np.testing.assert_array_equal(positions[:, 1], [-0.8] * 3 + [0.8] * 3)
        np.testing.assert_array_equal(velocities[:, 1], 0.0)
        back = positions[:, 0].reshape(2, 3) * [[-1.0], [1.0]]  # metres to go to the field's middle
        assert back[:, 0].min() >= 2.0
        assert back[:, 0].max() <= 7.0
        assert np.diff(back, axis=1).min() >= 5.0
        assert np.diff(back, axis=1).max() <= 8.0
        speeds.append(velocities[:, 0] * [1, 1, 1, -1, -1, -1])
        arrivals.append(back.ravel())
    z = (np.ravel(speeds) - CAR_MEAN_SPEED) / CAR_SPEED_STD
    assert abs(z.mean()) < 4.5 / math.sqrt(240)
    assert abs(z.var() - 1.0) < 4.5 * math.sqrt(2.0 / 240)
    spread = np.histogram(arrivals, bins=[2, 7, 14, 21])[0]
    assert spread.min() > 40  # over the whole episode


def test_the_cars_tracks_are_their_true_states_and_their_true_law(env):
    """A tracker told the truth: certain now, and as spread later as the traffic that is drawn."""
    env.reset(seed=12)
    for _ in range(5):
        env.step(push())
    tracks = env.car_tracks
    np.testing.assert_array_equal(tracks.positions, env.car_positions)
    np.testing.assert_array_equal(tracks.velocities, env.car_velocities)
    assert not tracks.covariance.any()
    times = [0.04, 1.0, 5.0]
    positions, covariances = tracks.ahead(times)
    for i, time in enumerate(times):
        flow, mean = transition(time), CAR_MEAN_SPEED * np.repeat([1.0, -1.0], 3)
        expected = env.car_positions[:, 0] + mean * time + flow[0, 1] * (env.car_velocities[:, 0] - mean)
        np.testing.assert_allclose(positions[i, :, 0], expected, rtol=1e-9)
        np.testing.assert_array_equal(positions[i, :, 1], env.car_positions[:, 1])
        np.testing.assert_allclose(covariances[i, :, 0, 0], noise_covariance(time)[0, 0], rtol=1e-6)
        np.testing.assert_array_equal(covariances[i, :, 1], 0.0)


def test_observation_is_what_it_says_and_knows_no_cars(env):
    start(env, agent=[1.0, -2.0, 2.0], goal=[-1.0, 2.9])
    for _ in range(10):
        observation = env.step(push(0.5, -0.3, 0.8))[0]
    (x, y, heading), (vx, vy, rate) = env.data.qpos[:3], env.data.qvel[:3]
    here = np.array([x, y])
    np.testing.assert_allclose(observation[:7], [x, y, vx, vy, math.cos(heading), math.sin(heading), rate])
    np.testing.assert_allclose(here + observation[7:9], [-1.0, 2.9])
    np.testing.assert_allclose(here + observation[9:].reshape(4, 2), PILLARS)
    np.testing.assert_array_equal(env.pillar_positions, PILLARS)
    np.testing.assert_array_equal([*env.agent_position, *env.agent_velocity], observation[:4])
    others = env.data.qpos.copy()
    others[3:] = 0.0
    env.set_state(others, env.data.qvel.copy())
    np.testing.assert_array_equal(env.observe(), observation)


def test_starts_goals_and_pillars_are_sampled_apart_and_beside_what_is_given(env):
    covered = [[-1.5, -2.9], [0.0, -2.9], [1.5, -2.9], [0.0, 2.9]]
    for seed in range(40):
        env.reset(seed=seed)
        agent, goal, pillars = env.agent_position, env.goal_position, env.pillar_positions
        assert (agent[1], goal[1], env.data.ncon) == (-2.9, 2.9, 0)
        assert abs(agent[0]) <= 2.0 and abs(goal[0]) <= 2.5
        assert env.agent_heading == pytest.approx(math.pi / 2)
        np.testing.assert_array_equal(np.sign(pillars[:, 1]), [-1, -1, 1, 1])
        assert np.abs(pillars[:, 1]).min() >= 1.8 and np.abs(pillars[:, 1]).max() <= 2.0
        assert np.abs(pillars[:, 0]).max() <= 3.0 and np.abs(np.diff(pillars[:, 0])[::2]).min() >= 1.5
        env.set_state(np.array([*goal, 0.0, *[FAR] * 6]), np.zeros(9))
        assert env.step(push())[4]["goal_met"]
        later = env.goal_position
        assert later[1] == -2.9 and abs(later[0]) <= 2.5
        for place in (agent, goal, later):
            assert np.hypot(*(pillars - place).T).min() >= 0.6
        given = {"agent": [-2.0, 1.9, -1.0], "goal": [1.0, -1.9]}
        env.reset(seed=seed, options={"layout": given})
        for place in (given["agent"][:2], given["goal"]):
            assert np.hypot(*(env.pillar_positions - place).T).min() >= 0.6
        env.reset(seed=seed, options={"layout": {"agent": [0.0, 2.9, 0.0]}})
        assert env.goal_position[1] == -2.9
        env.reset(seed=seed, options={"layout": {"pillars": covered}})
        assert np.hypot(*(env.pillar_positions - env.agent_position).T).min() >= 0.6


# The cars' motion ------------------------------------------------------------------------------------------------

A = np.array([[0.0, 1.0], [0.0, -1.0 / CAR_TIME_CONSTANT_S]])
Q = np.diag([0.0, CAR_ACCELERATION_NOISE])
CARS = 4000


@given(time_s=st.floats(0.01, 20.0))
def test_a_step_is_van_loans(time_s):
    block = expm(np.block([[-A, Q], [np.zeros((2, 2)), A.T]]) * time_s)
    flow = block[2:, 2:].T
    np.testing.assert_allclose(transition(time_s), flow, rtol=1e-9, atol=1e-13)
    np.testing.assert_allclose(noise_covariance(time_s), flow @ block[:2, 2:], rtol=1e-6, atol=1e-14)


@pytest.mark.parametrize(("step_s", "steps", "mean"), [(0.01, 4, 1.0), (0.5, 2, -1.0)])
def test_means_and_covariances_follow_the_moment_equations(step_s, steps, mean):
    """4,000 cars from one state, step by step, against the law of the whole time: every z-score within 4.5."""
    start, rng = np.array([-3.0, mean * 1.4]), np.random.default_rng(1)
    traffic, state = Traffic(np.full(CARS, mean), step_s, steps), np.repeat(start[:, None], CARS, axis=1)
    for call in range(1, round(10.0 / (step_s * steps)) + 1):
        state = traffic.drive(rng, *state)[-1]
        time = call * step_s * steps
        if call % round(2.0 / (step_s * steps)) == 0:
            expected = [start[0] + mean * time, mean] + transition(time) @ [0.0, start[1] - mean]
            covariance = noise_covariance(time)
            variances = np.diag(covariance)
            assert np.abs((state.mean(axis=1) - expected) / np.sqrt(variances / CARS)).max() < 4.5
            # Standard error of a normal sample's covariance entry: sqrt((P_ii P_jj + P_ij^2) / (n - 1)).
            error = np.sqrt((np.outer(variances, variances) + covariance**2) / (CARS - 1))
            assert np.abs((np.cov(state) - covariance) / error).max() < 4.5
