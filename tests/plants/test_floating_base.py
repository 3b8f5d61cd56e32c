"""Floating-base terms against MuJoCo: its forces, its subtree momentum, its motion over small steps."""

import math

import gymnasium as gym
import mujoco
import numpy as np
import pytest
from asking import bound
from oracles import in_cone, support_margin, zero_moment_point

from safe_wrappers.control.contact.friction_cone import friction_pyramid
from safe_wrappers.control.legged.centroidal import centroidal_momentum
from safe_wrappers.control.legged.support import common_plane
from safe_wrappers.control.legged.whole_body import rigid_forces, solve_cone, solve_pyramid
from safe_wrappers.control.legged.whole_body_problem import WholeBodyProblem
from safe_wrappers.errors import UnsupportedEnvError
from safe_wrappers.plants.queries.floating_base import MomentumReader, contact_points, equations_of_motion

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
    contacts = terms.contacts
    return np.einsum("kiv,ki->v", contacts.jacobians, contacts.forces)


def test_the_equations_of_motion_hold_with_mujocos_own_accelerations_and_forces(walker):
    touched = 0
    for plant in walker(60):
        terms, data = equations_of_motion(plant.model, plant.forward(), plant.actuators), plant.data
        left = terms.inertia @ data.qacc + terms.bias
        right = terms.actuation @ data.ctrl + pushed(terms)
        assert left == pytest.approx(right, abs=1e-9 * (1.0 + np.abs(right).max()))
        touched += len(terms.contacts.points)
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
    assert terms.contacts.forces.any()
    if condim == 1:
        assert not terms.contacts.friction.any()


def test_the_bias_does_not_hang_on_the_control():
    model, data = zoo()
    one = equations_of_motion(model, data)
    mujoco.mj_forward(model, data)
    one = equations_of_motion(model, data)
    no_dry_friction = data.efc_type >= int(mujoco.mjtConstraint.mjCNSTR_CONTACT_FRICTIONLESS)
    own = np.zeros(model.nv)
    mujoco.mj_mulJacTVec(model, data, own, np.where(no_dry_friction, 0.0, data.efc_force))
    data.ctrl[:] = [0.7, -0.4]
    mujoco.mj_forward(model, data)
    other = equations_of_motion(model, data)
    own_other = np.zeros(model.nv)
    mujoco.mj_mulJacTVec(model, data, own_other, np.where(no_dry_friction, 0.0, data.efc_force))
    # Only what other constraints give may differ.
    assert one.bias + own == pytest.approx(other.bias + own_other, abs=1e-10)
    assert one.actuation == pytest.approx(other.actuation)
    assert one.actuation[6] == pytest.approx([3.0, 0.0])
    assert one.actuation[7] == pytest.approx([0.0, 5.0])


def test_torsional_and_rolling_friction_are_in_the_moments():
    model, data = zoo("elliptic", 6)
    mujoco.mj_forward(model, data)
    contacts = contact_points(model, data)
    assert np.abs(contacts.moments).max() > 1e-6
    turning = np.zeros((len(contacts.points), 3, model.nv))
    for row, (body, other) in enumerate(zip(contacts.pushed, contacts.pushed_by, strict=True)):
        for which, sign in ((body, 1.0), (other, -1.0)):
            jac = np.zeros((3, model.nv))
            mujoco.mj_jac(model, data, None, jac, contacts.points[row], which)
            turning[row] += sign * jac
    terms = equations_of_motion(model, data)
    right = terms.actuation @ data.ctrl + pushed(terms) + np.einsum("kiv,ki->v", turning, contacts.moments)
    assert terms.inertia @ data.qacc + terms.bias == pytest.approx(right, abs=1e-8)


def test_the_world_is_never_the_pushed_one_and_pairs_push_each_other():
    model, data = zoo(settle=0.0)
    data.qpos[[9, 10, 11]] = [0.0, 0.0, 1.14]  # the ball on the box, both in the air
    data.qpos[2] = 1.0
    mujoco.mj_forward(model, data)
    contacts = contact_points(model, data)
    assert len(contacts.points) == 1
    assert {int(contacts.pushed[0]), int(contacts.pushed_by[0])} == {1, 4}
    upwards = 1.0 if contacts.pushed[0] == 4 else -1.0
    assert contacts.normals[0] == pytest.approx([0.0, 0.0, upwards])
    assert contacts.gaps[0] == pytest.approx(-0.01)
    # What pushes one way on the one pushes the other way on the other: no change of the sum.
    of_the_centre = np.zeros((3, model.nv))
    mujoco.mj_jacSubtreeCom(model, data, of_the_centre, 0)
    force = np.linalg.solve(
        equations_of_motion(model, data).inertia, pushed(equations_of_motion(model, data))
    )
    assert np.abs(force).max() > 1.0
    assert of_the_centre @ force == pytest.approx(np.zeros(3), abs=1e-9)
    # A geom of the world that comes second in MuJoCo's order is still the world.
    slab = mujoco.MjModel.from_xml_string(
        "<mujoco><worldbody><body pos='0 0 0.099'><freejoint/><geom type='sphere' size='0.1'/></body>"
        "<geom type='box' size='1 1 0.1' pos='0 0 -0.1'/></worldbody></mujoco>"
    )
    resting = mujoco.MjData(slab)
    mujoco.mj_forward(slab, resting)
    assert slab.geom_bodyid[resting.contact.geom[0]].tolist() == [1, 0]  # MuJoCo's normal points down here
    found = contact_points(slab, resting)
    assert found.pushed.tolist() == [1] and found.pushed_by.tolist() == [0]
    assert found.normals[0] == pytest.approx([0, 0, 1])
    assert found.forces[0, 2] > 0.0


def test_forces_are_what_mujocos_own_friction_allows(walker):
    seen = 0
    for plant in walker(40):
        contacts = equations_of_motion(plant.model, plant.forward(), plant.actuators).contacts
        assert in_cone(contacts.forces, contacts.normals, contacts.friction, 1e-6).all()
        # Its pyramid, edge on its first tangent.
        sides = friction_pyramid(contacts.normals, contacts.friction, 4, contacts.first_tangents)
        assert (np.einsum("kei,ki->ke", sides, contacts.forces) <= 1e-6).all()
        pressed = np.einsum("ki,ki->k", contacts.normals, contacts.forces)
        sideways = np.linalg.norm(contacts.forces - pressed[:, None] * contacts.normals, axis=1)
        seen += int((sideways > 0.1 * contacts.friction * pressed).sum())
    assert seen > 5


def relative_velocity(model, start, data, contacts, row):
    """Of the two material points that touch at the start, wherever their bodies are now."""
    total = np.zeros(3)
    for body, sign in ((contacts.pushed[row], 1.0), (contacts.pushed_by[row], -1.0)):
        local = start.xmat[body].reshape(3, 3).T @ (contacts.points[row] - start.xpos[body])
        point = data.xpos[body] + data.xmat[body].reshape(3, 3) @ local
        jac = np.zeros((3, model.nv))
        mujoco.mj_jac(model, data, jac, None, point, body)
        total += sign * (jac @ start.qvel)
    return total


def test_a_drift_is_of_both_bodies_that_touch():
    model, data = zoo(settle=0.0)
    data.qpos[[2, 9, 10, 11]] = [1.0, 0.0, 0.0, 1.14]  # the ball on the box, both in the air
    data.qvel[:] = np.random.default_rng(4).normal(size=model.nv) * 3.0
    mujoco.mj_forward(model, data)
    contacts = contact_points(model, data)
    assert len(contacts.points) == 1 and contacts.pushed_by[0] > 0
    moved = mujoco.MjData(model)
    moved.qpos[:], dt = data.qpos, 1e-6
    mujoco.mj_integratePos(model, moved.qpos, data.qvel, dt)
    mujoco.mj_forward(model, moved)
    before, later = (relative_velocity(model, data, d, contacts, 0) for d in (data, moved))
    assert (later - before) / dt == pytest.approx(contacts.drift[0], abs=1e-3)
    assert np.abs(contacts.drift).max() > 0.5


def test_what_is_near_but_gives_no_force_is_no_contact():
    near = 0
    for margin in (0.0, 0.05):  # MuJoCo has changed from which distance on the gap counts
        model = mujoco.MjModel.from_xml_string(
            f"""<mujoco><worldbody><geom type="plane" size="1 1 1"/><body pos="0 0 0.11"><freejoint/>
            <geom type="sphere" size="0.1" margin="{margin}" gap="0.05"/></body></worldbody></mujoco>"""
        )
        data = mujoco.MjData(model)
        mujoco.mj_forward(model, data)
        if data.nefc == 0 and data.ncon:
            near += 1
            assert contact_points(model, data).points.shape == (0, 3)
    assert near


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
        before, contacts = momentum(model, data), contact_points(model, data)
        world = contacts.pushed_by == 0  # what the robot does to itself changes nothing
        arms, forces = contacts.points[world] - before.com, contacts.forces[world]
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


def stance(slope=0.0, friction=1.0):
    """A settled 2 kg box on a plane that is tilted about y."""
    model = mujoco.MjModel.from_xml_string(
        f"""<mujoco><option timestep="0.002" gravity="{-9.81 * math.sin(slope)} 0 {-9.81 * math.cos(slope)}"/>
        <worldbody><geom type="plane" size="5 5 1" friction="{friction} 0 0"/>
        <body pos="0 0 0.0999"><freejoint/><geom type="box" size="0.2 0.15 0.1" mass="2" friction="{friction} 0 0"/>
        </body></worldbody></mujoco>"""
    )
    data = mujoco.MjData(model)
    for _ in range(1000):
        mujoco.mj_step(model, data)
    mujoco.mj_forward(model, data)
    return model, data


@pytest.mark.parametrize("slope", [0.0, 0.1, 0.25])
def test_a_box_on_a_slope_is_held_by_the_weight_it_has(slope):
    _, data = model_and_data = stance(slope)
    contacts = contact_points(*model_and_data)
    total = contacts.forces.sum(axis=0)
    assert total == pytest.approx([19.62 * math.sin(slope), 0, 19.62 * math.cos(slope)], abs=1e-3)
    # Its weight's line meets the plane downhill of the middle, by h tan(slope) with h the height of the centre.
    ground = common_plane(contacts.points, contacts.normals)
    x = data.qpos[0] - data.qpos[2] * math.tan(slope)
    zmp = zero_moment_point(contacts.points, contacts.forces, ground)
    assert zmp[:2] == pytest.approx([x, 0.0], abs=1e-3)
    margin = support_margin(contacts.points, contacts.normals, contacts.forces)
    assert margin == pytest.approx(min(0.15, 0.2 - 0.1 * math.tan(slope)), abs=2e-3)


def test_the_rigid_forces_of_a_standing_ant_are_its_weight_and_need_next_to_no_change():
    env = gym.make("Ant-v5")
    plant = bound(env)
    env.reset(seed=0)
    for _ in range(60):
        env.step(np.zeros(8, np.float32))
    plant.observe()
    terms = equations_of_motion(plant.model, plant.forward(), plant.actuators)
    c = terms.contacts
    assert len(c.points) >= 3
    problem = WholeBodyProblem(
        terms.inertia, terms.bias, terms.actuation, c.jacobians, c.drift, c.normals, c.friction,
        plant.lower, plant.upper, np.zeros(8),
    )  # fmt: skip
    forces, acceleration = rigid_forces(problem, np.zeros(8))
    weight = 9.81 * plant.model.body_subtreemass[0]
    assert forces[:, 2].sum() == pytest.approx(weight, rel=0.02)
    assert forces[:, 2].sum() == pytest.approx(c.forces[:, 2].sum(), rel=0.02)
    assert np.abs(acceleration[:3]).max() < 0.2
    # Four rigid feet share the load in another way than soft ones, one beyond its friction: a thousandth of the
    # torque is enough to share it as the ground can give it. MuJoCo 4.0's Runge-Kutta puts the ant down in another
    # pose: there the shares are inside their cones as they are, but not inside the pyramids in these.
    inside = mujoco.mj_version() >= 4_000_000
    assert in_cone(forces, c.normals, c.friction, 1e-6).all() == inside
    pyramid, cone = solve_pyramid(problem), solve_cone(problem)
    assert (pyramid.status, cone.status) == ("solved", "inactive" if inside else "solved")
    for found in (pyramid, cone):
        assert np.abs(found.control).max() < 2e-3
        assert in_cone(found.forces, c.normals, c.friction, 1e-6).all()
        assert found.forces[:, 2].sum() == pytest.approx(weight, rel=0.02)
    assert support_margin(c.points, c.normals, forces) > 0.05


def test_every_answer_on_a_struggling_robot_is_inside_its_cones_whatever_its_status(walker):
    seen = set()
    for plant in walker(120):
        terms = equations_of_motion(plant.model, plant.forward(), plant.actuators)
        c = terms.contacts
        if not len(c.points):
            continue
        problem = WholeBodyProblem(
            terms.inertia, terms.bias, terms.actuation, c.jacobians, c.drift, c.normals, 0.7 * c.friction,
            plant.lower, plant.upper, plant.upper * np.sin(np.arange(len(plant.upper)) + plant.time),
            contact_acceleration=-(c.jacobians @ plant.qvel) / 0.05,
        )  # fmt: skip
        for found in (solve_pyramid(problem, 8), solve_cone(problem)):
            seen.add(str(found.status))
            size = 1.0 + np.abs(found.forces).max()
            assert found.status != "failed"
            assert in_cone(found.forces, c.normals, 0.7 * c.friction, 2e-6 * size).all()
            assert ((found.control >= plant.lower) & (found.control <= plant.upper)).all()
            assert found.residuals.dynamics < 1e-9 * (1.0 + np.abs(found.acceleration).max() * size)
    assert {"solved", "infeasible"} <= seen


def test_something_flexible_in_contact_is_refused():
    model = mujoco.MjModel.from_xml_string(
        """<mujoco><worldbody><geom type="plane" size="1 1 1"/>
        <flexcomp name="cloth" type="grid" dim="2" count="3 3 1" spacing=".1 .1 .1" pos="0 0 0.004" radius="0.01"
        mass="0.1"><contact selfcollide="none"/></flexcomp></worldbody></mujoco>"""
    )
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    assert data.ncon > 0
    with pytest.raises(UnsupportedEnvError, match="flexible"):
        contact_points(model, data)


def test_in_the_air_there_are_no_contacts():
    model, data = zoo(settle=0.0)
    data.qpos[2] += 1.0
    data.qpos[11] += 1.0
    mujoco.mj_forward(model, data)
    terms = equations_of_motion(model, data)
    assert terms.contacts.points.shape == (0, 3)
    assert terms.contacts.jacobians.shape == (0, 3, model.nv)
    assert terms.contacts.friction.shape == (0,)
    assert terms.inertia @ data.qacc + terms.bias == pytest.approx(terms.actuation @ data.ctrl, abs=1e-9)
