"""ContactMonitor: against stepping by hand, that it changes nothing, and that it says when it cannot see."""

import copy
import warnings

import gymnasium as gym
import mujoco
import numpy as np
import pytest
from meddling import Meddling
from scenes import Scene

import safe_wrappers as sw
from safe_wrappers import info as keys
from safe_wrappers.control.contact import complementarity_residuals

FLOATS = (
    keys.CONTACT_PEAK_FORCE,
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
    peak = depth = residual = 0.0
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
            penetration, product = complementarity_residuals(contact.dist, wrench[0])
            depth, residual = max(depth, penetration), max(residual, product)
        peak = max([peak, *pairs.values()])
    return peak, depth, residual


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
                assert forces and info[keys.CONTACT_PEAK_FORCE] >= max(forces) * (1.0 - 1e-9)
            assert env.peak_bodies is not None or not info[keys.CONTACT_PEAK_FORCE]
    assert partial == [25, 30]
    assert sum("contact/partial" in str(w.message) for w in caught) == 1  # once


def test_numbers_that_are_none_are_reported_as_none():
    env = sw.ContactMonitor(Meddling(gym.make("HalfCheetah-v5"), (25,), dist=np.nan))
    env.reset(seed=0)
    with warnings.catch_warnings(action="ignore"):
        info = [env.step(env.action_space.low)[4] for _ in range(25)][-1]
    assert np.isnan([info[k] for k in FLOATS]).all()


def test_activations_under_runge_kutta_are_named_as_a_reason():
    env = Scene(
        """<mujoco><option integrator="RK4"/><worldbody><body><joint name="x" type="slide"/><geom size=".1"/></body>
        </worldbody><actuator><general joint="x" dyntype="filter" dynprm=".1" gainprm="5"/></actuator></mujoco>"""
    )
    monitored = sw.ContactMonitor(env)
    monitored.reset(seed=0)
    with pytest.warns(UserWarning, match="actuators with activations under Runge-Kutta"):
        assert monitored.step(np.ones(1))[4]["contact/partial"]
