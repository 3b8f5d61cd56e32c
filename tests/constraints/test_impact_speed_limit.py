"""ImpactSpeedLimit: masses, pushes and peaks against independent answers, and closed loops before springy walls."""

import gymnasium as gym
import mujoco
import numpy as np
import pytest
from asking import asked
from hypothesis import given, settings
from hypothesis import strategies as st
from judged_loops import Scene
from scipy.integrate import solve_ivp

import safe_wrappers as sw
from safe_wrappers.constraints.contact.impact_speed_limit import Contact
from safe_wrappers.control.contact.impact import BODY_REGIONS, peak_force, time_to_peak
from safe_wrappers.errors import ConfigurationError, UnknownNameError, UnsupportedEnvError

# A mass on a slide before a wall ------------------------------------------------------------------------------

K, MASS, LIMIT = 2e4, 5.0, 140.0
SLOW = LIMIT / np.sqrt(K * MASS)
"""Allowed at the touch, m/s."""


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


@settings(max_examples=40)
@given(
    speed=st.floats(0.0, 2.0),
    mass=st.floats(0.5, 40.0),
    stiffness=st.floats(1e3, 1e5),
    push=st.floats(0.0, 300.0),
    deflection=st.floats(0.0, 0.02),
)
def test_the_peak_is_that_of_the_differential_equation(speed, mass, stiffness, push, deflection):
    contact = Contact(-deflection, speed, mass, stiffness, push, deflection)
    period = 2.0 * np.pi * np.sqrt(mass / stiffness)
    done = solve_ivp(
        lambda _, s: [s[1], (push - stiffness * s[0]) / mass],
        (0.0, period),
        [deflection, speed],
        max_step=period / 200.0,
        rtol=1e-9,
        atol=1e-12,
    )
    assert contact.peak == pytest.approx(stiffness * done.y[0].max(), rel=1e-3, abs=1e-3)


@given(
    speed=st.floats(0.0, 2.0),
    mass=st.floats(0.1, 40.0),
    stiffness=st.floats(1e3, 1e5),
    push=st.floats(0.0, 400.0),
    pressed=st.floats(0.0, 400.0),
    margin=st.floats(0.0, 50.0),
)
def test_what_is_left_is_negative_exactly_where_the_peak_is_too_high(
    speed, mass, stiffness, push, pressed, margin
):
    contact = Contact(0.0, speed, mass, stiffness, push, pressed / stiffness)
    left, over = contact.left(LIMIT - margin), contact.peak - (LIMIT - margin)
    if abs(over) > 1e-6 * LIMIT:
        assert (left < 0.0) == (over > 0.0)
    assert left <= 0.5 * LIMIT + 1e-9
    harder = contact._replace(push=push + 10.0).left(LIMIT - margin)
    assert harder < left or pressed == LIMIT - margin  # also where all is lost


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


@pytest.mark.parametrize("seed", range(3))
def test_speed_mass_and_push_are_those_of_the_moving_arm(seed):
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
    assert contact.speed == pytest.approx(max(speed, 0.0), abs=1e-9)
    row = np.array([moving(qpos, unit) for unit in np.eye(m.nv)])
    inertia = np.array([np.zeros(m.nv) for _ in range(m.nv)])
    for column, unit in zip(inertia, np.eye(m.nv), strict=True):
        mujoco.mj_mulM(m, data, column, unit)
    mass = 1.0 / float(row @ np.linalg.solve(inertia, row))
    assert contact.mass == pytest.approx(mass, rel=1e-9) and contact.stiffness == 1e4

    # The push: how fast the closing speed grows, in motion (by differences along it) and once it has stopped.
    h = 1e-6
    ahead = qpos.copy()
    mujoco.mj_integratePos(m, ahead, qvel, h)
    growing = (moving(ahead, qvel + h * data.qacc_smooth) - speed) / h
    data.qvel[:] = 0.0
    mujoco.mj_forward(m, data)
    resting = float(row @ data.qacc_smooth)
    assert contact.push == pytest.approx(mass * max(growing, resting, 0.0), rel=1e-4, abs=1e-4)
    constraint.place(qpos, qvel, None)
    data.ctrl[:] = 0.0
    mujoco.mj_forward(m, data)
    resting = float(row @ data.qacc_smooth)  # without the motors
    assert constraint.contact(0).push >= mass * max(resting, 0.0) - 1e-9


# What the world is like ---------------------------------------------------------------------------------------


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


def test_what_gives_way_weighs_less():
    ball = '<body name="ball" pos=".4 0 0"><freejoint/><geom name="ball" size=".1" mass="1.25"/></body>'
    env = slide(extra=ball)
    env.data.qpos[0], env.data.qvel[0] = 0.2 + 1e-7, 0.3
    constraint = limit(against=["ball"])
    assert asked(env, constraint).value() == pytest.approx(LIMIT - 0.3 * np.sqrt(K * 1.0), abs=1e-2)
    env.data.qvel[1] = -0.2  # it comes along x itself
    assert asked(env, constraint).value() == pytest.approx(LIMIT - 0.5 * np.sqrt(K * 1.0), abs=1e-2)


def test_a_region_brings_its_spring_its_mass_and_its_limit():
    chest = BODY_REGIONS["chest"]
    reduced = 1.0 / (1.0 / MASS + 1.0 / chest.mass)

    def region(**more):
        return limit(region="chest", **{"force_limit": None, "stiffness": None, **more})

    def left(constraint):
        return value_at(slide(), constraint, 0.3, gap=-1e-8)[0]

    assert left(region()) == pytest.approx(280.0 - 0.3 * np.sqrt(chest.stiffness * reduced), abs=1e-2)
    assert left(region(clamped=True)) == pytest.approx(
        140.0 - 0.3 * np.sqrt(chest.stiffness * MASS), abs=1e-2
    )
    padded = 1.0 / (1.0 / chest.stiffness + 1.0 / 5e3)
    assert left(region(stiffness=5e3)) == pytest.approx(280.0 - 0.3 * np.sqrt(padded * reduced), abs=1e-2)
    assert left(region(force_limit=99.0)) == pytest.approx(
        99.0 - 0.3 * np.sqrt(chest.stiffness * reduced), abs=1e-2
    )
    face = limit(region="face", force_limit=50.0, stiffness=None)
    assert left(face) == pytest.approx(50.0 - 0.3 * np.sqrt(75e3 / (1.0 / MASS + 1.0 / 4.4)), abs=1e-2)
    # What moves in the model has the model's mass, not the region's on top of it.
    ball = '<body name="ball" pos=".4 0 0"><freejoint/><geom name="ball" size=".1" mass="1.25"/></body>'
    env = slide(extra=ball)
    env.data.qpos[0], env.data.qvel[0] = 0.2 + 1e-8, 0.3
    hit = region(against=["ball"])
    assert asked(env, hit).value() == pytest.approx(280.0 - 0.3 * np.sqrt(chest.stiffness), abs=1e-2)


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


def test_the_speed_is_taken_off_before_the_touch():
    env = sw.CBFActionFilter(slide(), [limit(margin=1.0, horizon=10)])
    raw = env.unwrapped
    env.reset(seed=0)
    speeds, gaps = [], []
    while not raw.data.ncon:
        speeds.append(raw.data.qvel[0])
        gaps.append(raw.model.body("wall").pos[0] - 0.1 - raw.data.qpos[0])
        env.step(np.ones(1))
    speeds, gaps = np.array(speeds), np.array(gaps)
    assert speeds.max() > 3.0 * SLOW  # it has been fast on the way
    assert raw.data.qvel[0] <= SLOW
    # Faster than what full braking (200 N on 5 kg) can still take off it has never been.
    assert (speeds**2 <= SLOW**2 + 2.0 * 40.0 * gaps + 1e-9).all()


def test_a_reactive_brake_comes_too_late_where_the_constraint_does_not():
    env = slide()
    latency = float(time_to_peak(MASS, K)) + env.model.opt.timestep
    assert 0.02 < latency < 0.05

    def hit(speed, brakes_after):
        mujoco.mj_resetData(env.model, env.data)
        env.data.qpos[0], env.data.qvel[0] = 0.3 - 1e-6, speed
        peak, touched = 0.0, None
        while env.data.time < 0.2:
            touched = env.data.time if touched is None and env.data.ncon else touched
            env.data.ctrl[:] = -float(touched is not None and env.data.time >= touched + brakes_after)
            mujoco.mj_step(env.model, env.data)
            peak = max(peak, float(env.data.efc_force[: env.data.nefc].sum()))
        return peak

    unmitigated = hit(1.0, np.inf)
    assert unmitigated == pytest.approx(float(peak_force(1.0, MASS, K)), rel=0.02)
    assert hit(1.0, latency) == unmitigated  # to the last bit
    assert unmitigated > 2.0 * LIMIT
    # Even a brake that acts at the touch itself would not do.
    assert hit(1.0, 0.0) > LIMIT
    filtered = sw.CBFActionFilter(slide(), [limit(margin=1.0, horizon=10)])
    filtered.reset(seed=0)
    filtered.unwrapped.data.qvel[0] = 1.0
    assert peaks(filtered, full, 80, reset=False)[0].max() <= LIMIT


def test_pushing_counts():
    # At rest at the surface: a push of half the limit springs up to the limit, more exceeds it.
    for share, passes in ((0.48, True), (0.52, False)):
        env = slide(force=LIMIT)
        env.start = [0.3 - 1e-5], [0.0]
        filtered = sw.CBFActionFilter(env, [limit(horizon=10)])
        force, infos = peaks(filtered, lambda raw, k, share=share: np.full(1, share), 40)
        assert force.max() <= LIMIT and (force.max() > 0.9 * LIMIT)
        assert any(i["cbf/intervened"] for i in infos) != passes


def test_pushing_counts_in_an_env_of_single_physics_steps():
    env = slide(force=LIMIT, frame_skip=1)
    env.data.qpos[0] = 0.3 + 1e-6
    constraint = asked(env, limit(horizon=30))
    assert constraint.admits(np.full(1, 0.48)) and not constraint.admits(np.full(1, 0.52))


def test_a_forecast_that_mujoco_gives_up_is_refused():
    for start in (0.1, 0.3 + 0.01):
        env = slide(force=1e15)
        env.data.qpos[0] = start
        constraint = asked(env, limit())
        constraint.value()
        assert not constraint.admits(np.ones(1)) and constraint.slack(np.ones(1)) == -np.inf
        assert constraint.admits(np.zeros(1))


def test_falling_counts():
    env = slide(force=400.0, mass=MASS, gap=0.2, option='integrator="RK4"')
    env.model.opt.gravity[:] = 9.81, 0.0, 0.0  # "down" is along x: 49 N of 140
    held = sw.CBFActionFilter(env, [limit(margin=2.0, horizon=12)])
    force, infos = peaks(held, lambda raw, k: np.zeros(1), 100)
    assert 0.8 * LIMIT < force.max() <= LIMIT and not any(i["cbf/infeasible"] for i in infos)


def test_it_composes_with_others_in_one_filter():
    env = sw.CBFActionFilter(
        slide(), [sw.constraints.JointSpeedLimit(0.8, margin=0.01), limit(margin=2.0, horizon=10)], margin=0.0
    )
    speeds = []

    def policy(raw, k):
        speeds.append(raw.data.qvel[0])
        return np.ones(1)

    force, infos = peaks(env, policy, 80)
    assert max(speeds) <= 0.8 and max(speeds) > 0.75
    assert 0.9 * LIMIT < force.max() <= LIMIT
    assert {tuple(i["cbf/refused"]) for i in infos} >= {(True, False), (False, True)}


def test_pressed_too_hard_already_it_says_so_and_lets_go():
    env = slide(force=400.0)
    env.start = [0.3 + 0.01], [0.0]  # 200 N
    filtered = sw.CBFActionFilter(env, [limit()])
    with pytest.warns(sw.UnsafeStateWarning, match="margin"):
        force, infos = peaks(filtered, full, 30)
    assert infos[0]["cbf/unsafe"] and infos[0]["cbf/margin"] == pytest.approx(-60.0, abs=1.0)
    left = force[force > LIMIT]
    assert (np.diff(left) < 0.0).all() and 1 < left.size < 10  # less and less, then none
    assert (force[10:] <= LIMIT).all()


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


def test_what_cannot_be_moved_towards_the_wall_is_left_alone():
    # A ball that slides along the wall: nothing moves it along the normal.
    env = Scene(
        """<mujoco><option gravity="0 0 0"/><worldbody><geom name="wall" type="plane" size="9 9 1" contype="0"/>
        <body name="cart" pos="0 0 .1"><joint type="slide" axis="1 0 0"/><geom size=".1"/></body></worldbody>
        <actuator><motor joint="" ctrlrange="-1 1"/></actuator></mujoco>""".replace(
            'type="slide"', 'name="x" type="slide"'
        ).replace('joint=""', 'joint="x"')
    )
    env.data.qvel[0] = 9.0
    constraint = asked(env, limit())
    assert constraint.value() == LIMIT and constraint.admits(np.ones(1))


def test_a_contact_begins_where_mujoco_lets_it_begin():
    env = slide()
    env.model.geom("wall").margin[:] = 0.01
    constraint = limit()
    assert value_at(env, constraint, 2.0, gap=0.009) < 0.0  # of 0.02 m it would be the forecast's to say
    assert value_at(env, constraint, 2.0, gap=0.011) == 0.0


# Plain data, and what is refused ------------------------------------------------------------------------------


PLAIN = {"force_limit": 100.0, "stiffness": 1e4}
REACHER = {"bodies": ["fingertip"], "against": ["sideE"]}


@pytest.mark.parametrize(
    ("arguments", "error", "message"),
    [
        ({"force_limit": 0.0}, ConfigurationError, "force_limit must be a finite number > 0 in N, got 0.0"),
        ({"margin": 100.0}, ConfigurationError, "the margin 100.0 N leaves nothing of the limit 100.0 N"),
        ({"stiffness": None}, ConfigurationError, r"give a force_limit \(N\) and the interface's stiffness"),
        ({"clamped": True}, ConfigurationError, "name the region too"),
        (
            {"region": "torso"},
            UnknownNameError,
            "no body region 'torso'; choose skull and forehead, face, neck",
        ),
        ({"region": "face", "force_limit": None}, ConfigurationError, "foresees no contact with 'face'"),
        ({"region": "face", "force_limit": None, "clamped": True}, ConfigurationError, "foresees no contact"),
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


def test_an_env_without_a_mujoco_model_is_refused():
    plant = sw.AnalyticPlant(
        f=lambda x: np.array([x[1], 0.0]),
        g=lambda x: np.array([[0.0], [1.0]]),
        state=lambda env: env.state,
        lower=-2.0,
        upper=2.0,
        control_dt=0.05,
    )
    with pytest.raises(UnsupportedEnvError, match="ImpactSpeedLimit forecasts with a MuJoCo model"):
        sw.CBFActionFilter(gym.make("Pendulum-v1"), [limit()], plant=plant)
    with pytest.raises(UnsupportedEnvError, match="no MuJoCo"):
        sw.CBFActionFilter(gym.make("Pendulum-v1"), [limit()])
