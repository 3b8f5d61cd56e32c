"""ContactFeasibility: where a pushed ball would slide, and closed loops judged on the env's own contacts."""

import gymnasium as gym
import numpy as np
import pytest
from asking import bound, settled
from contact_judge import DRIVERS, ConeJudge
from judged_loops import Scene, flagged

import safe_wrappers as sw
from safe_wrappers.errors import ConfigurationError, UnsupportedEnvError
from safe_wrappers.filter.bound import Bound
from safe_wrappers.plants.mujoco.model import weight_n

ROUNDING = 1e-6
"""Executed actions are rounded to float32, and a robot in contact makes more of it."""

BALLS = """<mujoco><option timestep="0.005" cone="{cone}"/>
<default><geom friction="0.8 0 0" condim="{condim}"/></default>
<worldbody><geom name="floor" type="plane" size="9 9 1"/>{balls}</worldbody>
<actuator>{motors}</actuator></mujoco>"""
BALL = """<body name="{0}" pos="0 {1} .1"><joint name="{0}x" type="slide" axis="1 0 0"/>
<joint type="slide" axis="0 0 1"/><geom size=".1" mass="2"/></body>"""
MOTOR = '<motor joint="{0}x" ctrllimited="true" ctrlrange="-1 1" gear="50"/>'


def pushed_balls(names=("left",), cone="pyramidal", condim=3, more=""):
    """Balls of 2 kg that do not roll, on a floor with a friction of 0.8; a control of 1 pushes with 50 N."""
    balls = "".join(BALL.format(name, 2 * i) for i, name in enumerate(names)) + more
    motors = "".join(MOTOR.format(name) for name in names)
    return Scene(BALLS.format(cone=cone, condim=condim, balls=balls, motors=motors))


@pytest.mark.parametrize("cone", ["pyramidal", "elliptic"])
@pytest.mark.parametrize(
    ("share", "tolerance"),
    [(0.7, 0.0), (0.5, 0.0), (0.7, 0.1)],
)
def test_it_admits_pushes_up_to_the_share_and_the_tolerance(cone, share, tolerance):
    # One ball, one contact: its pressure is the weight, and what holds it is what pushes it.
    largest = share * 0.8 + tolerance  # of the weight
    weight = 2.0 * 9.81
    spec = sw.constraints.ContactFeasibility(share, tolerance)
    for part, admitted in ((0.99, True), (1.01, False), (-0.99, True), (-1.01, False)):
        control = np.array([part * largest * weight / 50.0])
        limit = settled(pushed_balls(cone=cone), spec, control, 40)
        assert weight_n(limit.plant.model) == pytest.approx(weight)
        assert limit.admits(control) is admitted
        inside = share * 0.8 - abs(part) * largest
        limit.executed(control)
        assert limit.report["whole_body/cone_margin"] == pytest.approx(inside, abs=2e-3)
        assert limit.slack(control) == pytest.approx(min(inside, 0.0) + tolerance, abs=2e-3)


def test_in_the_air_nothing_is_missed():
    env = pushed_balls(("left", "right"))
    env.start = np.array([0.0, 3.0, 0.0, 3.0]), np.zeros(4)
    limit = settled(env, sw.constraints.ContactFeasibility(0.7, 0.0), np.zeros(2), 40)
    env.reset()
    limit.plant.observe()
    control = np.array([1.0, -1.0])
    assert limit.admits(control) and limit.slacks(control).tolist() == [0.0, 0.0]


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({"friction_share": 0.0}, "friction_share"),
        ({"friction_share": "all"}, "friction_share"),
        ({"tolerance": np.nan}, "tolerance"),
    ],
)
def test_bad_arguments_are_refused_in_words(arguments, words):
    with pytest.raises(ConfigurationError, match=words):
        sw.constraints.ContactFeasibility(**arguments)


def test_what_it_cannot_watch_is_refused_when_it_is_bound():
    def watched(env, **arguments):
        Bound(sw.constraints.ContactFeasibility(**arguments), bound(env))

    watched(pushed_balls())
    with pytest.raises(UnsupportedEnvError, match="no body of this model"):
        watched(pushed_balls(condim=1))
    with pytest.raises(UnsupportedEnvError, match="no body of this model"):
        watched(gym.make("Reacher-v5"))
    plant = sw.AnalyticPlant(
        f=lambda x: x, g=lambda x: np.ones((1, 1)), state=lambda e: e.state, control_dt=0.1
    )
    with pytest.raises(UnsupportedEnvError, match="AnalyticPlant"):
        Bound(sw.constraints.ContactFeasibility(), plant)


CASES = [
    ("Ant-v5", "bang_bang", 12),
    ("Ant-v5", "noisy", 12),
    ("Humanoid-v5", "at_random", 30),
    ("HalfCheetah-v5", "at_random", 40),
    ("HalfCheetah-v5", "bang_bang", 40),
    ("HalfCheetah-v5", "noisy", 40),
    ("Hopper-v5", "at_random", 60),
    ("Walker2d-v5", "bang_bang", 60),
]


def filtered(env_id, plant=None, **arguments):
    return sw.CBFActionFilter(gym.make(env_id), [sw.constraints.ContactFeasibility(**arguments)], plant=plant)


def loop(env, driver, steps, share=0.7, tolerance=0.01, seed=1):
    """Counts of a closed loop: steps outside, flagged, unflagged ones outside, changed; and unflagged excesses."""
    judge, rng = ConeJudge(env, share), np.random.default_rng(seed)
    seen = {"outside": 0, "flagged": 0, "unflagged": 0, "changed": 0, "worst": -np.inf}
    env.reset(seed=seed)
    for k in range(steps):
        action = DRIVERS[driver](env.action_space, k, rng).astype(np.float32)
        excess, (*_, terminated, truncated, info) = judge.step(env, action)
        beyond = excess - tolerance
        seen["outside"] += beyond > ROUNDING
        seen["flagged"] += flagged(info)
        seen["changed"] += info["cbf/intervened"]
        if not flagged(info):
            seen["worst"] = max(seen["worst"], beyond)
            seen["unflagged"] += beyond > ROUNDING
        # What it reports is what the env's own contacts were.
        reported = info["whole_body/cone_margin"]
        assert reported == (pytest.approx(-excess, abs=1e-7) if np.isfinite(excess) else 0.0)
        if terminated or truncated:
            env.reset()
    return seen


@pytest.mark.parametrize(("env_id", "driver", "steps"), CASES)
def test_unflagged_steps_stay_in_the_cone(env_id, driver, steps):
    seen = loop(filtered(env_id), driver, steps)
    assert seen["unflagged"] == 0 and seen["worst"] <= ROUNDING, seen
    assert seen["changed"] > 0 and seen["flagged"] < steps, seen


def test_without_it_they_leave_the_cone():
    judge, rng = ConeJudge(gym.make("HalfCheetah-v5"), 0.7), np.random.default_rng(1)
    bare = judge.raw
    bare.reset(seed=1)
    outside = sum(
        judge.step(bare, DRIVERS["at_random"](bare.action_space, k, rng))[0] > 0.01 for k in range(60)
    )
    assert outside > 10


@pytest.mark.parametrize("env_id", ["HalfCheetah-v5", "Ant-v5", "Humanoid-v5"])
def test_the_whole_cone_is_never_left_so_it_is_inactive_bit_for_bit(env_id):
    env, twin = filtered(env_id, friction_share=1.0, tolerance=0.0), gym.make(env_id)
    env.reset(seed=4), twin.reset(seed=4)
    rng = np.random.default_rng(4)
    for k in range(25):
        action = rng.choice([env.action_space.low, env.action_space.high, np.zeros(env.action_space.shape)])
        action = (action if k % 2 else env.action_space.sample()).astype(np.float32)
        observation, reward, *_, info = env.step(action)
        expected, as_much, *_ = twin.step(action)
        assert observation.tobytes() == expected.tobytes() and reward == as_much
        assert not info["cbf/intervened"] and not flagged(info)
