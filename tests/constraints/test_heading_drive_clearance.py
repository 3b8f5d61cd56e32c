"""HeadingDriveClearance: uncertain models, the side of a `Detour`, the way out of a disc, and the robot's parts."""

import math

import gymnasium as gym
import numpy as np
import pytest

import safe_wrappers as sw

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
    env = sw.StuckMonitor(sw.protect(gym.make("SafePointGoal1-v0")), progress=0.1)
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


def test_no_part_touches_a_vase_and_none_is_kept_farther_than_needed():
    env = sw.protect(gym.make("SafePointGoal2-v0"), detour=False)
    rng, turned, changed = np.random.default_rng(0), [], 0
    for side in (-1.0, 1.0, -1.0, 1.0):
        vase = [0.0, 0.29 * side]  # a disc about the axis that holds the nose would reach it
        layout = {"agent": [0.0, 0.0, 0.0], "goal": [3.0, 3.0], "hazards": [], "vases": [vase]}
        _, info = env.reset(seed=0, options={"layout": layout})
        assert info["cbf/margin"] > 0.004
        for _ in range(60):  # drives and turns at it
            info = env.step(np.array([rng.uniform(-1.0, 1.0), side]))[4]
            changed += info["cbf/intervened"]
            assert not (info["cbf/infeasible"] or info["cost_vases"] or info["cost_substep"])
        turned.append(abs(env.unwrapped.agent_heading))
    assert changed > 40 and max(turned) > 0.5


def test_what_is_seen_of_the_untouched_is_the_first_parts_clearance():
    discs, parts = [sw.constraints.Disc([0.0, 0.5], 0.1)], [[0.05, 0.1], [0.2, 0.05]]
    clearance = sw.constraints.HeadingDriveClearance([HAZARDS], untouched=discs, parts=parts)
    env = sw.CBFActionFilter(gym.make("SafePointGoal1-v0"), [clearance])
    start(env, [[1.0, 0.0]])
    seen = env.filter.bound[0].spec.nearest(3).reshape(3, 4)
    np.testing.assert_allclose(seen[:2, :2], [[0.0, 1.0], [1.0, 0.0]], atol=1e-12)
    left = np.array([0.5 - 0.1 - 0.1, 1.0 - RADIUS]) - clearance.margin
    np.testing.assert_allclose(seen[:, 2], [*(left / (1.0 + left)), 1.0], atol=1e-12)
