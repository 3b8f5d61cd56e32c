"""TeleopChannel, plain: an ideal one is none; a delay is a delay; links lose and delay as declared."""

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.envs.registration import EnvSpec
from hypothesis import given, settings
from hypothesis import strategies as st
from teleop_worlds import ceiling, channel, clamp, place

import safe_wrappers as sw
from safe_wrappers.envs.teleop_operator import TeleopOperator
from safe_wrappers.errors import ActionError, ConfigurationError
from safe_wrappers.wrappers.faults import Outages
from safe_wrappers.wrappers.teleop import Line
from safe_wrappers.wrappers.teleop_coding import Packet


def rollout(env, actions, seed=0):
    seen = [env.reset(seed=seed)[0]]
    rewards = []
    for action in actions:
        observation, reward, terminated, truncated, _ = env.step(action)
        seen.append(observation)
        rewards.append((reward, terminated, truncated))
    return np.array(seen), rewards


def some_actions(env, steps, seed=0):
    rng = np.random.default_rng(seed)
    return rng.uniform(env.action_space.low, env.action_space.high, (steps, *env.action_space.shape)).astype(
        np.float32
    )


@pytest.mark.parametrize("env_id", ["Reacher-v5", "Ant-v5", "TeleopContact-v0", "Pendulum-v1"])
def test_an_ideal_channel_is_no_channel(env_id):
    bare = gym.make(env_id)
    actions = some_actions(bare, 40)
    env = sw.TeleopChannel(gym.make(env_id), 0.0, sw.teleop.Link())
    (seen, rewards), (expected, expected_rewards) = rollout(env, actions), rollout(bare, actions)
    assert np.array_equal(seen, expected) and rewards == expected_rewards
    info = env.step(actions[0])[4]
    assert info["teleop/round_trip_s"] == 0.0
    assert not info["teleop/revoked"]


@pytest.mark.parametrize(("up", "down"), [(3, 0), (0, 5), (4, 2)])
def test_actions_and_observations_come_late_by_their_delay_and_rewards_do_not(up, down):
    bare = gym.make("Reacher-v5")
    actions = some_actions(bare, 40)
    zero = np.zeros((up, *actions[0].shape), np.float32)
    expected, rewards = rollout(bare, np.concatenate([zero, actions[: 40 - up]]))
    tick = bare.unwrapped.dt
    env = sw.TeleopChannel(gym.make("Reacher-v5"), up * tick, down * tick)
    seen, late = rollout(env, actions)
    assert np.array_equal(seen[down:], expected[: 41 - down])
    assert all(np.array_equal(o, expected[0]) for o in seen[: down + 1])
    assert late == rewards


def test_the_round_trip_is_the_age_of_what_the_command_was_made_from():
    env = channel(0.007, 0.004)
    place(env)
    ages = [env.step(np.zeros(2))[4]["teleop/round_trip_s"] for _ in range(40)]
    # At first the time since the reset, whose observation was known; then what both ways take.
    np.testing.assert_allclose(ages[:12], np.arange(12) * 0.001, atol=1e-12)
    np.testing.assert_allclose(ages[12:], 0.011, atol=1e-12)


def test_a_silent_operator_grows_old_and_a_stamp_from_the_future_is_not_believed():
    env = channel(0.002, 0.0)
    place(env)
    for _ in range(10):
        env.step(np.zeros(2))
    for _ in range(5):
        env.set_observation_time(None)
        age = env.step(np.full(2, 0.9))[4]["teleop/round_trip_s"]
    assert age == pytest.approx(0.002 + 0.003)
    for _ in range(3):
        env.set_observation_time(env.now_s + 0.1)
        info = env.step(np.full(2, 0.9))[4]
    assert info["teleop/round_trip_s"] > age and (info["executed_action"] == 0.0).all()
    # An older image, by a fault outside: the command is as old as that.
    for _ in range(6):
        env.set_observation_time(env.now_s - 0.004)
        age = env.step(np.zeros(2))[4]["teleop/round_trip_s"]
    assert age == pytest.approx(0.006)
    with pytest.raises(ActionError, match="time in seconds"):
        env.set_observation_time(np.nan)


def test_faults_and_recording_belong_outside():
    env = Outages(sw.RecordInterventions(channel(0.003, 0.003)), mean_between_s=0.05, mean_length_s=0.05)
    env.reset(seed=0)
    ages = [env.step(np.zeros(2))[4]["teleop/round_trip_s"] for _ in range(400)]
    assert max(ages) > 0.03 and min(ages[10:]) == pytest.approx(0.006)


def test_commands_act_in_the_order_of_sending():
    env = channel(sw.teleop.Link(0.002, 0.01, 0.2), sw.teleop.Link(loss=0.1))
    place(env)
    raw, stamps = env.unwrapped, []
    for k in range(1000):
        info = env.step(np.array([k * 1e-4, 0.0]))[4]
        stamps.append(info["executed_action"][0])
    assert raw.data.time == pytest.approx(1.0)
    assert (np.diff(stamps) >= 0.0).all()  # never back to an older one
    assert len(set(stamps)) < 800  # some are lost, some come at once


def test_links_and_operators_are_seeded_bit_for_bit():
    runs = []
    for seed in (0, 0, 1):
        env = channel(sw.teleop.Link(0.01, 0.02, 0.1), sw.teleop.Link(0.01, 0.02, 0.1))
        observation, _ = env.reset(seed=3)
        operator = TeleopOperator(seed)
        for _ in range(400):
            observation = env.step(operator.act(observation))[0]
        runs.append(observation)
    assert np.array_equal(runs[0], runs[1]) and not np.array_equal(runs[0], runs[2])


def test_an_action_that_is_not_finite_is_not_sent():
    env = channel()
    place(env)
    env.step(np.full(2, 0.5))
    with pytest.warns(UserWarning, match="not executed"):
        info = env.step(np.array([np.nan, 0.0]))[4]
    assert (info["executed_action"] == 0.5).all() and info["teleop/round_trip_s"] > 0.0
    for wrong in (np.zeros(3), "left"):
        with pytest.raises(ActionError, match="shape"):
            env.step(wrong)


def test_the_spec_rebuilds_it_with_all_that_it_holds():
    env = sw.TeleopChannel(
        sw.CBFActionFilter(gym.make("TeleopContact-v0"), [clamp()]),
        sw.teleop.Link(0.01, 0.02, 0.1),
        0.005,
        impedance=30.0,
        **ceiling(longest_s=0.5),
    )
    again = gym.make(EnvSpec.from_json(env.spec.to_json()))
    actions = some_actions(env, 100)
    assert np.array_equal(rollout(env, actions)[0], rollout(again, actions)[0])
    assert again.uplink == env.uplink


# Wrong use ------------------------------------------------------------------------------------------------------


def refused(error=ConfigurationError, inside=None, env_id="TeleopContact-v0", match=None, **options):
    arguments = {"uplink": 0.1, "downlink": 0.1} | options
    env = gym.make(env_id)
    with pytest.raises(error, match=match):
        sw.TeleopChannel(env if inside is None else inside(env), **arguments)


def test_waves_need_a_port():
    refused(env_id="Reacher-v5", match="need a port", impedance=10.0)


TICK = 0.001


def line(link, seed=0, stream="a line"):
    made = Line(link, stream, 1e-6 * TICK)
    made.reset(gym.make("Pendulum-v1"), seed)
    return made


def traffic(made, ticks=400):
    """By the tick of sending, at which tick a packet arrived, or None; and the order of arrival."""
    came, order = {}, []
    for k in range(ticks):
        if made.send(Packet(k, 0.0), k * TICK):
            came[k] = None
        for packet in made.receive(k * TICK):
            assert packet.content not in came
            came[packet.content] = k
            order.append(packet.content)
    return came, order


@settings(max_examples=40)
@given(
    delay=st.integers(0, 30),
    jitter=st.integers(0, 30),
    loss=st.sampled_from([0.0, 0.2, 1.0]),
    seed=st.integers(0, 1000),
)
def test_every_packet_arrives_once_in_its_time_and_order_or_is_lost(delay, jitter, loss, seed):
    link = sw.teleop.Link(delay * TICK, jitter * TICK, loss)
    came, order = traffic(line(link, seed), 150)
    for k in range(150):
        if k not in came:
            assert k + delay + jitter >= 149  # still on its way
        elif came[k] is not None:
            assert delay <= came[k] - k <= delay + jitter + 1
    assert order == sorted(order)
    if loss == 1.0:
        assert not order


def test_loss_takes_its_share():
    came = traffic(line(sw.teleop.Link(loss=0.3)), 20_000)[0].values()
    assert sum(c is None for c in came) / 20_000 == pytest.approx(0.3, abs=0.02)


def test_random_numbers_are_seeded_and_kept_apart():
    link = sw.teleop.Link(0.01, 0.05, 0.1)
    first = traffic(line(link))
    assert traffic(line(link)) == first
    assert traffic(line(link, seed=1)) != first and traffic(line(link, stream="another")) != first
