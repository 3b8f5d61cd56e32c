"""What vibrates in soft joints: against the arm's closed form, and closed loops with soft and stiff springs."""

import gymnasium as gym
import mujoco
import numpy as np
import pytest
from flexible_joint import manifold

from safe_wrappers.diagnosis import diagnose
from safe_wrappers.diagnosis.recording import record
from safe_wrappers.diagnosis.symptom import NotMeasuredError
from safe_wrappers.diagnosis.symptoms import soft_joints
from safe_wrappers.diagnosis.symptoms.soft_joints import Springs
from safe_wrappers.plants import rigid_model_check

pytest.importorskip("gymnasium_robotics")
from planted import Bench, stiffened, waving

pytestmark = pytest.mark.filterwarnings("ignore")
ROCKING = """
<mujoco><option timestep="0.001"/><worldbody><body><joint name="motor" axis="0 1 0" armature=".1"/>
  <geom type="sphere" size=".02" mass=".1"/><body>{spring}<geom type="capsule" size=".02" fromto="0 0 0 .3 0 0"
  mass=".5"/></body></body></worldbody><actuator><motor joint="motor" ctrlrange="-2 2" ctrllimited="true"/>{more}
  </actuator></mujoco>
"""
SPRING = '<joint name="spring" axis="0 1 0" stiffness="90" springref="3" damping=".01"/>'


def test_the_energy_is_that_of_the_arms_closed_form():
    env = gym.make("FlexJointReach-v0").unwrapped
    rng, arm = np.random.default_rng(0), env.arm
    springs = Springs(env.model, np.array([1, 3]), *env.model.actuator_ctrlrange.T)
    for _ in range(30):
        qpos = np.array([rng.uniform(-3, 3), rng.normal(0, 0.02), rng.uniform(-3, 3), rng.normal(0, 0.02)])
        qvel, torque = rng.normal(0.0, 2.0, 4), rng.uniform(-1.0, 1.0, 2)
        found, full = springs.energies(qpos, qvel, torque)
        assert found == pytest.approx(float(arm.vibration_energy(qpos, qvel, torque)), rel=1e-6)
        inertia = arm.link_inertia(qpos[::2] + qpos[1::2])
        steps = [manifold(step, arm.rotor_inertia, inertia) for step in np.diag([6.0, 2.0])]
        assert full == pytest.approx(sum(0.5 * float((z * z / arm.stiffness).sum()) for z in steps), rel=1e-6)


def test_gravity_and_a_spring_at_rest_are_no_vibration():
    model = mujoco.MjModel.from_xml_string(ROCKING.format(spring=SPRING, more=""))
    data = mujoco.MjData(model)
    springs = Springs(model, np.array([1]), *model.actuator_ctrlrange.T)
    held = 0.5 * 9.81 * 0.15  # N m, of the level link at the motor
    sag = np.radians(3.0) + held / 90.0
    data.qpos[:], data.ctrl[:] = [-sag, sag], -held
    mujoco.mj_forward(model, data)
    assert np.abs(data.qacc).max() < 1e-6  # it stands
    assert springs.energies(data.qpos, data.qvel, data.ctrl)[0] < 1e-12
    pulled = data.qpos + np.array([-0.01, 0.01])
    assert springs.energies(pulled, data.qvel, data.ctrl)[0] == pytest.approx(0.5 * 90.0 * 0.01**2, rel=1e-3)


def test_seams_ring_in_soft_joints_and_the_lines_stop_it():
    env = gym.make("FlexJointReach-v0")
    policy = waving(env, 0.15, 200.0, seam=24)
    finding = diagnose(env, policy, steps=300, symptoms=["soft_joints"]).findings[0]
    assert finding.present and finding.after <= 0.5 * finding.figure
    slowest = {each.name: each.value for each in finding.evidence}["resonance 0"]
    assert finding.code.count("rate_limit=[") == 1
    rates = [float(each) for each in finding.code.partition("[")[2].partition("]")[0].split(",")]
    assert rates == pytest.approx([0.5 * slowest * 0.05 * 6.0, 0.5 * slowest * 0.05 * 2.0], rel=1e-3)


@pytest.mark.parametrize(("times", "seam"), [(1.0, 0), (100.0, 24)])
def test_slow_commands_and_stiff_joints_are_healthy(times, seam):
    env = stiffened(gym.make("FlexJointReach-v0"), times)
    figure = soft_joints.measure(env, record(env, waving(env, 0.15, 200.0, seam=seam), 300, 0)).figure
    assert 0.0 < figure < 0.5 * soft_joints.SYMPTOM.threshold


def test_a_ramp_at_the_proposed_rate_leaves_what_was_promised():
    # One step of the whole range as a ramp: the energy left, by the env's own account.
    env = gym.make("FlexJointReach-v0").unwrapped
    env.reset(seed=0)
    check = rigid_model_check(env)
    rates = 0.5 * check.resonances[0] * np.sqrt(soft_joints.SHARE) * np.array([6.0, 2.0])
    springs = Springs(env.model, np.array([1, 3]), *env.model.actuator_ctrlrange.T)
    full = springs.energies(env.data.qpos, env.data.qvel, np.zeros(2))[1]
    command = np.zeros(2)
    while (command < [3.0, 1.0]).any():
        command = np.minimum(command + rates * env.dt, [3.0, 1.0])
        info = env.step(command)[4]
    assert info["vibration_energy"] < 2.0 * soft_joints.SHARE * full  # the arm moves, too


def test_what_cannot_be_measured_is_said():
    for env, why in (
        (gym.make("Pendulum-v1"), "no MuJoCo model"),
        (gym.make("Reacher-v5"), "no spring lies behind a motor"),
        (Bench(ROCKING.format(spring="", more="")), "no spring lies behind a motor"),
        (
            Bench(ROCKING.format(spring=SPRING, more='<general joint="motor" dyntype="integrator"/>')),
            "activation dynamics",
        ),
    ):
        recording = record(env, lambda seen, env=env: np.zeros(env.action_space.shape, np.float32), 3, 0)
        with pytest.raises(NotMeasuredError, match=why):
            soft_joints.measure(env, recording)


def test_where_actions_are_no_controls_it_is_told():
    class Halved(Bench):
        def step(self, action):
            return super().step(0.5 * np.asarray(action))

    env = Halved(ROCKING.format(spring=SPRING, more=""))
    code, advice = soft_joints.lines(env, record(env, waving(env), 5, 0))
    assert not code and 'flexible="auto"' in advice
