"""HeadingDriveClearance at the boundary of its safe set: an admissible control, and no disc touched until rest."""

import math

import gymnasium as gym
import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

import safe_wrappers as sw
from safe_wrappers.control.backup.heading_drive import (
    Motion,
    beyond_reach,
    brake_control,
    end_distance,
    path_distance,
    predict,
    stopping_path,
)

RADIUS = 0.2
# A reset stands still among the hazards of a moving state.
pytestmark = pytest.mark.filterwarnings("ignore::safe_wrappers.UnsafeStateWarning")
DISCS = [sw.constraints.Discs("hazard_positions", RADIUS)]


def filtered(**options):
    clearance = sw.constraints.HeadingDriveClearance(DISCS, **options)
    return sw.CBFActionFilter(gym.make("SafePointGoal1-v0"), [clearance])


def start(env, hazards, qpos, qvel):
    layout = {"agent": [0.0, 0.0, 0.0], "goal": [3.0, 3.0], "hazards": list(hazards), "vases": []}
    env.reset(seed=0, options={"layout": layout})
    raw = env.unwrapped
    positions, velocities = raw.data.qpos.copy(), raw.data.qvel.copy()
    positions[:3], velocities[:3] = qpos, qvel
    raw.set_state(positions, velocities)


@pytest.fixture(scope="module")
def drive():
    env = filtered()
    env.reset(seed=0)
    return env.filter.bound[0].drive


def driven(drive, pairs):
    """The motion after controls, (drive, turn, holds) each, from rest at the origin."""
    motion = Motion(0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    for push, turn, holds in pairs:
        for _ in range(holds):
            motion = predict(drive, motion, push, turn)
    return motion


def touching(drive, motion, direction, clearance):
    """The centre of a disc in that direction, this far from the area that the stopping path stays in."""
    path = stopping_path(drive, motion, True)
    x = motion.x + 0.5 * (path.forward * path.ex + path.sideways * path.sx)
    y = motion.y + 0.5 * (path.forward * path.ey + path.sideways * path.sy)
    near, far = 0.0, 4.0
    for _ in range(50):
        middle = 0.5 * (near + far)
        there = x + middle * math.cos(direction), y + middle * math.sin(direction)
        left = min(path_distance(path, *there), end_distance(path, *there) - 2.0 * drive.com_offset)
        near, far = (middle, far) if left < RADIUS + clearance else (near, middle)
    return [x + far * math.cos(direction), y + far * math.sin(direction)]


EXTREME = st.tuples(
    st.sampled_from([-1.0, 0.0, 1.0]), st.sampled_from([-1.0, -0.3, 0.0, 1.0]), st.integers(1, 60)
)
DRIVEN = st.lists(EXTREME, min_size=1, max_size=8)
ANGLE = st.floats(-math.pi, math.pi)


def test_where_the_closed_form_loses_a_tenth_of_a_millimetre_the_backup_is_still_admitted():
    env = sw.protect(gym.make("SafePointGoal1-v0"))
    hazards = [[0.5317, 0.1102], [0.3306, 0.4308], [-0.2102, 0.5007]]
    hazards += [[-0.5302, -0.1173], [-0.3617, -0.405], [0.1862, -0.5101]]
    start(env, hazards, [0.79762, -0.06754, -0.98793], [-1.29579, 0.1196, -0.83659])
    env.filter.observe()
    (limit,) = env.filter.bound
    assert limit.admits(limit.backup())
    for _ in range(40):
        info = env.step(np.array([-0.39, -0.34], np.float32))[4]
        assert not info["cbf/infeasible"] and not info["cbf/unsafe"] and not info["cost_substep"]


@pytest.mark.parametrize("margin", [0.0, 0.002, 0.004])
def test_from_the_boundary_on_there_is_always_an_admissible_control(margin, drive):
    rng, env, changed = np.random.default_rng(5), filtered(margin=margin, detour=True), 0
    for _ in range(40):
        pairs = [(*rng.choice([-1.0, 0.0, 1.0], 2), int(rng.integers(1, 60))) for _ in range(6)]
        motion = driven(drive, pairs)
        hazards = [
            touching(drive, motion, rng.uniform(-math.pi, math.pi), rng.choice([0.002, 0.05]) * rng.random())
            for _ in range(rng.integers(1, 7))
        ]
        start(env, hazards, motion[:3], motion[3:])
        action = rng.uniform(-1.0, 1.0, 2)
        for k in range(12):
            if k % 4 == 0:
                action = rng.uniform(-1.0, 1.0, 2)
            info = env.step(action.astype(np.float32))[4]
            assert not info["cbf/infeasible"] and not info["cost_substep"], (margin, motion, hazards, info)
            assert not info["cbf/unsafe"]
            changed += info["cbf/intervened"]
    assert changed > 100


@given(pairs=DRIVEN, direction=ANGLE, clearance=st.floats(0.0, 0.005))
@settings(max_examples=30)
def test_a_state_with_clearance_left_stops_clear_of_every_disc_in_mujoco(pairs, direction, clearance):
    env = filtered(margin=0.004)
    env.reset(seed=0)
    drive = env.filter.bound[0].drive
    motion = driven(drive, pairs)
    start(env, [touching(drive, motion, direction, clearance)], motion[:3], motion[3:])
    env.filter.observe()
    assume(env.filter.margin >= 0.0)
    raw = env.unwrapped
    for _ in range(150):
        _, _, heading, vx, vy, _ = *raw.data.qpos[:3], *raw.data.qvel[:3]
        ahead = float(vx * math.cos(heading) + vy * math.sin(heading))
        raw.step(np.array([brake_control(drive, ahead), 0.0]))
        gaps = np.linalg.norm(raw._path[:, None] - raw.hazard_positions, axis=2) - RADIUS
        assert gaps.min() >= -1e-7


@given(pairs=DRIVEN)
def test_no_driving_from_rest_leaves_what_is_promised_about(pairs, drive):
    assert beyond_reach(drive, driven(drive, pairs)) <= 0.0


@pytest.mark.parametrize(
    ("velocity", "unsafe"),
    [((1.5, 0.0, 0.0), False), ((0.0, 0.0, 3.0), False), ((1.65, 0.0, 0.0), True), ((0.0, 0.0, 3.2), True)],
)
def test_faster_than_the_actuators_make_it_is_unsafe_however_far_the_discs_are(velocity, unsafe):
    env = filtered()
    start(env, [[3.0, 0.0]], [0.0, 0.0, 0.0], velocity)
    info = env.step(np.zeros(2, np.float32))[4]
    assert info["cbf/unsafe"] == unsafe == (info["cbf/margin"] < 0.0)
    assert not info["cost_substep"]
