"""ChunkHandover against a slow simulator of its docstrings, on random scenarios; its promises, infos and refusals."""

import math
from dataclasses import dataclass, field

import gymnasium as gym
import numpy as np
import pytest
from chunk_worlds import ChunkHandover, Line, Wander, counting_plant
from hypothesis import assume, given
from hypothesis import strategies as st
from slow_handover import Slow, measured

from safe_wrappers.wrappers.layer import CommandReceiver, WrapperRng

HOLD = 0.1
pytestmark = pytest.mark.filterwarnings("ignore:a command was held back:UserWarning")


# Random scenarios ---------------------------------------------------------------------------------------------


@dataclass
class Scenario:
    size: int
    horizon: int
    delay: tuple
    fewest: int
    limit: float
    controls: int
    dtype: type
    bound: float
    fallback: str
    scale: float
    smooth: bool
    seed: int
    ends_at: int
    events: list = field(default_factory=list)

    def env(self):
        bound = self.bound
        line = Line(self.controls, -bound, bound, self.dtype, HOLD, ends_at=self.ends_at)
        wander = self.fallback == "wander"
        return ChunkHandover(
            line,
            self.size,
            self.horizon,
            self.delay[0] if self.delay[0] == self.delay[1] else list(self.delay),
            blend_time=(self.fewest + 1) * HOLD if self.fewest else None,
            rate_limit=self.limit if math.isfinite(self.limit) else None,
            fallback=Wander(self.seed, self.controls, self.scale) if wander else self.fallback,
            plant=counting_plant(HOLD) if wander else None,
        )

    def oracle(self):
        return Slow(
            HOLD,
            self.fewest,
            self.limit,
            -min(self.bound, float(np.finfo(np.float32).max)),
            min(self.bound, float(np.finfo(np.float32).max)),
            dtype=self.dtype,
        )

    def fall_back(self, given):
        if self.fallback == "wander":
            return Wander(self.seed, self.controls, self.scale).at(len(given))
        return given[-1] if self.fallback == "hold" and given else np.zeros(self.controls)

    def chunk(self, rng):
        if self.smooth:
            walk = np.cumsum(rng.uniform(-0.1, 0.1, (self.size, self.controls)), axis=0)
            made = self.scale * (rng.uniform(-1, 1) + walk)
        else:
            made = self.scale * rng.uniform(-1, 1, (self.size, self.controls))
        return np.clip(made, -3e38, 3e38).astype(self.dtype)


EVENTS = ("fresh",) * 8 + ("nothing", "stale", "older", "future", "nan", "inf")


@st.composite
def scenarios(draw, limited=False):
    most = draw(st.integers(0, 4))
    delay = (draw(st.integers(0, most)), most)
    horizon = draw(st.integers(max(most, 1), 6))
    chunk = horizon + most + draw(st.integers(0, 6))
    fewest, limit = 0, math.inf
    if draw(st.booleans()) and chunk - most > 1:
        fewest = draw(st.integers(1, chunk - most - 1))
    elif chunk == 1 and draw(st.booleans()):
        fewest = draw(st.integers(1, 5))
    if limited or not fewest or draw(st.booleans()):
        limit = draw(st.floats(0.05, 50.0))
    bound = draw(st.sampled_from([1.0, 1.0, 0.3, math.inf]))
    return Scenario(
        chunk,
        horizon,
        delay,
        fewest,
        limit,
        controls=draw(st.integers(1, 3)),
        dtype=draw(st.sampled_from([np.float32, np.float32, np.float64])),
        bound=bound,
        fallback=draw(st.sampled_from(["zero", "hold", "wander"])),
        scale=draw(st.sampled_from([1.0, 0.3, 3.0])),
        smooth=draw(st.booleans()),
        seed=draw(st.integers(0, 2**31)),
        ends_at=draw(st.integers(1, 60)),
        events=draw(st.lists(st.sampled_from(EVENTS), min_size=2, max_size=12)),
    )


def act(event, env, oracle, chunk, rng):
    """Let the event happen to both; the chunk, and the control step of its observation, None for nothing."""
    observed = oracle.now
    if event == "nothing":
        env.set_observation_time(None)
        return chunk, None
    if event in ("stale", "older", "future"):
        observed += {"stale": -int(rng.integers(1, 4)), "older": -9, "future": 2}[event]
        env.set_observation_time(observed * HOLD)
    if event in ("nan", "inf"):
        chunk = chunk.copy()
        where = tuple(rng.integers(0, chunk.shape))
        chunk[where] = np.nan if event == "nan" else rng.choice([-np.inf, np.inf])
    return chunk, observed


def play(scenario):
    """One episode of both: per step the env's info and reward, and the oracle's ticks."""
    env, oracle = scenario.env(), scenario.oracle()
    env.reset(seed=scenario.seed)
    rng, delays = np.random.default_rng(scenario.seed), WrapperRng("ChunkHandover")
    delays.reset(env, scenario.seed)
    line, steps = env.unwrapped, []
    for event in scenario.events:
        delay = int(delays.draw.integers(scenario.delay[0], scenario.delay[1] + 1))
        chunk, observed = act(event, env, oracle, scenario.chunk(rng), rng)
        refused = observed is not None and not oracle.submit(chunk, observed, oracle.now + delay)
        start = oracle.now
        _, reward, terminated, _, info = env.step(chunk)
        ticks = []
        for t in range(start, min(start + scenario.horizon, scenario.ends_at)):
            ticks.append(oracle.tick(scenario.fall_back(line.given[:t])))
        steps.append((info, reward, ticks, refused))
        if terminated:
            break
    return env, oracle, steps


@given(scenarios())
def test_every_command_and_every_figure_is_the_slow_simulators(scenario):
    env, oracle, steps = play(scenario)
    assume(not oracle.close_calls)  # some in a hundred
    given_commands = env.unwrapped.given
    ticks = [tick for _, _, ticks, _ in steps for tick in ticks]
    assert len(given_commands) == len(ticks)
    tolerance = 1e-6 * max(1.0, scenario.scale * 4) if scenario.dtype is np.float32 else 1e-9
    for command, tick in zip(given_commands, ticks, strict=True):
        np.testing.assert_allclose(command, tick.control, rtol=0, atol=tolerance)
        if tick.exact:
            assert command.tobytes() == np.array(tick.control, scenario.dtype).tobytes()
    figures, t = measured(given_commands, HOLD), 0
    for info, reward, own, refused in steps:
        assert info["handover/starved"] == sum(tick.starved for tick in own)
        assert info["handover/limited"] == sum(tick.limited for tick in own)
        assert info["handover/refused"] == (refused or any(tick.refused for tick in own))
        latencies = [tick.latency for tick in own if tick.latency >= 0]
        assert info["handover/latency"] == (latencies[-1] if latencies else -1)
        longest = max((tick.blend_steps for tick in own), default=0)
        assert info["handover/blend_time"] == pytest.approx((longest + 1) * HOLD if longest else 0.0)
        mine = figures[t : t + len(own)]
        assert info["handover/peak_jerk"] == pytest.approx(max(mine), abs=1e-12)
        t += len(own)
        assert reward == pytest.approx(sum(0.5 * (k + 1) for k in range(t - len(own), t)))


@given(scenarios(limited=True))
def test_no_two_neighbours_are_farther_apart_than_the_limit_allows(scenario):
    """Also where the simulator is not asked: ties, and numbers as coarse as the limit."""
    env, _, steps = play(scenario)
    commands = np.array(env.unwrapped.given, dtype=np.float64)
    largest = np.abs(np.diff(commands, axis=0)).max(initial=0.0)
    assert largest <= scenario.limit * HOLD
    assert max(info["handover/peak_jerk"] for info, *_ in steps) <= scenario.limit
    assert np.isfinite(commands).all()


@given(
    scenarios(limited=True),
    st.sampled_from([1e2, 1e5, 1e8, 1e30, 3e38]),
    st.sampled_from([1e-3, 0.05, 1.0]),
)
def test_the_limit_holds_in_infinite_boxes_where_float32_is_coarser(scenario, scale, limit):
    scenario.bound, scenario.scale, scenario.limit = math.inf, scale, limit
    if scenario.fallback == "wander":
        scenario.fallback = "hold"
    env = play(scenario)[0]
    commands = np.array(env.unwrapped.given, dtype=np.float64)
    assert np.isfinite(commands).all()
    assert np.abs(np.diff(commands, axis=0)).max(initial=0.0) <= limit * HOLD


# Bits -----------------------------------------------------------------------------------------------------------


def run(env, chunks, seed=0):
    """The commands that were given, and the infos."""
    env.reset(seed=seed)
    infos = [env.step(chunk)[4] for chunk in chunks]
    return np.array(env.unwrapped.given), infos


@pytest.mark.parametrize("limits", [None, {"jerk": 1e9}])
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_without_need_for_a_blend_the_chunks_bits_are_executed(limits, dtype):
    rng = np.random.default_rng(0)
    stream = rng.uniform(-1, 1, (40, 2)).astype(dtype)
    chunks = [stream[i : i + 8] for i in range(0, 32, 4)]  # they agree where they overlap
    env = ChunkHandover(Line(2, dtype=dtype), 8, 4, 2, limits=limits, rate_limit=20.0, fallback="zero")
    commands, infos = run(env, chunks)
    assert commands[2:].tobytes() == stream[2:32].tobytes()
    assert [i["handover/limited"] for i in infos] == [0] * 8
    assert [i["handover/blend_time"] for i in infos] == [0.0] * 8
    assert [i["handover/starved"] for i in infos] == [2] + [0] * 7


def test_what_is_held_back_is_counted_where_the_dtype_hardly_resolves_the_limit():
    env = ChunkHandover(Line(1, -1e6, 1e6), 8, 4, rate_limit=0.01, fallback="zero")
    env.reset(seed=0)
    env.step(np.full((8, 1), 1e5, np.float32))
    swing = np.float32(1e5 + 0.02 * (-1.0) ** np.arange(8)[:, None])
    assert all(env.step(swing)[4]["handover/limited"] for _ in range(5))


def test_ordinary_policies_pass_bit_for_bit_as_chunks_of_one():
    rng = np.random.default_rng(1)
    actions = rng.uniform(-1, 1, (50, 3)).astype(np.float32)
    env = ChunkHandover(Line(3), 1, 1, rate_limit=20.0, fallback="zero")
    commands, infos = run(env, actions[:, None])
    assert commands.tobytes() == actions.tobytes()
    assert all(i["handover/blend_time"] == 0.0 and i["handover/latency"] == 0 for i in infos)


def test_chunks_outside_the_box_are_clipped_to_it_before_they_are_limited():
    """A policy that asks for 1000 in a box of 1 must not be a long way from -1."""
    env = ChunkHandover(Line(), 4, 4, rate_limit=10.0, fallback="zero")
    up, down = np.full((4, 1), 1000.0, np.float32), np.full((4, 1), -1000.0, np.float32)
    commands, _ = run(env, [up, down])
    assert commands[:4, 0].tolist() == [1.0] * 4
    assert commands[-1, 0] == -1.0


# Latency by consumption -----------------------------------------------------------------------------------------


def numbered(k, size):
    """Chunk k: entry j reads 0.01 k + 0.001 j, so that a command says where it is from."""
    return np.array([[0.01 * k + 0.001 * j] for j in range(size)], np.float32)


@pytest.mark.parametrize(("size", "horizon"), [(8, 4), (6, 3), (4, 2)])
def test_what_is_executed_when_for_every_delay_up_to_the_horizon(size, horizon):
    for delay in range(min(horizon, size - horizon) + 1):
        env = ChunkHandover(Line(), size, horizon, delay, rate_limit=1e9, fallback="zero")
        commands, infos = run(env, [numbered(k, size) for k in range(1, 6)])
        for t, command in enumerate(commands[:, 0]):
            k, j = divmod(t - delay, horizon)  # chunk k took over at k horizon + delay
            expected = 0.0 if t < delay else numbered(k + 1, size)[j + delay, 0]
            assert command == expected, (delay, t)
        # delay == horizon: a chunk takes over at the first control step of the step after its own
        first = -1 if delay == horizon else delay
        assert [i["handover/latency"] for i in infos] == [first] + [delay] * 4


def test_random_delays_are_drawn_within_bounds_all_of_them_and_again_with_the_seed():
    def latencies(env, seed, episodes=1):
        found = []
        for _ in range(episodes):
            env.reset(seed=seed)
            seed = None
            found.append([env.step(numbered(k, 12))[4]["handover/latency"] for k in range(40)])
        return found

    env = ChunkHandover(Line(), 12, 6, [1, 4], fallback="zero", rate_limit=50.0)
    first, second = latencies(env, 3, episodes=2)
    assert set(first) == {1, 2, 3, 4} == set(second) and first != second
    assert latencies(env, 3, episodes=2) == [first, second]
    assert latencies(env, 4) != [first]
    again = ChunkHandover(Line(), 12, 6, [1, 4], fallback="zero", rate_limit=50.0)
    assert latencies(again, 3) == [first]


@pytest.mark.parametrize(
    ("stamp", "why"),
    [(0.0, "old"), (0.4, "a repeat"), (0.39, "a repeat"), (0.7, "the future"), (-1.0, "old")],
)
def test_chunks_that_are_not_newer_or_from_the_future_are_refused(stamp, why):
    env = ChunkHandover(Line(), 8, 2, rate_limit=1e9, fallback="zero")
    env.reset(seed=0)
    for k in (1, 2, 3):
        env.step(numbered(k, 8))  # the third is from 0.4 s
    env.set_observation_time(stamp)
    info = env.step(numbered(4, 8))[4]
    assert info["handover/refused"] and info["handover/latency"] == -1, why
    np.testing.assert_array_equal(env.unwrapped.given[6:], numbered(3, 8)[2:4])
    assert not env.step(numbered(5, 8))[4]["handover/refused"], "the next one, fresh, is welcome"


def test_a_reset_forgets_chunks_stamps_and_commands():
    env = ChunkHandover(Line(), 8, 4, 4, rate_limit=0.5, fallback="zero")
    fresh, _ = run(env, [numbered(k, 8) for k in range(4)])
    env.reset(seed=0)
    env.step(np.ones((8, 1), np.float32))
    env.set_observation_time(None)
    again, infos = run(env, [numbered(k, 8) for k in range(4)])
    assert again.tobytes() == fresh.tobytes()
    assert infos[0]["handover/starved"] == 4


# Starvation -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("where", [0, 5, 11])
def test_a_chunk_with_one_bad_entry_is_refused_whole_then_left_over_then_fallback(bad, where):
    env = ChunkHandover(Line(), 12, 4, rate_limit=1e9, fallback="hold")
    env.reset(seed=0)
    env.step(numbered(1, 12))
    broken = numbered(2, 12)
    broken[where] = bad
    infos = [env.step(broken)[4] for _ in range(3)]
    assert [i["handover/refused"] for i in infos] == [True] * 3
    assert [i["handover/starved"] for i in infos] == [0, 0, 4]
    np.testing.assert_array_equal(env.unwrapped.given[:12], numbered(1, 12))
    assert [float(c[0]) for c in env.unwrapped.given[12:]] == [float(np.float32(0.021))] * 4


def test_into_the_fallback_and_back_is_bumpless():
    limit = 1.0
    env = ChunkHandover(Line(), 8, 4, rate_limit=limit, fallback="zero")
    env.reset(seed=0)
    high, infos = np.full((8, 1), 0.9, np.float32), []
    for step in range(14):
        if 2 <= step < 8:
            env.set_observation_time(None)
        infos.append(env.step(high)[4])
    commands = np.array(env.unwrapped.given)[:, 0]
    assert np.abs(np.diff(commands)).max() <= limit * HOLD + 1e-7
    assert [i["handover/starved"] for i in infos] == [0, 0, 0, 4, 4, 4, 4, 4] + [0] * 6
    assert commands[31] == 0.0 and (commands[-4:] == np.float32(0.9)).all()
    into, back = infos[3], infos[8]
    assert into["handover/blend_time"] == pytest.approx(math.ceil(1.875 * 0.9 / limit / HOLD) * HOLD)
    assert back["handover/latency"] == 0


@pytest.mark.parametrize("value", [np.nan, np.inf, 1e300])
def test_a_broken_fallback_sends_nothing_that_is_not_finite(value):
    env = ChunkHandover(
        Line(low=-np.inf, high=np.inf),
        4,
        2,
        2,
        rate_limit=5.0,
        fallback=lambda p: [value],
        plant=counting_plant(),
    )
    commands, _ = run(env, [np.zeros((4, 1), np.float32)] * 3)
    assert np.isfinite(commands).all()


# Infos ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("ends_at", [1, 2, 5, 8])
def test_an_episode_may_end_inside_a_chunk(ends_at):
    def infos(line):
        return {"cost": float(line.steps)}

    env = ChunkHandover(Line(ends_at=ends_at, infos=infos), 8, 4, 1, rate_limit=5.0, fallback="zero")
    env.reset(seed=0)
    done, rewards, cost = False, 0.0, 0.0
    while not done:
        observation, reward, done, truncated, info = env.step(numbered(1, 8))
        rewards, cost = rewards + reward, cost + info["cost"]
        assert type(reward) is float and not truncated
    assert ends_at == len(env.unwrapped.given) == observation[0]
    assert rewards == 0.5 * cost == 0.5 * sum(range(1, ends_at + 1))


def test_what_was_executed_is_measured_not_what_was_sent():
    """A filter inside changes the commands: the figures are its, the limit is kept by what was sent."""

    class Flips(gym.Wrapper):
        def step(self, action):
            done = -action if self.unwrapped.steps % 2 else action
            observation, reward, terminated, truncated, info = self.env.step(done)
            info["executed_action"] = done
            return observation, reward, terminated, truncated, info

    env = ChunkHandover(Flips(Line()), 4, 2, rate_limit=5.0, fallback="zero")
    commands, infos = run(env, [np.full((4, 1), 0.5, np.float32)] * 3)
    assert np.abs(commands).tolist() == [[0.5]] * 6
    assert [i["handover/peak_jerk"] for i in infos] == [10.0] * 3


def test_within_a_wide_limit_the_new_chunk_comes_at_once_and_its_seam_is_measured():
    env = ChunkHandover(Line(), 4, 2, rate_limit=1e9, fallback="zero")
    commands, infos = run(env, [np.full((4, 1), x, np.float32) for x in (1.0, -1.0)])
    assert commands[:, 0].tolist() == [1.0, 1.0, -1.0, -1.0]
    assert infos[1]["handover/peak_jerk"] == pytest.approx(20.0)


# Order and construction -----------------------------------------------------------------------------------------


def handover(env, **changed):
    arguments = {"chunk_size": 8, "execution_horizon": 4, "fallback": "zero", "rate_limit": 5.0, **changed}
    return ChunkHandover(env, **arguments)


# What is told to those inside ---------------------------------------------------------------------------------


class Listener(gym.Wrapper, CommandReceiver):
    """Keeps the stamps that it is told, one per control step."""

    now_s = 0.0

    def reset(self, **how):
        self.stamps = []
        return self.env.reset(**how)

    def set_observation_time(self, observed_s):
        self.stamps.append(observed_s)


def test_whoever_is_inside_is_told_what_every_command_is_made_from():
    """Nothing before the first chunk; the chunk in force for its commands, its left-over, and while it starves."""
    env = ChunkHandover(Listener(Line()), 6, 3, 1, rate_limit=5.0, fallback="zero")
    env.reset(seed=0)
    env.step(numbered(1, 6))
    env.step(numbered(2, 6))
    for _ in range(2):
        env.set_observation_time(None)
        env.step(numbered(3, 6))
    env.set_observation_time(1.1)  # made at control step 11, there at 13
    env.step(numbered(4, 6))
    wanted = [None, 0, 0, 0, 3, 3, 3, 3, 3, 3, 3, 3, 3, 11, 11]
    told = [None if stamp is None else round(stamp / HOLD, 6) for stamp in env.env.stamps]
    assert told == wanted
