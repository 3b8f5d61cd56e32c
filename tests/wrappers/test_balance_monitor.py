"""BalanceMonitor: MuJoCo's own momenta, statics, Newton and Euler, stepping by hand; and that it changes nothing."""

import copy
import warnings

import gymnasium as gym
import mujoco
import numpy as np
import pytest
from meddling import Meddling
from scipy.spatial import ConvexHull

import safe_wrappers as sw
from safe_wrappers import info as keys
from safe_wrappers.wrappers.monitors import PRESSING

FLOATS = (keys.BALANCE_FRICTION_USED, keys.BALANCE_ZMP_MARGIN)
MOMENTA = (keys.BALANCE_LINEAR_MOMENTUM, keys.BALANCE_ANGULAR_MOMENTUM)
CRATE = """<mujoco><option timestep="0.002" cone="{cone}"/>
<worldbody>
  <geom name="floor" type="plane" size="5 5 .1" friction="{friction} .005 .0001" condim="1"/>
  {more}
  <body name="crate" pos="0 0 .3"><freejoint/>
    <geom type="box" size=".2 .1 .3" mass="10" friction="{friction} .005 .0001" condim="3"/></body>
  <body name="pebble" pos="2 0 .05"><freejoint/>
    <geom type="box" size=".05 .05 .05" mass=".05" friction="{friction} .005 .0001" condim="3"/></body>
  <body name="puck" pos="-2 0 .05"><freejoint/>
    <geom type="box" size=".05 .05 .05" mass="1" condim="1"/></body>
  <body name="ghost" pos="0 3 1"><joint type="slide"/><geom size=".1" contype="0" conaffinity="0"/></body>
</worldbody></mujoco>"""


class Crates(gym.Env):
    """The action is a force on the crate, (3,), N, at a height over its middle, m."""

    action_space = gym.spaces.Box(-200.0, 200.0, (4,), np.float64)
    observation_space = gym.spaces.Box(-np.inf, np.inf, (1,), np.float64)

    def __init__(self, friction=1.0, cone="elliptic", more=""):
        text = CRATE.format(friction=friction, cone=cone, more=more)
        self.model = mujoco.MjModel.from_xml_string(text)
        self.data = mujoco.MjData(self.model)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        mujoco.mj_resetData(self.model, self.data)
        return np.zeros(1), {}

    def step(self, action):
        force, height = np.array(action[:3]), action[3]
        self.data.xfrc_applied[self.model.body("crate").id] = [*force, *np.cross([0.0, 0.0, height], force)]
        mujoco.mj_step(self.model, self.data, 10)
        return np.zeros(1), 0.0, False, False, {}


def actions(env, count, seed=0, share=1.0):
    rng = np.random.default_rng(seed)
    space = env.action_space
    return (share * rng.uniform(space.low, space.high, (count, *space.shape))).astype(space.dtype)


def values(info):
    return [info[k] for k in FLOATS]


# Momentum ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("env_id", ["Ant-v5", "Humanoid-v5", "HalfCheetah-v5", "SafeRover-v0"])
def test_momentum_is_what_mujoco_says_of_the_state_after_the_step(env_id):
    env = sw.BalanceMonitor(gym.make(env_id))
    raw = env.unwrapped
    env.reset(seed=0)
    data, largest = mujoco.MjData(raw.model), np.zeros(2)
    with warnings.catch_warnings(action="ignore"):  # of the rover's tyres
        for action in actions(env, 20):
            info = env.step(action)[4]
            data.qpos[:], data.qvel[:] = raw.data.qpos, raw.data.qvel
            mujoco.mj_forward(raw.model, data)
            mujoco.mj_subtreeVel(raw.model, data)
            linear = data.subtree_linvel[0] * raw.model.body_subtreemass[0]
            np.testing.assert_allclose(info[MOMENTA[0]], linear, rtol=1e-9, atol=1e-9)
            np.testing.assert_allclose(info[MOMENTA[1]], data.subtree_angmom[0], rtol=1e-9, atol=1e-9)
            largest = np.maximum(largest, [np.linalg.norm(info[k]) for k in MOMENTA])
    assert (largest > 0.1).all()


# Support ----------------------------------------------------------------------------------------------------------


def settled(env, action, steps=60):
    """The last info of a held push."""
    for _ in range(steps):
        info = env.step(np.asarray(action, np.float64))[4]
    return info


@pytest.mark.parametrize(("along", "half"), [(0, 0.2), (1, 0.1)])
@pytest.mark.parametrize("push", [0.0, 10.0, 20.0, -20.0])
def test_a_pushed_crate_presses_where_statics_says(along, half, push):
    env = sw.BalanceMonitor(Crates(friction=3.0), bodies=["crate"])
    env.reset(seed=0)
    action = np.zeros(4)
    action[along], action[3] = push, 0.1  # 0.4 m over the floor
    info = settled(env, action)
    beyond = abs(push) * 0.4 / (10.0 * 9.81)
    other = min(0.2, 0.1) if along == 0 else np.inf
    expected = min(half - beyond, other)
    assert info[keys.BALANCE_ZMP_MARGIN] == pytest.approx(expected, abs=1e-3)


# Friction ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("cone", "turned", "used"),
    [("elliptic", 0.0, 1.0), ("elliptic", 0.6, 1.0), ("pyramidal", 0.25 * np.pi, 0.5**0.5)],
)
def test_what_slides_uses_all_friction_and_a_pyramid_has_less_between_its_edges(cone, turned, used):
    env = sw.BalanceMonitor(Crates(0.4, cone), bodies=["crate"])
    env.reset(seed=0)
    settled(env, np.zeros(4))
    env.unwrapped.data.qvel[:2] = 2.0 * np.cos(turned), 2.0 * np.sin(turned)
    info = env.step(np.zeros(4))[4]
    assert info[keys.BALANCE_FRICTION_USED] == pytest.approx(used, rel=0.02)


# All of it by hand, on robots -------------------------------------------------------------------------------------


def by_hand(raw, data):
    """The figures of one Euler step, substep by substep: MuJoCo's forces, the textbook's formula, scipy's hull."""
    model, wrench = raw.model, np.zeros(6)
    data.ctrl[:] = raw.data.ctrl
    weight = float(model.body_mass.sum()) * 9.81
    used, margins = 0.0, []
    for _ in range(raw.frame_skip):
        mujoco.mj_step(model, data)
        points, forces = [], []
        for k in range(data.ncon):
            one, two = model.geom_bodyid[data.contact.geom[k]]
            if 0 not in (one, two) or data.contact.efc_address[k] < 0:
                continue
            mujoco.mj_contactForce(model, data, k, wrench)
            points.append(data.contact.pos[k].copy())
            forces.append((1.0 if one == 0 else -1.0) * data.contact.frame[k].reshape(3, 3).T @ wrench[:3])
            if wrench[0] >= PRESSING * weight:
                slides = data.contact.friction[k, 0] * wrench[0]
                used = max(used, np.hypot(wrench[1], wrench[2]) / slides)
        if len(points) < 3 or sum(f[2] for f in forces) <= 0.0:
            continue
        p, f = np.array(points), np.array(forces)  # the ground is level
        if np.abs(p[:, 2] - p[:, 2].mean()).max() > 0.01:
            continue
        height = p[:, 2] - p[:, 2].mean()
        zmp = (p[:, :2] * f[:, 2:] - height[:, None] * f[:, :2]).sum(axis=0) / f[:, 2].sum()
        hull = ConvexHull(p[:, :2]).equations
        margins.append(-(hull[:, :2] @ zmp + hull[:, 2]).max())
    return used, min(margins, default=np.nan)


@pytest.mark.parametrize(("env_id", "strength"), [("Ant-v5", 0.08), ("Humanoid-v5", 0.3)])
def test_figures_are_those_of_stepping_by_hand(env_id, strength):
    env = sw.BalanceMonitor(gym.make(env_id, terminate_when_unhealthy=False))
    raw = env.unwrapped
    raw.model.opt.integrator = mujoco.mjtIntegrator.mjINT_EULER  # one evaluation per substep
    env.reset(seed=0)
    found = []
    for step, action in enumerate(actions(env, 120, share=strength)):
        if step == 60:  # whose contacts have other rows
            raw.model = copy.copy(raw.model)
            raw.model.opt.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
        start = copy.copy(raw.data)
        info = env.step(action)[4]
        np.testing.assert_allclose(values(info), by_hand(raw, start), rtol=1e-8, atol=1e-9)
        assert info[keys.BALANCE_PARTIAL] is False
        found.append(values(info))
    used, margins = np.array(found).T
    assert (~np.isnan(margins)).sum() > 10 and np.nanmin(margins) < 0.02 < np.nanmax(margins)
    assert used.max() > 0.9 and (used > 0.0).sum() > 60


# What it cannot see ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_no_number_that_is_none_is_reported(bad):
    for place in ("pos", "velocity"):
        env = sw.BalanceMonitor(Meddling(gym.make("HalfCheetah-v5"), (25,), **{place: bad}))
        env.reset(seed=0)
        with warnings.catch_warnings(action="ignore"):
            infos = [env.step(env.action_space.low)[4] for _ in range(27)]
        for info in infos[24:26]:  # and MuJoCo's reset in the step after it
            known = info[keys.BALANCE_FRICTION_USED]
            assert np.isfinite([known, *info[MOMENTA[0]], *info[MOMENTA[1]]]).all()
        assert infos[24][keys.BALANCE_PARTIAL] is True and infos[23][keys.BALANCE_PARTIAL] is False
        assert infos[26][keys.BALANCE_PARTIAL] is False


# Bad input --------------------------------------------------------------------------------------------------------
