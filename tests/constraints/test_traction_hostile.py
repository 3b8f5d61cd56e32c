"""Traction against strange vehicles, drivers and episodes: judged by MuJoCo's own velocities, never by the filter."""

import copy
import math
import pickle
import warnings

import gymnasium as gym
import mujoco
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode
from scipy.integrate import solve_ivp
from vehicles import FULL, MOTORS, OPEN, WHEEL, Trolley, rover

import safe_wrappers as sw
from safe_wrappers.constraints import traction as traction_module
from safe_wrappers.control.vehicle.slip import slip_ratio
from safe_wrappers.errors import ConfigurationError, UnsupportedEnvError


def start(env, **layout):
    env.reset(seed=0, options={"layout": OPEN | layout})
    return env


def true_slips(raw, names=("left", "right"), radius=0.1):
    """From `mj_objectVelocity` in a copy of the data: not the filter's kinematics."""
    model, data = raw.model, mujoco.MjData(raw.model)
    data.qpos[:], data.qvel[:] = raw.data.qpos, raw.data.qvel
    mujoco.mj_forward(model, data)
    slips = []
    for name in names:
        joint, velocity = model.joint(name), np.zeros(6)
        mujoco.mj_objectVelocity(model, data, mujoco.mjtObj.mjOBJ_XBODY, joint.bodyid[0], velocity, 0)
        axle = data.xaxis[joint.id]
        ahead = np.cross(axle, [0.0, 0.0, 1.0])
        ahead /= np.linalg.norm(ahead)
        slips.append(float(slip_ratio(radius * velocity[:3] @ axle, velocity[3:] @ ahead, 0.5)))
    return np.array(slips)


# Drivers -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("ground", "period"), [("dry", 1), ("dry", 2), ("wet", 2), ("ice", 3)])
def test_throttle_and_brake_by_turns(ground, period):
    """The slip changes its sign within a control step: its mean is near zero, and so is the force measured."""
    env = start(rover(), ground=ground, speed=2.0)
    slips = [env.step(FULL * (1 if k // period % 2 else -1))[4]["slip_max"] for k in range(200)]
    assert max(slips) < 0.16


def overshoots(steps, draw, seed=0):
    """Dry ground, each wheel's command drawn for itself at every step: slips at all physics substeps, at the end."""
    env, rng, slips = rover(), np.random.default_rng(seed), []
    for step in range(steps):
        if step % 300 == 0:
            start(env, speed=rng.uniform(0.0, 3.0))
        info = env.step(draw(rng).astype(np.float32))[4]
        assert not info["cbf/infeasible"]
        slips.append((info["slip_max"], np.abs(info["slip"]).max()))
    return np.array(slips)


def longest_run(flags):
    ends = np.flatnonzero(~np.concatenate([[False], flags, [False]]))
    return int(np.diff(ends).max()) - 1


def full_or_nothing(rng):
    return np.append(np.sign(rng.uniform(-1, 1, 4)), rng.uniform(-0.2, 0.2))


def anything(rng):
    return rng.uniform(-1.0, 1.0, 5)


def test_wheels_driven_against_each_other_at_random():
    """The limit is 0.15. What the other wheels do changes the speed over ground from step to step."""
    beyond = overshoots(300, full_or_nothing) > 0.17
    assert beyond[:, 0].sum() <= 2  # dozens without anything kept free
    assert longest_run(beyond[:, 0]) <= 2


@pytest.mark.slow
@pytest.mark.parametrize(("draw", "share"), [(anything, 0.0007), (full_or_nothing, 0.0053)])
def test_wheels_driven_against_each_other_at_random_for_long(draw, share):
    """The shares are those of docs/wrappers/slip-limiter.md; nothing kept free: 2.1 % and 6.8 %."""
    slips = overshoots(20_000, draw, seed=1)
    assert (slips > 0.17).mean(axis=0).max() < share
    assert slips.max() < 0.21
    assert longest_run(slips[:, 0] > 0.17) <= 2


def test_braking_straight_gives_nothing_away(monkeypatch):
    """What is kept back is for a ground speed above the prediction: a brake's own onset is below it."""
    kept = start(rover(), speed=3.0)
    expected = [kept.step(-FULL)[4]["executed_action"] for _ in range(25)]
    monkeypatch.setattr(traction_module, "_SPEED_ERROR_FACTOR", 0.0)
    free = start(rover(), speed=3.0)
    for action in expected:
        np.testing.assert_array_equal(free.step(-FULL)[4]["executed_action"], action)


def test_what_is_kept_back_is_no_limit_of_its_own(monkeypatch):
    """A wheel within its limit that cannot be brought farther inside at once is no infeasible state."""
    monkeypatch.setattr(traction_module, "_SPEED_ERROR_FACTOR", 1e6)
    slips = overshoots(100, full_or_nothing)
    assert slips.max() < 0.17


# A quarter of a car, written down as its equations ------------------------------------------------------------

RADIUS, MASS, INERTIA, DRAG, MOST = 0.3, 400.0, 1.2, 0.05, 1500.0
QUARTER = f"""
<mujoco>
  <option timestep="0.0002"/>
  <worldbody>
    <geom type="plane" size="900 900 1" condim="1"/>
    <body pos="0 0 {RADIUS}">
      <joint type="slide" axis="1 0 0"/><joint type="slide" axis="0 0 1"/>
      <geom type="box" size="0.2 0.2 0.1" mass="{MASS - 20.0}" contype="0" conaffinity="0"/>
      <body>
        <joint name="wheel" axis="0 1 0" damping="{DRAG}"/>
        <inertial pos="0 0 0" mass="20" diaginertia="0.8 {INERTIA} 0.8"/>
        <geom type="sphere" size="{RADIUS}" condim="1" density="0"/>
      </body>
    </body>
  </worldbody>
  <actuator><motor joint="wheel" gear="{MOST}" ctrlrange="-1 1"/></actuator>
</mujoco>
"""
BURCKHARDT = {"dry": (1.2801, 23.99, 0.52), "wet": (0.857, 33.822, 0.347), "snow": (0.1946, 94.129, 0.0646)}


def burckhardt(ground, slip):
    c1, c2, c3 = BURCKHARDT[ground]
    return math.copysign(c1 * (1.0 - math.exp(-c2 * abs(slip))) - c3 * abs(slip), slip)


def slip_of(v, w):
    return (RADIUS * w - v) / max(abs(v), abs(RADIUS * w), 0.5)


class QuarterCar(gym.Env):
    """Its tyre follows Burckhardt's published curve, which is not the shape that the estimate believes in."""

    def __init__(self, ground, speed, substeps=50):
        self.model = mujoco.MjModel.from_xml_string(QUARTER)
        self.data = mujoco.MjData(self.model)
        self.frame_skip, self.dt = substeps, 0.0002 * substeps
        self.ground, self.speed = ground, speed
        self.action_space = gym.spaces.Box(-1.0, 1.0, (1,))
        self.observation_space = gym.spaces.Box(-np.inf, np.inf, (2,))

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        mujoco.mj_resetData(self.model, self.data)
        self.data.qpos[1], self.data.qvel[:] = -1e-4, (self.speed, 0.0, self.speed / RADIUS)
        mujoco.mj_forward(self.model, self.data)
        return self.data.qvel[[0, 2]], {}

    def step(self, action):
        self.data.ctrl[:] = action
        for _ in range(self.frame_skip):
            force = burckhardt(self.ground, slip_of(*self.data.qvel[[0, 2]])) * MASS * 9.81
            self.data.qfrc_applied[:] = force, 0.0, -RADIUS * force
            mujoco.mj_step(self.model, self.data)
        return self.data.qvel[[0, 2]], 0.0, False, False, {}


def equations(ground, torque, state, hold):
    """Speed, rate and the force's impulse after one hold, by scipy."""

    def change(_, y):
        force = burckhardt(ground, slip_of(y[0], y[1])) * MASS * 9.81
        return [force / MASS, (torque - DRAG * y[1] - RADIUS * force) / INERTIA, force]

    return solve_ivp(change, (0.0, hold), [*state, 0.0], method="LSODA", rtol=1e-8, atol=1e-9).y[:, -1]


@pytest.mark.parametrize("ground", BURCKHARDT)
@pytest.mark.parametrize(("speed", "action"), [(3.0, 1.0), (15.0, -1.0)])
def test_a_quarter_car_by_its_equations(ground, speed, action):
    """Each hold by scipy from the env's state: its end, the force observed, the slip, and the grip that is used."""
    raw = QuarterCar(ground, speed)
    env = sw.SlipLimiter(raw, wheels=["wheel"])
    env.reset(seed=0)
    traction, slips, errors = env.filter.bound[0], [], []
    for _ in range(60):
        before = raw.data.qvel[[0, 2]].copy()
        info = env.step(np.array([action], dtype=np.float32))[4]
        v, w, impulse = equations(ground, MOST * info["executed_action"][0], before, raw.dt)
        np.testing.assert_allclose(raw.data.qvel[[0, 2]], (v, w), rtol=5e-3, atol=5e-3)
        env.filter.observe()
        errors.append(abs(traction.seen.traction[0] - impulse / raw.dt) / (MASS * 9.81))
        slips.append(abs(slip_of(v, w)))
    assert max(errors) < 0.02  # of the load
    assert max(slips) < 0.16
    top = max(burckhardt(ground, s) for s in np.linspace(0.0, 1.0, 2001))
    # A start on dry ground is the slowest: 0.70 of what the peak would give, as the force is learned step by step.
    assert abs(raw.data.qvel[0] - speed) / (60 * raw.dt) > 0.65 * top * 9.81


# Vehicles ------------------------------------------------------------------------------------------------------


def test_a_tendon_that_drives_a_limited_wheel_is_refused():
    """Its torque would be in no row: the wheels would spin at any limit."""

    joints = "".join(f'<joint joint="{side}" coef="1"/>' for side in ("left", "right"))
    tendon = f'<tendon><fixed name="axle">{joints}</fixed></tendon>'
    both = (
        MOTORS
        + '<motor name="booster" tendon="axle" gear="6" ctrlrange="-1 1"/></actuator>'
        + tendon
        + "<actuator>"
    )
    with pytest.raises(ConfigurationError, match="'left' is also driven by booster"):
        sw.SlipLimiter(Trolley(actuators=both), wheels=["left", "right"])
    alone = '<motor tendon="axle" ctrlrange="-1 1"/></actuator>' + tendon + "<actuator>"
    with pytest.raises(
        ConfigurationError, match=r"no actuator drives joint 'left' directly.*driven are none"
    ):
        sw.SlipLimiter(Trolley(actuators=alone), wheels=["left", "right"])


def test_a_drive_that_changes_is_read_anew():
    env = sw.SlipLimiter(Trolley(0.15), wheels=["left", "right"])
    env.reset(seed=0)
    before = env.filter.bound[0].rows().normals
    env.unwrapped.model.actuator_gear[:, 0] *= 2.0
    env.filter.observe()
    np.testing.assert_allclose(env.filter.bound[0].rows().normals, 2.0 * before)


@pytest.mark.parametrize("change", ["geoms more", "geoms less", "cone"])
def test_loads_are_the_envs_whatever_the_plants_model_looks_like(change):
    """Contacts name the env's geoms and are told by its cone; the plant's model may have others."""
    plain, deco = (
        Trolley(),
        Trolley(wheel='<geom type="sphere" size="0.01" contype="0" conaffinity="0"/>' + WHEEL),
    )
    env, model = (plain, deco.model) if change == "geoms more" else (deco, plain.model)
    if change == "cone":
        env, model = plain, copy.copy(plain.model)
        model.opt.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    filtered = sw.SlipLimiter(env, wheels=["left", "right"], plant=sw.MujocoPlant(model=model))
    filtered.reset(seed=0)
    for _ in range(60):
        filtered.step(np.zeros(2, dtype=np.float32))
    wheels = [env.model.joint(side).bodyid[0] for side in ("left", "right")]
    expected, force = np.zeros(2), np.zeros(6)
    for i, contact in enumerate(env.data.contact):
        for k, body in enumerate(wheels):
            if body in env.model.geom_bodyid[[contact.geom1, contact.geom2]]:
                mujoco.mj_contactForce(env.model, env.data, i, force)
                expected[k] += force[0]
    filtered.plant.observe()
    filtered.filter.bound[0].rows()
    assert (expected > 5.0).all()
    np.testing.assert_allclose(filtered.filter.bound[0].seen.load, expected, rtol=1e-6)


LEFT_RIGHT = ["left", "right"]
SERVOS = "".join(f'<velocity joint="{side}" kv="{{kv}}" ctrlrange="-40 40"/>' for side in ("left", "right"))


@pytest.mark.parametrize("integrator", ["EULER", "IMPLICIT", "IMPLICITFAST"])
@pytest.mark.parametrize("actuators", [MOTORS, SERVOS.format(kv=0.5), SERVOS.format(kv=4.0)])
@pytest.mark.parametrize("substeps", [1, 5, 25])
def test_wheels_that_touch_nothing_feel_no_force(actuators, integrator, substeps):
    """In the air, from torque to rate and back: exact, also where a servo has settled within the hold."""
    raw = Trolley(height=50.0, actuators=actuators, damping=0.05, substeps=substeps)
    raw.model.opt.integrator = getattr(mujoco.mjtIntegrator, f"mjINT_{integrator}")
    env = sw.SlipLimiter(raw, wheels=["left", "right"])
    # The hull is held: on a free one the drives' reaction turns the axles, which the wheel's equation leaves out.
    raw.model.body_inertia[raw.model.body("trolley").id] = env.plant.model.body_inertia[1] = 1e6
    env.reset(seed=0)
    raw.data.qvel[[6, 7]] = 3.0, -5.0
    mujoco.mj_forward(raw.model, raw.data)
    for _ in range(6):
        raw.step(np.array([0.5, -0.3]) * env.action_space.high)
        env.filter.observe()
    assert np.abs(raw.data.qvel[6:]).min() > 0.3
    np.testing.assert_allclose(env.filter.bound[0].seen.traction, 0.0, atol=1e-4)


@pytest.mark.parametrize(("kv", "substeps"), [(0.5, 25), (5.0, 5), (5.0, 25)])
def test_a_servo_faster_than_the_hold_still_drives(kv, substeps):
    env = sw.SlipLimiter(
        Trolley(0.15, actuators=SERVOS.format(kv=kv), substeps=substeps), wheels=["left", "right"]
    )
    env.reset(seed=0)
    slips = []
    for _ in range(500 // substeps):
        env.step(np.full(2, 40.0, dtype=np.float32))
        slips.append(true_slips(env.unwrapped))
    assert np.abs(slips).max() < 0.17
    assert np.abs(slips).max() > 0.09
    assert env.unwrapped.data.qvel[0] > 0.3


@pytest.mark.parametrize("clamp", ["", 'forcerange="-1 1"'])
@pytest.mark.parametrize("integrator", ["EULER", "IMPLICITFAST"])
def test_a_servo_too_stiff_to_be_limited_is_refused_with_one_that_works(integrator, clamp):
    def limited(kv):
        servos = "".join(
            f'<velocity joint="{side}" kv="{kv}" ctrlrange="-40 40" {clamp}/>' for side in LEFT_RIGHT
        )
        raw = Trolley(0.9, actuators=servos)
        raw.model.opt.integrator = getattr(mujoco.mjtIntegrator, f"mjINT_{integrator}")
        return sw.SlipLimiter(raw, wheels=LEFT_RIGHT)

    with pytest.raises(UnsupportedEnvError, match=r"speed servo 'left' is too stiff") as caught:
        limited(30.0)
    kv = float(str(caught.value).rpartition("at most ")[2])
    env = limited(kv)
    env.reset(seed=0)
    changed = 0
    for step in range(200):  # to 20 rad/s within a second: the ground has ten times what that takes
        info = env.step(np.full(2, 20.0 * min(1.0, step / 100.0), dtype=np.float32))[4]
        changed += info["cbf/intervened"]
    assert changed == 0 and env.unwrapped.data.qvel[0] > 1.9


def test_dry_friction_of_an_axle_leaves_the_limit_where_it_is():
    """It is measured as the ground's, which is right for the wheel and wrong for the estimate alone."""
    raw = Trolley(0.15)
    raw.model.dof_frictionloss[6:] = 0.3
    env = sw.SlipLimiter(raw, wheels=["left", "right"])
    env.reset(seed=0)
    slips = []
    for _ in range(120):
        info = env.step(np.ones(2, dtype=np.float32))[4]
        slips.append(true_slips(raw))
    assert np.abs(slips).max() < 0.17
    assert (info["slip/mu_estimate"] > 0.17).all()
    assert raw.data.qvel[0] > 0.7


# What a step before was ----------------------------------------------------------------------------------------


def test_a_second_look_changes_nothing():
    """A logger that asks for rows between two steps must not be taken for a control step in which nothing moved."""
    watched, left_alone = (start(rover(), ground="ice", speed=2.0) for _ in range(2))
    for _ in range(30):
        watched.plant.observe()
        watched.filter.bound[0].rows()
        got, expected = watched.step(FULL)[4], left_alone.step(FULL)[4]
        np.testing.assert_array_equal(got["executed_action"], expected["executed_action"])
        np.testing.assert_array_equal(got["slip/mu_estimate"], expected["slip/mu_estimate"])


def test_a_clock_that_is_set_back_measures_nothing():
    """An env that starts its own next episode within a step: the motion before it says nothing about the ground."""
    env = start(rover(), ground="wet")
    for _ in range(30):
        env.step(FULL)
    raw = env.unwrapped
    mujoco.mj_resetData(raw.model, raw.data)
    raw.set_state(raw.init_qpos.copy(), np.zeros(raw.model.nv))
    known = env.filter.bound[0].seen.estimate.mean
    info = env.step(FULL)[4]
    np.testing.assert_array_equal(env.filter.bound[0].seen.traction, 0.0)
    np.testing.assert_array_equal(info["slip/mu_estimate"], known)
    fresh = start(rover(), ground="wet").step(FULL)[4]
    # As from a fresh start but for the limit, which the estimate has moved.
    np.testing.assert_allclose(info["executed_action"], fresh["executed_action"], rtol=0.5)


def test_a_state_that_is_set_costs_one_wrong_step_and_no_estimate():
    """Braking at 4 m/s, then at once at 6 m/s with the same slip: no ground has that force."""
    env = start(rover(), ground="wet", speed=4.0)
    for _ in range(25):
        info = env.step(-FULL)[4]
    known, raw = info["slip/mu_estimate"], env.unwrapped
    qvel = np.zeros(raw.model.nv)
    qvel[0], qvel[raw.wheel_dofs] = 6.0, 0.92 * 60.0
    raw.set_state(raw.data.qpos.copy(), qvel)
    after = [env.step(-FULL)[4] for _ in range(30)]
    np.testing.assert_allclose(after[0]["slip/mu_estimate"], known, rtol=0.05)
    assert max(i["slip_max"] for i in after) < 0.2


def test_a_state_that_is_no_number_is_forgotten():
    """The filter falls back; when numbers come again, nothing from before them is counted on."""
    env = sw.SlipLimiter(Trolley(0.15), wheels=["left", "right"])
    env.reset(seed=0)
    for _ in range(30):
        env.step(np.ones(2, dtype=np.float32))
    raw = env.unwrapped
    good = raw.data.qvel.copy()
    traction, full = env.filter.bound[0], np.ones(2)
    assert (traction.seen.present > 0.0).all()
    raw.data.qvel[6] = np.nan
    env.plant.observe()
    traction.observe(traction.executed(full))
    assert np.isnan(traction.rows().offsets).all()
    assert np.isfinite(traction.backup()).all()
    raw.data.qvel[:] = good
    env.plant.observe()
    traction.observe(traction.executed(full))
    assert np.isfinite(traction.rows().offsets).all()
    np.testing.assert_array_equal(traction.seen.present, 0.0)


class AlwaysHere(gym.Wrapper):
    """Every episode starts at the same place, on wet ground."""

    def reset(self, *, seed=None, options=None):
        return self.env.reset(seed=seed, options={"layout": OPEN | {"ground": "wet"}})


@pytest.mark.parametrize("mode", [AutoresetMode.NEXT_STEP, AutoresetMode.SAME_STEP])
def test_a_vector_envs_next_episode_starts_afresh(mode):
    """Same layout in every episode: so are the filter's actions and estimates, and no key comes or goes."""

    def make():
        env = gym.make("SafeRover-v0", max_episode_steps=12)
        return sw.SlipLimiter(AlwaysHere(env), wheels=env.unwrapped.wheels)

    envs = gym.vector.SyncVectorEnv([make, make], autoreset_mode=mode)
    _, infos = envs.reset(seed=0)
    keys, seen = {k for k in infos if k.startswith(("slip/", "cbf/"))}, []
    assert len(keys) >= 4 + 8
    for _ in range(40):
        infos = envs.step(np.stack([FULL, FULL]))[4]
        assert keys <= set(infos)
        seen.append(np.concatenate([infos["executed_action"][0], infos["slip/mu_estimate"][0]]))
    period = 13 if mode is AutoresetMode.NEXT_STEP else 12
    np.testing.assert_array_equal(seen[:11], seen[period : period + 11])
    assert np.ptp(np.array(seen)[:11, 0]) > 0.1
    envs.close()


# Reports -------------------------------------------------------------------------------------------------------


def test_actions_in_double_precision_are_limited_only_where_they_are():
    env = start(rover())
    action = np.array([1.0, 0.1, 0.01, 0.02, 0.3])  # none but the first is a float32
    info = env.step(action)[4]
    assert info["cbf/intervened"]
    assert info["slip/limited"].tolist() == [True, False, False, False]


def test_infos_keep_their_shape_and_share_nothing():
    env = start(rover())
    rng = np.random.default_rng(0)
    infos = [env.reset(seed=0)[1]]
    with warnings.catch_warnings(action="ignore"):
        for k in range(100):
            action = rng.uniform(-2, 2, 5).astype(np.float32)
            if k % 17 == 0:
                action[0] = np.nan
            infos.append(env.reset()[1] if k % 23 == 22 else env.step(action)[4])
            infos.append(copy.deepcopy(infos[-1]))

    def shapes(info):
        return {k: (type(v), getattr(v, "dtype", None), getattr(v, "shape", None)) for k, v in info.items()}

    assert all(shapes(info) == shapes(infos[0]) for info in infos)
    for info, kept in zip(infos[1::2], infos[2::2], strict=True):
        for key, value in kept.items():
            np.testing.assert_array_equal(info[key], value)


@pytest.mark.parametrize("copied", [copy.deepcopy, lambda env: pickle.loads(pickle.dumps(env))])
def test_a_copy_filters_its_own_env(copied):
    """Gymnasium's MuJoCo envs start anew when copied; the copy's filter must read that env, not the first."""
    env = start(rover(), ground="wet")
    for _ in range(20):
        env.step(FULL)
    twin = start(copied(env), ground="wet")
    expected = [twin.step(FULL)[4]["executed_action"] for _ in range(10)]
    start(env, ground="wet")
    for action in expected:
        np.testing.assert_array_equal(env.step(FULL)[4]["executed_action"], action)


# Bad input -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        ({"wheels": [0, 1]}, "list of joint names"),
        ({"wheels": None}, "list of joint names"),
        ({"max_slip": [0.1, 0.1]}, "max_slip must be a number"),
        ({"max_slip": None}, "max_slip must be a number"),
        ({"max_slip": float("inf")}, "max_slip must be a finite number"),
        ({"friction": [0.1] * 4}, "friction must be a number"),
    ],
)
def test_arguments_of_other_types_are_refused_by_name(arguments, says):
    with pytest.raises(ConfigurationError, match=says):
        sw.constraints.Traction(**{"wheels": ["left"]} | arguments)
