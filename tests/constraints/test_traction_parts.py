"""What Traction is made of, each part by what goes wrong without it: estimate, memory, rows, fallback."""

import math

import gymnasium as gym
import mujoco
import numpy as np
import pytest
import vehicles
from scipy.integrate import solve_ivp
from vehicles import FULL, OPEN, Trolley, rover

import safe_wrappers as sw
from safe_wrappers.envs.ground import MAGIC_FORMULA
from safe_wrappers.errors import UnsupportedEnvError


def start(env, lateral=0.0, wheel_speed=None, **layout):
    """Reset, with a speed to the left (m/s) and a circumferential speed of all wheels (m/s), where given."""
    env.reset(seed=0, options={"layout": OPEN | layout})
    raw = env.unwrapped
    qvel = raw.data.qvel.copy()
    qvel[1] = lateral
    if wheel_speed is not None:
        qvel[raw.wheel_dofs] = wheel_speed / raw.wheel_radius
    raw.set_state(raw.data.qpos.copy(), qvel)
    return raw


def pulses(steering, seed=1, steps=200):
    """Torques drawn anew for every wheel every 0.2 s, and a steering angle."""
    rng = np.random.default_rng(seed)
    for _ in range(steps // 20):
        torque, angle = rng.choice([-1.0, -0.3, 0.3, 1.0], 4), steering * rng.uniform(-1.0, 1.0)
        for _ in range(20):
            yield np.array([*torque, angle], np.float32)


# The estimate ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("steering", [0.0, 1.0])
def test_the_estimate_is_the_truth_but_for_a_few_hundredths(steering):
    """Under pulses, straight on and in curves that slide: force along and across, slips that rise and fall."""
    errors = []
    for ground in ("dry", "wet", "snow", "ice"):
        env = rover()
        raw = start(env, ground=ground, speed=2.0)
        truth = MAGIC_FORMULA[raw.ground_under("front_left")].peak_friction
        for k, action in enumerate(pulses(steering)):
            info = env.step(action)[4]
            if k > 20:
                errors.append(np.abs(info["slip/mu_estimate"] - truth))
    assert np.quantile(errors, 0.99) < 0.04
    assert np.max(errors) < 0.12


# The rows ----------------------------------------------------------------------------------------------------------


def test_a_row_that_is_no_number_is_kept_and_fails():
    env = rover(friction=1e6)
    start(env, speed=1.0)
    env.filter.observe()
    traction = env.filter.bound[0].spec
    traction._window = tuple(np.nan * end for end in traction._window)
    assert np.isnan(traction.rows().offsets).all()
    assert traction.rows().offsets.shape == (8,)


# Traction against strange vehicles and drivers: judged by MuJoCo's own velocities, never by the filter's


# Drivers -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("ground", "period"), [("dry", 1), ("dry", 2), ("wet", 2), ("ice", 3)])
def test_throttle_and_brake_by_turns(ground, period):
    """The slip changes its sign within a control step: its mean is near zero, and so is the force measured."""
    env = rover()
    env.reset(seed=0, options={"layout": OPEN | {"ground": ground, "speed": 2.0}})
    slips = [env.step(FULL * (1 if k // period % 2 else -1))[4]["slip_max"] for k in range(200)]
    assert max(slips) < 0.16


def overshoots(steps, draw, seed=0):
    """Dry ground, each wheel's command drawn for itself at every step: slips at all physics substeps, at the end."""
    env, rng, slips = rover(), np.random.default_rng(seed), []
    for step in range(steps):
        if step % 300 == 0:
            env.reset(seed=0, options={"layout": OPEN | {"speed": rng.uniform(0.0, 3.0)}})
        info = env.step(draw(rng).astype(np.float32))[4]
        assert not info["cbf/infeasible"]
        slips.append((info["slip_max"], np.abs(info["slip"]).max()))
    return np.array(slips)


def longest_run(flags):
    ends = np.flatnonzero(~np.concatenate([[False], flags, [False]]))
    return int(np.diff(ends).max()) - 1


def full_or_nothing(rng):
    return np.append(np.sign(rng.uniform(-1, 1, 4)), rng.uniform(-0.2, 0.2))


def test_wheels_driven_against_each_other_at_random():
    """The limit is 0.15. What the other wheels do changes the speed over ground from step to step."""
    beyond = overshoots(300, full_or_nothing) > 0.17
    assert beyond[:, 0].sum() <= 2  # dozens without anything kept free
    assert longest_run(beyond[:, 0]) <= 2


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
    traction, slips, errors = env.filter.bound[0].spec, [], []
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


@pytest.mark.parametrize("integrator", ["EULER", "IMPLICIT", "IMPLICITFAST"])
@pytest.mark.parametrize("substeps", [1, 5, 25])
def test_wheels_that_touch_nothing_feel_no_force(integrator, substeps):
    """In the air, from torque to rate and back: exact."""
    raw = Trolley(height=50.0, damping=0.05, substeps=substeps)
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
    np.testing.assert_allclose(env.filter.bound[0].spec.seen.traction, 0.0, atol=1e-4)


SERVOS = {
    "speed": '<velocity joint="{}" kv="0.5" ctrlrange="-40 40"/>',
    "position": '<position joint="{}" kp="0.5" gear="2" ctrlrange="-40 40"/>',
    "dc motor": '<general joint="{}" gaintype="affine" gainprm="2 0 -0.1" ctrlrange="-1 1"/>',
}


@pytest.mark.parametrize("servo", SERVOS)
def test_a_wheel_that_a_servo_drives_is_refused(servo):
    actuators = "".join(SERVOS[servo].format(side) for side in ("left", "right"))
    with pytest.raises(UnsupportedEnvError, match="actuator 'left' is a servo"):
        sw.SlipLimiter(Trolley(0.15, actuators=actuators), wheels=["left", "right"])


# What a step before was ----------------------------------------------------------------------------------------


def test_a_state_that_is_no_number_is_forgotten():
    """The filter falls back; when numbers come again, nothing from before them is counted on."""
    env = sw.SlipLimiter(Trolley(0.15), wheels=["left", "right"])
    env.reset(seed=0)
    for _ in range(30):
        env.step(np.ones(2, dtype=np.float32))
    raw = env.unwrapped
    good = raw.data.qvel.copy()
    traction, full = env.filter.bound[0], np.ones(2)
    assert (traction.spec.seen.present > 0.0).all()
    raw.data.qvel[6] = np.nan
    env.plant.observe()
    traction.observe(traction.executed(full))
    assert np.isnan(traction.rows().offsets).all()
    assert np.isfinite(traction.backup()).all()
    raw.data.qvel[:] = good
    env.plant.observe()
    traction.observe(traction.executed(full))
    assert np.isfinite(traction.rows().offsets).all()
    np.testing.assert_array_equal(traction.spec.seen.present, 0.0)


# Bad input -----------------------------------------------------------------------------------------------------


# DrivenWheels: motion against MuJoCo's own velocities in any attitude, loads from whatever a wheel stands on


FLOOR = '<geom name="floor" type="plane" size="50 50 0.1" friction="0.01 0.005 0.0001"/>'


def wheels_of(env):
    limiter = sw.SlipLimiter(env, wheels=["left", "right"])
    return limiter.filter.bound[0].spec._wheels, limiter.plant


def test_motion_is_that_of_the_wheels_centres_in_any_attitude():
    env = Trolley()
    env.reset(seed=0)
    wheels, plant = wheels_of(env)
    model, data = env.model, env.data
    rng = np.random.default_rng(0)
    tilted, velocity = 0, np.zeros(6)
    for _ in range(50):
        data.qpos[:] = rng.normal(size=model.nq)
        data.qpos[3:7] /= np.linalg.norm(data.qpos[3:7])
        data.qvel[:] = rng.normal(size=model.nv)
        mujoco.mj_forward(model, data)
        plant.observe()
        rate, ground, sideways = wheels.motion()
        for k, name in enumerate(("left", "right")):
            geom, axle = model.geom(model.body(name).geomadr[0]).id, data.joint(name).xaxis
            mujoco.mj_objectVelocity(model, data, mujoco.mjtObj.mjOBJ_GEOM, geom, velocity, 0)
            ahead = np.cross(axle, [0.0, 0.0, 1.0])
            ahead /= np.linalg.norm(ahead)
            left = np.cross([0.0, 0.0, 1.0], ahead)
            assert rate[k] == pytest.approx(velocity[:3] @ axle, abs=1e-9)
            assert ground[k] == pytest.approx(velocity[3:] @ ahead, abs=1e-9)
            assert sideways[k] == pytest.approx(velocity[3:] @ left, abs=1e-9)
            tilted += abs(axle[2]) > 0.5
    assert tilted > 20


@pytest.mark.parametrize("floor", ["plane", "box"])
def test_loads_on_any_floor(floor, monkeypatch):
    """A contact names its geoms by their types' order: a wheel comes second on a plane, first on a box."""
    if floor == "box":
        box = '<geom name="floor" type="box" size="5 5 0.1" pos="0 0 -0.1" friction="0.01 0.005 0.0001"/>'
        monkeypatch.setattr(vehicles, "TROLLEY", vehicles.TROLLEY.replace(FLOOR, box))
    env = Trolley()
    assert env.model.geom("floor").type[0] == getattr(mujoco.mjtGeom, f"mjGEOM_{floor.upper()}")
    wheels, _ = wheels_of(env)
    env.reset(seed=0)
    for _ in range(100):
        env.step(np.zeros(2))
    caster = pushed_by(env, "front")
    weight = 9.81 * env.model.body_mass.sum()
    assert wheels.loads(env.model, env.data).sum() == pytest.approx(weight - caster, rel=1e-3)
    assert caster > 0.1 * weight


def pushed_by(env, *bodies):
    """Sum of the normal forces of all contacts of some bodies."""
    ids, force, total = [env.model.body(name).id for name in bodies], np.zeros(6), 0.0
    for k, pair in enumerate(env.data.contact.geom):
        if np.isin(env.model.geom_bodyid[pair], ids).any():
            mujoco.mj_contactForce(env.model, env.data, k, force)
            total += force[0]
    return total
