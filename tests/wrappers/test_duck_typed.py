"""Constraints by their methods alone, as they were written before `Constraint` was a base class: still heard."""

from functools import partial

import gymnasium as gym
import numpy as np
import pytest
from worlds import Cart, SpeedRow, cart_plant

import safe_wrappers as sw
from safe_wrappers.errors import ConfigurationError
from safe_wrappers.filter.search import Stage

deprecated = partial(pytest.warns, DeprecationWarning, match="make it a subclass of sw.Constraint")


class OldRow:
    """`SpeedRow` as it was: no base class, rows of a plant."""

    def __init__(self, limit):
        self.limit = limit

    def rows(self, plant):
        return sw.HalfSpaces(np.array([[plant.control_dt]]), np.array([self.limit - plant.state[1]]))


class OldLimit:
    """Every method of its time: the speed after the hold stays below a limit, margin kept free."""

    scale, margin = 2.0, 0.0

    def __init__(self):
        self.asked, self.suggested, self.backed, self.linear = [], [], [], True

    def bind(self, plant):
        self.asked.append("bind")
        self.bound_to = plant

    def reset(self):
        self.asked.append("reset")

    def check(self, plant):
        self.asked.append("check")
        if plant.state[1] > 9.0:
            raise ConfigurationError("too fast to begin with")

    def value(self, plant):
        return np.array([1.0 - plant.state[1]])

    def rows(self, plant):
        return sw.HalfSpaces.none(1)

    def shortfall(self, plant, control):
        return plant.state[1] + plant.control_dt * control[0] - 1.0 + self.margin

    def admits(self, plant, control):
        assert plant is self.bound_to
        return self.shortfall(plant, control) <= 0.0

    def cut(self, plant, control):
        if not self.linear:
            return sw.HalfSpaces.none(1)
        return sw.HalfSpaces(
            np.array([[plant.control_dt]]), np.array([1.0 - self.margin - plant.state[1] - 1e-6])
        )

    def suggestions(self, plant, control):
        return [np.array(each) for each in self.suggested]

    def backup(self, plant):
        return np.array(self.backed) if self.backed else None

    def report(self, proposed, executed):
        return {"old/proposed": float(proposed[0]), "old/executed": float(executed[0])}


def old(limit, state=(0.0, 0.0), **options):
    """A cart in the filter of an old constraint, after a reset; and the copy of it that the filter asks."""
    with deprecated():
        env = sw.CBFActionFilter(Cart(), [limit], plant=cart_plant(), **options)
    env.reset(seed=0, options={"state": list(state)})
    return env, env.filter.bound[0]._given


def test_rows_alone_are_projected_on_and_the_user_is_told_how_to_write_them():
    new = sw.CBFActionFilter(Cart(), [SpeedRow(0.25)], plant=cart_plant())
    new.reset(seed=0)
    with pytest.warns(DeprecationWarning, match=r"^OldRow is a constraint by its methods alone") as caught:
        env = sw.CBFActionFilter(Cart(), [OldRow(0.25)], plant=cart_plant())
    assert caught[0].filename == __file__
    env.reset(seed=0)
    for _ in range(5):
        one, other = (filtered.step(np.ones(1, np.float32))[4] for filtered in (new, env))
        np.testing.assert_array_equal(one["executed_action"], other["executed_action"])
        assert one["cbf/stage"] == other["cbf/stage"]
    assert env.unwrapped.state[1] == pytest.approx(0.25, abs=1e-6)


def test_a_recorded_env_with_one_is_rebuilt():
    with deprecated():
        env = sw.CBFActionFilter(gym.make("Reacher-v5"), [OldFree()])
    again = gym.make(env.spec)
    again.reset(seed=0)
    assert not again.step(np.zeros(2, np.float32))[4]["cbf/intervened"]


class OldFree:
    """Asks for nothing."""

    def rows(self, plant):
        return sw.HalfSpaces.none(2)


def test_bind_reset_check_value_and_report_are_asked():
    env, limit = old(OldLimit())
    assert limit.asked == ["bind", "reset", "check"]
    _, info = env.reset(seed=0, options={"state": [0.0, 0.5]})
    assert limit.asked[3:] == ["reset", "check"]
    assert info["cbf/margin"] == 0.5 and info["old/proposed"] == info["old/executed"] == 0.0
    info = env.step(np.array([0.25], np.float32))[4]
    assert info["cbf/margin"] == 0.5 and not info["cbf/intervened"]
    assert info["old/proposed"] == info["old/executed"] == 0.25
    with pytest.raises(ConfigurationError, match="too fast to begin with"):
        env.reset(seed=0, options={"state": [0.0, 10.0]})


def test_the_callers_object_is_left_alone():
    mine = OldLimit()
    old(mine)
    assert mine.asked == []


@pytest.mark.parametrize(
    ("suggested", "backed", "linear", "executed", "stage"),
    [
        ([[0.25]], [], True, 0.25, Stage.CANDIDATE),
        ([[0.75]], [], True, 0.5, Stage.RELINEARIZED),
        ([], [-0.1], False, None, Stage.BLEND),
    ],
)
def test_a_refused_control_is_answered_by_what_it_offers(suggested, backed, linear, executed, stage):
    env, limit = old(OldLimit(), (0.0, 0.95))
    limit.suggested, limit.backed, limit.linear = suggested, backed, linear
    info = env.step(np.array([1.0], np.float32))[4]
    assert info["cbf/refused"].all() and not info["cbf/infeasible"]
    assert info["cbf/stage"] == stage and info["old/executed"] == info["executed_action"][0] <= 0.5
    if executed is not None:
        assert info["executed_action"][0] == pytest.approx(executed, abs=1e-4)


def test_where_all_fails_its_shortfall_counts():
    env, limit = old(OldLimit())
    limit.suggested = [[-1.0]]
    with pytest.warns(sw.UnsafeStateWarning):
        env.reset(seed=0, options={"state": [0.0, 3.0]})
    (bound,) = env.filter.bound
    assert bound.scale == 2.0 and bound.slack(np.ones(1)) == -limit.shortfall(env.plant, np.ones(1))
    info = env.step(np.array([1.0], np.float32))[4]
    assert info["cbf/infeasible"] and info["executed_action"][0] == -1.0


def test_one_that_admits_without_a_shortfall_has_no_slack_to_compare():
    class Strict(OldRow):
        def admits(self, plant, control):
            return control[0] <= self.limit

    env, _ = old(Strict(0.5))
    (bound,) = env.filter.bound
    assert bound.slack(np.array([0.4])) == 0.0 and bound.slack(np.array([0.6])) == -np.inf
    assert bound.scale == 1.0 and bound.backup() is None and not bound.linearize(np.ones(1)).offsets.size


def test_its_margin_is_widened():
    env, limit = old(OldLimit(), (0.0, 0.95), margin=0.02)
    assert limit.margin == 0.02 and OldLimit.margin == 0.0
    info = env.step(np.array([1.0], np.float32))[4]
    assert info["executed_action"][0] == pytest.approx(0.3, abs=1e-4)
    with deprecated(), pytest.raises(ConfigurationError, match="no margin to widen"):
        sw.CBFActionFilter(Cart(), [OldRow(1.0)], plant=cart_plant(), margin=0.1)


@pytest.mark.parametrize("nothing", [OldRow, 3.0, object()])
def test_what_is_no_constraint_is_refused(nothing):
    with pytest.raises(ConfigurationError, match=r"expected a constraint \(a sw.Constraint\)"):
        sw.CBFActionFilter(Cart(), [nothing], plant=cart_plant())
