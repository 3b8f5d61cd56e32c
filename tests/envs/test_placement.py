import itertools

import numpy as np
import pytest

from safe_wrappers.envs.goal_layout import (
    AGENT_KEEPOUT,
    GOAL_KEEPOUT,
    HAZARD_KEEPOUT,
    LEVELS,
    VASE_KEEPOUT,
    PartialLayout,
    sample_goal,
    sample_layout,
)
from safe_wrappers.errors import ConfigurationError

KEEPOUTS = {"agent": AGENT_KEEPOUT, "goal": GOAL_KEEPOUT, "hazards": HAZARD_KEEPOUT, "vases": VASE_KEEPOUT}


def objects(layout):
    """(position, keepout) of every object."""
    for name, keepout in KEEPOUTS.items():
        points = np.atleast_2d(getattr(layout, name))[:, :2]
        yield from ((point, keepout) for point in points)


@pytest.mark.parametrize("level", LEVELS)
def test_keepouts_and_field_hold_for_every_seed(level):
    headings = []
    for seed in range(60):
        layout = sample_layout(np.random.default_rng(seed), level, PartialLayout())
        assert len(layout.hazards) == level.hazards
        assert len(layout.vases) == level.vases
        for point, keepout in objects(layout):
            assert np.abs(point).max() <= level.half_extent - keepout
        for (p, keep_p), (q, keep_q) in itertools.combinations(objects(layout), 2):
            assert np.linalg.norm(p - q) >= keep_p + keep_q
        headings.append(layout.agent[2])
    assert min(headings) < -2
    assert max(headings) > 2
    assert np.abs(headings).max() <= np.pi


def test_given_parts_are_kept_and_kept_clear_of():
    given = PartialLayout(agent=np.array([0.3, -0.2, 1.0]), hazards=np.array([[1.0, 1.0]]))
    for seed in range(30):
        layout = sample_layout(np.random.default_rng(seed), LEVELS[2], given)
        np.testing.assert_array_equal(layout.agent, given.agent)
        np.testing.assert_array_equal(layout.hazards, given.hazards)
        assert np.linalg.norm(layout.goal - given.agent[:2]) >= GOAL_KEEPOUT + AGENT_KEEPOUT
        assert np.linalg.norm(layout.goal - given.hazards[0]) >= GOAL_KEEPOUT + HAZARD_KEEPOUT


def test_new_goal_is_clear_of_everything():
    rng = np.random.default_rng(0)
    layout = sample_layout(rng, LEVELS[2], PartialLayout())
    for _ in range(50):
        goal = sample_goal(rng, LEVELS[2], layout.agent[:2], layout.hazards, layout.vases)
        assert np.linalg.norm(goal - layout.agent[:2]) >= GOAL_KEEPOUT + AGENT_KEEPOUT
        assert np.linalg.norm(goal - layout.hazards, axis=1).min() >= GOAL_KEEPOUT + HAZARD_KEEPOUT
        assert np.linalg.norm(goal - layout.vases, axis=1).min() >= GOAL_KEEPOUT + VASE_KEEPOUT


def test_new_goal_in_a_field_without_room_is_the_clearest_one():
    grid = np.linspace(-1.5, 1.5, 9)
    hazards = np.stack(np.meshgrid(grid, grid), axis=-1).reshape(-1, 2)
    goal = sample_goal(np.random.default_rng(1), LEVELS[1], np.zeros(2), hazards, np.zeros((0, 2)))
    gaps = np.linalg.norm(goal - hazards, axis=1)
    reach = LEVELS[1].half_extent - GOAL_KEEPOUT
    tries = np.random.default_rng(1).uniform(-reach, reach, (100, 2))
    clear = np.linalg.norm(tries[:, None] - hazards, axis=2).min(axis=1) - HAZARD_KEEPOUT
    clear = np.minimum(clear, np.linalg.norm(tries, axis=1) - AGENT_KEEPOUT)
    np.testing.assert_array_equal(goal, tries[clear.argmax()])
    assert gaps.min() < GOAL_KEEPOUT + HAZARD_KEEPOUT  # there was no room indeed


def test_no_room_is_said():
    grid = np.linspace(-0.6, 0.6, 3)
    level = LEVELS[0]
    blocked = PartialLayout(hazards=np.stack(np.meshgrid(grid, grid), axis=-1).reshape(-1, 2))
    with pytest.raises(ConfigurationError, match=r"no room .* \[-1\.0, 1\.0\]\^2"):
        sample_layout(np.random.default_rng(0), level, blocked)
