"""Floating-base terms against MuJoCo: its forces, its subtree momentum, its motion over small steps."""

import gymnasium as gym
import mujoco
import numpy as np
import pytest
from asking import bound
from oracles import in_cone

from safe_wrappers.control.legged import centroidal_momentum
from safe_wrappers.control.whole_body import WholeBodyProblem, solve_cone, solve_pyramid
from safe_wrappers.plants.mujoco.dynamics import MomentumReader, equations_of_motion

ZOO = """
<mujoco>
  <option timestep="0.001" cone="{cone}" integrator="Euler"/>
  <worldbody>
    <geom type="plane" size="5 5 1" condim="{condim}"/>
    <body pos="0 0 0.3"><freejoint/>
      <geom type="box" size="0.2 0.1 0.05" mass="2" condim="{condim}"/>
      <body pos="0.2 0 0"><joint name="hip" axis="0 1 0" damping="0.3" stiffness="2" armature="0.05"
          limited="true" range="-20 20" frictionloss="0.1"/>
        <geom type="capsule" fromto="0 0 0 0.2 0 -0.2" size="0.03" mass="0.4" condim="{condim}"/>
        <body pos="0.2 0 -0.2"><joint name="knee" axis="0 1 0" damping="0.1"/>
          <geom type="capsule" fromto="0 0 0 0 0.1 -0.1" size="0.03" mass="0.2" condim="{condim}"/></body>
      </body>
    </body>
    <body pos="0.6 0 0.1"><freejoint/><geom type="sphere" size="0.1" mass="0.5" condim="{condim}"/></body>
  </worldbody>
  <equality><joint joint1="knee" joint2="hip" polycoef="0 0.5 0 0 0" active="false"/></equality>
  <actuator><motor joint="hip" gear="3" ctrllimited="true" ctrlrange="-1 1"/><position joint="knee" kp="5" kv="0.4"/>
  </actuator>
</mujoco>
"""


def zoo(cone="pyramidal", condim=3, seed=0, settle=0.35):
    model = mujoco.MjModel.from_xml_string(ZOO.format(cone=cone, condim=condim))
    data = mujoco.MjData(model)
    rng = np.random.default_rng(seed)
    data.qvel[:] = rng.normal(size=model.nv) * 0.5
    while data.time < settle:
        data.ctrl[:] = rng.uniform(-1, 1, 2)
        mujoco.mj_step(model, data)
    return model, data


@pytest.fixture(params=["Ant-v5", "Humanoid-v5"])
def walker(request):
    """An env that falls and struggles, and the plant that observes it."""
    env = gym.make(request.param)
    plant = bound(env)
    env.reset(seed=3)
    env.action_space.seed(3)

    def states(count):
        for step in range(count):
            env.step(env.action_space.sample() * (0.2 if step % 3 else 1.0))
            plant.observe()
            yield plant

    return states


def pushed(terms):
    return np.einsum("kiv,ki->v", terms.jacobians, terms.contacts.force)


def test_the_equations_of_motion_hold_with_mujocos_own_accelerations_and_forces(walker):
    touched = 0
    for plant in walker(60):
        terms, data = equations_of_motion(plant.model, plant.forward(), plant.actuators), plant.data
        left = terms.inertia @ data.qacc + terms.bias
        right = terms.actuation @ data.ctrl + pushed(terms)
        assert left == pytest.approx(right, abs=1e-9 * (1.0 + np.abs(right).max()))
        touched += len(terms.contacts.point)
    assert touched > 20


@pytest.mark.parametrize("cone", ["pyramidal", "elliptic"])
@pytest.mark.parametrize("condim", [1, 3])
def test_they_hold_for_servos_limits_equalities_dry_friction_and_pushes_from_outside(cone, condim):
    model, data = zoo(cone, condim)
    data.eq_active[:] = 1
    data.ctrl[:] = [5.0, 0.3]  # the first is beyond its range
    data.qfrc_applied[7] = 0.5
    data.xfrc_applied[2] = [1.0, 2.0, -3.0, 0.1, 0.2, 0.3]
    mujoco.mj_forward(model, data)
    kinds = set(data.efc_type.tolist())
    assert len(kinds) > 2  # contact, dry friction, equality or limit
    terms = equations_of_motion(model, data)
    right = terms.actuation @ [1.0, 0.3] + pushed(terms)
    assert terms.inertia @ data.qacc + terms.bias == pytest.approx(right, abs=1e-8)
    assert terms.contacts.force.any()
    if condim == 1:
        assert not terms.contacts.friction.any()


def momentum(model, data):
    """Centroidal, from the bodies' Jacobians."""
    ids = [body for body in range(1, model.nbody) if model.body_mass[body] > 0.0]
    linear, angular = np.zeros((2, len(ids), 3, model.nv))
    for row, body in enumerate(ids):
        mujoco.mj_jacBodyCom(model, data, linear[row], angular[row], body)
    axes = data.ximat[ids].reshape(-1, 3, 3)
    inertias = np.einsum("nij,nj,nkj->nik", axes, model.body_inertia[ids], axes)
    spins = np.einsum("nij,nj->ni", inertias, angular @ data.qvel)
    return centroidal_momentum(model.body_mass[ids], data.xipos[ids], linear @ data.qvel, spins)


def test_momentum_is_mujocos_subtree_momentum(walker):
    for plant in walker(20):
        model, data = plant.model, plant.forward()
        found = momentum(model, data)
        read = MomentumReader(model, np.ones(model.nbody, dtype=bool)).read(data)
        for mine, other in zip(read, found, strict=True):
            np.testing.assert_allclose(mine, other, rtol=1e-9, atol=1e-9)
        mujoco.mj_subtreeVel(model, data)
        assert found.com == pytest.approx(data.subtree_com[0])
        assert found.linear == pytest.approx(found.mass * data.subtree_linvel[0])
        assert found.mass == pytest.approx(model.body_subtreemass[0])
        assert found.angular == pytest.approx(data.subtree_angmom[0], abs=1e-9)


def test_over_small_steps_the_momentum_changes_as_the_wrenches_say():
    model, data = zoo(settle=0.12)
    model.opt.timestep = 1e-5
    compared = 0
    for _ in range(300):
        mujoco.mj_forward(model, data)
        before, contacts = momentum(model, data), equations_of_motion(model, data).contacts
        world = contacts.bodies[:, 0] == 0  # what the robot does to itself changes nothing
        arms, forces = contacts.point[world] - before.com, contacts.force[world]
        linear = forces.sum(axis=0) + before.mass * model.opt.gravity
        expected = np.concatenate([linear, np.cross(arms, forces).sum(axis=0)])
        mujoco.mj_step(model, data)
        mujoco.mj_forward(model, data)
        after = momentum(model, data)
        change = np.concatenate([after.linear - before.linear, after.angular - before.angular])
        change /= model.opt.timestep
        assert change == pytest.approx(expected, abs=2e-2 + 1e-3 * np.abs(expected).max())
        compared += bool(world.any())
    assert compared > 50


def test_every_answer_on_a_struggling_robot_is_inside_its_cones_whatever_its_status(walker):
    seen = set()
    for plant in walker(120):
        terms = equations_of_motion(plant.model, plant.forward(), plant.actuators)
        c = terms.contacts
        if not len(c.point):
            continue
        problem = WholeBodyProblem(
            terms.inertia, terms.bias, terms.actuation, terms.jacobians, terms.drift, c.normal, 0.7 * c.friction,
            plant.lower, plant.upper, plant.upper * np.sin(np.arange(len(plant.upper)) + plant.time),
            contact_acceleration=-(terms.jacobians @ plant.qvel) / 0.05,
        )  # fmt: skip
        for found in (solve_pyramid(problem, 8), solve_cone(problem)):
            seen.add(str(found.status))
            size = 1.0 + np.abs(found.forces).max()
            assert found.status != "failed"
            assert in_cone(found.forces, c.normal, 0.7 * c.friction, 2e-6 * size).all()
            assert ((found.control >= plant.lower) & (found.control <= plant.upper)).all()
            pushed = np.einsum("kiv,ki->v", terms.jacobians, found.forces)
            missed = (
                terms.inertia @ found.acceleration + terms.bias - terms.actuation @ found.control - pushed
            )
            assert np.abs(missed).max() < 1e-9 * (1.0 + np.abs(found.acceleration).max() * size)
    assert {"projected", "infeasible"} <= seen
