"""Contacts: read as MuJoCo computes them, replayed as the env's step had them, and forecast as it will."""

import gymnasium as gym
import mujoco
import numpy as np
import pytest
from asking import bound
from dropped_ball import DroppedBall
from scenes import Scene
from scipy.spatial.transform import Rotation

from safe_wrappers.plants.mujoco.contacts import (
    ContactReader,
    Replay,
    between,
    can_touch_the_world,
    rotation_vector_rate,
)


def by_mujoco(model, data):
    """Every contact by MuJoCo's own function."""
    wrench, found = np.zeros(6), []
    for i in range(data.ncon):
        mujoco.mj_contactForce(model, data, i, wrench)
        bodies = sorted(model.geom_bodyid[data.contact[i].geom].tolist())
        found.append((tuple(bodies), data.contact[i].dist, wrench[0]))
    return found


def found(model, data, *names):
    reader = ContactReader(model, between(model, *names))
    reader.read(data)
    return reader.found()


def pairs(contacts):
    return [tuple(sorted(pair)) for pair in contacts.bodies.tolist()]


def assert_same(model, data):
    read, expected = found(model, data), by_mujoco(model, data)
    assert pairs(read) == [e[0] for e in expected]
    np.testing.assert_array_equal(read.gap, [e[1] for e in expected])
    normal_forces = np.einsum("ki,ki->k", read.force, read.normal)
    np.testing.assert_allclose(normal_forces, [e[2] for e in expected], rtol=1e-12, atol=1e-12)
    return len(expected)


@pytest.mark.parametrize("env_id", ["Humanoid-v5", "Pusher-v5", "HalfCheetah-v5"])
@pytest.mark.parametrize("cone", ["PYRAMIDAL", "ELLIPTIC"])
def test_forces_are_mujocos(env_id, cone):
    env = gym.make(env_id).unwrapped
    env.model.opt.cone = getattr(mujoco.mjtCone, f"mjCONE_{cone}")
    env.reset(seed=0)
    rng, seen = np.random.default_rng(0), 0
    for _ in range(80):
        env.step(rng.uniform(env.action_space.low, env.action_space.high))
        seen += assert_same(env.model, env.data)
    assert seen > 30


@pytest.mark.parametrize("cone", ["pyramidal", "elliptic"])
@pytest.mark.parametrize("condim", [1, 3, 4, 6])
def test_forces_are_mujocos_for_every_kind_of_contact(cone, condim):
    env = DroppedBall(cone=cone, height=0.101)
    env.model.geom_condim[:] = condim
    env.model.geom_friction[:, 1:] = 0.01
    env.reset()
    env.data.qvel[3:6] = 1.0, 2.0, 3.0
    assert sum(env.step(np.zeros(3)) is not None and assert_same(env.model, env.data) for _ in range(20)) > 20


def test_only_what_is_named_is_read():
    env = DroppedBall(height=0.0995)
    env.reset()
    model, data = env.model, env.data
    seen = lambda *names: set(pairs(found(model, data, *names)))  # noqa: E731
    world, ball, box, hand, puck = (model.body(n).id for n in ("world", "ball", "box", "hand", "puck"))
    data.qpos[model.jnt_qposadr[-1]], data.qpos[9] = -0.25, 0.1999  # the box presses on the floor
    mujoco.mj_forward(model, data)
    assert seen() == {(world, ball), (world, box), (hand, puck)}
    assert seen(["ball"]) == seen(None, ["ball"]) == seen(["world"], ["ball"]) == {(world, ball)}
    assert seen(["puck", "box"]) == {(world, box), (hand, puck)}
    assert seen(["puck", "box"], ["world"]) == {(world, box)}
    assert seen(["ball"], ["box"]) == seen(["ball"], ["ball"]) == set()


# Replays ------------------------------------------------------------------------------------------------------

INTEGRATORS = ("Euler", "implicit", "implicitfast", "RK4")
RAW = ("HalfCheetah-v5", "Pusher-v5", "Hopper-v5", "Ant-v5", "Humanoid-v5", "SafePointGoal2-v0")


def nothing(data, time_s):
    """Looks away."""


def stepped(env, replay, action):
    """One step, and whether its replay is the same."""
    replay.before()
    env.step(action)
    return replay.after(nothing)


def contacts(reader, data):
    reader.clear()
    reader.read(data)
    return reader.found()


def states(env, data):
    size = mujoco.mj_stateSize(env.model, int(mujoco.mjtState.mjSTATE_INTEGRATION))
    state = np.zeros(size)
    mujoco.mj_getState(env.model, data, state, int(mujoco.mjtState.mjSTATE_INTEGRATION))
    return state


@pytest.mark.parametrize("env_id", RAW)
def test_a_replay_ends_where_the_env_does_and_leaves_it_alone(env_id):
    env = gym.make(env_id).unwrapped
    replay = Replay(env)
    env.reset(seed=0)
    rng = np.random.default_rng(0)
    for _ in range(60):
        replay.before()
        env.step(rng.uniform(env.action_space.low, env.action_space.high))
        before = states(env, env.data).tobytes()
        assert replay.after(nothing)
        assert states(env, env.data).tobytes() == before


def test_bodies_that_sleep_sleep_in_the_replay_and_wake_with_the_env():
    env = gym.make("SafePointGoal2-v0").unwrapped
    replay = Replay(env)
    vases = ContactReader(env.model, between(env.model, [f"vase{i}" for i in range(10)]))
    for seed in range(3):
        env.reset(seed=seed)
        counts = []
        for _ in range(30):
            seen = []
            replay.before()
            env.step(np.zeros(2))
            assert replay.after(lambda data, _, seen=seen: seen.append(len(contacts(vases, data).gap)))
            counts.append(set(seen))
        # Four corners each, and no contacts any more where MuJoCo has put them to sleep.
        assert counts[:5] == [{40}] * 5
        assert counts[-5:] == ([{0}] * 5 if hasattr(mujoco.mjtEnableBit, "mjENBL_SLEEP") else [{40}] * 5)


@pytest.mark.parametrize("integrator", INTEGRATORS)
@pytest.mark.parametrize("meddle", ["nothing", "pushes", "moves the hand"])
def test_every_integrator_with_activations_applied_forces_and_mocap_bodies(integrator, meddle):
    env = DroppedBall(meddle, integrator)
    replay = Replay(env)
    env.reset()
    rng = np.random.default_rng(1)
    followed = integrator != "RK4"  # whose activations are not
    for _ in range(60):
        assert stepped(env, replay, rng.uniform(-1.0, 1.0, 3)) is followed
    # The limited activation has been at its limit, and the puck has been lifted where the hand moves.
    assert np.abs(env.data.act[0]) <= 0.3 and env.data.act.any()


def test_the_rate_of_a_rotation_vector_turns_by_the_angular_velocity():
    rng, short = np.random.default_rng(0), 1e-6
    for length in (0.0, 1e-9, 1e-3, 0.5, 3.0):
        turned, velocity = rng.normal(size=(2, 5, 3))
        turned *= length / np.linalg.norm(turned, axis=1, keepdims=True)
        rate = rotation_vector_rate(turned, velocity)
        after = Rotation.from_rotvec(turned + short * rate)
        difference = (Rotation.from_rotvec(turned) * Rotation.from_rotvec(short * velocity)).inv() * after
        assert difference.magnitude().max() < 20.0 * short**2


@pytest.mark.parametrize("integrator", ["Euler", "RK4"])
def test_what_changes_between_substeps_is_noticed(integrator):
    env = DroppedBall("pushes in substeps", integrator)
    replay = Replay(env)
    env.reset()
    assert not stepped(env, replay, np.zeros(3))


@pytest.mark.parametrize(
    ("integrator", "nudge", "same"),
    [("Euler", 0.0, True), ("Euler", 1e-13, False), ("RK4", 1e-13, True), ("RK4", 1e-8, False)],
)
def test_same_is_bit_for_bit_and_up_to_rounding_for_runge_kutta(integrator, nudge, same):
    env = DroppedBall("nudges", integrator)
    env.nudge = nudge
    replay = Replay(env)
    env.reset()
    assert stepped(env, replay, np.zeros(3)) is same


@pytest.mark.parametrize("integrator", INTEGRATORS)
def test_forces_times_their_times_are_the_momentum_gained(integrator):
    # Ball and box fall, land and bounce; along z the floor's normal force and the weight are all there is.
    env = DroppedBall(integrator=integrator, height=0.13)
    replay = Replay(env)
    floor = ContactReader(env.model, between(env.model, ["ball", "box"], ["world"]))
    env.reset()
    held = 0.0
    for _ in range(100):
        seen = []
        mass = {name: float(env.model.body(name).mass[0]) for name in ("ball", "box")}
        before = mass["ball"] * env.data.qvel[2] + mass["box"] * env.data.qvel[8]
        replay.before()
        env.step(np.zeros(3))
        assert replay.after(
            lambda data, time_s, seen=seen: seen.append((time_s, contacts(floor, data).force[:, 2].sum()))
        )
        gained = mass["ball"] * env.data.qvel[2] + mass["box"] * env.data.qvel[8] - before
        assert sum(t for t, _ in seen) == pytest.approx(0.01)
        impulse = sum(t * f for t, f in seen)
        assert impulse == pytest.approx(gained + (mass["ball"] + mass["box"]) * 9.81 * 0.01, abs=1e-9)
        held += impulse
    assert held > 10.0


# Forecasts ----------------------------------------------------------------------------------------------------

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
