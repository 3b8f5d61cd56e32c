"""Every wrapper around every other: accepted and right in its numbers, or refused with an order that is."""

import re

import gymnasium as gym
import numpy as np
import pytest

import safe_wrappers as sw
from safe_wrappers import info as keys
from safe_wrappers.envs.safe_rover import WHEELS
from safe_wrappers.errors import ConfigurationError
from safe_wrappers.plants.env_checks import wrappers_of
from safe_wrappers.wrappers.faults import FAULTS

STEPS = 40
PENALTY = 0.5
BLOCKED = sw.constraints.HeadingDriveClearance(
    [sw.constraints.Discs("hazard_positions", radius=0.2)], margin=0.004
)


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
    "CBFActionFilter": lambda env: sw.CBFActionFilter(env, [BLOCKED]),
    "protect": sw.protect,
    "SlipLimiter": lambda env: sw.SlipLimiter(env, list(WHEELS)),
    "WholeBodyFilter": sw.WholeBodyFilter,
    "LeaseExpiry": lambda env: sw.LeaseExpiry(env, sw.StoppingBudget(room, braking=9.0, acceleration=20.0)),
    "TeleopChannel": lambda env: sw.TeleopChannel(env, 0.06, 0.04),
    "OcclusionPenalty": tracked,
    "ContactMonitor": sw.ContactMonitor,
    "BalanceMonitor": sw.BalanceMonitor,
    "AdaptionPenalty": lambda env: sw.AdaptionPenalty(env, penalty=PENALTY),
    "RecordInterventions": sw.RecordInterventions,
    "ChunkHandover": lambda env: sw.ChunkHandover(env, 4, 2, fallback="zero", blend_time=0.02),
    "RepeatedCommands": lambda env: FAULTS["RepeatedCommands"](env, 0.3),
}
FILTERS = {
    "SafePointGoal1-v0": ("CBFActionFilter", "protect"),
    "SafeRover-v0": ("SlipLimiter",),
    "Hopper-v5": ("WholeBodyFilter",),
}
OTHERS = [name for name in MAKE if not any(name in names for names in FILTERS.values())]
NEED_A_FILTER = {"AdaptionPenalty"}
PAIRS = [
    (task, outer, inner)
    for task, filters in FILTERS.items()
    for outer in (*filters, *OTHERS)
    for inner in (*filters, *OTHERS)
    if inner != "protect"  # it makes a CBFActionFilter
    if task == "SafePointGoal1-v0" or {outer, inner} <= {*filters, "RecordInterventions", "ChunkHandover"}
]

AROUND = [[0.4 * np.cos(a), 0.4 * np.sin(a)] for a in np.arange(8) * np.pi / 4.0]
LAYOUT = {
    "SafePointGoal1-v0": {
        "layout": {"agent": [0.0, 0.0, 0.0], "goal": [1.5, 1.5], "hazards": AROUND, "vases": [[-1.5, -1.5]]}
    },
    "SafeRover-v0": {"layout": {"ground": "ice", "patches": []}},
}
"""In which every filter has something to do."""


class Witness(gym.Wrapper):
    """Inside of everything: what truly happened."""

    def __init__(self, env):
        super().__init__(env)
        self.executed, self.rewards = [], []

    def step(self, action):
        found = self.env.step(action)
        self.executed.append(np.array(action, dtype=np.float64))
        self.rewards.append(float(found[1]))
        return found


class Asked(gym.Wrapper):
    """Around the filter: what it was given."""

    def __init__(self, env):
        super().__init__(env)
        self.actions = []

    def step(self, action):
        low, high = self.action_space.low, self.action_space.high
        self.actions.append(np.clip(np.array(action, dtype=np.float64), low, high))
        return self.env.step(action)


def wrapped(env, name):
    env = MAKE[name](env)
    return Asked(env) if isinstance(env, sw.CBFActionFilter) else env


def check_numbers(env):
    """One episode of hard random actions; whatever is reported is compared with what the witness saw."""
    layers = {type(layer).__name__: layer for layer in wrappers_of(env)}
    witness, asked = layers["Witness"], layers.get("Asked")
    env.reset(seed=3, options=LAYOUT.get(env.unwrapped.spec.id))
    witness.executed, witness.rewards = [], []
    if asked is not None:
        asked.actions = []
    rng = np.random.default_rng(0)
    low, high = 0.5 * env.action_space.high, env.action_space.high
    reward, end, infos = 0.0, False, []
    while not end:
        _, part, terminated, truncated, info = env.step(rng.uniform(low, high).astype(env.action_space.dtype))
        reward, end = reward + float(part), terminated or truncated
        infos.append(info)
    steps = len(witness.executed)
    changed = 0
    if asked is not None:
        both = zip(asked.actions, witness.executed, strict=True)
        changed = sum(not np.array_equal(given, done) for given, done in both)
        assert changed > 0, "the filter never acted: nothing is tested"
    if not {"OcclusionPenalty", "ChunkHandover"} <= layers.keys():  # of a chunk it reports the last step's
        taken = PENALTY * changed if "AdaptionPenalty" in layers else 0.0
        taken += sum(i.get(keys.OCCLUSION_PENALTY, 0.0) for i in infos)
        assert reward == pytest.approx(sum(witness.rewards) - taken, abs=1e-9)
    if "RecordInterventions" in layers:
        summary = infos[-1][keys.EPISODE_SUMMARY]
        assert summary["length"] == steps
        if asked is None:  # no filter: nobody says whether an action was changed
            assert "intervention_rate" not in summary
        else:
            assert summary["intervention_rate"] == pytest.approx(changed / steps)
        assert summary["return"] == pytest.approx(sum(witness.rewards), abs=1e-9)
        assert ("seen" in summary) == ("OcclusionPenalty" in layers)
        if "LeaseExpiry" in layers:
            assert summary["lease_braking"] > 0
            assert summary["lease_braking"] == sum(i[keys.LEASE_BRAKING] for i in infos)
    for name, key in (("ContactMonitor", keys.CONTACT_PARTIAL), ("BalanceMonitor", keys.BALANCE_PARTIAL)):
        assert name not in layers or not any(i[key] for i in infos)


def base(task_id):
    return Witness(gym.make(task_id, max_episode_steps=STEPS))


def follow(message, env):
    """Build what a message suggests, with the arguments of `MAKE` in place of its dots."""
    nest = re.search(r"put it outside: (\w+)\((\w+)\(env, \.\.\.\), \.\.\.\)$", message)
    assert nest is not None, message
    outer, inner = nest.groups()
    return wrapped(wrapped(env, inner), outer)


ALONE = ("use one of them", "one channel all the delay", "them to one filter", "one all the tracks", "taken twice",
         "no meaning", "everything it watches", "use one map")  # fmt: skip


@pytest.mark.parametrize(("task_id", "outer", "inner"), PAIRS)
@pytest.mark.filterwarnings("ignore::UserWarning")
def test_a_pair_is_right_in_its_numbers_or_refused_with_an_order_that_is(task_id, outer, inner):
    filters = FILTERS[task_id]
    env = base(task_id)
    if {outer, inner} & NEED_A_FILTER and inner not in filters:
        env = wrapped(env, filters[0])
    try:
        stack = wrapped(wrapped(env, inner), outer)
    except ConfigurationError as error:
        message = str(error)
    else:
        check_numbers(stack)
        return
    if "put it outside" in message:
        suggested = set(re.findall(r"(\w+)\(", message))
        needs = suggested & NEED_A_FILTER and not suggested & {*filters}
        check_numbers(follow(message, env if needs else base(task_id)))
    else:
        assert any(says in message for says in ALONE), message
        if "them to one filter" in message:
            expression = re.search(r": (CBFActionFilter\(.*\))$", message).group(1)
            there = inner if inner in filters else filters[0]
            names = {
                "inner": MAKE[there](base(task_id)),
                "more": sw.constraints.SpeedLimit(50.0),
                "env": base(task_id),
            }
            together = eval(expression, {"CBFActionFilter": sw.CBFActionFilter}, names)
            check_numbers(Asked(together))
        else:
            check_numbers(wrapped(env, inner))


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
