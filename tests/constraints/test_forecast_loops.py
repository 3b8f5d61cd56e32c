"""Every constraint on a forecast in closed loops that attack it: an executed control that is not flagged keeps it."""

from collections.abc import Callable
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
import pytest
from judged_loops import (
    ForceJudge,
    Judge,
    at_random,
    bang_bang,
    below_force,
    cart_before_a_wall,
    cone_room,
    drive,
    full,
    inside_the_hull,
    manipulability,
    noisy,
    seeking,
    table,
)

import safe_wrappers as sw
from safe_wrappers import constraints as of

ANY = (bang_bang, seeking)


class Loop(NamedTuple):
    """Who attacks what, and what is left of the limit; of the counts what they may be."""

    make: Callable[[], gym.Env[Any, Any]]
    limits: list[sw.Constraint]
    room: Callable[[Any, Any], Any]
    drivers: tuple[Callable[..., Any], ...] = ANY
    steps: int = 60
    most_flagged: float = 0.0
    """Share of the steps; those may end outside."""
    deepest: float = 1e-6
    """Outside, in the unit of the room."""
    used: float = np.inf
    """The drivers that seek the limit come as close as this."""
    judge: Callable[..., Any] = Judge


def task(env_id):
    return lambda: gym.make(env_id, disable_env_checker=True)


# What is left -------------------------------------------------------------------------------------------------


def below_speed(dofs, limit):
    return lambda model, data: limit - np.abs(data.qvel[dofs])


ARM_JOINTS = "r_shoulder_pan_joint", "r_shoulder_lift_joint", "r_upper_arm_roll_joint", "r_elbow_flex_joint"


def impact(mass, stiffness, horizon, steps):
    """At full throttle it arrives with what is allowed, and then holds it."""
    limit = of.ImpactSpeedLimit(["cart"], ["wall"], 140.0, stiffness, margin=2.0, horizon=horizon)
    make = lambda: cart_before_a_wall(mass, stiffness)  # noqa: E731
    return Loop(make, [limit], below_force(140.0), (full,), steps, used=14.0, judge=ForceJudge)


def feet(env_id, *drivers, steps):
    """In contact a rounded action makes more of its rounding; some steps have no control that stays."""
    room, limits = cone_room(0.7, 0.01), [of.ContactFeasibility(0.7, 0.01)]
    return Loop(task(env_id), limits, room, drivers, steps, 0.95, np.inf, judge=ForceJudge)


FINGER_LOW, FINGER_HIGH = [-0.22, -0.15], [0.22, 0.15]
LOOPS = {
    "joint speed of Reacher": Loop(
        task("Reacher-v5"), [of.JointSpeedLimit(4.0)], below_speed([0, 1], 4.0), (*ANY, full), 200, used=0.2
    ),
    # Infeasible steps, too fast to stop within the horizon, may take it out, by a hair.
    "joint position of Reacher": Loop(
        task("Reacher-v5"),
        [of.JointPositionLimit(-1.5, 1.5, ["joint0", "joint1"], horizon=10)],
        lambda model, data: 1.5 - np.abs(data.qpos[:2]),
        most_flagged=0.4,
        deepest=1e-3,
    ),
    "a box on Reacher": Loop(
        task("Reacher-v5"),
        [of.Workspace([*FINGER_LOW, None], [*FINGER_HIGH, None], bodies=["fingertip"], horizon=10)],
        lambda model, data: FINGER_HIGH - np.abs(data.body("fingertip").xpos[:2]),
        most_flagged=0.1,
        deepest=5e-3,
    ),
    # It starts stretched.
    "singularity of Pusher": Loop(
        task("Pusher-v5"),
        [of.SingularityMargin(0.05, body="tips_arm", horizon=8)],
        lambda model, data: manipulability(model, data, "body", "tips_arm", ARM_JOINTS) / 0.05 - 1.0,
        steps=45,
        most_flagged=0.1,
        deepest=1.0,
    ),
    "feet of Ant": feet("Ant-v5", bang_bang, noisy, steps=12),
    "feet of Humanoid": feet("Humanoid-v5", at_random, steps=30),
    "feet of HalfCheetah": feet("HalfCheetah-v5", at_random, bang_bang, noisy, steps=40),
    "a table that is pushed over": Loop(
        table,
        [of.SupportMargin(0.05)],
        inside_the_hull(0.05),
        (at_random, bang_bang, full),
        60,
        0.6,
        np.inf,
        judge=ForceJudge,
    ),
    "a cart": impact(5.0, 8e3, 12, 70),
}
"""Limits in the room's own unit, all of them on the model itself."""


@pytest.mark.filterwarnings("ignore::safe_wrappers.UnsafeStateWarning")
@pytest.mark.parametrize(
    ("name", "driver"),
    [(name, driver) for name, loop in LOOPS.items() for driver in loop.drivers],
    ids=lambda one: getattr(one, "__name__", one),
)
def test_no_step_that_is_not_flagged_breaks_it(name, driver):
    loop = LOOPS[name]
    env = sw.CBFActionFilter(loop.make(), loop.limits)
    seen = drive(env, loop.judge(env, loop.room), driver, loop.steps, seed=1)
    assert seen["intervened"] > 0 or driver not in (bang_bang, full, noisy), seen  # the others may stay away
    assert seen["flagged"] <= loop.most_flagged * loop.steps, seen
    assert seen["least"] >= -loop.deepest, seen
    assert seen["least"] <= loop.used or driver is at_random, seen


@pytest.mark.parametrize("name", LOOPS)
def test_without_the_filter_one_of_them_breaks_it(name):
    loop = LOOPS[name]

    def least(driver):
        bare, rng = loop.make(), np.random.default_rng(1)
        judge, left = loop.judge(bare, loop.room), []
        bare.reset(seed=1)
        for k in range(loop.steps):
            action = driver(judge, bare.action_space, k, rng).astype(bare.action_space.dtype)
            left.append(judge.step(bare, action)[0])
        return min(left)

    assert any(least(driver) < -1e-3 for driver in reversed(loop.drivers))
