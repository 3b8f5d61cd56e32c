"""HeadingDriveClearance: how far away a disc may be and still come into play within one control step."""

import gymnasium as gym
import numpy as np
import pytest
from asking import asked

import safe_wrappers as sw

RADIUS, MARGIN = 0.2, 0.002
PUSH, NONE = np.array([1.0, 0.0]), np.zeros(2)


def at_rest(distance):
    """A robot at the origin, at rest, whose backup is to coast; so far from the rim of a disc straight ahead."""
    env = gym.make("SafePointGoal1-v0")
    hazard = [RADIUS + distance, 0.0]
    layout = {"agent": [0.0, 0.0, 0.0], "goal": [1.2, 1.2], "hazards": [hazard], "vases": []}
    env.reset(seed=0, options={"layout": layout})
    discs = [sw.constraints.Discs("hazard_positions", RADIUS)]
    spec = sw.constraints.HeadingDriveClearance(discs, margin=MARGIN, brake=False)
    return env.unwrapped, asked(env, spec)


@pytest.fixture(scope="module")
def way():
    """Of one step of full drive and coasting to rest, on the env itself."""
    env, _ = at_rest(1.0)
    start = env.agent_position[0]
    for control in (PUSH, *[NONE] * 400):
        env.step(control)
    return env.agent_position[0] - start


@pytest.mark.parametrize("share", [0.55, 0.8, 0.95, 1.05, 1.2, 1.5, 1.8, 1.9, 2.1, 2.5, 4.0])
def test_from_rest_full_drive_may_use_up_half_of_the_clearance(way, share):
    turning = 1.0 - float(at_rest(1.0)[1].value()[0])  # kept free at rest as well
    limit = at_rest(MARGIN + turning + share * way)[1]
    assert limit.value() == pytest.approx([share * way + MARGIN])
    assert limit.admits(PUSH) == (share > 2.0)
    assert limit.admits(NONE)
