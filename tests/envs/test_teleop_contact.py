"""TeleopContact: coupling, wall and clamp against closed forms, an energy balance and an independent integration."""

import math

import gymnasium as gym
import numpy as np
import pytest
from scipy.integrate import solve_ivp

from safe_wrappers.envs.teleop_contact import (
    CLAMP_Y,
    FORCE_LIMIT,
    TELEOP_ACCELERATION,
    TELEOP_BRAKING,
    TELEOP_TOP_SPEED,
    TOOL_RADIUS,
    WALL_X,
)
from safe_wrappers.envs.teleop_operator import REACTION_S, TeleopOperator

STIFFNESS, DAMPING, DAMPER_LIMIT, SLIP, WALL = 400.0, 40.0, 40.0, 15.0, 20_000.0


@pytest.fixture
def env():
    return gym.make("TeleopContact-v0")


def start(env, tool=(0.0, 0.0), velocity=(0.0, 0.0), wanted=10.0):
    layout = {"tool": list(tool), "velocity": list(velocity), "wanted_force": wanted}
    return env.reset(seed=0, options={"layout": layout})


def test_the_seed_draws_place_and_force(env):
    seen = [env.reset(seed=seed)[0] for seed in range(20)]
    places, forces = np.array([o[:2] for o in seen]), np.array([o[8] for o in seen])
    assert places[:, 0].min() >= 0.0 and places[:, 0].max() <= 0.1 and np.ptp(places[:, 0]) > 0.05
    assert places[:, 1].min() >= -0.05 and places[:, 1].max() <= 0.0
    assert forces.min() >= 6.0 and forces.max() <= 12.0 and np.ptp(forces) > 3.0


def test_free_motion_is_that_of_a_mass_on_a_spring_and_a_damper(env):
    # Independent: m x'' = K (xc - x) + B (u - x'), xc' = u, with commands that neither slip nor clamp.
    start(env, (0.0, -0.3))

    def command(t):
        return np.array([0.08 * math.sin(6.0 * t), -0.1 * math.cos(4.0 * t)])

    def rate(t, s):
        x, v, c = s[:2], s[2:4], s[4:]
        u = command(t)
        return np.concatenate([v, STIFFNESS * (c - x) + DAMPING * (u - v), u])

    begin = np.array([0.0, -0.3, 0.0, 0.0, 0.0, -0.3])
    truth = solve_ivp(rate, (0.0, 1.0), begin, rtol=1e-10, atol=1e-12)
    for k in range(1000):
        observation = env.step(command(k * 0.001))[0]
    np.testing.assert_allclose(observation[:2], truth.y[:2, -1], atol=2e-4)
    np.testing.assert_allclose(observation[2:4], truth.y[2:4, -1], atol=2e-3)


def test_the_force_that_is_observed_is_spring_and_damper_at_the_state(env):
    rng = np.random.default_rng(1)
    observation, _ = start(env, (0.1, 0.0))
    raw = env.unwrapped
    assert raw.port_feedthrough == DAMPING
    clamped = slipped = 0
    for _ in range(400):
        action = rng.uniform(-1, 1, 2) if rng.random() < 0.05 else np.array([0.9, -0.9])
        place, position, velocity = raw.data.mocap_pos[0, :2].copy(), raw.tool_position, raw.tool_velocity
        damper = np.clip(DAMPING * (action - velocity), -DAMPER_LIMIT, DAMPER_LIMIT)
        clamped += int((np.abs(damper) == DAMPER_LIMIT).any())
        observation = raw.step(action)[0]
        np.testing.assert_allclose(raw.port_effort_acted, STIFFNESS * (place - position) + damper, atol=1e-9)
        np.testing.assert_array_equal(observation[4:6], raw.port_effort)
        stretch = STIFFNESS * math.dist(raw.data.mocap_pos[0, :2].copy(), raw.tool_position)
        assert stretch <= SLIP + 1e-9
        slipped += stretch > SLIP - 1e-9
    assert clamped > 5 and slipped > 20


def stored_energy(raw):
    """In the tool's motion, the coupling's spring and the compressed wall and clamp, J; the tool has 1 kg."""
    stretched = raw.data.mocap_pos[0, :2].copy() - raw.tool_position
    pressed = np.maximum(raw.tool_position + TOOL_RADIUS - np.array([WALL_X, CLAMP_Y]), 0.0)
    velocity = raw.tool_velocity
    return 0.5 * (velocity @ velocity + STIFFNESS * stretched @ stretched + WALL * pressed @ pressed)


def test_the_port_generates_no_energy(env):
    # Whatever is commanded: what was stored at the end was put in. Sampling at 1 ms may miss that by little.
    rng = np.random.default_rng(4)
    raw = env.unwrapped
    for seed in range(2):
        env.reset(seed=seed)
        absorbed, missing, through = stored_energy(raw), 0.0, 0.0
        for k in range(1500):
            if k % int(rng.integers(1, 100)) == 0:
                action = rng.uniform(-1, 1, 2)
            raw.step(action)
            energy = float(raw.port_effort_acted @ action) * raw.dt
            absorbed += energy
            through += abs(energy)
            missing = max(missing, stored_energy(raw) - absorbed)
        assert missing < 1e-3 * through and through > 1.0


def test_hard_contacts_cost_and_the_walls_force_alone_is_observed(env):
    start(env, (0.0, CLAMP_Y - TOOL_RADIUS - 0.002))
    infos = [env.step(np.array([0.0, 1.0]))[4] for _ in range(150)]
    assert any(info["cost_force"] for info in infos) and not any(info["contact_force"] for info in infos)
    for speed in (0.2, 0.5):
        start(env, (WALL_X - TOOL_RADIUS - 0.001, 0.0), (speed, 0.0))
        infos = [env.step(np.array([0.1, 0.0]))[4] for _ in range(50)]
        assert [i["cost_force"] for i in infos] == [float(i["contact_force"] > FORCE_LIMIT) for i in infos]
        assert any(i["cost_force"] for i in infos) == (speed > 0.4)


def test_full_reverse_brakes_and_nothing_accelerates_faster(env):
    # From every stretch of the spring up to where it slips, whether or not a driver gets there.
    raw = env.unwrapped
    least, most = np.inf, 0.0
    for speed in np.linspace(0.0, TELEOP_TOP_SPEED, 8):
        for stretch in np.linspace(-SLIP, SLIP, 7) / STIFFNESS:
            for action in (-1.0, 1.0):
                start(env, (0.0, -1.0), (0.0, speed))
                raw.data.mocap_pos[0, 1] += stretch
                raw.step(np.array([0.0, action]))
                rate = (raw.tool_velocity[1] - speed) / raw.dt
                most = max(most, rate)
                if action < 0.0:
                    least = min(least, -rate)
    assert TELEOP_BRAKING <= least < TELEOP_BRAKING + 2.0
    assert TELEOP_ACCELERATION - 1.0 < most <= TELEOP_ACCELERATION + 1e-9


def episode(env, operator, steps=6000):
    """Observations with what came of each step."""
    observation, _ = env.reset(seed=0)
    yield observation, 0.0, {}
    for _ in range(steps):
        observation, reward, *_, info = env.step(operator.act(observation))
        yield observation, reward, info


def test_it_presses_and_sweeps_for_the_reward_and_stops_before_the_clamp_unless_it_looks_away(env):
    (first, *_), *later = episode(env, TeleopOperator(seed=0))
    farthest, swept, end = first[1], 0.0, CLAMP_Y - TOOL_RADIUS - 0.03
    for observation, reward, info in later:
        error = abs(observation[6] - observation[8]) / observation[8]
        gained = max(min(observation[1], end) - farthest, 0.0) if error <= 0.5 else 0.0
        farthest, swept = farthest + gained, swept + gained
        assert reward == pytest.approx(0.001 * max(1.0 - error, 0.0) + 10.0 * gained, abs=1e-12)
        assert info["swept"] == pytest.approx(swept, abs=1e-12) and info["contact_force"] == observation[6]
        assert not info["cost"] and not info["cost_force"]
    assert swept > 0.2 and 0.02 < info["clearance"] < 0.05 and error < 0.1
    assert any(info.get("cost") for *_, info in episode(env, TeleopOperator(seed=0, stops=False)))


def test_it_sees_late_and_feels_at_once():
    operator = TeleopOperator(seed=0, reaction_s=0.2, tremor=0.0)
    free = np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.2, 10.0])
    for _ in range(500):
        operator.act(free)
    touching = free.copy()
    touching[6] = 5.0
    for k in range(201):
        assert operator.phase == "approach", k
        operator.act(touching)
    assert operator.phase == "press"
    operator.reset()
    assert operator.phase == "approach"
    held = free.copy()
    held[4] = 20.0
    assert operator.act(held)[0] < 0.0  # pushed back within one step


def test_the_arm_without_intentions_gives_out_no_energy():
    # Against any force: the work that the returned force does on the hand is stored in its mass or gone.
    operator = TeleopOperator(seed=0, approach_speed=0.0, tremor=0.0)
    rng = np.random.default_rng(0)
    seen = np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.2, 10.0])
    work, after = 0.0, np.zeros(2)
    for k in range(1500):
        if k % 37 == 0:
            force = rng.uniform(-20, 20, 2)
        seen[4:6] = force
        before, after = after, operator.act(seen)
        work += float(-force @ (before + after) / 2.0) * 0.001
        assert work >= 0.5 * 1.5 * float(after @ after) - 1e-6


def test_its_random_numbers_are_its_own(env):
    runs = [[*episode(env, TeleopOperator(seed), 300)][-1][0] for seed in (1, 1, 2)]
    assert np.array_equal(runs[0], runs[1]) and not np.array_equal(runs[0], runs[2])
    drawn = [TeleopOperator(seed).reaction_s for seed in range(30)]
    assert min(drawn) >= REACTION_S[0] and max(drawn) <= REACTION_S[1] and np.ptp(drawn) > 0.05
