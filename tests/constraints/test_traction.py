"""Traction and SlipLimiter: slip within its limit on every ground, without being told which; its parts by oracles."""

import warnings

import gymnasium as gym
import mujoco
import numpy as np
import pytest
from asking import bound
from scenes import Scene

import safe_wrappers as sw
from safe_wrappers.control.vehicle import slip_ratio
from safe_wrappers.envs.ground import MAGIC_FORMULA
from safe_wrappers.errors import UnsupportedEnvError
from safe_wrappers.plants.mujoco.driven_wheels import DrivenWheels

FULL = np.array([1.0, 1.0, 1.0, 1.0, 0.0], dtype=np.float32)
OPEN = {"agent": [0.0, 0.0, 0.0], "goal": [4.0, 4.0], "hazards": [], "patches": []}


def rover(**options):
    """SafeRover under a SlipLimiter of all its wheels."""
    env = gym.make("SafeRover-v0", max_episode_steps=100_000)
    return sw.CBFActionFilter(env, [sw.constraints.Traction(env.unwrapped.wheels, **options)])


DRIVES = {
    "full throttle": (0.0, lambda k: FULL),
    "full reverse": (0.0, lambda k: -FULL),
    "panic brake": (3.0, lambda k: -FULL),
    # The slip changes its sign within a control step: its mean is near zero, and so is the force measured.
    "throttle and brake by turns": (2.0, lambda k: FULL * (1 if k // 2 % 2 else -1)),
}


@pytest.mark.parametrize("ground", ["dry", "wet", "ice"])
@pytest.mark.parametrize("name", DRIVES)
def test_drives_stay_on_the_stable_side_and_use_what_there_is(name, ground):
    (speed, act), env, top = DRIVES[name], rover(), MAGIC_FORMULA[ground]
    env.reset(seed=0, options={"layout": OPEN | {"ground": ground, "speed": speed}})
    infos, raw = [], env.unwrapped
    while raw.forward_speed > 0.02 if name == "panic brake" else len(infos) < 120:
        infos.append(env.step(act(len(infos)))[4])
    assert max(info["slip_max"] for info in infos) < 0.16
    slips = np.abs([info["slip"] for info in infos])
    if name.startswith("full"):
        # The estimate is of a peak that is flat: within a sixth of it, less than a hundredth of force is lost.
        assert slips.max() < max(1.17 * top.peak_slip, 0.135)
        assert (slips[60:] > 0.6 * top.peak_slip).all()
    if name == "panic brake":  # v^2 / (2 mu g) needs the peak's slip at all wheels from the first moment on
        assert raw.agent_position[0] < 1.05 * 9.0 / (2.0 * top.peak_friction * 9.81)


def test_another_ground_costs_a_step_or_two():
    """Full throttle from dry ground onto ice, straight on."""
    ice = {"ground": "ice", "center": [2.0, 0.0], "radius": 1.0}
    env, free = rover(), rover().env
    for each in (env, free):
        each.reset(seed=0, options={"layout": OPEN | {"patches": [ice]}})
    slips, spins = [], []
    while env.unwrapped.agent_position[0] < 2.5:
        slips.append(env.step(FULL)[4]["slip_max"])
    while free.unwrapped.agent_position[0] < 2.5:
        spins.append(free.step(FULL)[4]["slip_max"])
    assert max(slips) < 0.3
    assert sum(s > 0.2 for s in slips) <= 4  # of each axle, at the patch's edge
    assert min(spins[20:]) > 0.5


def test_limit_margin_and_a_ground_that_is_counted_on_are_the_users():
    def driven(steps, ground, **options):
        env = rover(**options)
        env.reset(seed=0, options={"layout": OPEN | {"ground": ground}})
        slips = [env.step(FULL)[4]["slip_max"] for _ in range(steps)]
        return max(slips), env.unwrapped.forward_speed

    for limit in (0.03, 0.08):
        assert 0.9 * limit < driven(120, "wet", max_slip=limit)[0] < 1.1 * limit
        assert driven(120, "wet", max_slip=limit, margin=0.3 * limit)[0] < 0.75 * limit
    assert driven(8, "dry", friction=0.9)[1] > 1.1 * driven(8, "dry")[1]  # used at once


def test_a_wheel_in_the_air_keeps_the_ground_speed():
    """Lifted, under full throttle: no load, no force, and it must touch down rolling."""
    env = rover()
    before = env.reset(seed=0, options={"layout": OPEN | {"speed": 2.0}})[1]["slip/mu_estimate"]
    raw = env.unwrapped
    qpos, qvel = raw.data.qpos.copy(), raw.data.qvel.copy()
    qpos[2] += 0.5
    raw.set_state(qpos, qvel)
    for _ in range(20):
        info = env.step(FULL)[4]
        assert (raw.data.userdata == 0.0).all()
        slip = slip_ratio(raw.wheel_radius * raw.data.qvel[raw.wheel_dofs], raw.forward_speed, 0.5)
        assert (np.abs(slip) < 0.11).all()
    np.testing.assert_array_equal(info["slip/mu_estimate"], before)  # nothing was measured


def test_a_policy_that_is_not_finite_is_braked_for_within_the_limit():
    env = rover()
    env.reset(seed=0, options={"layout": OPEN | {"ground": "wet", "speed": 3.0}})
    with warnings.catch_warnings(action="ignore"):
        infos = [env.step(np.full(5, np.nan, dtype=np.float32))[4] for _ in range(110)]
    assert all(info["cbf/fallback"] for info in infos)
    assert max(info["slip_max"] for info in infos) < 0.17
    assert abs(env.unwrapped.forward_speed) < 0.02


def test_wheels_driven_against_each_other_at_random():
    """The limit is 0.15. What the other wheels do changes the speed over ground from step to step."""
    env, rng, beyond = rover(), np.random.default_rng(0), [False]
    env.reset(seed=0, options={"layout": OPEN | {"speed": rng.uniform(0.0, 3.0)}})
    for _ in range(300):
        action = np.append(np.sign(rng.uniform(-1, 1, 4)), rng.uniform(-0.2, 0.2))
        info = env.step(action.astype(np.float32))[4]
        assert not info["cbf/infeasible"]
        beyond.append(info["slip_max"] > 0.17)
    assert sum(beyond) <= 2  # dozens without anything kept free


def test_the_estimate_is_the_truth_but_for_a_few_hundredths():
    """Under pulses in curves that slide: force along and across, slips that rise and fall."""
    errors = []
    for ground in ("dry", "wet", "snow", "ice"):
        env, rng = rover(), np.random.default_rng(1)
        env.reset(seed=0, options={"layout": OPEN | {"ground": ground, "speed": 2.0}})
        truth = MAGIC_FORMULA[env.unwrapped.ground_under("front_left")].peak_friction
        for k in range(200):
            if k % 20 == 0:
                torque, angle = rng.choice([-1.0, -0.3, 0.3, 1.0], 4), rng.uniform(-1.0, 1.0)
                action = np.append(torque, angle).astype(np.float32)
            info = env.step(action)[4]
            if k > 20:
                errors.append(np.abs(info["slip/mu_estimate"] - truth))
    assert np.quantile(errors, 0.99) < 0.04
    assert np.max(errors) < 0.12


# A trolley on MuJoCo's own friction --------------------------------------------------------------------------

TROLLEY = """
<mujoco>
  <option timestep="0.002"/>
  <worldbody>
    <geom name="floor" {floor} friction="0.01 0.005 0.0001"/>
    <body name="trolley" pos="0 0 {height}">
      <freejoint name="trolley"/>
      <geom name="hull" type="box" size="0.25 0.15 0.03" pos="0 0 0.05" mass="4" contype="0" conaffinity="0"/>
      <body name="front" pos="0.2 0 0"><geom type="sphere" size="0.1" mass="0.2" condim="1" priority="1"/></body>
      <body name="left" pos="-0.15 0.2 0">
        <joint name="left" axis="0 1 0" damping="{damping}" armature="0.01"/>{wheel}
      </body>
      <body name="right" pos="-0.15 -0.2 0">
        <joint name="right" axis="0 1 0" damping="{damping}" armature="0.01"/>{wheel}
      </body>
    </body>
  </worldbody>
  <actuator>{actuators}</actuator>
</mujoco>
"""
WHEEL = '<geom type="cylinder" size="0.1 0.02" euler="90 0 0" mass="0.5" friction="{friction} 0.005 0.0001"/>'
MOTORS = '<motor joint="left" gear="6" ctrlrange="-1 1"/><motor joint="right" gear="6" ctrlrange="-1 1"/>'
PLANE, BOX = 'type="plane" size="50 50 0.1"', 'type="box" size="50 50 0.1" pos="0 0 -0.1"'
"""A contact names its geoms by their types' order: a wheel comes second on a plane, first on a box."""
LEFT_RIGHT = ["left", "right"]


class Trolley(Scene):
    """Two driven wheels behind, a frictionless caster in front."""

    def __init__(self, friction=0.7, height=0.1, actuators=MOTORS, damping=0.01, substeps=5, floor=PLANE):
        wheel = WHEEL.format(friction=friction)
        text = TROLLEY.format(height=height, wheel=wheel, actuators=actuators, damping=damping, floor=floor)
        super().__init__(text, substeps)


def slip_of_the(wheel, data):
    return slip_ratio(0.1 * data.qvel[6 + wheel], data.qvel[0], 0.5)


@pytest.mark.parametrize(("friction", "floor", "most"), [(0.15, BOX, 0.0), (0.7, PLANE, 0.05)])
def test_on_mujocos_own_friction(friction, floor, most):
    """On much friction the trolley's wheels hop under full throttle, and have no force in the air."""
    env, free = sw.SlipLimiter(Trolley(friction, floor=floor), wheels=LEFT_RIGHT), Trolley(friction)
    data, slips, spins = env.unwrapped.data, [], []
    env.reset(seed=0), free.reset(seed=0)
    for _ in range(150):
        env.step(np.ones(2))
        free.step(np.ones(2))
        slips.append(max(abs(slip_of_the(wheel, data)) for wheel in (0, 1)))
        spins.append(abs(slip_of_the(0, free.data)))
    assert np.mean(np.array(slips) > 0.17) <= most
    assert max(slips) < 0.3
    assert np.mean(spins) > 0.4
    # Dry friction does not fall behind its peak: nothing is won, and little lost.
    assert data.qvel[0] > 0.7 * free.data.qvel[0]


@pytest.mark.parametrize("integrator", ["EULER", "IMPLICIT", "IMPLICITFAST"])
def test_wheels_that_touch_nothing_feel_no_force(integrator):
    """In the air, from torque to rate and back: exact."""
    raw = Trolley(height=50.0, damping=0.05, substeps=25)
    raw.model.opt.integrator = getattr(mujoco.mjtIntegrator, f"mjINT_{integrator}")
    env = sw.SlipLimiter(raw, wheels=LEFT_RIGHT)
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
    actuators = "".join(SERVOS[servo].format(side) for side in LEFT_RIGHT)
    with pytest.raises(UnsupportedEnvError, match="actuator 'left' is a servo"):
        sw.SlipLimiter(Trolley(0.15, actuators=actuators), wheels=LEFT_RIGHT)


def test_a_state_that_is_no_number_is_forgotten():
    """The filter falls back; when numbers come again, nothing from before them is counted on."""
    env = sw.SlipLimiter(Trolley(0.15), wheels=LEFT_RIGHT)
    env.reset(seed=0)
    for _ in range(30):
        env.step(np.ones(2))
    traction, raw = env.filter.bound[0], env.unwrapped
    good = raw.data.qvel.copy()
    assert (traction.spec.seen.present > 0.0).all()
    for rate, numbers in ((np.nan, False), (good[6], True)):
        raw.data.qvel[:], raw.data.qvel[6] = good, rate
        env.plant.observe()
        traction.observe(traction.executed(np.ones(2)))
        assert np.isfinite(traction.rows().offsets).all() == numbers
        assert np.isfinite(traction.backup()).all()
    np.testing.assert_array_equal(traction.spec.seen.present, 0.0)
    traction.spec.friction = np.nan  # a row that is no number is kept, and fails
    assert np.isnan(traction.spec.rows().offsets).sum() == 4


def test_motion_is_that_of_the_wheels_centres_in_any_attitude():
    env = Trolley()
    env.reset(seed=0)
    plant = bound(env)
    wheels, model, data = DrivenWheels(plant, LEFT_RIGHT), env.model, env.data
    rng, up, velocity = np.random.default_rng(0), np.array([0.0, 0.0, 1.0]), np.zeros(6)
    for _ in range(50):
        data.qpos[:], data.qvel[:] = rng.normal(size=model.nq), rng.normal(size=model.nv)
        data.qpos[3:7] /= np.linalg.norm(data.qpos[3:7])
        mujoco.mj_forward(model, data)
        plant.observe()
        found = np.transpose(wheels.motion())
        for name, rate_ground_sideways in zip(LEFT_RIGHT, found, strict=True):
            geom, axle = model.geom(model.body(name).geomadr[0]).id, data.joint(name).xaxis
            mujoco.mj_objectVelocity(model, data, mujoco.mjtObj.mjOBJ_GEOM, geom, velocity, 0)
            ahead = np.cross(axle, up) / np.linalg.norm(np.cross(axle, up))
            expected = velocity[:3] @ axle, velocity[3:] @ ahead, velocity[3:] @ np.cross(up, ahead)
            np.testing.assert_allclose(rate_ground_sideways, expected, atol=1e-9)
