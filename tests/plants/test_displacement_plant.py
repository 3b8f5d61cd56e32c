"""DisplacementPlant against gymnasium-robotics' Fetch envs themselves: their own step, to the last bit."""

import gymnasium as gym
import mujoco
import numpy as np
import pytest

import safe_wrappers as sw
from safe_wrappers.errors import ConfigurationError, UnsupportedEnvError
from safe_wrappers.plants.default import default_plant

gym.register_envs(pytest.importorskip("gymnasium_robotics"))

ENVS = ["FetchReach-v4", "FetchPush-v4", "FetchSlide-v4", "FetchPickAndPlace-v4"]
every_env = pytest.mark.parametrize("env_id", ENVS)


def bound(env, **options):
    plant = sw.plants.DisplacementPlant(**options)
    plant.bind(env)
    return plant


def actions(seed, steps, down=0.3):
    """Random ones, corners held for a while, and dives into the table and whatever lies on it."""
    rng = np.random.default_rng(seed)
    held = np.ones(4)
    for k in range(steps):
        if k % 12 == 0:
            held = np.where(rng.random(4) < 0.5, -1.0, 1.0)
            held[2] = -1.0 if rng.random() < down else held[2]
        yield (rng.uniform(-1.0, 1.0, 4) if k % 3 == 2 else held).astype(np.float32)


def watched(raw):
    """Positions and velocities after every physics substep of the env's own next step."""
    seen = []

    def step(action):
        for _ in range(raw.n_substeps):
            mujoco.mj_step(raw.model, raw.data)
            seen.append((raw.data.qpos.copy(), raw.data.qvel.copy()))

    raw._mujoco_step = step
    return seen


def inputs(data):
    """What the env has set, and where MuJoCo has the bodies: what the next step starts from beside the state."""
    return [a.copy() for a in (data.mocap_pos, data.mocap_quat, data.ctrl, data.xpos[1:], data.xquat[1:])]


# Forecasts ----------------------------------------------------------------------------------------------------


@every_env
def test_every_substep_is_the_envs_own_to_the_last_bit(env_id):
    env = gym.make(env_id, max_episode_steps=35)
    raw, plant = env.unwrapped, bound(env)
    seen = watched(raw)
    over, episode = True, 0
    for k, action in enumerate(actions(0, 80)):
        if over:
            env.reset(seed=episode)
            episode += 1
        plant.observe()
        control = action.astype(np.float64)
        if k % 3 == 1:  # other questions between do not disturb it
            plant.pose(), plant.forecast(-control), plant.forward(), plant.braking()
        if k % 5 == 0:
            plant.forecast(control)
            expected = inputs(plant.data)
        forecast = plant.forecast(control, horizon=2)
        seen.clear()
        *_, over, _ = env.step(action)
        n = raw.n_substeps
        # Not the last one: the env closes the fingers after it.
        assert all(np.array_equal(forecast.qpos[i], seen[i][0]) for i in range(n - 1))
        assert all(np.array_equal(forecast.qvel[i], seen[i][1]) for i in range(n))
        assert np.array_equal(forecast.qpos[n - 1], raw.data.qpos)
        assert np.array_equal(forecast.published_frames[0][1:], raw.data.xpos[1:])
        if k % 5 == 0:
            assert all(np.array_equal(a, b) for a, b in zip(expected, inputs(raw.data), strict=True))


@pytest.mark.slow
@every_env
def test_long_episodes_are_the_envs_own_to_the_last_bit(env_id):
    env = gym.make(env_id, max_episode_steps=1000)
    plant = bound(env)
    for episode in range(3):
        env.reset(seed=episode)
        for action in actions(episode, 1000, down=0.2 * episode):
            plant.observe()
            forecast = plant.forecast(action.astype(np.float64))
            env.step(action)
            assert np.array_equal(forecast.qpos[-1], env.unwrapped.data.qpos)
            assert np.array_equal(forecast.qvel[-1], env.unwrapped.data.qvel)


@every_env
def test_after_the_held_action_a_forecast_brakes_as_steps_of_zero_do(env_id):
    env = gym.make(env_id)
    plant, data = bound(env), env.unwrapped.data
    env.reset(seed=0)
    for action in actions(1, 6):
        env.step(action)
    plant.observe()
    action = np.array([1.0, -0.4, -0.2, 0.7], dtype=np.float32)
    forecast = plant.forecast(action.astype(np.float64), horizon=4)
    assert np.array_equal(plant.braking(), np.zeros(4))
    for hold in range(4):
        env.step(action if hold == 0 else np.zeros(4, np.float32))
        end = (hold + 1) * plant.substeps - 1
        assert np.array_equal(forecast.qpos[end], data.qpos) and np.array_equal(forecast.qvel[end], data.qvel)


def test_what_a_rendering_env_does_to_its_poses_is_seen():
    # PickAndPlace's poses lag a substep behind after a step; rendering calls mj_forward, and the next step starts
    # from the newer pose.
    env = gym.make("FetchPickAndPlace-v4")
    raw, plant = env.unwrapped, bound(env)
    env.reset(seed=0)
    ends = []
    for forward in (False, True):
        env.reset(seed=0)
        for action in actions(2, 5):
            env.step(action)
        if forward:
            raw._render_callback()
        plant.observe()
        forecast = plant.forecast(np.ones(4))
        env.step(np.ones(4, np.float32))
        assert np.array_equal(forecast.qpos[-1], raw.data.qpos)
        ends.append(raw.data.qpos.copy())
    assert not np.array_equal(*ends)


def test_nothing_is_written_to_the_env():
    env = gym.make("FetchPush-v4")
    raw, plant = env.unwrapped, bound(env)
    env.reset(seed=0)
    kept = mujoco.MjData(raw.model)
    mujoco.mj_copyData(kept, raw.model, raw.data)
    plant.observe()
    plant.forecast(np.ones(4), 3), plant.forward(), plant.under(-np.ones(4)), plant.path(np.zeros(4))
    for name in (
        "qpos",
        "qvel",
        "ctrl",
        "mocap_pos",
        "mocap_quat",
        "xpos",
        "xquat",
        "qacc_warmstart",
        "qacc",
    ):
        assert np.array_equal(getattr(kept, name), getattr(raw.data, name)), name


def test_actions_in_double_precision_are_taken_as_the_env_is_promised_them():
    env = gym.make("FetchReach-v4")
    plant = bound(env)
    env.reset(seed=0)
    plant.observe()
    action = np.array([1.0, 1.0, -1.0, 0.0]) / 3.0
    forecast = plant.forecast(action)
    env.step(action)  # float64: the env keeps it
    assert np.abs(forecast.qpos[-1] - env.unwrapped.data.qpos).max() < 1e-8


def test_a_blocked_gripper_takes_no_command_and_costs_no_forecast():
    env = gym.make("FetchReach-v4")
    plant = bound(env)
    env.reset(seed=0)
    plant.observe()
    assert plant.blocked and plant.gripper == "robot0:gripper_link"
    assert plant.forecast(np.array([1.0, 0.0, 0.0, 1.0])) is plant.forecast(np.array([1.0, 0.0, 0.0, -1.0]))
    open_env = gym.make("FetchPickAndPlace-v4")
    other = bound(open_env)
    open_env.reset(seed=0)
    other.observe()
    closed, opened = (other.forecast(np.array([0.0, 0.0, 0.0, f])).qpos[-1] for f in (-1.0, 1.0))
    assert not other.blocked and np.abs(closed - opened).max() > 1e-3


# Other masses, delays -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("bound_first", [False, True])
def test_a_plant_with_other_masses_forecasts_another_motion(bound_first):
    env = gym.make("FetchReach-v4")
    plant = sw.plants.DisplacementPlant()
    if bound_first:
        plant.bind(env)
    plant.perturb(mass=1.5, damping=0.5)
    if not bound_first:
        plant.bind(env)
    true = bound(env)
    env.reset(seed=0)
    for one in (plant, true):
        one.observe()
    apart = np.abs(plant.forecast(np.ones(4)).qpos[-1] - true.forecast(np.ones(4)).qpos[-1]).max()
    assert 1e-4 < apart < 0.1
    assert plant.model.body_mass.sum() == pytest.approx(1.5 * env.unwrapped.model.body_mass.sum())


class Late(gym.ActionWrapper):
    """Actions arrive so many steps late; until the first has, nothing moves."""

    def __init__(self, env, steps):
        super().__init__(env)
        self.late = steps

    def reset(self, **options):
        self.queue = [np.zeros(4, np.float32)] * self.late
        return super().reset(**options)

    def action(self, action):
        self.queue.append(action)
        return self.queue.pop(0)


@pytest.mark.parametrize("steps", [1, 3])
@pytest.mark.parametrize("env_id", ["FetchReach-v4", "FetchPickAndPlace-v4"])
def test_under_a_delay_it_is_where_the_commands_in_flight_lead(env_id, steps):
    env = gym.make(env_id)
    plant = bound(env, delay_s=steps * 0.04)
    late = Late(env, steps)
    late.reset(seed=0)
    plant.executed(None)
    sent, predicted = list(actions(3, 14)), []
    data = env.unwrapped.data
    for k, action in enumerate(sent):
        plant.observe()
        predicted.append((plant.qpos.copy(), plant.forecast(action.astype(np.float64)).qpos[-1]))
        if k >= steps:  # the state that it foresaw so many steps ago
            assert np.array_equal(predicted[k - steps][0], data.qpos)
        if k > steps:
            assert np.array_equal(predicted[k - steps - 1][1], data.qpos)
        late.step(action)
        plant.executed(action.astype(np.float64))


def test_another_scale_is_declared():
    env = gym.make("FetchReach-v4")
    raw = env.unwrapped
    whole = raw._set_action
    raw._set_action = lambda action: whole((0.5 * action).astype(np.float32))
    plant = bound(env, metres_per_unit=0.025)
    env.reset(seed=0)
    plant.observe()
    forecast = plant.forecast(np.array([1.0, -0.5, 0.25, 0.0]))
    env.step(np.array([1.0, -0.5, 0.25, 0.0], np.float32))
    assert np.abs(forecast.qpos[-1] - raw.data.qpos).max() < 1e-8


# Braking ------------------------------------------------------------------------------------------------------


def test_no_displacement_stops_the_gripper_within_one_interval():
    env = gym.make("FetchReach-v4")
    plant = bound(env)
    gripper = plant.model.body("robot0:gripper_link").id
    rng = np.random.default_rng(0)
    for seed in range(8):
        env.reset(seed=seed)
        way = rng.normal(size=3)
        action = np.append(way / np.abs(way).max(), 0.0).astype(np.float32)
        for _ in range(2):
            env.step(action)
        plant.observe()
        places = plant.forecast(action.astype(np.float64), horizon=3).poses().frames[:, gripper]
        end = plant.substeps
        speed = np.linalg.norm(places[end - 1] - places[end - 2]) / 0.002
        onwards = (places[end:] - places[end - 1]) @ (action[:3] / np.linalg.norm(action[:3]))
        left = np.linalg.norm(places[-1] - places[2 * end - 1]) / plant.control_dt
        assert 0.55 < speed < 1.05
        assert 0.003 < onwards.max() < 0.007
        assert left < 0.03


# What it is not -----------------------------------------------------------------------------------------------


def test_it_has_no_accelerations():
    env = gym.make("FetchReach-v4")
    plant = bound(env)
    env.reset(seed=0)
    plant.observe()
    asked = [
        lambda: plant.f,
        lambda: plant.g,
        lambda: plant.acceleration,
        lambda: plant.point("site", "robot0:grip"),
    ]
    for ask in asked:
        with pytest.raises(UnsupportedEnvError, match=r"an action is a displacement.*Workspace"):
            ask()
    place, velocity = plant.motion("site", "robot0:grip")
    assert np.allclose(place, env.unwrapped.initial_gripper_xpos, atol=1e-4) and np.abs(velocity).max() < 0.01


@pytest.mark.parametrize("constraint", [
    sw.constraints.Barrier(lambda x: 1.0 - x[0], alpha=1.0),
    sw.constraints.Clearance(
        [sw.constraints.Plane([0.0, 0.0, 0.45], [0.0, 0.0, 1.0])], braking=5.0, bodies=["robot0:gripper_link"]
    ),
    sw.constraints.ImpactSpeedLimit(["robot0:l_gripper_finger_link"], ["table0"], force_limit=50.0, stiffness=1e4),
    sw.constraints.TrackPermission("robot0:gripper_link", braking=1.0),
])  # fmt: skip
def test_constraints_that_need_accelerations_are_refused_when_the_filter_is_built(constraint):
    name = type(constraint).__name__
    with pytest.raises(UnsupportedEnvError, match=f"{name} needs the acceleration .* Workspace, Joint"):
        sw.CBFActionFilter(gym.make("FetchReach-v4"), [constraint])


@every_env
def test_it_is_what_a_fetch_env_gets_when_no_plant_is_named(env_id):
    assert type(default_plant(gym.make(env_id))) is sw.plants.DisplacementPlant
    assert type(default_plant(gym.make("Reacher-v5"))) is sw.MujocoPlant


def test_other_envs_and_other_plants_are_refused():
    with pytest.raises(UnsupportedEnvError, match=r"not moved by displacements.*take MujocoPlant"):
        bound(gym.make("Reacher-v5"))
    with pytest.raises(UnsupportedEnvError, match=r"take DisplacementPlant\(\)"):
        sw.MujocoPlant().bind(gym.make("FetchReach-v4"))


@pytest.mark.parametrize("options, message", [
    ({"delay_s": 0.05}, r"delay_s = 0.05 s is not a whole number of control intervals of 0.04 s"),
    ({"delay_s": -0.04}, "delay_s must be a finite number >= 0 in s"),
    ({"delay_s": "soon"}, "delay_s must be a number in s, got 'soon'"),
    ({"metres_per_unit": 0.0}, "metres_per_unit must be a finite number > 0 in m per unit of action, got 0.0"),
    ({"metres_per_unit": np.nan}, "metres_per_unit must be a finite number > 0 .* got nan"),
    ({"metres_per_unit": "far"}, "metres_per_unit must be a number .* got 'far'"),
])  # fmt: skip
def test_nonsense_is_refused(options, message):
    with pytest.raises(ConfigurationError, match=message):
        bound(gym.make("FetchReach-v4"), **options)
