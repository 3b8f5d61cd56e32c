"""WallClearance against MuJoCo itself: what is admitted stays clear, and is as close to what was asked as can be."""

import warnings

import gymnasium as gym
import numpy as np
import pytest
from asking import Asked
from hypothesis import assume, given
from hypothesis import strategies as st
from point_worlds import RADIUS, PointWorld

import safe_wrappers as sw
from safe_wrappers.errors import ConfigurationError, UnsupportedEnvError
from safe_wrappers.filter.constraint import Constraint

MARGIN = 0.001
ROOM = RADIUS + 2 * 0.002 + MARGIN
"""From the ball's centre to a wall: radius, both contact margins, the constraint's own."""


def filtered(world=None, more=(), **options):
    env = sw.CBFActionFilter(world or PointWorld(clip=5.0), [sw.constraints.WallClearance(**options), *more])
    env.reset(seed=0)
    return env


def placed(env, at, velocity=(0.0, 0.0)):
    """The constraint, with the ball somewhere."""
    env.unwrapped.place(at, velocity)
    env.plant.observe()
    return Asked(env.constraints[0], env.plant)


ENVS = {
    "clip known": (5.0, dict(velocity_clip=5.0), 1),
    "clip not known": (5.0, {}, 1),
    "any clip": (1.3, {}, 1),
    "no clip": (None, {}, 1),
    "four physics steps": (5.0, dict(velocity_clip=5.0), 4),
    "four, not known": (None, {}, 4),
}


@pytest.fixture(scope="module", params=ENVS)
def world(request):
    clip, options, substeps = ENVS[request.param]
    return filtered(PointWorld(substeps, clip), **options)


PLACES = st.tuples(st.floats(-1.9, 1.9), st.floats(-1.9, 1.9))
SPEEDS = st.tuples(st.floats(-6.0, 6.0), st.floats(-6.0, 6.0))
ACTIONS = st.lists(
    st.tuples(st.sampled_from([-1.0, 0.0, 1.0, 0.37]), st.sampled_from([-0.8, 0.0, 1.0, -0.2])),
    min_size=1,
    max_size=12,
)


@given(PLACES, SPEEDS, ACTIONS, st.integers(1, 5))
def test_from_every_safe_state_any_actions_stay_clear_in_mujoco(world, at, velocity, actions, hold):
    limit = placed(world, at, velocity)
    assume(limit.least >= limit.spec.margin)
    for action in actions:
        for _ in range(hold):
            info = world.step(np.array(action, np.float32))[4]
            assert not info["touched"]
            assert info["nearest"] >= MARGIN + 0.004 - 1e-6
            assert not (info["cbf/infeasible"] or info["cbf/fallback"] or info["cbf/unsafe"])
            world.plant.observe()
            assert limit.least >= limit.spec.margin - 1e-7


@given(PLACES, SPEEDS)
def test_the_backup_is_admitted_and_loses_nothing(world, at, velocity):
    limit = placed(world, at, velocity)
    before = limit.least
    assume(before >= limit.spec.margin)
    backup = limit.backup()
    assert limit.admits(backup)
    world.unwrapped.step(backup)
    limit.plant.observe()
    assert limit.least >= before - 1e-9


@given(PLACES, SPEEDS, st.tuples(st.floats(-1, 1), st.floats(-0.8, 1)))
def test_what_is_proposed_is_admitted_and_no_farther_away_than_braking(world, at, velocity, asked):
    limit = placed(world, at, velocity)
    assume(limit.least >= limit.spec.margin + 1e-6)
    asked = np.array(asked)
    away = [float(np.linalg.norm(control - asked)) for control in limit.candidates(asked)]
    assert all(limit.admits(control) for control in limit.candidates(asked)) and len(away) == 2
    assert away == sorted(away) and away[-1] <= np.linalg.norm(limit.backup() - asked) + 1e-12


@pytest.mark.parametrize("options", [{"velocity_clip": 5.0}, {}])
def test_a_hair_lost_to_rounding_is_no_reason_to_refuse_braking(options):
    limit = placed(filtered(**options), (2.0 - ROOM + 5e-8, -1.2), (0.0, 1.0))
    assert limit.least < limit.spec.margin
    assert limit.admits(limit.backup())
    assert limit.admits(np.array([0.0, 1.0]))  # along the wall
    assert limit.admits(np.array([-1.0, 0.0]))  # away from it
    assert not limit.admits(np.array([1e-4, 0.0]))


def test_the_nearest_admitted_control_is_found():
    # Against every control of a fine grid, at states that a rough driver comes to.
    env = filtered(PointWorld(clip=5.0))
    limit = Asked(env.constraints[0], env.plant)
    grid = np.array([(x, y) for x in np.linspace(-1, 1, 41) for y in np.linspace(-0.8, 1, 37)])
    rng = np.random.default_rng(0)
    checked = 0
    while checked < 60:
        action = rng.choice([-1.0, 1.0], 2) * [1.0, 0.8]
        for _ in range(15):
            env.plant.observe()
            if not limit.admits(action) and rng.random() < 0.2:
                best = limit.candidates(action)[0]
                distance = np.linalg.norm(grid - action, axis=1)
                order = np.argsort(distance)
                found = next(k for k in order if limit.admits(grid[k]))
                assert np.linalg.norm(best - action) <= distance[found] + 1e-6
                checked += 1
            env.step(action.astype(np.float32))


@pytest.mark.parametrize("options", [{"velocity_clip": 5.0}, {}])
@pytest.mark.parametrize("asked", [(1.0, 0.0), (0.0, 0.0), (-1.0, 0.3)])
@pytest.mark.parametrize(
    ("gap", "lost"), [(0.03, False), (0.001, True)], ids=["inside the margin", "at the wall"]
)
def test_from_outside_it_comes_back_and_stays(options, asked, gap, lost):
    env = filtered(margin=0.05, **options)
    placed(env, (2.0 - RADIUS - gap, -1.2))
    with warnings.catch_warnings(action="ignore"):
        infos = [env.step(np.array(asked, np.float32))[4] for _ in range(200)]
    margins = np.array([info["cbf/margin"] for info in infos])
    assert infos[0]["cbf/unsafe"] == lost and not infos[-1]["cbf/unsafe"]
    assert margins.min() >= margins[0] - 1e-9 and margins[-1] >= 0.05 - 1e-6
    back = int(np.argmax(margins >= 0.05 - 1e-6))
    assert back < 120 and margins[back:].min() >= 0.05 - 1e-6


def test_far_from_walls_actions_pass_bit_for_bit():
    env = filtered(PointWorld(blocks=[(50, 0, 1, 1)]))
    action = np.array([0.1234567, -0.7654321], np.float32)
    for _ in range(20):
        info = env.step(action)[4]
        assert not info["cbf/intervened"]
        assert (info["executed_action"] == action.astype(np.float64)).all()


# Composition --------------------------------------------------------------------------------------------------


class SlowAlongY(Constraint):
    """Rows only: the speed along y stays below 0.5 m/s after the step."""

    def rows(self):
        plant = self.plant
        axis = plant.model.opt.timestep * 90.0 / (plant.model.body_mass[1] + 0.01)
        v = plant.qvel[0]
        return sw.HalfSpaces(np.array([[0.0, axis], [0.0, -axis]]), np.array([0.5 - v, 0.5 + v]))


def test_with_another_constraint_both_hold():
    env = filtered(PointWorld(clip=5.0), more=[SlowAlongY()], velocity_clip=5.0)
    rng = np.random.default_rng(1)
    fastest = 0.0
    for _ in range(80):
        action = rng.choice([-1.0, 1.0], 2) * [1.0, 0.8]
        for _ in range(10):
            info = env.step(action.astype(np.float32))[4]
            assert not (info["touched"] or info["cbf/infeasible"] or info["cbf/fallback"])
            fastest = max(fastest, abs(env.unwrapped.data.qvel[0]))
    assert 0.45 < fastest <= 0.5 + 1e-5


# What the constraint itself is asked for ----------------------------------------------------------------------


@pytest.mark.parametrize(("at", "velocity"), [((np.nan, 0.0), (0.0, 0.0)), ((0.0, 0.0), (0.0, np.nan))])
def test_a_state_that_is_not_a_number_admits_nothing(at, velocity):
    env = filtered(velocity_clip=5.0)
    limit = placed(env, at, velocity)
    assert np.isnan(limit.least)
    assert not limit.admits(np.zeros(2))
    assert np.isfinite(limit.backup()).all()
    assert not limit.candidates(np.ones(2))


@pytest.mark.parametrize(
    ("options", "says"),
    [
        ({"margin": -0.1}, "margin.*m, got -0.1"),
        ({"velocity_clip": np.inf}, "velocity_clip.*finite"),
    ],
)
def test_bad_numbers_are_refused(options, says):
    with pytest.raises(ConfigurationError, match=says):
        sw.constraints.WallClearance(**options)


def test_other_plants_and_machines_are_refused_with_the_alternative():
    plant = sw.AnalyticPlant(
        f=lambda x: np.zeros(4),
        g=lambda x: np.zeros((4, 2)),
        state=lambda env: np.zeros(4),
        control_dt=0.01,
    )
    with pytest.raises(UnsupportedEnvError, match=r"MujocoPlant.*Clearance"):
        sw.CBFActionFilter(PointWorld(), [sw.constraints.WallClearance()], plant=plant)
    with pytest.raises(UnsupportedEnvError, match=r"two slides.*Use Clearance"):
        sw.CBFActionFilter(gym.make("Reacher-v5"), [sw.constraints.WallClearance()])


# WallClearance where a path passes a corner closely: the path fits, the rectangle around it does not


def moved(limit, control, axis, asked):
    """A control moved along one axis towards the one asked for, in small steps, while that is admitted."""
    found = control
    for share in np.linspace(0.0, 1.0, 401):
        tried = np.array(control)
        tried[axis] += share * (asked[axis] - control[axis])
        if not limit.admits(tried):
            break
        found = tried
    return found


@pytest.mark.parametrize(
    ("at", "velocity", "asked", "first"),
    [
        ((-0.06, 0.05), (4.4, -3.6), (0.6, -0.5), 1),
        ((-0.35, -0.54), (-3.4, 4.3), (-0.3, 0.7), 1),
        ((0.43, -0.26), (-4.6, 2.7), (-0.7, 0.4), 0),
        ((0.21, -0.16), (-2.0, 1.7), (0.0, 0.6), 0),
    ],
)
def test_beside_a_corner_the_nearer_of_both_ways_back_to_the_proposal_is_taken(at, velocity, asked, first):
    """From braking along x and then along y, and the other way round, by small steps instead of by halving."""
    env = sw.CBFActionFilter(PointWorld(clip=5.0), [sw.constraints.WallClearance(velocity_clip=5.0)])
    env.reset(seed=0)
    env.unwrapped.place(at, velocity)
    env.plant.observe()
    limit, asked = Asked(env.constraints[0], env.plant), np.array(asked)
    assert limit.least > limit.spec.margin and not limit.admits(asked)
    ways = [moved(limit, moved(limit, limit.backup(), i, asked), 1 - i, asked) for i in (0, 1)]
    away = [float(np.linalg.norm(way - asked)) for way in ways]
    assert away[first] < away[1 - first] - 0.1
    nearest = limit.candidates(asked)[0]
    step = np.abs(asked - limit.backup()).sum() / 32  # as finely as it halves, along both
    assert np.linalg.norm(nearest - asked) <= away[first] + step
