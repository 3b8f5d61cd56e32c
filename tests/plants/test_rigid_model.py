"""Verdicts on rigid models, against eigenvalues of MuJoCo's finite differences and two masses with a spring."""

import gymnasium as gym
import mujoco
import numpy as np
import pytest
from flexible_joint import inertia_of, resonances
from oracles import damping_ratios
from scenes import Scene

from safe_wrappers.plants import rigid_model_check

ANGLES = (0.0, 0.7, 1.5, 2.4, np.pi)


def placed(elbow):
    env = gym.make("FlexJointReach-v0")
    env.unwrapped.set_state(np.array([0.4, 0.0, elbow, 0.0]), np.zeros(4))
    return env


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


@pytest.mark.parametrize("elbow", ANGLES)
def test_the_flexible_arms_resonances_are_those_of_finite_differences_and_of_two_masses(elbow):
    env = placed(elbow)
    check, arm = rigid_model_check(env), env.unwrapped.arm
    frequencies, ratios = ringing_of_finite_differences(env)
    np.testing.assert_allclose(check.resonances, frequencies, rtol=1e-3)
    np.testing.assert_allclose(check.damping_ratios, ratios, rtol=0.02)
    constants = arm.stiffness, arm.rotor_inertia, inertia_of(arm, np.array([0.4, elbow]))
    np.testing.assert_allclose(check.resonances, resonances(*constants), rtol=1e-9)
    whole = damping_ratios(arm, constants[2])
    np.testing.assert_allclose(check.damping_ratios, whole, rtol=1e-3)  # to first order


TWO_MASSES = """<mujoco><option timestep="0.0005" gravity="0 0 0"/><worldbody><body><joint name="motor" axis="0 0 1"
armature="0.05" damping="{damping}"/><joint name="spring" axis="0 0 1" stiffness="{stiffness}" damping="{across}"/>
<geom type="box" size="0.1 0.1 0.1" mass="3"/></body>{other}</worldbody>
<actuator>{actuator}</actuator></mujoco>"""
INERTIA = 3.0 * (0.2**2 + 0.2**2) / 12.0


class TwoMasses(Scene):
    def __init__(self, stiffness=200.0, damping=0.0, across=0.0, actuator='<motor joint="motor"/>', other=""):
        given = {"stiffness": stiffness, "damping": damping, "across": across}
        super().__init__(TWO_MASSES.format(actuator=actuator, other=other, **given), frame_skip=20)


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
    whole = TWO_MASSES.replace("</body>{other}", tip + "</body>")
    env = Scene(whole.format(stiffness=200, damping=0, across=0, actuator=servos), frame_skip=20)
    check = rigid_model_check(env)  # no vibration has half of its energy in the spring
    assert check.resonances and not check.rigid_is_good_enough
    env.model.jnt_stiffness[:] = 0.0
    assert not rigid_model_check(env).resonances
