"""What constraints draw, against geometry by hand and against where the env really goes."""

import copy

import gymnasium as gym
import mujoco
import numpy as np
import pytest

import safe_wrappers as sw
from safe_wrappers.filter.constraint import BoundConstraint


def looked(env):
    """The marks of each constraint in the env's present state."""
    return [list(bound.draw()) for bound in env.look()]


def of(marks, role, shape=None):
    return [m for m in marks if m.role == role and shape in (None, m.shape)]


def rods(marks, along=1):
    """Both ends of every rod; the size along it."""
    ends = [(m.position, m.size[along] * m.axes[:, 2]) for m in marks]
    return np.array([[middle - half, middle + half] for middle, half in ends])


def test_a_constraint_draws_nothing_unless_it_says_so():
    assert BoundConstraint(None, None).draw() == ()


@pytest.mark.parametrize("uncertainty", [0.0, 0.1])
def test_heading_drive_rings_every_disc_and_shows_where_braking_ends(uncertainty):
    clearance = sw.constraints.HeadingDriveClearance(
        [sw.constraints.Discs("hazard_positions", radius=0.2)], margin=0.05, uncertainty=uncertainty
    )
    env = sw.CBFActionFilter(gym.make("SafePointGoal1-v0"), [clearance])
    env.reset(seed=0)
    task = env.unwrapped
    for _ in range(20):
        env.step(np.array([1.0, 0.0], np.float32))
    (marks,) = looked(env)
    limits = rods(of(marks, "limit"), along=2)[:, 0, :2].reshape(len(task.hazard_positions), -1, 2)
    np.testing.assert_allclose(limits.mean(axis=1), task.hazard_positions, atol=1e-9)
    radii = np.linalg.norm(limits - task.hazard_positions[:, None], axis=2)
    np.testing.assert_allclose(radii, 0.25)
    way = rods(of(marks, "way", "capsule"))[:, 0, :2]
    assert len(way) == (4 if uncertainty else 3)
    np.testing.assert_allclose(way[0], task.agent_position, atol=1e-9)
    (end,) = of(marks, "way", "sphere")
    before = task.agent_position
    for _ in range(50):
        task.step(env.look()[0].backup())
    gone = np.linalg.norm(task.agent_position - before)
    assert gone > 0.01
    if uncertainty:  # the farthest stop
        assert np.linalg.norm(end.position[:2] - before) > 1.05 * gone
    else:
        np.testing.assert_allclose(end.position[:2], task.agent_position, atol=0.003)


def test_coasting_shows_where_the_car_rolls_to():
    env = sw.protect(gym.make("SafeCarGoal1-v0"))
    env.reset(seed=0)
    for _ in range(20):
        env.step(np.array([1.0, 0.9], np.float32))
    task, (marks,) = env.unwrapped, looked(env)
    np.testing.assert_allclose(rods(of(marks, "way", "capsule"))[0, 0, :2], task.agent_position, atol=1e-6)
    (end,) = of(marks, "way", "sphere")
    before = task.agent_position.copy()
    for _ in range(40):
        task.step(np.zeros(2))
    assert np.linalg.norm(task.agent_position - before) > 0.01
    np.testing.assert_allclose(end.position[:2], task.agent_position, atol=0.005)


@pytest.mark.parametrize("task", ["PointMaze_UMaze-v3", "PatrolledPointMaze-v0"])
def test_walls_are_framed_where_the_ball_touches_and_braking_ends_where_it_is_drawn(task):
    robotics = pytest.importorskip("gymnasium_robotics")
    gym.register_envs(robotics)
    walls = sw.constraints.WallClearance(margin=0.02, velocity_clip=5.0)
    env = sw.CBFActionFilter(gym.make(task), [walls])
    env.reset(seed=0, options={"reset_cell": np.array([1, 1]), "goal_cell": np.array([3, 1])})
    for _ in range(25):
        env.step(np.array([1.0, 0.2], np.float32))
    (marks,) = looked(env)
    edges = rods(of(marks, "limit"))[..., :2]
    # The wall in the middle ends 0.5 m off its centre; the ball has 0.1 m, and MuJoCo reports earlier touches.
    inner = edges[(np.abs(edges) < 1.3).all(axis=(1, 2))]
    reported = 2.0 * env.unwrapped.model.geom_margin.max()
    np.testing.assert_allclose(np.abs(inner[..., 1]).max(), 0.5 + 0.1 + 0.02 + reported)
    data = env.unwrapped.data
    np.testing.assert_allclose(rods(of(marks, "way", "capsule"))[0, 0, :2], data.qpos[:2], atol=1e-9)
    (end,) = of(marks, "way", "sphere")
    before = data.qpos[:2].copy()
    for _ in range(60):
        env.unwrapped.step(env.look()[0].backup())
    assert np.linalg.norm(data.qpos[:2] - before) > 0.05
    np.testing.assert_allclose(end.position[:2], data.qpos[:2], atol=1e-6)


def test_an_escape_begins_where_the_ball_is_and_the_patrols_have_their_bounds():
    pytest.importorskip("gymnasium_robotics")
    env = sw.protect(gym.make("PatrolledPointMaze-v0"))
    env.reset(seed=0)
    for _ in range(5):
        env.step(np.array([1.0, 0.0], np.float32))
    _, marks = looked(env)
    task = env.unwrapped
    np.testing.assert_allclose(rods(of(marks, "way", "capsule"))[0, 0, :2], task.agent_position, atol=1e-9)
    bounds = of(marks, "estimate")
    np.testing.assert_allclose([m.position[:2] for m in bounds], task.patrol_positions)
    np.testing.assert_allclose([m.size for m in bounds], 0.1 + 0.15 + 0.03)  # known exactly: radii, margin


def test_tracked_discs_are_ellipsoids_of_the_estimates():
    cars = sw.occlusion.Track("car*", acceleration_noise=[0.02, 0.0], start_position_std=[0.3, 0.1])
    env = sw.OcclusionPenalty(gym.make("OccludedCrossing-v0"), [cars], "eye", tolerance=0.5)
    discs = sw.constraints.TrackedDiscs(radius=0.4, sigmas=2.0)
    keep = sw.constraints.Clearance([discs], braking=2.0, bodies=["robot"], radius=0.2, margin=0.1)
    env = sw.CBFActionFilter(env, [keep])
    env.reset(seed=0)
    (marks,) = looked(env)
    tracking = env.get_wrapper_attr("tracking")
    found = of(marks, "estimate")
    np.testing.assert_allclose([m.position[:2] for m in found], tracking.positions)
    for mark, covariance in zip(found, tracking.position_covariances, strict=True):
        along = np.sort(mark.size[:2] - 0.7) / 2.0
        np.testing.assert_allclose(along, np.sqrt(np.linalg.eigvalsh(covariance)), atol=1e-9)


def test_clearance_draws_planes_moved_by_what_is_kept_free_and_the_way_that_braking_takes():
    rail = [sw.constraints.Plane([-0.9], [1]), sw.constraints.Plane([0.9], [-1])]
    keep = sw.constraints.Clearance(rail, 8.0, bodies=["cart"], radius=0.1, margin=0.05, state_error=0.01)
    env = sw.CBFActionFilter(gym.make("InvertedPendulum-v5"), [keep])
    env.reset(seed=0)
    for _ in range(5):
        env.step(np.array([3.0], np.float32))
    (marks,) = looked(env)
    (x, _), (v, _) = env.unwrapped.data.qpos, env.unwrapped.data.qvel
    left, right = of(marks, "keep out")
    np.testing.assert_allclose([left.position[0], right.position[0]], [-0.74, 0.74])
    for pad in (left, right):
        np.testing.assert_allclose(np.abs(pad.axes[:, 2]), [1.0, 0.0, 0.0], atol=1e-12)
    (way,) = of(marks, "way")
    ((start, end),) = rods([way])
    assert abs(v) > 0.1 and way.size[0] == 0.1
    assert sorted([start[0], end[0]]) == pytest.approx(sorted([x, x + v * abs(v) / 16.0]))


@pytest.mark.parametrize(
    ("obstacle", "shape", "position", "size"),
    [
        (sw.constraints.Sphere([0.3, 0.2, 0.1], 0.05), "sphere", [0.3, 0.2, 0.1], [0.08, 0.0, 0.0]),
        (sw.constraints.Box([0.3, 0.2, 0.1], [0.1, 0.2, 0.3]), "box", [0.3, 0.2, 0.1], [0.13, 0.23, 0.33]),
    ],
)
def test_a_workspace_draws_what_is_kept_out_of(obstacle, shape, position, size):
    space = sw.constraints.Workspace(keep_out=[obstacle], bodies=["fingertip"], radius=0.01, margin=0.02)
    env = sw.CBFActionFilter(gym.make("Reacher-v5"), [space])
    env.reset(seed=0)
    (marks,) = looked(env)
    (drawn,) = of(marks, "keep out")
    assert drawn.shape == shape
    np.testing.assert_allclose(drawn.position, position)
    np.testing.assert_allclose(drawn.size, size)
    (point,) = of(marks, "way")
    np.testing.assert_allclose(point.position, env.unwrapped.data.body("fingertip").xpos, atol=1e-6)


def test_a_workspace_draws_its_planes_or_if_it_is_closed_its_edges():
    half = sw.constraints.Workspace(high=[0.15, None, None], bodies=["fingertip"], margin=0.01)
    box = sw.constraints.Workspace([-0.3, -0.2, -0.1], [0.3, 0.2, 0.1], bodies=["fingertip"], margin=0.01)
    env = sw.CBFActionFilter(gym.make("Reacher-v5"), [half, box])
    env.reset(seed=0)
    planes, closed = looked(env)
    (pad,) = of(planes, "keep out")
    tip = env.unwrapped.data.body("fingertip").xpos
    np.testing.assert_allclose(pad.position, [0.14, tip[1], tip[2]], atol=1e-6)
    edges = rods(of(closed, "limit")).reshape(-1, 3)
    np.testing.assert_allclose(edges.min(axis=0), [-0.29, -0.19, -0.09])
    np.testing.assert_allclose(edges.max(axis=0), [0.29, 0.19, 0.09])


@pytest.mark.parametrize("body", [None, "torso"])
def test_a_speed_is_an_arrow_that_reaches_the_ball_at_the_limit(body):
    limit = sw.constraints.SpeedLimit(3.0, body=body, direction="x", horizon=1)
    env = sw.CBFActionFilter(gym.make("HalfCheetah-v5"), [limit])
    env.reset(seed=0)
    assert looked(env) == [[]]  # nothing has moved yet
    rng = np.random.default_rng(0)
    for _ in range(10):
        before = env.unwrapped.data.qpos[0]
        info = env.step(rng.uniform(-1, 1, 6).astype(np.float32))[4]
    (marks,) = looked(env)
    ((arrow,), (ball,)) = of(marks, "way"), of(marks, "limit")
    if body:
        speed = (env.unwrapped.data.qpos[0] - before) / env.unwrapped.dt
        assert speed == pytest.approx(info["x_velocity"])
    else:
        speed = np.sign(arrow.axes[0, 2]) * (3.0 - env.look()[0].value()[0])
    assert abs(speed) > 0.05 and np.sign(arrow.axes[0, 2]) == np.sign(speed)
    assert arrow.size[2] / np.linalg.norm(ball.position - arrow.position) == pytest.approx(abs(speed) / 3.0)


def link_at(env, joint, value):
    """Where a joint's anchor and its body's centre of mass are with the joint elsewhere, all others as they are."""
    model, data = env.unwrapped.model, copy.copy(env.unwrapped.data)
    data.qpos[model.jnt_qposadr[joint]] = value
    mujoco.mj_forward(model, data)
    return data.xanchor[joint].copy(), data.xipos[model.jnt_bodyid[joint]].copy(), data.xaxis[joint].copy()


def across(vector, axis):
    """The direction of what is perpendicular to an axis."""
    rest = vector - (vector @ axis) * axis
    return rest / np.linalg.norm(rest)


def driven(task, constraint, steps=10):
    env = sw.CBFActionFilter(gym.make(task), [constraint])
    env.reset(seed=0)
    rng = np.random.default_rng(0)
    for _ in range(steps):
        env.unwrapped.step(0.3 * rng.uniform(-1, 1, env.action_space.shape))
    return env


def test_a_hinge_s_range_is_where_its_link_would_be_at_either_end():
    keep = sw.constraints.JointPositionLimit(margin=0.1)
    env = driven("Ant-v5", keep)
    (marks,) = looked(env)
    ways, ends = rods(of(marks, "way")), rods(of(marks, "limit")).reshape(-1, 2, 2, 3)
    model, data = env.unwrapped.model, env.unwrapped.data
    joints = sorted(model.actuator_trnid[:, 0])
    assert len(ways) == len(ends) == len(joints) == 8
    for joint, way, (low, high) in zip(joints, ways, ends, strict=True):
        first, last = model.jnt_range[joint]
        here = data.qpos[model.jnt_qposadr[joint]]
        for rod, value in ((way, here), (low, first + 0.1), (high, last - 0.1)):
            anchor, centre, axis = link_at(env, joint, value)
            np.testing.assert_allclose(rod[0], anchor, atol=1e-6)
            np.testing.assert_allclose(
                across(rod[1] - rod[0], axis), across(centre - anchor, axis), atol=1e-6
            )


def test_a_slide_s_range_ends_in_squares_where_it_would_be_and_one_without_end_has_one():
    keep = sw.constraints.JointPositionLimit(upper=0.5, lower=-np.inf, joints=["slider"])
    env = driven("InvertedPendulum-v5", keep, 3)
    (marks,) = looked(env)
    (square,), (point,) = of(marks, "limit", "box"), of(marks, "way", "sphere")
    np.testing.assert_allclose(square.position, [0.5, 0.0, 0.0], atol=1e-12)
    np.testing.assert_allclose(np.abs(square.axes[:, 2]), [1.0, 0.0, 0.0], atol=1e-12)
    np.testing.assert_allclose(point.position, [env.unwrapped.data.qpos[0], 0.0, 0.0], atol=1e-12)


@pytest.mark.parametrize("task", ["Ant-v5", "InvertedPendulum-v5"])
def test_a_joint_s_speed_reaches_its_ball_at_the_limit(task):
    limit = 5.0
    env = driven(task, sw.constraints.JointSpeedLimit(limit))
    model, data = env.unwrapped.model, env.unwrapped.data
    joints = sorted(model.actuator_trnid[:, 0])
    (marks,) = looked(env)
    per = len(marks) // len(joints)
    for joint, start in zip(joints, range(0, len(marks), per), strict=True):
        own = marks[start : start + per]
        share = data.qvel[model.jnt_dofadr[joint]] / limit
        assert abs(share) > 1e-3
        below, above = (ball.position for ball in of(own, "limit", "sphere"))
        if task == "Ant-v5":
            here = data.qpos[model.jnt_qposadr[joint]]
            tip = rods(of(own, "way"))[-1, 1]
            for point, value in ((tip, share), (below, -1.0), (above, 1.0)):
                anchor, centre, axis = link_at(env, joint, here + value * np.pi / 2)
                np.testing.assert_allclose(
                    across(point - anchor, axis), across(centre - anchor, axis), atol=1e-5
                )
        else:
            (arrow,) = of(own, "way")
            np.testing.assert_allclose(arrow.position, [data.qpos[0], 0.0, 0.0], atol=1e-12)
            np.testing.assert_allclose(
                arrow.tip - arrow.position, abs(share) * (above - below) / 2 * np.sign(share)
            )


def test_a_wheel_about_its_own_centre_has_an_arc_about_its_axle():
    wheels = ["front_left", "rear_right"]
    env = driven("SafeRover-v0", sw.constraints.JointSpeedLimit(50.0, joints=wheels))
    (marks,) = looked(env)
    data = env.unwrapped.data
    for name, balls in zip(wheels, np.split(np.array(of(marks, "limit")), 2), strict=True):
        joint = env.unwrapped.model.joint(name).id
        below, above = (ball.position - data.xanchor[joint] for ball in balls)
        assert np.linalg.norm(above) > 0.01 and abs(above @ data.xaxis[joint]) < 1e-9
        np.testing.assert_allclose(above, -below, atol=1e-9)


def test_contacts_have_narrowed_cones_forces_and_a_support_polygon():
    cones = sw.constraints.ContactFeasibility(friction_share=0.5)
    support = sw.constraints.SupportMargin(inset=0.01)
    env = sw.CBFActionFilter(gym.make("Ant-v5"), [cones, support])
    env.reset(seed=0)
    for _ in range(60):  # it falls to its feet and comes to rest
        env.unwrapped.step(np.zeros(8))
    first, second = looked(env)
    task = env.unwrapped
    feet = [c.pos for c in task.data.contact[: task.data.ncon]]
    forces = of(first, "way")
    assert len(forces) == len(feet) == task.data.ncon >= 3
    tall = 0.08 * task.model.stat.extent
    weight = 9.81 * task.model.body_mass.sum()
    up = sum(arrow.size[2] * arrow.axes[2, 2] for arrow in forces) / tall * weight
    assert up == pytest.approx(weight, rel=0.1)  # at rest
    (point, rim), *_ = rods(of(first, "limit"))
    friction = task.data.contact[0].friction[0]
    assert np.hypot(*(rim - point)[:2]) / abs((rim - point)[2]) == pytest.approx(0.5 * friction)
    corners = rods(of(second, "limit"))[:, 0, :2]
    for corner in corners:
        assert np.linalg.norm(np.array(feet)[:, :2] - corner, axis=1).min() < 1e-9
    (pressure,) = of(second, "way")
    assert (corners.min(axis=0) < pressure.position[:2]).all()
    assert (pressure.position[:2] < corners.max(axis=0)).all()


def test_in_the_air_there_is_nothing_to_draw_of_contacts():
    env = sw.CBFActionFilter(
        gym.make("Ant-v5"), [sw.constraints.ContactFeasibility(), sw.constraints.SupportMargin(inset=0.01)]
    )
    env.reset(seed=0)
    up = env.unwrapped.init_qpos.copy()
    up[2] = 5.0
    env.unwrapped.set_state(up, env.unwrapped.init_qvel)
    assert looked(env) == [[], []]
