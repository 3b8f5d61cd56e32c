"""Forecasts against the envs' own steps: every substep to the last bit, braking after it, Euler steps."""

import copy

import mujoco
import numpy as np
import pytest
from scenes import Legs, Scene, make

import safe_wrappers as sw
from safe_wrappers.errors import UnsupportedEnvError
from safe_wrappers.plants import default_plant

RUNNERS = ("HalfCheetah-v5", "Hopper-v5", "Walker2d-v5", "Swimmer-v5", "Ant-v5", "Humanoid-v5", "Ant-v4")
OTHERS = (
    *("InvertedPendulum-v5", "InvertedDoublePendulum-v5", "Reacher-v5", "Pusher-v5", "HumanoidStandup-v5"),
    *("SafeHopperVelocity-v0", "FlexJointReach-v0"),
)
FETCH = ("FetchReach-v4", "FetchPush-v4", "FetchSlide-v4", "FetchPickAndPlace-v4")
HANDS = ("HandReach-v3", *(f"AdroitHand{task}-v1" for task in ("Door", "Hammer", "Pen", "Relocate")))
"""Of actions that move the gripper, and of actions in other units than the model's controls."""


def made(env_id):
    env = make(env_id, disable_env_checker=True)
    env.reset(seed=0)
    return env


def observing(env):
    plant = default_plant(env)
    plant.bind(env)
    plant.observe()
    return plant


def actions(space, steps):
    """Random ones, and corners that are held for a while; of a gripper more often down, onto the table."""
    rng = np.random.default_rng(0)
    for k in range(steps):
        if k % 6 == 0:
            corner = np.where(rng.random(space.shape) < 0.5, space.low, space.high)
            if space.shape == (4,):
                corner[2] = -1.0
        yield (rng.uniform(space.low, space.high) if k % 3 == 2 else corner).astype(space.dtype)


def own_substeps(env, action, substeps):
    """Step the env; states after each of its physics substeps, by steps of a copy with what its step has put in."""
    raw = env.unwrapped
    data = copy.copy(raw.data)
    env.step(action)
    for name in ("ctrl", "mocap_pos", "mocap_quat"):
        getattr(data, name)[:] = getattr(raw.data, name)
    states = []
    for _ in range(substeps):
        mujoco.mj_step(raw.model, data)
        states.append(np.concatenate([data.qpos, data.qvel]))
    # What the env itself ends in: a Fetch env closes the fingers after its step.
    return np.array([*states[:-1], np.concatenate([raw.data.qpos, raw.data.qvel])])


LEFT_ALONE = (
    *("qpos", "qvel", "act", "ctrl", "mocap_pos", "mocap_quat", "qfrc_applied", "xfrc_applied", "qacc"),
    *("qacc_warmstart", "xpos", "xquat", "xipos", "xmat", "geom_xpos", "site_xpos", "subtree_com", "cvel"),
    *("qM", "qfrc_bias", "qfrc_constraint", "actuator_length", "actuator_velocity", "actuator_force"),
    "sensordata",
)


def arrays(data):
    """Those of which MuJoCo fills more than a part."""
    return {name: getattr(data, name).tobytes() for name in LEFT_ALONE if hasattr(data, name)}


@pytest.mark.filterwarnings("ignore:.*is out of date", "ignore::UserWarning")
@pytest.mark.parametrize("env_id", [*RUNNERS, *OTHERS, *FETCH, *HANDS])
def test_every_substep_is_what_the_env_does_to_the_last_bit_and_nothing_is_written_to_it(env_id):
    env = made(env_id)
    raw, plant = env.unwrapped, observing(env)
    assert type(plant) is (sw.plants.DisplacementPlant if env_id in FETCH else sw.MujocoPlant)
    n, truth = plant.substeps, mujoco.MjData(raw.model)
    still = raw.model.body_mocapid < 0

    def at(qpos):
        """Where the bodies are at these positions."""
        truth.qpos[:] = qpos
        mujoco.mj_kinematics(raw.model, truth)
        return np.column_stack([truth.xpos, truth.xipos, truth.xmat])[still]

    for k, action in enumerate(actions(env.action_space, 24)):
        if k == 12:  # episodes differ in where the door, the nail or the target is
            env.reset(seed=k)
            plant.executed(None)
        before = arrays(raw.data) if k % 8 == 0 else None
        plant.observe()
        control = action.astype(np.float64)
        if k % 3 == 1:  # other questions between do not disturb it
            plant.rollout(-control, 2).poses(), plant.forward(), plant.braking()
        forecast, pose = plant.rollout(control, 2), plant.pose()
        now = np.column_stack([pose.xpos, pose.xipos, pose.xmat])[still]
        assert before is None or before == arrays(raw.data)
        assert len(forecast.states) == 2 * n and plant.published() is raw.data
        if k % 12 == 7:
            # MuJoCo's own poses lag behind its state; these do not.
            np.testing.assert_allclose(now, at(raw.data.qpos), atol=1e-12)
            poses = forecast.poses()
            for i in range(n, 2 * n):
                axes = poses.axes[i].reshape(-1, 9)
                found = np.column_stack([poses.frames[i], poses.centres[i], axes])[still]
                np.testing.assert_allclose(found, at(forecast.qpos[i]), atol=1e-12)
        assert forecast.states[:n].tobytes() == own_substeps(env, action, n).tobytes()
        # What the env publishes lags behind its state; the forecast knows that too.
        assert np.array_equal(forecast.published_frames[0], raw.data.xpos)
        assert np.array_equal(forecast.published_centres[0], raw.data.xipos)


@pytest.mark.parametrize("env_id", FETCH)
def test_a_gripper_brakes_by_displacements_of_zero(env_id):
    env = made(env_id)
    plant, data = observing(env), env.unwrapped.data
    action = np.array([1.0, -0.4, -0.2, 0.7], dtype=np.float32)
    forecast = plant.rollout(action.astype(np.float64), horizon=4)
    assert np.array_equal(plant.braking(), np.zeros(4))
    for end in forecast.states[plant.substeps - 1 :: plant.substeps]:
        env.step(action)
        assert np.array_equal(end, np.concatenate([data.qpos, data.qvel]))
        action = np.zeros(4, np.float32)


NEED_ACCELERATIONS = [
    sw.constraints.Barrier(lambda x: 1.0 - x[0], alpha=1.0),
    sw.constraints.Clearance(
        [sw.constraints.Plane([0.0, 0.0], [0.0, 1.0])], 5.0, bodies=["robot0:gripper_link"]
    ),
    sw.constraints.ImpactSpeedLimit(["robot0:l_gripper_finger_link"], ["table0"], 50.0, 1e4),
    sw.constraints.TrackPermission("robot0:gripper_link", braking=1.0),
]


@pytest.mark.parametrize("constraint", NEED_ACCELERATIONS, ids=lambda one: type(one).__name__)
def test_of_displacements_what_needs_accelerations_is_refused_with_what_works(constraint):
    name = type(constraint).__name__
    with pytest.raises(UnsupportedEnvError, match=f"{name} needs the acceleration .* Workspace, Joint"):
        sw.CBFActionFilter(made("FetchReach-v4"), [constraint])


@pytest.mark.parametrize("integrator", ["Euler", "RK4", "implicit", "implicitfast"])
def test_every_integrator_through_contact_under_applied_forces_beside_what_the_env_moves(integrator):
    env = Legs(integrator)
    env.reset()
    env.data.mocap_pos[0], env.data.mocap_quat[0] = [3.0, 1.0, 2.0], [0.0, 1.0, 0.0, 0.0]
    env.data.qfrc_applied[2], env.data.xfrc_applied[3, 0] = 0.5, 0.3  # both belong to the state
    plant, lift = observing(env), env.model.body("lift").id
    rng, touched = np.random.default_rng(0), 0
    for _ in range(40):
        u = rng.uniform(-1.0, 1.0, 2)
        plant.observe()
        forecast = plant.rollout(u)
        poses = forecast.poses()
        assert forecast.states.tobytes() == own_substeps(env, u, 5).tobytes()
        np.testing.assert_array_equal(poses.frames[:, lift], np.tile([3.0, 1.0, 2.0], (5, 1)))
        np.testing.assert_allclose(poses.axes[0, lift], np.diag([1.0, -1.0, -1.0]), atol=1e-15)
        touched += env.data.ncon > 1  # beside the load on the trunk
    assert touched > 10


def test_one_control_is_simulated_once_until_something_changes(monkeypatch):
    env = made("HalfCheetah-v5")
    plant, u, step, count = observing(env), np.full(6, 0.3), mujoco.mj_step, [0]

    def counted(model, data, nstep=1):
        count[0] += nstep
        step(model, data, nstep)

    monkeypatch.setattr(mujoco, "mj_step", counted)

    def asked(control, horizon):
        before = count[0]
        return plant.rollout(control, horizon), count[0] - before

    long, first = asked(u, 3)
    assert first == 15 and asked(u.copy(), 3) == (long, 0)
    assert asked(u, 2)[1] == asked(u, 1)[1] == 0  # a shorter one is its beginning
    assert asked(u, 4)[1] == 20  # a longer one begins anew
    assert asked(-u, 1)[1] == 5
    assert asked(-u, 4)[1] == 15  # but goes on from the first interval where that was the last question
    assert asked(u, 4)[1] == 0  # and other controls in between do not matter
    plant.observe()
    same, again = asked(u, 3)
    assert again == 15 and np.array_equal(same.qpos, long.qpos)
    plant.perturb(mass=2.0)
    heavy, again = asked(u, 3)
    assert again == 15 and not np.array_equal(heavy.qpos, long.qpos)


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


@pytest.mark.parametrize("kind", MOTORS)
def test_braking_halves_the_speed_of_a_driven_slide_in_every_control_step(kind):
    unforced = np.array(
        [{"with a constant force": -0.25, "position servo without damping": 0.3}.get(kind, 0)]
    )
    for mass, speed in ((0.1, 2.0), (1.0, -0.7), (30.0, 2.0)):
        env = Scene(SLIDER.format(mass=mass, actuator=MOTORS[kind]))
        env.data.qpos[0], env.data.qvel[0] = 0.3, speed
        speeds = observing(env).rollout(unforced, 8).qvel[4::5, 0]
        # The speed that is read is one substep old, hence not exactly a half.
        assert (np.abs(speeds[1:]) < 0.62 * np.abs(speeds[:-1])).all(), speeds
        assert (speeds / speeds[0] > -0.01).all(), speeds  # nor does it turn back


def by_hand(raw, control, own_holds, holds):
    """States after each substep of motors that brake half of their motion; by Euler steps from `own_holds` on."""
    m, data = raw.model, mujoco.MjData(raw.model)
    euler = copy.copy(m)
    euler.opt.integrator = int(mujoco.mjtIntegrator.mjINT_EULER)
    per_control = m.actuator_acc0 * np.abs(m.actuator_gear).max(axis=1) * m.actuator_gainprm[:, 0] * raw.dt
    data.qpos[:], data.qvel[:], data.qacc_warmstart[:] = raw.data.qpos, raw.data.qvel, raw.data.qacc_warmstart
    path = []
    for hold in range(holds):
        braking = np.clip(-0.5 / per_control * data.actuator_velocity, *m.actuator_ctrlrange.T)
        data.ctrl[:] = braking if hold else control
        for _ in range(raw.frame_skip):
            mujoco.mj_step(m if hold < own_holds else euler, data)
            path.append(np.concatenate([data.qpos, data.qvel]))
    return np.array(path)


@pytest.mark.parametrize("env_id", ["Hopper-v5", "Ant-v5", "Swimmer-v5", "Reacher-v5", "HalfCheetah-v5"])
def test_the_look_ahead_brakes_and_like_a_sketch_it_can_make_euler_steps(env_id):
    env = made(env_id)
    raw = env.unwrapped
    for action in actions(env.action_space, 8):
        env.step(0.5 * action)
    plant = observing(env)
    control = 0.8 * plant.upper
    forecast, own = plant.rollout(control, 3, euler=True), plant.rollout(control, 3)
    for found, own_holds in ((forecast, 1), (own, 3), (plant.sketch(control, 3), 0)):
        np.testing.assert_allclose(found.states, by_hand(raw, control, own_holds, 3), rtol=1e-9, atol=1e-12)
    assert plant.model.opt.integrator == raw.model.opt.integrator
    if raw.model.opt.integrator == int(mujoco.mjtIntegrator.mjINT_RK4):
        # Poses that are published by these Euler steps do not lag; after Runge-Kutta's they lag a little.
        ends, own_ends = (one.poses(plant.substeps) for one in (forecast, own))
        np.testing.assert_array_equal(forecast.published_frames[1:], ends.frames[1:])
        np.testing.assert_array_equal(forecast.published_centres[1:], ends.centres[1:])
        moved = np.abs(np.diff(own.qpos, axis=0)).max()
        assert np.abs(own.published_frames - own_ends.frames).max() < 0.1 * moved


# A simulation that breaks down --------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("qpos", "qvel", "control"), [(np.nan, 0.0, 0.0), (0.0, np.nan, 0.0), (0.0, 0.0, 1e9), (1e11, 0.0, 0.0)]
)
def test_what_mujoco_resets_is_not_a_number(qpos, qvel, control, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # MuJoCo writes a log there
    env = Scene(SLIDER.format(mass=1.0, actuator='<motor joint="x" gear="1000" ctrllimited="false"/>'))
    env.data.qpos[0], env.data.qvel[0] = qpos, qvel
    plant = observing(env)
    forecast = plant.rollout(np.array([control]), 2)
    for values in (forecast.states, forecast.published_frames, forecast.poses().centres[:, 1]):
        assert np.isnan(values).all()
    env.data.qpos[0], env.data.qvel[0] = 0.0, 1.0
    plant.observe()
    assert np.isfinite(plant.rollout(np.array([0.0]), 2).qpos).all()  # the next one is whole again


def test_only_what_comes_after_a_break_down_is_lost(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    runaway = SLIDER.replace("type", 'stiffness="-1e6" type').format(mass=1.0, actuator=MOTORS["motor"])
    env = Scene(runaway)
    env.data.qpos[0] = 1e-8  # a hundredfold with every substep
    long, short = (observing(env).rollout(np.zeros(1), horizon) for horizon in (4, 1))
    assert np.isfinite(short.qpos).all() and short.qpos[-1] > 1.0
    assert long.qpos[:5].tobytes() == short.qpos.tobytes()
    assert np.isnan(long.qpos[5:]).all() and np.isnan(long.published_frames[1:]).all()
