"""ContactFeasibility and SupportMargin where balls slide and tables tip; Stance by a program put together by hand.

Closed loops are in test_forecast_loops.py, robots under Stance's program in plants/test_dynamics.py.
"""

import gymnasium as gym
import mujoco
import numpy as np
import pytest
from asking import settled
from judged_loops import HALF, HEIGHT, MASS, ForceJudge, at_random, cone_room, inside_the_hull, table
from qpsolvers import solve_qp
from scenes import Scene
from scipy.linalg import block_diag
from scipy.sparse import csc_matrix

import safe_wrappers as sw

BALL = """<mujoco><option timestep="0.005" cone="{cone}"/><default><geom friction="0.8 0 0"/></default>
<worldbody><geom type="plane" size="9 9 1"/><body pos="0 0 .1"><joint name="x" type="slide" axis="1 0 0"/>
<joint type="slide" axis="0 0 1"/><geom size=".1" mass="2"/></body></worldbody>
<actuator><motor joint="x" ctrllimited="true" ctrlrange="-1 1" gear="50"/></actuator></mujoco>"""
"""2 kg that do not roll, on a floor with a friction of 0.8; a control of 1 pushes with 50 N."""


@pytest.mark.parametrize("cone", ["pyramidal", "elliptic"])
@pytest.mark.parametrize(("share", "tolerance"), [(0.5, 0.0), (0.7, 0.1)])
def test_it_admits_pushes_up_to_the_share_and_the_tolerance(cone, share, tolerance):
    # One ball, one contact: its pressure is the weight, and what holds it is what pushes it.
    largest = share * 0.8 + tolerance  # of the weight
    weight = 2.0 * 9.81
    spec = sw.constraints.ContactFeasibility(share, tolerance)
    for part, admitted in ((0.99, True), (1.01, False), (-0.99, True), (-1.01, False)):
        control = np.array([part * largest * weight / 50.0])
        limit = settled(Scene(BALL.format(cone=cone)), spec, control, 40)
        assert limit.admits(control) is admitted
        inside = share * 0.8 - abs(part) * largest
        limit.executed(control)
        assert limit.report["whole_body/cone_margin"] == pytest.approx(inside, abs=2e-3)
        assert limit.slack(control) == pytest.approx(min(inside, 0.0) + tolerance, abs=2e-3)


def test_in_the_air_nothing_is_missed():
    limit = settled(table(gravity="0 0 0.1"), sw.constraints.ContactFeasibility(0.7, 0.0), np.zeros(1), 20)
    assert limit.admits(np.ones(1)) and not limit.slacks(np.ones(1)).any()


TIPS = MASS * 9.81 / HEIGHT / 50.0
"""A push F at the height h moves the zero moment point by F h / W: the control that moves it by 1 m."""


@pytest.mark.parametrize("inset", [0.03, 0.1])
@pytest.mark.parametrize("way", [-1.0, 1.0])
def test_it_admits_pushes_up_to_where_the_table_tips_about_the_inset_edge(inset, way):
    most = np.array([way * TIPS * (HALF - inset)])
    limit = settled(table(), sw.constraints.SupportMargin(inset), 0.97 * most)
    assert limit.admits(0.97 * most) and not limit.admits(1.04 * most)
    assert limit.slack(9.0 * most) >= -(inset + 1e-9)
    expected = HALF - 0.97 * (HALF - inset)  # the distance is that of the moments
    assert limit.slacks(0.97 * most)[0] == pytest.approx(expected - inset, abs=2e-3)
    limit.executed(0.97 * most)
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


# Stance: a table with driven legs, against the whole program from MuJoCo's numbers, and robots ----------------

LEGS = [(x, y) for x in (-0.3, 0.3) for y in (-0.2, 0.2)]
FRICTION = 0.8


def legged_table(gravity="0 0 -9.81", friction=FRICTION, cone="pyramidal", more="", range_=""):
    """Four legs that swing along x, each with a motor of 30 N m and a spring that holds it upright."""
    legs = "".join(
        f'<body pos="{x} {y} 0"><joint name="j{i}" axis="0 1 0" stiffness="300" damping="6" {range_}/>'
        f'<geom type="capsule" fromto="0 0 0 0 0 -.3" size=".02" mass=".4" contype="0" conaffinity="0"/>'
        f'<geom pos="0 0 -.3" size=".03" mass=".2"/></body>'
        for i, (x, y) in enumerate(LEGS)
    )
    motors = "".join(f'<motor joint="j{i}" gear="30" ctrllimited="true" ctrlrange="-1 1"/>' for i in range(4))
    return Scene(
        f"""<mujoco><compiler angle="radian"/><option timestep="0.002" gravity="{gravity}" cone="{cone}"/>
        <default><geom friction="{friction} 0 0"/></default>
        <worldbody><geom name="floor" type="plane" size="9 9 1"/>
        <body name="trunk" pos="0 0 .33"><freejoint/>
        <geom type="box" size=".35 .25 .05" mass="6"/>{legs}{more}</body></worldbody>
        <actuator>{motors}</actuator></mujoco>"""
    )


STILL = np.zeros(4)


def whole_program(env, nominal, share, edges, settle_s, outer=False):
    """The closest controls, by an interior-point solver on controls and forces, nothing eliminated; None: none."""
    m, d = env.model, mujoco.MjData(env.model)
    d.qpos[:], d.qvel[:], d.ctrl[:] = env.data.qpos, env.data.qvel, nominal
    mujoco.mj_forward(m, d)
    inertia, moments = np.zeros((m.nv, m.nv)), np.zeros((m.nu, m.nv))
    mujoco.mj_fullM(m, d, inertia)
    mujoco.mju_sparse2dense(moments, d.actuator_moment, d.moment_rownnz, d.moment_rowadr, d.moment_colind)
    around, sides = 2.0 * np.pi * (np.arange(edges) + 0.5) / edges, []
    # Sides between edges that lie on the cone, the first along the frame's first tangent; or around the cone.
    slope = share * FRICTION * (1.0 if outer else np.cos(np.pi / edges))
    jacobians, dots = np.zeros((2, d.ncon, 3, m.nv))
    for contact, jac, dot in zip(d.contact, jacobians, dots, strict=True):
        frame, body = contact.frame.reshape(3, 3), m.geom_bodyid[contact.geom[1]]
        assert contact.geom[0] == 0 and frame[0] @ [0, 0, 1] == pytest.approx(1.0)
        mujoco.mj_jac(m, d, jac, None, contact.pos, body)
        mujoco.mj_jacDot(m, d, dot, None, contact.pos, body)
        sides.append(np.column_stack([np.full(edges, -slope), np.cos(around), np.sin(around)]) @ frame)
    held = jacobians.reshape(-1, m.nv)
    aim = -held @ d.qvel / settle_s - dots.reshape(-1, m.nv) @ d.qvel
    # Feet that belong together cannot all come to rest alone.
    aim = held @ np.linalg.lstsq(held, aim, rcond=1e-5)[0]
    drive, bias = (moments * m.actuator_gainprm[:, :1]).T, d.qfrc_bias - d.qfrc_passive
    response = np.linalg.solve(inertia, np.column_stack([drive, held.T, -bias]))
    left, size, right = np.linalg.svd(held @ response[:, :-1], full_matrices=False)
    rank, k = int((size > 1e-9 * size[0]).sum()), len(held)
    equal, aims = right[:rank] * size[:rank, None], left[:, :rank].T @ (aim - held @ response[:, -1])
    rows = np.hstack([np.zeros((len(sides) * edges, m.nu)), block_diag(*sides)])
    cost = np.diag(np.concatenate([np.ones(m.nu), np.full(k, 1e-8)]))
    low, high = np.concatenate([m.actuator_ctrlrange, np.tile([[-np.inf, np.inf]], (k, 1))]).T
    program = (
        csc_matrix(cost),
        np.append(-np.asarray(nominal), np.zeros(k)),
        csc_matrix(rows),
        np.zeros(len(rows)),
    )
    found = solve_qp(*program, csc_matrix(equal), aims, low, high, solver="clarabel", tol_gap_abs=1e-12)
    return None if found is None else found[: m.nu]


PUSHES = [(1.0, 1.0, -1.0, -1.0), (0.9, -0.7, 0.8, 0.2), (1.0, 1.0, 1.0, 1.0), (-1.0, 0.4, 0.1, 0.9)]


@pytest.mark.parametrize("share", [0.7, 0.3])
@pytest.mark.parametrize("cone", ["pyramid", "exact"])
def test_its_answer_is_that_of_the_whole_program(share, cone):
    changed = 0
    env = legged_table()
    stance = settled(env, sw.constraints.Stance(share, cone), STILL, 100)
    for push in map(np.array, PUSHES):
        stance.plant.observe()
        admitted = stance.admits(push)
        (answer,) = stance.candidates(push)
        if cone == "pyramid":
            expected = whole_program(env, push, share, 8, 0.05)
            np.testing.assert_allclose(answer, expected, atol=2e-5)
            assert admitted == bool(np.abs(expected - push).max() < 2e-5)
        else:  # between a pyramid inside and one around it
            inner, outer = (whole_program(env, push, share, 64, 0.05, outer=o) for o in (False, True))
            far = [np.linalg.norm(u - push) for u in (outer, answer, inner)]
            assert far[0] - 1e-5 <= far[1] <= far[2] + 1e-5
            np.testing.assert_allclose(answer, inner, atol=5e-3)
        if not admitted:
            changed += 1
            assert stance.admits(answer)
    assert changed >= 2


@pytest.mark.parametrize("cone", ["pyramid", "exact"])
def test_where_no_torques_will_do_it_says_so_and_stays_finite(cone):
    env = legged_table(gravity="0 4 -9", friction=0.05)
    filtered = sw.CBFActionFilter(env, [sw.constraints.Stance(0.7, cone)])
    filtered.reset()
    standing, seen = 0, mujoco.MjData(env.model)
    for _ in range(25):
        mujoco.mj_copyData(seen, env.model, env.data)
        mujoco.mj_forward(env.model, seen)
        info = filtered.step(STILL)[4]
        assert np.isfinite(info["executed_action"]).all() and np.isfinite(info["whole_body/cone_margin"])
        if seen.ncon == 4:
            standing += 1
            assert info["cbf/infeasible"] and info["cbf/fallback"]
            assert info["whole_body/cone_margin"] < 0.0
    assert standing > 5


def test_at_bounds_that_float32_rounds_outwards_nothing_is_changed():
    env = sw.CBFActionFilter(gym.make("Humanoid-v5"), [sw.constraints.Stance(1.0)])
    high = env.action_space.high
    assert float(high[0]) > env.plant.upper[0]  # 0.4 as float32 is more than the model's 0.4
    env.reset(seed=0)
    info = env.step(high)[4]
    assert not info["cbf/intervened"] and not info["cbf/refused"].any()
    assert info["executed_action"].astype(high.dtype).tobytes() == high.tobytes()
