"""Every exported wrapper under faults in the middle of an episode: refused, flagged, harmless or an error.

Whatever comes of a fault: no number that is not finite reaches the env, no action outside the action space through a
wrapper that decides, and the next episode is bit for bit that of a wrapper that never saw the fault.
"""

import copy
import functools
import pickle
import threading
import warnings
from unittest import mock

import clarabel
import daqp
import gymnasium as gym
import numpy as np
import pytest
from episodes import actions, plain, trace
from wrapper_examples import CHUNKED, EXAMPLES, EXPORTED, FILTERS, INSIDE, ONLY_LOOKING, build

import safe_wrappers as sw
from safe_wrappers import info as keys
from safe_wrappers.errors import SafeWrappersError
from safe_wrappers.plants.env_checks import wrappers_of

pytestmark = pytest.mark.filterwarnings("ignore")
BEFORE, LONG = 7, 25
"""Steps before the fault, and of an episode."""
OURS = (SafeWrappersError, gym.error.ResetNeeded)
FILTERED = (*FILTERS, *INSIDE, "ActionShield")
"""They are filters, or have one inside."""
READ_A_PLANT = (*FILTERED, "FilterObservation", "LeaseExpiry")
"""They ask one for its state at every step, or before it."""
COUNTS = "handover/starved", "handover/limited", "teleop/lost", "action/clipped"
FLAGS = [
    name
    for name, key in keys.KEYS.items()
    if name in COUNTS or ("/" in name and key.dtype == "bool" and name != "occlusion/visible")
]
LESS_KNOWN = {"lease/remaining_s": -1, "teleop/round_trip_s": 1, "cbf/correction": 1}
"""Figures that say that something is not as usual, and in which direction."""
GATES = {}
"""By the id of a `Bottom`: events that a step is inside, and that it may go on. A copy has none."""


class BrokenError(RuntimeError):
    """What breaks raises it."""


class Bottom(gym.Wrapper):
    """The env itself: keeps what reached it, and breaks, blocks or leaves a wrong state when it is told to."""

    def __init__(self, env):
        super().__init__(env)
        self.given, self.breaks, self.leaves = [], "", None

    def step(self, action):
        if gate := GATES.pop(id(self), None):
            gate[0].set()
            gate[1].wait(20.0)
        if self.breaks == "step":
            raise BrokenError("the env broke in step")
        self.given.append(np.array(action))
        observation, *rest = self.env.step(action)
        if self.leaves is not None:
            self.unwrapped.data.qpos[0] = self.unwrapped.data.qvel[0] = self.leaves
            observation, self.leaves = np.full_like(observation, self.leaves), None
        return observation, *rest

    def reset(self, **options):
        if self.breaks == "reset":
            raise BrokenError("the env broke in reset")
        return self.env.reset(**options)


class Session:
    """A wrapper of the contract around a `Bottom`."""

    def __init__(self, name):
        self.name, self.env = name, build(name, next(iter(EXAMPLES[name])), Bottom)
        self.bottom = next(one for one in wrappers_of(self.env) if isinstance(one, Bottom))
        self.actions = actions(self.env, LONG)

    def begin(self):
        self.env.reset(seed=0)
        for action in self.actions[:BEFORE]:
            self.env.step(action)
        return self

    def step(self, action=None, env=None):
        """What a step returns, or raises, what is warned of, and what reaches the env."""
        before, returned, error = len(self.bottom.given), None, None
        with warnings.catch_warnings(record=True, action="always") as warned:
            try:
                returned = (env or self.env).step(self.actions[BEFORE] if action is None else action)
            except Exception as raised:
                error = raised
        return returned, error, [str(one.message) for one in warned], self.bottom.given[before:]

    def episode(self, env=None):
        return trace(env or self.env, steps=LONG)


@functools.cache
def undisturbed(name):
    """An episode, and the first step that a fault would hit, of a session without one."""
    session = Session(name)
    return session.episode(), session.begin().step()


@pytest.fixture(scope="module", params=EXPORTED)
def session(request):
    with warnings.catch_warnings(action="ignore"):
        made = Session(request.param)
    yield made
    made.env.close()


@pytest.fixture(autouse=True)
def as_if_nothing_had_been(session):
    """Each test leaves a session whose next episode is the first one's."""
    session.begin()
    yield
    session.bottom.breaks, session.bottom.leaves = "", None
    assert session.episode() == undisturbed(session.name)[0]


def check(session, answer, allowed=()):
    """That a fault was refused, flagged, harmless or an error that is allowed."""
    returned, error, said, reached = answer
    usual, _, usual_said, usual_reached = undisturbed(session.name)[1]
    space = session.bottom.action_space
    for given in reached:
        assert given.dtype.kind in "fiu" and np.isfinite(given).all()
        assert session.name in ONLY_LOOKING or space.contains(given.astype(space.dtype))
    if error is not None:
        assert isinstance(error, allowed) or (isinstance(error, OURS) and not reached), repr(error)
        return
    info, expected = returned[4], usual[4]
    flagged = any(np.any(info.get(key, False)) and not np.any(expected.get(key, False)) for key in FLAGS)
    flagged |= any(
        np.any(sign * (np.asarray(info[key]) - np.asarray(expected[key])) > 0.0)
        for key, sign in LESS_KNOWN.items()
        if key in info and key in expected
    )
    flagged |= not set(said) <= set(usual_said)
    passed = session.name in ONLY_LOOKING and len(reached) == len(usual_reached)
    harmless = plain(returned) == plain(usual)
    assert flagged or passed or harmless, (
        "something else happened than without the fault, and nothing says so"
    )


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf, 1e30], ids=str)
def test_a_wrong_action(session, value):
    shape = session.env.action_space.shape
    check(session, session.step(np.full(shape, value, np.float64) if shape else value))


@pytest.mark.parametrize("shape", [(0,), (1, 7), (50,)], ids=str)
def test_an_action_of_a_wrong_shape(session, shape):
    returned, error, _, reached = session.step(np.zeros(shape))
    assert returned is None and error is not None
    # A wrapper that judges no action leaves it to the env.
    assert session.name in ONLY_LOOKING or (isinstance(error, OURS) and not reached)


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_a_state_that_is_no_number(session, value):
    """A step ends in it and returns it: then, or at the next step, it is said, unless nothing reads the state."""
    session.bottom.leaves = value
    first, error, _, reached = session.step()
    if error is not None:
        assert isinstance(error, (*OURS, ValueError)), repr(error)
        return
    second, refusal, _, then = session.step(session.actions[BEFORE + 1])
    assert all(np.isfinite(given).all() for given in (*reached, *then))
    infos = [answer[4] for answer in (first, second) if answer is not None]
    told = any(
        np.any(info.get(flag, False)) for info in infos for flag in FLAGS if flag != keys.CBF_INTERVENED
    )
    assert told or isinstance(refusal, OURS) or session.name in (*ONLY_LOOKING, *CHUNKED, "TeleopChannel")


@pytest.mark.parametrize("kind", ["raises", "has no answer"])
def test_a_solver_that_fails(session, kind):
    def failing(hessian, linear, normals, upper, *arguments, **options):
        if kind == "raises":
            raise BrokenError("the solver broke")
        multipliers = {"lam": np.full(len(upper), np.nan), "iterations": 0}
        return np.full(len(hessian), np.nan), np.nan, -1, multipliers

    other = mock.Mock(side_effect=BrokenError("broken, too"))
    with mock.patch.object(daqp, "solve", failing), mock.patch.object(clarabel, "DefaultSolver", other):
        answer = session.step()
    check(session, answer, allowed=(BrokenError,))
    assert answer[1] is None or not answer[3], "no step is made where the filter has no answer"


def test_a_plant_that_raises(session):
    broken = mock.Mock(side_effect=BrokenError("no state"))
    with (
        mock.patch.object(sw.MujocoPlant, "observe", broken),
        mock.patch.object(sw.SimulatorPlant, "observe", broken),
    ):
        answer = session.step()
    assert broken.called == (session.name in READ_A_PLANT)
    check(session, answer, allowed=(BrokenError,))
    assert not broken.called or isinstance(answer[1], BrokenError)
    assert not (broken.called and answer[3]) or session.name == "FilterObservation", "it reads after the step"


@pytest.mark.parametrize("where", ["step", "reset"])
def test_an_env_that_raises(session, where):
    session.bottom.breaks = where
    with pytest.raises(BrokenError):
        session.env.reset(seed=1) if where == "reset" else session.env.step(session.actions[BEFORE])
    if where == "reset" and session.name not in ONLY_LOOKING:
        session.bottom.breaks = ""
        # Commands of the episode before are not executed in what a failed reset has left.
        _, error, _, reached = session.step()
        assert isinstance(error, gym.error.ResetNeeded) and not reached


@pytest.mark.parametrize("by_s", [-100.0, 100.0])
def test_a_clock_that_is_set(session, by_s):
    """Of the simulation, and of who stamps commands."""
    if hasattr(session.env, "set_observation_time"):
        session.env.set_observation_time(session.env.now_s + by_s)
    session.bottom.unwrapped.data.time += by_s
    check(session, session.step(), allowed=OURS)


@pytest.mark.parametrize("session", FILTERED, indirect=True)
@pytest.mark.parametrize(
    "call", [Session.step, lambda session: session.env.reset(seed=0)], ids=["step", "reset"]
)
def test_a_second_thread_waits_for_the_step_that_was_judged(session, call):
    inside, go_on = GATES[id(session.bottom)] = threading.Event(), threading.Event()
    first, second = (threading.Thread(target=one, args=(session,)) for one in (Session.step, call))
    first.start()
    try:
        assert inside.wait(20.0)
        steps = len(session.bottom.given)
        second.start()
        second.join(0.2)
        assert second.is_alive() and len(session.bottom.given) == steps
    finally:
        go_on.set()
        first.join(20.0)
        second.join(20.0)
    assert not second.is_alive()


@pytest.mark.parametrize("again", [copy.deepcopy, lambda env: pickle.loads(pickle.dumps(env))])
def test_a_copy_goes_on_or_refuses_and_has_the_same_episodes(session, again):
    copied = again(session.env)
    for action in session.actions[BEFORE : BEFORE + 3]:
        returned, error, _, _ = session.step(action, copied)
        expected = session.step(action)[0]
        assert isinstance(error, OURS) or plain(returned) == plain(expected)
    assert session.episode(copied) == undisturbed(session.name)[0]
