"""The stack as one: every wrapper around every other, and what has the last word when links and policies fail."""

import math
import re

import gymnasium as gym
import numpy as np
import pytest
from braked_cart import BrakedCart, cart_plant, lease, read_cart, stop

import safe_wrappers as sw
from safe_wrappers import info as keys
from safe_wrappers.envs.safe_rover import WHEELS
from safe_wrappers.errors import ConfigurationError
from safe_wrappers.plants.env_checks import wrappers_of
from safe_wrappers.wrappers.faults import Outages, RepeatedCommands

pytestmark = pytest.mark.filterwarnings("ignore::UserWarning")
STEPS, PENALTY = 40, 0.5
HAZARDS = sw.constraints.HeadingDriveClearance(
    [sw.constraints.Discs("hazard_positions", radius=0.2)], margin=0.004
)


# Every wrapper around every other -------------------------------------------------------------------------------


def tracked(env):
    """Some body of the env, seen from another."""
    model = env.unwrapped.model
    named = [model.body(i).name for i in range(model.nbody) if model.body(i).name]
    track = sw.occlusion.Track(named[-1], acceleration_noise=0.1)
    eye = {"site": model.site(0).name} if model.nsite else "track"
    return sw.OcclusionPenalty(env, [track], eye, tolerance=0.3, weight=0.25, observe=False)


def room(env):
    """Now and then too little for a lease."""
    return (9.0 if env.unwrapped.data.time % 0.4 < 0.3 else 0.05), 1.0


MAKE = {
    "CBFActionFilter": lambda env: sw.CBFActionFilter(env, [HAZARDS]),
    "protect": sw.protect,
    "SlipLimiter": lambda env: sw.SlipLimiter(env, list(WHEELS)),
    "WholeBodyFilter": sw.WholeBodyFilter,
    "LeaseExpiry": lambda env: lease(env, room, braking=9.0, acceleration=20.0),
    "TeleopChannel": lambda env: sw.TeleopChannel(env, 0.06, 0.04),
    "OcclusionPenalty": tracked,
    "ContactMonitor": sw.ContactMonitor,
    "BalanceMonitor": sw.BalanceMonitor,
    "AdaptionPenalty": lambda env: sw.AdaptionPenalty(env, penalty=PENALTY),
    "RecordInterventions": sw.RecordInterventions,
    "ChunkHandover": lambda env: sw.ChunkHandover(env, 4, 2, fallback="zero", blend_time=0.02),
    "RepeatedCommands": lambda env: RepeatedCommands(env, 0.3),
}
FILTERS = {
    "SafePointGoal1-v0": ("CBFActionFilter", "protect"),
    "SafeRover-v0": ("SlipLimiter",),
    "Hopper-v5": ("WholeBodyFilter",),
}
OTHERS = [name for name in MAKE if not any(name in names for names in FILTERS.values())]
PAIRS = [
    (task, outer, inner)
    for task, filters in FILTERS.items()
    for outer in (*filters, *OTHERS)
    for inner in (*filters, *OTHERS)
    if inner != "protect"  # it makes a CBFActionFilter
    if task == "SafePointGoal1-v0" or {outer, inner} <= {*filters, "RecordInterventions", "ChunkHandover"}
]

AROUND = [[0.4 * np.cos(a), 0.4 * np.sin(a)] for a in np.arange(8) * np.pi / 4.0]
PLACES = {"agent": [0.0, 0.0, 0.0], "goal": [1.5, 1.5], "hazards": AROUND, "vases": [[-1.5, -1.5]]}
LAYOUT = {"SafePointGoal1-v0": PLACES, "SafeRover-v0": {"ground": "ice", "patches": []}}
"""In which every filter has something to do."""


class Witness(gym.Wrapper):
    """Keeps the actions and rewards of an episode that come by."""

    def reset(self, **how):
        self.actions, self.rewards = [], []
        return self.env.reset(**how)

    def step(self, action):
        assert np.isfinite(action).all()
        self.actions.append(np.array(action, dtype=np.float64))
        found = self.env.step(action)
        self.rewards.append(float(found[1]))
        return found


class Asked(Witness):
    """Around the filter."""


def wrapped(env, name):
    env = MAKE[name](env)
    return Asked(env) if isinstance(env, sw.CBFActionFilter) else env


def check_numbers(env):
    """One episode of hard random actions; whatever is reported is compared with what the witnesses saw."""
    layers = {type(layer).__name__: layer for layer in wrappers_of(env)}
    witness, asked = layers["Witness"], layers.get("Asked")
    layout = LAYOUT.get(env.unwrapped.spec.id)
    env.reset(seed=3, options=layout and {"layout": layout})
    rng = np.random.default_rng(0)
    low, high = 0.5 * env.action_space.high, env.action_space.high
    reward, end, infos = 0.0, False, []
    while not end:
        _, part, terminated, truncated, info = env.step(rng.uniform(low, high).astype(env.action_space.dtype))
        reward, end = reward + float(part), terminated or truncated
        infos.append(info)
    steps, changed = len(witness.actions), 0
    if asked is not None:
        proposed = np.clip(asked.actions, asked.action_space.low, asked.action_space.high)
        changed = sum((proposed != witness.actions).any(axis=1))
        assert changed > 0, "the filter never acted: nothing is tested"
    if not {"OcclusionPenalty", "ChunkHandover"} <= layers.keys():  # of a chunk it reports the last step's
        taken = PENALTY * changed if "AdaptionPenalty" in layers else 0.0
        taken += sum(i.get(keys.OCCLUSION_PENALTY, 0.0) for i in infos)
        assert reward == pytest.approx(sum(witness.rewards) - taken, abs=1e-9)
    if "RecordInterventions" in layers:
        summary = infos[-1][keys.EPISODE_SUMMARY]
        assert summary["length"] == steps
        # Without a filter nobody says whether an action was changed.
        assert summary.get("intervention_rate") == (None if asked is None else pytest.approx(changed / steps))
        assert summary["return"] == pytest.approx(sum(witness.rewards), abs=1e-9)
        assert ("seen" in summary) == ("OcclusionPenalty" in layers)
        if "LeaseExpiry" in layers:
            assert summary["lease_braking"] == sum(i[keys.LEASE_BRAKING] for i in infos) > 0
    for name, key in (("ContactMonitor", keys.CONTACT_PARTIAL), ("BalanceMonitor", keys.BALANCE_PARTIAL)):
        assert name not in layers or not any(i[key] for i in infos)


def base(task_id, *inside):
    """The task between a witness and some of the wrappers, the innermost first."""
    env = Witness(gym.make(task_id, max_episode_steps=STEPS))
    for name in inside:
        env = wrapped(env, name)
    return env


ALONE = {
    "use one of them": {"LeaseExpiry", "TeleopChannel"},
    "one channel all the delay": {"TeleopChannel"},
    "all the tracks": {"OcclusionPenalty"},
    "taken twice": {"AdaptionPenalty"},
    "no meaning": {"ChunkHandover"},
    "everything it watches": {"ContactMonitor", "BalanceMonitor"},
}
"""What a message says that has no order, and of whom."""
NEST = "RecordInterventions", "RepeatedCommands"
"""Those that may be there twice."""


@pytest.mark.parametrize(("task_id", "outer", "inner"), PAIRS)
def test_a_pair_is_right_in_its_numbers_or_refused_with_an_order_that_is(task_id, outer, inner):
    filters = FILTERS[task_id]

    def nested(*names):
        """The innermost first; an AdaptionPenalty needs a filter inside."""
        needs = "AdaptionPenalty" in names and names[0] not in filters
        return base(task_id, *filters[:1] if needs else (), *names)

    try:
        stack = nested(inner, outer)
    except ConfigurationError as error:
        message = str(error)
    else:
        assert outer != inner or outer in NEST
        check_numbers(stack)
        return
    if nest := re.search(r"put it outside: (\w+)\((\w+)\(env, \.\.\.\), \.\.\.\)$", message):
        check_numbers(nested(nest[2], nest[1]))
    elif "to one filter: CBFActionFilter(inner.env, [*inner.constraints, more])" in message:
        there = base(task_id, inner if inner in filters else filters[0]).env
        both = [*there.constraints, sw.constraints.SpeedLimit(50.0)]
        check_numbers(Asked(sw.CBFActionFilter(there.env, both)))
    else:
        assert any(says in message and {outer, inner} <= of for says, of in ALONE.items()), message
        check_numbers(nested(inner))


@pytest.mark.parametrize(
    "outer", ["CBFActionFilter", "protect", "LeaseExpiry", "TeleopChannel", "ChunkHandover"]
)
def test_recorders_of_others_are_not_refused(outer):
    monitor = pytest.importorskip("stable_baselines3.common.monitor").Monitor
    for recorder in (gym.wrappers.RecordEpisodeStatistics, monitor):
        MAKE[outer](recorder(base("SafePointGoal1-v0")))
        recorder(MAKE[outer](base("SafePointGoal1-v0")))


class Renamed(sw.RecordInterventions):
    """A user's own recorder."""


def test_a_subclass_is_refused_as_its_parent_is_and_by_its_own_name():
    with pytest.raises(ConfigurationError, match="Renamed inside CBFActionFilter"):
        MAKE["CBFActionFilter"](gym.wrappers.TimeLimit(Renamed(base("SafePointGoal1-v0")), 9))


def test_with_nothing_to_say_every_layer_passes_on_the_same_bits():
    """Full leases, far limits: the arm gets what the policy gave."""
    watch, far = Witness(gym.make("Reacher-v5")), sw.constraints.JointSpeedLimit(1e9)
    env = lease(sw.CBFActionFilter(watch, [far]), far, closing_speed=1.0)
    env = sw.ChunkHandover(env, 4, 2, rate_limit=1e6)
    env.reset(seed=0)
    rng, wanted = np.random.default_rng(0), []
    for _ in range(20):
        chunk = rng.uniform(-1.0, 1.0, env.action_space.shape).astype(np.float32)
        env.step(chunk)
        wanted += list(chunk[:2].astype(np.float64))
    assert np.array(watch.actions).tobytes() == np.array(wanted).tobytes()


# The last word --------------------------------------------------------------------------------------------------


def reckless(robot, rng, t):
    """At the nearest hazard at full drive; now and then anything."""
    if t % 60 >= 50:
        return rng.uniform(-1.0, 1.0, 2).astype(np.float32)
    dx, dy = sorted(robot.hazard_positions - robot.agent_position, key=np.linalg.norm)[(t // 60) % 2]
    angle = math.remainder(math.atan2(dy, dx) - robot.agent_heading, math.tau)
    return np.array([1.0, np.clip(4.0 * angle, -1.0, 1.0)], np.float32)


@pytest.mark.parametrize(
    ("least", "repeated"), [(None, 0.0), (0.02, 0.0), (0.02, 0.3)], ids=["lease alone", "filter", "repeated"]
)
def test_a_point_goal_never_violates_whatever_the_policy_or_the_link_do(least, repeated):
    env = gym.make("SafePointGoal1-v0", max_episode_steps=400)
    # A lease alone keeps it away from where a filter acts.
    env = env if least is None else sw.CBFActionFilter(env, [HAZARDS])
    env = lease(env, HAZARDS, closing_speed=4.0, max_lease_s=0.3, min_lease_s=least or 0.0)
    env = RepeatedCommands(Outages(sw.RecordInterventions(env), 0.5, 0.3), repeated)
    rng, told = np.random.default_rng(0), dict.fromkeys(("lease/braking", "cbf/intervened"), 0)
    for seed in range(3):
        env.reset(seed=seed)
        for t in range(400):
            info = env.step(reckless(env.unwrapped, rng, t))[4]
            assert info["cost_hazards"] == 0.0
            told = {key: told[key] + info.get(key, False) for key in told}
        assert info["interventions"]["lease_braking"] > 0
    assert told["lease/braking"] > 0 and (told["cbf/intervened"] > 0) == (least is not None), told


@pytest.mark.parametrize("change", [5.0, 1e9])
def test_chunks_under_a_lease_hit_nothing_whatever_is_lost(change):
    """A cart at a wall: chunks of full throttle that come late or not at all, and a queue that rolls on when dry."""
    hits = {True: 0, False: 0}
    for seed in range(30):
        for guarded in hits:
            rng = np.random.default_rng(seed)
            dt = float(rng.choice([0.02, 0.1]))
            wall, drive, braking = rng.uniform([2.0, 0.5, 1.0], [6.0, 2.0, 5.0])
            cart = env = BrakedCart(dt, wall, drive, braking, delay_s=rng.uniform(0.0, 2.0 * dt))
            if guarded:
                known = {"braking": braking, "acceleration": drive, "delays_s": cart.delay_s}
                env = lease(cart, read_cart, **known, fallback=stop, plant=cart_plant(dt))
            env = sw.ChunkHandover(env, 8, 4, [0, 3], rate_limit=change / dt, fallback="zero")
            env = Outages(RepeatedCommands(env, 0.2), 10.0 * dt, 10.0 * dt)
            env.reset(seed=seed)
            for _ in range(round(1.5 / dt)):
                full = cart.v**2 / (2.0 * braking) < cart.wall - cart.x - 8.0 * dt * cart.v
                env.step(np.tile([1.0, 0.0] if full else [0.0, 1.0], (8, 1)).astype(np.float32))
            hits[guarded] += cart.farthest >= cart.wall
    assert hits[True] == 0 and hits[False] > 0, hits
