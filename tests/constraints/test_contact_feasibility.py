"""ContactFeasibility and SupportMargin: where a pushed ball slides, where a pushed table tips, and what they report.

Closed loops are in test_forecast_loops.py.
"""

import gymnasium as gym
import numpy as np
import pytest
from asking import settled
from judged_loops import HALF, HEIGHT, MASS, ForceJudge, at_random, cone_room, inside_the_hull, table
from scenes import Scene

import safe_wrappers as sw
from safe_wrappers.errors import UnsupportedEnvError
from safe_wrappers.plants.mujoco.model import weight_n

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


def test_where_nothing_has_friction_there_is_no_cone_to_stay_in():
    with pytest.raises(UnsupportedEnvError, match="no body of this model"):
        sw.CBFActionFilter(pushed_balls(condim=1), [sw.constraints.ContactFeasibility()])


TIPS = MASS * 9.81 / HEIGHT / 50.0
"""A push F at the height h moves the zero moment point by F h / W: the control that moves it by 1 m."""


@pytest.mark.parametrize("inset", [0.03, 0.1])
def test_it_admits_pushes_up_to_where_the_table_tips_about_the_inset_edge(inset):
    tips = TIPS * (HALF - inset)
    for way in (-1.0, 1.0):
        limit = settled(table(), sw.constraints.SupportMargin(inset), np.array([0.97 * way * tips]))
        assert limit.admits(np.array([0.97 * way * tips]))
        assert not limit.admits(np.array([1.04 * way * tips]))
        assert limit.slack(np.array([9.0 * way * tips])) >= -(inset + 1e-9)


def test_the_distance_is_that_of_the_moments():
    for push in (-0.3, 0.0, 0.25):
        limit = settled(table(), sw.constraints.SupportMargin(0.01), np.array([push]))
        expected = HALF - abs(push) / TIPS
        assert limit.slacks(np.array([push]))[0] == pytest.approx(expected - 0.01, abs=2e-3)
        limit.executed(np.array([push]))
        assert limit.report["whole_body/zmp_margin"] == pytest.approx(expected, abs=2e-3)


@pytest.mark.parametrize(
    "env",
    [
        table([(-0.2, 0.0), (0.2, 0.0)]),  # a line
        table([(0.0, 0.0)]),  # a point
        table(step=0.05),  # two heights
        table(gravity="0 0 0.1"),  # in the air
    ],
)
def test_where_there_is_no_polygon_nothing_is_asked(env):
    limit = settled(env, sw.constraints.SupportMargin(0.1), np.zeros(1), 20)
    for push in (-1.0, 0.0, 1.0):
        assert limit.admits(np.array([push]))
        limit.executed(np.array([push]))
        assert limit.report == {"whole_body/zmp_margin": 0.0}


REPORTS = {
    "whole_body/cone_margin": (
        lambda: gym.make("HalfCheetah-v5"),
        sw.constraints.ContactFeasibility(0.7),
        cone_room(0.7),
    ),
    "whole_body/zmp_margin": (table, sw.constraints.SupportMargin(0.01), inside_the_hull(0.0)),
}


@pytest.mark.parametrize("key", REPORTS)
def test_what_it_reports_is_what_the_env_s_own_contacts_were(key):
    make, limit, room = REPORTS[key]
    env, rng, finite = sw.CBFActionFilter(make(), [limit]), np.random.default_rng(1), 0
    judge = ForceJudge(env, room)
    env.reset(seed=1)
    for k in range(40):
        action = at_random(judge, env.action_space, k, rng).astype(env.action_space.dtype)
        least, *_, info = judge.step(env, action)
        assert info[key] == (pytest.approx(least, abs=1e-7) if np.isfinite(least) else 0.0)
        finite += bool(np.isfinite(least))
    assert finite > 20
