"""ContactReader: against mj_contactForce, and which contacts are read."""

import gymnasium as gym
import mujoco
import numpy as np
import pytest
from dropped_ball import DroppedBall

from safe_wrappers.plants.mujoco.contacts import ContactReader, between


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
