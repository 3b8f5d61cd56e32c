"""Forecasts of contacts against the env's own step, MuJoCo's solver decoded by hand, and Newton's laws."""

import gymnasium as gym
import mujoco
import numpy as np
import pytest
from asking import bound
from scenes import Scene

from safe_wrappers.plants.mujoco.contacts import Replay, can_touch_the_world

ROBOTS = ("Ant-v5", "HalfCheetah-v5", "Hopper-v5", "Walker2d-v5", "Humanoid-v5")


class Legs(Scene):
    """A trunk on two driven legs beside other things that move; the action is the control."""

    XML = """<mujoco><option timestep="0.002" integrator="{integrator}" cone="{cone}"/>
    <default><geom condim="{condim}" friction="0.6 0.01 0.002"/></default>
    <worldbody>
      <geom name="floor" type="plane" size="5 5 .1"/>
      <body name="step" pos=".35 0 0"><geom name="step" type="box" size=".1 .3 .06"/></body>
      <body name="lift" mocap="true" pos="-.35 0 0"><geom name="lift" type="box" size=".1 .3 .05"/></body>
      <body name="trunk" pos="0 0 .42"><freejoint/>
        <geom name="trunk" type="box" size=".3 .1 .05" mass="4"/>
        <body name="front" pos=".3 0 0"><joint name="hip" axis="0 1 0" range="-40 40" damping=".5"/>
          <geom name="front" type="capsule" fromto="0 0 0 0 0 -.3" size=".05" mass=".6"/></body>
        <body name="back" pos="-.3 0 0"><joint name="tail" axis="0 1 0" range="-40 40" damping=".5"/>
          <geom name="back" type="capsule" fromto="0 0 0 0 0 -.3" size=".05" mass=".6"/></body>
      </body>
      <body name="load" pos="0 0 .55"><freejoint/><geom name="load" type="box" size=".1 .1 .06" mass="1"/></body>
      {more}
    </worldbody>
    <actuator><motor name="hip" joint="hip" gear="40" ctrllimited="true" ctrlrange="-1 1"/>
      <motor name="tail" joint="tail" gear="40" ctrllimited="true" ctrlrange="-1 1"/>{act}</actuator>
    {end}</mujoco>"""

    def __init__(self, integrator="Euler", cone="pyramidal", condim=3, more="", act="", end=""):
        super().__init__(
            self.XML.format(integrator=integrator, cone=cone, condim=condim, more=more, act=act, end=end)
        )


def decoded(model, data, contact):
    """The contact's force on its second geom, in the world, from the rows of the solver, N."""
    rows = data.efc_force[contact.efc_address :]
    frame = contact.frame.reshape(3, 3)
    if contact.dim == 1:
        return rows[0] * frame[0]
    if model.opt.cone == mujoco.mjtCone.mjCONE_ELLIPTIC:
        return rows[:3] @ frame
    edges = rows[: 2 * (contact.dim - 1)].reshape(-1, 2)
    return edges.sum() * frame[0] + ((edges[:2, 0] - edges[:2, 1]) * contact.friction[:2]) @ frame[1:]


def happened(env, action):
    """Every contact of moving bodies with the fixed world at every evaluation of the env's own step."""
    raw, replay, seen = env.unwrapped, Replay(env.unwrapped), []
    model = raw.model
    jointed = model.body_dofnum > 0

    def moving(geom):
        body = int(model.geom_bodyid[geom])
        while body and not jointed[body]:
            body = model.body_parentid[body]
        return body > 0

    def look(data, _):
        here = []
        for contact in data.contact:
            first, second = (moving(g) for g in contact.geom)
            if first != second and contact.efc_address >= 0:
                side = 1.0 if second else -1.0
                body = model.geom_bodyid[contact.geom[1 if second else 0]]
                force = side * decoded(model, data, contact)
                here.append((body, *contact.pos, *side * contact.frame[:3], *force))
        seen.append(np.array(here).reshape(-1, 10))

    replay.before()
    env.step(action)
    assert replay.after(look)
    return seen


def same(found, seen, rounding=1e-9):
    assert found.finite and found.steps == len(seen)
    np.testing.assert_array_equal(found.step, np.repeat(np.arange(len(seen)), [len(at) for at in seen]))
    mine, theirs = np.column_stack([found.body, found.point, found.normal, found.force]), np.concatenate(seen)
    np.testing.assert_allclose(
        mine, theirs, rtol=rounding, atol=rounding * (1.0 + np.abs(theirs).max(initial=0))
    )
    return len(theirs)


@pytest.mark.parametrize("env_id", ROBOTS)
def test_it_is_what_the_env_does_then(env_id):
    env = gym.make(env_id)
    plant = bound(env)
    rng = np.random.default_rng(0)
    env.reset(seed=0)
    touched = 0
    for k in range(15):
        action = rng.uniform(env.action_space.low, env.action_space.high) * (0.2 if k % 2 else 1.0)
        plant.observe()
        found = plant.contact_forecast(action)
        assert found.steps == env.unwrapped.frame_skip * (4 if env.unwrapped.model.opt.integrator == 1 else 1)
        touched += same(found, happened(env, action), 1e-7)
    assert touched > 5


KINDS = pytest.mark.parametrize(
    ("integrator", "cone", "condim"),
    [
        ("Euler", "pyramidal", 3),
        ("Euler", "elliptic", 4),
        ("RK4", "pyramidal", 4),
        ("RK4", "elliptic", 3),
        ("implicitfast", "pyramidal", 6),
        ("implicitfast", "elliptic", 1),
    ],
)


@KINDS
def test_of_every_kind_of_contact_on_floors_steps_and_lifts(integrator, cone, condim):
    env = Legs(integrator, cone, condim)
    plant = bound(env)
    rng = np.random.default_rng(1)
    env.reset()
    bodies, normals = set(), 0.0
    for k in range(25):
        env.data.mocap_pos[0, 2] = 0.05 + 0.02 * np.sin(k)
        action = rng.choice([-1.0, 1.0], 2)
        plant.observe()
        found = plant.contact_forecast(action)
        same(found, happened(env, action))
        bodies |= set(found.body.tolist())
        names = {env.model.body(b).name for b in found.body}
        assert not names & {"step", "lift", "world"}
        np.testing.assert_array_equal(found.friction, 0.0 if condim == 1 else 0.6)
        pressing = np.einsum("ki,ki->k", found.force, found.normal)
        normals += pressing.sum()
        assert (pressing >= 0.0).all()
    assert len(bodies) >= 2 and normals > 0.0


def test_what_moves_is_no_ground_and_either_geom_may_come_first():
    # The load lies on the trunk; the floor's geom comes before the legs' and the ledge's after them.
    ledge = '<body pos="0 0 .3"><geom name="ledge" type="box" size=".2 .2 .07"/></body>'
    env = Legs(more=ledge)
    plant = bound(env)
    env.reset()
    seen, inside = set(), 0
    for _ in range(40):
        plant.observe()
        found = plant.contact_forecast(np.zeros(2))
        same(found, happened(env, np.zeros(2)))
        data = env.data
        inside += sum(env.model.geom(int(g)).name == "load" for c in data.contact for g in c.geom)
        seen |= {
            (env.model.body(b).name, round(float(z), 6))
            for b, z in zip(found.body, found.normal[:, 2], strict=True)
        }
    assert inside and ("trunk", 1.0) in seen and ("load", 1.0) not in seen


@pytest.mark.parametrize("integrator", ["Euler", "RK4"])
@pytest.mark.parametrize("fast", [1e11, 1e30, 1e200])
def test_numbers_that_mujoco_resets_are_no_forecast(integrator, fast):
    env = Legs(integrator)
    plant = bound(env)
    env.reset()
    for _ in range(20):
        env.step(np.zeros(2))
    for where, index in (("qvel", 6), ("qvel", 2), ("qpos", 7)):
        at = getattr(env.data, where)
        kept = at[index]
        plant.observe()
        assert plant.contact_forecast(np.zeros(2)).finite
        at[index] = fast
        plant.observe()
        assert not plant.contact_forecast(np.zeros(2)).finite
        at[index] = kept


@pytest.mark.parametrize("integrator", ["Euler", "RK4"])
def test_accelerations_that_end_in_a_reset_are_found_where_speeds_are_not_out_of_bounds(integrator):
    rail = '<joint name="rail" axis="1 0 0" type="slide"/>'
    cart = f'<body name="cart" pos="2 2 1">{rail}<geom size=".1" mass="1"/></body>'
    env = Legs(
        integrator, more=cart, act='<motor joint="rail" gear="1e11" ctrlrange="-1 1" ctrllimited="true"/>'
    )
    plant = bound(env)
    for push in (1e-3, 1.0):
        env.reset()
        plant.observe()
        found = plant.contact_forecast(np.array([0.0, 0.0, push]))
        env.step(np.array([0.0, 0.0, push]))
        resets = bool(env.data.warning.number.any())
        assert resets == (push == 1.0) and found.finite == (not resets)


def test_the_weaker_of_two_directions_counts_and_so_do_declared_pairs():
    pair = '<contact><pair geom1="front" geom2="step" friction="0.9 0.3 .01 .001 .001"/></contact>'
    env = Legs(end=pair)
    plant = bound(env)
    env.reset()
    frictions = {}
    for _ in range(40):
        plant.observe()
        found = plant.contact_forecast(np.zeros(2))
        for body, friction in zip(found.body, found.friction, strict=True):
            frictions.setdefault(env.model.body(body).name, set()).add(friction)
        same(found, happened(env, np.zeros(2)))
    assert frictions["front"] - {0.6} == {0.3} and frictions["back"] == {0.6}


def names(model, found):
    return {model.body(int(b)).name for b in np.flatnonzero(found)}


def test_who_can_touch_the_world():
    whole = Legs().model
    assert names(whole, can_touch_the_world(whole)) == {"trunk", "front", "back", "load"}
    frictionless = Legs(condim=1).model
    assert not can_touch_the_world(frictionless).any()
    pairs = (("lift", "back", 3), ("front", "back", 3), ("trunk", "lift", 1))
    pair = "".join(f'<pair geom1="{one}" geom2="{two}" condim="{dim}"/>' for one, two, dim in pairs)
    only = Legs(condim=1, end=f"<contact>{pair}</contact>").model
    assert names(only, can_touch_the_world(only)) == {"back"}
    for env_id, some in (
        ("Ant-v5", True),
        ("Humanoid-v5", True),
        ("Reacher-v5", False),
        ("Swimmer-v5", False),
    ):
        assert can_touch_the_world(gym.make(env_id).unwrapped.model).any() == some
