"""Worlds for the vector envs: a cart whose episodes end when the test says, and some of the library's tasks.

Everything is a function or a class of a module, so that a spawned process can unpickle it; no learner is imported.
"""

from collections import deque
from functools import partial
from typing import ClassVar

import gymnasium as gym
import numpy as np

import safe_wrappers as sw
from safe_wrappers.info import COST, COST_SUBSTEP
from safe_wrappers.wrappers.faults import Outages, RepeatedCommands

WALL = 1.0
DT = 0.1


class ScheduledCart(gym.Env):
    """x'' = u, integrated exactly; starts anywhere (at times behind the wall), ends by a schedule.

    `reset(options={"ends": [[length, ...], ...]})` gives sub-env i its episodes' lengths, row i; a negative length
    truncates instead of terminating. Without it an episode lasts four steps.
    """

    metadata: ClassVar = {"render_modes": []}
    dt = DT

    def __init__(self, index=0):
        self.action_space = gym.spaces.Box(-1.0, 1.0, (1,), np.float32)
        self.observation_space = gym.spaces.Box(-np.inf, np.inf, (2,), np.float64)
        self.index = index
        self.ends = deque()

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        if options and "ends" in options:
            self.ends = deque(options["ends"][self.index])
        self.end = self.ends.popleft() if self.ends else 4
        self.steps = 0
        self.state = self.np_random.uniform([-0.5, -0.3], [1.2, 0.3])
        if options and "start" in options:
            self.state = np.array(options["start"], dtype=np.float64)
        return self.state.copy(), {"start": self.state.copy()}

    def step(self, action):
        a = float(action[0])
        x, v = self.state
        self.state = np.array([x + v * DT + 0.5 * a * DT**2, v + a * DT])
        self.steps += 1
        over = self.steps >= abs(self.end)
        beyond = float(self.state[0] > WALL)
        info = {COST: beyond, COST_SUBSTEP: beyond, "effort": 0.7 * abs(a), "count": self.steps}
        return self.state.copy(), -abs(a), over and self.end > 0, over and self.end < 0, info


def drift(x):
    return np.array([x[1], 0.0])


def push(x):
    return np.array([[0.0], [1.0]])


def read(env):
    return env.state


def slow(x):
    return 0.25 - x[1] ** 2


def cart_plant(delay_s=0.0):
    return sw.AnalyticPlant(f=drift, g=push, state=read, control_dt=DT, delay_s=delay_s)


BEFORE_THE_WALL = sw.constraints.Clearance(
    [sw.constraints.Plane([WALL], [-1.0])], braking=1.0, position=[0], velocity=[1]
)
"""One for all envs: the filter's business is to take copies."""


def cart_filter(index=0, delay_s=0.0, fallback="hold"):
    """A cart that stays in front of a wall and below 0.5 m/s. `hold` shows the last action after a reset."""
    limits = [BEFORE_THE_WALL, sw.constraints.Barrier(slow, alpha=2.0)]
    return sw.CBFActionFilter(ScheduledCart(index), limits, plant=cart_plant(delay_s), fallback=fallback)


def cart(index=0, delay_s=0.25):
    """The whole stack; the delay makes commands in flight show in `cbf/margin`."""
    return sw.RecordInterventions(cart_filter(index, delay_s))


class AtHazard(gym.Wrapper):
    """Starts every episode in front of a hazard; goal and vase stay random."""

    def reset(self, *, seed=None, options=None):
        layout = {"agent": [0.0, 0.0, 0.0], "hazards": [[0.26, 0.0]]}
        return self.env.reset(seed=seed, options={"layout": layout})


def point_goal(index=0):
    env = gym.make("SafePointGoal1-v0", max_episode_steps=7 + 2 * index)
    plant = sw.MujocoPlant(delay_s=0.03)
    return sw.RecordInterventions(sw.protect(AtHazard(env), fallback="hold", plant=plant))


def reacher(index=0):
    env = gym.make("Reacher-v5", max_episode_steps=7 + 2 * index)
    return sw.AdaptionPenalty(sw.RecordInterventions(sw.protect(env, fallback="hold")), penalty=0.1)


class AtSpeed(gym.Wrapper):
    """Starts every episode of the rover at speed; all else stays random."""

    def reset(self, *, seed=None, options=None):
        return self.env.reset(seed=seed, options={"layout": {"speed": 2.0}})


def rover(index=0):
    """What the limiter has learnt of the ground is its state; the friction declared admits some random torques."""
    env = AtSpeed(gym.make("SafeRover-v0", max_episode_steps=7 + 2 * index))
    traction = sw.constraints.Traction(["rear_left", "rear_right"], friction=2.0)
    limiter = sw.CBFActionFilter(env, [traction], fallback="hold")
    return sw.RecordInterventions(limiter)


def commanded_cart(index=0):
    """Faults, chunks, a lease and the filter."""
    env = sw.CBFActionFilter(ScheduledCart(index), [BEFORE_THE_WALL], plant=cart_plant(), fallback="hold")
    budget = sw.StoppingBudget(BEFORE_THE_WALL, acceleration=1.0)
    lease = {"max_lease_s": 0.3, "min_lease_s": 0.1}
    env = sw.LeaseExpiry(env, budget, plant=cart_plant(), fallback="hold", **lease)
    env = sw.ChunkHandover(sw.RecordInterventions(env), 4, 2, [0, 2], rate_limit=6.0, fallback="hold")
    return RepeatedCommands(Outages(env, 0.6, 0.3), 0.2)


def occluded(index=0):
    """Estimates and sensor noise."""
    cars = sw.occlusion.Track(
        "car*", acceleration_noise=[0.0225, 0.0], reversion_s=2.0, start_position_std=[0.3, 0.0]
    )
    eye = sw.occlusion.Sensor("eye", view_deg=120, range_m=6.0)
    task = gym.make("OccludedCrossing-v0", max_episode_steps=9 + index)
    env = sw.OcclusionPenalty(task, [cars], eye, tolerance=0.5, weight=0.1)
    return sw.RecordInterventions(sw.protect(env, cars="estimated", fallback="hold"))


TASKS = {
    "cart": cart,
    "point_goal": point_goal,
    "reacher": reacher,
    "rover": rover,
    "commanded_cart": commanded_cart,
    "occluded": occluded,
}


def sub_envs(make, n=3):
    """One function per sub-env, as the vector envs want them."""
    return [partial(make, i) for i in range(n)]
