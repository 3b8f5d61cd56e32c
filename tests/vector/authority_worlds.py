"""Stacks of faults, handover, lease and filter for the vector envs, and the same stacks by hand.

Everything is a function or a class of a module, so that a spawned process can unpickle it; no learner is imported.
"""

import gymnasium as gym
from vector_worlds import DT, AtHazard, ScheduledCart, drift, push, read

import safe_wrappers as sw
from safe_wrappers.wrappers.faults import Outages, RepeatedCommands

HAZARDS = [sw.constraints.Discs("hazard_positions", radius=0.2)]
RAIL = [sw.constraints.Plane([-0.9], [1]), sw.constraints.Plane([0.9], [-1])]


def _plant():
    return sw.AnalyticPlant(f=drift, g=push, state=read, control_dt=DT)


def cart(index=0, chunked=True):
    """A cart in front of a wall; `hold` shows the last command after a reset, and what is left of an episode."""
    wall = sw.constraints.Clearance(
        [sw.constraints.Plane([1.0], [-1.0])], braking=1.0, position=[0], velocity=[1]
    )
    env = sw.CBFActionFilter(ScheduledCart(index), [wall], plant=_plant(), fallback="hold")
    env = sw.LeaseExpiry(
        env,
        sw.StoppingBudget(wall, acceleration=1.0),
        plant=_plant(),
        fallback="hold",
        max_lease_s=0.3,
        min_lease_s=0.1,
    )
    env = sw.RecordInterventions(env)
    if chunked:
        env = sw.ChunkHandover(env, 4, 2, [0, 2], rate_limit=6.0, fallback="hold")
    return RepeatedCommands(Outages(env, 0.6, 0.3), 0.2)


def single_cart(index=0):
    """The same without chunks."""
    return cart(index, chunked=False)


def point_goal(index=0):
    clearance = sw.constraints.HeadingDriveClearance(HAZARDS, margin=0.004)
    env = AtHazard(gym.make("SafePointGoal1-v0", max_episode_steps=14 + 4 * index))
    env = sw.CBFActionFilter(env, [clearance], fallback="hold")
    env = sw.LeaseExpiry(
        env, sw.StoppingBudget(clearance, closing_speed=4.0), max_lease_s=0.2, min_lease_s=0.08
    )
    env = sw.ChunkHandover(sw.RecordInterventions(env), 6, 2, [0, 2], rate_limit=40.0)
    return Outages(env, 0.1, 0.1)


def pendulum(index=0):
    """Lease and faults alone, no filter; the pole falls by itself."""
    clearance = sw.constraints.Clearance(RAIL, bodies=["cart"], braking=8.0)
    env = gym.make("InvertedPendulum-v5", max_episode_steps=8 + index)
    env = sw.LeaseExpiry(env, sw.StoppingBudget(clearance, acceleration=20.0), max_lease_s=0.12)
    return Outages(sw.RecordInterventions(env), 0.12, 0.3)


TASKS = {"cart": cart, "single_cart": single_cart, "point_goal": point_goal, "pendulum": pendulum}


def _generators(env):
    """The wrappers' own random numbers, the outermost first."""
    inner, found = env, []
    while isinstance(inner, gym.Wrapper):
        found += [(inner, name) for name in ("random", "_random") if name in vars(inner)]
        inner = inner.env
    return found


class CarriedOn:
    """Makes the stack of a sub-env anew for every episode, and hands on its wrappers' random numbers.

    `by_hand` hands on the env's; nothing else may outlast an episode.
    """

    def __init__(self, make):
        self.make, self.before = make, {}

    def __call__(self, index):
        env = self.make(index)
        if index in self.before:
            for (new, name), (old, _) in zip(_generators(env), _generators(self.before[index]), strict=True):
                setattr(new, name, getattr(old, name))
        self.before[index] = env
        return env
