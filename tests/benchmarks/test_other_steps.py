"""The benchmark of the other filters: each case has the filter that its name says, and compares the same steps."""

import numpy as np
import pytest

from benchmarks.other_steps import CASES, measure


@pytest.mark.parametrize("name", CASES)
def test_a_case_has_the_filter_of_its_name(name):
    if any(word in name for word in ("Maze", "Fetch")):
        pytest.importorskip("gymnasium_robotics")
    case, kind = CASES[name], name.split(",")[0]
    env = case.protect(case.make())
    assert kind in {type(env).__name__, *(type(c).__name__ for c in env.constraints)}


@pytest.mark.parametrize("name", ["EscapeClearance, OccludedCrossing-v0", "ImpactSpeedLimit, arm and wall"])
def test_both_envs_take_the_same_steps(name):
    made, case = [], CASES[name]

    def make():
        made.append(case.make())
        return made[-1]

    found = measure(case._replace(make=make), active=True, steps=150)
    assert 0.0 < found.share < 1.0 and found.with_us > found.without_us
    one, other = (env.unwrapped.data for env in made)
    assert np.array_equal(one.qpos, other.qpos) and np.array_equal(one.qvel, other.qvel)
