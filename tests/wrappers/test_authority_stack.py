"""The stack as one: faults over handover over lease over filter, on MuJoCo tasks."""

import math

import gymnasium as gym
import numpy as np
import pytest
from braked_cart import BrakedCart, cart_plant, read_cart, stop

import safe_wrappers as sw
from safe_wrappers.wrappers.faults import Outages, RepeatedCommands

pytestmark = pytest.mark.filterwarnings("ignore::UserWarning")
HAZARDS = sw.constraints.HeadingDriveClearance(
    [sw.constraints.Discs("hazard_positions", radius=0.2)], margin=0.004
)


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
    env = sw.CBFActionFilter(gym.make("SafePointGoal1-v0", max_episode_steps=400), [HAZARDS])
    budget = sw.StoppingBudget(HAZARDS, closing_speed=4.0)
    env = sw.LeaseExpiry(env, budget, max_lease_s=0.3, min_lease_s=least)
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
