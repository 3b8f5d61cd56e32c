"""DrivenWheels: motion against MuJoCo's own velocities in any attitude, loads from whatever a wheel stands on."""

import mujoco
import numpy as np
import pytest
import vehicles
from vehicles import Trolley

import safe_wrappers as sw

FLOOR = '<geom name="floor" type="plane" size="50 50 0.1" friction="0.01 0.005 0.0001"/>'


def wheels_of(env):
    limiter = sw.SlipLimiter(env, wheels=["left", "right"])
    return limiter.filter.bound[0].wheels, limiter.plant


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
        rate, ground, sideways = wheels.motion(plant)
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


def test_a_wheel_that_lies_flat_goes_nowhere():
    """Its axle stands upright but for rounding, and what is left of a direction is none."""
    env = Trolley()
    env.reset(seed=0)
    wheels, plant = wheels_of(env)
    env.data.qpos[3:7] = [np.sqrt(0.5), np.sqrt(0.5), 0.0, 0.0]
    env.data.qvel[:3] = 1.0, 2.0, 0.5
    mujoco.mj_forward(env.model, env.data)
    assert abs(env.data.joint("left").xaxis[2]) == pytest.approx(1.0)
    plant.observe()
    _, ground, sideways = wheels.motion(plant)
    assert (ground == 0.0).all()
    assert (sideways == 0.0).all()


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


def test_a_wall_carries_nothing(monkeypatch):
    wall = FLOOR + '<geom name="wall" type="box" size="0.1 5 1" pos="-0.348 0 1"/>'
    monkeypatch.setattr(vehicles, "TROLLEY", vehicles.TROLLEY.replace(FLOOR, wall))
    env = Trolley(height=0.5)
    wheels, _ = wheels_of(env)
    env.reset(seed=0)  # 2 mm inside the wall, and above the floor
    pressed = pushed_by(env, "left", "right")
    assert pressed > 10.0
    assert wheels.loads(env.model, env.data).sum() < 1e-3 * pressed


def test_the_geom_that_touches_is_the_wheel():
    """Not a hub cap that is listed first and touches nothing."""
    hub = '<geom type="cylinder" size="0.05 0.03" euler="90 0 0" mass="0.1" contype="0" conaffinity="0"/>'
    wheels, plant = wheels_of(Trolley(wheel=hub + vehicles.WHEEL))
    np.testing.assert_allclose(wheels.constants(plant).radius, 0.1)


def test_of_geoms_that_touch_the_one_of_the_joints_name_is_the_wheel(monkeypatch):
    hub = '<geom type="cylinder" size="0.05 0.03" euler="90 0 0" mass="0.1"/>'
    named = vehicles.WHEEL.replace("<geom ", '<geom name="left" ')
    both = vehicles.TROLLEY.replace("{wheel}", (hub + named).format(friction=0.7), 1)
    monkeypatch.setattr(vehicles, "TROLLEY", both)
    wheels, plant = wheels_of(Trolley())
    np.testing.assert_allclose(wheels.constants(plant).radius, 0.1)


def test_all_geoms_of_a_wheel_carry():
    """Two rims side by side: either may be what touches."""
    rim = (
        '<geom type="cylinder" size="0.1 0.02" euler="90 0 0" pos="0 {y} 0" mass="0.25" friction="0.7 0 0"/>'
    )
    env = Trolley(wheel=rim.format(y=0.05) + rim.format(y=-0.05))
    wheels, _ = wheels_of(env)
    env.reset(seed=0)
    for _ in range(100):
        env.step(np.zeros(2))
    assert wheels.loads(env.model, env.data).sum() == pytest.approx(pushed_by(env, "left", "right"), rel=1e-9)
