"""SpeedLimit and Workspace: what the tasks publish, MuJoCo's own points, and sliders and bounds by hand."""

import gymnasium as gym
import mujoco
import numpy as np
import pytest
from asking import asked
from hypothesis import assume, given
from hypothesis import strategies as st
from judged_loops import slider
from scenes import Scene

from safe_wrappers import constraints as of
from safe_wrappers.envs import SPEED_LIMITS

PLANAR = ("Ant", "Humanoid")


def watching(env, **options):
    """A limit that follows an env by itself, and its plant."""
    found = asked(env, of.SpeedLimit(**{"limit": 50.0, "horizon": 1, **options}))
    return found, found.plant


@pytest.mark.parametrize("robot", SPEED_LIMITS)
def test_the_forecast_speed_is_the_one_that_the_task_judges(robot):
    env = gym.make(f"Safe{robot}Velocity-v0", disable_env_checker=True)
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

DIRECTIONS = [sign + axis for axis in "xyz" for sign in ("+", "-", "")] + ["xy", "xyz"]


def measured(direction, velocity):
    """Of velocities, shape (..., 3)."""
    if direction[0] in "+-":
        return float(direction[0] + "1") * velocity[..., "xyz".index(direction[1])]
    return np.linalg.norm(velocity[..., ["xyz".index(axis) for axis in direction]], axis=-1)


def velocities(v, u, timestep, substeps):
    """Of both bodies after each substep of a held control, shape (substeps, 2, 3), by hand."""
    t = timestep * np.arange(1, substeps + 1)
    still = 0.0 * t
    first = np.stack([v[0] + t * u[0] / WEIGHTS[0], v[1] + still, v[2] + still], axis=1)
    return np.stack([first, np.stack([v[3] + t * u[1] / WEIGHTS[1], still, still], axis=1)], axis=1)


@given(
    v=st.lists(st.floats(-3.0, 3.0), min_size=4, max_size=4),
    u=st.lists(st.floats(-20.0, 20.0), min_size=2, max_size=2),
    direction=st.sampled_from(DIRECTIONS),
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
    left = 2.0 - margin - measured(direction, moving).max()
    assume(abs(left) > 1e-7)
    assert limit.admits(np.array(u)) == (left > 0.0)
    assert limit.slack(np.array(u)) == pytest.approx(left, abs=1e-7)
    start = np.einsum("b,bi->i", np.asarray(weights), velocities(v, [0.0, 0.0], timestep, 1)[0])
    assert limit.value()[0] == pytest.approx(2.0 - measured(direction, start), abs=1e-9)


@pytest.mark.parametrize(("average", "speed"), [("step", 0.3), ("substep", 0.5)])
def test_the_present_speed_is_that_of_the_last_step_or_substep(average, speed):
    env = slider(10.0)  # from rest, at 10 m/s^2: 0.1 m/s more in every substep
    limit, plant = watching(env, average=average, body="b0", direction="+x")
    assert limit.value()[0] == pytest.approx(50.0)
    limit.executed(np.full(1, 10.0))
    env.step(np.full(1, 10.0))
    plant.observe()
    assert limit.value()[0] == pytest.approx(50.0 - speed)


def downhill(**options):
    """Whether brakes and full throttle are admitted at 0.6 m/s where a control step adds 0.2 m/s at the least."""
    env = slider()
    env.model.opt.gravity[0] = 5.0
    env.data.qvel[0] = 0.6
    mujoco.mj_forward(env.model, env.data)
    limit, _ = watching(env, limit=1.0, direction="+x", **options)
    return [limit.admits(np.array([u])) for u in (-1.0, 1.0)]


def test_a_speed_that_is_kept_only_to_be_exceeded_next_is_refused_unless_enough_is_left():
    # The averages of the next steps, braking: 0.72, 0.92, 1.12; at full throttle: 0.78, 1.0 + ...
    admitted = {horizon: downhill(horizon=horizon) for horizon in (1, 2, 3)}
    assert admitted == {1: [True, True], 2: [True, False], 3: [False, False]}
    # 0.28 m/s are left after the own step of the brakes, 0.22 after full throttle's.
    admitted = {gate: downhill(horizon=3, look_ahead_below=gate) for gate in (0.3, 0.25, 0.2)}
    assert admitted == {0.3: [False, False], 0.25: [True, False], 0.2: [True, True]}


# Workspace --------------------------------------------------------------------------------------------------

ARM = """<mujoco><option timestep="0.01"/><worldbody><body name="upper" pos="0 0 1" quat=".9 .1 .3 .2">
<joint name="a" axis="0 1 0"/>
<geom name="bone" type="capsule" fromto="0 0 0 .3 .1 0" size=".02"/>
<body name="lower" pos=".3 .1 0" euler="20 30 40"><joint name="b" axis=".3 0 1"/><joint name="c" axis="1 0 0"/>
<geom name="shin" type="box" pos=".1 .05 .02" quat=".5 .5 .1 .2" size=".05 .02 .03"/>
<site name="tip" pos=".2 -.1 .05" euler="10 0 70"/></body></body></worldbody>
<actuator><motor joint="a" ctrlrange="-1 1"/><motor joint="b" ctrlrange="-1 1"/></actuator></mujoco>"""
"""Frames that are turned against each other: bodies, geoms off their body's origin, a site."""


def test_bodies_sites_and_geoms_are_where_mujoco_has_them_now_and_ahead():
    env = Scene(ARM)
    names = {"bodies": ["lower", "upper"], "sites": ["tip"], "geoms": ["bone", "shin"]}
    limit = asked(env, of.Workspace(low=[0.0, 0.0, 0.0], horizon=2, **names))
    rng, truth = np.random.default_rng(0), mujoco.MjData(env.model)

    def true_points(qpos):
        truth.qpos[:] = qpos
        mujoco.mj_forward(env.model, truth)
        bodies, geoms = map(truth.body, names["bodies"]), map(truth.geom, names["geoms"])
        return np.array([one.xpos for one in (*bodies, truth.site("tip"), *geoms)])

    for _ in range(10):
        env.data.qpos[:], env.data.qvel[:] = rng.uniform(-3.0, 3.0, (2, 3))
        limit.plant.observe()
        np.testing.assert_allclose(limit.value().reshape(5, 3), true_points(env.data.qpos), atol=1e-12)
        forecast = limit.plant.rollout(rng.uniform(-1.0, 1.0, 2), 2)
        room = limit.h_along(forecast)
        assert room.shape == (10, 15)
        for left, qpos in zip(room, forecast.qpos, strict=True):
            np.testing.assert_allclose(left.reshape(5, 3), true_points(qpos), atol=1e-12)


def test_every_bound_that_there_is_and_every_obstacle_counts_by_itself():
    env = Scene(ARM)
    env.data.qpos[:] = [0.4, -0.7, 0.2]
    mujoco.mj_forward(env.model, env.data)
    both = np.array([env.data.site("tip").xpos, env.data.geom("bone").xpos])

    def left(**arguments):
        return asked(env, of.Workspace(sites=["tip"], geoms=["bone"], **arguments)).value()

    np.testing.assert_allclose(left(low=[-1.0, None, None]), both[:, 0] + 1.0)
    expected = np.concatenate([both[:, 1] + 1.0, ([2.0, 3.0] - both[:, [0, 2]]).ravel()]) - 0.1
    np.testing.assert_allclose(left(low=[None, -1.0, None], high=[2.0, None, 3.0], radius=0.1), expected)
    obstacles = [
        (of.Disc([0.1, 0.2], 0.05), np.linalg.norm(both[:, :2] - [0.1, 0.2], axis=1) - 0.05),
        (of.Sphere([0.1, 0.2, 0.9], 0.05), np.linalg.norm(both - [0.1, 0.2, 0.9], axis=1) - 0.05),
        (of.Plane([0.0, 0.0, 0.5], [0.0, 3.0, 4.0]), 0.6 * both[:, 1] + 0.8 * (both[:, 2] - 0.5)),
        (of.Box([9.0, 0.0, 0.0], [1.0, 99.0, 99.0]), 8.0 - both[:, 0]),
    ]
    keep_out, distances = zip(*obstacles, strict=True)
    np.testing.assert_allclose(left(keep_out=keep_out, radius=0.01), np.concatenate(distances) - 0.01)
