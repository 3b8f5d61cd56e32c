"""ImpactSpeedLimit: masses, pushes and peaks against independent answers, and closed loops before springy walls."""

import gymnasium as gym
import mujoco
import numpy as np
import pytest
from asking import asked, bound
from judged_loops import Scene
from scipy.optimize import lsq_linear

import safe_wrappers as sw
from safe_wrappers.constraints.impact_speed_limit import GeomGaps
from safe_wrappers.errors import ConfigurationError, UnknownNameError

# A mass on a slide before a wall ------------------------------------------------------------------------------

K, MASS, LIMIT = 2e4, 5.0, 140.0


def slide(
    force=200.0, stiffness=K, mass=MASS, timestep=1e-3, gap=0.3, frame_skip=10, extra="", wall="", option=""
):
    """A ball that is pushed along x towards a wall that MuJoCo makes a spring without damping."""
    env = Scene(
        f"""<mujoco><option timestep="{timestep}" gravity="0 0 0" {option}/><worldbody>
        <body name="wall" pos="{gap + 0.1} 0 0" {wall}><geom name="wall" type="box" size=".05 .5 .5" pos=".05 0 0"
          condim="1" priority="1"/></body>
        <body name="cart"><joint name="x" axis="1 0 0" type="slide"/>
        <geom name="bumper" size=".1" mass="{mass}" condim="1"/></body>{extra}</worldbody>
        <actuator><motor joint="x" ctrlrange="-1 1" gear="{force}"/></actuator></mujoco>""",
        frame_skip=frame_skip,
    )
    m = env.model
    m.geom("wall").solref[:] = -stiffness * m.body("cart").invweight0[0], 0.0
    m.geom("wall").solimp[:] = 1e-3, 1e-3, 1e-3, 0.5, 2.0
    return env


def limit(**arguments):
    return sw.constraints.ImpactSpeedLimit(
        **{"bodies": ["cart"], "against": ["wall"], "force_limit": LIMIT, "stiffness": K, **arguments}
    )


def peaks(env, policy, steps, reset=True):
    """Largest contact force of each control step, by an integration of its own; and the infos."""
    raw = env.unwrapped
    if reset:
        env.reset(seed=0)
    data, found, infos = mujoco.MjData(raw.model), [], []
    for k in range(steps):
        mujoco.mj_copyData(data, raw.model, raw.data)
        action = policy(raw, k)
        info = env.step(action)[4]
        data.ctrl[:] = info.get("executed_action", action)
        worst = 0.0
        for _ in range(raw.frame_skip):
            mujoco.mj_step(raw.model, data)
            worst = max(worst, float(data.efc_force[data.contact.efc_address[: data.ncon]].sum()))
        np.testing.assert_array_equal(data.qpos, raw.data.qpos)  # else it judges another machine
        found.append(worst)
        infos.append(info)
    return np.array(found), infos


def full(raw, k):
    return np.ones(1)


# What a contact comes to --------------------------------------------------------------------------------------


ARM = """<mujoco><option timestep="0.001"/><worldbody>
<geom name="wall" type="plane" pos="1 0 0" euler="0 -70 0" size="2 2 .1" contype="0"/>
<body name="upper" pos="0 0 .3"><joint name="a" axis="0 1 0" damping=".4"/><geom type="capsule" fromto="0 0 0 .4 0 0"
size=".04"/><body name="lower" pos=".4 0 0"><joint name="b" axis="0 1 .3" damping=".2" armature=".02"/>
<geom type="capsule" fromto="0 0 0 .3 0 .1" size=".03"/><body name="hand" pos=".3 0 .1"><joint name="c" axis="1 0 0"
stiffness="3"/><geom name="fist" size=".05" pos=".05 .02 0"/></body></body></body>
<body name="free" pos="3 0 3"><freejoint/><geom name="free" size=".1" mass="2"/></body></worldbody>
<actuator><motor joint="a" gear="40" ctrlrange="-1 1"/><motor joint="b" gear="20" ctrlrange="-1 1"/>
<motor joint="c" gear="2" ctrlrange="-1 1"/></actuator></mujoco>"""


def closing(model, qpos, qvel, normal, point):
    """Speed along a fixed direction of the point of the hand that is at `point` (in its frame)."""
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:] = qpos, qvel
    mujoco.mj_forward(model, data)
    hand = data.body("hand")
    jacobian = np.zeros((3, model.nv))
    mujoco.mj_jac(model, data, jacobian, None, hand.xpos + hand.xmat.reshape(3, 3) @ point, hand.id)
    return float(normal @ jacobian @ qvel)


def value_at(env, constraint, speed, gap=None):
    if gap is not None:
        env.data.qpos[0] = env.data.qpos[0] + env.model.body("wall").pos[0] - 0.1 - gap - env.data.qpos[0]
    env.data.qvel[0] = speed
    return asked(env, constraint).value()


def test_the_value_is_the_limit_less_the_peak_at_the_present_speed():
    touching = value_at(slide(), limit(margin=5.0), 0.3, gap=-1e-7)
    assert touching == pytest.approx(LIMIT - 0.3 * np.sqrt(K * MASS), abs=1e-2)  # 45 N
    assert value_at(slide(), limit(), 3.0, gap=-1e-7) == pytest.approx(
        LIMIT - 3.0 * np.sqrt(K * MASS), abs=1e-2
    )
    assert value_at(slide(), limit(), 0.3, gap=0.1) == pytest.approx(LIMIT - 0.3 * np.sqrt(K * MASS))
    assert value_at(slide(), limit(), 3.0, gap=0.1) == 0.0  # whether it brakes in time the forecast says
    assert value_at(slide(), limit(), -3.0, gap=0.1) == LIMIT
    pressed = value_at(slide(), limit(), 0.0, gap=-0.005)
    assert pressed == pytest.approx(LIMIT - K * 0.005)


@pytest.mark.parametrize("seed", range(6))
def test_the_peak_is_that_of_the_moving_arms_speed_mass_and_push(seed):
    env, rng = Scene(ARM), np.random.default_rng(seed)
    env.data.qpos[:3], env.data.qvel[:3] = rng.uniform(-0.8, 0.8, 3), rng.uniform(-3.0, 3.0, 3)
    constraint = asked(
        env, sw.constraints.ImpactSpeedLimit(["hand"], ["wall"], force_limit=100.0, stiffness=1e4)
    )
    m, data, control = env.model, mujoco.MjData(env.model), rng.uniform(-1.0, 1.0, 3)
    constraint.value()
    qpos, qvel = env.data.qpos.copy(), env.data.qvel.copy()
    constraint.place(qpos, qvel, control)
    contact = constraint.contact(0)

    # The distance and the point by hand: the wall's normal, the fist's lowest point above it.
    data.qpos[:], data.qvel[:], data.ctrl[:] = qpos, qvel, control
    mujoco.mj_forward(m, data)
    into = -data.geom("wall").xmat.reshape(3, 3)[:, 2]
    fist = data.geom("fist").xpos + 0.05 * into
    assert contact.gap == pytest.approx(float(into @ (data.geom("wall").xpos - fist)))
    hand = data.body("hand")
    point = hand.xmat.reshape(3, 3).T @ (fist - hand.xpos)

    def moving(q, v):
        return closing(m, q, v, into, point)

    speed = moving(qpos, qvel)
    row = np.array([moving(qpos, unit) for unit in np.eye(m.nv)])
    inertia = np.array([np.zeros(m.nv) for _ in range(m.nv)])
    for column, unit in zip(inertia, np.eye(m.nv), strict=True):
        mujoco.mj_mulM(m, data, column, unit)
    mass = 1.0 / float(row @ np.linalg.solve(inertia, row))

    # The push: how fast the closing speed grows, in motion (by differences along it) and once it has stopped.
    h = 1e-6
    ahead = qpos.copy()
    mujoco.mj_integratePos(m, ahead, qvel, h)
    growing = (moving(ahead, qvel + h * data.qacc_smooth) - speed) / h
    data.qvel[:] = 0.0
    mujoco.mj_forward(m, data)
    resting = float(row @ data.qacc_smooth)
    push, deep = mass * max(growing, resting, 0.0), max(-contact.gap, 0.0)
    for k in (1e-6, 1e4, 1e9):  # the push decides, both, and the speed
        constraint.spec.stiffness = k
        struck = max(speed, 0.0) * np.sqrt(k * mass)
        expected = push + np.hypot(k * deep - push, struck)
        assert constraint.contact(0).peak == pytest.approx(expected, rel=1e-4, abs=1e-4)
    constraint.spec.stiffness = 1e-6
    constraint.place(qpos, qvel, None)
    data.ctrl[:] = 0.0
    mujoco.mj_forward(m, data)
    resting = float(row @ data.qacc_smooth)  # without the motors
    assert constraint.contact(0).peak >= 2.0 * mass * max(resting, 0.0) - 1e-6


def test_what_cannot_move_along_the_normal_is_not_pressed():
    env = slide(extra='<geom name="floor" type="box" pos="0 0 -.14" size="9 9 .05"/>')  # 1 cm below its top
    assert asked(env, limit(against=["floor"])).value() == LIMIT
    assert asked(env, limit(against=["floor"])).admits(np.ones(1))


# What the world is like ---------------------------------------------------------------------------------------


def test_a_wall_that_the_env_moves_by_hand_is_taken_where_it_is():
    env = slide(wall='mocap="true"')
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


# Closed loops -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("mass", "stiffness"), [(0.5, 6e4), (MASS, 8e3), (40.0, 6e4)])
def test_at_full_throttle_it_arrives_with_what_is_allowed_and_then_holds_it(mass, stiffness):
    held = limit(stiffness=stiffness, margin=2.0, horizon={0.5: 8, MASS: 12, 40.0: 40}[mass])
    fine = (
        {"timestep": 2.5e-4, "frame_skip": 40, "gap": 0.05} if mass < 1.0 else {}
    )  # a contact lasts 20 ms or less
    env = sw.CBFActionFilter(slide(mass=mass, stiffness=stiffness, **fine), [held])
    steps = 30 if mass < 1.0 else 70
    force, infos = peaks(env, full, steps)
    assert force.max() <= LIMIT  # by MuJoCo's own contact
    assert force.max() >= 0.9 * LIMIT  # and it is let near the limit
    assert not any(i["cbf/infeasible"] or i["cbf/fallback"] for i in infos)
    unfiltered, _ = peaks(slide(mass=mass, stiffness=stiffness, **fine), full, steps)
    assert unfiltered.max() > 3.0 * LIMIT


def test_pushing_counts():
    # At rest at the surface: a push of half the limit springs up to the limit, more exceeds it.
    for share, passes in ((0.48, True), (0.52, False)):
        env = slide(force=LIMIT)
        env.start = [0.3 - 1e-5], [0.0]
        filtered = sw.CBFActionFilter(env, [limit(horizon=10)])
        force, infos = peaks(filtered, lambda raw, k, share=share: np.full(1, share), 40)
        assert force.max() <= LIMIT and (force.max() > 0.9 * LIMIT)
        assert any(i["cbf/intervened"] for i in infos) != passes


def test_away_from_everything_actions_pass_bit_for_bit():
    bare, filtered = slide(gap=50.0), sw.CBFActionFilter(slide(gap=50.0), [limit()])
    rng = np.random.default_rng(0)
    bare.reset(seed=0)
    filtered.reset(seed=0)
    for _ in range(30):
        action = rng.uniform(-1.0, 1.0, 1)
        bare.step(action)
        assert not filtered.step(action)[4]["cbf/intervened"]
        assert bare.data.qpos.tobytes() == filtered.unwrapped.data.qpos.tobytes()


# Plain data, and what is refused ------------------------------------------------------------------------------


PLAIN = {"force_limit": 100.0, "stiffness": 1e4}
REACHER = {"bodies": ["fingertip"], "against": ["sideE"]}


@pytest.mark.parametrize(
    ("arguments", "error", "message"),
    [
        ({"force_limit": 0.0}, ConfigurationError, "force_limit must be a finite number > 0 in N, got 0.0"),
        ({"margin": 100.0}, ConfigurationError, "the margin 100.0 N leaves nothing of the limit 100.0 N"),
        ({"stiffness": None}, ConfigurationError, "stiffness must be a number in N/m"),
        ({"bodies": []}, ConfigurationError, r"bodies is a list of names of bodies or geoms; got \[\]"),
        ({"bodies": ["hand"]}, UnknownNameError, "no body or geom 'hand'; bodies: world, body0.*fingertip"),
        ({"against": ["body0"]}, ConfigurationError, "'body0' is part of the machine itself"),
    ],
)
def test_nonsense_is_refused(arguments, error, message):
    with pytest.raises(error, match=message):
        sw.CBFActionFilter(
            gym.make("Reacher-v5"), [sw.constraints.ImpactSpeedLimit(**{**REACHER, **PLAIN, **arguments})]
        )


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


@pytest.fixture(scope="module")
def plant():
    return bound(Scene(ARM_GAPS))


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
        forecast = plant.rollout(rng.uniform(-9.0, 9.0, 3), 8)
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


@pytest.mark.parametrize("margin", [0.0, 5.0])
def test_a_limit_that_cannot_be_kept_any_more_is_flagged_from_inside_the_margin_too(margin):
    env = sw.CBFActionFilter(slide(gap=0.02, force=20.0), [limit(margin=margin)])
    env.reset(seed=0)
    env.unwrapped.data.qvel[0] = 1.5
    for _ in range(2):  # too fast to be stopped before the wall
        info = env.step(np.ones(1))[4]
        assert info["cbf/infeasible"] and info["cbf/fallback"]
