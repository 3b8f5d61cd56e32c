"""The symptoms' measurements against what they have to be: control theory, kinematics, known delays."""

import control
import gymnasium as gym
import mujoco
import numpy as np
import pytest

pytest.importorskip("gymnasium_robotics")
from planted import ARM, TURNTABLE, Bench, waving

from safe_wrappers.diagnosis.recording import attacking_driver, braking_horizon, random_driver, record
from safe_wrappers.diagnosis.symptoms import command_steps, late_commands, lever_arms, wheel_slip
from safe_wrappers.diagnosis.symptoms.loop_margin import loop
from safe_wrappers.diagnosis.symptoms.singular_poses import _arm, _manipulability


@pytest.mark.parametrize("delay", [0, 1, 3])
@pytest.mark.parametrize("dt", [0.01, 0.05])
def test_phase_margins_are_those_of_python_control(delay, dt):
    kp, kd = 4.0, 2.0
    system = control.ss(control.c2d(control.ss([[0, 1], [0, -0.4]], [[0], [1]], np.eye(2), 0), dt, "zoh"))
    gains = np.array([[kp, kd]])
    wait = control.tf([1.0], [1.0, *[0.0] * delay], dt)
    opened = control.ss2tf(control.ss(system.A, system.B, gains, 0, dt)) * wait
    _, margin, _, _, crossover, _ = control.stability_margins(opened)
    ours, at = loop(system.A, system.B, -gains, delay, 0, dt)
    if margin > 0.0:
        assert np.degrees(ours) == pytest.approx(margin, abs=0.5)
        assert at == pytest.approx(crossover, rel=2e-3)
    else:
        assert ours == 0.0


def test_a_loop_that_delay_makes_unstable_has_no_margin():
    a, b = np.array([[1.0, 0.1], [0.0, 1.0]]), np.array([[0.005], [0.1]])
    gains = -np.array([[20.0, 8.0]])
    assert loop(a, b, gains, 0, 0, 0.1)[0] > 0.1
    assert loop(a, b, gains, 3, 0, 0.1)[0] == 0.0


def test_two_inputs_are_cut_one_at_a_time():
    a, b = np.diag([0.9, 0.8]), np.eye(2)
    together, alone = np.array([[-0.5, 0.0], [0.0, -0.4]]), np.array([[-0.5]])
    both = loop(a, b, together, 1, 0, 0.02)
    one = loop(a[:1, :1], b[:1, :1], alone, 1, 0, 0.02)
    assert both == pytest.approx(one)


def test_manipulability_of_a_two_link_arm():
    env = Bench(ARM)
    tip, dofs = _arm(env.model)
    assert env.model.body(tip).name == "tip" and dofs.tolist() == [0, 1]
    poses = np.random.default_rng(0).uniform(-3.0, 3.0, (50, 2))
    found, directions = _manipulability(env.model, tip, dofs, poses)
    assert directions == "xy"
    assert found == pytest.approx(np.abs(0.3 * 0.3 * np.sin(poses[:, 1])), abs=1e-12)


def test_what_turning_adds_is_what_an_accelerometer_reads():
    env = Bench(TURNTABLE.format(arm=0.25))
    policy, read = waving(env, 0.5, 100.0), []

    def act(observation):
        read.append(np.linalg.norm(env.data.sensordata[:3]))
        return policy(observation)

    measured = lever_arms.measure(env, record(env, act, 200, 0))
    # Asked three times at first; a reading before an action is that of the step before it.
    seen = np.array(read[3:])
    assert np.abs(measured.steps[1:-1] - seen[1:]).max() < 0.02 * seen.max()
    assert measured.evidence[0].value == pytest.approx(0.25)


ROVER = """
<mujoco><worldbody><geom type="plane" size="9 9 1"/>
  <body name="chassis" pos="0 0 .1"><freejoint/><geom type="box" size=".2 .1 .02" mass="5"/>
    <body name="wheel" pos=".1 .12 0"><joint name="wheel" axis="0 1 0"/>
      <geom type="cylinder" size=".1 .02" zaxis="0 1 0" mass=".5"/></body>
    <body name="foot" pos="-.1 .12 0"><joint name="foot" axis="0 1 0" range="-90 90" limited="true"/>
      <geom type="sphere" size=".1" mass=".5"/></body>
    <body name="mast" pos="0 0 .05"><joint name="mast" axis="0 0 1"/><geom type="sphere" size=".02" mass=".1"/></body>
  </body></worldbody><actuator><motor joint="wheel"/><motor joint="foot"/><motor joint="mast"/></actuator></mujoco>
"""


def test_wheels_are_what_rolls_and_their_slip_is_that_of_kinematics():
    model = mujoco.MjModel.from_xml_string(ROVER)
    rolling = wheel_slip.wheels(model)
    assert [model.joint(j).name for j in rolling] == ["wheel"] and list(rolling.values()) == [0.1]
    env = gym.Env()
    env.model, env.data = model, mujoco.MjData(model)

    class Seen:
        qpos = np.tile(model.qpos0, (4, 1))
        qvel = np.zeros((4, model.nv))

    Seen.qpos[3, 3:7] = [np.cos(0.6), 0.0, 0.0, np.sin(0.6)]  # turned round by 1.2 rad
    Seen.qvel[0, [0, 6]] = 1.0, 10.0  # rolls
    Seen.qvel[1, [0, 6]] = 1.0, 20.0  # twice as fast as it rolls
    Seen.qvel[2, [0, 6]] = 2.0, 0.0  # locked
    Seen.qvel[3, :2], Seen.qvel[3, 6] = 2.0 * np.array([np.cos(1.2), np.sin(1.2)]), 10.0
    found = wheel_slip.slips(env, Seen)[:, 0]
    assert found == pytest.approx([0.0, 0.5, -1.0, -0.5], abs=1e-9)


def test_ages_are_the_delays_that_were_made():
    class Seen:
        rng = np.random.default_rng(0)
        actions = rng.uniform(-1.0, 1.0, (40, 2))
        executed = actions.copy()
        first = np.zeros(40, dtype=bool)

    Seen.executed[5:] = Seen.actions[2:-3]
    Seen.executed[20:26] = Seen.actions[17]
    Seen.first[[0, 30]] = True
    Seen.executed[30:] = Seen.actions[30:]
    age = late_commands.ages(None, Seen)
    assert age[:5].tolist() == [0.0] * 5 and (age[5:20] == 3.0).all()
    assert age[20:26].tolist() == [3.0, 4.0, 5.0, 6.0, 7.0, 8.0] and (age[30:] == 0.0).all()


def test_command_steps_are_not_counted_over_resets():
    class Seen:
        executed = np.array([[0.0], [0.1], [0.2], [-1.0], [-0.9], [-0.8]])
        actions = executed
        first = np.array([True, False, False, True, False, False])

    env = gym.Env()
    env.action_space = gym.spaces.Box(-1.0, 1.0, (1,))
    measured = command_steps.measure(env, Seen)
    assert measured.steps == pytest.approx([0.0, 0.05, 0.05, 0.0, 0.05, 0.05])
    assert measured.evidence[0].value == pytest.approx(0.0, abs=1e-12)


def test_drivers_are_seeded_and_hold_corners():
    env = gym.make("Reacher-v5")
    for make in (random_driver, attacking_driver):
        first, second = ([make(env, 4)(None) for _ in range(2)] for _ in range(2))
        assert np.array_equal(first, second)
    act = attacking_driver(env, 0)
    taken = np.array([act(None) for _ in range(45)])
    assert (np.abs(taken) == 1.0).all()
    assert all(len(np.unique(taken[k : k + 15], axis=0)) == 1 for k in (0, 15, 30))


def test_what_the_env_was_given_is_seen_inside_of_wrappers():
    class Half(gym.ActionWrapper):
        def action(self, action):
            return 0.5 * action

    env = Half(gym.make("Swimmer-v5"))
    recording = record(env, random_driver(env, 0), 20, 0)
    assert np.allclose(recording.executed, 0.5 * recording.actions)
    assert np.allclose(recording.controls, recording.executed)
    assert recording.control_dt == pytest.approx(env.unwrapped.dt) and not recording.repeats


def test_a_horizon_covers_the_time_to_brake():
    env = Bench(ARM)
    recording = record(env, random_driver(env, 0), 30, 0)
    recording.qvel = np.repeat(np.linspace(0.0, 4.0, 30)[:, None], 2, axis=1)
    assert braking_horizon(recording) == 29
    recording.qvel *= 0.0
    assert braking_horizon(recording) == 5
