"""ContactMonitor: against stepping by hand, that it changes nothing, and that it says when it cannot see."""

import copy
import warnings

import gymnasium as gym
import mujoco
import numpy as np
import pytest
from meddling import Meddling
from scipy.optimize import brentq

import safe_wrappers as sw
from safe_wrappers import info as keys
from safe_wrappers.control.contact.impact import complementarity_residuals
from safe_wrappers.errors import ConfigurationError, UnknownNameError, UnsupportedEnvError

FLOATS = (
    keys.CONTACT_PEAK_FORCE,
    keys.CONTACT_IMPULSE,
    keys.CONTACT_PENETRATION,
    keys.CONTACT_RESIDUAL,
)


def actions(env, count, seed=0):
    rng = np.random.default_rng(seed)
    space = env.action_space
    return rng.uniform(space.low, space.high, (count, *space.shape)).astype(space.dtype)


def by_hand(env, data, substeps, bodies=None):
    """The figures of one Euler step from some data on, substep by substep, by MuJoCo's own functions."""
    model = env.model
    data.ctrl[:] = env.data.ctrl
    peak = impulse = depth = residual = 0.0
    wrench = np.zeros(6)
    for _ in range(substeps):
        mujoco.mj_step(model, data)
        pairs = {}
        for i in range(data.ncon):
            contact = data.contact[i]
            pair = frozenset(model.body(model.geom_bodyid[g]).name for g in contact.geom)
            if bodies is not None and not pair & bodies:
                continue
            mujoco.mj_contactForce(model, data, i, wrench)
            pairs[pair] = pairs.get(pair, 0.0) + wrench[0]
            impulse += wrench[0] * model.opt.timestep
            missed = complementarity_residuals(contact.dist, wrench[0])
            depth, residual = max(depth, missed.penetration), max(residual, missed.product)
        peak = max([peak, *pairs.values()])
    return peak, impulse, depth, residual


@pytest.mark.parametrize(
    ("env_id", "bodies"),
    [("HalfCheetah-v5", None), ("HalfCheetah-v5", ["ffoot", "bfoot"]), ("SafeCarGoal2-v0", None)],
)
def test_figures_are_those_of_stepping_by_hand(env_id, bodies):
    env = sw.ContactMonitor(gym.make(env_id), bodies)
    raw = env.unwrapped
    raw.model.opt.integrator = mujoco.mjtIntegrator.mjINT_EULER  # one evaluation per substep
    env.reset(seed=0)
    landed = 0
    for step, action in enumerate(actions(env, 100)):
        if step == 50:  # whose contacts have other rows
            raw.model = copy.copy(raw.model)
            raw.model.opt.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
        start = copy.copy(raw.data)
        info = env.step(action)[4]
        expected = by_hand(raw, start, raw.frame_skip, None if bodies is None else set(bodies))
        np.testing.assert_allclose([info[k] for k in FLOATS], expected, rtol=1e-12)
        assert info[keys.CONTACT_PARTIAL] is False
        landed += expected[0] > 0.0
    assert landed > 20


@pytest.mark.parametrize("env_id", ["HalfCheetah-v5", "Ant-v5", "Pusher-v5"])
def test_the_physics_stays_the_same_bit_for_bit(env_id):
    env, bare = sw.ContactMonitor(gym.make(env_id)), gym.make(env_id)
    assert env.reset(seed=0)[0].tobytes() == bare.reset(seed=0)[0].tobytes()
    for action in actions(env, 60):
        one, other = env.step(action), bare.step(action)
        assert one[0].tobytes() == other[0].tobytes() and one[1:4] == other[1:4]
        assert {k: one[4][k] for k in other[4]} == other[4]
        assert env.unwrapped.data.qacc_warmstart.tobytes() == bare.unwrapped.data.qacc_warmstart.tobytes()


def test_a_runner_with_runge_kutta_balances_its_weight():
    # Upwards, the floor's normal force and the weight are all there is, but for what a soft foot's turning adds.
    env = sw.ContactMonitor(gym.make("Ant-v5", terminate_when_unhealthy=False), against=["world"])
    raw = env.unwrapped
    env.reset(seed=0)
    weight, impulse, time = float(raw.model.body_mass.sum()) * 9.81, 0.0, 0.0

    def upwards():
        mujoco.mj_forward(raw.model, raw.data)
        mujoco.mj_subtreeVel(raw.model, raw.data)
        return raw.data.subtree_linvel[0, 2] * raw.model.body_mass.sum()

    before = upwards()
    for action in actions(env, 200):
        info = env.step(action)[4]
        assert not info[keys.CONTACT_PARTIAL]
        impulse, time = impulse + info[keys.CONTACT_IMPULSE], time + raw.dt
    assert impulse == pytest.approx(upwards() - before + weight * time, rel=1e-3)


def test_a_touch_that_is_over_before_the_step_ends_is_seen():
    env = sw.ContactMonitor(gym.make("HalfCheetah-v5"))
    env.reset(seed=0)
    unseen = 0
    for action in actions(env, 200):
        info = env.step(action)[4]
        mujoco.mj_forward(env.unwrapped.model, env.unwrapped.data)
        unseen += info[keys.CONTACT_PEAK_FORCE] > 1.0 and env.unwrapped.data.ncon == 0
    assert unseen > 0


def test_no_contact_is_zero_and_so_is_a_reset():
    env = sw.ContactMonitor(gym.make("HalfCheetah-v5"))
    _, info = env.reset(seed=0)
    assert [info[k] for k in FLOATS] == [0.0] * 4 and info[keys.CONTACT_PARTIAL] is False
    for _ in range(30):
        info = env.step(env.action_space.low)[4]
    assert info[keys.CONTACT_PEAK_FORCE] > 0.0 and env.peak_bodies is not None
    _, info = env.reset(seed=1)
    assert [info[k] for k in FLOATS] == [0.0] * 4 and env.peak_bodies is None
    info = sw.ContactMonitor(gym.make("Reacher-v5")).reset()[1]
    assert all(isinstance(info[k], float) for k in FLOATS)


def test_the_bodies_of_the_peak_are_named():
    env = sw.ContactMonitor(gym.make("HalfCheetah-v5"), bodies=["ffoot"])
    env.reset(seed=0)
    named = set()
    for action in actions(env, 60):
        info = env.step(action)[4]
        assert (env.peak_bodies is None) == (info[keys.CONTACT_PEAK_FORCE] == 0.0)
        named.add(env.peak_bodies)
    assert named == {None, ("world", "ffoot")}


def test_a_step_that_cannot_be_replayed_is_said_to_be_and_the_next_is_whole_again():
    env = sw.ContactMonitor(Meddling(gym.make("HalfCheetah-v5"), (25, 30)))
    raw = env.unwrapped
    env.reset(seed=0)
    partial = []
    with pytest.warns(UserWarning, match="contact/partial") as caught:
        for step, _ in enumerate(range(40), start=1):
            info = env.step(env.action_space.low)[4]
            if info[keys.CONTACT_PARTIAL]:
                partial.append(step)
                wrench, forces = np.zeros(6), []
                for i in range(raw.data.ncon):
                    mujoco.mj_contactForce(raw.model, raw.data, i, wrench)
                    forces.append(wrench[0])
                assert forces and info[keys.CONTACT_IMPULSE] == pytest.approx(
                    sum(forces) * raw.model.opt.timestep
                )
            assert env.peak_bodies is not None or not info[keys.CONTACT_PEAK_FORCE]
    assert partial == [25, 30]
    assert sum("contact/partial" in str(w.message) for w in caught) == 1  # once


def test_numbers_that_are_none_are_reported_as_none():
    env = sw.ContactMonitor(Meddling(gym.make("HalfCheetah-v5"), (25,), dist=np.nan))
    env.reset(seed=0)
    with warnings.catch_warnings(action="ignore"):
        info = [env.step(env.action_space.low)[4] for _ in range(25)][-1]
    assert np.isnan([info[k] for k in FLOATS]).all()


def test_what_a_broken_simulation_was_reset_to_is_no_contact():
    env = sw.ContactMonitor(gym.make("HalfCheetah-v5"))
    env.reset(seed=0)
    env.step(env.action_space.low)
    env.unwrapped.data.qvel[3] = np.nan
    with pytest.warns(UserWarning, match="MuJoCo has reset it"):
        info = env.step(env.action_space.low)[4]
    assert info[keys.CONTACT_PARTIAL] and np.isfinite([info[k] for k in FLOATS]).all()


def test_inside_a_chunk_impulses_add_up_and_peaks_are_the_largest():
    single, chunked = (gym.make("HalfCheetah-v5") for _ in range(2))
    single = sw.ContactMonitor(single)
    chunked = sw.ChunkHandover(sw.ContactMonitor(chunked), 5, 5, rate_limit=1e6)
    single.reset(seed=0), chunked.reset(seed=0)
    for chunk in actions(single, 100).reshape(20, 5, -1):
        macro = chunked.step(chunk)[4]
        infos = [single.step(a)[4] for a in chunk]
        assert macro[keys.CONTACT_IMPULSE] == pytest.approx(sum(i[keys.CONTACT_IMPULSE] for i in infos))
        for key in (keys.CONTACT_PEAK_FORCE, keys.CONTACT_PENETRATION, keys.CONTACT_RESIDUAL):
            assert macro[key] == max(i[key] for i in infos)
        assert macro[keys.CONTACT_PARTIAL] is False


def test_a_chunk_is_partial_if_any_of_its_steps_was():
    meddling = Meddling(gym.make("HalfCheetah-v5"), (7,))
    env = sw.ChunkHandover(sw.ContactMonitor(meddling), 5, 5, rate_limit=1e6)
    env.reset(seed=0)
    with pytest.warns(UserWarning, match="contact/partial"):
        partial = [env.step(chunk)[4][keys.CONTACT_PARTIAL] for chunk in actions(env, 3)]
    assert partial == [False, True, False]


@pytest.mark.parametrize(
    ("env_id", "whole"),
    [
        ("SafePointGoal2-v0", True),
        ("SafeCarGoal2-v0", True),
        ("FlexJointReach-v0", True),
        ("SafeAntVelocity-v0", True),
        ("SafeRover-v0", False),  # its tyres push anew in every substep
    ],
)
def test_which_of_our_tasks_are_seen_whole(env_id, whole):
    env = sw.ContactMonitor(gym.make(env_id))
    env.reset(seed=0)
    with warnings.catch_warnings(action="ignore"):
        partial = [env.step(a)[4][keys.CONTACT_PARTIAL] for a in actions(env, 20)]
    assert all(partial) if not whole else not any(partial)


def test_bad_input_is_refused_in_words():
    with pytest.raises(UnsupportedEnvError, match=r"MuJoCo's \.model and \.data"):
        sw.ContactMonitor(gym.make("Pendulum-v1"))
    with pytest.raises(UnknownNameError, match="no body 'hoof'; it has: world, torso"):
        sw.ContactMonitor(gym.make("HalfCheetah-v5"), bodies=["hoof"])
    with pytest.raises(ConfigurationError, match="against is a list"):
        sw.ContactMonitor(gym.make("HalfCheetah-v5"), against="world")
    chunked = sw.ChunkHandover(gym.make("Reacher-v5"), 4, 2)
    with pytest.raises(ConfigurationError, match=r"ChunkHandover\(ContactMonitor"):
        sw.ContactMonitor(chunked)


# The three conditions of an ideal contact ---------------------------------------------------------------------


class Solid(gym.Env):
    """Any MJCF without actuators, ten physics steps to a control step."""

    observation_space = gym.spaces.Box(-1.0, 1.0, (1,))
    action_space = gym.spaces.Box(-1.0, 1.0, (1,))
    frame_skip = 10

    def __init__(self, xml, qvel=None):
        self.model = mujoco.MjModel.from_xml_string(xml)
        self.data = mujoco.MjData(self.model)
        self.dt = self.frame_skip * self.model.opt.timestep
        self.qvel = np.zeros(self.model.nv) if qvel is None else np.array(qvel, dtype=float)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        mujoco.mj_resetData(self.model, self.data)
        self.data.qvel[:] = self.qvel
        return np.zeros(1, np.float32), {}

    def step(self, action):
        mujoco.mj_step(self.model, self.data, nstep=self.frame_skip)
        return np.zeros(1, np.float32), 0.0, False, False, {}


STILL = np.zeros(1, np.float32)


def ball(margin=0.0, height=0.3, **option):
    """A ball of 2 kg over a floor without friction."""
    options = " ".join(f'{name}="{value}"' for name, value in option.items())
    return f"""<mujoco><option cone="elliptic" {options}/><worldbody>
    <geom type="plane" size="1 1 .1" margin="{margin}" condim="1" solref="-1 -1" solimp=".9999 .9999 .001"/>
    <body name="ball" pos="0 0 {0.1 + height}"><freejoint/><geom size=".1" mass="2" condim="1" solref="-1 -1"
    solimp=".9999 .9999 .001"/></body></worldbody></mujoco>"""


def test_what_was_judged_is_counted_and_what_was_not_is_none():
    env = sw.ContactMonitor(Solid(ball(height=0.05)))
    env.unwrapped.model.geom_solref[:] = -1e4, -50.0
    info = env.reset(seed=0)[1]
    judged = []
    for _ in range(30):
        assert np.isnan(info[keys.CONTACT_PULL]) == (info[keys.CONTACT_JUDGED] == 0)
        assert np.isnan(info[keys.CONTACT_OPEN_FORCE]) == (info[keys.CONTACT_JUDGED] == 0)
        before = copy.copy(env.unwrapped.data)
        info = env.step(STILL)[4]
        count = 0
        for _ in range(10):
            mujoco.mj_step(env.unwrapped.model, before)
            count += before.ncon
        assert info[keys.CONTACT_JUDGED] == count
        judged.append(count)
    assert 0 in judged and 10 in judged


@pytest.mark.parametrize("margin", [0.0, 0.004])
def test_a_margin_is_a_force_across_an_open_gap(margin):
    env = sw.ContactMonitor(Solid(ball(margin, height=0.001)))
    env.unwrapped.model.geom_solref[:], env.unwrapped.model.geom_solimp[:, :2] = (0.02, 1.0), (0.9, 0.95)
    env.reset(seed=0)
    info = [env.step(STILL)[4] for _ in range(200)][-1]
    weight = 2.0 * 9.81
    assert info[keys.CONTACT_PEAK_FORCE] == pytest.approx(weight, rel=1e-3)
    assert info[keys.CONTACT_OPEN_FORCE] == pytest.approx(weight if margin else 0.0, rel=1e-3)
    assert (info[keys.CONTACT_PENETRATION] > 0.0) == (margin == 0.0)
    assert info[keys.CONTACT_PULL] == 0.0  # MuJoCo's contacts push


def test_a_pull_is_told(monkeypatch):
    env = sw.ContactMonitor(Solid(ball(height=0.0)))
    env.reset(seed=0)
    read = env._contacts.read
    pulling = lambda data: [c._replace(force=-7.0) for c in read(data)]  # noqa: E731
    monkeypatch.setattr(env._contacts, "read", pulling)
    infos = [env.step(STILL)[4] for _ in range(5)]
    assert {i[keys.CONTACT_PULL] for i in infos if i[keys.CONTACT_JUDGED]} == {7.0}


def test_a_chunk_leaves_out_steps_without_contact():
    env = sw.ChunkHandover(sw.ContactMonitor(Solid(ball(height=0.3))), 8, 8, fallback="zero", rate_limit=1e6)
    env.unwrapped.model.geom_solref[:] = -1e4, -50.0
    env.reset(seed=0)
    infos = [env.step(np.zeros((8, 1)))[4] for _ in range(3)]
    judged = [info[keys.CONTACT_JUDGED] for info in infos]
    assert judged[0] == 0 and np.isnan(infos[0][keys.CONTACT_PULL])
    assert 10 < judged[1] < 80 and infos[1][keys.CONTACT_PULL] == 0.0


# The next impact ----------------------------------------------------------------------------------------------


def touching(env):
    """The last info that predicts the first touch, and those of the contact until it is over."""
    info, before = env.reset(seed=0)[1], None
    while not info[keys.CONTACT_JUDGED]:
        before = info if np.isfinite(info[keys.CONTACT_NEXT_TIME]) else before  # it may end inside already
        info = env.step(STILL)[4]
    during = []
    while info[keys.CONTACT_JUDGED]:
        during.append(info)
        info = env.step(STILL)[4]
    return before, during


def bounce(zeta):
    """Restitution of a spring and damper that let go when their force is zero."""
    root = np.sqrt(1.0 - zeta**2)
    return np.exp(-zeta * np.arctan2(2.0 * zeta * root, 2.0 * zeta**2 - 1.0) / root)


@pytest.mark.parametrize(("restitution", "gravity"), [(1.0, 0.0), (1.0, -9.81), (0.5, -9.81)])
def test_a_dropped_balls_momentum_changes_by_the_predicted_impulse(restitution, gravity):
    mass, stiffness = 2.0, 2e6
    zeta = brentq(lambda z: bounce(z) - restitution, 0.0, 0.9) if restitution < 1.0 else 0.0
    damping = 2.0 * zeta * np.sqrt(stiffness / mass)
    xml = ball(height=0.2, gravity=f"0 0 {gravity}", timestep=2e-5)
    env = Solid(xml, qvel=[0.0, 0.0, -1.5, 0.0, 0.0, 0.0])
    env.model.geom_solref[:] = -stiffness / mass, -damping
    env = sw.ContactMonitor(env, ["ball"], restitution=restitution, stiffness=stiffness)
    data = env.unwrapped.data
    before, during = touching(env)
    after = data.qvel[2]
    fell = np.sqrt(1.5**2 - 2.0 * gravity * 0.2)
    changed = mass * (after + fell)
    assert after == pytest.approx(restitution * fell, rel=0.02)  # it has the restitution that was declared
    assert before[keys.CONTACT_NEXT_IMPULSE] == pytest.approx(changed, rel=0.02)
    assert before[keys.CONTACT_NEXT_IMPULSE] == pytest.approx(
        sum(i[keys.CONTACT_IMPULSE] for i in during), rel=0.02
    )
    assert 0.0 <= before[keys.CONTACT_NEXT_TIME] <= env.unwrapped.dt
    if restitution == 1.0:
        peak = max(i[keys.CONTACT_PEAK_FORCE] for i in during)
        assert before[keys.CONTACT_NEXT_FORCE] == pytest.approx(peak, rel=0.01)
    assert env.next_bodies is None  # it rises


def test_two_free_bodies_exchange_the_predicted_impulse():
    # Obliquely, and spinning: no friction, so that only the motion along the normal counts.
    env = Solid(
        """<mujoco><option gravity="0 0 0" timestep="2e-5" cone="elliptic"/><default><geom condim="1"
        solref="-1e6 0" solimp=".9999 .9999 .001"/></default><worldbody>
        <body name="one"><freejoint/><geom size=".1" mass="2"/></body>
        <body name="two" pos=".4 .08 .02"><freejoint/><geom size=".1" mass=".5"/></body></worldbody></mujoco>""",
        qvel=[1.5, 0.1, 0.0, 3.0, 0.0, 1.0, -0.7, 0.0, 0.0, 0.0, 2.0, 0.0],
    )
    env = sw.ContactMonitor(env, restitution=1.0)
    start = env.unwrapped.qvel
    before, during = touching(env)
    end = env.unwrapped.data.qvel
    for mass, at in ((2.0, slice(0, 3)), (0.5, slice(6, 9))):
        changed = mass * np.linalg.norm(end[at] - start[at])
        assert before[keys.CONTACT_NEXT_IMPULSE] == pytest.approx(changed, rel=0.02)
    assert 2.0 * start[0:3] + 0.5 * start[6:9] == pytest.approx(2.0 * end[0:3] + 0.5 * end[6:9])
    assert np.isnan(before[keys.CONTACT_NEXT_FORCE]) and len(during) > 1  # no stiffness declared


def test_an_arm_strikes_with_its_effective_mass():
    # Its two joints' momenta change by the impulse's share, by J' P.
    env = Solid(
        """<mujoco><option gravity="0 0 0" timestep="2e-5" cone="elliptic"/><default><geom condim="1"
        solref="-4e6 0" solimp=".9999 .9999 .001"/></default><worldbody><geom name="wall" type="plane"
        pos=".62 0 0" euler="0 -90 0" size="1 1 .1"/><body name="upper"><joint name="a" axis="0 0 1"/>
        <geom type="capsule" fromto="0 0 0 .4 0 0" size=".02" mass="1.5"/><body name="lower" pos=".4 0 0">
        <joint name="b" axis="0 0 1"/><geom type="capsule" fromto="0 0 0 .3 0 0" size=".02" mass=".7"/></body></body>
        </worldbody></mujoco>"""
    )
    model, data = env.model, env.data
    env.qvel = np.array([-2.0, 1.0])
    reset = env.reset

    def turned(**more):
        answer = reset(**more)
        data.qpos[:] = 0.9, -0.1
        return answer

    env.reset = turned
    watched = sw.ContactMonitor(env, ["lower"], ["world"], restitution=1.0, stiffness=1e5)
    info, momenta = watched.reset(seed=0)[1], None
    inertia, last = np.zeros((2, 2)), None
    while not info[keys.CONTACT_JUDGED]:
        last = info if np.isfinite(info[keys.CONTACT_NEXT_TIME]) else last
        momenta = data.qvel.copy()
        mujoco.mj_forward(model, data)
        for column, unit in zip(inertia, np.eye(2), strict=True):
            mujoco.mj_mulM(model, data, column, unit)
        info = watched.step(STILL)[4]
    measured = info[keys.CONTACT_IMPULSE]
    while info[keys.CONTACT_JUDGED]:
        info = watched.step(STILL)[4]
        measured += info[keys.CONTACT_IMPULSE]
    assert last[keys.CONTACT_NEXT_IMPULSE] == pytest.approx(measured, rel=0.03)
    # The tip's momentum along the wall's normal by the joints': J' P = M dv, so P = |M dv| / |J'|.
    pushed = inertia @ (data.qvel - momenta)
    tip = mujoco.MjData(model)
    tip.qpos[:] = data.qpos
    mujoco.mj_kinematics(model, tip), mujoco.mj_comPos(model, tip)
    jacobian = np.zeros((3, 2))
    end = tip.body("lower").xpos + tip.body("lower").xmat.reshape(3, 3) @ [0.3, 0.0, 0.0]
    mujoco.mj_jac(model, tip, jacobian, None, end, model.body("lower").id)
    assert last[keys.CONTACT_NEXT_IMPULSE] == pytest.approx(
        np.linalg.norm(pushed) / np.linalg.norm(jacobian[0]), rel=0.05
    )


def test_the_prediction_follows_a_new_model_and_is_absent_where_it_is_not_asked_for():
    env = sw.ContactMonitor(Solid(ball(gravity="0 0 0"), qvel=[0, 0, -1, 0, 0, 0]), restitution=0.0)
    info = env.reset(seed=0)[1]
    assert info[keys.CONTACT_NEXT_TIME] == pytest.approx(0.3) and env.next_bodies == ("world", "ball")
    assert info[keys.CONTACT_NEXT_IMPULSE] == pytest.approx(2.0)
    raw = env.unwrapped
    raw.model = mujoco.MjModel.from_xml_string(ball(height=0.7).replace('mass="2"', 'mass="4"'))
    raw.data = mujoco.MjData(raw.model)
    info = env.reset(seed=0)[1]
    assert info[keys.CONTACT_NEXT_TIME] == pytest.approx(0.7)
    assert info[keys.CONTACT_NEXT_IMPULSE] == pytest.approx(4.0)
    raw.qvel[2] = np.nan
    info = env.reset(seed=0)[1]
    assert all(np.isnan(info[k]) for k in (keys.CONTACT_NEXT_TIME, keys.CONTACT_NEXT_IMPULSE))
    assert env.next_bodies is None
    plain = sw.ContactMonitor(Solid(ball())).reset(seed=0)[1]
    assert not {k for k in plain if "next" in k}


def test_bad_laws_of_impact_are_refused_in_words():
    env = gym.make("HalfCheetah-v5")
    with pytest.raises(
        ConfigurationError, match=r"restitution is from 0 \(plastic\) to 1 \(elastic\), got 1.5"
    ):
        sw.ContactMonitor(env, restitution=1.5)
    with pytest.raises(ConfigurationError, match="restitution must be a finite number >= 0"):
        sw.ContactMonitor(env, restitution=-0.1)
    with pytest.raises(ConfigurationError, match="stiffness must be a finite number > 0 in N/m"):
        sw.ContactMonitor(env, restitution=0.5, stiffness=0.0)
    with pytest.raises(ConfigurationError, match="give their restitution, too"):
        sw.ContactMonitor(env, stiffness=1e4)
