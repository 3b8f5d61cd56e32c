"""The heading drive: its steps, and what they leave of discs until it rests, are MuJoCo's."""

import hashlib
import math

import gymnasium as gym
import mujoco
import numpy as np
import pytest

import safe_wrappers as sw
from safe_wrappers.control.backup.heading_drive import (
    REST_M,
    Motion,
    advance,
    brake_control,
    clearances,
    look,
)
from safe_wrappers.plants.mujoco.planar_robot import heading_drive


def robot():
    """Env, plant and constants."""
    env = gym.make("SafePointGoal0-v0").unwrapped
    env.reset(seed=0, options={"layout": {"goal": [900.0, 900.0]}})
    plant = sw.MujocoPlant()
    plant.bind(env)
    return env, plant, heading_drive(plant, "agent")


def place(env, motion):
    qpos, qvel = env.data.qpos.copy(), env.data.qvel.copy()
    qpos[:3], qvel[:3] = motion[:3], motion[3:]
    env.set_state(qpos, qvel)


def now(env):
    return Motion(*env.data.qpos[:3].tolist(), *env.data.qvel[:3].tolist())


def random_motion(rng, yaw=3.0):
    direction, speed = rng.uniform(-math.pi, math.pi), 1.3 * rng.uniform() ** 0.5
    place = *rng.uniform(-1, 1, 2), rng.uniform(-math.pi, math.pi)
    return Motion(*place, speed * math.cos(direction), speed * math.sin(direction), rng.uniform(-yaw, yaw))


def played(env, drive, control):
    """The places after each physics step of a control step, by MuJoCo."""
    places, env.data.ctrl[:] = [], control
    for _ in range(drive.substeps):
        mujoco.mj_step(env.model, env.data)
        places.append(env.data.qpos[:2].copy())
    return np.array(places)


def test_prediction_is_mujocos_own_step():
    env, _, drive = robot()
    rng, places = np.random.default_rng(0), np.empty((drive.substeps, 2))
    for k in range(200):
        motion, action = random_motion(rng), rng.uniform(-1, 1, 2) * (0.04 if k % 3 == 0 else 1.0)
        place(env, motion)  # every third inside the drive's clamp
        predicted = advance(drive, motion, *action, places)
        np.testing.assert_allclose(places, played(env, drive, action), atol=1e-9)
        np.testing.assert_allclose(predicted, now(env), atol=1e-9)


@pytest.mark.parametrize("control", [None, (1.0, 1.0), (-0.03, -0.4)])
def test_clearances_are_those_of_mujocos_steps_until_it_rests(control):
    env, _, drive = robot()
    rng, models = np.random.default_rng(4), np.array([drive], dtype=np.float64)
    for _ in range(5):
        motion, discs = random_motion(rng), np.column_stack([rng.uniform(-1.2, 1.2, (6, 2)), np.full(6, 0.1)])
        place(env, motion)
        first = control or (brake_control(drive, motion), 0.0)
        least, end = clearances(models, np.array(motion), *first, discs, True)
        path = [np.array([motion[:2]]), played(env, drive, first)]
        path += [played(env, drive, (brake_control(drive, now(env)), 0.0)) for _ in range(299)]
        seen = np.linalg.norm(np.concatenate(path)[:, None] - discs[:, :2], axis=2).min(axis=0) - 0.1
        x, y, heading = now(env)[:3]
        com = x + drive.com_offset * math.cos(heading), y + drive.com_offset * math.sin(heading)
        turning = np.linalg.norm(discs[:, :2] - com, axis=1) - 0.1 - drive.com_offset
        # What is not followed to its very end is a lower bound.
        lost = np.minimum(seen, turning) - least
        assert (lost >= -1e-6).all() and (lost <= 2.0 * REST_M).all()
        np.testing.assert_allclose(end, turning, atol=2.0 * REST_M)
        again = clearances(models, np.array(motion), *first, discs, False)[0]
        np.testing.assert_allclose(again, least, atol=REST_M)


def test_what_an_uncertain_machine_leaves_is_told_of_each_model_apart():
    drive, rng = robot()[2], np.random.default_rng(5)
    models = np.array([drive, *drive.corners(0.25)], dtype=np.float64)
    for _ in range(10):
        given = np.array(random_motion(rng)), *rng.uniform(-1.0, 1.0, 2)
        discs = np.column_stack([rng.uniform(-1.2, 1.2, (6, 2)), np.full(6, 0.1)])
        every = clearances(models, *given, discs, True)
        alone = clearances(models[:1], *given, discs, True)
        others = [clearances(models[[0, i]], *given, discs, True)[:, 6:] for i in range(1, len(models))]
        np.testing.assert_array_equal(every, np.concatenate([alone, *others], axis=1))
        assert (others != alone).any()


def random_scenes(count):
    """What is seen and left of random scenes, as one digest."""
    drive, rng, digest = robot()[2], np.random.default_rng(3), hashlib.sha256()
    models, place = np.array([drive, *drive.corners(0.1)], dtype=np.float64), np.zeros(4)
    for _ in range(count):
        joints = rng.uniform(-1.0, 1.0, (2, 3)) * [[0.1, 0.1, 3.0], [1.0, 1.0, 2.0]]
        discs = np.column_stack([rng.uniform(-0.9, 0.9, (6, 2)), np.full(6, 0.1)])
        motion, _, near, *seen = look(models, *joints, place, discs, 0.004)
        left = clearances(models, motion, *rng.uniform(-1.0, 1.0, 2), near, bool(rng.integers(2)))
        for part in (motion, near, *seen, left):
            digest.update(np.asarray(part, dtype=np.float64).tobytes())
    return digest.hexdigest()


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda m: m.dof_damping.__setitem__(0, 0.02), "'agent' is no heading drive: the slides need equal"),
        (lambda m: setattr(m.opt, "integrator", mujoco.mjtIntegrator.mjINT_RK4), "must be Euler"),
        (lambda m: m.body_ipos[:, 1].fill(0.01), "centre of mass must lie on the heading"),
        (lambda m: m.jnt_axis[0].fill(0.1), "'agent' must slide along world x and y"),
        (lambda m: m.site_quat.fill(0.5), "needs one actuator along its heading"),
        (lambda m: m.dof_damping.__setitem__(2, 0.0), "hinge needs damping above zero"),
        (lambda m: m.dof_armature.fill(0.1), "no armature or stiffness"),
        (lambda m: m.jnt_stiffness.fill(0.1), "no armature or stiffness"),
        (
            lambda m: m.actuator_biastype.fill(int(mujoco.mjtBias.mjBIAS_AFFINE)),
            "drive must be a plain motor",
        ),
        (lambda m: m.actuator_biasprm[:, 2].fill(0.0), "turning actuator must be a speed servo"),
    ],
)
def test_refusals_name_what_does_not_fit(change, words):
    _, plant, _ = robot()
    change(plant.model)
    with pytest.raises(sw.SafeWrappersError, match=words):
        heading_drive(plant, "agent")
