"""The stack as one: faults over handover over lease over filter, on MuJoCo tasks."""

import itertools
import math

import gymnasium as gym
import numpy as np
import pytest
from braked_cart import BrakedCart, cart_plant, lease, read_cart, stop

import safe_wrappers as sw
from safe_wrappers.wrappers.faults import Outages, RepeatedCommands

pytestmark = pytest.mark.filterwarnings("ignore::UserWarning")
RAIL = [sw.constraints.Plane([-0.9], [1]), sw.constraints.Plane([0.9], [-1])]
HAZARDS = [sw.constraints.Discs("hazard_positions", radius=0.2)]


class Task:
    """What each layer is given on an env."""

    def __init__(self, env_id, constraint, lease):
        self.env_id, self.constraint, self.lease = env_id, constraint, lease

    def filter(self, env):
        return sw.CBFActionFilter(env, [self.constraint()])

    def record(self, env):
        return sw.RecordInterventions(env)

    def penalty(self, env):
        return sw.AdaptionPenalty(env, penalty=0.1)

    def expiry(self, env):
        return lease(env, self.constraint(), **self.lease)

    def handover(self, env):
        return sw.ChunkHandover(env, 6, 3, [0, 2], rate_limit=40.0)

    def outages(self, env):
        return Outages(env, mean_between_s=0.3, mean_length_s=0.2)

    def repeats(self, env):
        return RepeatedCommands(env, share=0.4)

    def build(self, layers):
        env = gym.make(self.env_id)
        for layer in layers:
            env = getattr(self, layer)(env)
        return env


TASKS = {
    "point": Task(
        "SafePointGoal1-v0",
        lambda: sw.constraints.HeadingDriveClearance(HAZARDS, margin=0.004),
        {"closing_speed": 4.0, "max_lease_s": 0.15},
    ),
    "pendulum": Task(
        "InvertedPendulum-v5",
        lambda: sw.constraints.Clearance(RAIL, bodies=["cart"], braking=8.0),
        {"acceleration": 20.0, "max_lease_s": 0.2},
    ),
    "reacher": Task(
        "Reacher-v5",
        lambda: sw.constraints.JointPositionLimit(-1.5, 1.5, ["joint1"]),
        {"closing_speed": 10.0, "max_lease_s": 0.15},
    ),
}
ORDER = ["filter", "expiry", "record", "penalty", "handover", "outages", "repeats"]
"""From the innermost to the outermost."""


def legal(layers):
    return "penalty" not in layers or "filter" in layers


PAIRS = [list(p) for p in itertools.combinations(ORDER, 2)]
PAIRS = [p if legal(p) else ["filter", *p] for p in PAIRS]


def actions(env, steps, seed=0):
    """Bang-bang held for a while, and now and then not a number."""
    rng = np.random.default_rng(seed)
    space = env.action_space
    held = rng.choice([0.0, 1.0], (steps // 5 + 1, *space.shape)).repeat(5, axis=0)[:steps]
    made = (space.low + held * (space.high - space.low)).astype(space.dtype)
    made[7::19] = np.nan
    return made


class Watch(gym.Wrapper):
    """Innermost: nothing but finite commands inside the box ever comes through."""

    def reset(self, **kwargs):
        self.sent = []
        return self.env.reset(**kwargs)

    def step(self, action):
        assert np.isfinite(action).all() and self.action_space.contains(np.asarray(action))
        self.sent.append(np.array(action, np.float64))
        return self.env.step(action)


@pytest.mark.parametrize("layers", [["filter", "expiry"], ["filter", "expiry", "handover"]], ids="+".join)
def test_with_nothing_to_say_every_layer_passes_on_the_same_bits(layers):
    """Chunks of a constant command, full leases, far limits: the arm gets what the policy gave."""
    env = watch = Watch(gym.make("Reacher-v5"))
    far = sw.constraints.JointSpeedLimit(1e9)
    env = sw.CBFActionFilter(env, [far])
    env = sw.LeaseExpiry(env, sw.StoppingBudget(sw.constraints.JointSpeedLimit(1e9), closing_speed=1.0))
    if "handover" in layers:
        env = sw.ChunkHandover(env, 4, 2, rate_limit=1e6)
    env.reset(seed=0)
    rng, wanted = np.random.default_rng(0), []
    for _ in range(20):
        action = rng.uniform(-1.0, 1.0, env.action_space.shape).astype(np.float32)
        env.step(action)
        wanted += list(action[:2].astype(np.float64)) if "handover" in layers else [action.astype(np.float64)]
    assert np.array(watch.sent).tobytes() == np.array(wanted).tobytes()


# The filter has the last word ---------------------------------------------------------------------------------


def reckless(robot, rng, t):
    """At the nearest hazard at full drive; now and then anything."""
    if t % 60 >= 50:
        return rng.uniform(-1.0, 1.0, 2)
    to = robot.hazard_positions - robot.agent_position
    dx, dy = to[np.argsort((to**2).sum(1))[(t // 60) % 2]]
    return np.array(
        [1.0, np.clip(4.0 * math.remainder(math.atan2(dy, dx) - robot.agent_heading, math.tau), -1, 1)]
    )


@pytest.mark.parametrize(
    ("least", "fault", "filters"),
    [
        (
            0.0,
            lambda env: Outages(env, 0.5, 0.3),
            False,
        ),  # the lease alone keeps it away from where a filter acts
        (0.02, lambda env: Outages(env, 0.5, 0.3), True),
        (0.02, lambda env: RepeatedCommands(Outages(env, 0.5, 0.3), 0.3), True),
    ],
)
def test_a_leased_and_filtered_point_goal_never_violates_whatever_the_policy_or_the_link_do(
    least, fault, filters
):
    made = TASKS["point"]
    env = made.filter(gym.make(made.env_id, max_episode_steps=400))
    env = sw.LeaseExpiry(
        env, sw.StoppingBudget(made.constraint(), closing_speed=4.0), max_lease_s=0.3, min_lease_s=least
    )
    env = fault(sw.RecordInterventions(env))
    rng = np.random.default_rng(0)
    told = dict.fromkeys(("lease/braking", "cbf/intervened"), 0)
    for seed in range(3):
        env.reset(seed=seed)
        for t in range(400):
            info = env.step(reckless(env.unwrapped, rng, t).astype(np.float32))[4]
            assert info["cost_hazards"] == 0.0
            for key in told:
                told[key] += info[key]
        assert info["interventions"]["lease_braking"] > 0
    assert told["lease/braking"] > 0, told
    assert (told["cbf/intervened"] > 0) == filters, told


@pytest.mark.parametrize("change", [5.0, 1e9])
def test_chunks_under_a_lease_hit_nothing_whatever_is_lost(change):
    """A cart at a wall: chunks of full throttle that come late or not at all, and a queue that rolls on when dry."""
    hits = {True: 0, False: 0}
    for seed in range(30):
        for guarded in hits:
            rng = np.random.default_rng(seed)
            dt = float(rng.choice([0.02, 0.1]))
            delay = rng.uniform(0.0, 2.0 * dt)
            cart = BrakedCart(
                dt, rng.uniform(2.0, 6.0), rng.uniform(0.5, 2.0), rng.uniform(1.0, 5.0), delay_s=delay
            )
            env = cart
            if guarded:
                env = sw.LeaseExpiry(
                    cart,
                    sw.StoppingBudget(
                        read_cart, braking=cart.braking, acceleration=cart.drive, delays_s=delay
                    ),
                    fallback=stop,
                    plant=cart_plant(dt),
                )
            env = sw.ChunkHandover(env, 8, 4, [0, 3], rate_limit=change / dt, fallback="zero")
            env = Outages(RepeatedCommands(env, 0.2), 10.0 * dt, 10.0 * dt)
            env.reset(seed=seed)
            for _ in range(round(1.5 / dt)):
                room = cart.wall - cart.x - 8.0 * dt * cart.v
                full = cart.v**2 / (2.0 * cart.braking) < room
                env.step(np.tile([1.0, 0.0] if full else [0.0, 1.0], (8, 1)).astype(np.float32))
            hits[guarded] += cart.farthest >= cart.wall
    assert hits[True] == 0 and hits[False] > 0, hits
