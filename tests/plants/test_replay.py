"""Replays: the env's own end, bit for bit, what is seen on the way, and when they say that they have failed."""

import gymnasium as gym
import mujoco
import numpy as np
import pytest
from dropped_ball import DroppedBall
from scipy.spatial.transform import Rotation

from safe_wrappers.plants.mujoco.contacts import ContactReader, Replay, between, rotation_vector_rate

INTEGRATORS = ("Euler", "implicit", "implicitfast", "RK4")
RAW = ("HalfCheetah-v5", "Pusher-v5", "Hopper-v5", "Ant-v5", "Humanoid-v5", "SafePointGoal2-v0")


def nothing(data, time_s):
    """Looks away."""


def stepped(env, replay, action):
    """One step, and whether its replay is the same."""
    replay.before()
    env.step(action)
    return replay.after(nothing)


def contacts(reader, data):
    reader.clear()
    reader.read(data)
    return reader.found()


def states(env, data):
    size = mujoco.mj_stateSize(env.model, int(mujoco.mjtState.mjSTATE_INTEGRATION))
    state = np.zeros(size)
    mujoco.mj_getState(env.model, data, state, int(mujoco.mjtState.mjSTATE_INTEGRATION))
    return state


@pytest.mark.parametrize("env_id", RAW)
def test_a_replay_ends_where_the_env_does_and_leaves_it_alone(env_id):
    env = gym.make(env_id).unwrapped
    replay = Replay(env)
    env.reset(seed=0)
    rng = np.random.default_rng(0)
    for _ in range(60):
        replay.before()
        env.step(rng.uniform(env.action_space.low, env.action_space.high))
        before = states(env, env.data).tobytes()
        assert replay.after(nothing)
        assert states(env, env.data).tobytes() == before


def test_bodies_that_sleep_sleep_in_the_replay_and_wake_with_the_env():
    env = gym.make("SafePointGoal2-v0").unwrapped
    replay = Replay(env)
    vases = ContactReader(env.model, between(env.model, [f"vase{i}" for i in range(10)]))
    for seed in range(3):
        env.reset(seed=seed)
        counts = []
        for _ in range(30):
            seen = []
            replay.before()
            env.step(np.zeros(2))
            assert replay.after(lambda data, _, seen=seen: seen.append(len(contacts(vases, data).gap)))
            counts.append(set(seen))
        # Four corners each, and no contacts any more where MuJoCo has put them to sleep.
        assert counts[:5] == [{40}] * 5
        assert counts[-5:] == ([{0}] * 5 if hasattr(mujoco.mjtEnableBit, "mjENBL_SLEEP") else [{40}] * 5)


@pytest.mark.parametrize("integrator", INTEGRATORS)
@pytest.mark.parametrize("meddle", ["nothing", "pushes", "moves the hand"])
def test_every_integrator_with_activations_applied_forces_and_mocap_bodies(integrator, meddle):
    env = DroppedBall(meddle, integrator)
    replay = Replay(env)
    env.reset()
    rng = np.random.default_rng(1)
    followed = integrator != "RK4"  # whose activations are not
    for _ in range(60):
        assert stepped(env, replay, rng.uniform(-1.0, 1.0, 3)) is followed
    # The limited activation has been at its limit, and the puck has been lifted where the hand moves.
    assert np.abs(env.data.act[0]) <= 0.3 and env.data.act.any()


def test_the_rate_of_a_rotation_vector_turns_by_the_angular_velocity():
    rng, short = np.random.default_rng(0), 1e-6
    for length in (0.0, 1e-9, 1e-3, 0.5, 3.0):
        turned, velocity = rng.normal(size=(2, 5, 3))
        turned *= length / np.linalg.norm(turned, axis=1, keepdims=True)
        rate = rotation_vector_rate(turned, velocity)
        after = Rotation.from_rotvec(turned + short * rate)
        difference = (Rotation.from_rotvec(turned) * Rotation.from_rotvec(short * velocity)).inv() * after
        assert difference.magnitude().max() < 20.0 * short**2


@pytest.mark.parametrize("integrator", ["Euler", "RK4"])
def test_what_changes_between_substeps_is_noticed(integrator):
    env = DroppedBall("pushes in substeps", integrator)
    replay = Replay(env)
    env.reset()
    assert not stepped(env, replay, np.zeros(3))


@pytest.mark.parametrize(
    ("integrator", "nudge", "same"),
    [("Euler", 0.0, True), ("Euler", 1e-13, False), ("RK4", 1e-13, True), ("RK4", 1e-8, False)],
)
def test_same_is_bit_for_bit_and_up_to_rounding_for_runge_kutta(integrator, nudge, same):
    env = DroppedBall("nudges", integrator)
    env.nudge = nudge
    replay = Replay(env)
    env.reset()
    assert stepped(env, replay, np.zeros(3)) is same


@pytest.mark.parametrize("integrator", INTEGRATORS)
def test_forces_times_their_times_are_the_momentum_gained(integrator):
    # Ball and box fall, land and bounce; along z the floor's normal force and the weight are all there is.
    env = DroppedBall(integrator=integrator, height=0.13)
    replay = Replay(env)
    floor = ContactReader(env.model, between(env.model, ["ball", "box"], ["world"]))
    env.reset()
    held = 0.0
    for _ in range(100):
        seen = []
        mass = {name: float(env.model.body(name).mass[0]) for name in ("ball", "box")}
        before = mass["ball"] * env.data.qvel[2] + mass["box"] * env.data.qvel[8]
        replay.before()
        env.step(np.zeros(3))
        assert replay.after(
            lambda data, time_s, seen=seen: seen.append((time_s, contacts(floor, data).force[:, 2].sum()))
        )
        gained = mass["ball"] * env.data.qvel[2] + mass["box"] * env.data.qvel[8] - before
        assert sum(t for t, _ in seen) == pytest.approx(0.01)
        impulse = sum(t * f for t, f in seen)
        assert impulse == pytest.approx(gained + (mass["ball"] + mass["box"]) * 9.81 * 0.01, abs=1e-9)
        held += impulse
    assert held > 10.0
