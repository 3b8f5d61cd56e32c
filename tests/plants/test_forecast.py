"""Forecasts against MuJoCo itself: every substep of the env's own step, its poses, braking after it, Euler steps."""

import copy

import gymnasium as gym
import mujoco
import numpy as np
import pytest
from scenes import Scene

import safe_wrappers as sw
from safe_wrappers.plants.mujoco.forecast import Recorder

ROBOTS = [
    "InvertedPendulum",
    "InvertedDoublePendulum",
    "Reacher",
    "Pusher",
    "HalfCheetah",
    "Hopper",
    "Walker2d",
    "Swimmer",
    "Ant",
    "Humanoid",
    "HumanoidStandup",
]


def make(robot, version="v5"):
    return gym.make(f"{robot}-{version}", disable_env_checker=True)


def bound(env, **options):
    plant = sw.MujocoPlant(**options)
    plant.bind(env)
    plant.observe()
    return plant


def integrate(raw, control, substeps):
    """The truth: positions and velocities after each substep of a copy of the env's own data."""
    data = mujoco.MjData(raw.model)
    mujoco.mj_copyData(data, raw.model, raw.data)
    data.ctrl[:] = control
    qpos, qvel = [], []
    for _ in range(substeps):
        mujoco.mj_step(raw.model, data)
        qpos.append(data.qpos.copy())
        qvel.append(data.qvel.copy())
    return np.array(qpos), np.array(qvel)


# The held control ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("robot", "version"),
    # Gymnasium makes Pusher-v4 with MuJoCo 2 only.
    [
        (robot, version)
        for robot in ROBOTS
        for version in ("v5", "v4")
        if (robot, version) != ("Pusher", "v4")
    ],
)
@pytest.mark.filterwarnings("ignore:.*is out of date")
def test_every_substep_is_what_the_env_does_to_the_last_bit(robot, version):
    env = make(robot, version)
    raw, n = env.unwrapped, env.unwrapped.frame_skip
    rng = np.random.default_rng(0)
    env.reset(seed=0)
    plant = bound(env)
    truth = mujoco.MjData(raw.model)
    for k in range(16):
        action = rng.uniform(env.action_space.low, env.action_space.high).astype(np.float32)
        plant.observe()
        if k % 3 == 1:  # other questions between do not disturb it
            _ = plant.acceleration
            plant.rollout(-action.astype(float), 2).poses()
        forecast = plant.rollout(action.astype(float), 2)
        qpos, qvel = integrate(raw, action, n)
        assert forecast.qpos.shape == (2 * n, raw.model.nq) and forecast.qvel.shape == (2 * n, raw.model.nv)
        assert forecast.qpos[:n].tobytes() == qpos.tobytes()
        assert forecast.qvel[:n].tobytes() == qvel.tobytes()
        poses = forecast.poses()
        for i in range(2 * n) if k % 8 == 7 else ():
            truth.qpos[:], truth.qvel[:] = forecast.qpos[i], forecast.qvel[i]
            mujoco.mj_forward(raw.model, truth)
            np.testing.assert_allclose(poses.frames[i], truth.xpos, atol=1e-12)
            np.testing.assert_allclose(poses.axes[i].reshape(-1, 9), truth.xmat, atol=1e-12)
            np.testing.assert_allclose(poses.centres[i], truth.xipos, atol=1e-12)
        env.step(action)
        assert forecast.qpos[n - 1].tobytes() == raw.data.qpos.tobytes()
        # what the env publishes lags behind its state; the forecast knows that too
        assert forecast.published_frames[0].tobytes() == raw.data.xpos.tobytes()
        assert forecast.published_centres[0].tobytes() == raw.data.xipos.tobytes()


FALLING = """<mujoco><option timestep="0.004" integrator="{}"/><worldbody><geom type="plane" size="5 5 1"/>
<body name="ball" pos="0 0 .2" quat="1 .2 .1 0"><freejoint/><geom type="capsule" size=".05 .1"/>
<body name="arm" pos=".1 0 0"><joint name="elbow" axis="0 1 0" damping=".1"/>
<geom type="capsule" size=".03" fromto="0 0 0 .2 0 0"/>
<site name="tip" pos=".2 0 0"/></body></body></worldbody>
<actuator><motor joint="elbow" gear="2" ctrlrange="-1 1"/></actuator></mujoco>"""


@pytest.mark.parametrize("integrator", ["Euler", "RK4", "implicit", "implicitfast"])
def test_every_integrator_through_contact_and_under_applied_forces(integrator):
    env = Scene(FALLING.format(integrator))
    mujoco.mj_forward(env.model, env.data)
    plant = bound(env)
    env.data.qfrc_applied[2], env.data.xfrc_applied[2, 0] = 0.5, 0.3  # both belong to the state
    rng = np.random.default_rng(0)
    touched = 0
    for _ in range(40):
        u = rng.uniform(-1.0, 1.0, 1)
        plant.observe()
        forecast = plant.rollout(u)
        qpos, qvel = integrate(env, u, 5)
        assert forecast.qpos.tobytes() == qpos.tobytes() and forecast.qvel.tobytes() == qvel.tobytes()
        env.data.ctrl[:] = u
        mujoco.mj_step(env.model, env.data, nstep=5)
        touched += env.data.ncon > 0
    assert touched > 10


def test_bodies_that_the_env_moves_by_hand_stay_where_they_are():
    hand = '<body name="hand" mocap="true" pos="1 0 0"><geom size=".1" mass="2" contype="0" conaffinity="0"/></body>'
    env = Scene(FALLING.format("Euler").replace("</worldbody>", f"{hand}</worldbody>"))
    env.data.mocap_pos[0], env.data.mocap_quat[0] = [3.0, 1.0, 2.0], [0.0, 1.0, 0.0, 0.0]
    poses = bound(env).rollout(np.zeros(1)).poses()
    for frames in (poses.frames, poses.centres):
        np.testing.assert_allclose(frames[:, env.model.body("hand").id], np.tile([3.0, 1.0, 2.0], (5, 1)))
    np.testing.assert_allclose(poses.axes[0, env.model.body("hand").id], np.diag([1.0, -1.0, -1.0]))


# What is kept, and what is left alone -------------------------------------------------------------------------


def simulated(monkeypatch):
    """Counts the physics substeps of all forecasts from now on."""
    count, simulate = [0], Recorder.simulate

    def counted(self, begin, end, *rest, **options):
        count[0] += (end - begin) * self.substeps
        return simulate(self, begin, end, *rest, **options)

    monkeypatch.setattr(Recorder, "simulate", counted)
    return count


def test_one_control_is_simulated_once_until_something_changes(monkeypatch):
    env = make("HalfCheetah")
    env.reset(seed=0)
    plant, count = bound(env), simulated(monkeypatch)
    u = np.full(6, 0.3)

    def asked(control, horizon):
        before = count[0]
        forecast = plant.rollout(control, horizon)
        return forecast, count[0] - before

    long, first = asked(u, 3)
    assert first == 15
    assert asked(u.copy(), 3) == (long, 0)
    assert asked(u, 2)[1] == asked(u, 1)[1] == 0  # a shorter one is its beginning
    assert asked(u, 4)[1] == 20  # a longer one begins anew
    assert asked(-u, 1)[1] == 5
    assert (
        asked(-u, 4)[1] == 15
    )  # but goes on from the first control interval where that was the last question
    assert asked(u, 4)[1] == 0  # and other controls in between do not matter
    plant.observe()
    same, again = asked(u, 3)
    assert again == 15
    np.testing.assert_array_equal(same.qpos, long.qpos)
    plant.perturb(mass=2.0)
    heavy, again = asked(u, 3)
    assert again == 15 and not np.array_equal(heavy.qpos, long.qpos)
    env.step(u.astype(np.float32))
    plant.observe()
    assert not np.array_equal(asked(u, 3)[0].qpos, heavy.qpos)


def fresh(raw):
    """Data at the env's state with everything up to date."""
    data = mujoco.MjData(raw.model)
    data.qpos[:], data.qvel[:] = raw.data.qpos, raw.data.qvel
    mujoco.mj_forward(raw.model, data)
    return data


@pytest.mark.parametrize("robot", ["Humanoid", "Pusher"])
def test_nothing_of_the_envs_data_is_written(robot):
    env, twin = make(robot), make(robot)
    env.reset(seed=0), twin.reset(seed=0)
    raw, plant = env.unwrapped, bound(env)
    rng = np.random.default_rng(0)
    fields = [f for f in dir(raw.data) if isinstance(getattr(raw.data, f), np.ndarray)]
    assert {"qpos", "ctrl", "xpos", "qacc_warmstart", "mocap_pos", "warning"} - {"warning"} <= set(fields)
    for _ in range(8):
        u = rng.uniform(env.action_space.low, env.action_space.high)
        before = {f: getattr(raw.data, f).tobytes() for f in fields}
        plant.observe()
        plant.rollout(u, 3).poses()
        plant.pose()
        assert plant.published() is raw.data
        assert [f for f in fields if getattr(raw.data, f).tobytes() != before[f]] == []
        assert env.step(u)[0].tobytes() == twin.step(u)[0].tobytes()


def test_the_pose_is_that_of_the_state_where_mujocos_lags():
    env = make("HalfCheetah")
    env.reset(seed=0)
    plant = bound(env)
    for k in range(6):
        env.step(np.full(6, 0.8, np.float32))
        plant.observe()
        if k % 2:  # whatever was asked before
            _ = plant.acceleration
        truth = fresh(env.unwrapped)
        np.testing.assert_allclose(plant.pose().xpos, truth.xpos, atol=1e-12)
        np.testing.assert_allclose(plant.pose().xipos, truth.xipos, atol=1e-12)
    assert np.abs(plant.published().xpos - truth.xpos).max() > 1e-4


# Braking ------------------------------------------------------------------------------------------------------

SLIDER = """<mujoco><option timestep="0.01" gravity="0 0 0"/><worldbody><body>
<joint name="x" type="slide" axis="1 0 0"/><geom size=".1" mass="{mass}"/></body></worldbody>
<actuator>{actuator}</actuator></mujoco>"""
MOTORS = {
    "motor": '<motor joint="x" ctrlrange="-9999 9999"/>',
    "gear": '<motor joint="x" gear="20" ctrlrange="-9999 9999"/>',
    "turned round": '<motor joint="x" gear="-3" ctrlrange="-9999 9999"/>',
    "negative gain": '<general joint="x" gainprm="-2" ctrlrange="-9999 9999"/>',
    "unlimited": '<motor joint="x" ctrllimited="false"/>',
    "with a constant force": (
        '<general joint="x" gainprm="2" biastype="affine" biasprm=".5 0 0" ctrlrange="-9e3 9e3"/>'
    ),
    "position servo without damping": '<position joint="x" kp="0.2" ctrlrange="-9999 9999"/>',
}


@pytest.mark.parametrize("mass", [0.1, 1.0, 30.0])
@pytest.mark.parametrize("kind", MOTORS)
def test_braking_halves_the_speed_of_a_driven_slide_in_every_control_step(kind, mass):
    env = Scene(SLIDER.format(mass=mass, actuator=MOTORS[kind]))
    plant = bound(env)
    for speed in (2.0, -0.7):
        env.data.qpos[0], env.data.qvel[0] = 0.3, speed
        plant.observe()
        unforced = {"with a constant force": -0.25, "position servo without damping": 0.3}.get(kind, 0.0)
        speeds = plant.rollout(np.array([unforced]), 8).qvel[4::5, 0]
        # The speed that is read is one substep old, hence not exactly a half.
        assert (np.abs(speeds[1:]) < 0.62 * np.abs(speeds[:-1])).all(), speeds
        assert (speeds / speeds[0] > -0.01).all(), speeds  # nor does it turn back


# A simulation that breaks down --------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("qpos", "qvel", "control"), [(np.nan, 0.0, 0.0), (0.0, np.nan, 0.0), (0.0, 0.0, 1e9), (1e11, 0.0, 0.0)]
)
def test_what_mujoco_resets_is_not_a_number(qpos, qvel, control, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # MuJoCo writes a log there
    env = Scene(SLIDER.format(mass=1.0, actuator='<motor joint="x" gear="1000" ctrllimited="false"/>'))
    env.data.qpos[0], env.data.qvel[0] = qpos, qvel
    plant = bound(env)
    forecast = plant.rollout(np.array([control]), 2)
    for values in (forecast.qpos, forecast.qvel, forecast.published_frames, forecast.poses().centres[:, 1]):
        assert np.isnan(values).all()
    env.data.qpos[0], env.data.qvel[0] = 0.0, 1.0
    plant.observe()
    assert np.isfinite(plant.rollout(np.array([0.0]), 2).qpos).all()  # the next one is whole again


def test_only_what_comes_after_a_break_down_is_lost(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    runaway = SLIDER.format(mass=1.0, actuator=MOTORS["motor"]).replace(
        'axis="1 0 0"', 'axis="1 0 0" stiffness="-1e6"'
    )
    env = Scene(runaway)
    env.data.qpos[0] = 1e-8  # a hundredfold with every substep
    long, short = bound(env).rollout(np.zeros(1), 4), bound(env).rollout(np.zeros(1), 1)
    assert np.isfinite(short.qpos).all() and short.qpos[-1] > 1.0
    assert long.qpos[:5].tobytes() == short.qpos.tobytes()
    assert np.isnan(long.qpos[5:]).all() and np.isnan(long.published_frames[1:]).all()


# Euler steps --------------------------------------------------------------------------------------------------


def started(env_id, seed=0):
    """An env after some steps, and its plant."""
    env = gym.make(env_id)
    env.reset(seed=seed)
    for action in np.random.default_rng(seed).uniform(-0.5, 0.5, (8, *env.action_space.shape)):
        env.step(action.astype(env.action_space.dtype))
    return env.unwrapped, bound(env)


def by_hand(raw, plant, control, own_holds, holds):
    """States after each substep; from `own_holds` on by Euler steps of a model of its own."""
    euler, data = copy.copy(raw.model), mujoco.MjData(raw.model)
    euler.opt.integrator = int(mujoco.mjtIntegrator.mjINT_EULER)
    data.qpos[:], data.qvel[:], data.qacc_warmstart[:] = raw.data.qpos, raw.data.qvel, raw.data.qacc_warmstart
    path = []
    for hold in range(holds):
        data.ctrl[:] = plant._recorder.braking(data) if hold else control
        for _ in range(plant.substeps):
            mujoco.mj_step(raw.model if hold < own_holds else euler, data)
            path.append(np.concatenate([data.qpos, data.qvel]))
    return np.array(path)


@pytest.mark.parametrize("env_id", ["Hopper-v5", "Ant-v5", "Swimmer-v5", "Reacher-v5", "HalfCheetah-v5"])
def test_the_look_ahead_and_a_sketch_are_euler_steps(env_id):
    raw, plant = started(env_id)
    control = 0.8 * plant.upper
    forecast, own = plant.rollout(control, 3, euler=True), plant.rollout(control, 3)
    np.testing.assert_array_equal(forecast.states, by_hand(raw, plant, control, 1, 3))
    np.testing.assert_array_equal(own.states, by_hand(raw, plant, control, 3, 3))
    np.testing.assert_array_equal(plant.sketch(control, 2).states, by_hand(raw, plant, control, 0, 2))
    assert plant.model.opt.integrator == raw.model.opt.integrator


def test_poses_published_by_euler_steps_do_not_lag():
    _, plant = started("Ant-v5")
    forecast = plant.rollout(0.5 * plant.upper, 3, euler=True)
    ends = forecast.poses(plant.substeps)
    np.testing.assert_array_equal(forecast.published_frames[1:], ends.frames[1:])
    np.testing.assert_array_equal(forecast.published_centres[1:], ends.centres[1:])
    # As after Runge-Kutta steps, whose last stage is near the end.
    own = plant.rollout(0.5 * plant.upper, 3)
    ends = own.poses(plant.substeps)
    moved = np.abs(np.diff(own.qpos, axis=0)).max()
    assert np.abs(own.published_frames - ends.frames).max() < 0.1 * moved
