"""HeadingDriveClearance: the corners of the uncertainty, the side of a `Detour`, and what holds at the boundary."""

import math

import gymnasium as gym
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import safe_wrappers as sw
from safe_wrappers.control.backup.heading_drive import Motion, advance, brake_control, clearances

RADIUS = 0.2
# A reset stands still among the hazards of a moving state.
pytestmark = pytest.mark.filterwarnings("ignore::safe_wrappers.UnsafeStateWarning")


HAZARDS = sw.constraints.Discs("hazard_positions", RADIUS)


def filtered(discs=HAZARDS, **options):
    clearance = sw.constraints.HeadingDriveClearance([discs], **options)
    env = sw.CBFActionFilter(gym.make("SafePointGoal1-v0"), [clearance])
    env.reset(seed=0)
    return env, env.filter.bound[0]


def start(env, hazards, qpos=(0.0, 0.0, 0.0), qvel=(0.0, 0.0, 0.0)):
    """Observed anew in this motion."""
    layout = {"agent": [0.0, 0.0, 0.0], "goal": [3.0, 3.0], "hazards": list(hazards), "vases": []}
    env.reset(seed=0, options={"layout": layout})
    raw = env.unwrapped
    positions, velocities = raw.data.qpos.copy(), raw.data.qvel.copy()
    positions[:3], velocities[:3] = qpos, qvel
    raw.set_state(positions, velocities)
    env.filter.observe()


def test_a_control_must_be_safe_for_every_corner_of_the_uncertainty():
    env, limit = filtered(uncertainty=0.25)
    start(env, [[0.6, 0.0]])
    raw = env.unwrapped
    every, push = limit.spec.models, np.array([0.05, 0.0])
    assert len(every) == 1 + 4  # the body, and its corners

    def refused(x, models):
        qpos, qvel = raw.data.qpos.copy(), raw.data.qvel.copy()
        qpos[0], qvel[0] = x, 0.9
        raw.set_state(qpos, qvel)
        limit.spec.models = models
        env.filter.observe()
        return not limit.admits(push)

    places = np.linspace(-0.4, 0.2, 100)
    by_all = np.array([refused(x, every) for x in places])
    by_one = np.array([refused(x, every[:1]) for x in places])
    assert by_all[by_one].all()
    assert (by_all & ~by_one).any()


def test_who_drives_straight_at_goals_seldom_stands_before_a_disc():
    """Without backing out 41 % of the steps."""
    env = sw.StuckEscape(sw.protect(gym.make("SafePointGoal1-v0")), progress=0.1, escape_s=0)
    task, stuck = env.unwrapped, 0
    for seed in range(2):
        env.reset(seed=1_000_000 + seed)
        for _ in range(600):
            x, y = task.goal_position - task.agent_position
            off = math.remainder(math.atan2(y, x) - task.agent_heading, math.tau)
            action = np.array([1.0 if abs(off) < 1.2 else 0.1, np.clip(3.0 * off, -1.0, 1.0)], np.float32)
            stuck += env.step(action)[4]["cbf/stuck"]
    assert stuck < 0.25 * 2 * 600


@pytest.mark.parametrize("side", [-1.0, 1.0])
def test_a_disc_ahead_is_passed_on_its_other_side_which_is_kept_for_fifty_steps(side):
    env, limit = filtered(detour=True)
    start(env, [[0.26, -0.05 * side]])
    drive = np.array([1.0, 0.1])

    def tried(memory):
        limit.observe(memory)
        return list(limit.candidates(drive))

    # Around, turning, backing out.
    np.testing.assert_array_equal(tried({}), [[1.0, side], [0.0, side], [-1.0, side], [-1.0, 0.0]])
    assert tried({"detour": (-side, 1)})[0][1] == -side  # but a detour on the other side goes on
    assert limit.executed(drive)["detour"] == (-side, 50)
    assert tried({"detour": (-side, 0)})[0][1] == side  # until it has not been needed for long
    memory = limit.executed(drive)
    limit.observe(memory)  # not needed in this step
    assert limit.executed(drive)["detour"] == (side, 49)
    limit.observe({"detour": (side, 20)})
    assert limit.spec.surroundings(2)[0] == 0.4 * side  # of its time


# At the boundary of its safe set -----------------------------------------------------------------------------


def driven(drive, pairs):
    """The motion after controls, (drive, turn, holds) each, from rest at the origin."""
    motion, places = Motion(0.0, 0.0, 0.0, 0.0, 0.0, 0.0), np.empty((drive.substeps, 2))
    for push, turn, holds in pairs:
        for _ in range(holds):
            motion = advance(drive, motion, push, turn, places)
    return motion


def touching(drive, motion, direction, clearance):
    """The centre of a disc in that direction of which braking leaves this much."""
    models, start = np.array([drive], dtype=np.float64), np.array(motion)
    brake = brake_control(drive, motion)
    near, far = 0.0, 4.0
    for _ in range(50):
        middle = 0.5 * (near + far)
        there = motion.x + middle * math.cos(direction), motion.y + middle * math.sin(direction)
        left = clearances(models, start, brake, 0.0, np.array([[*there, RADIUS]]), False)[0, 0]
        near, far = (middle, far) if left < clearance else (near, middle)
    return [motion.x + far * math.cos(direction), motion.y + far * math.sin(direction)]


EXTREME = st.tuples(
    st.sampled_from([-1.0, 0.0, 1.0]), st.sampled_from([-1.0, -0.3, 0.0, 1.0]), st.integers(1, 60)
)
DRIVEN = st.lists(EXTREME, min_size=1, max_size=8)
ANGLE = st.floats(-math.pi, math.pi)


@given(pairs=DRIVEN, directions=st.lists(ANGLE, min_size=1, max_size=3), control=st.tuples(ANGLE, ANGLE))
@settings(max_examples=30)
def test_the_rest_of_an_admitted_trajectory_is_the_backup_of_the_next_step(pairs, directions, control):
    """The step of the proof, in MuJoCo: what was left of a control, its successor's backup leaves."""
    env, limit = filtered()
    spec = limit.spec
    motion = driven(spec.drive, pairs)
    start(env, [touching(spec.drive, motion, d, 0.03) for d in directions], motion[:3], motion[3:])
    control = (np.clip(np.array(control) * [0.03, 0.5], -1.0, 1.0)).astype(np.float32).astype(np.float64)
    before = spec.h_along(limit.model.rollout(control)).min(initial=1.0)
    env.env.step(control)
    env.filter.observe()
    assert limit.value().min(initial=1.0) >= before - spec.rounding
    for _ in range(50):
        before = limit.least
        env.env.step(limit.backup().astype(np.float32))
        env.filter.observe()
        assert limit.least >= before - spec.rounding


@given(pairs=DRIVEN, direction=ANGLE)
@settings(max_examples=15)
def test_a_control_that_is_not_looked_at_leaves_the_margin(pairs, direction):
    env, limit = filtered()
    drive, margin = limit.spec.drive, limit.spec.margin
    motion = driven(drive, pairs)
    looked, unseen = margin, margin + 0.3
    for _ in range(12):  # as near as it can be without being looked at
        middle = 0.5 * (looked + unseen)
        start(env, [touching(drive, motion, direction, middle)], motion[:3], motion[3:])
        looked, unseen = (middle, unseen) if limit.slacks(np.zeros(2)).size else (looked, middle)
    discs = np.array([[*touching(drive, motion, direction, unseen), RADIUS]])
    for control in ([1.0, 1.0], [1.0, -1.0], [-1.0, 1.0], [-1.0, -1.0], [1.0, 0.0], [-1.0, 0.0]):
        assert clearances(limit.spec.models, np.array(motion), *control, discs, False).min() >= margin
    assert looked > margin


@pytest.mark.parametrize("alone", [False, True])
def test_from_inside_a_disc_the_filter_and_the_backup_alone_lead_out(alone):
    env, limit = filtered(sw.constraints.Disc([0.0, 0.0], 0.3))
    start(env, [[1.0, -1.0]], (0.1, 0.05, 0.4))
    rng, values, changed = np.random.default_rng(0), [], 0
    for _ in range(60):
        env.filter.observe()
        values.append(limit.least)
        if alone:
            control = limit.backup()
        else:
            decision = env.filter.filter(rng.uniform(-1.0, 1.0, 2))
            control, changed = decision.control, changed + decision.changed
        env.env.step(control)
        env.filter.executed(control)
    assert values[0] < -0.15 and values[-1] > 0.04
    assert np.diff(values)[np.array(values[:-1]) < limit.spec.margin].min() > 1e-4
    assert changed >= 5 or alone
