"""What is drawn of constraints, against geometry by hand."""

import gymnasium as gym
import numpy as np
import pytest

import safe_wrappers as sw
from safe_wrappers.wrappers.safety_overlay import marks_of


def looked(env):
    """The marks of each constraint in the env's present state."""
    return [marks_of(bound.spec) for bound in env.look()]


def of(marks, role, shape=None):
    return [m for m in marks if m.role == role and shape in (None, m.shape)]


def rods(marks, along=1):
    """Both ends of every rod; the size along it."""
    ends = [(m.position, m.size[along] * m.axes[:, 2]) for m in marks]
    return np.array([[middle - half, middle + half] for middle, half in ends])


@pytest.mark.parametrize("task", ["SafePointGoal1-v0", "SafeCarGoal1-v0"])
def test_every_disc_has_a_ring_where_the_margin_begins(task):
    env = sw.protect(gym.make(task))
    env.reset(seed=0)
    (marks,) = looked(env)
    centers = env.unwrapped.hazard_positions
    limits = rods(of(marks, "limit"), along=2)[:, 0, :2].reshape(len(centers), -1, 2)
    np.testing.assert_allclose(limits.mean(axis=1), centers, atol=1e-9)
    radii = np.linalg.norm(limits - centers[:, None], axis=2)
    np.testing.assert_allclose(radii, 0.2 + env.constraints[0].margin)


def test_planes_are_moved_by_what_is_kept_free():
    rail = [sw.constraints.Plane([-0.9], [1]), sw.constraints.Plane([0.9], [-1])]
    keep = sw.constraints.Clearance(rail, 8.0, bodies=["cart"], radius=0.1, margin=0.05, state_error=0.01)
    env = sw.CBFActionFilter(gym.make("InvertedPendulum-v5"), [keep])
    env.reset(seed=0)
    for _ in range(5):
        env.step(np.array([3.0], np.float32))
    (marks,) = looked(env)
    x = env.unwrapped.data.qpos[0]
    left, right = of(marks, "keep out")
    np.testing.assert_allclose([left.position[0], right.position[0]], [-0.74, 0.74])
    for pad in (left, right):
        np.testing.assert_allclose(np.abs(pad.axes[:, 2]), [1.0, 0.0, 0.0], atol=1e-12)
    (point,) = of(marks, "way")
    np.testing.assert_allclose(point.position[0], x)
    assert point.shape == "sphere" and point.size[0] == 0.1
