"""TeleopChannel: what a network does to commands, images and energy, and when the local brake takes over."""

import itertools

import gymnasium as gym
import numpy as np
import pytest
from braked_cart import BrakedCart, cart_plant, stop
from hypothesis import given, settings
from hypothesis import strategies as st

import safe_wrappers as sw
from safe_wrappers.envs import teleop_contact as task
from safe_wrappers.envs.teleop_operator import TeleopOperator
from safe_wrappers.errors import ActionError

TICK = 0.001
IMPEDANCE = 40.0
MARGIN = 0.001


def clamp(braking=task.TELEOP_BRAKING):
    """The clamp's face, as a constraint."""
    face = sw.constraints.Plane([0.0, task.CLAMP_Y], [0.0, -1.0])
    return sw.constraints.Clearance([face], braking, bodies=["tool"], radius=task.TOOL_RADIUS, margin=MARGIN)


def ceiling(braking=task.TELEOP_BRAKING, **times):
    """What a channel with a ceiling takes."""
    machine = {"acceleration": task.TELEOP_ACCELERATION, "top_speed": task.TELEOP_TOP_SPEED}
    return {"budget": sw.StoppingBudget(clamp(braking), **machine), **times}


def channel(uplink=0.0, downlink=0.0, inside=lambda env: env, **options):
    env = gym.make("TeleopContact-v0", max_episode_steps=100_000)
    return sw.TeleopChannel(inside(env), uplink, downlink, **options)


def place(env, tool=(0.0, 0.0), velocity=(0.0, 0.0), seed=0):
    layout = {"tool": list(tool), "velocity": list(velocity), "wanted_force": 8.0}
    return env.reset(seed=seed, options={"layout": layout})[0]


def cart(uplink=0.0, downlink=0.0, dt=TICK, **options):
    """A channel to a cart on a line, which is not MuJoCo's."""
    return sw.TeleopChannel(BrakedCart(dt, dtype=np.float64), uplink, downlink, **options)


# What is sent and what arrives ----------------------------------------------------------------------------------


def rollout(env, actions):
    seen, rest = [env.reset(seed=0)[0]], []
    for action in actions:
        observation, *more, _ = env.step(action)
        seen.append(observation)
        rest.append(more)
    return np.array(seen), rest


@pytest.mark.parametrize("env_id", ["Reacher-v5", "Pendulum-v1", "TeleopContact-v0"])
@pytest.mark.parametrize(("up", "down"), [(0, 0), (3, 0), (0, 5), (4, 2)])
def test_actions_and_observations_come_late_by_their_delays_and_rewards_do_not(env_id, up, down):
    bare = gym.make(env_id)
    tick, space = bare.get_wrapper_attr("dt"), bare.action_space
    actions = np.random.default_rng(0).uniform(space.low, space.high, (40, *space.shape)).astype(space.dtype)
    expected, rewards = rollout(bare, [*np.zeros((up, *space.shape), space.dtype), *actions[: 40 - up]])
    seen, late = rollout(sw.TeleopChannel(gym.make(env_id), up * tick, down * tick), actions)
    assert np.array_equal(seen, [*[expected[0]] * down, *expected[: 41 - down]])
    assert late == rewards


SAID = st.one_of(st.integers(0, 6), st.sampled_from(["nothing", "from the future", "not finite"]))
"""A command that is made from what was shown so many ticks ago, or what else a tick may bring."""


@given(up=st.integers(0, 4), down=st.integers(0, 4), said=st.lists(SAID, min_size=5, max_size=40))
@pytest.mark.filterwarnings("ignore:the policy's action is not finite")
def test_the_round_trip_is_the_age_of_the_image_that_the_command_in_force_was_made_from(up, down, said):
    env = cart(up * TICK, down * TICK)
    env.reset(seed=0)
    shown, arriving, in_force = [0], {}, (0.0, 0)
    for now, what in enumerate(said):
        action = np.array([0.01 * (now + 1), 0.0])
        if what == "nothing":
            env.set_observation_time(None)
        elif what == "from the future":
            env.set_observation_time((now + 1) * TICK)
        elif what == "not finite":
            action[1] = np.nan
        else:
            env.set_observation_time((now - what) * TICK)
            arriving[now + up] = action[0], shown[max(now - what, 0)]
        in_force = arriving.get(now, in_force)
        info = env.step(action)[4]
        assert info["executed_action"].tolist() == [in_force[0], 0.0]
        assert info["teleop/round_trip_s"] == pytest.approx((now - in_force[1]) * TICK, abs=1e-12)
        assert info["teleop/lost"] == (what in ("from the future", "not finite"))
        shown.append(max(now + 1 - down, 0))
    for wrong in (np.nan, np.inf, "now", [0.0]):
        with pytest.raises(ActionError, match="time in seconds"):
            env.set_observation_time(wrong)


@given(
    delay=st.integers(0, 20),
    jitter=st.integers(0, 20),
    loss=st.sampled_from([0.0, 0.3, 1.0]),
    seed=st.integers(0, 1000),
)
def test_what_is_sent_arrives_in_order_and_in_its_time_or_is_lost_and_counted(delay, jitter, loss, seed):
    env = cart(sw.teleop.Link(delay * TICK, jitter * TICK, loss))
    env.reset(seed=seed)
    arrives, before = [], -1
    for now in range(120):
        info = env.step(np.array([0.001 * (now + 1), 0.0]))[4]
        arrives += [now] if not info["teleop/lost"] else []
        in_force = round(1000 * info["executed_action"][0]) - 1
        assert in_force in (-1, *arrives) and before <= in_force <= max(now - delay, -1)
        assert in_force >= max((sent for sent in arrives if sent <= now - delay - jitter), default=-1)
        before = in_force
    assert len(arrives) == {0.0: 120, 1.0: 0}.get(loss, len(arrives))


def test_losses_take_their_share_in_each_direction_by_itself_and_are_seeded():
    def lost(seed):
        env = cart(sw.teleop.Link(loss=0.3), sw.teleop.Link(loss=0.3))
        env.reset(seed=seed)
        return [env.step(np.zeros(2))[4]["teleop/lost"] for _ in range(4000)]

    once = lost(0)
    assert lost(0) == once != lost(1)
    np.testing.assert_allclose(np.bincount(once) / 4000, [0.7**2, 2 * 0.7 * 0.3, 0.3**2], atol=0.03)


# Energy ---------------------------------------------------------------------------------------------------------


class Energies:
    """Net energy at the two ports, by what an operator is shown and what the env says that acted."""

    def __init__(self, env):
        self.env = env
        self.into = self.out = self.worst = self.through = 0.0

    def step(self, action):
        observation, *_, info = self.env.step(action)
        raw = self.env.unwrapped
        self.into += float(observation[4:6] @ np.clip(action, -1, 1)) * raw.dt
        if not (info["teleop/revoked"] or info.get("cbf/intervened", False)):
            out = float(raw.port_effort_acted @ info["executed_action"]) * raw.dt
            self.out += out
            self.through += abs(out)
        self.worst = max(self.worst, self.out + self.env.stored_j - self.into)
        return observation, info


NETWORKS = {
    "ideal": (sw.teleop.Link(), sw.teleop.Link()),
    "300 ms": (sw.teleop.Link(0.15), sw.teleop.Link(0.15)),
    "jitter, loss": (sw.teleop.Link(0.02, 0.03, 0.1), sw.teleop.Link(0.04, 0.05, 0.2)),
}


@pytest.mark.parametrize("network", NETWORKS)
def test_waves_never_give_out_more_than_went_in_less_what_is_in_flight(network):
    env = channel(*NETWORKS[network], impedance=IMPEDANCE)
    energies, rng, action = Energies(env), np.random.default_rng(1), np.zeros(2)
    place(env, (0.1, 0.0))
    for k in range(800):
        if k % int(rng.integers(20, 80)) == 0:  # all of the box, and dead time
            action = rng.uniform(-1, 1, 2) * rng.choice([0.0, 0.2, 1.0])
        info = energies.step(action)[1]
    # What is over is what saturation has made of the machine's effort: a share of what went through, and reported.
    assert energies.through > 0.1
    assert energies.worst <= 1e-12 * energies.through + info["teleop/created_j"] + 1e-12
    assert info["teleop/created_j"] < 1e-3 * energies.through
    assert env.ledger.net_j == pytest.approx(energies.into - energies.out, abs=1e-9)


def test_pressing_by_waves_creates_nothing_where_plain_coding_creates_energy_and_chatters():
    told = {}
    for impedance in (None, IMPEDANCE):
        env = channel(0.1, 0.1, impedance=impedance)
        energies, operator = Energies(env), TeleopOperator(0)
        observation, forces = place(env, (0.15, 0.0)), []
        for _ in range(4000):
            observation, info = energies.step(operator.act(observation))
            forces.append(info["contact_force"])
        touches = np.diff([0.0, *np.sign(forces)]) > 0.0
        told[impedance] = info["teleop/created_j"], max(forces), touches.sum()
        assert info["teleop/created_j"] == pytest.approx(max(energies.worst, 0.0), abs=1e-9)
    (made, force, bounces), (made_by_waves, force_by_waves, bounces_by_waves) = told.values()
    assert made > 1.0 and made_by_waves < 1e-12
    assert force > 30.0 and force_by_waves < 12.0
    assert bounces >= 4 and bounces_by_waves <= 2


def test_a_filter_inside_pays_for_itself():
    # It brakes hard before the clamp, again and again; none of that is the channel's energy.
    env = channel(0.02, 0.02, lambda env: sw.CBFActionFilter(env, [clamp()]), impedance=IMPEDANCE)
    operator, changed = TeleopOperator(0, stops=False, sweep_speed=0.4), 0
    observation = place(env, (0.184, 0.2))
    for _ in range(1600):
        observation, *_, info = env.step(operator.act(observation))
        changed += info["cbf/intervened"]
        assert info["cost"] == 0.0
    assert changed > 20 and info["clearance"] < 0.01
    assert info["teleop/created_j"] < 1e-12


def test_the_operator_feels_a_damper_first_and_the_machine_after_the_round_trip():
    env = channel(0.05, 0.05, impedance=IMPEDANCE)
    place(env, (0.0, -0.2))
    felt = np.array([env.step(np.array([0.1, 0.0]))[0][4] for _ in range(900)])
    np.testing.assert_allclose(felt[:100], IMPEDANCE * 0.1, atol=1e-9)
    assert abs(felt[-1]) < 0.2  # it moves freely
    assert env.unwrapped.tool_velocity[0] == pytest.approx(0.1, abs=0.01)


def test_pressing_with_a_still_hand_both_forces_agree():
    env = channel(0.02, 0.02, impedance=IMPEDANCE)
    observation, velocity = place(env, (0.18, 0.0)), 0.0
    for _ in range(4000):  # a mass of 1.5 kg, a damper of 10 N s/m, pushed with 8 N
        velocity += 0.001 / 1.5 * (8.0 - 10.0 * velocity - observation[4])
        observation, *_, info = env.step(np.array([velocity, 0.0]))
    assert abs(velocity) < 1e-3
    assert observation[4] == pytest.approx(8.0, abs=0.05) == info["contact_force"]


def test_while_authority_is_revoked_the_operator_feels_a_damper_and_nothing_piles_up():
    env = channel(0.002, 0.002, impedance=IMPEDANCE, **ceiling())
    place(env, (0.0, 0.1))
    seen = []
    for _ in range(400):
        observation, *_, info = env.step(np.array([0.0, 0.8]))
        seen.append((info["teleop/revoked"], observation[5], env.stored_j))
    revoked, forces, flying = map(np.array, zip(*seen, strict=True))
    # Never more than the impedance's own damping, at the largest while nothing comes back.
    assert revoked.sum() > 100 and forces.max() == pytest.approx(IMPEDANCE * 0.8, rel=1e-6)
    # The hand puts b v^2 in per second, and two ticks of it are on their way.
    assert flying.max() == pytest.approx(2 * IMPEDANCE * 0.8**2 * TICK, rel=0.05)
    assert info["teleop/created_j"] < 1e-8  # flows are rounded to the action space's float32


def test_waves_in_a_queue_are_as_old_as_they_are():
    # A queue puts every wave out in turn, so it is as late as the latest; a single command takes over at once.
    ages = {}
    for impedance in (IMPEDANCE, None):
        env = channel(sw.teleop.Link(0.01, 0.05), impedance=impedance)
        place(env)
        ages[impedance] = [env.step(np.array([0.1, 0.0]))[4]["teleop/round_trip_s"] for _ in range(400)]
        # What went in and has not come out is in flight or waits; commands are rounded to float32.
        assert env.stored_j == (pytest.approx(env.ledger.net_j, rel=1e-5) if impedance else 0.0)
    np.testing.assert_allclose(ages[IMPEDANCE][200:], max(ages[None]), atol=1e-9)
    assert np.mean(ages[None][200:]) < 0.9 * max(ages[None])


class Liar(gym.Env):
    """Publishes a `Port` that shows an effort of `shown`, and first resists with 5 N."""

    shown = 0.0
    dt, port_flow, port_effort_observed, port_feedthrough = TICK, [0], [0], 0.0
    action_space = gym.spaces.Box(-1.0, 1.0, (1,), np.float64)
    observation_space = gym.spaces.Box(-9.0, 9.0, (1,), np.float64)

    def reset(self, *, seed=None, options=None):
        self.efforts = itertools.chain([5.0], itertools.repeat(0.0))
        return np.zeros(1), {}

    def step(self, action):
        assert np.isfinite(action).all()
        self.port_effort_acted = np.array([next(self.efforts)])
        return np.array([self.shown]), 0.0, False, False, {}


def test_what_a_machine_took_unpaid_is_paid_by_the_next_waves():
    env = sw.TeleopChannel(Liar(), 0.0, 1.0, impedance=2.0)
    env.reset(seed=0)
    # sqrt(2 b) v = 1 sqrt(W): half a watt. It takes 5 mJ for half of one: the next nine waves are kept for the rest.
    infos = [env.step(np.array([0.5]))[4] for _ in range(14)]
    flows = [float(info["executed_action"][0]) for info in infos]
    np.testing.assert_allclose(flows, [1.0] + 9 * [0.0] + 4 * [1.0], atol=1e-6)
    assert [info["teleop/created_j"] for info in infos] == pytest.approx([4.5e-3] * 14)
    assert env.stored_j <= env.ledger.net_j + 1e-12


def test_an_effort_that_is_not_finite_makes_no_command():
    env = sw.TeleopChannel(Liar(), 0.0, 1.0, impedance=2.0)
    env.reset(seed=0)
    env.unwrapped.shown = np.nan
    env.step(np.array([0.5]))
    with pytest.raises(ActionError, match=r"finite numbers.*was not stepped"):
        env.step(np.array([0.5]))


# Authority ------------------------------------------------------------------------------------------------------


def watched(reading, braking=1e6, delays_s=0.0, **times):
    """A cart whose clearance and speed are what a test says, and what commands of some age, or none, lead to."""
    budget = sw.StoppingBudget(lambda env: reading["now"], braking, acceleration=0.0, delays_s=delays_s)
    env = cart(budget=budget, plant=cart_plant(TICK), fallback=stop, **times)
    reading["now"] = 1e3, 1.0
    env.reset(seed=0)

    def revoked(age=0):
        env.set_observation_time(None if age is None else env.now_s - age * TICK)
        info = env.step(np.array([0.5, 0.0]))[4]
        assert info["executed_action"].tolist() == ([0.0, 1.0] if info["teleop/revoked"] else [0.5, 0.0])
        return info["teleop/revoked"]

    for _ in range(120):
        assert not revoked()
    return revoked


@settings(max_examples=25)
@given(
    speed=st.floats(-1.0, 3.0),
    braking=st.floats(1.0, 50.0),
    video_s=st.floats(0.0, 0.3),
    human_s=st.floats(0.0, 0.3),
    delays_s=st.floats(0.0, 0.1),
    steps=st.integers(10, 130),
)
def test_authority_goes_beyond_the_appendix_s_ceiling_and_returns_below_a_share_of_it(
    speed, braking, video_s, human_s, delays_s, steps
):
    reading = {}
    revoked = watched(reading, braking, delays_s, video_s=video_s, human_s=human_s, longest_s=0.1)
    # So far that the ceiling, less the step until the next look, lies between two steps; at most `longest_s`.
    time_s = (steps + 0.5) * TICK + TICK + video_s + human_s + delays_s
    approaches = speed > 1e-6
    reading["now"] = (speed * time_s + speed**2 / (2 * braking) if approaches else 1.0), speed
    longest = min(steps, 100) if approaches else 100
    share = int(0.8 * min(longest + 0.5, 100.0))
    revoked()  # it looks after its step
    assert not revoked(longest) and revoked(longest + 1)
    assert all(revoked(share) for _ in range(share - 1))  # of an image from before the revocation
    assert revoked(share + 1) and revoked(share + 1)  # of one from after it, but above the share
    assert not revoked(share) and not revoked(longest)


def test_an_operator_who_is_silent_for_a_second_loses_authority_at_rest_too():
    reading = {}
    revoked = watched(reading)
    reading["now"] = 1.0, 0.0
    revoked()
    assert [revoked(None) for _ in range(1005)] == [False] * 1000 + [True] * 5


@pytest.mark.parametrize("answer", [(np.nan, 0.1), (0.1, np.inf), (-np.inf, 0.0), (0.1, 200.0)])
def test_where_nothing_can_be_read_or_is_left_there_is_no_authority(answer):
    reading = {}
    revoked = watched(reading)
    reading["now"] = answer
    revoked()
    assert all(revoked() for _ in range(9))
    reading["now"] = 1e3, 1.0
    assert revoked() and not revoked()


@pytest.mark.parametrize("room", [0.0, 0.002, 0.008])
@pytest.mark.parametrize(
    "own", [{}, {"margin": 0.2}, {"state_error": 0.2}, {"margin": 0.05, "state_error": 0.03}], ids=str
)
def test_no_command_is_executed_that_the_machine_cannot_stop_behind(own, room):
    """From rest, one hold of an acceleration takes a h^2 / 2, and one hold of braking back to rest as much."""
    hold = 0.1

    def revoked(throttle, delays_s=0.0):
        wall = sw.constraints.Plane([room + sum(own.values())], [-1.0])
        near = sw.constraints.Clearance([wall], braking=4.0, position=[0], velocity=[1], **own)
        # So fast a cart could be that no command is let through unseen.
        budget = sw.StoppingBudget(near, acceleration=1e3, delays_s=delays_s)
        env = cart(dt=hold, budget=budget, plant=cart_plant(hold), fallback=stop)
        env.reset(seed=0)
        return env.step(np.array([throttle, 0.0]))[4]["teleop/revoked"]

    most = room / hold**2
    assert [revoked(most + more) for more in (-1.0, -1e-6, 1e-6, 0.5)] == [False, False, True, True]
    # While the brake only begins to act no command is known to lead away.
    assert revoked(-1.0, delays_s=0.01)


def driven(env, pulses, ticks):
    """The least clearance under these actions, each for so many ticks, again and again."""
    place(env, (0.0, 0.12), (0.0, 0.3), seed=1)
    actions = itertools.cycle([np.array(action) for *action, held in pulses for _ in range(held)])
    return min(env.step(next(actions))[4]["clearance"] for _ in range(ticks))


LINKS = st.builds(
    sw.teleop.Link, st.floats(0.0, 0.1), st.sampled_from([0.0, 0.02, 0.3]), st.sampled_from([0.0, 0.5])
)
PULSES = st.tuples(st.floats(-1, 1), st.sampled_from([-1.0, 0.3, 1.0, 1.0]), st.integers(1, 200))
FOR_EVER = [(0.0, 1.0, 1)]
NO_HUMAN = {"human_s": 0.0, "video_s": 0.0, "longest_s": 10.0}
"""Nor video to wait for: only what the network and the brake themselves need is left."""


@settings(max_examples=15)
@given(up=LINKS, down=LINKS, pulses=st.lists(PULSES, min_size=1, max_size=5))
def test_the_margin_is_kept_whatever_operator_and_network_do(up, down, pulses):
    assert driven(channel(up, down, **ceiling(**NO_HUMAN)), pulses, 400) >= MARGIN - 1e-6


def test_without_a_ceiling_or_with_a_weaker_brake_than_declared_it_is_not():
    assert driven(channel(0.02, 0.02), FOR_EVER, 400) < 0.0
    assert driven(channel(**ceiling(3 * task.TELEOP_BRAKING, **NO_HUMAN)), FOR_EVER, 400) < 0.5 * MARGIN
    env = channel(**ceiling(**NO_HUMAN))
    assert MARGIN - 1e-6 < driven(env, FOR_EVER, 1200) < 1.2 * MARGIN
    # Next to the margin the operator may still back off.
    for _ in range(200):
        info = env.step(np.array([0.0, -0.3]))[4]
    assert info["clearance"] > 0.03 and not info["teleop/revoked"]


@pytest.mark.slow
@pytest.mark.parametrize("stops", [True, False])
def test_an_operator_who_looks_away_is_stopped_and_one_who_looks_is_not_disturbed(stops):
    env = channel(0.05, 0.05, impedance=IMPEDANCE, **ceiling())
    energies, operator = Energies(env), TeleopOperator(1, stops=stops)
    observation, infos = place(env, (0.18, 0.12), seed=1), []
    for _ in range(3000):
        observation, info = energies.step(operator.act(observation))
        infos.append(info)
    revoked = sum(info["teleop/revoked"] for info in infos)
    assert min(info["clearance"] for info in infos) > MARGIN and energies.worst < 1e-12
    assert info["swept"] > 0.06 and revoked < 400 if stops else revoked > 50
