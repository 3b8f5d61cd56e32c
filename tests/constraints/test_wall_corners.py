"""WallClearance where a path passes a corner closely: the path fits, the rectangle around it does not."""

import numpy as np
import pytest
from asking import Asked
from point_worlds import PointWorld

import safe_wrappers as sw


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
    assert limit.value()[0] > limit.spec.margin and not limit.admits(asked)
    ways = [moved(limit, moved(limit, limit.backup(), i, asked), 1 - i, asked) for i in (0, 1)]
    away = [float(np.linalg.norm(way - asked)) for way in ways]
    assert away[first] < away[1 - first] - 0.1
    nearest = limit.candidates(asked)[0]
    step = np.abs(asked - limit.backup()).sum() / 32  # as finely as it halves, along both
    assert np.linalg.norm(nearest - asked) <= away[first] + step
