"""Constructors that are called without an argument, or with one that they do not take, say so in words."""

import copy
import inspect
import pickle

import gymnasium as gym
import pytest

import safe_wrappers as sw
from safe_wrappers.errors import ConfigurationError

REQUIRED = inspect.Parameter.empty
EXPORTED = [
    *(getattr(sw.constraints, name) for name in sw.constraints.__all__ if not name.startswith("Bound")),
    *(getattr(sw, name) for name in sw.__all__),
]
TELLING = sw.Constraint | gym.Wrapper | sw.AnalyticPlant | sw.IdentifiedPlant | sw.constraints.Disc
KINDS = [
    one for one in EXPORTED if isinstance(one, type) and issubclass(one, TELLING) and one is not sw.Constraint
]


@pytest.mark.parametrize("kind", KINDS)
def test_a_missing_argument_is_named_with_its_meaning(kind):
    parameters = inspect.signature(kind).parameters
    needed = [name for name, one in parameters.items() if one.default is REQUIRED and name != "env"]
    for name in needed:
        others = {one: 1 for one in parameters if one in ("env", *needed) and one != name}
        if issubclass(kind, gym.Wrapper) or others:
            with pytest.raises(
                ConfigurationError, match=rf"^{kind.__name__} needs {name}: .{{8,}}"
            ) as caught:
                kind(**others)
            assert isinstance(caught.value, TypeError)


@pytest.mark.parametrize("kind", KINDS)
def test_an_unknown_argument_is_refused_with_those_that_there_are(kind):
    first = next(iter(inspect.signature(kind).parameters))
    says = rf"takes no '{first}x' \(did you mean '\w+'\?\); it takes {first}"
    with pytest.raises(ConfigurationError, match=says):
        kind(**{f"{first}x": 1})


def test_the_examples_of_the_issue():
    for call, says in (
        (lambda: sw.constraints.JointSpeedLimit(), r"needs limit: In rad/s for hinges"),
        (lambda: sw.constraints.PredictiveShield(lambda x: 1.0), r"needs horizon: Steps"),
        (lambda: sw.CBFActionFilter(gym.make("Reacher-v5")), r"needs constraints: "),
    ):
        with pytest.raises(ConfigurationError, match=says):
            call()


def test_filters_and_constraints_are_copied_and_pickled_as_before():
    limit = sw.constraints.JointSpeedLimit(4.0)
    assert copy.deepcopy(limit) == pickle.loads(pickle.dumps(limit)) == limit
    env = copy.deepcopy(sw.CBFActionFilter(gym.make("Reacher-v5"), [limit]))
    env.reset(seed=0)
    assert env.step(env.action_space.sample())[4]["cbf/margin"] > 0.0
