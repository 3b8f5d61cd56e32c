"""SpeedLimit: what the tasks publish, what a slider does by hand, and what its declarations refuse."""

import gymnasium as gym
import mujoco
import numpy as np
import pytest
from asking import asked
from hypothesis import assume, given
from hypothesis import strategies as st
from judged_loops import Scene, flagged, sliders

import safe_wrappers as sw
from safe_wrappers.envs import SPEED_LIMITS
from safe_wrappers.errors import ConfigurationError, UnknownNameError

PLANAR = ("Ant", "Humanoid")
robots = pytest.mark.parametrize("robot", SPEED_LIMITS)
averages = pytest.mark.parametrize("average", ["step", "substep"])


def watching(env, **options):
    """A limit that follows an env by itself, and its plant."""
    found = asked(env, sw.constraints.SpeedLimit(**{"limit": 50.0, "horizon": 1, **options}))
    return found, found.plant


# The speed that is meant --------------------------------------------------------------------------------------


@pytest.mark.parametrize("version", ["v5", "v4"])
@robots
def test_the_forecast_speed_is_the_one_that_the_task_judges(robot, version):
    env = gym.make(f"Safe{robot}Velocity-v0", version=version, disable_env_checker=True)
    plane = robot in PLANAR
    env.reset(seed=0)
    body = None if robot == "Humanoid" else "torso"
    limit, plant = watching(env, body=body, direction="xy" if plane else "+x")
    rng = np.random.default_rng(0)
    speeds, wrong = [], np.zeros(2)
    for _ in range(60):
        action = rng.uniform(env.action_space.low, env.action_space.high)
        plant.observe()
        present = limit.value()[0]
        if speeds and not plane:  # the step behind it is judged by the same measure
            assert 50.0 - present == pytest.approx(speeds[-1], abs=1e-12)
        forecast = plant.rollout(action)
        ahead = 50.0 - limit.h_along(forecast)
        assert ahead.shape == (1, 2)
        assert limit.slack(action) == pytest.approx(50.0 - ahead.max(), abs=1e-12)
        limit.executed(action)
        *_, terminated, _, info = env.step(action)
        wrong = np.maximum(wrong, np.abs(ahead[0] - info["speed"]))
        speeds.append(info["speed"])
        if terminated:
            env.reset()
            limit.start()
            speeds = []
    # Gymnasium reads Ant's and Humanoid's position from what MuJoCo has left behind, the others' from qpos.
    assert wrong[1 if plane else 0] < 1e-12
    assert wrong[0 if plane else 1] > 1e-4  # so that it matters which


WEIGHTS = (1.0, 3.0)
TWO = """<mujoco><option timestep="{timestep}" gravity="0 0 0"><flag contact="disable"/></option><worldbody>
<body name="b0"><joint name="x0" type="slide" axis="1 0 0"/><joint type="slide" axis="0 1 0"/>
<joint type="slide" axis="0 0 1"/><geom size=".1" mass="1" pos=".5 0 0"/></body>
<body name="b1" pos="0 1 0"><joint name="x1" type="slide" axis="1 0 0"/><geom size=".1" mass="3"/></body>
</worldbody><actuator>
<motor joint="x0" ctrlrange="-20 20"/><motor joint="x1" ctrlrange="-60 60"/></actuator></mujoco>"""
"""Four speeds (x, y, z of the first mass and x of the second); `v' = u / m`."""

MEASURES = {
    "+x": lambda v: v[..., 0],
    "-x": lambda v: -v[..., 0],
    "x": lambda v: np.abs(v[..., 0]),
    "+y": lambda v: v[..., 1],
    "-y": lambda v: -v[..., 1],
    "y": lambda v: np.abs(v[..., 1]),
    "+z": lambda v: v[..., 2],
    "-z": lambda v: -v[..., 2],
    "z": lambda v: np.abs(v[..., 2]),
    "xy": lambda v: np.hypot(v[..., 0], v[..., 1]),
    "xyz": lambda v: np.sqrt((v**2).sum(axis=-1)),
}


def velocities(v, u, timestep, substeps):
    """Of both bodies after each substep of a held control, shape (substeps, 2, 3), by hand."""
    t = timestep * np.arange(1, substeps + 1)
    out = np.zeros((substeps, 2, 3))
    out[:, 0] = v[:3]
    out[:, 0, 0] += t * u[0] / WEIGHTS[0]
    out[:, 1, 0] = v[3] + t * u[1] / WEIGHTS[1]
    return out


@given(
    v=st.lists(st.floats(-3.0, 3.0), min_size=4, max_size=4),
    u=st.lists(st.floats(-20.0, 20.0), min_size=2, max_size=2),
    direction=st.sampled_from(sorted(MEASURES)),
    average=st.sampled_from(["step", "substep"]),
    body=st.sampled_from(["b0", "b1", None]),
    margin=st.sampled_from([0.0, 0.3]),
    timing=st.sampled_from([(0.01, 5), (0.002, 10), (0.01, 1)]),
)
def test_a_control_is_admitted_by_the_speed_it_leads_to(v, u, direction, average, body, margin, timing):
    timestep, substeps = timing
    env = Scene(TWO.format(timestep=timestep), frame_skip=substeps)
    env.data.qvel[:] = v
    mujoco.mj_forward(env.model, env.data)
    limit, _ = watching(
        env, limit=2.0, body=body, direction=direction, average=average, margin=margin, horizon=1
    )
    both = velocities(v, u, timestep, substeps)
    weights = {"b0": (1.0, 0.0), "b1": (0.0, 1.0), None: np.array(WEIGHTS) / sum(WEIGHTS)}[body]
    moving = np.einsum("b,kbi->ki", np.asarray(weights), both)
    if average == "step":
        # from state to state, and what data.xpos shows after Euler steps: one substep less of it
        moving = np.stack([moving.mean(axis=0), moving[:-1].sum(axis=0) / substeps])
    left = 2.0 - margin - MEASURES[direction](moving).max()
    assume(abs(left) > 1e-7)
    assert limit.admits(np.array(u)) == (left > 0.0)
    assert limit.slack(np.array(u)) == pytest.approx(left, abs=1e-7)
    start = np.einsum("b,bi->i", np.asarray(weights), velocities(v, [0.0, 0.0], timestep, 1)[0])
    assert limit.value()[0] == pytest.approx(2.0 - MEASURES[direction](start), abs=1e-9)


@pytest.mark.parametrize(("timestep", "substeps"), [(0.01, 5), (0.002, 10), (0.005, 1), (0.01, 20)])
@averages
def test_units_do_not_slip_between_speed_and_displacement(average, timestep, substeps):
    env = Scene(TWO.format(timestep=timestep), frame_skip=substeps)
    limit = sw.constraints.SpeedLimit(1.5, body="b0", direction="x", average=average)
    filtered = sw.CBFActionFilter(env, [limit])
    filtered.reset(seed=0)
    position, fastest = 0.0, 0.0
    for k in range(60):
        action = np.array([20.0 if k < 40 else -20.0, 0.0])
        speeds = []
        for i in range(substeps):  # watched from outside: the env's own step, one substep at a time
            if i == 0:
                info = _filtered_control(filtered, action)
            mujoco.mj_step(env.model, env.data)
            speeds.append((env.data.qpos[0] - position) / timestep)
            position = float(env.data.qpos[0])
        judged = np.abs(np.mean(speeds) if average == "step" else np.array(speeds)).max()
        assert judged <= 1.5 + 1e-9 and not info.infeasible
        fastest = max(fastest, judged)
    assert fastest > 1.5 * 0.98


def _filtered_control(filtered, action):
    """What the filter would execute at the env's present state; it is set, not stepped."""
    filtered.filter.observe()
    decision = filtered.filter.filter(action)
    filtered.filter.executed(decision.control)
    filtered.unwrapped.data.ctrl[:] = decision.control
    return decision


def test_a_speed_that_is_kept_only_to_be_exceeded_next_is_refused_now():
    # Downhill at 5 m/s^2 with brakes for 1: every control step adds 0.2 m/s at least.
    admitted = {}
    for horizon in (1, 2, 3):
        env = sliders(range_="-1 1")
        env.model.opt.gravity[0] = 5.0
        env.data.qvel[0] = 0.6
        mujoco.mj_forward(env.model, env.data)
        limit, _ = watching(env, limit=1.0, direction="+x", horizon=horizon)
        admitted[horizon] = [limit.admits(np.array([u])) for u in (-1.0, 1.0)]
    # The averages of the next steps, braking: 0.72, 0.92, 1.12; at full throttle: 0.78, 1.0 + ...
    assert admitted == {1: [True, True], 2: [True, False], 3: [False, False]}


# Closed loops, and forecasts that are spared ------------------------------------------------------------------


def launched(robot, speed, **options):
    """A task whose robot already runs, in the filter of the recipe's limit."""
    env = gym.make(f"Safe{robot}Velocity-v0", disable_env_checker=True)
    limit = {"limit": SPEED_LIMITS[robot], "body": "torso", "direction": "+x", "margin": 0.02, **options}
    filtered = sw.CBFActionFilter(env, [sw.constraints.SpeedLimit(**limit)])
    filtered.reset(seed=0)
    env.unwrapped.data.qvel[0] = speed
    return filtered


@pytest.mark.parametrize("robot", ["HalfCheetah", "Walker2d", "Swimmer"])
def test_an_executed_control_that_is_not_flagged_costs_nothing(robot):
    filtered = launched(robot, 0.95 * SPEED_LIMITS[robot])
    rng = np.random.default_rng(0)
    refused = 0
    for _ in range(60):
        action = rng.choice([-1.0, 1.0], filtered.action_space.shape).astype(np.float32)
        *_, terminated, _, info = filtered.step(action)
        assert info["cost"] == 0.0 or flagged(info)
        refused += info["cbf/refused"].any()
        if terminated:
            break
    assert refused > 0


def test_a_control_that_leaves_enough_is_admitted_without_a_look_ahead():
    # The hill again: 0.28 m/s are left after the own step of the brakes, 0.22 after full throttle's.
    for gate, admitted in (
        (None, [False, False]),
        (0.3, [False, False]),
        (0.25, [True, False]),
        (0.2, [True, True]),
    ):
        env = sliders(range_="-1 1")
        env.model.opt.gravity[0] = 5.0
        env.data.qvel[0] = 0.6
        mujoco.mj_forward(env.model, env.data)
        limit, _ = watching(env, limit=1.0, direction="+x", horizon=3, look_ahead_below=gate)
        assert [limit.admits(np.array([u])) for u in (-1.0, 1.0)] == admitted
    for wrong in (0.0, -1.0, np.nan):
        with pytest.raises(ConfigurationError, match="look_ahead_below must be"):
            sw.constraints.SpeedLimit(1.0, look_ahead_below=wrong)


# Plain data, and what is refused ------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("arguments", "error", "message"),
    [
        ({"limit": 0.0}, ConfigurationError, "limit must be a finite number > 0 in m/s, got 0.0"),
        ({"limit": "fast"}, ConfigurationError, "limit must be a number in m/s, got 'fast'"),
        ({"limit": 1.0, "direction": ""}, UnknownNameError, "no direction ''; choose"),
        ({"limit": 1.0, "body": "belly"}, UnknownNameError, "no body 'belly'; it has: world, torso"),
    ],
)
def test_nonsense_is_refused_with_the_options(arguments, error, message):
    with pytest.raises(error, match=message):
        sw.CBFActionFilter(gym.make("HalfCheetah-v5"), [sw.constraints.SpeedLimit(**arguments)])
