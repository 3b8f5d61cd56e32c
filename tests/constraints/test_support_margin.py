"""SupportMargin: a pushed table that tips at a known force, and polygons by another library."""

import gymnasium as gym
import numpy as np
import pytest
from asking import bound, settled
from contact_judge import ConeJudge
from judged_loops import Scene, flagged
from scipy.spatial import ConvexHull

import safe_wrappers as sw
from safe_wrappers.control.legged import support_distances
from safe_wrappers.errors import ConfigurationError

HALF, HEIGHT, MASS = 0.2, 0.5, 5.0
WEIGHT = MASS * 9.81
TABLE = """<mujoco><option timestep="0.002" gravity="{gravity}"/>
<default><geom friction="2 0 0" solref="-40000 -200"/></default>
<worldbody><geom name="floor" type="plane" size="9 9 1"/>{step}
<body name="table" pos="0 0 {height}">
  <joint name="x" type="slide" axis="1 0 0"/><joint type="slide" axis="0 0 1"/><joint type="hinge" axis="0 1 0"/>
  <inertial pos="0 0 0" mass="{mass}" diaginertia=".3 .3 .3"/>{feet}</body></worldbody>
<actuator><motor joint="x" ctrllimited="true" ctrlrange="-1 1" gear="50"/></actuator></mujoco>"""
CORNERS = [(x, y) for x in (-HALF, HALF) for y in (-0.6, 0.6)]


def table(feet=CORNERS, step=0.0, gravity="0 0 -9.81"):
    """A table pushed at the height of its centre of mass; a control of 1 is 50 N."""
    legs = "".join(
        f'<geom name="f{i}" pos="{x} {y} {-HEIGHT + 0.02 + (step if x > 0 else 0.0)}" size=".02"/>'
        for i, (x, y) in enumerate(feet)
    )
    ground = f'<geom type="box" pos="1.1 0 {step - 0.5}" size="1 2 .5"/>' if step else ""
    return Scene(
        TABLE.format(height=HEIGHT, mass=MASS, feet=legs, step=ground, gravity=gravity), frame_skip=5
    )


@pytest.mark.parametrize("inset", [0.03, 0.1])
def test_it_admits_pushes_up_to_where_the_table_tips_about_the_inset_edge(inset):
    # A push F at the height h moves the zero moment point by F h / W; farther than the edge it cannot go.
    tips = WEIGHT * (HALF - inset) / HEIGHT / 50.0
    for way in (-1.0, 1.0):
        limit = settled(table(), sw.constraints.SupportMargin(inset), np.array([0.97 * way * tips]))
        assert limit.admits(np.array([0.97 * way * tips]))
        assert not limit.admits(np.array([1.04 * way * tips]))
        assert limit.slack(np.array([9.0 * way * tips])) >= -(inset + 1e-9)


def test_the_distance_is_that_of_the_moments():
    for push in (-0.3, 0.0, 0.25):
        limit = settled(table(), sw.constraints.SupportMargin(0.01), np.array([push]))
        expected = HALF - abs(push) * 50.0 * HEIGHT / WEIGHT
        assert limit.slacks(np.array([push]))[0] == pytest.approx(expected - 0.01, abs=2e-3)
        limit.executed(np.array([push]))
        assert limit.report["whole_body/zmp_margin"] == pytest.approx(expected, abs=2e-3)


def hull_distance(contacts):
    """Distance of the centre of pressure from the hull's edge, by scipy; None where there is no polygon."""
    points, forces = (np.array([c[i] for c in contacts]) for i in (1, 3))
    flat, pressure = points[:, :2], forces[:, 2]
    if len(flat) < 3 or np.linalg.matrix_rank(flat - flat.mean(axis=0), 1e-6) < 2 or pressure.sum() <= 0.0:
        return None
    hull = ConvexHull(flat)
    # Points above the mean height have moments of their own tangential forces.
    up = points[:, 2] - points[:, 2].mean()
    centre = (flat * pressure[:, None] - up[:, None] * forces[:, :2]).sum(axis=0) / pressure.sum()
    return -float((hull.equations @ [*centre, 1.0]).max())


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


def test_at_every_evaluation_it_is_the_distance_to_the_hull_of_all_contact_points():
    env = gym.make("Ant-v5")
    judge, plant = ConeJudge(env, 1.0), bound(env)
    env.reset(seed=0)
    rng = np.random.default_rng(0)
    polygons = 0
    for _ in range(40):
        action = 0.1 * rng.normal(size=8)
        plant.observe()
        found = plant.contact_forecast(action)
        mine = support_distances(found.step, found.point, found.normal, found.force)
        judge.step(env, action)
        flat = [at for at in judge.instants if len(at) and np.ptp([c[1][2] for c in at]) < 0.009]
        theirs = [d for d in map(hull_distance, flat) if d is not None]
        polygons += len(theirs)
        inside = [d for d in theirs if d >= 0.0]
        assert len(mine) == len(theirs)
        np.testing.assert_allclose([d for d in mine if d >= 0.0], inside, atol=1e-7)
    assert polygons > 10


def closed_loop(env, pushes):
    """Infos, and the least distance at the evaluations of each step that the env has made, by scipy."""
    judge = ConeJudge(env, 1.0)
    env.reset()
    for push in pushes:
        *_, info = judge.step(env, np.array([push]))[1]
        found = [hull_distance(at) for at in judge.instants if len(at)]
        yield info, min((d for d in found if d is not None), default=None)


def test_a_table_that_is_pushed_over_stays_up_and_keeps_its_inset():
    rng = np.random.default_rng(0)
    pushes = [*[0.0] * 10, *rng.uniform(-1.0, 1.0, 30), *[1.0] * 15, *[-1.0] * 15]
    env = sw.CBFActionFilter(table(), [sw.constraints.SupportMargin(0.05)])
    changed = silent = 0
    for info, least in closed_loop(env, pushes):
        changed += info["cbf/intervened"]
        if not flagged(info):
            assert least is None or least >= 0.05 - 1e-6
            silent += 1
    assert changed > 20 and silent > 25
    assert abs(env.unwrapped.data.qpos[2]) < 0.2
    bare = table()
    bare.reset()
    for push in [1.0] * 60:
        bare.step(np.array([push]))
    assert abs(bare.data.qpos[2]) > 0.5  # without it the table falls


@pytest.mark.parametrize(
    "arguments",
    [{"inset": 0.0}, {"inset": -0.01}, {"inset": np.nan}, {"inset": "1 cm"}],
)
def test_bad_arguments_are_refused(arguments):
    with pytest.raises(ConfigurationError, match="inset"):
        sw.constraints.SupportMargin(**arguments)
