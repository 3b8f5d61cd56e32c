"""ContactMonitor and BalanceMonitor: against stepping by hand, momenta and statics; and what they cannot see."""

import copy

import gymnasium as gym
import mujoco
import numpy as np
import pytest
from oracles import support_margin
from scenes import Scene

import safe_wrappers as sw
from safe_wrappers import info as keys
from safe_wrappers.control.contact import complementarity_residuals
from safe_wrappers.wrappers.monitors import PRESSING

CONTACT = keys.CONTACT_PEAK_FORCE, keys.CONTACT_PENETRATION, keys.CONTACT_RESIDUAL
BALANCE = keys.BALANCE_FRICTION_USED, keys.BALANCE_ZMP_MARGIN
MOMENTA = keys.BALANCE_LINEAR_MOMENTUM, keys.BALANCE_ANGULAR_MOMENTUM


def actions(env, count, share=1.0):
    rng, space = np.random.default_rng(0), env.action_space
    return (share * rng.uniform(space.low, space.high, (count, *space.shape))).astype(space.dtype)


# All of it by hand ------------------------------------------------------------------------------------------------


def contacts_of(raw, data):
    """Of each contact its index, its bodies, and its force in its own frame, N, by MuJoCo's own function."""
    wrench = np.zeros(6)
    for k in range(data.ncon):
        mujoco.mj_contactForce(raw.model, data, k, wrench)
        yield k, raw.model.geom_bodyid[data.contact.geom[k]].tolist(), wrench[:3].copy()


def substeps(raw, data):
    """The contacts of each substep of one Euler step from some data on."""
    data.ctrl[:] = raw.data.ctrl
    for _ in range(raw.frame_skip):
        mujoco.mj_step(raw.model, data)
        yield list(contacts_of(raw, data))


def strongest(raw, data, contacts, bodies=None, against=None):
    """The figures of one evaluation, and the names of the two bodies of the peak."""
    pairs, depth, residual = {frozenset(): 0.0}, 0.0, 0.0
    for k, (one, two), force in contacts:
        names = raw.model.body(one).name, raw.model.body(two).name
        if any(a in (bodies or names) and b in (against or names) for a, b in (names, names[::-1])):
            pairs[frozenset(names)] = pairs.get(frozenset(names), 0.0) + force[0]
            penetration, product = complementarity_residuals(data.contact.dist[k], force[0])
            depth, residual = max(depth, penetration), max(residual, product)
    peak = max(pairs, key=pairs.get)
    return (pairs[peak], depth, residual), peak


def limbs(model, names):
    """Bodies of these names, or all, and what hangs from them."""
    own = np.array([names is None or model.body(b).name in names for b in range(model.nbody)])
    for b in range(1, model.nbody):
        own[b] |= own[model.body_parentid[b]]
    return own & (np.arange(model.nbody) > 0)


def balance_by_hand(raw, data, bodies):
    """Used friction, and the margin of the support."""
    own = limbs(raw.model, bodies)
    weight = float(raw.model.body_mass[own].sum()) * 9.81
    used, margins = 0.0, []
    for found in substeps(raw, data):
        points, normals, forces = [], [], []
        for k, (one, two), force in found:
            if (
                {one, two} - {0} - set(np.flatnonzero(own))
                or 0 not in (one, two)
                or data.contact.efc_address[k] < 0
            ):
                continue
            frame = (1.0 if one == 0 else -1.0) * data.contact.frame[k].reshape(3, 3)
            points.append(data.contact.pos[k].copy())
            normals.append(frame[0])
            forces.append(frame.T @ force)
            if force[0] >= PRESSING * weight:
                used = max(used, np.hypot(*force[1:]) / (data.contact.friction[k, 0] * force[0]))
        margins.append(support_margin(*(np.reshape(one, (-1, 3)) for one in (points, normals, forces))))
    return [used, min((margin for margin in margins if not np.isnan(margin)), default=np.nan)]


def watched(env, count, share=1.0):
    """Of each step its info and the data from which it began; halfway the model, and the contacts' rows, change."""
    raw = env.unwrapped
    raw.model.opt.integrator = mujoco.mjtIntegrator.mjINT_EULER  # one evaluation per substep
    env.reset(seed=0)
    for step, action in enumerate(actions(env, count, share)):
        if step == count // 2:
            raw.model = copy.copy(raw.model)
            raw.model.opt.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
        start = copy.copy(raw.data)
        yield env.step(action)[4], start


@pytest.mark.parametrize(
    ("env_id", "bodies", "against"),
    [
        ("HalfCheetah-v5", None, None),
        ("HalfCheetah-v5", ["ffoot", "bfoot"], ["world"]),
        ("SafeCarGoal2-v0", None, None),
    ],
)
def test_contacts_are_those_of_stepping_by_hand(env_id, bodies, against):
    env = sw.ContactMonitor(gym.make(env_id), bodies, against)
    landed = 0
    for info, start in watched(env, 100):
        raw = env.unwrapped
        each = [strongest(raw, start, found, bodies, against) for found in substeps(raw, start)]
        expected = np.max([figures for figures, _ in each], axis=0)
        np.testing.assert_allclose([info[k] for k in CONTACT], expected, rtol=1e-12)
        assert set(env.peak_bodies or ()) == max(each)[1]
        assert info[keys.CONTACT_PARTIAL] is False
        landed += expected[0] > 0.0
    assert landed > 20


@pytest.mark.parametrize(
    ("env_id", "bodies", "strength"),
    [("Ant-v5", None, 0.08), ("Humanoid-v5", None, 0.3), ("Humanoid-v5", ["right_thigh"], 0.3)],
)
def test_balance_is_that_of_stepping_by_hand(env_id, bodies, strength):
    env = sw.BalanceMonitor(gym.make(env_id, terminate_when_unhealthy=False), bodies)
    found = []
    for info, start in watched(env, 120, strength):
        found.append([info[k] for k in BALANCE])
        expected = balance_by_hand(env.unwrapped, start, bodies)
        np.testing.assert_allclose(found[-1], expected, rtol=1e-8, atol=1e-9)
        assert info[keys.BALANCE_PARTIAL] is False
    used, margins = np.array(found).T
    assert used.max() > 0.9 and (used > 0.0).sum() > 30
    assert bodies or (np.nanmin(margins) < 0.02 < np.nanmax(margins) and (~np.isnan(margins)).sum() > 10)


# Momentum ------------------------------------------------------------------------------------


@pytest.mark.filterwarnings("ignore::UserWarning")  # of the rover's tyres
@pytest.mark.parametrize("env_id", ["Ant-v5", "Humanoid-v5", "HalfCheetah-v5", "SafeRover-v0"])
def test_momentum_is_what_mujoco_says_of_the_state_after_the_step(env_id):
    env = sw.BalanceMonitor(gym.make(env_id))
    raw = env.unwrapped
    env.reset(seed=0)
    data, largest = mujoco.MjData(raw.model), np.zeros(2)
    for action in actions(env, 20):
        info = env.step(action)[4]
        data.qpos[:], data.qvel[:] = raw.data.qpos, raw.data.qvel
        mujoco.mj_forward(raw.model, data)
        mujoco.mj_subtreeVel(raw.model, data)
        linear = data.subtree_linvel[0] * raw.model.body_subtreemass[0]
        for key, expected in zip(MOMENTA, (linear, data.subtree_angmom[0]), strict=True):
            np.testing.assert_allclose(info[key], expected, rtol=1e-9, atol=1e-9)
        largest = np.maximum(largest, [np.linalg.norm(info[k]) for k in MOMENTA])
    assert (largest > 0.1).all()


# What they cannot see ---------------------------------------------------------------------------------------------


class Meddling(gym.Wrapper):
    """Writes to the env's data after some steps: adds to its first velocity, and sets fields of its contacts."""

    def __init__(self, env, at, velocity=1e-3, **contact):
        super().__init__(env)
        self.at, self.velocity, self.contact, self.steps = at, velocity, contact, 0

    def step(self, action):
        out = super().step(action)
        self.steps += 1
        if self.steps in self.at:
            self.unwrapped.data.qvel[0] += self.velocity
            for field, value in self.contact.items():
                getattr(self.unwrapped.data.contact, field)[:] = value
        return out


def meddled(kind, at, count, **options):
    env = kind(Meddling(gym.make("HalfCheetah-v5"), at, **options))
    env.reset(seed=0)
    for _ in range(count):
        yield env, env.step(env.action_space.low)[4]


def test_a_step_that_cannot_be_replayed_is_said_to_be_and_the_next_is_whole_again():
    partial = []
    with pytest.warns(UserWarning, match="contact/partial") as caught:
        for step, (env, info) in enumerate(meddled(sw.ContactMonitor, (25, 30), 40), start=1):
            if info[keys.CONTACT_PARTIAL]:
                partial.append(step)
                raw = env.unwrapped  # what is left behind is read
                expected, pair = strongest(raw, raw.data, contacts_of(raw, raw.data))
                np.testing.assert_allclose([info[k] for k in CONTACT], expected, rtol=1e-9)
                assert set(env.peak_bodies or ()) == pair
    assert partial == [25, 30]
    assert sum("contact/partial" in str(w.message) for w in caught) == 1  # once


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("bad", [np.nan, np.inf])
@pytest.mark.parametrize("place", ["pos", "velocity"])
def test_no_figure_of_balance_is_made_of_what_is_no_number(place, bad):
    infos = [info for _, info in meddled(sw.BalanceMonitor, (25,), 27, **{place: bad})]
    for info in infos[24:26]:  # and MuJoCo's reset in the step after it
        assert np.isfinite([info[BALANCE[0]], *info[MOMENTA[0]], *info[MOMENTA[1]]]).all()
    assert [infos[i][keys.BALANCE_PARTIAL] for i in (23, 24, 26)] == [False, True, False]


@pytest.mark.filterwarnings("ignore")
def test_contacts_that_are_no_numbers_are_reported_as_none():
    *_, (_, info) = meddled(sw.ContactMonitor, (25,), 25, dist=np.nan)
    assert np.isnan([info[k] for k in CONTACT]).all()


def test_activations_under_runge_kutta_are_named_as_a_reason():
    scene = Scene(
        """<mujoco><option integrator="RK4"/><worldbody><body><joint name="x" type="slide"/><geom size=".1"/></body>
        </worldbody><actuator><general joint="x" dyntype="filter" dynprm=".1" gainprm="5"/></actuator></mujoco>"""
    )
    env = sw.ContactMonitor(scene)
    assert env.reset(seed=0)[1] == dict.fromkeys(CONTACT, 0.0) | {keys.CONTACT_PARTIAL: False}
    with pytest.warns(UserWarning, match="actuators with activations under Runge-Kutta"):
        assert env.step(np.ones(1))[4][keys.CONTACT_PARTIAL]
