"""The equations of motion of MuJoCo models, their momentum, and whether their springs let a rigid model do.

The oracles are MuJoCo's own accelerations and forces, motion over small steps, and eigenvalues of finite differences.
"""

import gymnasium as gym
import mujoco
import numpy as np
import pytest
from asking import bound
from flexible_joint import inertia_of, resonances
from oracles import damping_ratios, in_cone
from scenes import Legs, Scene

from safe_wrappers.control.whole_body import WholeBodyProblem, solve_cone, solve_pyramid
from safe_wrappers.errors import UnsupportedEnvError
from safe_wrappers.plants import rigid_model_check
from safe_wrappers.plants.mujoco.dynamics import MomentumReader, equations_of_motion

EQUALITY = '<equality><joint joint1="tail" joint2="hip" polycoef="0 .5 0 0 0" active="false"/></equality>'


def struggling(cone="pyramidal", condim=3, settle_s=0.35):
    """Legs with a servo, a spring, dry friction, armature and an equality, after random motion."""
    env = Legs("Euler", cone, condim, act='<position joint="tail" kp="5" kv="0.4"/>', end=EQUALITY)
    model, data, rng = env.model, env.data, np.random.default_rng(0)
    model.dof_frictionloss[6], model.dof_armature[6], model.jnt_stiffness[1] = 0.1, 0.05, 2.0
    model.opt.tolerance = 0.0  # the equations hold where the solver has found its minimum
    data.qvel[:] = rng.normal(size=model.nv) * 0.5
    while data.time < settle_s:
        data.ctrl[:] = rng.uniform(-1, 1, 3)
        mujoco.mj_step(model, data)
    return model, data


def moving(model):
    return model.body_dofnum[model.body_weldid] > 0


def pushed(terms, forces):
    return np.einsum("kiv,ki->v", terms.jacobians, forces)


@pytest.mark.parametrize("env_id", ["Ant-v5", "Humanoid-v5"])
def test_a_walkers_equations_hold_and_what_is_solved_with_them_is_inside_its_cones(env_id):
    env, touched, seen = gym.make(env_id), 0, set()
    plant = bound(env)
    env.reset(seed=3)
    env.action_space.seed(3)
    for step in range(60):  # it falls and struggles
        env.step(env.action_space.sample() * (0.2 if step % 3 else 1.0))
        plant.observe()
        terms, data = equations_of_motion(plant.model, plant.forward(), plant.actuators), plant.data
        left, c = terms.inertia @ data.qacc + terms.bias, terms.contacts
        right = terms.actuation @ data.ctrl + pushed(terms, c.force)
        assert left == pytest.approx(right, abs=1e-9 * (1.0 + np.abs(right).max()))
        touched += len(c.point)
        if not len(c.point):
            continue
        nominal = plant.upper * np.sin(np.arange(len(plant.upper)) + plant.time)
        problem = WholeBodyProblem(
            terms.inertia, terms.bias, terms.actuation, terms.jacobians, terms.drift, c.normal, 0.7 * c.friction,
            plant.lower, plant.upper, nominal, contact_acceleration=-(terms.jacobians @ plant.qvel) / 0.05,
        )  # fmt: skip
        for found in (solve_pyramid(problem, 8), solve_cone(problem)):
            seen.add(str(found.status))
            size = 1.0 + np.abs(found.forces).max()
            assert in_cone(found.forces, c.normal, 0.7 * c.friction, 2e-6 * size).all()
            assert ((found.control >= plant.lower) & (found.control <= plant.upper)).all()
            left = terms.inertia @ found.acceleration + terms.bias
            right = terms.actuation @ found.control + pushed(terms, found.forces)
            assert np.abs(left - right).max() < 1e-9 * (1.0 + np.abs(found.acceleration).max() * size)
    assert touched > 20 and {"projected", "infeasible"} <= seen and "failed" not in seen


@pytest.mark.parametrize("cone", ["pyramidal", "elliptic"])
@pytest.mark.parametrize("condim", [1, 3])
def test_they_hold_for_servos_limits_equalities_dry_friction_and_pushes_from_outside(cone, condim):
    model, data = struggling(cone, condim)
    data.eq_active[:] = 1
    data.ctrl[:] = [5.0, 0.3, 0.2]  # the first is beyond its range
    data.qfrc_applied[7] = 0.5
    data.xfrc_applied[3] = [1.0, 2.0, -3.0, 0.1, 0.2, 0.3]
    mujoco.mj_forward(model, data)
    assert len(set(data.efc_type.tolist())) > 2  # contact, dry friction, equality or limit
    terms = equations_of_motion(model, data)
    right = terms.actuation @ [1.0, 0.3, 0.2] + pushed(terms, terms.contacts.force)
    assert terms.inertia @ data.qacc + terms.bias == pytest.approx(right, abs=1e-8)
    assert terms.contacts.force.any() and (condim == 3 or not terms.contacts.friction.any())


def test_something_flexible_in_contact_is_refused():
    cloth = 'name="cloth" type="grid" count="3 3 1" spacing=".1 .1 .1" radius=".02" pos="0 0 .01" mass="1"'
    world = f'<geom type="plane" size="1 1 1"/><flexcomp {cloth}/>'
    model = mujoco.MjModel.from_xml_string(f"<mujoco><worldbody>{world}</worldbody></mujoco>")
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    with pytest.raises(UnsupportedEnvError, match="something flexible is in contact"):
        equations_of_motion(model, data)


def momentum(model, data):
    """Mass, centre of mass, linear and angular momentum about it, body by body."""
    mass, about, linear, angular = model.body_mass * moving(model), model.body_inertia, [], []
    com = mass @ data.xipos / mass.sum()
    for body in np.flatnonzero(mass):
        six, axes = np.zeros(6), data.ximat[body].reshape(3, 3)
        mujoco.mj_objectVelocity(model, data, mujoco.mjtObj.mjOBJ_BODY, body, six, 0)
        linear.append(mass[body] * six[3:])
        arm = data.xipos[body] - com
        angular.append(np.cross(arm, linear[-1]) + axes @ (about[body] * (axes.T @ six[:3])))
    return mass.sum(), com, np.sum(linear, axis=0), np.sum(angular, axis=0)


def test_momentum_is_that_of_all_bodies_and_over_small_steps_it_changes_as_the_wrenches_say():
    model, data = struggling(settle_s=0.12)
    model.opt.timestep = 1e-5
    reader, compared = MomentumReader(model, np.ones(model.nbody, dtype=bool)), 0
    for _ in range(150):
        mujoco.mj_forward(model, data)
        before, contacts = reader.read(data), equations_of_motion(model, data).contacts
        found = before.mass, before.com, before.linear, before.angular
        for mine, theirs in zip(found, momentum(model, data), strict=True):
            np.testing.assert_allclose(mine, theirs, rtol=1e-9, atol=1e-9)
        world = ~moving(model)[contacts.bodies[:, 0]]  # what the robot does to itself changes nothing
        arms, forces = contacts.point[world] - before.com, contacts.force[world]
        linear = forces.sum(axis=0) + before.mass * model.opt.gravity
        expected = np.concatenate([linear, np.cross(arms, forces).sum(axis=0)])
        mujoco.mj_step(model, data)
        after = reader.read(data)
        change = np.concatenate([after.linear - before.linear, after.angular - before.angular])
        change /= model.opt.timestep
        assert change == pytest.approx(expected, abs=2e-2 + 1e-3 * np.abs(expected).max())
        compared += bool(world.any())
    assert compared > 50


# Springs ----------------------------------------------------------------------------------------------------------


def ringing_of_finite_differences(env, substep=1e-4):
    """Frequencies and damping ratios of the oscillating eigenvalues of one Euler step."""
    model, data = env.unwrapped.model, env.unwrapped.data
    step, kind = model.opt.timestep, model.opt.integrator
    model.opt.timestep, model.opt.integrator = substep, int(mujoco.mjtIntegrator.mjINT_EULER)
    n = 2 * model.nv
    transition = np.zeros((n, n))
    mujoco.mjd_transitionFD(model, data, 1e-6, True, transition, None, None, None)
    model.opt.timestep, model.opt.integrator = step, kind
    # Semi-implicit Euler: (x, v) -> (x + h v', v' = v + h a): the acceleration's derivatives are in its lower rows.
    system = np.zeros((n, n))
    system[: model.nv, model.nv :] = np.eye(model.nv)
    system[model.nv :] = (transition[model.nv :] - np.eye(n)[model.nv :]) / substep
    values = np.linalg.eigvals(system)
    values = values[values.imag > 1.0]
    values = values[np.argsort(np.abs(values))]
    return np.abs(values), -values.real / np.abs(values)


@pytest.mark.parametrize("elbow", [0.0, 0.7, 2.4])
def test_the_flexible_arms_resonances_are_those_of_finite_differences_and_of_two_masses(elbow):
    env = gym.make("FlexJointReach-v0")
    env.unwrapped.set_state(np.array([0.4, 0.0, elbow, 0.0]), np.zeros(4))
    check, arm = rigid_model_check(env), env.unwrapped.arm
    frequencies, ratios = ringing_of_finite_differences(env)
    np.testing.assert_allclose(check.resonances, frequencies, rtol=1e-3)
    assert all(f"{frequency / (2.0 * np.pi):.3g} Hz" in str(check) for frequency in check.resonances)
    np.testing.assert_allclose(check.damping_ratios, ratios, rtol=0.02)
    inertia = inertia_of(arm, np.array([0.4, elbow]))
    np.testing.assert_allclose(
        check.resonances, resonances(arm.stiffness, arm.rotor_inertia, inertia), rtol=1e-9
    )
    np.testing.assert_allclose(
        check.damping_ratios, damping_ratios(arm, inertia), rtol=1e-3
    )  # to first order


TWO_MASSES = """<mujoco><option timestep="0.0005" gravity="0 0 0"/><worldbody><body><joint name="motor" axis="0 0 1"
armature="0.05" damping="{damping}"/><joint name="spring" axis="0 0 1" stiffness="{stiffness}" damping="{across}"/>
<geom type="box" size="0.1 0.1 0.1" mass="3"/></body></worldbody>
<actuator>{actuator}</actuator></mujoco>"""
INERTIA = 3.0 * (0.2**2 + 0.2**2) / 12.0


class TwoMasses(Scene):
    def __init__(self, stiffness=200.0, damping=0.0, across=0.0, actuator='<motor joint="motor"/>'):
        given = {"stiffness": stiffness, "damping": damping, "across": across}
        super().__init__(TWO_MASSES.format(actuator=actuator, **given), frame_skip=20)


def test_a_stiff_and_damped_spring_is_rigid_enough_and_one_that_rings_is_not():
    mobility = 1.0 / 0.05 + 1.0 / INERTIA
    for stiffness, across, good in ((200.0, 0.01, False), (2e4, 0.5, False), (2e6, 30.0, True)):
        check = rigid_model_check(TwoMasses(stiffness, across=across))
        assert check.resonances == pytest.approx([np.sqrt(stiffness * mobility)])
        assert check.boundary_layer_s == pytest.approx(2.0 / (across * mobility))
        assert check.left_over == pytest.approx(np.exp(-0.01 * across * mobility / 2.0))
        assert check.rigid_is_good_enough is good
    assert rigid_model_check(TwoMasses()).boundary_layer_s == np.inf
    assert not rigid_model_check(TwoMasses()).rigid_is_good_enough


def test_a_servos_own_damping_counts():
    env = TwoMasses(actuator='<position joint="motor" kp="300" kv="0.4"/>')
    check = rigid_model_check(env)
    mujoco.mj_forward(env.model, env.data)
    frequencies, ratios = ringing_of_finite_differences(env)
    assert check.resonances == pytest.approx([frequencies[1]], rel=1e-2)
    assert check.damping_ratios == pytest.approx([ratios[1]], rel=0.1) and ratios[1] > 0.01


def test_a_spring_that_servos_share_out_among_all_vibrations_is_one():
    tip = '<body><joint name="t" axis="0 0 1" armature=".02"/><geom pos=".1 0 0" size=".05" mass="1"/></body>'
    servos = '<position joint="motor" kp="800"/><position joint="t" kp="100"/>'
    whole = TWO_MASSES.replace("</body>", tip + "</body>")
    env = Scene(whole.format(stiffness=200, damping=0, across=0, actuator=servos), frame_skip=20)
    check = rigid_model_check(env)  # no vibration has half of its energy in the spring
    assert check.resonances and not check.rigid_is_good_enough
    env.model.jnt_stiffness[:] = 0.0
    check = rigid_model_check(env)
    assert not check.resonances and check.boundary_layer_s == 0.0 and check.rigid_is_good_enough
