"""MujocoPlant: f and g against MuJoCo itself, actuators of every kind, points, its own model."""

import gymnasium as gym
import mujoco
import numpy as np
import pytest
from asking import bound
from scenes import Legs, Scene

import safe_wrappers as sw
from safe_wrappers.errors import ConfigurationError, UnsupportedEnvError
from safe_wrappers.plants.mujoco.model import fixed_bodies, weight_n

ENVS = ("InvertedDoublePendulum-v5", "Pusher-v5", "Swimmer-v5", "Hopper-v5", "Ant-v5", "Humanoid-v5")


def accelerations(model, qpos, qvel, controls):
    """MuJoCo's, of each of the controls, from a solver that starts anew."""
    data, found = mujoco.MjData(model), []
    for control in controls:
        data.qpos[:], data.qvel[:], data.ctrl[:], data.qacc_warmstart[:] = qpos, qvel, control, 0.0
        mujoco.mj_forward(model, data)
        found.append(data.qacc.copy())
    return np.array(found)


@pytest.mark.parametrize("env_id", ENVS)
def test_f_and_g_are_mujocos_own_derivatives(env_id):
    env = gym.make(env_id)
    plant, raw = bound(env), env.unwrapped
    nq, nu = raw.model.nq, raw.model.nu
    rng, effects, drifts = np.random.default_rng(0), [], []
    for k in range(30):
        if k % 10 == 0:
            env.reset(seed=k)
            if k == 20:  # as MuJoCo takes it for large models
                raw.model.opt.jacobian = int(mujoco.mjtJacobian.mjJAC_SPARSE)
        env.step(rng.uniform(env.action_space.low, env.action_space.high).astype(np.float32))
        plant.observe()
        drift, effect = plant.acceleration
        qpos, qvel = raw.data.qpos, raw.data.qvel
        aside = 1e-3 * np.eye(nu)
        (none, *_), up, down = (
            accelerations(raw.model, qpos, qvel, c) for c in (np.zeros((1, nu)), aside, -aside)
        )
        expected = (up - down).T / 2e-3
        effects.append(np.abs(effect - expected).max() / np.abs(expected).max())
        drifts.append(np.abs(drift - none).max() / max(1.0, np.abs(none).max()))
        ends = qpos.copy(), qpos.copy()
        for end, time_s in zip(ends, (1e-6, -1e-6), strict=True):
            mujoco.mj_integratePos(raw.model, end, qvel, time_s)
        np.testing.assert_allclose(plant.f[:nq], (ends[0] - ends[1]) / 2e-6, atol=1e-7)
        np.testing.assert_array_equal(plant.f[nq:], drift)
        np.testing.assert_array_equal(plant.g, np.vstack([np.zeros((nq, nu)), effect]))
        np.testing.assert_array_equal(plant.state, np.concatenate([qpos, qvel]))
    # Where the difference crosses a switch of contacts the two differ.
    assert (np.median(np.reshape([effects, drifts], (2, 3, 10)), axis=2) < 1e-6).all()


@pytest.mark.parametrize(
    ("env_id", "kind", "name"), [("Reacher-v5", "body", "fingertip"), ("Ant-v5", "geom", "left_ankle_geom")]
)
def test_a_points_acceleration_by_differences(env_id, kind, name):
    env = gym.make(env_id)
    env.reset(seed=3)
    raw, rng, step = env.unwrapped, np.random.default_rng(1), 1e-5
    qpos = raw.data.qpos.copy()
    if env_id == "Ant-v5":
        qpos[2] = 2.0  # in the air: no contact switches
    raw.set_state(qpos, rng.normal(size=raw.model.nv))
    plant = bound(env)
    plant.observe()
    first = plant.motion(kind, name)  # before anything has been derived from the state
    place, velocity, drift, effect = plant.point(kind, name)
    u = rng.uniform(-1, 1, raw.model.nu)
    qacc = plant.acceleration[0] + plant.acceleration[1] @ u
    handle, data, places = plant.named(kind, name), mujoco.MjData(raw.model), []
    for time_s in (-step, 0.0, step):
        data.qpos[:] = raw.data.qpos
        mujoco.mj_integratePos(raw.model, data.qpos, raw.data.qvel + 0.5 * time_s * qacc, time_s)
        mujoco.mj_kinematics(raw.model, data)
        places.append((data.xpos if kind == "body" else data.geom_xpos)[handle].copy())
    behind, now, ahead = places
    np.testing.assert_allclose(place, now, atol=1e-12)
    np.testing.assert_allclose(velocity, (ahead - behind) / (2.0 * step), atol=1e-5)
    np.testing.assert_allclose(
        drift + effect @ u, (ahead - 2.0 * now + behind) / step**2, rtol=1e-4, atol=1e-4
    )
    for found in (first, plant.motion(kind, name)):
        np.testing.assert_allclose(found, (place, velocity), atol=1e-12)


# Actuators ----------------------------------------------------------------------------------------------------


def scene(actuators):
    return Scene(
        f"""<mujoco><option timestep="0.01" gravity="0 0 0"/><worldbody>
        <body name="arm"><joint name="hinge" type="hinge" axis="0 0 1" damping="0.1"/>
        <geom type="capsule" fromto="0 0 0 1 0 0" size=".05"/><site name="tip" pos="1 0 0"/>
        <site name="base" pos="0 .5 0"/></body>
        <body name="slider" pos="0 0 2"><joint name="slide" type="slide" axis="1 0 0"/><geom size=".1"/></body>
        </worldbody><tendon><fixed name="both"><joint joint="hinge" coef="2"/><joint joint="slide" coef="-1"/></fixed>
        </tendon><actuator>{actuators}</actuator></mujoco>"""
    )


ALL = -1.0, 1.0
KINDS = {
    "gear": ('<motor joint="hinge" gear="7" ctrlrange="-1 1"/>', ALL),
    "velocity servo": ('<velocity joint="hinge" kv="3" gear="2" ctrlrange="-1 1"/>', ALL),
    "position servo": ('<position joint="hinge" kp="5" kv="0.4" ctrlrange="-1 1"/>', ALL),
    "joint in parent": ('<motor jointinparent="hinge" gear="0.3" ctrlrange="-1 1"/>', ALL),
    "site with torque": ('<motor site="tip" gear="0 1 0 0 0 3" ctrlrange="-1 1"/>', ALL),
    "affine gain": (
        '<general joint="hinge" gaintype="affine" gainprm="2 0.5 -0.3" biastype="affine" biasprm="0.1 -4 -0.2"'
        ' ctrlrange="-1 1"/>',
        ALL,
    ),
    "asymmetric range": ('<motor joint="hinge" gear="3" ctrlrange="0.2 2"/>', (0.2, 2.0)),
    "two on a joint": (
        '<motor joint="hinge" ctrlrange="-1 1"/><velocity joint="hinge" kv="2" ctrlrange="-1 1"/>',
        ALL,
    ),
    "unlimited": ('<motor joint="hinge" gear="3" ctrllimited="false"/>', (-np.inf, np.inf)),
    "tendon": ('<motor tendon="both" gear="2" ctrlrange="-1 1"/>', ALL),
    "clamp": ('<motor joint="hinge" gear="2" ctrlrange="-1 1" forcerange="-.05 .2"/>', (-0.05, 0.2)),
    "clamp, turned round": (
        '<general joint="hinge" gainprm="-2" ctrlrange="-1 1" forcerange="-.2 .4"/>',
        (-0.2, 0.1),
    ),
    "saturated": (
        '<general joint="hinge" biastype="affine" biasprm="5 0 0" ctrlrange="-1 1" forcerange="-2 2"/>',
        (-1.0, -1.0),
    ),
    "wide clamp": ('<motor joint="hinge" gear="2" ctrlrange="-1 1" forcerange="-5 5"/>', ALL),
}


@pytest.mark.parametrize("kind", KINDS)
def test_the_force_is_affine_inside_the_acting_range_and_the_same_beyond_it(kind):
    xml, acts = KINDS[kind]
    env = scene(xml)
    env.data.qpos[:], env.data.qvel[:] = [0.4, 0.2], [-1.5, 0.3]
    plant = bound(env)
    plant.observe()
    drift, effect = plant.acceleration
    least, most = plant.acting_range
    np.testing.assert_allclose([least[0], most[0]], acts, atol=1e-12)
    controls = np.linspace(-1.0, 1.0, 9)[:, None] * np.ones(env.model.nu)
    expected = drift + np.clip(controls, least, most) @ effect.T
    found = accelerations(env.model, env.data.qpos, env.data.qvel, controls)
    np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-9)
    assert effect.any() == (acts[0] < acts[1])


def test_a_speed_servos_clamp_moves_with_the_speed_and_is_widened_by_what_a_hold_can_change():
    kv, gear, most_n = 2.0, 1.5, 0.05
    for speed in (-0.4, 0.0, 0.5):
        env = scene(
            f'<velocity joint="hinge" kv="{kv}" gear="{gear}" ctrlrange="-1 1" forcerange="-{most_n} {most_n}"/>'
        )
        env.data.qvel[0] = speed
        plant = bound(env)
        plant.observe()
        drift, effect = plant.acceleration
        middle, per_newton = gear * speed, effect[0, 0] / kv
        reach = most_n / kv + most_n * per_newton * gear * plant.control_dt
        np.testing.assert_allclose(plant.acting_range, [[middle - reach], [middle + reach]], atol=1e-9)
        inside = [middle + 0.02]
        (found,) = accelerations(env.model, env.data.qpos, env.data.qvel, [inside])
        np.testing.assert_allclose(drift + effect @ inside, found, atol=1e-9)


MUSCLE = "0.75 1.05 -1 200 0.5 1.6 1.5 1.3 1.2"
REFUSED = {
    '<muscle joint="hinge" ctrlrange="0 1" lengthrange="-1 1"/>': "'#0' has activation dynamics muscle",
    '<general name="slow" joint="hinge" dyntype="integrator"/>': "'slow' has activation dynamics integrator",
    '<general joint="hinge" dyntype="filter" dynprm="0.1"/>': "activation dynamics filter",
    '<motor name="rod" cranksite="tip" slidersite="base" cranklength="1"/>': "'rod' has transmission slidercrank",
    '<adhesion name="glue" body="arm" ctrlrange="0 1"/>': "'glue' has transmission body",
    f'<general name="g" joint="hinge" gaintype="muscle" lengthrange="-1 1" gainprm="{MUSCLE}"/>': "gain type muscle",
    f'<general joint="hinge" biastype="muscle" lengthrange="-1 1" biasprm="{MUSCLE}"/>': "bias type muscle",
}


@pytest.mark.parametrize(("xml", "says"), REFUSED.items(), ids=REFUSED.values())
def test_what_is_not_affine_is_refused_by_name(xml, says):
    with pytest.raises(UnsupportedEnvError, match=f"{says}.*AnalyticPlant"):
        bound(scene(xml))


NO_ACTUATION = int(mujoco.mjtDisableBit.mjDSBL_ACTUATION)
SPOILT = {
    r"integrator is 'discrete'.*AnalyticPlant": lambda m: setattr(m.opt, "integrator", 4),  # from 3.13 on
    r"joint 'hinge' clamps the sum .*actuatorfrcrange": lambda m: m.jnt_actfrclimited.fill(True),
    r"tendon 'both' clamps the sum": lambda m: m.tendon_actfrclimited.fill(True),
    r"actuator 'push' is disabled .*enable it": lambda m: setattr(m.opt, "disableactuator", 1 << 3),
    r"actuator 'push' is disabled": lambda m: setattr(m.opt, "disableflags", NO_ACTUATION),
}


@pytest.mark.parametrize("says", SPOILT)
def test_a_model_whose_forces_are_others_than_its_actuators_is_refused(says):
    env = scene('<motor name="push" group="3" joint="hinge" ctrlrange="-1 1"/>')
    env.model.opt.disableactuator = 1 << 2  # another group's
    for integrator in range(4):
        env.model.opt.integrator = integrator
        bound(env)
    SPOILT[says](env.model)
    with pytest.raises(UnsupportedEnvError, match=says):
        bound(env)


# Its own model ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("perturbed", [False, True])
def test_a_plant_that_is_declared_to_be_another_says_so_once_and_leaves_the_env_as_it_is(perturbed):
    heavier = gym.make("Hopper-v5").unwrapped.model
    heavier.body_mass[:] *= 1.1
    plant = sw.MujocoPlant(model=None if perturbed else heavier)
    if perturbed:
        plant.perturb(mass=1.1, damping=0.5)
    env = sw.CBFActionFilter(gym.make("Hopper-v5"), [sw.constraints.SpeedLimit(9.0)], plant=plant)
    own = gym.make("Hopper-v5").unwrapped.model
    env.reset(seed=0)
    with pytest.warns(UserWarning, match=r"model is not the env's: they differ in .*body_mass") as caught:
        infos = [env.step(np.zeros(3, np.float32))[4] for _ in range(5)]
    assert len(caught) == 1 and all(info["cbf/mismatch"] for info in infos)
    for name, factor in (("body_mass", 1.1), ("dof_damping", 0.5 if perturbed else 1.0)):
        np.testing.assert_array_equal(getattr(own, name), getattr(env.unwrapped.model, name))
        np.testing.assert_allclose(getattr(plant.model, name), factor * getattr(own, name))
    effect = plant.acceleration[1].copy()
    plant.perturb(mass=2.0)  # now, as it has a model already
    for wrong in ({"mass": 0.0}, {"damping": -0.1}):
        with pytest.raises(ConfigurationError, match="factors must be positive"):
            plant.perturb(**wrong)
    plant.observe()
    np.testing.assert_allclose(plant.model.body_mass, 2.2 * own.body_mass)
    if perturbed:  # `heavier` says nothing of whole trees
        np.testing.assert_allclose(plant.model.body_subtreemass, 2.2 * own.body_subtreemass)
    assert not np.allclose(plant.acceleration[1], effect)


def test_the_world_mocap_bodies_and_what_is_welded_to_either_are_fixed_and_no_weight():
    ring = '<body name="hand" mocap="true"><body name="ring"><geom size=".1" mass="50"/></body></body>'
    model = Legs(more=ring).model
    fixed = {model.body(int(body)).name for body in np.flatnonzero(fixed_bodies(model))}
    assert fixed == {"world", "step", "lift", "hand", "ring"}
    assert weight_n(model) == pytest.approx((4.0 + 0.6 + 0.6 + 1.0) * 9.81)
    model.opt.gravity[:] = 0.0
    assert weight_n(model) == pytest.approx(4.0 + 0.6 + 0.6 + 1.0)
