"""Whole stacks under any sequence of calls: resets, actions of any kind, other margins, copies, closing.

Beside each stack goes a twin that is never given what the stack refuses, looks aside at or copies. The episode of the
stack is the twin's bit for bit, whatever happened in between; nothing that is not finite, or outside the action
space, reaches the task; and the counts are those of a count beside it.
"""

import copy
import pickle
import warnings

import gymnasium as gym
import numpy as np
import pytest
from asking import pendulum_plant
from episodes import plain
from hypothesis import HealthCheck, settings
from hypothesis import strategies as st
from hypothesis.stateful import (
    RuleBasedStateMachine,
    initialize,
    invariant,
    precondition,
    rule,
    run_state_machine_as_test,
)

import safe_wrappers as sw
from safe_wrappers import info as keys
from safe_wrappers.errors import SafeWrappersError

HORIZON = 15
REFUSALS = (SafeWrappersError, gym.error.Error)


class Bottom(gym.Wrapper):
    """The task keeps to itself what it was given that is no action."""

    def __init__(self, env):
        super().__init__(env)
        self.wrong = []

    def step(self, action):
        given = np.asarray(action, np.float64)
        low, high = self.action_space.low, self.action_space.high
        if given.shape != low.shape or not ((given >= low) & (given <= high)).all():
            self.wrong.append(action)
        return super().step(action)


def slow(x):
    return 9.0 - x[1] ** 2  # rad^2/s^2


def made(env_id):
    return Bottom(gym.make(env_id, max_episode_steps=HORIZON, disable_env_checker=True))


def point_goal():
    env = sw.protect(made("SafePointGoal1-v0"))
    return sw.RecordInterventions(sw.FilterObservation(env))


def reacher():
    env = sw.CBFActionFilter(made("Reacher-v5"), [sw.constraints.JointSpeedLimit(2.0)])
    return sw.AdaptionPenalty(sw.RecordInterventions(env), penalty=0.5)


def pendulum():
    limits = [sw.constraints.Barrier(slow)]
    return sw.RecordInterventions(sw.CBFActionFilter(made("Pendulum-v1"), limits, pendulum_plant()))


STACKS = [point_goal, reacher, pendulum]
SHARES = st.lists(st.floats(0.0, 1.0, width=32), min_size=4, max_size=4)


def inside(space, shares):
    """An action within the space, in its dtype."""
    low, high = space.low, space.high
    return np.clip(low + np.resize(shares, low.shape) * (high - low), low, high).astype(space.dtype)


FORMS = {
    "list": lambda a: a.tolist(),
    "tuple of numbers": lambda a: tuple(a.tolist()),
    "float64": lambda a: a.astype(np.float64),
    "float16": lambda a: (0.5 * a).astype(np.float16),
    "whole numbers": lambda a: np.zeros(a.shape, np.int64),
    "strided": lambda a: np.repeat(a, 2, axis=-1)[..., ::2],
    "objects": lambda a: a.astype(object),
    "texts of numbers": lambda a: a.astype(str),
    "denormal": lambda a: np.full(a.shape, 5e-324),
    "outside": lambda a: 3.0 * a + 1.5,
    "huge": lambda a: np.full(a.shape, 1e300),
    "beyond float32": lambda a: np.full(a.shape, -1e39),
    "nan": lambda a: np.full(a.shape, np.nan, np.float32),
    "inf": lambda a: np.full(a.shape, -np.inf),
    "longer": lambda a: np.concatenate([a, a], axis=-1),
    "a row": lambda a: a[None],
    "0-d": lambda a: np.float32(0.1),
    "a number": lambda a: 0.1,
    "empty": lambda a: np.zeros(0),
    "text": lambda a: "fast",
    "None": lambda a: None,
    "complex": lambda a: a * (0.5 + 0.5j),
    "ragged": lambda a: [[0.1], [0.1, 0.2]],
    "objects that are none": lambda a: np.full(a.shape, None),
    "dates": lambda a: np.full(a.shape, "2020-01-01", dtype="datetime64[D]"),
    "mapping": lambda a: {"action": a},
    "beyond float64": lambda a: np.full(a.shape, 10**400, dtype=object),
    "masked": lambda a: np.ma.masked_array(a, True),
}
SEEDS = st.one_of(st.none(), st.integers(0, 5))


def answer(call, *arguments, **options):
    """What a call returns, or its refusal, which has to say something."""
    try:
        return call(*arguments, **options), None
    except REFUSALS as refusal:
        assert str(refusal).strip(), repr(refusal)
        return None, refusal


class Calls(RuleBasedStateMachine):
    """Any calls on a stack, and those that it did not refuse on its twin."""

    make = staticmethod(pendulum)

    @initialize()
    def begin(self):
        self.stack, self.twin = self.make(), self.make()
        self.running = self.seeded = False  # whether an episode has begun, and ever one with a seed
        self.episode = []

    @rule(seed=SEEDS)
    def reset(self, seed):
        if not self.seeded and seed is None:
            seed = 0
        self.seeded = True
        start = self.stack.reset(seed=seed)
        assert plain(start) == plain(self.twin.reset(seed=seed))
        self.running, self.episode = True, []

    @rule(seed=st.sampled_from([-1, 0.5, "seven"]))
    def reset_refused(self, seed):
        assert answer(self.stack.reset, seed=seed)[1] is not None
        self.running = False  # Gymnasium's own wrappers have begun to reset

    @rule(shares=SHARES, form=st.sampled_from([None, None, None, *FORMS]))
    def step(self, shares, form):
        action = inside(self.stack.action_space, shares)
        given = action if form is None else FORMS[form](action)
        found, refusal = answer(self.stack.step, given)
        if not self.running:
            assert refusal is not None or self.seeded, "a step before the first reset"
            return
        if refusal is not None:
            assert form is not None, refusal
            return
        expected = self.twin.step(FORMS[form](action) if form else action)
        assert plain(found) == plain(expected), form
        self.episode.append(found)
        self.counted()

    def counted(self):
        """The counts of the stack against a count beside it, and its keys against those of the first step."""
        infos = [step[4] for step in self.episode]
        *_, terminated, truncated, info = self.episode[-1]
        assert {keys.EXECUTED_ACTION, keys.CBF_STAGE, *keys.CBF_BOOLS} <= info.keys()
        steps = len(infos)
        if terminated or truncated:
            summary = info[keys.EPISODE_SUMMARY]
            assert summary["length"] == steps
            assert summary["intervention_rate"] == sum(bool(i[keys.CBF_INTERVENED]) for i in infos) / steps
            assert summary["margin_min"] == min(float(i[keys.CBF_MARGIN]) for i in infos)
            assert summary["nonfinite"] == sum(bool(i[keys.CBF_NONFINITE]) for i in infos)
            rewards = [
                float(step[1]) + float(step[4].get(keys.ADAPTION_PENALTY, 0.0)) for step in self.episode
            ]
            assert summary["return"] == pytest.approx(sum(rewards), abs=1e-9)

    @precondition(lambda self: self.running)
    @rule()
    def look_on(self):
        self.stack.get_wrapper_attr("look")()

    @rule(
        again=st.sampled_from([copy.deepcopy, lambda env: pickle.loads(pickle.dumps(env))]),
        seed=st.integers(0, 5),
    )
    def copy(self, again, seed):
        """A copy has the episodes of a stack that is made anew; the original does not notice."""
        copied, anew = again(self.stack), self.make()
        assert plain(copied.reset(seed=seed)) == plain(anew.reset(seed=seed))
        for share in (0.0, 1.0):
            action = inside(anew.action_space, [share])
            assert plain(copied.step(action)) == plain(anew.step(action))

    @rule(times=st.integers(1, 2))
    def close(self, times):
        for _ in range(times):
            self.stack.close()

    @invariant()
    def nothing_wrong_reached_the_task(self):
        if hasattr(self, "stack"):
            assert not self.stack.get_wrapper_attr("wrong")


def run(machine, examples, steps):
    """More where examples are drawn anew in every run."""
    times = 1 if settings.default.derandomize else 10
    quiet = [HealthCheck.too_slow, HealthCheck.filter_too_much]
    limits = settings(
        max_examples=times * examples, stateful_step_count=steps, deadline=None, suppress_health_check=quiet
    )
    with warnings.catch_warnings(action="ignore"):
        run_state_machine_as_test(machine, settings=limits)


@pytest.mark.hypothesis
@pytest.mark.parametrize("stack", STACKS, ids=lambda stack: stack.__name__)
def test_any_calls_on_a_stack(stack):
    run(type("Case", (Calls,), {"make": staticmethod(stack)}), 3, 15)
