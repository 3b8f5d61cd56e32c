"""Contacts: read as MuJoCo computes them, replayed as the env's step had them, and forecast as it will."""

import gymnasium as gym
import mujoco
import numpy as np
import pytest
from asking import bound
from scenes import Legs, Scene
from scipy.spatial.transform import Rotation

from safe_wrappers.plants.mujoco.contacts import (
    ContactReader,
    Replay,
    between,
    can_touch_the_world,
    rotation_vector_rate,
)

INTEGRATORS = ("Euler", "implicit", "implicitfast", "RK4")


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


def moving(model, geom):
    body = int(model.geom_bodyid[geom])
    while body and not model.body_dofnum[body]:
        body = model.body_parentid[body]
    return body > 0


def solved(model, data):
    """Of every contact the other body, the pushed one, which moves, the gap, the point, the normal and the force."""
    found = []
    for contact in data.contact:
        if contact.efc_address >= 0:
            bodies = model.geom_bodyid[contact.geom]
            side = 1.0 if moving(model, contact.geom[1]) else -1.0
            force = side * decoded(model, data, contact)
            found.append(
                [*bodies[:: int(side)], contact.dist, *contact.pos, *side * contact.frame[:3], *force]
            )
    return np.array(found).reshape(-1, 12)


def table(contacts):
    return np.column_stack([contacts.bodies, contacts.gap, contacts.point, contacts.normal, contacts.force])


def same(found, expected, rounding):
    scale = rounding * (1.0 + np.abs(expected).max(initial=0.0))
    np.testing.assert_allclose(found, expected, rtol=rounding, atol=scale)


def read(model, data, *names):
    reader = ContactReader(model, between(model, *names))
    reader.read(data)
    return reader.found()


def happened(env, action):
    """Step the env; the contacts of moving bodies with the world at every evaluation of the physics in it."""
    raw, replay, seen = env.unwrapped, Replay(env.unwrapped), []

    def look(data, _):
        every = solved(raw.model, data)
        same(table(read(raw.model, data)), every, 1e-12)
        fixed = [not moving(raw.model, raw.model.body_geomadr[int(b)]) for b in every[:, 0]]
        seen.append(every[np.array(fixed, dtype=bool)])

    replay.before()
    env.step(action)
    assert replay.after(look)
    return seen


def forecast(env, plant, action, rounding=1e-9):
    """The contacts that are forecast of a step, which the env then makes with the same."""
    plant.observe()
    plant.rollout(-action, 2)  # another question before does not disturb it
    found = plant.contact_forecast(action)
    seen = happened(env, action)
    assert found.finite and found.steps == len(seen)
    np.testing.assert_array_equal(found.step, np.repeat(np.arange(len(seen)), [len(at) for at in seen]))
    same(table(found), np.concatenate(seen), rounding)
    return found


# Forecasts, and what is read of MuJoCo ----------------------------------------------------------------------------


ROBOTS = ("Ant-v5", "HalfCheetah-v5", "Hopper-v5", "Walker2d-v5", "Humanoid-v5")
KINDS = (
    *(("Euler", "pyramidal", 3), ("Euler", "elliptic", 4), ("RK4", "pyramidal", 4), ("RK4", "elliptic", 3)),
    *(("implicitfast", "pyramidal", 6), ("implicitfast", "elliptic", 1)),
)


@pytest.mark.parametrize("world", [*ROBOTS, *KINDS], ids=str)
def test_the_contacts_that_are_forecast_are_those_of_the_envs_own_step(world):
    env = gym.make(world) if world in ROBOTS else Legs(*world)
    plant, raw, rng, bodies = bound(env), env.unwrapped, np.random.default_rng(0), set()
    env.reset(seed=0)
    for k in range(20):
        if world in KINDS:  # on a floor, a step and a lift
            raw.data.mocap_pos[0, 2] = 0.05 + 0.02 * np.sin(k)
        action = rng.uniform(env.action_space.low, env.action_space.high) * (0.2 if k % 2 else 1.0)
        found = forecast(env, plant, action, 1e-7 if world in ROBOTS else 1e-9)
        assert found.steps == raw.frame_skip * (4 if raw.model.opt.integrator == 1 else 1)
        assert (np.einsum("ki,ki->k", found.force, found.normal) >= 0.0).all()
        bodies |= {raw.model.body(b).name for b in found.body}
        if world in KINDS:
            np.testing.assert_array_equal(found.friction, 0.0 if world[2] == 1 else 0.6)
    assert len(bodies) > (world in KINDS) and not bodies & {"step", "lift", "world"}


def test_what_moves_is_no_ground_either_geom_may_come_first_and_the_weaker_friction_counts():
    # The load lies on the trunk; the floor's geom comes before the legs' and the ledge's after them.
    ledge = '<body pos="0 0 .3"><geom name="ledge" type="box" size=".2 .2 .07"/></body>'
    pair = '<contact><pair geom1="front" geom2="step" friction="0.9 0.3 .01 .001 .001"/></contact>'
    normals, frictions, loaded = set(), {}, 0
    for env in (Legs(more=ledge), Legs(end=pair)):
        plant = bound(env)
        env.reset()
        for _ in range(40):
            found = forecast(env, plant, np.zeros(2))
            loaded += sum(env.model.geom(int(g)).name == "load" for c in env.data.contact for g in c.geom)
            names = [env.model.body(b).name for b in found.body]
            normals |= set(zip(names, found.normal[:, 2].round(6).tolist(), strict=True))
            for name, friction in zip(names, found.friction.tolist(), strict=True):
                frictions.setdefault(name, set()).add(friction)
    assert loaded and ("trunk", 1.0) in normals and ("load", 1.0) not in normals
    assert frictions["front"] - {0.6} == {0.3} and frictions["back"] == {0.6}


@pytest.mark.parametrize("integrator", ["Euler", "RK4"])
def test_numbers_that_mujoco_resets_are_no_forecast(integrator):
    rail = '<joint name="rail" axis="1 0 0" type="slide"/>'
    cart = f'<body name="cart" pos="2 2 1">{rail}<geom size=".1" mass="1"/></body>'
    motor = '<motor joint="rail" gear="1e11" ctrlrange="-1 1" ctrllimited="true"/>'
    env = Legs(integrator, more=cart, act=motor)
    plant, still = bound(env), np.zeros(3)
    env.reset()
    for _ in range(20):
        env.step(still)
    for where, index in (("qvel", 6), ("qvel", 2), ("qpos", 7)):
        at = getattr(env.data, where)
        kept = at[index]
        for value in (kept, 1e11, 1e30, 1e200):
            at[index] = value
            plant.observe()
            assert plant.contact_forecast(still).finite == (value == kept)
        at[index] = kept
    for push in (1e-3, 1.0):  # an acceleration, where no speed is out of bounds
        env.reset()
        plant.observe()
        action = np.array([0.0, 0.0, push])
        found = plant.contact_forecast(action)
        env.step(action)
        assert found.finite == (not env.data.warning.number.any()) == (push < 1.0)


def test_who_can_touch_the_world():
    def names(model):
        return {model.body(int(b)).name for b in np.flatnonzero(can_touch_the_world(model))}

    pairs = (("lift", "back", 3), ("front", "back", 3), ("trunk", "lift", 1))
    pair = "".join(f'<pair geom1="{one}" geom2="{two}" condim="{dim}"/>' for one, two, dim in pairs)
    assert names(Legs().model) == {"trunk", "front", "back", "load"}
    assert names(Legs(condim=1).model) == set()
    assert names(Legs(condim=1, end=f"<contact>{pair}</contact>").model) == {"back"}
    for env_id, some in (("Humanoid-v5", True), ("Reacher-v5", False), ("Swimmer-v5", False)):
        assert can_touch_the_world(gym.make(env_id).unwrapped.model).any() == some


# Replays ----------------------------------------------------------------------------------------------------------


class Falling(Scene):
    """A ball and a box over a floor beside a driven cart; `meddle` is what the env does beside its action."""

    XML = """<mujoco>
    <option timestep="0.002" integrator="{integrator}"/><default><geom solref="-5e3 0"/></default>
    <worldbody>
      <geom name="floor" type="plane" size="5 5 .1"/>
      <body name="ball" pos="0 0 {height}"><freejoint/><geom name="ball" size=".1" mass="2"/></body>
      <body name="box" pos="1 0 .2"><freejoint/><geom type="box" size=".2 .2 .2" mass="3"/></body>
      <body name="cart" pos="2 0 1"><joint name="slide" type="slide" axis="1 0 0"/><geom size=".05"/></body>
    </worldbody>
    <actuator>
      <motor joint="slide" gear="3"/>
      <general joint="slide" dyntype="integrator" actlimited="true" actrange="-.3 .3" gainprm="5"/>
      <general joint="slide" dyntype="filter" dynprm=".05" gainprm="2"/>
    </actuator></mujoco>"""

    def __init__(self, integrator="Euler", meddle="nothing", height=0.5):
        super().__init__(self.XML.format(integrator=integrator, height=height))
        self.meddle = meddle
        self.reset()

    def step(self, action):
        if self.meddle == "pushes":
            self.data.xfrc_applied[1, :3] = [4.0 * action[0], 0.0, -3.0]
        if self.meddle == "pushes in substeps":
            self.data.xfrc_applied[1, 2] += 2.0
            super().step(action)
            self.data.xfrc_applied[1, 2] += 2.0
        super().step(action)
        if isinstance(self.meddle, float):
            self.data.qvel[6] += self.meddle


def test_only_what_is_named_is_read():
    env = Legs()
    env.reset()
    for _ in range(60):
        env.step(np.zeros(2))

    def seen(*names):
        pairs = read(env.model, env.data, *names).bodies.tolist()
        return {tuple(sorted(env.model.body(body).name for body in pair)) for pair in pairs}

    front, back, load = ("front", "step"), ("back", "lift"), ("load", "trunk")
    assert seen() == {front, back, load}
    assert seen(["front"]) == seen(None, ["front"]) == seen(["step"], ["front"]) == {front}
    assert seen(["front", "load"]) == {front, load} and seen(["front", "load"], ["trunk"]) == {load}
    assert seen(["front"], ["back"]) == seen(["front"], ["front"]) == set()


def nothing(data, time_s):
    """Looks away."""


def state(env):
    kind = int(mujoco.mjtState.mjSTATE_INTEGRATION)
    found = np.zeros(mujoco.mj_stateSize(env.model, kind))
    mujoco.mj_getState(env.model, env.data, found, kind)
    return found.tobytes()


class Lifting(Legs):
    """Its step moves a body by hand, which no force tells."""

    def step(self, action):
        self.data.mocap_pos[0, 2] += 0.001
        return super().step(action)


def test_what_the_env_moves_by_hand_in_its_step_is_replayed():
    env = Lifting()
    env.reset()
    for _ in range(40):
        happened(env, np.zeros(2))  # asserts it


REPLAYED = {
    # Of Runge-Kutta steps activations are not followed.
    **{(one, how): one != "RK4" for one in INTEGRATORS for how in ("nothing", "pushes")},
    **{("Euler", "pushes in substeps"): False, ("Euler", 1e-13): False},
}


@pytest.mark.parametrize(("world", "followed"), REPLAYED.items(), ids=map(str, REPLAYED))
def test_a_replay_says_whether_it_ends_where_the_env_does_and_leaves_it_alone(world, followed):
    env = Falling(*world)
    replay, rng = Replay(env), np.random.default_rng(1)
    for _ in range(40):
        replay.before()
        env.step(rng.uniform(-1.0, 1.0, 3))
        before = state(env)
        assert replay.after(nothing) is followed
        assert state(env) == before
    assert (
        np.abs(env.data.act[0]) <= 0.3 and env.data.act.any()
    )  # the limited activation has been at its limit


@pytest.mark.parametrize(("meddle", "same"), [(1e-13, True), (1e-8, False), ("pushes in substeps", False)])
def test_of_runge_kutta_steps_rounding_is_no_difference(meddle, same):
    env = Falling("RK4", meddle)
    replay = Replay(env)
    replay.before()
    env.step(np.zeros(3))
    assert replay.after(nothing) is same


def test_bodies_that_sleep_sleep_in_the_replay_and_wake_with_the_env():
    env = gym.make("SafePointGoal2-v0").unwrapped
    replay, vases = Replay(env), [f"vase{i}" for i in range(10)]
    for seed in range(2):  # a reset wakes them
        env.reset(seed=seed)
        counts = []
        for _ in range(30):
            seen = set()
            replay.before()
            env.step(np.zeros(2))
            assert replay.after(lambda data, _, seen=seen: seen.add(len(read(env.model, data, vases).gap)))
            counts.append(seen)
        # Four corners each, and no contacts any more where MuJoCo has put them to sleep.
        assert counts[:5] == [{40}] * 5
        assert counts[-5:] == ([{0}] * 5 if hasattr(mujoco.mjtEnableBit, "mjENBL_SLEEP") else [{40}] * 5)


@pytest.mark.parametrize("integrator", INTEGRATORS)
def test_forces_times_their_times_are_the_momentum_gained(integrator):
    # Ball and box fall, land and bounce; along z the floor's normal force and the weight are all there is.
    env = Falling(integrator, height=0.13)
    replay, masses, speeds, held = Replay(env), np.array([2.0, 3.0]), env.data.qvel[[2, 8]], 0.0
    for _ in range(60):
        seen = []
        replay.before()
        env.step(np.zeros(3))
        assert replay.after(
            lambda data, time_s, seen=seen: seen.append(
                (time_s, read(env.model, data, ["ball", "box"], ["world"]).force[:, 2].sum())
            )
        )
        before, speeds = speeds, env.data.qvel[[2, 8]]
        times, forces = np.array(seen).T
        assert times.sum() == pytest.approx(0.01)
        assert times @ forces == pytest.approx(masses @ (speeds - before) + 5.0 * 9.81 * 0.01, abs=1e-9)
        held += times @ forces
    assert held > 10.0


def test_the_rate_of_a_rotation_vector_turns_by_the_angular_velocity():
    rng, short = np.random.default_rng(0), 1e-6
    for length in (0.0, 1e-9, 1e-3, 0.5, 3.0):
        turned, velocity = rng.normal(size=(2, 5, 3))
        turned *= length / np.linalg.norm(turned, axis=1, keepdims=True)
        after = Rotation.from_rotvec(turned + short * rotation_vector_rate(turned, velocity))
        difference = (Rotation.from_rotvec(turned) * Rotation.from_rotvec(short * velocity)).inv() * after
        assert difference.magnitude().max() < 20.0 * short**2
