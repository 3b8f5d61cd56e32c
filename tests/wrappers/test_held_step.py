"""What a held control does between samples: no unflagged violation, no false infeasible, the proved backup first."""

import gymnasium as gym
import mujoco
import numpy as np
import pytest

import safe_wrappers as sw

pytestmark = pytest.mark.filterwarnings("ignore::safe_wrappers.UnsafeStateWarning")


def unflagged(info):
    return not (info["cbf/infeasible"] or info["cbf/fallback"] or info["cbf/unsafe"])


def drive(filtered, h, driver, steps=300):
    """Violations of h at the ends of steps, and how many of them nothing flagged."""
    rng = np.random.default_rng(0)
    low, high = filtered.action_space.low, filtered.action_space.high
    filtered.reset(seed=0)
    bad = silent = infeasible = 0
    for k in range(steps):
        action = {
            "full": high,
            "bang": np.where(rng.random(high.size) < 0.5, low, high),
            "alternating": high * (-1.0) ** (k // 15),
        }[driver]
        *_, terminated, truncated, info = filtered.step(action.astype(np.float32))
        violated = h(filtered.unwrapped) < -1e-6
        bad += violated
        silent += violated and unflagged(info)
        infeasible += info["cbf/infeasible"]
        if terminated or truncated:
            filtered.reset()
    return bad, silent, infeasible


@pytest.mark.parametrize("alpha", [5.0, 10.0, 25.0])
@pytest.mark.parametrize("driver", ["full", "bang", "alternating"])
def test_a_barrier_whose_gradient_vanishes_at_rest_holds_on_a_strong_arm(alpha, driver):
    # At rest the row of 4 - v^2 allows everything; one held step reaches twice the limit.
    env = gym.make("Reacher-v5", max_episode_steps=1000)
    filtered = sw.CBFActionFilter(env, [sw.constraints.Barrier(lambda x: 4.0 - x[4] ** 2, alpha=alpha)])
    assert drive(filtered, lambda raw: 4.0 - raw.data.qvel[0] ** 2, driver) == (0, 0, 0)


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
    filtered = sw.CBFActionFilter(
        env, [sw.constraints.Barrier(lambda x: 16.0 - x[1] ** 2, alpha=alpha)], plant=plant
    )
    bad, silent, _ = drive(filtered, lambda raw: 16.0 - raw.state[1] ** 2, "bang")
    assert silent == 0
    assert (bad == 0) == holds  # gravity is stronger than the 2 N m of the published task


@pytest.mark.parametrize("env_id", ["Swimmer-v5", "Pusher-v5", "HalfCheetah-v5"])
def test_a_speed_limit_is_never_broken_in_silence_at_any_substep(env_id, monkeypatch):
    filtered = sw.CBFActionFilter(gym.make(env_id), [sw.constraints.JointSpeedLimit(3.0)])
    dofs, worst = filtered.filter.bound[0]._dofs, [0.0]
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
