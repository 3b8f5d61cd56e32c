"""Traction and SlipLimiter: slip within its limit on every ground, without being told which."""

import warnings

import gymnasium as gym
import numpy as np
import pytest
from vehicles import FULL, OPEN, Trolley, rover

import safe_wrappers as sw
from safe_wrappers.control.vehicle import slip_ratio
from safe_wrappers.envs.ground import MAGIC_FORMULA
from safe_wrappers.errors import ConfigurationError, UnknownNameError, UnsupportedEnvError


def drive(env, action, steps, **layout):
    env.reset(seed=0, options={"layout": OPEN | layout})
    return [env.step(action)[4] for _ in range(steps)]


@pytest.mark.parametrize("ground", ["dry", "wet", "snow", "ice"])
@pytest.mark.parametrize("throttle", [1.0, -1.0])
def test_full_throttle_stays_on_the_stable_side(ground, throttle):
    infos = drive(rover(), throttle * FULL, 150, ground=ground)
    top = MAGIC_FORMULA[ground]
    slips = np.array([info["slip"] for info in infos])
    assert max(info["slip_max"] for info in infos) < 0.16
    # The estimate is of a peak that is flat: within a sixth of where it is, less than a hundredth of force is lost.
    assert np.abs(slips).max() < max(1.17 * top.peak_slip, 0.135)
    assert (np.abs(slips[60:]) > 0.6 * top.peak_slip).all()  # and it uses what there is
    estimate = infos[-1]["slip/mu_estimate"]
    np.testing.assert_allclose(estimate, top.peak_friction, rtol=0.2)


@pytest.mark.parametrize(("ground", "longest"), [("dry", 1.07), ("wet", 1.05), ("snow", 1.05), ("ice", 1.05)])
def test_a_panic_brake_stops_within_the_physics(ground, longest):
    """Against v^2 / (2 mu g), which needs the peak's slip at all wheels from the first moment on."""
    env = rover()
    env.reset(seed=0, options={"layout": OPEN | {"ground": ground, "speed": 3.0}})
    raw = env.unwrapped
    while raw.forward_speed > 0.02:
        env.step(-FULL)
    assert raw.agent_position[0] < longest * 9.0 / (2.0 * MAGIC_FORMULA[ground].peak_friction * 9.81)


def test_another_ground_costs_a_step_or_two():
    """Full throttle from dry ground onto ice, straight on."""
    ice = {"ground": "ice", "center": [2.0, 0.0], "radius": 1.0}
    env, free = rover(), rover().env
    for each in (env, free):
        each.reset(seed=0, options={"layout": OPEN | {"patches": [ice]}})
    slips, spins = [], []
    while env.unwrapped.agent_position[0] < 2.5:
        slips.append(env.step(FULL)[4]["slip_max"])
    while free.unwrapped.agent_position[0] < 2.5:
        spins.append(free.step(FULL)[4]["slip_max"])
    assert max(slips) < 0.3
    assert sum(s > 0.2 for s in slips) <= 4  # of each axle, at the patch's edge
    assert min(spins[20:]) > 0.5


def test_admissible_torques_pass_bit_for_bit():
    env = rover()
    env.reset(seed=3)
    rng = np.random.default_rng(0)
    for _ in range(200):
        action = (rng.uniform(-0.05, 0.05, 5) * [1, 1, 1, 1, 10]).astype(np.float32)
        info = env.step(action)[4]
        assert not info["cbf/intervened"]
        assert (info["executed_action"] == action.astype(np.float64)).all()
    assert env.unwrapped.forward_speed != 0.0


def test_a_ground_that_is_counted_on_is_used_at_once():
    measured, declared = rover(), rover(friction=0.9)
    drive(measured, FULL, 8)
    drive(declared, FULL, 8)
    assert declared.unwrapped.forward_speed > 1.1 * measured.unwrapped.forward_speed


@pytest.mark.parametrize("limit", [0.03, 0.08])
def test_the_limit_is_the_users(limit):
    infos = drive(rover(max_slip=limit), FULL, 120, ground="wet")
    assert 0.9 * limit < max(info["slip_max"] for info in infos[40:]) < 1.1 * limit
    inner = drive(rover(max_slip=limit, margin=0.3 * limit), FULL, 120, ground="wet")
    assert max(info["slip_max"] for info in inner) < 0.75 * limit


def test_a_wheel_in_the_air_keeps_the_ground_speed():
    """Lifted, under full throttle: no load, no force, and it must touch down rolling."""
    env = rover()
    before = env.reset(seed=0, options={"layout": OPEN | {"speed": 2.0}})[1]["slip/mu_estimate"]
    raw = env.unwrapped
    qpos, qvel = raw.data.qpos.copy(), raw.data.qvel.copy()
    qpos[2] += 0.5
    raw.set_state(qpos, qvel)
    for _ in range(20):
        info = env.step(FULL)[4]
        assert (raw.data.userdata == 0.0).all()
        slip = slip_ratio(raw.wheel_radius * raw.data.qvel[raw.wheel_dofs], raw.forward_speed, 0.5)
        assert (np.abs(slip) < 0.11).all()
    np.testing.assert_array_equal(info["slip/mu_estimate"], before)  # nothing was measured


def test_a_policy_that_is_not_finite_is_braked_for_within_the_limit():
    env = rover()
    env.reset(seed=0, options={"layout": OPEN | {"ground": "wet", "speed": 3.0}})
    with warnings.catch_warnings(action="ignore"):
        infos = [env.step(np.full(5, np.nan, dtype=np.float32))[4] for _ in range(60)]
    assert all(info["cbf/fallback"] for info in infos)
    assert max(info["slip_max"] for info in infos) < 0.17
    assert abs(env.unwrapped.forward_speed) < 0.2
    for _ in range(50):
        with warnings.catch_warnings(action="ignore"):
            env.step(np.full(5, np.nan, dtype=np.float32))
    assert abs(env.unwrapped.forward_speed) < 0.02


# Other vehicles: MuJoCo's own friction, wheels as cylinders, one actuator for two wheels ---------------------------


def trolley_slip(env):
    wheels = env.filter.bound[0].spec._wheels
    env.plant.observe()
    rate, ground, _ = wheels.motion()
    return slip_ratio(0.1 * rate, ground, 0.5)


@pytest.mark.parametrize(("friction", "most"), [(0.15, 0.0), (0.3, 0.0), (0.7, 0.05)])
def test_on_mujocos_own_friction(friction, most):
    """On much friction the trolley's wheels hop under full throttle, and have no force in the air."""
    env, free = sw.SlipLimiter(Trolley(friction), wheels=["left", "right"]), Trolley(friction)
    slips, spins = [], []
    for each in (env, free):
        each.reset(seed=0)
    for _ in range(150):
        env.step(np.ones(2, dtype=np.float32))
        free.step(np.ones(2))
        slips.append(np.abs(trolley_slip(env)).max())
        spins.append(abs(slip_ratio(0.1 * free.data.qvel[6], free.data.qvel[0], 0.5)))
    assert np.mean(np.array(slips) > 0.17) <= most
    assert max(slips) < 0.3
    assert np.mean(spins) > 0.4
    # Dry friction does not fall behind its peak: nothing is won, and little lost.
    assert env.unwrapped.data.qvel[0] > 0.7 * free.data.qvel[0]


# Bad input ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("arguments", "error", "says"),
    [
        ({"wheels": ["front_lft"]}, UnknownNameError, "no joint 'front_lft'; it has: .*front_left"),
        ({"wheels": ["front_left", "front_left"]}, ConfigurationError, "each once"),
        ({"max_slip": 0.0}, ConfigurationError, r"\(0, 1\)"),
        ({"max_slip": float("nan")}, ConfigurationError, "max_slip"),
        ({"friction": -0.5}, ConfigurationError, "friction"),
    ],
)
def test_refused_at_construction(arguments, error, says):
    env = gym.make("SafeRover-v0")
    with pytest.raises(error, match=says):
        sw.SlipLimiter(env, **{"wheels": list(env.unwrapped.wheels)} | arguments)


def test_twice_in_one_list_is_refused():
    env = gym.make("SafeRover-v0")
    front, rear = (sw.constraints.Traction([f"{axle}_left", f"{axle}_right"]) for axle in ("front", "rear"))
    with pytest.raises(ConfigurationError, match="2 times"):
        sw.CBFActionFilter(env, [front, rear])


def test_an_env_without_a_model_is_refused():
    with pytest.raises(UnsupportedEnvError):
        sw.SlipLimiter(gym.make("Pendulum-v1"), wheels=["left"])
    plant = sw.AnalyticPlant(
        f=lambda x: x, g=lambda x: np.ones((1, 1)), state=lambda env: np.zeros(1), control_dt=0.05
    )
    with pytest.raises(UnsupportedEnvError, match="MujocoPlant"):
        sw.CBFActionFilter(gym.make("Pendulum-v1"), [sw.constraints.Traction(["left"])], plant)
