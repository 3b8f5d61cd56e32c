"""Contacts: against mj_contactForce, and which ones are read."""

import gymnasium as gym
import mujoco
import numpy as np
import pytest
from dropped_ball import DroppedBall

from safe_wrappers.plants.mujoco.contacts import Contacts


def by_mujoco(model, data):
    """Every contact by MuJoCo's own function."""
    wrench, found = np.zeros(6), []
    for i in range(data.ncon):
        mujoco.mj_contactForce(model, data, i, wrench)
        bodies = sorted(model.geom_bodyid[data.contact[i].geom].tolist())
        found.append((tuple(bodies), data.contact[i].dist, wrench[0]))
    return found


def assert_same(model, data):
    read, expected = Contacts(model).read(data), by_mujoco(model, data)
    assert [c.bodies for c in read] == [e[0] for e in expected]
    np.testing.assert_array_equal([c.gap for c in read], [e[1] for e in expected])
    np.testing.assert_allclose([c.force for c in read], [e[2] for e in expected], rtol=1e-12, atol=1e-12)
    return len(read)


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
    pairs = lambda *names: {c.bodies for c in Contacts(model, *names).read(data)}  # noqa: E731
    world, ball, box, hand, puck = (model.body(n).id for n in ("world", "ball", "box", "hand", "puck"))
    data.qpos[model.jnt_qposadr[-1]] = -0.25
    mujoco.mj_forward(model, data)
    assert pairs() == {(world, ball), (world, box), (hand, puck)}
    assert pairs(["ball"]) == pairs(None, ["ball"]) == pairs(["world"], ["ball"]) == {(world, ball)}
    assert pairs(["puck", "box"]) == {(world, box), (hand, puck)}
    assert pairs(["puck", "box"], ["world"]) == {(world, box)}
    assert pairs(["ball"], ["box"]) == pairs(["ball"], ["ball"]) == set()
