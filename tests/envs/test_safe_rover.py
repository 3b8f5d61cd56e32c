"""The rover: its control step against a second writing from its docstrings, and what it says of it."""

import math

import gymnasium as gym
import mujoco
import numpy as np
import pytest

import safe_wrappers  # noqa: F401  (registers its envs)

WHEELS = ("front_left", "front_right", "rear_left", "rear_right")
RADIUS, SLOWEST, SUBSTEPS = 0.1, 0.5, 5
EMPTY = {"agent": [0.0, 0.0, 0.0], "goal": [3.5, 3.5], "hazards": [], "patches": []}


@pytest.fixture
def env():
    return gym.make("SafeRover-v0").unwrapped


def start(env, **layout):
    return env.reset(seed=0, options={"layout": {**EMPTY, **layout}})


def throttle(*torques, steer=0.0):
    return np.array([*(torques if len(torques) == 4 else torques * 4), steer])


# A second writing: other kinematics, loads from contacts --------------------------------------------------------

# Friction at the peak, and its slip.
CURVES = {"dry": (1.0, 0.14), "wet": (0.7, 0.12), "snow": (0.3, 0.15), "ice": (0.1, 0.10)}
RATES = [7, 9, 10, 11]


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
    data.ctrl[:], data.xfrc_applied[:] = (
        np.clip(control, -1.0, 1.0),
        0.0,
    )  # beyond its box it acts as its edge
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
    places = {"ice": [1, 1], "wet": [-1, 0], "snow": [1, -2]}
    patches = [{"ground": ground, "center": place, "radius": 1.5} for ground, place in places.items()]
    env.reset(seed=0, options={"layout": EMPTY | {"patches": patches}})
    most, lifted, grounds = 0.0, 0, set()
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
            control = rng.uniform(-1.3, 1.3, 5)
            lifted += 0.0 in loads and loads.any()
            expected, slips, largest = simulate(env.model, whole_state(env), control, loads, env.ground.at)
            info = env.step(control)[4]
            np.testing.assert_allclose(env.data.qpos, expected.qpos, atol=1e-9)
            np.testing.assert_allclose(env.data.qvel, expected.qvel, atol=1e-7)
            np.testing.assert_allclose(info["slip"], slips, atol=1e-8)
            assert info["slip_max"] == pytest.approx(largest, abs=1e-8)
            most = max(most, np.abs(env.data.xfrc_applied).max())
            loads = np.array(env.data.userdata)
            grounds |= {env.ground_under(wheel) for wheel in WHEELS}
    assert grounds >= {"dry", "ice"}
    assert (most > 1.0) == (kind not in ("in the air", "on its side"))
    if kind == "one wheel lifted":
        assert lifted > 3


def test_patches_are_sampled_in_the_field(env):
    kinds = set()
    for seed in range(30):
        env.reset(seed=seed)
        assert [patch.ground for patch in env.ground.patches] == ["wet"] * 4 + ["ice"] * 4
        for patch in env.ground.patches:
            assert 0.6 <= patch.radius <= 1.0 and np.abs(patch.center).max() + patch.radius <= 4
        kinds.add(env.ground_under("rear_left"))
    assert kinds == {"dry", "wet", "ice"}


# Rest, and what is said of a step ----------------------------------------------------------------------------


def test_it_comes_to_rest_and_stays_there(env):
    """Where slip counts against SLOWEST the tyre is stiffest: an explicit step must neither creep nor chatter."""
    start(env)
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
    np.testing.assert_allclose(observation[5:9], RADIUS * qvel[RATES])
    assert observation[9] == pytest.approx(env.data.ten_length[0], abs=2e-3)
    for target, lidar in (
        (env.goal_position, observation[10:26]),
        (env.hazard_positions[0], observation[26:]),
    ):
        ahead, left = (axes[:2, :2].T @ (target - env.agent_position)).tolist()
        sector = int(math.atan2(left, ahead) % math.tau / (math.tau / 16))
        assert lidar.argmax() == sector
        assert lidar.max() == pytest.approx(1 - math.hypot(ahead, left) / 12.0)


@pytest.mark.parametrize(
    ("height", "turned", "pressed"),
    [(0.12, [0.0, 1.0, 0.0, 0.0], []), (0.295, [math.sqrt(0.5), math.sqrt(0.5), 0.0, 0.0], [1, 3])],
    ids=["on its back", "on its right side, axles upright"],
)
def test_rolled_over_is_the_end_and_no_tyre_pushes(env, height, turned, pressed):
    start(env)
    qpos = env.data.qpos.copy()
    qpos[2], qpos[3:7] = height, turned
    env.set_state(qpos, np.zeros(env.model.nv))
    assert (np.array(env.data.userdata)[pressed] > 0.0).all()
    assert not env.data.xfrc_applied.any()
    assert env.step(throttle(1.0))[2]
    assert not env.data.xfrc_applied.any()
