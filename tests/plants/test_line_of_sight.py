"""What a sensor sees, against geometry of the test's own: circles and segments, cones, ranges."""

import gymnasium as gym
import mujoco
import numpy as np
import pytest

import safe_wrappers  # noqa: F401 (registers the crossing)
from safe_wrappers.plants.mujoco.line_of_sight import LineOfSight


def world(inside, robot="", eye='pos="0 0 0.5"'):
    text = f"""
    <mujoco>
      <worldbody>
        {inside}
        <body name="robot">
          <joint name="turn" type="hinge" axis="0 0 1"/>
          <geom size="0.2" mass="1"/>
          <camera name="cam" {eye} xyaxes="0 -1 0 0 0 1" fovy="60"/>
          <site name="spot" {eye} zaxis="1 0 0"/>
          {robot}
        </body>
        <camera name="fixed" pos="0 0 0.5" xyaxes="0 -1 0 0 0 1" fovy="170"/>
      </worldbody>
    </mujoco>"""
    model = mujoco.MjModel.from_xml_string(text)
    return model, mujoco.MjData(model)


def looking(model, data, camera="cam", site=None, view_deg=360.0, range_m=np.inf):
    sight = LineOfSight(model, None if site else camera, site, view_deg, range_m)
    sight.read(data)
    return sight


def sees(sight, *points, bodies=None):
    which = np.full(len(points), -1) if bodies is None else np.array(bodies)
    return sight.sees(np.array(points, dtype=float), which).tolist()


WALL = '<geom name="wall" type="box" pos="2 0 0.5" size="0.1 1 1"/>'


# The crossing -----------------------------------------------------------------------------------------------------


def hidden_by_circles(eye, point, centres, radius):
    """Whether the segment between two points in the plane passes through a circle; from how far inside, m."""
    way = point - eye
    share = np.clip(((centres - eye) @ way) / (way @ way), 0.0, 1.0)
    return float((radius - np.linalg.norm(eye + share[:, None] * way - centres, axis=1)).max())


def test_on_the_crossing_it_is_what_circles_and_cones_say():
    env = gym.make("OccludedCrossing-v0").unwrapped
    sight = LineOfSight(env.model, "eye", None, 120.0, 6.0)
    bodies = np.array([env.model.body(name).id for name in env.car_bodies])
    rng = np.random.default_rng(0)
    env.reset(seed=0)
    judged, seen, hidden, aside, far = 0, 0, 0, 0, 0
    for k in range(1000):
        if k % 20 == 0:
            env.reset(seed=k)
        qpos = np.concatenate([rng.uniform([-3.7, -3.2, -9.0], [3.7, 3.2, 9.0]), rng.uniform(-8, 8, 6)])
        env.set_state(qpos, np.zeros(9))
        sight.read(env.data)
        heading = np.array([np.cos(qpos[2]), np.sin(qpos[2])])
        eye = qpos[:2] + 0.15 * heading
        np.testing.assert_allclose(sight.position, [*eye, 0.3], atol=1e-12)
        cars = env.car_positions
        got = sight.sees(np.column_stack([cars, np.full(6, 0.3)]), bodies)
        for i, car in enumerate(cars):
            away = car - eye
            length = np.linalg.norm(away)
            angle = np.degrees(np.arccos(np.clip(away @ heading / length, -1, 1)))
            others = np.delete(cars, i, axis=0)
            surface = car - 0.4 * away / length  # cars drive through each other
            slack = [
                60.0 - angle,
                6.0 - length,
                -hidden_by_circles(eye, surface, env.pillar_positions, 0.35),
                -hidden_by_circles(eye, surface, others, 0.4),
            ]
            inside = (
                min(np.linalg.norm(others - eye, axis=1)) < 0.41
                or min(np.linalg.norm(env.pillar_positions - eye, axis=1)) < 0.36
            )
            if min(np.abs(slack)) < 1e-4 or inside or length < 0.4:
                continue  # at an edge, or looking from inside of something
            judged += 1
            assert got[i] == (min(slack) > 0.0), (k, i, slack)
            seen += got[i]
            aside += slack[0] < 0
            far += slack[1] < 0
            hidden += min(slack[:2]) > 0 and min(slack[2:]) < 0
    assert min(seen, hidden, aside, far) > 200 and judged > 4000


# View and range ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("sensor", [{"camera": "cam"}, {"site": "spot"}])
@pytest.mark.parametrize("view", [10.0, 90.0, 180.0, 300.0])
def test_the_view_is_a_cone_of_the_full_opening_angle(sensor, view):
    model, data = world("")
    sight = looking(model, data, view_deg=view, **sensor)
    rng = np.random.default_rng(0)
    for _ in range(40):
        roll = rng.uniform(0, 2 * np.pi)
        side = np.array([0.0, np.cos(roll), np.sin(roll)])
        for angle, expected in ((view / 2 - 0.01, True), (view / 2 + 0.01, False)):
            a = np.radians(angle)
            point = sight.position + 3.0 * (np.cos(a) * np.array([1.0, 0, 0]) + np.sin(a) * side)
            assert sees(sight, point) == [expected]


def test_it_reads_the_state_and_not_what_lags_behind_it():
    model, data = world("", eye='pos="0.5 0 0.5"')
    mujoco.mj_forward(model, data)
    data.qpos[0] = np.pi / 2  # data.xpos is old now
    np.testing.assert_allclose(looking(model, data).position, [0, 0.5, 0.5], atol=1e-12)


# What hides -------------------------------------------------------------------------------------------------------


def test_a_point_at_the_sensor_and_points_that_are_none():
    model, data = world(WALL)
    sight = looking(model, data, view_deg=60.0, range_m=4.0)
    assert sees(sight, sight.position, [np.nan, 0, 0], [np.inf, 0, 0], [1, 0, 0.5]) == [
        True,
        False,
        False,
        True,
    ]
    assert sees(looking(model, data), [np.nan, 0, 0]) == [False]


TRACKED = """
<body name="thing" pos="3 0 0.5">
  <geom name="shell" type="box" size="0.3 0.3 0.3"/>
  <body name="flap" pos="-0.6 0 0"><geom type="box" size="0.05 0.5 0.5"/></body>
</body>
<body name="other" pos="5 0 0.5"><geom size="0.2"/></body>
"""


def test_what_moves_with_a_tracked_body_does_not_hide_it_and_hides_others():
    model, data = world(TRACKED)
    sight = looking(model, data)
    thing, flap, other = (model.body(name).id for name in ("thing", "flap", "other"))
    places = data.xpos if data.xpos.any() else sight.data.xpos
    assert sees(sight, places[thing], bodies=[thing]) == [True]
    assert sees(sight, places[thing]) == [False]  # the same point, when it belongs to nothing
    assert sees(sight, places[other], bodies=[other]) == [False]
    # A child's point is hidden by its parent: seen from behind.
    data.qpos[0] = 0.0
    model.body_pos[model.body("robot").id] = [6, 0, 0]
    behind = looking(model, data)
    assert sees(behind, behind.data.xpos[flap], bodies=[flap]) == [False]
    assert sees(behind, behind.data.xpos[other], bodies=[other]) == [True]


def test_looking_leaves_the_env_s_data_alone():
    env = gym.make("OccludedCrossing-v0").unwrapped
    env.reset(seed=0)
    spec = mujoco.mjtState.mjSTATE_INTEGRATION
    before = np.zeros(mujoco.mj_stateSize(env.model, spec))
    mujoco.mj_getState(env.model, env.data, before, spec)
    sight = looking(env.model, env.data, camera="eye")
    sees(sight, [0, 0, 0.3])
    after = np.zeros_like(before)
    mujoco.mj_getState(env.model, env.data, after, spec)
    assert before.tobytes() == after.tobytes()
