"""MujocoPlant: f and g against MuJoCo itself, actuators of every kind, its own model, delay, rollouts."""

import gymnasium as gym
import mujoco
import numpy as np
import pytest
from asking import bound
from scenes import Scene

from safe_wrappers.errors import ConfigurationError, UnsupportedEnvError
from safe_wrappers.plants.mujoco.binding import physics_steps
from safe_wrappers.plants.mujoco.model import fixed_bodies, weight_n

ENVS = [
    "Reacher-v5",
    "InvertedPendulum-v5",
    "InvertedDoublePendulum-v5",
    "Pusher-v5",
    "Swimmer-v5",
    "HalfCheetah-v5",
    "Hopper-v5",
    "Walker2d-v5",
    "Ant-v5",
    "Humanoid-v5",
]


def scene(actuators, body="", **options):
    return Scene(
        f"""<mujoco><option timestep="0.01" gravity="0 0 0"/><worldbody><body name="arm">
        <joint name="hinge" type="hinge" axis="0 0 1" damping="0.1"/>
        <geom type="capsule" fromto="0 0 0 1 0 0" size=".05"/><site name="tip" pos="1 0 0"/>{body}
        </body><body name="slider" pos="0 0 2"><joint name="slide" type="slide" axis="1 0 0"/><geom size=".1"/></body>
        </worldbody>{actuators}</mujoco>""",
        **options,
    )


def differences(plant, control, step=1e-3):
    """d qacc / d ctrl by central differences of mj_forward at the plant's state."""
    model, data = plant.model, mujoco.MjData(plant.model)
    columns = []
    for i in range(model.nu):
        pair = []
        for sign in (1.0, -1.0):
            data.qpos[:], data.qvel[:] = plant.qpos, plant.qvel
            data.ctrl[:] = control
            data.ctrl[i] += sign * step
            data.qacc_warmstart[:] = 0.0
            mujoco.mj_forward(model, data)
            pair.append(data.qacc.copy())
        columns.append((pair[0] - pair[1]) / (2.0 * step))
    return np.array(columns).T


@pytest.mark.parametrize("env_id", ENVS)
def test_f_and_g_are_mujocos_own_derivatives(env_id):
    env = gym.make(env_id)
    plant = bound(env)
    raw = env.unwrapped
    rng = np.random.default_rng(0)
    effects, drifts = [], []
    env.reset(seed=0)
    for k in range(60):
        if k % 20 == 0:
            env.reset(seed=k)
        env.step(rng.uniform(env.action_space.low, env.action_space.high).astype(np.float32))
        plant.observe()
        drift, effect = plant.acceleration
        reference = np.clip(np.zeros(plant.model.nu), plant.lower, plant.upper)
        expected = differences(plant, reference)
        effects.append(np.abs(effect - expected).max() / np.abs(expected).max())
        data = mujoco.MjData(raw.model)
        data.qpos[:], data.qvel[:] = raw.data.qpos, raw.data.qvel
        mujoco.mj_forward(raw.model, data)
        drifts.append(np.abs(drift - data.qacc).max() / max(1.0, np.abs(data.qacc).max()))
        assert plant.f.shape == (plant.model.nq + plant.model.nv,)
        assert plant.g.shape == (plant.model.nq + plant.model.nv, plant.model.nu)
        assert not plant.g[: plant.model.nq].any()
    assert np.median(effects) < 1e-6, np.median(effects)
    assert np.median(drifts) < 1e-6, np.median(drifts)


@pytest.mark.parametrize("env_id", ["Ant-v5", "Humanoid-v5", "Reacher-v5"])
def test_position_rates_integrate_quaternions(env_id):
    env = gym.make(env_id)
    env.reset(seed=1)
    raw = env.unwrapped
    qpos = raw.data.qpos.copy()
    mujoco.mj_normalizeQuat(raw.model, qpos)
    raw.set_state(qpos, np.random.default_rng(0).normal(size=raw.model.nv))
    plant = bound(env)
    plant.observe()
    ahead, behind = raw.data.qpos.copy(), raw.data.qpos.copy()
    mujoco.mj_integratePos(raw.model, ahead, raw.data.qvel, 1e-6)
    mujoco.mj_integratePos(raw.model, behind, raw.data.qvel, -1e-6)
    np.testing.assert_allclose(plant.f[: raw.model.nq], (ahead - behind) / 2e-6, atol=1e-7)
    np.testing.assert_array_equal(plant.state, np.concatenate([raw.data.qpos, raw.data.qvel]))


# Actuators ----------------------------------------------------------------------------------------------------

KINDS = {
    "motor with gear": '<motor joint="hinge" gear="7" ctrlrange="-1 1" ctrllimited="true"/>',
    "velocity servo": '<velocity joint="hinge" kv="3" gear="2" ctrlrange="-1 1" ctrllimited="true"/>',
    "position servo": '<position joint="hinge" kp="5" kv="0.4" ctrlrange="-1 1" ctrllimited="true"/>',
    "joint in parent": '<motor jointinparent="hinge" gear="0.3" ctrlrange="-1 1" ctrllimited="true"/>',
    "site": '<motor site="tip" gear="0 2 0 0 0 0" ctrlrange="-1 1" ctrllimited="true"/>',
    "site with torque": '<motor site="tip" gear="0 1 0 0 0 3" ctrlrange="-1 1" ctrllimited="true"/>',
    "affine gain": (
        '<general joint="hinge" gaintype="affine" gainprm="2 0.5 -0.3" biastype="affine" biasprm="0.1 -4 -0.2"'
        ' ctrlrange="-1 1" ctrllimited="true"/>'
    ),
    "asymmetric range": '<motor joint="hinge" gear="3" ctrlrange="0.2 2" ctrllimited="true"/>',
    "two on a joint": (
        '<motor joint="hinge" ctrlrange="-1 1" ctrllimited="true"/>'
        '<velocity joint="hinge" kv="2" ctrlrange="-1 1" ctrllimited="true"/>'
    ),
    "unlimited": '<motor joint="hinge" gear="3" ctrllimited="false"/>',
    "in degrees of a tendon": '<motor tendon="both" gear="2" ctrlrange="-1 1" ctrllimited="true"/>',
}
TENDON = '<tendon><fixed name="both"><joint joint="hinge" coef="2"/><joint joint="slide" coef="-1"/></fixed></tendon>'


@pytest.mark.parametrize("kind", KINDS)
def test_affine_actuators_of_every_kind(kind):
    tendon = TENDON if "tendon" in kind else ""
    env = scene(f"{tendon}<actuator>{KINDS[kind]}</actuator>")
    env.data.qpos[:], env.data.qvel[:] = [0.4, 0.2], [-1.5, 0.3]
    plant = bound(env)
    plant.observe()
    drift, effect = plant.acceleration
    assert np.abs(effect).max() > 0.0
    check = mujoco.MjData(env.model)
    for u in np.linspace(0.25, 0.9, 4):
        control = np.full(env.model.nu, u)
        check.qpos[:], check.qvel[:], check.ctrl[:] = env.data.qpos, env.data.qvel, control
        mujoco.mj_forward(env.model, check)
        np.testing.assert_allclose(drift + effect @ control, check.qacc, rtol=1e-9, atol=1e-9)


def force_limited(kind, **state):
    env = scene(f"<actuator>{kind}</actuator>")
    env.data.qvel[0] = state.get("speed", 0.0)
    plant = bound(env)
    plant.observe()
    return env, plant


@pytest.mark.parametrize(
    ("kind", "speed", "expected"),
    [
        ('<motor joint="hinge" gear="2" ctrlrange="-1 1" forcerange="-.05 .05"/>', 0.0, (-0.05, 0.05)),
        ('<motor joint="hinge" gear="2" ctrlrange="-1 1" forcerange="-.05 .2"/>', 0.0, (-0.05, 0.2)),
        ('<general joint="hinge" gainprm="-2" ctrlrange="-1 1" forcerange="-.2 .4"/>', 0.0, (-0.2, 0.1)),
        ('<motor joint="hinge" gear="2" ctrlrange="-1 1" forcerange="-5 5"/>', 0.0, (-1.0, 1.0)),
        ('<motor joint="hinge" gear="2" ctrlrange="-1 1"/>', 0.0, (-1.0, 1.0)),
    ],
)
def test_a_force_clamp_narrows_the_acting_range(kind, speed, expected):
    env, plant = force_limited(kind, speed=speed)
    low, high = plant.acting_range
    np.testing.assert_allclose([low[0], high[0]], expected, atol=1e-12)
    check = mujoco.MjData(env.model)

    def acceleration(u):
        check.ctrl[0] = u
        mujoco.mj_forward(env.model, check)
        return check.qacc[0]

    drift, effect = plant.acceleration
    for u in np.linspace(low[0], high[0], 5):
        assert acceleration(u) == pytest.approx(drift[0] + effect[0, 0] * u, abs=1e-9)
    if high[0] < 1.0:
        assert acceleration(1.0) == pytest.approx(acceleration(high[0]), abs=1e-9)
        assert acceleration(high[0] - 0.01) != pytest.approx(acceleration(high[0]), abs=1e-6)


def test_a_speed_servos_clamp_moves_with_the_speed():
    kind = '<velocity joint="hinge" kv="1" ctrlrange="-1 1" forcerange="-.05 .05"/>'
    for speed in (-0.4, 0.0, 0.5):
        env, plant = force_limited(kind, speed=speed)
        low, high = plant.acting_range  # at least the present clamp, widened by what a hold can change
        assert low[0] <= speed - 0.05 + 1e-12 and high[0] >= speed + 0.05 - 1e-12
        assert low[0] >= speed - 0.15 and high[0] <= speed + 0.15
        drift, effect = plant.acceleration
        check = mujoco.MjData(env.model)
        check.qvel[0], check.ctrl[0] = speed, speed + 0.02
        mujoco.mj_forward(env.model, check)
        assert check.qacc[0] == pytest.approx(drift[0] + effect[0, 0] * (speed + 0.02), abs=1e-9)


REFUSED = {
    "muscle": (
        '<muscle joint="hinge" ctrlrange="0 1" lengthrange="-1 1"/>',
        "'#0' has activation dynamics muscle",
    ),
    "integrator": (
        '<general name="slow" joint="hinge" dyntype="integrator"/>',
        "'slow' has activation dynamics integrator",
    ),
    "filter": (
        '<general name="slow" joint="hinge" dyntype="filter" dynprm="0.1"/>',
        "activation dynamics filter",
    ),
    "slidercrank": (
        '<motor name="rod" cranksite="tip" slidersite="base" cranklength="1"/>',
        "'rod' has transmission slidercrank",
    ),
    "body": ('<adhesion name="glue" body="arm" ctrlrange="0 1"/>', "'glue' has transmission body"),
    "muscle gain": (
        '<general name="g" joint="hinge" gaintype="muscle" biastype="muscle" lengthrange="-1 1"'
        ' gainprm="0.75 1.05 -1 200 0.5 1.6 1.5 1.3 1.2" biasprm="0.75 1.05 -1 200 0.5 1.6 1.5 1.3 1.2"/>',
        "'g' has gain type muscle",
    ),
}


@pytest.mark.parametrize("kind", REFUSED)
def test_what_is_not_affine_is_refused_by_name(kind):
    xml, message = REFUSED[kind]
    env = scene(f"<actuator>{xml}</actuator>", body='<site name="base" pos="0 .5 0"/>')
    with pytest.raises(UnsupportedEnvError, match=message) as caught:
        bound(env)
    assert "AnalyticPlant" in str(caught.value)


def test_clamped_sums_of_forces_are_refused():
    xml = """<mujoco><worldbody><body><joint name="elbow" type="hinge" actuatorfrcrange="-1 1"/><geom size=".1"/>
    </body></worldbody><actuator><motor joint="elbow" ctrlrange="-1 1"/></actuator></mujoco>"""
    with pytest.raises(UnsupportedEnvError, match=r"'elbow' clamps the sum .*actuatorfrcrange"):
        bound(Scene(xml))
    nameless = xml.replace('name="elbow"', "").replace('<motor joint="elbow" ctrlrange="-1 1"/>', "")
    with pytest.raises(UnsupportedEnvError, match="joint '#0' clamps"):
        bound(Scene(nameless))


def test_an_integrator_that_mixes_forces_and_steps_is_refused():
    env = gym.make("Reacher-v5")
    for integrator in range(4):
        env.unwrapped.model.opt.integrator = integrator
        bound(env)
    env.unwrapped.model.opt.integrator = 4  # "discrete", from 3.13 on
    with pytest.raises(UnsupportedEnvError, match=r"integrator is 'discrete'.*AnalyticPlant"):
        bound(env)


# Its own model ------------------------------------------------------------------------------------------------


def test_perturbing_the_plant_leaves_the_env_untouched():
    env = gym.make("HalfCheetah-v5")
    env.reset(seed=0)
    raw = env.unwrapped
    before = raw.model.body_mass.copy(), raw.model.dof_damping.copy(), raw.data.qpos.copy()
    plant = bound(env)
    plant.observe()
    effect = plant.acceleration[1].copy()
    plant.perturb(mass=2.0, damping=0.5)
    plant.observe()
    for old, now in zip(before, (raw.model.body_mass, raw.model.dof_damping, raw.data.qpos), strict=True):
        np.testing.assert_array_equal(old, now)
    np.testing.assert_array_equal(plant.model.body_mass, 2.0 * raw.model.body_mass)
    np.testing.assert_array_equal(plant.model.dof_damping, 0.5 * raw.model.dof_damping)
    np.testing.assert_array_equal(plant.model.body_subtreemass, 2.0 * raw.model.body_subtreemass)
    assert not np.allclose(plant.acceleration[1], effect)


@pytest.mark.parametrize(
    ("env_id", "kind", "name"), [("Reacher-v5", "body", "fingertip"), ("Ant-v5", "geom", "left_ankle_geom")]
)
def test_a_points_acceleration_by_differences(env_id, kind, name):
    env = gym.make(env_id)
    env.reset(seed=3)
    raw = env.unwrapped
    rng = np.random.default_rng(1)
    qpos = raw.data.qpos.copy()
    if env_id == "Ant-v5":
        qpos[2] = 2.0  # in the air: no contact switches
    raw.set_state(qpos, rng.normal(size=raw.model.nv))
    plant = bound(env)
    plant.observe()
    _, _, drift, effect = plant.point(kind, name)
    u = rng.uniform(-1, 1, raw.model.nu)
    free_drift, free_effect = plant.acceleration
    qacc = free_drift + free_effect @ u
    step = 1e-5
    velocities = []
    for sign in (1, -1):
        data = mujoco.MjData(raw.model)
        data.qpos[:] = raw.data.qpos
        mujoco.mj_integratePos(raw.model, data.qpos, raw.data.qvel + 0.5 * sign * step * qacc, sign * step)
        data.qvel[:] = raw.data.qvel + sign * step * qacc
        mujoco.mj_forward(raw.model, data)
        jacobian = np.zeros((3, raw.model.nv))
        handle = plant.named(kind, name)
        position = data.xpos[handle] if kind == "body" else data.geom_xpos[handle]
        body = handle if kind == "body" else raw.model.geom_bodyid[handle]
        mujoco.mj_jac(raw.model, data, jacobian, None, position, body)
        velocities.append(jacobian @ data.qvel)
    expected = (velocities[0] - velocities[1]) / (2 * step)
    np.testing.assert_allclose(drift + effect @ u, expected, rtol=1e-4, atol=1e-4)


# Rollouts and delay -------------------------------------------------------------------------------------------


CART = """<mujoco><option timestep="0.01" gravity="0 0 0"/>
<worldbody><body><joint name="x" type="slide" axis="1 0 0"/><geom
size=".1" mass="1"/></body></worldbody><actuator><motor joint="x" ctrlrange="-1 1"/></actuator></mujoco>"""


def delayed_truth(x, v, commands, hold, delay, initial=0.0):
    """Where the cart is after the delay, if command k acts from k * hold + delay on; `len(commands)` holds in."""
    now = len(commands) * hold
    step = 0.01

    def acting(t):
        k = int(np.floor((t - delay) / hold + 1e-9))
        return initial if k < 0 else commands[min(k, len(commands) - 1)]

    for i in range(round(delay / step)):
        v += acting(now + i * step) * step
        x += v * step
    return x, v


@pytest.mark.parametrize("delay", [0.05, 0.1])
def test_the_state_is_predicted_over_whole_holds_of_delay(delay):
    check_delay(delay, [0.3, -0.7, 1.0, 0.4])


@pytest.mark.parametrize("delay", [0.03, 0.07, 0.12])
@pytest.mark.parametrize("executed", [4, 1, 0])  # in a young episode nothing, and then little, is in flight
def test_the_state_is_predicted_over_fractions_of_a_hold(delay, executed):
    check_delay(delay, [0.3, -0.7, 1.0, 0.4][:executed])


def check_delay(delay, commands):
    env = Scene(CART, frame_skip=5)
    plant = bound(env, delay_s=delay)
    env.data.qpos[0], env.data.qvel[0] = 0.2, 1.5
    plant.executed(None)
    for u in commands:
        plant.executed(np.array([u]))
    plant.observe()
    np.testing.assert_allclose(plant.state, delayed_truth(0.2, 1.5, commands, 0.05, delay), atol=1e-12)


def test_a_state_that_is_no_number_is_not_predicted_to_be_one():
    env = Scene(CART, frame_skip=5)
    plant = bound(env, delay_s=0.07)
    env.data.qvel[0] = np.nan  # MuJoCo would step on from its own reset
    plant.observe()
    assert np.isnan(plant.state).any()


def test_forgetting_clears_the_commands_in_flight():
    env = Scene(CART)
    plant = bound(env, delay_s=0.05)
    plant.executed(np.array([1.0]))
    plant.executed(None)
    plant.observe()
    np.testing.assert_array_equal(plant.state, [0.0, 0.0])


@pytest.mark.parametrize(
    ("frame_skip", "control_dt", "got"),
    [
        (0, None, "no control_dt, and 0 by"),
        (5, 0.02, "2 by control_dt, and 5 by"),
        (None, 0.025, "2.5 by control_dt, and nothing by"),
    ],
)
def test_a_control_step_that_is_no_whole_number_of_physics_steps_is_refused(frame_skip, control_dt, got):
    env = Scene(CART)
    env.frame_skip = env.dt = frame_skip
    with pytest.raises(ConfigurationError, match=rf"steps of 0\.01 s.*got {got} .*: leave control_dt"):
        physics_steps(env, None, control_dt)


# What no force can move -----------------------------------------------------------------------------------------

CARRIED = """<mujoco><option timestep="0.01"/><worldbody><geom type="plane" size="1 1 1"/>
<body name="shelf"><geom size=".1"/></body>
<body name="hand" mocap="true"><geom size=".1" mass="50"/><body name="ring"><geom size=".1" mass="50"/></body></body>
<body name="held" pos="0 0 1"><joint name="swing" type="hinge"/><geom size=".1" mass="1"/>
<body name="tip"><geom size=".1" mass="2"/></body></body></worldbody>
<actuator><motor joint="swing" ctrlrange="-1 1"/></actuator></mujoco>"""


def test_the_world_mocap_bodies_and_what_is_welded_to_either():
    model = mujoco.MjModel.from_xml_string(CARRIED)
    names = ["world", "shelf", "hand", "ring", "held", "tip"]
    assert [model.body(name).id for name in names] == list(range(6))
    assert fixed_bodies(model).tolist() == [True, True, True, True, False, False]


def test_a_hand_that_is_moved_by_the_env_is_no_weight():
    assert np.isclose(weight_n(mujoco.MjModel.from_xml_string(CARRIED)), 3.0 * 9.81)
