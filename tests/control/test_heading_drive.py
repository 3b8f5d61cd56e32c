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
    """Place, and the heading's cosine and sine, after each physics step of a control step, by MuJoCo."""
    places, env.data.ctrl[:] = [], control
    for _ in range(drive.substeps):
        mujoco.mj_step(env.model, env.data)
        x, y, heading = env.data.qpos[:3]
        places.append([x, y, math.cos(heading), math.sin(heading)])
    return np.array(places)


def random_discs(rng):
    """Some count for the axis, some for a place ahead of it or behind."""
    return np.column_stack(
        [rng.uniform(-1.2, 1.2, (6, 2)), np.full(6, 0.1), [0.0, 0.0, 0.0, 0.07, 0.2, -0.1]]
    )


def test_prediction_is_mujocos_own_step():
    env, _, drive = robot()
    rng, places = np.random.default_rng(0), np.empty((drive.substeps, 4))
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
        motion, discs = random_motion(rng), random_discs(rng)
        place(env, motion)
        first = control or (brake_control(drive, motion), 0.0)
        least, end = clearances(models, np.array(motion), *first, discs, True)
        start = [*motion[:2], math.cos(motion.heading), math.sin(motion.heading)]
        path = [np.array([start]), played(env, drive, first)]
        path += [played(env, drive, (brake_control(drive, now(env)), 0.0)) for _ in range(299)]
        path = np.concatenate(path)[:, None]
        where = path[..., :2] + discs[:, 3:] * path[..., 2:]
        gaps = np.linalg.norm(where - discs[:, :2], axis=2) - 0.1
        axis, (x, y, cos, sin) = discs[:, 3] == 0.0, path[-1, 0]
        com = x + drive.com_offset * cos, y + drive.com_offset * sin
        turning = np.linalg.norm(discs[:, :2] - com, axis=1) - 0.1 - drive.com_offset
        rest = np.where(axis, turning, gaps[-1])  # only the axis must be able to turn
        # What is not followed to its very end is a lower bound.
        lost = np.minimum(gaps.min(axis=0), rest) - least
        assert (lost >= -1e-6).all() and (lost <= 2.0 * REST_M).all()
        np.testing.assert_allclose(end, rest, atol=2.0 * REST_M)
        again = clearances(models, np.array(motion), *first, discs, False)[0]
        np.testing.assert_allclose(again, least, atol=REST_M)


def test_what_an_uncertain_machine_leaves_is_told_of_each_model_apart():
    drive, rng = robot()[2], np.random.default_rng(5)
    models = np.array([drive, *drive.corners(0.25)], dtype=np.float64)
    for _ in range(10):
        given, discs = (np.array(random_motion(rng)), *rng.uniform(-1.0, 1.0, 2)), random_discs(rng)
        every = clearances(models, *given, discs, True)
        alone = clearances(models[:1], *given, discs, True)
        others = [clearances(models[[0, i]], *given, discs, True)[:, 6:] for i in range(1, len(models))]
        np.testing.assert_array_equal(every, np.concatenate([alone, *others], axis=1))
        assert (others != alone).any()


def test_no_control_takes_more_than_is_said_or_comes_near_what_is_left_out():
    drive, rng = robot()[2], np.random.default_rng(6)
    models, left_out = np.array([drive], dtype=np.float64), 0
    joint = np.array([0.0, 3.0, 0.0, 0.0])  # the index of its speeds is another
    for _ in range(300):
        motion = np.array(random_motion(rng, yaw=10.0))
        motion[3:5] *= rng.choice([0.0, 0.2, 1.0])
        discs = random_discs(rng)
        discs[:, 3] *= 100.0  # m: swings farther than it drives
        heading = math.cos(motion[2]), math.sin(motion[2])
        discs[:, :2] = motion[:2] + discs[:, 3:] * heading + 0.6 * discs[:, :2]
        seen = look(models, motion, motion, joint, discs, 0.004)
        far = discs[(discs[:, None] != seen.discs).any(axis=2).all(axis=1)]
        left_out += len(far)
        for control in rng.uniform(-1.0, 1.0, (8, 2)).round():
            left = clearances(models, motion, *control, seen.discs, False)[0]
            assert (left >= seen.clearances[0] - seen.loss).all()
            assert (clearances(models, motion, *control, far, False)[0] > 0.004).all()
    assert left_out > 100


def random_scenes(count):
    """What is seen and left of random scenes, as one digest."""
    drive, rng, digest = robot()[2], np.random.default_rng(3), hashlib.sha256()
    models, place = np.array([drive, *drive.corners(0.1)], dtype=np.float64), np.zeros(4)
    for _ in range(count):
        joints = rng.uniform(-1.0, 1.0, (2, 3)) * [[0.1, 0.1, 3.0], [1.0, 1.0, 2.0]]
        discs = 0.75 * random_discs(rng)
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
