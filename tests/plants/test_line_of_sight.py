"""What a sensor sees, against geometry of the test's own: circles and segments, cones, ranges."""

import gymnasium as gym
import mujoco
import numpy as np
import pytest

import safe_wrappers  # noqa: F401 (registers the crossing)
from safe_wrappers.plants.mujoco.line_of_sight import LineOfSight

WORLD = """
<mujoco><worldbody>
  {inside}
  <body name="robot">
    <joint name="turn" type="hinge" axis="0 0 1"/>
    <geom size="0.2" mass="1"/>
    <camera name="cam" pos="{eye} 0 0.5" xyaxes="0 -1 0 0 0 1" fovy="60"/>
    <site name="spot" pos="{eye} 0 0.5" zaxis="1 0 0"/>
    <body name="arm" pos="1 0 2"><geom size="0.1"/></body>
  </body>
  <camera name="fixed" pos="0 0 0.5" xyaxes="0 -1 0 0 0 1" fovy="170"/>
</worldbody></mujoco>"""
WALL = '<geom name="wall" type="box" pos="2 0 0.5" size="0.1 1 1" rgba="1 1 1 {alpha}"/>'


def world(inside="", eye=0.0):
    model = mujoco.MjModel.from_xml_string(WORLD.format(inside=inside, eye=eye))
    return model, mujoco.MjData(model)


def looking(model, data, camera="cam", site=None, view_deg=360.0, range_m=np.inf):
    sight = LineOfSight(model, None if site else camera, site, view_deg, range_m)
    sight.read(data)
    return sight


def sees(sight, *points, bodies=None):
    which = np.full(len(points), -1) if bodies is None else np.array(bodies)
    return sight.sees(np.array(points, dtype=float), which).tolist()


def outside_circles(eye, point, centres, radius):
    """How far the segment between two points in the plane stays outside of circles, m."""
    way = point - eye
    share = np.clip(((centres - eye) @ way) / (way @ way), 0.0, 1.0)
    return float((np.linalg.norm(eye + share[:, None] * way - centres, axis=1) - radius).min())


def test_on_the_crossing_it_is_what_circles_and_cones_say_and_the_env_s_data_are_left_alone():
    env = gym.make("OccludedCrossing-v0").unwrapped
    sight = LineOfSight(env.model, "eye", None, 120.0, 6.0)
    bodies = np.array([env.model.body(name).id for name in env.car_bodies])
    rng, judged = np.random.default_rng(0), []
    for k in range(400):
        if k % 20 == 0:
            env.reset(seed=k)
        qpos = np.concatenate([rng.uniform([-3.7, -3.2, -9.0], [3.7, 3.2, 9.0]), rng.uniform(-8, 8, 6)])
        env.set_state(qpos, np.zeros(9))
        before = env.data.qpos.tobytes(), env.data.xpos.tobytes(), env.data.cam_xpos.tobytes()
        sight.read(env.data)
        heading = np.array([np.cos(qpos[2]), np.sin(qpos[2])])
        eye, cars = qpos[:2] + 0.15 * heading, env.car_positions
        np.testing.assert_allclose(sight.position, [*eye, 0.3], atol=1e-12)
        seen = sight.sees(np.column_stack([cars, np.full(6, 0.3)]), bodies)
        assert before == (env.data.qpos.tobytes(), env.data.xpos.tobytes(), env.data.cam_xpos.tobytes())
        inside = outside_circles(eye, eye + 1e-9, env.pillar_positions, 0.36) < 0.0
        for i, car in enumerate(cars):
            away, others = car - eye, np.delete(cars, i, axis=0)
            length = np.linalg.norm(away)
            surface = car - 0.4 * away / length  # cars drive through each other
            slack = [
                60.0 - np.degrees(np.arccos(np.clip(away @ heading / length, -1, 1))),
                6.0 - length,
                outside_circles(eye, surface, env.pillar_positions, 0.35),
                outside_circles(eye, surface, others, 0.4),
            ]
            inside_a_car = outside_circles(eye, eye + 1e-9, others, 0.41) < 0.0
            if min(np.abs(slack)) < 1e-4 or inside or inside_a_car or length < 0.4:
                continue  # at an edge, or looking from inside of something
            assert seen[i] == (min(slack) > 0.0), (k, i, slack)
            judged.append([seen[i], slack[0] < 0, slack[1] < 0, min(slack[:2]) > 0 and min(slack[2:]) < 0])
    assert min(np.sum(judged, axis=0)) > 80 and len(judged) > 1600


@pytest.mark.parametrize("sensor", [{"camera": "cam"}, {"site": "spot"}])
@pytest.mark.parametrize("view", [10.0, 90.0, 180.0, 300.0, None])
def test_the_view_is_a_cone_of_the_full_opening_angle(sensor, view):
    sight = looking(*world(), view_deg=view, **sensor)
    if view is None and "site" in sensor:
        assert sees(sight, [-3.0, 0.1, 0.5]) == [True]  # all around
        return
    half = 30.0 if view is None else view / 2.0  # a camera's own fovy
    for roll in np.linspace(0.0, 2.0 * np.pi, 20):
        side = np.array([0.0, np.cos(roll), np.sin(roll)])
        for angle, expected in ((half - 0.01, True), (half + 0.01, False)):
            a = np.radians(angle)
            assert sees(
                sight, sight.position + 3.0 * (np.cos(a) * np.array([1.0, 0, 0]) + np.sin(a) * side)
            ) == [expected]


def test_it_reads_the_state_and_not_what_lags_behind_it():
    model, data = world(eye=0.5)
    mujoco.mj_forward(model, data)
    data.qpos[0], data.qvel[0] = np.pi / 2, 2.0  # data.xpos is old now
    sight = looking(model, data)
    np.testing.assert_allclose(sight.position, [0, 0.5, 0.5], atol=1e-12)
    linear, angular = sight.velocity(model.body("arm").id)
    np.testing.assert_allclose([linear, angular], [[-2.0, 0, 0], [0, 0, 2.0]], atol=1e-12)


def test_a_point_at_the_sensor_is_seen_points_that_are_none_are_not_and_what_is_visible_hides():
    model, data = world(WALL.format(alpha=1))
    sight, around = looking(model, data, view_deg=60.0, range_m=4.0), looking(model, data)
    nan, far, near, behind = [np.nan, 0, 0], [np.inf, 0, 0], [1, 0, 0.5], [3, 0, 0.5]
    assert sees(sight, sight.position, nan, far, near, behind) == [True, False, False, True, False]
    assert sees(around, nan, near, behind) == [False, True, False]
    assert sees(around, behind, bodies=[0]) == [True]  # the world's, whose wall it is
    # A sensor does not see its own body, but it sees what is fixed where it is fixed itself.
    assert sees(looking(model, data, camera="fixed"), [0.1, 0, 0.5], behind) == [True, False]
    assert sees(looking(*world(WALL.format(alpha=0))), behind) == [True]


TRACKED = """
<body name="thing" pos="3 0 0.5">
  <geom name="shell" type="box" size="0.3 0.3 0.3"/>
  <body name="flap" pos="-0.6 0 0"><geom type="box" size="0.05 0.5 0.5"/></body>
</body>
<body name="other" pos="5 0 0.5"><geom size="0.2"/></body>
"""


def test_what_moves_with_a_tracked_body_does_not_hide_it_and_hides_others():
    model, data = world(TRACKED)
    thing, flap, other = (model.body(name).id for name in ("thing", "flap", "other"))
    sight = looking(model, data)
    places = sight.data.xpos
    assert sees(sight, places[thing], bodies=[thing]) == [True]
    assert sees(sight, places[thing]) == [False]  # the same point, when it belongs to nothing
    assert sees(sight, places[other], bodies=[other]) == [False]
    # A child's point is hidden by its parent: seen from behind.
    model.body_pos[model.body("robot").id] = [6, 0, 0]
    behind = looking(model, data)
    assert sees(behind, behind.data.xpos[flap], bodies=[flap]) == [False]
    assert sees(behind, behind.data.xpos[other], bodies=[other]) == [True]
