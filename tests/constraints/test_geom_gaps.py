"""GeomGaps: every touch of a forecast is found, whatever is skipped on the way."""

from types import SimpleNamespace

import mujoco
import numpy as np
import pytest
from asking import bound
from judged_loops import Scene
from scipy.optimize import lsq_linear

from safe_wrappers.constraints.contact.geom_gaps import GeomGaps
from safe_wrappers.errors import ConfigurationError, UnknownNameError
from safe_wrappers.plants.mujoco.forecast import Poses

ARM = """<mujoco><option timestep="0.005" gravity="0 0 0"/><worldbody>
<geom name="floor" type="plane" pos="0 0 -.4" size="3 3 .1"/>
<geom name="post" type="cylinder" pos=".35 .3 0" size=".05 .3" margin=".01"/>
<body name="block" mocap="true" pos=".3 -.3 0" euler="10 20 30"><geom name="side" type="box" size=".1 .05 .2"/></body>
<body name="upper"><joint name="a" axis="0 0 1"/><joint name="b" axis="0 1 0"/>
<geom name="bone" type="capsule" fromto="0 0 0 .3 0 0" size=".03" mass="1" contype="0" conaffinity="0"/>
<body name="lower" pos=".3 0 0"><joint name="c" axis="0 .3 1"/>
<geom name="shin" type="box" pos=".12 .02 0" euler="20 0 40" size=".12 .04 .02" mass="1"/>
<geom name="painted" type="sphere" size=".2" contype="0" conaffinity="0"/></body></body>
<body name="ball" pos=".6 .1 0"><freejoint/><geom name="ball" size=".05"/></body>
<body name="bare" pos="0 0 2"/></worldbody>
<actuator><motor joint="a" ctrlrange="-9 9"/><motor joint="b" ctrlrange="-9 9"/><motor joint="c" ctrlrange="-9 9"/>
</actuator></mujoco>"""


@pytest.fixture(scope="module")
def plant():
    return bound(Scene(ARM))


def brute(plant, gaps, forecast, pair):
    """Distance of a pair at every instant."""
    m, data, found = plant.model, mujoco.MjData(plant.model), []
    for q in forecast.qpos:
        data.qpos[:] = q
        mujoco.mj_kinematics(m, data)
        found.append(gaps.nearest(m, data, pair)[0])
    return np.array(found)


def test_nothing_that_touches_is_skipped(plant):
    gaps = GeomGaps(plant, ["lower", "bone"], ["post", "floor", "block", "ball"])
    rng, data, touches, looked = np.random.default_rng(0), mujoco.MjData(plant.model), 0, 0
    honest = mujoco.mj_geomDistance
    for _ in range(120):
        raw = plant._raw
        raw.data.qpos[:3], raw.data.qvel[:3] = rng.uniform(-1.5, 1.5, 3), rng.uniform(-6.0, 6.0, 3)
        plant.observe()
        forecast = plant.forecast(rng.uniform(-9.0, 9.0, 3), 8)
        for pair in range(len(gaps.pairs)):
            distance, touch = brute(plant, gaps, forecast, pair), gaps.touch[pair]
            if np.abs(distance - touch).min() < 1e-9:
                continue  # rounding decides
            there, k = distance <= touch, len(distance)
            again = [
                i for i in range(2, k) if there[i - 2] and distance[i - 2] < distance[i - 1] > distance[i]
            ]
            wanted = [
                i
                for i in range(k)
                if there[i] and (i == 0 or not there[i - 1] or (i + 1) % plant.substeps == 0 or i in again)
            ]
            calls = []
            with pytest.MonkeyPatch.context() as patch:
                patch.setattr(
                    mujoco, "mj_geomDistance", lambda *a, calls=calls: calls.append(0) or honest(*a)
                )
                assert list(gaps.touched(plant, forecast, data, pair)) == wanted
            touches += len(wanted)
            looked += len(calls) / k
    assert touches > 100
    assert looked < 0.5 * 120 * len(gaps.pairs)  # and most of what cannot touch is


def test_an_approach_that_follows_a_rebound_begins_anew(plant):
    gaps = GeomGaps(plant, ["ball"], ["floor"])
    distances = [9, 3, -1, -4, -5, -3, -2, -2.5, -4, -4.5, -4, -1, 2, -1, -3, -2, -3, -2, -1, -4]  # mm
    ball, k = plant.named("body", "ball"), len(distances)
    poses = Poses(*(np.zeros((k, plant.model.nbody, *shape)) for shape in ((3,), (3, 3), (3,))))
    poses.axes[:] = np.eye(3)
    poses.frames[:, ball, 2] = -0.4 + 0.05 + 1e-3 * np.array(distances)
    poses.frames[:, 0] = 0.0
    forecast = SimpleNamespace(poses=lambda: poses)
    assert plant.substeps == 5
    found = list(gaps.touched(plant, forecast, mujoco.MjData(plant.model), 0))
    assert found == [2, 4, 7, 9, 13, 14, 16, 19]  # 2, 13: touch; 4, 9, 14, 19: ends; 7, 16, 19: approaches


def test_boxes_are_as_far_apart_as_a_least_squares_solver_finds_them():
    # MuJoCo alone says 0 of some that are far apart, up to 3.11; 3.12 has another algorithm for two boxes.
    boxes = """<mujoco><worldbody><geom name="a" type="box" size=".1 .05 .2"/>
    <body><freejoint/><geom name="b" type="box" size=".12 .04 .02"/></body></worldbody></mujoco>"""
    env = Scene(boxes)
    plant = bound(env)
    m, data = plant.model, mujoco.MjData(plant.model)
    gaps, rng, wrong, apart = GeomGaps(plant, ["b"], ["a"]), np.random.default_rng(0), 0, 0
    for _ in range(2500):
        quat = rng.normal(size=4)
        data.qpos[:] = [*rng.uniform(-0.4, 0.4, 3), *quat / np.linalg.norm(quat)]
        mujoco.mj_kinematics(m, data)
        axes = [data.geom_xmat[g].reshape(3, 3) for g in (1, 0)]
        sizes = np.concatenate([m.geom_size[1], m.geom_size[0]])
        nearest = lsq_linear(
            np.hstack([axes[0], -axes[1]]), data.geom_xpos[0] - data.geom_xpos[1], (-sizes, sizes), "bvls"
        )
        distance = np.linalg.norm(nearest.fun)
        if distance > 1e-4:  # the solver ends near 0 where they overlap
            apart += 1
            assert gaps.nearest(m, data, 0)[0] == pytest.approx(distance, abs=2e-7)
            wrong += mujoco.mj_geomDistance(m, data, 1, 0, 9.0, None) == 0.0
    assert apart > 1500
    assert wrong == 0 if mujoco.mj_version() >= 3_012_000 else wrong > 10


def test_normals_point_from_the_machine_to_the_world_on_both_sides_of_the_surface(plant):
    gaps = GeomGaps(plant, ["ball"], ["floor"])
    data = mujoco.MjData(plant.model)
    for height in (0.2, 1e-4, -1e-4, -0.02):
        data.qpos[:] = plant.model.qpos0
        data.qpos[5] = -0.4 + 0.05 + height
        mujoco.mj_kinematics(plant.model, data)
        gap, normal, points = gaps.nearest(plant.model, data, 0)
        assert gap == pytest.approx(height, abs=1e-12)
        np.testing.assert_allclose(normal, [0.0, 0.0, -1.0], atol=1e-9)
        np.testing.assert_allclose(points[[2, 5]], [height - 0.4, -0.4], atol=1e-9)
    data.qpos[5] = -0.4 + 0.05  # exactly at the surface there is no way between the nearest points
    mujoco.mj_kinematics(plant.model, data)
    gap, normal, _ = gaps.nearest(plant.model, data, 0)
    assert abs(gap) < 1e-12
    np.testing.assert_allclose(normal, [0.0, 0.0, -1.0], atol=1e-6)
    np.testing.assert_allclose(data.geom("ball").xpos, [*plant.model.qpos0[3:5], -0.35], atol=1e-12)


def test_bodies_stand_for_what_of_them_collides(plant):
    def names(machine, world):
        gaps = GeomGaps(plant, machine, world)
        return [tuple(plant.model.geom(g).name for g in pair) for pair in gaps.pairs], gaps

    pairs, gaps = names(["lower", "upper"], ["post", "block", "ball", "post"])
    assert pairs == [(a, b) for a in ("shin", "bone") for b in ("post", "side", "ball")]
    np.testing.assert_array_equal(gaps.touch, [0.01, 0.0, 0.0] * 2)
    np.testing.assert_array_equal(gaps.moves, [False, False, True] * 2)
    assert names(["painted"], ["floor"])[0] == [("painted", "floor")]  # by its own name it counts
    assert names(["shin"], ["world"])[0] == [("shin", "floor"), ("shin", "post")]


@pytest.mark.parametrize(
    ("machine", "world", "error", "message"),
    [
        (
            ["hand"],
            ["floor"],
            UnknownNameError,
            "no body or geom 'hand'; bodies: world, block, upper.*floor, post",
        ),
        (["lower"], ["wall"], UnknownNameError, "no body or geom 'wall'"),
        (["lower"], ["upper"], ConfigurationError, "'upper' is part of the machine itself.*lower"),
        (["lower"], ["shin"], ConfigurationError, "'shin' is part of the machine itself"),
        (["floor"], ["ball"], ConfigurationError, "no joint moves 'floor'"),
        (["lower"], ["bare"], ConfigurationError, "body 'bare' has no geoms"),
    ],
)
def test_what_cannot_meet_is_refused(plant, machine, world, error, message):
    with pytest.raises(error, match=message):
        GeomGaps(plant, machine, world)
