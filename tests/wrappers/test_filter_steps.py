"""The filter in closed loops that are known exactly: walls, delays, held controls, units; and broken readings."""

import functools
import warnings

import gymnasium as gym
import mujoco
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from worlds import Cart, filtered_cart, full_throttle, wall

import safe_wrappers as sw
from safe_wrappers.constraints.obstacles import Discs
from safe_wrappers.control.projection import cast_inside

pytestmark = pytest.mark.filterwarnings("ignore")


# A cart and a wall ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("own", [0.0, 0.1])
def test_margin_is_added_to_the_constraints_own(own):
    for margin in (0.0, 0.2):
        filtered = filtered_cart([wall(1.0, margin=own)], margin=margin)
        full_throttle(filtered, 100)
        assert filtered.unwrapped.farthest == pytest.approx(1.0 - margin - own, abs=1e-3)


@pytest.mark.parametrize("dt", [0.02, 0.1, 0.5])
@pytest.mark.parametrize("late", [0, 3])
def test_a_plant_with_inertia_stops_in_front_of_the_wall_whatever_is_in_flight(dt, late):
    # Bugs 6 and 7: one step of look-ahead on the position would drive through at any of these.
    filtered = filtered_cart([wall(3.0)], env=Cart(dt, latency_steps=late), dt=dt, delay_s=late * dt)
    infos = full_throttle(filtered, int(12 / dt))
    assert 3.0 - 1e-2 < filtered.unwrapped.farthest <= 3.0 + 1e-6
    assert min(i["cbf/margin"] for i in infos) > -1e-8
    assert sum(i["cbf/intervened"] for i in infos) > 3
    if late:
        blind = filtered_cart(
            [wall(3.0)], env=Cart(dt, latency_steps=late), dt=dt
        )  # the same without telling it
        full_throttle(blind, int(12 / dt))
        assert blind.unwrapped.farthest > 3.0 + 1e-3


def test_reset_forgets_the_last_action_and_the_commands_in_flight():
    filtered = filtered_cart([wall(100.0)], fallback="hold", env=Cart(0.1, 2), delay_s=0.2)
    full_throttle(filtered, 5)
    filtered.reset(seed=1)
    np.testing.assert_array_equal(filtered.plant.state, [0.0, 0.0])
    assert filtered.step(np.array([np.nan]))[4]["executed_action"] == [0.0]


# Rounding and held controls -------------------------------------------------------------------------------------


unit = st.floats(-1.0, 1.0)


@given(st.lists(st.tuples(unit, unit), min_size=1, max_size=5))
def test_the_cast_control_keeps_the_row_that_the_exact_one_kept(pairs):
    control, normal = (np.array(side) for side in zip(*pairs, strict=True))
    rows = normal[None, :], np.array([normal @ control]), -np.ones(control.size), np.ones(control.size)
    sent = cast_inside(control, np.float32, *rows)
    assert sent.dtype == np.float32 and (np.abs(sent) <= 1.0).all()
    assert np.abs(sent - control).max() <= 2.0 * np.finfo(np.float32).eps
    assert normal @ sent.astype(np.float64) <= rows[1][0] + 1e-15
    assert cast_inside(control, np.float64, *rows).tobytes() == control.tobytes()


def unflagged(info):
    return not (info["cbf/infeasible"] or info["cbf/fallback"] or info["cbf/unsafe"])


def drive_held(filtered, h, driver, steps=300):
    """Violations of h at the ends of steps, and how many of them nothing flagged."""
    rng = np.random.default_rng(0)
    low, high = filtered.action_space.low, filtered.action_space.high
    filtered.reset(seed=0)
    found = np.zeros(3, int)
    for k in range(steps):
        action = {
            "full": high,
            "bang": np.where(rng.random(high.size) < 0.5, low, high),
            "alternating": high * (-1.0) ** (k // 15),
        }[driver]
        *_, terminated, truncated, info = filtered.step(action.astype(np.float32))
        violated = h(filtered.unwrapped) < -1e-6
        found += violated, violated and unflagged(info), info["cbf/infeasible"]
        if terminated or truncated:
            filtered.reset()
    return found.tolist()


@pytest.mark.parametrize("alpha", [5.0, 10.0, 25.0])
@pytest.mark.parametrize("driver", ["full", "bang", "alternating"])
def test_a_barrier_whose_gradient_vanishes_at_rest_holds_on_a_strong_arm(alpha, driver):
    # At rest the row of 4 - v^2 allows everything; one held step reaches twice the limit.
    env = gym.make("Reacher-v5", max_episode_steps=1000)
    filtered = sw.CBFActionFilter(env, [sw.constraints.Barrier(lambda x: 4.0 - x[4] ** 2, alpha=alpha)])
    assert drive_held(filtered, lambda raw: 4.0 - raw.data.qvel[0] ** 2, driver) == [0, 0, 0]


@pytest.mark.parametrize("alpha", [5.0, 15.0, 20.0])
@pytest.mark.parametrize(("torque", "holds"), [(20.0, True), (2.0, False)])
def test_a_barrier_on_pendulum_is_never_broken_in_silence(alpha, torque, holds):
    env = gym.make("Pendulum-v1")
    env.unwrapped.max_torque = torque
    env.unwrapped.action_space = gym.spaces.Box(-torque, torque, (1,), np.float32)
    plant = sw.AnalyticPlant(
        f=lambda x: np.array([x[1], 15.0 * np.sin(x[0])]),
        g=lambda x: np.array([[0.0], [3.0]]),
        state=lambda raw: raw.state,
        control_dt=0.05,
    )
    slow = sw.constraints.Barrier(lambda x: 16.0 - x[1] ** 2, alpha=alpha)
    filtered = sw.CBFActionFilter(env, [slow], plant=plant)
    bad, silent, _ = drive_held(filtered, lambda raw: 16.0 - raw.state[1] ** 2, "bang")
    assert silent == 0
    assert (bad == 0) == holds  # gravity is stronger than the 2 N m of the published task


@pytest.mark.parametrize("env_id", ["Swimmer-v5", "Pusher-v5", "HalfCheetah-v5"])
def test_a_speed_limit_is_never_broken_in_silence_at_any_substep(env_id, monkeypatch):
    filtered = sw.CBFActionFilter(gym.make(env_id), [sw.constraints.JointSpeedLimit(3.0)])
    dofs, worst = filtered.filter.bound[0].spec._dofs, [0.0]
    raw, step = filtered.unwrapped, mujoco.mj_step

    def watched(model, data, nstep=1):
        for _ in range(nstep):
            step(model, data)
            if data is raw.data:
                worst[0] = max(worst[0], float(np.abs(data.qvel[dofs]).max()))

    monkeypatch.setattr(mujoco, "mj_step", watched)
    rng = np.random.default_rng(0)
    filtered.reset(seed=0)
    for _ in range(300):
        worst[0] = 0.0
        action = rng.choice([-1.0, 1.0], filtered.action_space.shape) * filtered.action_space.high
        info = filtered.step(action.astype(np.float32))[4]
        assert worst[0] <= 3.0 + 1e-6 or not unflagged(info)
        if info["cbf/infeasible"]:
            break  # from here on the state may be outside


@pytest.mark.parametrize("fallback", ["hold", "zero", lambda plant: np.array([1.0, 1.0])])
def test_a_proved_constraint_stays_proved_with_any_fallback(fallback):
    env = sw.protect(gym.make("SafePointGoal2-v0", max_episode_steps=400), fallback=fallback)
    rng, cost = np.random.default_rng(1), 0.0
    for seed in range(5):
        env.reset(seed=seed)
        raw = env.unwrapped
        for k in range(400):
            if k % 60 == 0:
                target = raw.hazard_positions[rng.integers(len(raw.hazard_positions))]
            offset = target - raw.agent_position
            angle = np.arctan2(offset[1], offset[0]) - raw.agent_heading
            angle = (angle + np.pi) % (2.0 * np.pi) - np.pi
            cost += env.step(np.array([1.0, np.clip(4.0 * angle, -1.0, 1.0)], np.float32))[4]["cost_substep"]
    assert cost == 0.0


# Units ----------------------------------------------------------------------------------------------------------


class Sled(gym.Env):
    """x'' = u / unit in the plane, exact; the action space is the box of `unit` on both axes."""

    observation_space = gym.spaces.Box(-np.inf, np.inf, (4,), np.float64)
    dt = 0.05

    def __init__(self, unit):
        self.unit = unit
        self.action_space = gym.spaces.Box(-unit, unit, (2,), np.float64)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.state = np.zeros(4)
        return self.state.copy(), {}

    def step(self, action):
        x, v, a = self.state[:2], self.state[2:], np.asarray(action) / self.unit
        self.state = np.concatenate([x + v * self.dt + 0.5 * a * self.dt**2, v + a * self.dt])
        return self.state.copy(), 0.0, False, False, {}

    def plant(self):
        return sw.AnalyticPlant(
            f=lambda x: np.array([x[2], x[3], 0.0, 0.0]),
            g=lambda x: np.vstack([np.zeros((2, 2)), np.eye(2) / self.unit]),
            state=lambda env: env.state,
            control_dt=self.dt,
        )


WEDGE = [
    sw.constraints.Plane([0.6, 0.0], [-1.0, 0.1]),
    sw.constraints.Plane([0.0, 0.4], [-0.2, -1.0]),
    sw.constraints.Plane([-0.5, 0.0], [1.0, 0.0]),
]
"""Two oblique walls, and a third one behind: their rows meet at a corner that the policy heads for."""


@functools.cache
def driven_into_the_corner(unit, with_barrier):
    """Positions, what was executed in shares of the box, and what the filter said, at every step."""
    limits = [sw.constraints.Clearance(WEDGE, braking=0.5, position=[0, 1], velocity=[2, 3])]
    if with_barrier:
        limits.append(sw.constraints.Barrier(lambda x: 0.09 - x[2] ** 2 - x[3] ** 2, alpha=5.0))
    sled = Sled(unit)
    env = sw.CBFActionFilter(sled, limits, plant=sled.plant())
    env.reset(seed=0)
    rng, seen = np.random.default_rng(0), []
    for step in range(100):
        if step % 25 == 0:
            wanted = np.clip(rng.uniform(-0.5, 1.5, 2), -1.0, 1.0)
        observation, _, _, _, info = env.step(wanted * unit)
        said = [info["cbf/margin"], info["cbf/intervened"], info["cbf/fallback"], info["cbf/infeasible"]]
        seen.append(np.concatenate([observation, info["executed_action"] / unit, said]))
    return np.array(seen)


@pytest.mark.parametrize("unit", [1e-7, 1e-4, 1e7])
@pytest.mark.parametrize("with_barrier", [False, True])
def test_the_unit_of_the_control_does_not_matter(unit, with_barrier):
    one, other = driven_into_the_corner(1.0, with_barrier), driven_into_the_corner(unit, with_barrier)
    margin, intervened, fallback = one[:, 6], one[:, 7], one[:, 8]
    assert intervened.mean() > 0.2 and not fallback.any() and margin.min() > -1e-9
    assert margin.min() < 0.01  # it did come to the walls
    np.testing.assert_allclose(other, one, atol=1e-6)


# Broken readings ------------------------------------------------------------------------------------------------


class Given(gym.Wrapper):
    """Keeps what the env was given; the physics stands still, so that a broken state cannot crash it."""

    hazards = np.array([[0.5, 0.0]])

    def step(self, action):
        self.given = np.array(action)
        return self.observation_space.sample(), 0.0, False, False, {}


def both(env, value):
    env.unwrapped.data.qpos[0] = env.unwrapped.data.qvel[0] = value


def speed(env, value):
    env.unwrapped.data.qvel[0] = value


def hazard(env, value):
    env.hazards = np.array([[0.5, 0.0], [value, 0.0]])


LINE = sw.constraints.Clearance([sw.constraints.Plane([-1.0], [1.0])], 1.0, bodies=["fingertip"])
POINT, ARM = "SafePointGoal1-v0", "Reacher-v5"


@pytest.mark.parametrize(
    ("env_id", "limit", "broken", "fallback", "delay_s"),
    [
        (POINT, sw.constraints.HeadingDriveClearance([Discs("hazard_positions", 0.2)]), both, "brake", 0.0),
        (POINT, sw.constraints.HeadingDriveClearance([Discs("hazards", 0.2)]), hazard, "brake", 0.0),
        (
            POINT,
            sw.constraints.Clearance([Discs("hazards", 0.2)], 1.0, bodies=["agent"]),
            hazard,
            "hold",
            0.0,
        ),
        (ARM, sw.constraints.JointSpeedLimit(4.0), both, "zero", 0.0),
        (ARM, LINE, both, lambda plant: [np.nan, np.inf], 0.0),
        (ARM, sw.constraints.JointSpeedLimit(4.0), speed, "brake", 0.02),  # not hidden by the prediction
    ],
)
def test_a_state_or_an_obstacle_that_is_no_number_runs_the_fallback(env_id, limit, broken, fallback, delay_s):
    plant = sw.MujocoPlant(delay_s=delay_s)
    filtered = sw.CBFActionFilter(Given(gym.make(env_id)), [limit], plant=plant, fallback=fallback)
    for value in (np.nan, np.inf) if broken is not hazard else (np.nan,):
        filtered.env.hazards = Given.hazards
        filtered.reset(seed=0)
        filtered.step(np.zeros(2, np.float32))
        broken(filtered.env, value)
        with warnings.catch_warnings(action="ignore"):
            info = filtered.step(np.array([1.0, 1.0], np.float32))[4]
        given = filtered.env.given
        assert np.isfinite(given).all() and filtered.action_space.contains(given.astype(np.float32))
        assert info["cbf/fallback"] and info["cbf/unsafe"] and info["cbf/intervened"], info
        assert all(np.isfinite(v).all() for v in info.values())
