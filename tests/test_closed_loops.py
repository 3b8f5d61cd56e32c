"""Every env that `protect` knows, under drivers that attack it, judged on the env's own state at every substep."""

import copy
import math
import warnings
from collections import Counter
from dataclasses import replace

import gymnasium as gym
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import safe_wrappers as sw
from benchmarks import fetch
from benchmarks.cases import CASES, Case, crossing, driven
from benchmarks.judges import counted

pytestmark = [
    pytest.mark.filterwarnings("ignore::safe_wrappers.UnsafeStateWarning"),
    pytest.mark.filterwarnings("ignore:.*is out of date"),
    pytest.mark.filterwarnings("error:.*farther than the declared max_decrease"),  # of a recipe
]
STEPS = {
    "SafePointGoal": 400,
    "SafeCarGoal": 200,
    "PatrolledPointMaze": 200,
    "PointMaze": 400,
    "Pendulum": 150,
    "TeleopContact": 1500,
    "OccludedCrossing": 300,
    "Reacher": 200,
    "Hand": 20,
    "Walker2d": 150,
    "Humanoid": 80,
    "Velocity": 100,
    "Fetch": 45,
    "": 60,
}
"""Of each driver, by a part of the env's name; what is dear is short."""
HARMLESS = "Goal0", "HumanoidVelocity", "InvertedPendulum-v5"
"""Whose drivers break nothing in so few steps without a filter, the plain pendulum's because it falls first."""


def made(case: Case, filtered=True):
    if any(word in case.env_id for word in ("Maze", "Fetch", "Hand")):
        pytest.importorskip("gymnasium_robotics")
    env = case.make()
    return case.protect(env) if filtered else env


def attack(case: Case, env, driver, steps, seed=0, enough=math.inf):
    """What happened in so many steps, or until there were enough violations: violations, those that nothing flagged,
    what the filter reported, the reward."""
    told, filtered = Counter(), env.has_wrapper_attr("filter")
    for action, reward, info, violated, _ in driven(case, env, driver, steps, seed, 1000 * seed):
        told.update(counted(info, violated), reward=reward)
        if filtered and not info["cbf/intervened"]:
            within = np.clip(action, env.action_space.low, env.action_space.high)
            assert info["executed_action"].astype(action.dtype).tobytes() == within.tobytes()
        if told["violations"] > enough:
            break
    return told


def steps_of(name):
    return next(n for word, n in STEPS.items() if word in name)


@pytest.mark.parametrize("name", CASES)
def test_no_driver_breaks_a_limit_without_a_flag(name):
    case, env = CASES[name], made(CASES[name])
    chosen = ("corner-seeking", "margin-reading") if "Fetch" in name else set(case.drivers) - {"random"}
    told = sum((attack(case, env, driver, steps_of(name)) for driver in sorted(chosen)), Counter())
    assert told["unflagged"] == 0, told
    if all(c.promise == "proved" for c in env.constraints):
        assert told["violations"] == told["infeasible"] == told["fallback"] == told["unsafe"] == 0, told
    assert told["intervened"] > 0 or any(word in name for word in HARMLESS)


@pytest.mark.parametrize("name", [n for n in CASES if not any(word in n for word in HARMLESS)])
def test_the_same_drivers_break_it_without_the_filter(name):
    case, env = CASES[name], made(CASES[name], filtered=False)
    chosen = ["corner-seeking"] if "Fetch" in name else sorted(set(case.drivers) - {"random"}, reverse=True)
    told = (attack(case, env, driver, steps_of(name), enough=2) for driver in chosen)
    assert any(one["violations"] > 2 for one in told)


@pytest.mark.parametrize("name", ["SafePointGoal1-v0", "SafeCarGoal1-v0"])
def test_the_goal_is_still_reached(name):
    case = CASES[name]
    kept, free = (attack(case, made(case, filtered), "goal-seeking", 1000) for filtered in (True, False))
    assert kept["violations"] == 0 < free["violations"]
    assert kept["reward"] > 0.35 * free["reward"] > 0.0, (kept["reward"], free["reward"])


def test_an_arm_reaches_as_well_as_without_the_filter():
    case = CASES["FetchReach-v4"]
    for filtered in (False, True):
        env = made(case, filtered)
        for seed in range(4):
            seen, info = env.reset(seed=seed)
            for _ in range(20):
                way = np.clip(10.0 * (seen["desired_goal"] - seen["achieved_goal"]), -1.0, 1.0)
                seen, *_, info = env.step(np.append(way, 0.0).astype(np.float32))
            assert info["is_success"]


# What a wrong model breaks: without these, the tests above might be unable to fail --------------------------------


def with_filter(name, protect):
    return replace(CASES[name], protect=protect)


def wrong_plant(env, mass, damping, **options):
    filtered = sw.protect(env, **options)
    filtered.plant.perturb(mass=mass, damping=damping)
    return filtered


def on_ice(env):
    """The car takes longer to stop than a filter believes that goes on with the dry model."""
    plant = sw.MujocoPlant(model=copy.copy(env.unwrapped.model))
    filtered = sw.protect(env, plant=plant)
    env.unwrapped.model.geom_friction[:, 0] *= 0.25
    return filtered


@pytest.mark.parametrize(("name", "driver", "protect"), [
    ("SafePointGoal2-v0", "lateral-drift", lambda env: wrong_plant(env, 0.5, 1.5)),
    ("SafeCarGoal2-v0", "full throttle", on_ice),
    ("PointMaze_UMaze-v3", "bang-bang",
     lambda env: sw.CBFActionFilter(env, [sw.constraints.WallClearance(velocity_clip=2.0)])),
])  # fmt: skip
def test_a_filter_of_another_machine_is_found_out(name, driver, protect):
    case = with_filter(name, protect)
    with warnings.catch_warnings(action="ignore"):
        told = (attack(case, made(case), driver, 1000, seed, enough=0) for seed in range(3))
        assert any(one["violations"] for one in told)


@pytest.mark.slow
@pytest.mark.parametrize("mass", [0.8, 1.2])
@pytest.mark.parametrize("damping", [0.8, 1.2])
def test_a_wrong_plant_inside_the_declared_uncertainty(mass, damping):
    # The filter's machine is `mass` times the true one, so the truth is within 25 % of what it believes.
    case = with_filter("SafePointGoal2-v0", lambda env: wrong_plant(env, mass, damping, uncertainty=0.25))
    with warnings.catch_warnings(action="ignore"):
        for driver in ("hazard-seeking", "lateral-drift", "bang-bang"):
            assert attack(case, made(case), driver, 1000, seed=7)["violations"] == 0


# Other stacks ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("driver", CASES["OccludedCrossing-v0"].drivers)
@pytest.mark.parametrize("cars", ["true", "estimated"])
def test_no_car_hits_a_robot_that_knows_or_estimates_them(driver, cars):
    case = with_filter("OccludedCrossing-v0", lambda env: sw.protect(crossing(env), cars=cars))
    told = attack(case, made(case), driver, 250, seed=1)
    assert told["violations"] == 0 and told["infeasible"] + told["fallback"] + told["unsafe"] <= 5, told


def permission_and_ways_out(env):
    ways_out = sw.constraints.EscapeClearance("robot", [sw.constraints.TrackedDiscs(0.4)], 0.2)
    return sw.CBFActionFilter(
        crossing(env, tolerance=0.8), [ways_out, sw.constraints.TrackPermission("robot", 3.0)]
    )


def test_a_permission_and_ways_out_together_stop_where_it_is_safe_to():
    case = with_filter("OccludedCrossing-v0", permission_and_ways_out)
    told = attack(case, made(case), "goal-seeking", 250, seed=2)
    assert told["violations"] == 0 and told["intervened"] > 20, told


@pytest.mark.parametrize("task", ["Reach", "PickAndPlace"])
def test_no_finger_gets_into_a_ball_that_is_kept_out(task):
    case = replace(
        CASES[f"Fetch{task}-v4"],
        judge=lambda env: fetch.FetchJudge(env, True),
        drivers={"ball-seeking": fetch.seeking(fetch.in_the_ball, 12)},
        protect=lambda env: sw.protect(env, keep_out=fetch.obstacles(env.unwrapped)),
    )
    kept, free = (attack(case, made(case, filtered), "ball-seeking", 100) for filtered in (True, False))
    assert kept["violations"] == 0 < free["violations"] and kept["infeasible"] <= 1


# A robot that runs at its speed limit, driven by whatever hypothesis finds ---------------------------------------

CHEETAH = sw.protect(gym.make("SafeHalfCheetahVelocity-v0", disable_env_checker=True))
pulses = st.lists(
    st.tuples(
        st.integers(1, 8),  # control steps that it is held for
        st.lists(st.sampled_from([-1.0, -0.3, 0.0, 0.5, 1.0]), min_size=6, max_size=6),
    ),
    min_size=1,
    max_size=8,
)


@settings(max_examples=25)
@given(seed=st.integers(0, 50), speed=st.floats(0.0, 3.1), controls=pulses)
def test_no_control_sequence_costs_without_a_flag(seed, speed, controls):
    CHEETAH.reset(seed=seed)
    CHEETAH.unwrapped.data.qvel[0] = speed
    for held, control in controls:
        for _ in range(held):
            info = CHEETAH.step(np.array(control, np.float32))[4]
            flagged = info["cbf/infeasible"] or info["cbf/fallback"]
            assert flagged or (info["cost"] == 0.0 and info["speed"] <= 3.2096)
