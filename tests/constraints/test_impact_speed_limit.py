"""ImpactSpeedLimit: masses, pushes and peaks against independent answers, and gaps that are not skipped."""

import mujoco
import numpy as np
import pytest
from asking import asked, bound
from judged_loops import ForceJudge, below_force, cart_before_a_wall
from scenes import Scene
from scipy.optimize import lsq_linear

import safe_wrappers as sw
from safe_wrappers.constraints.impact_speed_limit import GeomGaps

K, MASS, LIMIT = 2e4, 5.0, 140.0


def limit(against="wall", **options):
    return sw.constraints.ImpactSpeedLimit(["cart"], [against], LIMIT, K, **options)


STRUCK = np.sqrt(K * MASS)  # N per m/s


@pytest.mark.parametrize(
    ("speed", "gap", "left"),
    [
        (0.3, -1e-7, LIMIT - 0.3 * STRUCK),  # 45 N
        (3.0, -1e-7, LIMIT - 3.0 * STRUCK),
        (0.3, 0.1, LIMIT - 0.3 * STRUCK),
        (3.0, 0.1, 0.0),  # whether it brakes in time the forecast says
        (-3.0, 0.1, LIMIT),
        (0.0, -0.005, LIMIT - K * 0.005),
    ],
)
def test_the_value_is_the_limit_less_the_peak_at_the_present_speed(speed, gap, left):
    env = cart_before_a_wall(MASS, K, gap=gap)
    env.data.qvel[0] = speed
    assert asked(env, limit(margin=5.0)).value() == pytest.approx(left, abs=1e-2)


ARM = """<mujoco><option timestep="0.001"/><worldbody>
<geom name="wall" type="plane" pos="1 0 0" euler="0 -70 0" size="2 2 .1" contype="0"/>
<body name="upper" pos="0 0 .3"><joint name="a" axis="0 1 0" damping=".4"/><geom type="capsule" fromto="0 0 0 .4 0 0"
size=".04"/><body name="lower" pos=".4 0 0"><joint name="b" axis="0 1 .3" damping=".2" armature=".02"/>
<geom type="capsule" fromto="0 0 0 .3 0 .1" size=".03"/><body name="hand" pos=".3 0 .1"><joint name="c" axis="1 0 0"
stiffness="3"/><geom name="fist" size=".05" pos=".05 .02 0"/></body></body></body>
<body name="free" pos="3 0 3"><freejoint/><geom name="free" size=".1" mass="2"/></body></worldbody>
<actuator><motor joint="a" gear="40" ctrlrange="-1 1"/><motor joint="b" gear="20" ctrlrange="-1 1"/>
<motor joint="c" gear="2" ctrlrange="-1 1"/></actuator></mujoco>"""


@pytest.mark.parametrize("seed", range(4))
def test_the_peak_is_that_of_the_moving_arms_speed_mass_and_push(seed):
    env, rng = Scene(ARM), np.random.default_rng(seed)
    env.data.qpos[:3], env.data.qvel[:3] = rng.uniform(-0.8, 0.8, 3), rng.uniform(-3.0, 3.0, 3)
    constraint = asked(env, sw.constraints.ImpactSpeedLimit(["hand"], ["wall"], 100.0, 1e4))
    constraint.value()
    m, data, control = env.model, mujoco.MjData(env.model), rng.uniform(-1.0, 1.0, 3)
    qpos, qvel = env.data.qpos.copy(), env.data.qvel.copy()

    def at(q, v, u=control):
        data.qpos[:], data.qvel[:], data.ctrl[:] = q, v, u
        mujoco.mj_forward(m, data)
        return data.body("hand").xpos, data.body("hand").xmat.reshape(3, 3)

    # The distance and the point by hand: the wall's normal, the fist's lowest point above it.
    place, axes = at(qpos, qvel)
    into = -data.geom("wall").xmat.reshape(3, 3)[:, 2]
    fist = data.geom("fist").xpos + 0.05 * into
    gap, point = float(into @ (data.geom("wall").xpos - fist)), axes.T @ (fist - place)

    def closing(q, v):
        """Speed along the normal of the point of the hand that is there now."""
        place, axes = at(q, v)
        jacobian = np.zeros((3, m.nv))
        mujoco.mj_jac(m, data, jacobian, None, place + axes @ point, m.body("hand").id)
        return float(into @ jacobian @ v)

    speed, row = closing(qpos, qvel), np.array([closing(qpos, unit) for unit in np.eye(m.nv)])
    given = np.zeros((1, m.nv))
    mujoco.mj_solveM(m, data, given, row[None])
    mass = 1.0 / float(row @ given[0])
    # The push: how fast the closing speed grows, in motion (by differences along it) and once it has stopped.
    h, ahead = 1e-6, qpos.copy()
    mujoco.mj_integratePos(m, ahead, qvel, h)
    at(qpos, qvel)
    growing = (closing(ahead, qvel + h * data.qacc_smooth) - speed) / h
    at(qpos, 0.0 * qvel)
    push, deep = mass * max(growing, float(row @ data.qacc_smooth), 0.0), max(-gap, 0.0)
    constraint.place(qpos, qvel, control)
    assert constraint.contact(0).gap == pytest.approx(gap)
    for k in (1e-6, 1e4, 1e9):  # the push decides, both, and the speed
        constraint.spec.stiffness = k
        expected = push + np.hypot(k * deep - push, max(speed, 0.0) * np.sqrt(k * mass))
        assert constraint.contact(0).peak == pytest.approx(expected, rel=1e-4, abs=1e-4)
    at(qpos, 0.0 * qvel, 0.0)  # without the motors
    constraint.spec.stiffness = 1e-6
    constraint.place(qpos, qvel, None)
    assert constraint.contact(0).peak >= 2.0 * mass * max(float(row @ data.qacc_smooth), 0.0) - 1e-6


def test_what_cannot_move_along_the_normal_is_not_pressed():
    env = cart_before_a_wall(
        MASS, K, extra='<geom name="floor" type="box" pos="0 0 -.14" size="9 9 .05"/>'
    )  # 1 cm below its top
    assert asked(env, limit("floor")).value() == LIMIT
    assert asked(env, limit("floor")).admits(np.ones(1))


def test_a_wall_that_the_env_moves_by_hand_is_taken_where_it_is():
    env = cart_before_a_wall(MASS, K, wall='mocap="true"')
    constraint = limit()
    env.data.qvel[0] = 0.3
    far = asked(env, constraint).value()
    env.data.mocap_pos[0, 0] = 0.1 - 0.002
    near = asked(env, constraint).value()
    assert far == pytest.approx(LIMIT - 0.3 * np.sqrt(K * MASS))
    assert near == pytest.approx(LIMIT - np.hypot(K * 0.002, 0.3 * np.sqrt(K * MASS)), rel=1e-6)
    assert not asked(env, constraint).admits(np.ones(1))  # 200 N more against 140
    env.data.mocap_pos[0, 0] = 9.0
    assert asked(env, constraint).admits(np.ones(1))


@pytest.mark.parametrize(("share", "passes"), [(0.48, True), (0.52, False)])
def test_pushing_counts(share, passes):
    # At rest at the surface: a push of half the limit springs up to the limit, more exceeds it.
    env = cart_before_a_wall(MASS, K, force=LIMIT)
    env.start = [0.3 - 1e-5], [0.0]
    filtered = sw.CBFActionFilter(env, [limit(horizon=10)])
    judge = ForceJudge(filtered, below_force(LIMIT))
    filtered.reset(seed=0)
    steps = [judge.step(filtered, np.full(1, share)) for _ in range(40)]
    assert 0.0 <= min(left for left, *_ in steps) < 0.1 * LIMIT
    assert any(info["cbf/intervened"] for *_, info in steps) != passes


def test_at_the_end_of_the_held_step_the_push_is_over():
    push, wall = np.ones(1), 1.0
    for _ in range(2):  # the second time the wall is reached within the last substep
        env = cart_before_a_wall(MASS, K, gap=wall, force=LIMIT)
        env.data.qvel[0] = 0.9
        constraint = asked(env, limit(horizon=1))
        before, end = constraint.plant.rollout(push).qpos[-2:, 0]
        speed, wall = constraint.plant.rollout(push).qvel[-1, 0], 0.5 * (before + end)
    struck = np.hypot(K * (end - wall), speed * STRUCK)
    assert constraint.slack(push) == pytest.approx(LIMIT - struck, rel=1e-3)


@pytest.mark.parametrize("margin", [0.0, 5.0])
def test_a_limit_that_cannot_be_kept_any_more_is_flagged_from_inside_the_margin_too(margin):
    env = sw.CBFActionFilter(cart_before_a_wall(MASS, K, gap=0.02, force=20.0), [limit(margin=margin)])
    env.reset(seed=0)
    env.unwrapped.data.qvel[0] = 1.5
    for _ in range(2):  # too fast to be stopped before the wall
        info = env.step(np.ones(1))[4]
        assert info["cbf/infeasible"] and info["cbf/fallback"]


# GeomGaps: every touch of a forecast is found, whatever is skipped on the way


ARM_GAPS = """<mujoco><option timestep="0.005" gravity="0 0 0"/><worldbody>
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


def test_nothing_that_touches_is_skipped():
    env = Scene(ARM_GAPS)
    plant = bound(env)
    gaps = GeomGaps(plant, ["lower", "bone"], ["post", "floor", "block", "ball"])
    rng, data, touches, looked = np.random.default_rng(0), mujoco.MjData(plant.model), 0, []
    honest = mujoco.mj_geomDistance
    for _ in range(60):
        env.data.qpos[:3], env.data.qvel[:3] = rng.uniform(-1.5, 1.5, 3), rng.uniform(-6.0, 6.0, 3)
        plant.observe()
        forecast = plant.rollout(rng.uniform(-9.0, 9.0, 3), 8)
        k, distances = len(forecast.qpos), []
        for data.qpos[:] in forecast.qpos:
            mujoco.mj_kinematics(plant.model, data)
            distances.append([gaps.nearest(plant.model, data, pair)[0] for pair in range(len(gaps.pairs))])
        for pair, distance in enumerate(np.transpose(distances)):
            if np.abs(distance - gaps.touch[pair]).min() < 1e-9:
                continue  # rounding decides
            there = distance <= gaps.touch[pair]
            again = np.zeros(k, bool)
            again[2:] = there[:-2] & (distance[:-2] < distance[1:-1]) & (distance[1:-1] > distance[2:])
            ends, begins = np.arange(1, k + 1) % plant.substeps == 0, ~np.concatenate([[False], there[:-1]])
            wanted = np.flatnonzero(there & (ends | begins | again)).tolist()
            with pytest.MonkeyPatch.context() as patch:
                patch.setattr(
                    mujoco, "mj_geomDistance", lambda *a, pair=pair: looked.append(pair) or honest(*a)
                )
                assert list(gaps.touched(plant, forecast, data, pair)) == wanted
            touches += len(wanted)
    assert touches > 50
    assert len(looked) < 0.5 * 60 * k * len(gaps.pairs)  # and most of what cannot touch is


BOXES = """<mujoco><worldbody><geom name="a" type="box" size=".1 .05 .2"/>
<body><freejoint/><geom name="b" type="box" size=".12 .04 .02"/></body></worldbody></mujoco>"""


def test_boxes_are_as_far_apart_as_a_least_squares_solver_finds_them():
    # MuJoCo alone says 0 of some that are far apart, up to 3.11; 3.12 has another algorithm for two boxes.
    env = Scene(BOXES)
    plant, m, data = bound(env), env.model, mujoco.MjData(env.model)
    gaps, rng, wrong, apart = GeomGaps(plant, ["b"], ["a"]), np.random.default_rng(0), 0, 0
    bounds = np.concatenate([m.geom_size[1], m.geom_size[0]])
    for _ in range(1000):
        data.qpos[:] = [*rng.uniform(-0.4, 0.4, 3), *rng.normal(size=4)]
        mujoco.mj_kinematics(m, data)
        one, other = data.geom_xmat.reshape(2, 3, 3)
        way = data.geom_xpos[0] - data.geom_xpos[1]
        distance = np.linalg.norm(lsq_linear(np.hstack([other, -one]), way, (-bounds, bounds), "bvls").fun)
        if distance > 1e-4:  # the solver ends near 0 where they overlap
            apart += 1
            assert gaps.nearest(m, data, 0)[0] == pytest.approx(distance, abs=2e-7)
            wrong += mujoco.mj_geomDistance(m, data, 1, 0, 9.0, None) == 0.0
    assert apart > 600
    assert wrong == 0 if mujoco.mj_version() >= 3_012_000 else wrong > 4
