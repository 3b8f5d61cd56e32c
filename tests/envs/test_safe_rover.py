"""The rover: tyre forces against their formula and MuJoCo's Jacobians, drives against ODEs and closed forms."""

import copy
import math

import gymnasium as gym
import mujoco
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.optimize import minimize_scalar

from safe_wrappers.control.vehicle import slip_ratio
from safe_wrappers.envs.ground import GROUNDS, MAGIC_FORMULA, SLOWEST, MagicFormula, tyre_force
from safe_wrappers.envs.safe_rover import WHEELS
from safe_wrappers.errors import ConfigurationError, SafeWrappersError, UnknownNameError

G = 9.81
MASS, WHEELBASE, RADIUS = 18.0, 0.5, 0.1
AXLE_INERTIA, OWN_INERTIA = 0.05, 0.0025  # kg m^2 of a wheel: with its rotor, without
TORQUE, DAMPING = 15.0, 0.02
EMPTY = {"agent": [0.0, 0.0, 0.0], "goal": [3.5, 3.5], "hazards": [], "patches": []}


@pytest.fixture
def env():
    made = gym.make("SafeRover-v0").unwrapped
    yield made
    made.close()


def start(env, **layout):
    return env.reset(seed=0, options={"layout": {**EMPTY, **layout}})


def throttle(*torques, steer=0.0):
    return np.array([*(torques if len(torques) == 4 else torques * 4), steer])


# One tyre ------------------------------------------------------------------------------------------------

speeds = st.floats(-20.0, 20.0)


@given(rim=speeds, forward=speeds, load=st.floats(0.0, 200.0), ground=st.sampled_from(GROUNDS))
def test_along_its_heading_a_tyre_follows_the_traction_curve(rim, forward, load, ground):
    along, across, slip = tyre_force(rim, forward, 0.0, load, MAGIC_FORMULA[ground])
    assert slip == pytest.approx(float(slip_ratio(rim, forward, SLOWEST)), abs=1e-12)
    assert along == pytest.approx(float(MAGIC_FORMULA[ground].friction(slip)) * load, abs=1e-9)
    assert across == 0.0


@given(
    rim=speeds, forward=speeds, sideways=speeds, load=st.floats(0.1, 200.0), ground=st.sampled_from(GROUNDS)
)
def test_a_tyre_opposes_its_sliding_with_no_more_than_the_curve_gives(rim, forward, sideways, load, ground):
    curve = MAGIC_FORMULA[ground]
    along, across, _ = tyre_force(rim, forward, sideways, load, curve)
    sliding = np.array([forward - rim, sideways])
    speed = max(abs(forward), abs(rim), SLOWEST)
    assert math.hypot(along, across) == pytest.approx(
        float(curve.friction(np.linalg.norm(sliding) / speed)) * load, abs=1e-9
    )
    assert along * sliding[0] + across * sliding[1] <= 1e-9
    assert along * sliding[1] == pytest.approx(across * sliding[0], abs=1e-6)  # along the sliding


def test_sliding_without_drive_only_loses_energy(env):
    """Kinetic and potential energy after every substep, motors off, thrown with spin on every ground."""
    env.model.opt.enableflags |= int(mujoco.mjtEnableBit.mjENBL_ENERGY)
    rng = np.random.default_rng(1)
    env.frame_skip = 1
    for ground in GROUNDS:
        start(env, ground=ground)
        qvel = np.zeros(env.model.nv)
        qvel[:2], qvel[5], qvel[[7, 9, 10, 11]] = rng.normal(0, 3, 2), 4.0, rng.normal(0, 30, 4)
        env.set_state(env.data.qpos.copy(), qvel)
        energy = [env.data.energy.sum()]
        for _ in range(300):
            env.step(throttle(0.0))
            energy.append(env.data.energy.sum())
        assert energy[-1] < energy[0] - 1.0
        # 50 mJ: an unloaded corner's landing, which the contact's spring gives back.
        assert np.diff(energy).max() < 0.05


def lock(env):
    """Hold the wheels at the rate that they have: rotors too heavy to turn."""
    env.model.dof_armature[[7, 9, 10, 11]] = 1e9


@pytest.mark.parametrize("ground", GROUNDS)
def test_locked_wheels_stop_in_the_sliding_frictions_distance(env, ground):
    speed, mu = 4.0, float(MAGIC_FORMULA[ground].friction(1.0))
    start(env, ground=ground, speed=speed, agent=[0, 0, 0.7])
    lock(env)
    qvel = env.data.qvel.copy()
    qvel[[7, 9, 10, 11]] = 0.0
    env.set_state(env.data.qpos.copy(), qvel)
    for _ in range(1500):
        env.step(throttle(0.0))
        if env.forward_speed < 0.02:
            break
    assert np.hypot(*env.agent_position) == pytest.approx(speed**2 / (2 * mu * G), rel=0.02)
    assert env.agent_heading == pytest.approx(0.7, abs=0.01)


def test_it_comes_to_rest_and_stays_there(env):
    """Where slip counts against SLOWEST the tyre is stiffest: an explicit step must neither creep nor chatter."""
    for ground in GROUNDS:
        start(env, ground=ground)
        qvel = np.zeros(env.model.nv)
        qvel[1], qvel[5] = 0.3, 0.5
        env.set_state(env.data.qpos.copy(), qvel)
        for _ in range(300):
            env.step(throttle(0.0))
        place, rates = env.agent_position, []
        for _ in range(100):
            env.step(throttle(0.0))
            rates.append(env.data.qvel[[0, 1, 5]])
        assert np.abs(rates).max() < 0.02  # it rolls freely; across and around it stands
        assert np.abs(np.diff(rates, axis=0)).max() < 1e-4
        assert np.hypot(*(env.agent_position - place)) < 0.02


def test_observation_is_what_it_says(env):
    start(env, speed=2.0, agent=[1.0, -1.0, 2.0], goal=[1.0, 2.0], hazards=[[2.0, -1.0]])
    for _ in range(20):
        env.step(throttle(0.3, 0.2, 0.1, 0.0, steer=0.5))
    before = env.data.qvel.copy()
    observation = env.step(throttle(0.3, 0.2, 0.1, 0.0, steer=0.5))[0]
    qpos, qvel = env.data.qpos, env.data.qvel
    rotation = np.zeros(9)
    mujoco.mju_quat2Mat(rotation, qpos[3:7])
    axes = rotation.reshape(3, 3)
    np.testing.assert_allclose(observation[:2], (axes.T @ qvel[:3])[:2], atol=2e-3)  # 2 cm lower
    assert observation[2] == pytest.approx(qvel[5])
    gained = axes.T @ (qvel[:3] - before[:3]) / env.dt
    np.testing.assert_allclose(observation[3:5], gained[:2], atol=0.3)
    np.testing.assert_allclose(observation[5:9], RADIUS * qvel[[7, 9, 10, 11]])
    assert observation[9] == pytest.approx(env.data.ten_length[0], abs=2e-3)
    for target, lidar in (
        (env.goal_position, observation[10:26]),
        (env.hazard_positions[0], observation[26:]),
    ):
        ahead, left = (axes[:2, :2].T @ (target - env.agent_position)).tolist()
        sector = int(math.atan2(left, ahead) % math.tau / (math.tau / 16))
        assert lidar.argmax() == sector
        assert lidar.max() == pytest.approx(1 - math.hypot(ahead, left) / 12.0)


def test_costs_and_yaw_rates_count_every_substep(env, monkeypatch):
    """Independent oracle: the states after each physics substep, judged one by one."""
    states = []

    def recording(model, data, step=mujoco.mj_step2):
        step(model, data)
        states.append((data.qpos.copy(), data.qvel.copy()))

    monkeypatch.setattr(mujoco, "mj_step2", recording)
    rng = np.random.default_rng(3)
    cut_only_between = costs = spins = 0
    for episode in range(3):
        env.reset(
            seed=episode, options={"layout": {"speed": 3.0, "agent": [-2, 0, 0], "hazards": [[-1, 0.28]]}}
        )
        for k in range(60):
            if k % 15 == 0:
                action = throttle(rng.uniform(-1, 1), steer=rng.uniform(-0.3, 0.3))
            states.clear()
            info = env.step(action)[4]
            hazards = env.hazard_positions
            inside = [bool((np.hypot(*(q[:2] - hazards).T) <= 0.3).any()) for q, _ in states]
            assert info["cost"] == info["cost_substep"] == float(any(inside))
            costs += any(inside)
            cut_only_between += any(inside) and not inside[-1]
            yaw = []
            for qpos, qvel in states:
                w, x, y, z = qpos[3:7]
                heading = math.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))
                speed = qvel[:2] @ [math.cos(heading), math.sin(heading)]
                yaw.append(abs(qvel[5] - speed * math.tan(0.5 * (qpos[7] + qpos[9])) / WHEELBASE))
            assert info["spin_out"] == float(info["slip_max"] > 0.5)
            assert info["yaw_rate_error"] == pytest.approx(max(yaw), abs=1e-3)
            spins += info["spin_out"]
    assert len(states) == 5
    assert costs > 10
    assert cut_only_between > 0
    assert 10 < spins < 170


def test_layouts_are_sampled_apart_and_given_ones_are_kept(env):
    kinds = set()
    for seed in range(30):
        env.reset(seed=seed)
        hazards, agent, goal = env.hazard_positions, env.agent_position, env.goal_position
        assert hazards.shape == (6, 2)
        assert np.abs(hazards).max() <= 4.0
        assert np.hypot(*(hazards - agent).T).min() > 1.0
        assert np.hypot(*(hazards - goal).T).min() > 0.8
        assert [p.ground for p in env.ground.patches] == ["wet"] * 4 + ["ice"] * 4
        assert all(
            0.6 <= p.radius <= 1.0 and max(map(abs, p.center)) + p.radius <= 4 for p in env.ground.patches
        )
        kinds.add(env.ground_under("rear_left"))
    assert kinds == {"dry", "wet", "ice"}
    layout = {
        "agent": [1.0, 2.0, -3.0],
        "goal": [0.0, 1.0],
        "hazards": [[3.0, 3.0]],
        "patches": [
            {"ground": "snow", "center": [1.0, 2.0], "radius": 5.0},
            {"ground": "ice", "center": [1.0, 2.0], "radius": 0.4},
        ],
        "ground": "wet",
        "speed": -1.5,
    }
    kept = copy.deepcopy(layout)
    _, info = env.reset(options={"layout": layout})
    assert layout == kept
    np.testing.assert_allclose(env.agent_position, [1.0, 2.0])
    assert env.agent_heading == pytest.approx(-3.0)
    assert env.forward_speed == pytest.approx(-1.5)
    np.testing.assert_allclose(info["slip"], 0.0, atol=1e-12)
    np.testing.assert_array_equal(env.goal_position, [0.0, 1.0])
    np.testing.assert_array_equal(env.hazard_positions, [[3.0, 3.0]])
    assert {env.ground_under(wheel) for wheel in WHEELS} == {"ice"}  # on top of the snow
    assert env.ground.at(3.0, 2.0) == "snow"
    assert env.ground.at(-3.9, -3.9) == "wet"


@pytest.mark.parametrize(
    ("layout", "error", "message"),
    [
        ({"vases": []}, UnknownNameError, "'vases'.*agent, goal, hazards, patches, ground, speed"),
        ({"ground": "mud"}, UnknownNameError, "'mud'.*dry, wet, snow, ice"),
        ({"ground": ["ice"]}, UnknownNameError, "valid grounds"),
        ({"patches": {"ground": "ice"}}, ConfigurationError, "must be a list"),
        (
            {"patches": [{"ground": "ice", "center": [0, 0]}]},
            UnknownNameError,
            r"patches\[0\].*ground, center, radius",
        ),
        ({"patches": [{"ground": "ice", "center": [0, 0], "radius": 0}]}, ConfigurationError, "radius > 0"),
        ({"patches": [{"ground": "ice", "center": [0], "radius": 1}]}, ConfigurationError, r"\[x, y\]"),
        (
            {"patches": [{"ground": "ice", "center": [0, 0], "radius": 1}] * 9},
            ConfigurationError,
            "9 patches.* 8",
        ),
        ({"hazards": [[0, 0]] * 7}, ConfigurationError, "7 hazards.*at most 6"),
        ({"speed": [1.0]}, ConfigurationError, "a number of m/s"),
    ],
)
def test_layouts_that_cannot_be_used_are_refused(env, layout, error, message):
    with pytest.raises(error, match=message):
        env.reset(options={"layout": layout})


@pytest.mark.filterwarnings("ignore")
def test_numbers_that_are_not_finite_are_not_hidden(env, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # MuJoCo writes its warning into a log here
    env.reset(seed=0)
    qvel = np.zeros(env.model.nv)
    qvel[0] = math.nan
    env.set_state(env.data.qpos.copy(), qvel)
    with pytest.raises(SafeWrappersError, match="not finite"):
        env.step(throttle(0.0))
    assert np.isfinite(env.reset(seed=0)[0]).all()


def test_rolled_over_is_the_end(env):
    start(env)
    qpos = env.data.qpos.copy()
    qpos[2], qpos[3:7] = 0.12, [0.0, 1.0, 0.0, 0.0]
    env.set_state(qpos, np.zeros(env.model.nv))
    assert env.step(throttle(1.0))[2]
    np.testing.assert_array_equal(np.array(env.data.userdata), 0.0)
    start(env)
    qpos[2], qpos[3:7] = 0.295, [math.sqrt(0.5), math.sqrt(0.5), 0.0, 0.0]  # on its right side: axles upright
    env.set_state(qpos, np.zeros(env.model.nv))
    assert np.array(env.data.userdata)[[1, 3]].min() > 0.0
    assert not env.data.xfrc_applied.any()
    assert env.step(throttle(1.0))[2]
    assert not env.data.xfrc_applied.any()


@given(st.floats(0.05, 1.5), st.floats(0.02, 0.3), st.floats(1.2, 1.9))
def test_the_peak_against_scipy(friction, slip, shape):
    curve = MagicFormula(friction, slip, shape)
    found = minimize_scalar(lambda s: -curve.at(s), bounds=(0.0, 1.0), method="bounded")
    assert found.x == pytest.approx(slip, abs=1e-4)
    assert -found.fun == pytest.approx(friction, rel=1e-6)
