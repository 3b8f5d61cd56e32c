"""Every env that `protect` knows, under drivers that attack it, judged on the env's own state at every substep."""

import copy
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
from benchmarks.cases import CASES, crossing
from benchmarks.protected import Case

pytestmark = [
    pytest.mark.filterwarnings("ignore::safe_wrappers.UnsafeStateWarning"),
    pytest.mark.filterwarnings("ignore:.*is out of date"),
    pytest.mark.filterwarnings("error:.*farther than the declared max_decrease"),  # of a recipe
]
STEPS = {
    "SafePointGoal": 800,
    "SafeCarGoal": 300,
    "PatrolledPointMaze": 200,
    "PointMaze": 400,
    "Pendulum": 150,
    "TeleopContact": 2000,
    "OccludedCrossing": 300,
    "Reacher": 300,
    "Hand": 30,
    "Velocity": 150,
    "": 80,
}
"""Of each driver, by a part of the env's name; what is dear is short."""
HARMLESS = "Goal0", "HumanoidVelocity", "InvertedPendulum-v5"
"""Whose drivers break nothing in so few steps without a filter, the plain pendulum's because it falls first."""


def attack(case: Case, driver, steps, filtered=True, seed=0):
    """What happened: steps that violated, those that nothing flagged, what the filter reported, the reward."""
    env = case.make()
    env = case.protect(env) if filtered else env
    judge = case.judge(env.unwrapped)
    act = case.drivers[driver](env.unwrapped, np.random.default_rng(seed))
    told, over, episode = Counter(), True, 1000 * seed
    for _ in range(steps):
        while over:
            env.reset(seed=episode)
            over, episode = not judge.start() <= 0.0, episode + 1
        action = np.asarray(act(), env.action_space.dtype)
        judge.before()
        _, reward, terminated, truncated, info = env.step(action)
        executed = info["executed_action"] if filtered else action
        violated = not judge.after(executed, info) <= 0.0  # what is not a number counts
        flags = {name: info.get(f"cbf/{name}", False) for name in ("infeasible", "fallback", "unsafe")}
        told.update(flags, violations=violated, unflagged=violated and not any(flags.values()), reward=reward)
        told["intervened"] += info.get("cbf/intervened", False)
        if filtered and not info["cbf/intervened"]:
            assert (
                executed.astype(action.dtype).tobytes()
                == np.clip(action, env.action_space.low, env.action_space.high).tobytes()
            )
        over = bool(truncated or (terminated and not case.past_termination))
    return told


def together(name, filtered, drivers=None):
    """The same of all drivers of a case."""
    if any(word in name for word in ("Maze", "Fetch", "Hand")):
        pytest.importorskip("gymnasium_robotics")
    case, steps = CASES[name], next(n for word, n in STEPS.items() if word in name)
    every = drivers or [driver for driver in case.drivers if driver != "random"]
    return sum((attack(case, driver, steps, filtered) for driver in every), Counter())


@pytest.mark.parametrize("name", CASES)
def test_no_driver_breaks_a_limit_without_a_flag(name):
    told = together(name, True, ["corner-seeking", "margin-reading"] if "Fetch" in name else None)
    assert told["unflagged"] == 0, told
    case = CASES[name]
    if all(c.promise == "proved" for c in case.protect(case.make()).constraints):
        assert told["violations"] == told["infeasible"] == told["fallback"] == told["unsafe"] == 0, told
    assert told["intervened"] > 0 or any(word in name for word in HARMLESS)


@pytest.mark.parametrize("name", [n for n in CASES if not any(word in n for word in HARMLESS)])
def test_the_same_drivers_break_it_without_the_filter(name):
    assert together(name, False, ["corner-seeking"] if "Fetch" in name else None)["violations"] > 2


@pytest.mark.parametrize("name", ["SafePointGoal1-v0", "SafeCarGoal1-v0"])
def test_the_goal_is_still_reached(name):
    kept, free = (attack(CASES[name], "goal-seeking", 1500, filtered) for filtered in (True, False))
    assert kept["violations"] == 0 < free["violations"]
    assert kept["reward"] > 0.35 * free["reward"] > 0.0, (kept["reward"], free["reward"])


def test_an_arm_reaches_as_well_as_without_the_filter():
    pytest.importorskip("gymnasium_robotics")
    case, solved = CASES["FetchReach-v4"], Counter()
    for filtered in (False, True):
        env = case.protect(case.make()) if filtered else case.make()
        for seed in range(4):
            seen, info = env.reset(seed=seed)
            for _ in range(20):
                way = np.clip(10.0 * (seen["desired_goal"] - seen["achieved_goal"]), -1.0, 1.0)
                seen, *_, info = env.step(np.append(way, 0.0).astype(np.float32))
            solved[filtered] += int(info["is_success"])
    assert solved == {False: 4, True: 4}


@pytest.mark.parametrize(("options", "farther"), [({"margin": 0.102}, 0.1), ({"state_error": 0.1}, 0.1)])
def test_a_margin_and_an_error_keep_it_farther_away(options, farther):
    def closest(**options):
        hazards = sw.constraints.HeadingDriveClearance(
            [sw.constraints.Discs("hazard_positions", 0.2)], **options
        )
        env = sw.CBFActionFilter(gym.make("SafePointGoal1-v0"), [hazards])
        layout = {"agent": [0.0, 0.0, 0.0], "goal": [9.0, 9.0], "hazards": [[1.5, 0.0]], "vases": []}
        env.reset(seed=0, options={"layout": layout})
        for _ in range(400):
            env.step(np.array([1.0, 0.0], np.float32))
        return float(np.linalg.norm(env.unwrapped.agent_position - env.unwrapped.hazard_positions[0]))

    assert closest(**options) - closest() == pytest.approx(farther, abs=0.01)


# What a wrong model breaks: without these, the tests above might be unable to fail --------------------------------


def with_filter(name, protect):
    return replace(CASES[name], protect=protect)


def wrong_plant(env, mass, damping, **options):
    filtered = sw.protect(env, **options)
    filtered.plant.perturb(mass=mass, damping=damping)
    return filtered


def another_clip(env):
    return sw.CBFActionFilter(env, [sw.constraints.WallClearance(velocity_clip=2.0)])


def on_ice(env):
    """The car takes longer to stop than a filter believes that goes on with the dry model."""
    plant = sw.MujocoPlant(model=copy.copy(env.unwrapped.model))
    filtered = sw.protect(env, plant=plant)
    env.unwrapped.model.geom_friction[:, 0] *= 0.25
    return filtered


@pytest.mark.parametrize(("name", "driver", "protect"), [
    ("SafePointGoal2-v0", "lateral-drift", lambda env: wrong_plant(env, 0.5, 1.5)),
    ("SafeCarGoal2-v0", "full throttle", on_ice),
    ("PointMaze_UMaze-v3", "bang-bang", another_clip),
])  # fmt: skip
def test_a_filter_of_another_machine_is_found_out(name, driver, protect):
    with warnings.catch_warnings(action="ignore"):
        told = [attack(with_filter(name, protect), driver, 1000, seed=seed) for seed in range(3)]
    assert sum(one["violations"] for one in told) > 0


@pytest.mark.slow
@pytest.mark.parametrize("mass", [0.8, 1.2])
@pytest.mark.parametrize("damping", [0.8, 1.2])
def test_a_wrong_plant_inside_the_declared_uncertainty(mass, damping):
    # The filter's machine is `mass` times the true one, so the truth is within 25 % of what it believes.
    case = with_filter("SafePointGoal2-v0", lambda env: wrong_plant(env, mass, damping, uncertainty=0.25))
    with warnings.catch_warnings(action="ignore"):
        for driver in ("hazard-seeking", "lateral-drift", "bang-bang"):
            assert attack(case, driver, 1000, seed=7)["violations"] == 0


# Other stacks ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("driver", CASES["OccludedCrossing-v0"].drivers)
@pytest.mark.parametrize("cars", ["true", "estimated"])
def test_no_car_hits_a_robot_that_knows_or_estimates_them(driver, cars):
    case = with_filter("OccludedCrossing-v0", lambda env: sw.protect(crossing(env), cars=cars))
    told = attack(case, driver, 250, seed=1)
    assert told["violations"] == 0 and told["infeasible"] + told["fallback"] + told["unsafe"] <= 5, told


def permission_and_ways_out(env):
    ways_out = sw.constraints.EscapeClearance("robot", [sw.constraints.TrackedDiscs(0.4)], 0.2)
    return sw.CBFActionFilter(
        crossing(env, tolerance=0.8), [ways_out, sw.constraints.TrackPermission("robot", 3.0)]
    )


def test_a_permission_and_ways_out_together_stop_where_it_is_safe_to():
    told = attack(with_filter("OccludedCrossing-v0", permission_and_ways_out), "goal-seeking", 250, seed=2)
    assert told["violations"] == 0 and told["intervened"] > 20, told


@pytest.mark.parametrize("task", ["Reach", "PickAndPlace"])
def test_no_finger_gets_into_a_ball_that_is_kept_out(task):
    pytest.importorskip("gymnasium_robotics")
    case = replace(
        CASES[f"Fetch{task}-v4"],
        judge=lambda env: fetch.FetchJudge(env, True),
        drivers=fetch.drivers(ball=True),
        protect=lambda env: sw.protect(env, keep_out=fetch.obstacles(env.unwrapped)),
    )
    kept, free = (attack(case, "ball-seeking", 100, filtered) for filtered in (True, False))
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
