"""The rover's control step, written a second time from its docstrings: other kinematics, loads from contacts."""

import math

import gymnasium as gym
import mujoco
import numpy as np
import pytest

WHEELS = ("front_left", "front_right", "rear_left", "rear_right")
RADIUS, SLOWEST, SUBSTEPS = 0.1, 0.5, 5
CURVES = {
    "dry": (1.0, 0.14),
    "wet": (0.7, 0.12),
    "snow": (0.3, 0.15),
    "ice": (0.1, 0.10),
}  # peak: friction, slip
RATES = [7, 9, 10, 11]
EMPTY = {"agent": [0.0, 0.0, 0.0], "goal": [3.5, 3.5], "hazards": [], "patches": []}


def friction(ground, slip):
    """Magic Formula with C = 1.65 and no E, its peak where the table has it."""
    highest, at = CURVES[ground]
    stiffness = math.tan(math.pi / 2 / 1.65) / at
    return highest * math.sin(1.65 * math.atan(stiffness * min(slip, 1.0)))


def wheels_of(model, data):
    """Centre, angular and linear velocity and axle of every wheel, by `mj_objectVelocity` and `xmat`."""
    for name in WHEELS:
        velocity, body = np.zeros(6), model.body(name).id
        mujoco.mj_objectVelocity(model, data, mujoco.mjtObj.mjOBJ_GEOM, model.geom(name).id, velocity, 0)
        yield (
            data.geom_xpos[model.geom(name).id],
            velocity[:3],
            velocity[3:],
            data.xmat[body].reshape(3, 3)[:, 1],
        )


def tyre_wrenches(model, data, loads, ground_at):
    """World forces at the contact points, with the points and the slips along; None for a wheel that lies down."""
    found = []
    for (centre, turn, move, axle), load in zip(wheels_of(model, data), loads, strict=True):
        if math.hypot(axle[0], axle[1]) < 0.5:
            found.append((np.zeros(3), centre, 0.0))
            continue
        left = np.array([axle[0], axle[1], 0.0]) / math.hypot(axle[0], axle[1])
        ahead = np.cross(left, [0.0, 0.0, 1.0])
        below = centre - [0.0, 0.0, RADIUS]
        rim, forward = RADIUS * (turn @ left), move @ ahead
        sideways = (move + np.cross(turn, below - centre)) @ left
        fast = max(abs(rim), abs(forward), SLOWEST)
        sliding = np.array([forward - rim, sideways]) / fast
        size = float(np.hypot(*sliding))
        force = np.zeros(3)
        if size > 0.0 and load > 0.0:
            strength = friction(ground_at(*centre[:2]), size) * load
            force = -strength * (sliding[0] * ahead + sliding[1] * left) / size
        found.append((force, below, (rim - forward) / fast))
    return found


def loads_of(model, data):
    """From MuJoCo's contacts with the floor, wheel by wheel: what the touch sensors must say."""
    loads, floor, force = np.zeros(4), model.geom("floor").id, np.zeros(6)
    ids = [model.geom(name).id for name in WHEELS]
    for i, contact in enumerate(data.contact):
        pair = {int(contact.geom1), int(contact.geom2)}
        for k, geom in enumerate(ids):
            if pair == {floor, geom}:
                mujoco.mj_contactForce(model, data, i, force)
                loads[k] += force[0]
    return loads


def joint_forces(model, qpos, qvel, loads, ground_at):
    """All tyres' forces on the joints, and the slips."""
    data, joints = mujoco.MjData(model), np.zeros(model.nv)
    data.qpos[:], data.qvel[:] = qpos, qvel
    mujoco.mj_fwdPosition(model, data)
    mujoco.mj_fwdVelocity(model, data)
    tyres = tyre_wrenches(model, data, loads, ground_at)
    for name, (force, point, _) in zip(WHEELS, tyres, strict=True):
        mujoco.mj_applyFT(model, data, force, np.zeros(3), point, model.body(name).id, joints)
    return joints, np.array([slip for _, _, slip in tyres])


def simulate(model, state, control, loads, ground_at):
    """One control step by `mj_step`: the data at its end, the slips there, and the largest of any loaded wheel."""
    data, largest = mujoco.MjData(model), 0.0
    mujoco.mj_setState(model, data, state, mujoco.mjtState.mjSTATE_INTEGRATION)
    data.ctrl[:], data.xfrc_applied[:] = control, 0.0
    for _ in range(SUBSTEPS):
        data.qfrc_applied[:] = joint_forces(model, data.qpos, data.qvel, loads, ground_at)[0]
        mujoco.mj_step(model, data)
        loads = loads_of(model, data)
        slips = joint_forces(model, data.qpos, data.qvel, loads, ground_at)[1]
        largest = max(largest, np.abs(slips[loads > 0.0]).max(initial=0.0))
    return data, slips, largest


def whole_state(env):
    kind = mujoco.mjtState.mjSTATE_INTEGRATION
    state = np.zeros(mujoco.mj_stateSize(env.model, kind))
    mujoco.mj_getState(env.model, env.data, state, kind)
    return state


def pose(rng, roll=0.0, pitch=0.0, height=0.099915):
    qpos, qvel = np.zeros(13), rng.normal(0.0, 1.0, 12)
    qpos[:2], qpos[2] = rng.uniform(-3, 3, 2), height
    mujoco.mju_euler2Quat(qpos[3:7], np.array([roll, pitch, rng.uniform(-3, 3)]), "XYZ")
    qpos[[7, 9]] = rng.uniform(-0.5, 0.5)
    qvel[2:5] *= 0.2
    qvel[RATES] = rng.normal(0.0, 25.0, 4)
    return qpos, qvel


@pytest.fixture(scope="module")
def env():
    made = gym.make("SafeRover-v0").unwrapped
    yield made
    made.close()


KINDS = {
    "level": {},
    "pitched": {"pitch": 0.25, "height": 0.13},
    "rolled": {"roll": -0.3, "height": 0.14},
    "one wheel lifted": {"roll": 0.02, "pitch": 0.02, "height": 0.098},
    "in the air": {"height": 0.3},
    "on its side": {"roll": 1.5, "height": 0.28},
}


@pytest.mark.parametrize("kind", KINDS)
def test_a_control_step_from_any_state(env, kind):
    """Thrown, spinning, steered, reversing: positions and velocities after five substeps to rounding."""
    rng = np.random.default_rng(list(KINDS).index(kind))
    patches = [
        {"ground": "ice", "center": [1, 1], "radius": 2},
        {"ground": "wet", "center": [-1, 0], "radius": 1.5},
    ]
    env.reset(seed=0, options={"layout": EMPTY | {"patches": patches}})
    most, lifted = 0.0, 0
    for _ in range(6):
        qpos, qvel = pose(rng, **KINDS[kind])
        env.set_state(qpos, qvel)
        np.testing.assert_allclose(np.array(env.data.userdata), loads_of(env.model, env.data), atol=1e-9)
        loads = np.array(env.data.userdata)
        still = mujoco.MjData(env.model)
        still.qpos[:], still.qvel[:] = env.data.qpos, env.data.qvel
        still.qfrc_applied[:] = joint_forces(env.model, qpos, qvel, loads, env.ground.at)[0]
        mujoco.mj_forward(env.model, still)
        np.testing.assert_allclose(loads_of(env.model, still), loads, rtol=1e-5, atol=1e-4)  # an equilibrium
        for _ in range(3):
            control = rng.uniform(-1, 1, 5)
            lifted += 0.0 in loads and loads.any()
            expected, slips, largest = simulate(env.model, whole_state(env), control, loads, env.ground.at)
            info = env.step(control)[4]
            np.testing.assert_allclose(env.data.qpos, expected.qpos, atol=1e-9)
            np.testing.assert_allclose(env.data.qvel, expected.qvel, atol=1e-7)
            np.testing.assert_allclose(info["slip"], slips, atol=1e-8)
            assert info["slip_max"] == pytest.approx(largest, abs=1e-8)
            most = max(most, np.abs(env.data.xfrc_applied).max())
            loads = np.array(env.data.userdata)
    assert (most > 1.0) == (kind not in ("in the air", "on its side"))
    if kind == "one wheel lifted":
        assert lifted > 3


def test_a_long_drive_stays_the_second_writings(env):
    """A second of hard driving over three grounds, each control step from the env's own state."""
    patches = [
        {"ground": "ice", "center": [1, 0], "radius": 0.7},
        {"ground": "snow", "center": [3, 0], "radius": 1},
    ]
    env.reset(seed=0, options={"layout": EMPTY | {"patches": patches, "speed": 3.0}})
    rng, grounds, loads = np.random.default_rng(1), set(), np.array(env.data.userdata)
    for k in range(70):
        if k % 12 == 0:
            control = np.append(rng.choice([-1.0, 0.3, 1.0], 4), rng.uniform(-0.4, 0.4))
        expected, _, _ = simulate(env.model, whole_state(env), control, loads, env.ground.at)
        env.step(control)
        loads = np.array(env.data.userdata)
        np.testing.assert_allclose(env.data.qpos, expected.qpos, atol=1e-9)
        np.testing.assert_allclose(env.data.qvel, expected.qvel, atol=1e-7)
        grounds |= {env.ground_under(wheel) for wheel in WHEELS}
    assert grounds >= {"dry", "ice", "snow"}


def test_actions_beyond_the_box_act_as_its_edge(env):
    ends = []
    for size in (1.0, 50.0):
        env.reset(seed=0, options={"layout": EMPTY})
        for _ in range(10):
            env.step(size * np.array([1.0, -1.0, 1.0, -1.0, 1.0]))
        ends.append(np.concatenate([env.data.qpos, env.data.qvel]))
    np.testing.assert_array_equal(*ends)
