"""EscapeClearance: distances from boxes that hold uncertain things, and how fast a violation must shrink."""

import gymnasium as gym
import numpy as np
import pytest
from asking import Asked

import safe_wrappers as sw
from safe_wrappers.control.estimation.tracks import Motion, Tracks

RADIUS, MARGIN, HOLD = 0.2, 0.05, 0.04
FAR = [9.0] * 6
AWAY = np.array([0.0, -1.0, 0.0])


class Seen(gym.Wrapper):
    """The crossing, with one thing at the origin whose place is less well known along x than along y."""

    def __init__(self, deviations):
        super().__init__(gym.make("OccludedCrossing-v0"))
        self.tracking = Tracks([Motion(np.zeros((2, 2)), np.inf, np.zeros(2))])
        self.tracking.start(np.zeros((1, 4)), np.diag([*np.square(deviations), 0.0, 0.0])[None])


def bound(env, obstacle):
    env.reset(seed=0)
    plant = sw.MujocoPlant()
    plant.bind(env)
    return Asked(sw.constraints.EscapeClearance("robot", [obstacle], RADIUS, MARGIN), plant), plant


def anew(env, plant, limit, place, velocity=(0.0, 0.0)):
    qpos, qvel = np.array([*place, 0.0, *FAR]), np.array([*velocity, 0.0, *[0.0] * 6])
    env.unwrapped.set_state(qpos, qvel)
    limit.start()
    plant.observe()


@pytest.mark.parametrize(
    "place",
    [
        (-1.9, 0.0),
        (1.9, 0.25),
        (-1.9, -0.29),
        (0.0, 1.4),
        (0.8, -1.4),
        (-0.89, 1.4),
        (1.5, 1.1),
        (-1.4, -1.2),
    ],
    ids=str,
)
def test_beside_a_box_only_what_is_left_across_it_counts(place):
    """The box is three standard deviations wide: 0.9 m to both sides along x, 0.3 m along y."""
    env = Seen([0.3, 0.1])
    limit, plant = bound(env, sw.constraints.TrackedDiscs(0.35, 3.0))
    anew(env, plant, limit, place)
    beyond = np.maximum(np.abs(place) - [0.9, 0.3], 0.0)
    assert limit.value() == pytest.approx([np.hypot(*beyond) - 0.35 - RADIUS], abs=1e-9)


@pytest.mark.parametrize(("speed", "admitted"), [(-1.5, False), (-1.2, False), (0.7, True), (1.5, True)])
def test_a_deep_violation_must_shrink_exponentially_and_need_not_be_gone_at_once(speed, admitted):
    """15 cm inside a wall, coming or leaving: what full drive away leaves at every second hold, on the env itself."""
    env = gym.make("OccludedCrossing-v0")
    limit, plant = bound(env, sw.constraints.Plane([0.0, 0.0], [0.0, -1.0]))
    place, velocity = (0.0, 0.15 - RADIUS), (0.0, -speed)
    anew(env, plant, limit, place, velocity)
    assert limit.value() == pytest.approx([-0.15])
    slack = limit.slack(AWAY)
    assert limit.admits(AWAY) == admitted
    left = []
    for k in range(1, 22):
        env.unwrapped.step(AWAY)
        wanted = MARGIN - (0.15 + MARGIN) * np.exp(-k * HOLD / 0.4)
        left.append(-env.unwrapped.agent_position[1] - RADIUS - wanted)
    assert slack == pytest.approx(min(left[::2]), abs=1e-7)
