"""What Traction is made of, each part by what goes wrong without it: estimate, memory, rows, servos, fallback."""

import warnings

import numpy as np
import pytest
from vehicles import FULL, OPEN, Trolley, rover

import safe_wrappers as sw
from safe_wrappers.control.vehicle.slip import slip_ratio


def start(env, lateral=0.0, wheel_speed=None, **layout):
    """Reset, with a speed to the left (m/s) and a circumferential speed of all wheels (m/s), where given."""
    env.reset(seed=0, options={"layout": OPEN | layout})
    raw = env.unwrapped
    qvel = raw.data.qvel.copy()
    qvel[1] = lateral
    if wheel_speed is not None:
        qvel[raw.wheel_dofs] = wheel_speed / raw.wheel_radius
    raw.set_state(raw.data.qpos.copy(), qvel)
    return raw


def pulses(steering, seed=1, steps=200):
    """Torques drawn anew for every wheel every 0.2 s, and a steering angle."""
    rng = np.random.default_rng(seed)
    for _ in range(steps // 20):
        torque, angle = rng.choice([-1.0, -0.3, 0.3, 1.0], 4), steering * rng.uniform(-1.0, 1.0)
        for _ in range(20):
            yield np.array([*torque, angle], np.float32)


# The estimate ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("steering", [0.0, 1.0])
def test_the_truth_lies_within_the_estimates_standard_deviations(steering):
    """Under pulses, straight on and in curves that slide: force along and across, slips that rise and fall."""
    errors = []
    for ground in ("dry", "wet", "snow", "ice"):
        env = rover()
        raw = start(env, ground=ground, speed=2.0)
        truth = raw.curve_under("front_left").peak_friction
        for k, action in enumerate(pulses(steering)):
            info = env.step(action)[4]
            if k > 20:
                errors.append(np.abs(info["slip/mu_estimate"] - truth) / info["slip/mu_std"])
    assert np.mean(np.array(errors) < 2.0) > 0.99
    assert np.max(errors) < 3.0


@pytest.mark.parametrize("ground", ["dry", "wet", "snow", "ice"])
def test_pulses_on_one_ground_overshoot_by_little_and_seldom(ground):
    """From full brake to full throttle the force changes within a step by twice what the ground has."""
    env = rover()
    start(env, ground=ground, speed=2.0)
    slips = np.array([env.step(action)[4]["slip_max"] for action in pulses(0.0)])
    assert slips.max() < 0.2
    assert np.mean(slips > 0.16) < 0.02


def test_below_the_regularisation_nothing_is_learnt():
    env = rover()
    raw = start(env)
    fastest, learnt = [], []
    for _ in range(12):
        info = env.step(FULL)[4]  # its report is of the state before
        learnt.append(info["slip/mu_std"][0] < 0.5)
        fastest.append(max(raw.forward_speed, raw.wheel_radius * raw.data.qvel[raw.wheel_dofs[0]]))
    assert learnt[1:] == [speed > 0.5 for speed in fastest[:-1]]
    assert any(learnt)


def test_a_wheel_that_is_hardly_loaded_teaches_nothing():
    env = rover()
    start(env, ground="wet", speed=2.0)
    for _ in range(40):
        info = env.step(FULL)[4]
    wheels, before = env.filter.bound[0].wheels, info["slip/mu_estimate"]
    measured = wheels.loads
    wheels.loads = lambda model, data: 0.01 * measured(model, data)  # for one step: it hops
    env.step(FULL)
    wheels.loads = measured
    for _ in range(2):
        info = env.step(FULL)[4]
        np.testing.assert_allclose(info["slip/mu_estimate"], before, atol=0.01)


def test_another_episode_knows_nothing_of_the_one_before():
    used, fresh = rover(), rover()
    start(used, ground="ice", speed=3.0)
    for _ in range(60):
        info = used.step(FULL)[4]
    assert (info["slip/mu_std"] < 0.1).all()  # it has learnt
    for each in (used, fresh):
        start(each, ground="wet", speed=2.0)
    for _ in range(30):
        one, other = used.step(FULL)[4], fresh.step(FULL)[4]
        for key in ("executed_action", "slip/ratio", "slip/mu_estimate", "slip/mu_std"):
            np.testing.assert_array_equal(one[key], other[key], err_msg=key)


# The rows ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("throttle", [1.0, -1.0])
def test_what_slides_sideways_is_not_left_for_the_drives(throttle):
    """0.45 m/s to the left at 3 m/s is a slip of 0.15 across: all that there is."""
    env = rover()
    raw = start(env, ground="wet", speed=3.0, lateral=0.45)
    for k in range(40):
        info = env.step(throttle * FULL)[4]
        across = np.abs(raw.data.qvel[1]) / raw.forward_speed
        along = np.abs(info["slip"]).max()
        assert np.hypot(across, along) < 0.155
        if k < 3:
            assert across > 0.08 and along < 0.03
    assert across < 0.02 and along > 0.08  # the grip is the drives' again


def test_a_force_that_grew_with_its_slip_counts_at_its_end():
    """A start from rest; counting on the force's mean over each step, it has a slip of 0.044 after four steps."""
    env = rover()
    start(env)
    slips = [env.step(FULL)[4]["slip"].min() for _ in range(4)]
    assert slips[-1] > 0.052


@pytest.mark.parametrize(("wheel_speed", "throttle"), [(6.0, 1.0), (0.5, -1.0), (-3.0, -1.0)])
def test_from_outside_the_drives_bring_it_back_as_fast_as_they_can(wheel_speed, throttle):
    """At 2 m/s on ice, wheels that spin, that are nearly locked, that turn backwards; and a policy that goes on."""
    env = rover()
    raw = start(env, ground="ice", speed=2.0, wheel_speed=wheel_speed)
    outside = slip_ratio(wheel_speed, 2.0, 0.5) * np.ones(4)
    for _ in range(40):
        limit = env.constraints[0].max_slip
        info = env.step(throttle * FULL)[4]
        assert not info["cbf/infeasible"]
        if (np.abs(outside) > 3.0 * limit).all():
            np.testing.assert_array_equal(info["executed_action"][:4], -np.sign(outside))
        outside = info["slip"]
    assert np.abs(info["slip"]).max() < 0.12
    assert raw.forward_speed > 1.0


def test_a_row_that_no_torque_can_break_is_left_out():
    env = rover(friction=1e6)
    start(env, speed=1.0)
    env.plant.observe()
    assert env.filter.bound[0].rows().normals.shape == (0, 5)
    tight = rover()
    start(tight, speed=1.0)
    tight.plant.observe()
    normals = tight.filter.bound[0].rows().normals
    assert normals.shape == (8, 5)
    assert (normals[:, 4] == 0.0).all()  # the steering's


SERVOS = {
    "speed": '<velocity joint="{}" kv="0.5" ctrlrange="-40 40"/>',
    "speed, geared": '<velocity joint="{}" kv="0.5" gear="2" ctrlrange="-40 40"/>',
    "position, geared": '<position joint="{}" kp="0.5" gear="2" ctrlrange="-40 40"/>',
}


@pytest.mark.parametrize("forward", [1.0, -1.0])
@pytest.mark.parametrize("servo", SERVOS)
def test_a_servo_drives_as_a_motor_does(servo, forward):
    """Both are asked for more than the ground has, so both get what it has, however a servo's torque falls."""
    actuators = "".join(SERVOS[servo].format(side) for side in ("left", "right"))
    speeds, slips = [], []
    for given, size in (({}, 1.0), ({"actuators": actuators}, 40.0)):
        env = sw.SlipLimiter(Trolley(0.15, **given), wheels=["left", "right"])
        env.reset(seed=0)
        data, seen = env.unwrapped.data, []
        for _ in range(100):
            env.step(np.full(2, forward * size, dtype=np.float32))
            seen.append(slip_ratio(0.1 * data.qvel[6], data.qvel[0], 0.5))
        speeds.append(data.qvel[0])
        slips.append(np.mean(seen))
    assert forward * speeds[0] > 0.8
    assert speeds[1] == pytest.approx(speeds[0], rel=0.02)
    assert slips[1] == pytest.approx(slips[0], abs=0.02)


def test_the_fallbacks_brake_ends_at_a_standstill():
    env = rover()
    raw = start(env, ground="wet", speed=1.0)
    with warnings.catch_warnings(action="ignore"):
        for _ in range(100):
            info = env.step(np.full(5, np.nan, dtype=np.float32))[4]
            assert raw.forward_speed > -0.02
    assert abs(raw.forward_speed) < 1e-4
    assert np.abs(info["executed_action"]).max() < 1e-4


def test_a_measurement_that_is_no_number_is_reported_and_forgotten():
    env = rover()
    start(env, ground="wet", speed=2.0)
    for _ in range(20):
        env.step(FULL)
    wheels = env.filter.bound[0].wheels
    measured = wheels.loads
    wheels.loads = lambda model, data: np.nan * measured(model, data)
    with warnings.catch_warnings(action="ignore"):
        info = env.step(FULL)[4]
    assert info["cbf/fallback"]
    assert np.isfinite(info["executed_action"]).all()
    wheels.loads = measured
    for _ in range(10):
        info = env.step(FULL)[4]
    assert not info["cbf/fallback"]
    assert np.isfinite(np.concatenate([info["slip/mu_estimate"], info["slip/mu_std"]])).all()
    assert info["slip_max"] < 0.16


@pytest.mark.parametrize("servo", SERVOS)
def test_a_servos_brake_ends_at_a_standstill_within_the_limit(servo):
    actuators = "".join(SERVOS[servo].format(side) for side in ("left", "right"))
    env = sw.SlipLimiter(Trolley(0.15, actuators=actuators), wheels=["left", "right"])
    env.reset(seed=0)
    data, slips = env.unwrapped.data, []
    for _ in range(100):
        env.step(np.full(2, 40.0, dtype=np.float32))
    assert data.qvel[0] > 0.8
    with warnings.catch_warnings(action="ignore"):
        for _ in range(150):
            env.step(np.full(2, np.nan, dtype=np.float32))
            slips.append(abs(float(slip_ratio(0.1 * data.qvel[6], data.qvel[0], 0.5))))
    assert max(slips) < 0.2
    assert abs(data.qvel[0]) < 0.02


def test_a_limit_that_shrinks_is_followed_as_fast_as_the_drives_can():
    """Slip of 0.14 ahead, within max_slip, and a slide of as much across, which leaves nothing of it."""
    env = rover()
    start(env, ground="ice", speed=6.0, lateral=0.9, wheel_speed=6.0 / (1.0 - 0.14))
    info = env.step(FULL)[4]
    assert not info["cbf/infeasible"]
    np.testing.assert_array_equal(info["executed_action"][:4], -1.0)


def test_a_row_that_is_no_number_is_kept_and_fails():
    env = rover(friction=1e6)
    start(env, speed=1.0)
    env.filter.observe()
    traction = env.filter.bound[0]
    traction._window = tuple(np.nan * end for end in traction._window)
    assert np.isnan(traction._bounds().offsets).all()
    assert traction._bounds().offsets.shape == (8,)


# The report --------------------------------------------------------------------------------------------------------


def test_a_reader_that_writes_into_a_report_changes_nothing():
    untouched, written = rover(), rover()
    for env in (untouched, written):
        start(env, ground="wet", speed=2.0)
    for _ in range(10):
        one, other = untouched.step(FULL)[4], written.step(FULL)[4]
        np.testing.assert_array_equal(one["executed_action"], other["executed_action"])
        np.testing.assert_array_equal(one["slip/mu_estimate"], other["slip/mu_estimate"])
        for key in ("slip/ratio", "slip/limited", "slip/mu_estimate", "slip/mu_std"):
            other[key][:] = 9.0


def test_a_resets_report_is_of_the_state_that_it_begins_in():
    class Spinning(Trolley):
        def reset(self, *, seed=None, options=None):
            super().reset(seed=seed, options=options)
            self.data.qvel[6:8] = 2.0, -3.0
            return self.observe(), {}

    info = sw.SlipLimiter(Spinning(), wheels=["left", "right"]).reset(seed=0)[1]
    np.testing.assert_allclose(info["slip/ratio"], [0.2 / 0.5, -0.3 / 0.5], atol=1e-9)
    assert not info["slip/limited"].any()
