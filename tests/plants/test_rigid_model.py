"""Verdicts on rigid models, against eigenvalues of MuJoCo's finite differences and two masses with a spring."""

import gymnasium as gym
import mujoco
import numpy as np
import pytest
from flexible_joint import resonances
from oracles import damping_ratios
from scenes import Scene

import safe_wrappers as sw
from safe_wrappers.plants import RigidModelCheck, rigid_model_check

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
    constants = arm.stiffness, arm.rotor_inertia, arm.link_inertia(np.array([0.4, elbow]))
    np.testing.assert_allclose(check.resonances, resonances(*constants), rtol=1e-9)
    whole = damping_ratios(arm, constants[2])
    np.testing.assert_allclose(check.damping_ratios, whole, rtol=1e-3)  # to first order


def test_what_it_says_of_the_flexible_arm():
    check = rigid_model_check(placed(0.0))
    assert check.springs == ("spring0", "spring1") and check.control_dt == pytest.approx(0.01)
    assert check.epsilon == pytest.approx(70.0**-0.5)
    slow = min(w * z for w, z in zip(check.resonances, check.damping_ratios, strict=True))
    assert check.boundary_layer_s == pytest.approx(1.0 / slow)
    assert check.lightly_damped == check.resonances and not check.rigid_is_good_enough
    assert str(check).startswith("rigid model is not good enough: 10.1 Hz (damping ratio 0.017), 18.8 Hz")
    assert "99% of the amplitude is left after a control interval of 0.01 s" in str(check)


@pytest.mark.parametrize("name", ["Reacher-v5", "HalfCheetah-v5", "InvertedPendulum-v5"])
def test_joints_that_a_motor_drives_itself_are_no_springs_behind_it(name):
    check = rigid_model_check(gym.make(name))
    assert check.rigid_is_good_enough and check.springs == () and check.lightly_damped == ()
    assert str(check) == "rigid model is good enough: no spring lies behind a motor"


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


def test_a_servo_holds_the_motor_and_what_swings_on_the_servo_is_not_the_spring():
    servo = '<position joint="motor" kp="1e7"/>'
    check = rigid_model_check(TwoMasses(actuator=servo))
    assert check.resonances == pytest.approx([np.sqrt(200.0 / INERTIA)], rel=1e-4)  # the link alone


def test_a_servos_own_damping_counts():
    env = TwoMasses(actuator='<position joint="motor" kp="300" kv="0.4"/>')
    check = rigid_model_check(env)
    mujoco.mj_forward(env.model, env.data)
    frequencies, ratios = ringing_of_finite_differences(env)
    assert check.resonances == pytest.approx([frequencies[1]], rel=1e-2)
    assert check.damping_ratios == pytest.approx([ratios[1]], rel=0.1) and ratios[1] > 0.01


def test_a_spring_without_a_motor_before_it_does_not_count():
    other = '<body pos="1 0 0"><joint name="alone" stiffness="30"/><geom size="0.1" mass="1"/></body>'
    assert rigid_model_check(TwoMasses(other=other)).springs == ("spring",)


def test_the_users_plant_says_where_the_model_is():
    class Hidden(gym.Env):
        def __init__(self):
            self.inner = TwoMasses()
            self.dt, self.action_space = 0.01, self.inner.action_space
            self.observation_space = self.inner.observation_space

    plant = sw.MujocoPlant(
        model=lambda env: env.inner.model, data=lambda env: env.inner.data, control_dt=0.01
    )
    assert rigid_model_check(Hidden(), plant) == rigid_model_check(TwoMasses())
    assert isinstance(rigid_model_check(TwoMasses()), RigidModelCheck)
