"""The crossing under drivers that try to be hit: with the true cars and with estimates nothing unflagged hits it."""

import gymnasium as gym
import numpy as np
import pytest
from crossing_drivers import CARS, DRIVERS, CarSeeking, GoalSeeking, OnTheRoad, crossing, drive

import safe_wrappers as sw

pytestmark = pytest.mark.filterwarnings("ignore::safe_wrappers.UnsafeStateWarning")


def kept_or_flagged(env, action, info):
    """The control that was executed is admitted by what was known when it was chosen, or the step says so."""
    inner = env
    while not isinstance(inner, sw.CBFActionFilter):
        inner = inner.env
    executed = info["executed_action"]
    if not (info["cbf/infeasible"] or info["cbf/fallback"]):
        assert inner.filter.bound[0].admits(executed)
    if not info["cbf/intervened"]:
        assert executed.tobytes() == action.astype(np.float64).tobytes()


@pytest.mark.parametrize("driver", DRIVERS)
@pytest.mark.parametrize("cars", ["true", "estimated"])
def test_nothing_hits_it(cars, driver):
    told = drive(crossing(cars), driver, episodes=1, steps=250, watch=kept_or_flagged)
    assert told["collisions"] == 0 and told["flagged"] <= 5, told


def test_without_a_filter_they_are_hit():
    hits = [drive(crossing(None), d, episodes=1)["collisions"] for d in (GoalSeeking, CarSeeking, OnTheRoad)]
    assert min(hits) >= 1 and sum(hits) >= 8, hits


def test_a_permission_and_ways_out_together_stop_where_it_is_safe_to():
    env = sw.OcclusionPenalty(
        gym.make("OccludedCrossing-v0"),
        CARS,
        sw.occlusion.Sensor("eye", view_deg=120, range_m=6.0),
        tolerance=0.8,
    )
    both = [
        sw.constraints.EscapeClearance("robot", [sw.constraints.TrackedDiscs(0.4)], 0.2),
        sw.constraints.TrackPermission("robot", 3.0),
    ]
    filtered = sw.CBFActionFilter(env, both)
    filtered.reset(seed=2)
    told = drive(filtered, GoalSeeking, episodes=1, steps=250)
    assert told["collisions"] == 0 and told["changed"] > 20, told
