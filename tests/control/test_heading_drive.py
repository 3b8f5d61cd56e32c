"""The heading drive: its prediction is MuJoCo's, its stopping area holds MuJoCo's braking, its distance is right."""

import math

import gymnasium as gym
import mujoco
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import safe_wrappers as sw
from safe_wrappers.control.backup.heading_drive import (
    Motion,
    StoppingPath,
    brake_control,
    end_distance,
    path_distance,
    predict,
    stopping_path,
)
from safe_wrappers.plants.mujoco.planar_robot import heading_drive


def robot(level=0, uncertainty=0.0):
    """Env, plant and constants."""
    env = gym.make(f"SafePointGoal{level}-v0").unwrapped
    layout = {"goal": [900.0, 900.0]} if level == 0 else {}
    env.reset(seed=0, options={"layout": {**layout}} if layout else None)
    plant = sw.MujocoPlant()
    plant.bind(env)
    return env, plant, heading_drive(plant, "agent", uncertainty)


def place(env, motion):
    qpos, qvel = env.data.qpos.copy(), env.data.qvel.copy()
    qpos[:3], qvel[:3] = motion[:3], motion[3:]
    env.set_state(qpos, qvel)


def now(env):
    return Motion(*env.data.qpos[:3].tolist(), *env.data.qvel[:3].tolist())


def random_motion(rng, speed=1.3, yaw=3.0):
    direction = rng.uniform(-math.pi, math.pi)
    v = speed * rng.uniform() ** 0.5
    return Motion(
        *rng.uniform(-1, 1, 2),
        rng.uniform(-math.pi, math.pi),
        v * math.cos(direction),
        v * math.sin(direction),
        rng.uniform(-yaw, yaw),
    )


def test_prediction_is_mujocos_own_step():
    env, _, drive = robot()
    rng = np.random.default_rng(0)
    for _ in range(200):
        motion, action = random_motion(rng), rng.uniform(-1, 1, 2)
        if rng.uniform() < 0.3:
            action *= 0.04  # inside the drive's clamp
        place(env, motion)
        env.step(action)
        np.testing.assert_allclose(now(env), predict(drive, motion, *action), atol=1e-9)


def backup(drive, motion):
    ahead = motion.vx * math.cos(motion.heading) + motion.vy * math.sin(motion.heading)
    return np.array([brake_control(drive, ahead), 0.0])


def excursion(drive, truth, yaw=0.0, speed=1.3, runs=12, seed=4):
    """How far a machine gets out of the area while it runs the backup manoeuvre, m."""
    rng = np.random.default_rng(seed)
    worst = -math.inf
    for _ in range(runs):
        motion = random_motion(rng, speed, yaw)
        place(truth, motion)
        path = stopping_path(drive, motion)
        for _ in range(150):
            truth.step(backup(drive, now(truth)))
            worst = max(worst, *(path_distance(path, float(x), float(y)) for x, y in truth._path))
    return worst


@pytest.mark.parametrize("speed", [0.7, 1.0, 1.3])
def test_the_area_holds_mujocos_stopping_path(speed):
    # The drag's torque about the axis turns the heading by up to 0.02 rad while sliding: `wander` covers it.
    env, _, drive = robot()
    assert excursion(drive, env, speed=speed, runs=25) <= 1e-3


def test_the_area_holds_the_stopping_path_while_turning():
    env, _, drive = robot()
    assert excursion(drive, env, yaw=2.0, speed=0.7) <= 2e-3 + 2 * drive.com_offset
    assert excursion(drive, env, yaw=2.0, speed=0.7) <= 8e-3


@pytest.mark.parametrize("mass", [0.8, 1.2])
@pytest.mark.parametrize("damping", [0.8, 1.2])
def test_the_area_holds_every_machine_inside_the_uncertainty(mass, damping):
    # The constants are the nominal ones; the machine that brakes is another.
    drive = robot(uncertainty=0.2)[2]
    truth = robot()[0]
    truth.model.body_mass *= mass
    truth.model.body_inertia *= mass
    truth.model.dof_damping *= damping
    mujoco.mj_setConst(truth.model, mujoco.MjData(truth.model))
    assert excursion(drive, truth, speed=0.7) <= 4e-3
    if mass > damping:  # and without the uncertainty it does not
        assert excursion(robot()[2], truth, speed=0.7) > 2e-2


# Distance to the area -----------------------------------------------------------------------------------------

LENGTH = st.floats(0.0, 1.0).map(lambda v: round(v, 3))


def polygon_distance(corners, point):
    """Signed distance to a convex polygon by dense sampling of its sides and a half-plane test."""
    n = len(corners)
    sides = [np.linspace(corners[i], corners[(i + 1) % n], 2001) for i in range(n)]
    near = min(float(np.linalg.norm(side - point, axis=1).min()) for side in sides)
    crosses = [
        (b[0] - a[0]) * (point[1] - a[1]) - (b[1] - a[1]) * (point[0] - a[0])
        for a, b in zip(corners, np.roll(corners, -1, axis=0), strict=True)
    ]
    area = sum(a[0] * b[1] - a[1] * b[0] for a, b in zip(corners, np.roll(corners, -1, axis=0), strict=True))
    inside = all(c >= 0 for c in crosses) or all(c <= 0 for c in crosses)
    return (-near if inside and abs(area) > 1e-12 else near), near


@given(
    LENGTH,
    LENGTH,
    st.floats(0, 1),
    st.booleans(),
    st.floats(-3, 3),
    st.floats(-1.5, 1.5),
    st.floats(-1.5, 1.5),
)
def test_distance_agrees_with_brute_force(forward, sideways, share, spread, angle, px, py):
    # The crossing lies at or below the end, as the tangent does.
    e, s = np.array([math.cos(angle), math.sin(angle)]), np.array([-math.sin(angle), math.cos(angle)])
    crossing = round(share, 3) * sideways
    fields = dict(
        x=0.1, y=-0.2, ex=e[0], ey=e[1], sx=s[0], sy=s[1],
        forward=forward, sideways=sideways, crossing=crossing, spread=spread,
    )  # fmt: skip
    fields["radius"] = math.hypot(forward, sideways)
    path = StoppingPath(**fields)
    start = np.array([0.1, -0.2])
    area = [start, start + forward * e + crossing * s, start + forward * e + sideways * s]
    if spread:
        area.append(start + sideways * s)
    expected, near = polygon_distance(np.array(area), np.array([px, py]))
    if near < 1e-3:  # on the boundary the sampling decides the sign
        assert abs(path_distance(path, px, py)) < 2e-3
    else:
        assert path_distance(path, px, py) == pytest.approx(expected, abs=1e-3)
    assert end_distance(path, px, py) == pytest.approx(np.linalg.norm(area[2] - [px, py]))
    assert path.radius >= max(np.linalg.norm(c - start) for c in area) - 1e-12


def test_refusals_name_what_does_not_fit():
    _, plant, _ = robot()
    plant.model.dof_damping[0] = 0.02
    with pytest.raises(
        sw.SafeWrappersError, match="'agent' is no heading drive: the slides need equal damping"
    ):
        heading_drive(plant, "agent")
    _, plant, _ = robot()
    plant.model.opt.integrator = int(mujoco.mjtIntegrator.mjINT_RK4)
    with pytest.raises(sw.SafeWrappersError, match="the integrator must be Euler"):
        heading_drive(plant, "agent")
    _, plant, _ = robot()
    plant.model.body_ipos[plant.named("body", "agent"), 1] = 0.01
    with pytest.raises(sw.SafeWrappersError, match="the centre of mass must lie on the heading"):
        heading_drive(plant, "agent")
    ant = sw.MujocoPlant()
    ant.bind(gym.make("Ant-v5"))
    with pytest.raises(sw.SafeWrappersError, match="'torso' must slide along world x and y"):
        heading_drive(ant, "torso")
