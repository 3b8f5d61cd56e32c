"""ChunkHandover against a slow simulator of its docstrings, on random scenarios; its promises, infos and refusals."""

import copy
import itertools
import math
import pickle
import warnings
from dataclasses import dataclass, field

import gymnasium as gym
import numpy as np
import pytest
from chunk_worlds import Line, Wander, counting_plant
from hypothesis import assume, given
from hypothesis import strategies as st
from slow_handover import BLENDS, Slow, measured

import safe_wrappers as sw
from safe_wrappers.errors import ActionError, ConfigurationError, UnknownNameError
from safe_wrappers.wrappers.faults import ClockSkew, DroppedRefreshes, FrozenPolicy, RepeatedCommands
from safe_wrappers.wrappers.layer import CommandReceiver, WrapperRng

HOLD = 0.1
TYPES = {
    "handover/seam_jump": "float64(3,)",
    "handover/peak_jerk": "float",
    "handover/blend_time": "float",
    "handover/starved": "int",
    "handover/limited": "int",
    "handover/stretched": "int",
    "handover/refused": "bool",
    "handover/clipped": "float",
    "handover/latency": "int",
    "handover/steps": "int",
}
pytestmark = pytest.mark.filterwarnings("ignore:a command was held back:UserWarning")


def types(info):
    return {
        k: f"{v.dtype}{v.shape}" if isinstance(v, np.ndarray) else type(v).__name__
        for k, v in info.items()
        if k.startswith("handover/")
    }


# Random scenarios ---------------------------------------------------------------------------------------------


@dataclass
class Scenario:
    size: int
    horizon: int
    delay: tuple
    blend: str
    fewest: int | None
    limit: float | None
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
        return sw.ChunkHandover(
            line,
            self.size,
            self.horizon,
            self.delay[0] if self.delay[0] == self.delay[1] else list(self.delay),
            blend=self.blend,
            blend_time=None if self.fewest is None else (self.fewest + 1) * HOLD,
            rate_limit=self.limit,
            fallback=Wander(self.seed, self.controls, self.scale) if wander else self.fallback,
            plant=counting_plant(HOLD) if wander else None,
        )

    def oracle(self):
        fewest = self.fewest or 0
        if self.fewest is None and self.limit is None and self.blend in BLENDS:
            fewest = self.size - self.horizon - self.delay[1]
        return Slow(
            HOLD,
            self.blend,
            fewest,
            math.inf if self.limit is None else self.limit,
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


EVENTS = ("fresh",) * 8 + ("nothing", "stale", "older", "future", "nan", "inf", "switch")


@st.composite
def scenarios(draw, blends=(*BLENDS, *BLENDS, "replace", "ensemble"), size=None, limited=None):
    most = draw(st.integers(0, 4)) if size is None else 0
    delay = (draw(st.integers(0, most)), most)
    horizon = draw(st.integers(max(most, 1), 6)) if size is None else 1
    chunk = horizon + most + draw(st.integers(0, 6)) if size is None else size
    blend = draw(st.sampled_from(blends))
    fewest, limit = None, None
    if blend in BLENDS:
        if draw(st.booleans()) and chunk - most > 1:
            fewest = draw(st.integers(1, chunk - most - 1))
        elif chunk == 1 and draw(st.booleans()):
            fewest = draw(st.integers(1, 5))
        nothing = fewest is None and chunk - horizon - most == 0
        if limited or nothing or (limited is None and draw(st.booleans())):
            limit = draw(st.floats(0.05, 50.0))
    bound = draw(st.sampled_from([1.0, 1.0, 0.3, math.inf]))
    return Scenario(
        chunk,
        horizon,
        delay,
        blend,
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


def act(event, env, oracle, chunk, rng, names):
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
    if event == "switch":
        name = next(names)
        env.switch(name)
        oracle.source = name
    return chunk, observed


def play(scenario):
    """One episode of both: per step the env's info and reward, and the oracle's ticks."""
    env, oracle = scenario.env(), scenario.oracle()
    env.reset(seed=scenario.seed)
    rng, delays = np.random.default_rng(scenario.seed), WrapperRng("ChunkHandover")
    delays.reset(env, scenario.seed)
    names = itertools.cycle(["human", "fallback", "policy"])
    line, steps = env.unwrapped, []
    for event in scenario.events:
        delay = int(delays.draw.integers(scenario.delay[0], scenario.delay[1] + 1))
        chunk, observed = act(event, env, oracle, scenario.chunk(rng), rng, names)
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
    figures, t = measured(given_commands, ticks, HOLD), 0
    for info, reward, own, refused in steps:
        assert types(info) == TYPES
        assert info["handover/steps"] == len(own)
        assert info["handover/starved"] == sum(tick.starved for tick in own)
        assert info["handover/limited"] == sum(tick.limited for tick in own)
        assert info["handover/refused"] == (refused or any(tick.refused for tick in own))
        latencies = [tick.latency for tick in own if tick.latency >= 0]
        assert info["handover/latency"] == (latencies[-1] if latencies else -1)
        longest = max((tick.blend_steps for tick in own), default=0)
        assert info["handover/blend_time"] == pytest.approx((longest + 1) * HOLD if longest else 0.0)
        mine = figures[t : t + len(own)]
        jumps = [max([o[k] for o, at_seam, _ in mine if at_seam], default=0.0) for k in range(3)]
        np.testing.assert_allclose(info["handover/seam_jump"], jumps, rtol=0, atol=1e-12)
        assert info["handover/peak_jerk"] == pytest.approx(max(j for _, _, j in mine), abs=1e-12)
        t += len(own)
        assert reward == pytest.approx(sum(0.5 * (k + 1) for k in range(t - len(own), t)))


@given(scenarios(blends=BLENDS, limited=True))
def test_no_two_neighbours_are_farther_apart_than_the_limit_allows(scenario):
    """Also where the simulator is not asked: ties, and numbers as coarse as the limit."""
    env, _, steps = play(scenario)
    commands = np.array(env.unwrapped.given, dtype=np.float64)
    largest = np.abs(np.diff(commands, axis=0)).max(initial=0.0)
    assert largest <= scenario.limit * HOLD
    assert max(info["handover/peak_jerk"] for info, *_ in steps) <= scenario.limit
    assert np.isfinite(commands).all()


@given(
    scenarios(blends=BLENDS, limited=True),
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


@given(scenarios(size=1))
def test_chunks_of_one_against_the_simulator(scenario):
    test_every_command_and_every_figure_is_the_slow_simulators.hypothesis.inner_test(scenario)


# Bits -----------------------------------------------------------------------------------------------------------


def run(env, chunks, seed=0):
    """The commands that were given, and the infos."""
    env.reset(seed=seed)
    infos = [env.step(chunk)[4] for chunk in chunks]
    return np.array(env.unwrapped.given), infos


@pytest.mark.parametrize("blend", BLENDS)
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_without_need_for_a_blend_the_chunks_bits_are_executed(blend, dtype):
    rng = np.random.default_rng(0)
    stream = rng.uniform(-1, 1, (40, 2)).astype(dtype)
    chunks = [stream[i : i + 8] for i in range(0, 32, 4)]  # they agree where they overlap
    env = sw.ChunkHandover(Line(2, dtype=dtype), 8, 4, 2, blend=blend, rate_limit=20.0, fallback="zero")
    commands, infos = run(env, chunks)
    assert commands[2:].tobytes() == stream[2:32].tobytes()
    assert [i["handover/limited"] for i in infos] == [0] * 8
    assert [i["handover/blend_time"] for i in infos] == [0.0] * 8
    assert [i["handover/starved"] for i in infos] == [2] + [0] * 7


def test_a_stream_at_exactly_the_limit_is_not_held_back():
    """Steps of 0.1 / s for 0.1 s are 0.25 exactly in float32: the limit itself is allowed, bit for bit."""
    stream = np.array([[0.0], [0.25], [0.5], [0.25], [0.0], [-0.25], [-0.5], [-0.75]], np.float32)
    env = sw.ChunkHandover(Line(dt=0.1), 4, 4, rate_limit=2.5, fallback="zero")
    commands, infos = run(env, [stream[:4], stream[4:]])
    assert commands.tobytes() == stream.tobytes()
    assert [i["handover/limited"] for i in infos] == [0, 0]
    assert max(i["handover/peak_jerk"] for i in infos) == 2.5


def test_ordinary_policies_pass_bit_for_bit_as_chunks_of_one():
    rng = np.random.default_rng(1)
    actions = rng.uniform(-1, 1, (50, 3)).astype(np.float32)
    env = sw.ChunkHandover(Line(3), 1, 1, rate_limit=20.0, fallback="zero")
    commands, infos = run(env, actions[:, None])
    assert commands.tobytes() == actions.tobytes()
    assert all(i["handover/blend_time"] == 0.0 and i["handover/latency"] == 0 for i in infos)
    assert not any(i["handover/seam_jump"].any() for i in infos), "no seam, nobody took over"


def test_chunks_outside_the_box_are_clipped_to_it_before_they_are_limited():
    """A policy that asks for 1000 in a box of 1 must not be a long way from -1."""
    env = sw.ChunkHandover(Line(), 4, 4, rate_limit=10.0, fallback="zero")
    up, down = np.full((4, 1), 1000.0, np.float32), np.full((4, 1), -1000.0, np.float32)
    commands, _ = run(env, [up, down])
    assert commands[:4, 0].tolist() == [1.0] * 4
    assert commands[-1, 0] == -1.0


@pytest.mark.parametrize("low", [-1.0, -np.inf])
@pytest.mark.parametrize("blend", [*BLENDS, "replace", "ensemble"])
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_numbers_beyond_the_envs_dtype_stay_finite(low, blend, dtype):
    bounds = {} if blend in ("replace", "ensemble") else {"rate_limit": 5.0}
    env = sw.ChunkHandover(
        Line(low=low, high=-low, dtype=dtype), 4, 2, blend=blend, fallback="zero", **bounds
    )
    with warnings.catch_warnings(action="error", category=RuntimeWarning):
        commands, _ = run(env, [np.full((4, 1), x) for x in (1.7e308, -1.7e308, 1e39, -3e38)])
    assert np.isfinite(commands).all()  # and the line asserts that they are in its box


# Latency by consumption -----------------------------------------------------------------------------------------


def numbered(k, size):
    """Chunk k: entry j reads 0.01 k + 0.001 j, so that a command says where it is from."""
    return np.array([[0.01 * k + 0.001 * j] for j in range(size)], np.float32)


@pytest.mark.parametrize(("size", "horizon"), [(8, 4), (6, 3), (4, 2)])
def test_what_is_executed_when_for_every_delay_up_to_the_horizon(size, horizon):
    for delay in range(min(horizon, size - horizon) + 1):
        env = sw.ChunkHandover(Line(), size, horizon, delay, blend="replace", fallback="zero")
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

    env = sw.ChunkHandover(Line(), 12, 6, [1, 4], fallback="zero", rate_limit=50.0)
    first, second = latencies(env, 3, episodes=2)
    assert set(first) == {1, 2, 3, 4} == set(second) and first != second
    assert latencies(env, 3, episodes=2) == [first, second]
    assert latencies(env, 4) != [first]
    again = sw.ChunkHandover(Line(), 12, 6, [1, 4], fallback="zero", rate_limit=50.0)
    assert latencies(again, 3) == [first]


def test_the_delays_leave_the_envs_own_random_numbers_alone():
    bare, env = Line(), sw.ChunkHandover(Line(), 8, 4, [0, 4], blend="replace", fallback="zero")
    for seed in (5, None, None, 6):
        seen = [bare.reset(seed=seed)[0].tolist()]
        mine = [env.reset(seed=seed)[0].tolist()]
        for k in range(3):
            mine.append(env.step(numbered(k, 8))[0].tolist())
            seen.append([bare.step(np.zeros(1, np.float32))[0].tolist() for _ in range(4)][-1])
        assert mine == seen


def test_without_any_seed_the_delays_come_from_the_envs_own_seed():
    a = sw.ChunkHandover(Line(), 12, 6, [1, 4], fallback="zero", blend="replace")
    b = sw.ChunkHandover(Line(), 12, 6, [1, 4], fallback="zero", blend="replace")
    a.reset()
    b.reset(seed=int(a.unwrapped.np_random_seed))
    play_ = [[e.step(numbered(k, 12))[4]["handover/latency"] for k in range(20)] for e in (a, b)]
    assert play_[0] == play_[1]


def test_a_stale_stamp_is_consumed_from_its_age_on():
    env = sw.ChunkHandover(Line(), 8, 2, blend="replace", fallback="zero")
    env.reset(seed=0)
    env.step(numbered(1, 8))
    env.step(numbered(2, 8))
    assert env.now_s == pytest.approx(0.4)
    env.set_observation_time(0.3)  # made at control step 3, there at 4: its entry 1
    info = env.step(numbered(3, 8))[4]
    assert info["handover/latency"] == 1 and not info["handover/refused"]
    np.testing.assert_array_equal(env.unwrapped.given[4:], numbered(3, 8)[1:3])


@pytest.mark.parametrize(
    ("stamp", "why"),
    [(0.0, "old"), (0.4, "a repeat"), (0.39, "a repeat"), (0.7, "the future"), (-1.0, "old")],
)
def test_chunks_that_are_not_newer_or_from_the_future_are_refused(stamp, why):
    env = sw.ChunkHandover(Line(), 8, 2, blend="replace", fallback="zero")
    env.reset(seed=0)
    for k in (1, 2, 3):
        env.step(numbered(k, 8))  # the third is from 0.4 s
    env.set_observation_time(stamp)
    info = env.step(numbered(4, 8))[4]
    assert info["handover/refused"] and info["handover/latency"] == -1, why
    np.testing.assert_array_equal(env.unwrapped.given[6:], numbered(3, 8)[2:4])
    assert not env.step(numbered(5, 8))[4]["handover/refused"], "the next one, fresh, is welcome"


def test_nothing_delivered_is_no_refusal():
    env = sw.ChunkHandover(Line(), 8, 2, blend="replace", fallback="zero")
    env.reset(seed=0)
    env.step(numbered(1, 8))
    env.set_observation_time(None)
    info = env.step(np.full((8, 1), np.nan))[4]
    assert not info["handover/refused"] and info["handover/starved"] == 0
    np.testing.assert_array_equal(env.unwrapped.given[2:], numbered(1, 8)[2:4])


def test_a_reset_forgets_chunks_stamps_and_commands():
    env = sw.ChunkHandover(Line(), 8, 4, 4, rate_limit=0.5, fallback="zero")
    fresh, _ = run(env, [numbered(k, 8) for k in range(4)])
    env.reset(seed=0)
    env.step(np.ones((8, 1), np.float32))
    env.set_observation_time(None)
    again, infos = run(env, [numbered(k, 8) for k in range(4)])
    assert again.tobytes() == fresh.tobytes()
    assert infos[0]["handover/starved"] == 4


def test_an_episode_does_not_begin_with_the_last_ones_command():
    env = sw.ChunkHandover(Line(), 8, 4, 2, rate_limit=50.0, fallback="hold")
    run(env, [np.full((8, 1), 0.5, np.float32)] * 2)
    commands, _ = run(env, [np.full((8, 1), 0.5, np.float32)])
    assert commands[:, 0].tolist() == [0.0, 0.0, 0.5, 0.5]


# Starvation -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("where", [0, 5, 11])
def test_a_chunk_with_one_bad_entry_is_refused_whole_then_left_over_then_fallback(bad, where):
    env = sw.ChunkHandover(Line(), 12, 4, blend="replace", fallback="hold")
    env.reset(seed=0)
    env.step(numbered(1, 12))
    broken = numbered(2, 12)
    broken[where] = bad
    infos = [env.step(broken)[4] for _ in range(3)]
    assert [i["handover/refused"] for i in infos] == [True] * 3
    assert [i["handover/starved"] for i in infos] == [0, 0, 4]
    np.testing.assert_array_equal(env.unwrapped.given[:12], numbered(1, 12))
    assert [float(c[0]) for c in env.unwrapped.given[12:]] == [float(np.float32(0.021))] * 4


@pytest.mark.parametrize("blend", BLENDS)
def test_into_the_fallback_and_back_is_bumpless(blend):
    limit = 1.0
    env = sw.ChunkHandover(Line(), 8, 4, blend=blend, rate_limit=limit, fallback="zero")
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
    assert back["handover/latency"] == 0 and back["handover/seam_jump"][0] > 0.0


def test_at_the_start_of_an_episode_the_fallback_acts_until_a_chunk_is_there():
    env = sw.ChunkHandover(
        Line(), 8, 4, 3, rate_limit=50.0, fallback=Wander(1, 1, 0.2), plant=counting_plant()
    )
    commands, infos = run(env, [np.full((8, 1), 0.1, np.float32)] * 2)
    np.testing.assert_allclose(commands[:3, 0], [Wander(1, 1, 0.2).at(k)[0] for k in range(3)], atol=1e-7)
    assert [i["handover/starved"] for i in infos] == [3, 0]


@pytest.mark.parametrize("value", [np.nan, np.inf, 1e300])
def test_a_broken_fallback_sends_nothing_that_is_not_finite(value):
    env = sw.ChunkHandover(
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


# Mode switches --------------------------------------------------------------------------------------------------


def test_a_human_takes_over_and_gives_back_bumplessly():
    limit = 2.0
    env = sw.ChunkHandover(Line(), 1, 1, rate_limit=limit, fallback="zero")
    env.reset(seed=0)
    sent = []

    def go(value, times):
        infos = [env.step(np.full((1, 1), value, np.float32))[4] for _ in range(times)]
        sent.extend(float(c[0]) for c in env.unwrapped.given[-times:])
        return infos

    go(0.8, 3)
    env.switch("human")
    human = go(-0.6, 20)
    env.switch("policy")
    policy = go(0.8, 20)
    assert np.abs(np.diff(sent)).max() <= limit * HOLD
    steps = math.ceil(1.875 * 1.4 / limit / HOLD - 1e-6) - 1
    for infos, start, a, b in ((human, 3, 0.8, -0.6), (policy, 23, -0.6, 0.8)):
        assert infos[0]["handover/blend_time"] == pytest.approx((steps + 1) * HOLD)
        assert not any(i["handover/blend_time"] for i in infos[1:])
        assert not any(i["handover/limited"] for i in infos)
        alpha = [BLEND(i / (steps + 1)) for i in range(1, steps + 1)]
        np.testing.assert_allclose(sent[start : start + steps], [a + x * (b - a) for x in alpha], atol=1e-6)
        assert sent[start + steps] == np.float32(b)


def BLEND(s):  # noqa: N802
    return 10 * s**3 - 15 * s**4 + 6 * s**5


def test_a_switch_to_the_same_source_is_none():
    env = sw.ChunkHandover(Line(), 1, 1, blend_time=0.5, fallback="zero")
    env.reset(seed=0)
    env.switch("human")
    env.step(np.full((1, 1), 0.5, np.float32))
    env.switch("human")
    assert env.step(np.full((1, 1), -0.5, np.float32))[4]["handover/blend_time"] == 0.0
    assert float(env.unwrapped.given[-1][0]) == -0.5


def test_a_switch_waits_for_the_new_sources_chunk():
    """With a delay the old source's left-over goes on bit for bit until the new one's chunk is there."""
    rng = np.random.default_rng(0)
    stream = rng.uniform(-0.1, 0.1, (16, 1)).astype(np.float32)
    env = sw.ChunkHandover(Line(), 8, 4, 2, rate_limit=3.0, fallback="hold")
    env.reset(seed=0)
    env.step(stream[:8])
    env.switch("human")
    env.step(np.full((8, 1), 0.9, np.float32))
    given_commands = np.array(env.unwrapped.given)
    assert given_commands[2:6].tobytes() == stream[2:6].tobytes()
    assert given_commands[6] != stream[6]


def test_a_source_may_be_called_anything():
    env = sw.ChunkHandover(Line(), 1, 1, blend_time=0.5, fallback="zero")
    env.reset(seed=0)
    env.switch("fallback")
    env.step(np.full((1, 1), 0.5, np.float32))
    env.set_observation_time(None)
    info = env.step(np.full((1, 1), 0.5, np.float32))[4]
    assert info["handover/starved"] == 1 and info["handover/blend_time"] == 0.5
    assert 0.0 < float(env.unwrapped.given[-1][0]) < 0.5


def test_blend_time_is_the_least_duration_rounded_up():
    for given_time, lasts in ((0.2, 0.2), (0.21, 0.3), (0.3, 0.3), (0.05, 0.2), (0.24999, 0.3)):
        env = sw.ChunkHandover(Line(), 8, 4, blend_time=given_time, fallback="zero")
        _, infos = run(env, [numbered(k, 8) for k in range(2)])
        assert infos[1]["handover/blend_time"] == pytest.approx(lasts)


# Infos ----------------------------------------------------------------------------------------------------------


def test_reset_reports_the_same_keys_and_types_as_a_step():
    env = sw.ChunkHandover(Line(), 4, 2, rate_limit=5.0, fallback="zero")
    info = env.reset(seed=0)[1]
    assert types(info) == TYPES == types(env.step(numbered(0, 4))[4])
    assert not info["handover/seam_jump"].any() and info["handover/latency"] == -1
    info["handover/seam_jump"][:] = 9.0
    assert not env.reset()[1]["handover/seam_jump"].any()


@pytest.mark.parametrize("ends_at", [1, 2, 5, 8])
def test_an_episode_may_end_inside_a_chunk(ends_at):
    def infos(line):
        return {"cost": float(line.steps)}

    env = sw.ChunkHandover(Line(ends_at=ends_at, infos=infos), 8, 4, 1, rate_limit=5.0, fallback="zero")
    env.reset(seed=0)
    done, steps, rewards, cost = False, [], 0.0, 0.0
    while not done:
        observation, reward, done, truncated, info = env.step(numbered(1, 8))
        steps.append(info["handover/steps"])
        rewards, cost = rewards + reward, cost + info["cost"]
        assert type(reward) is float and not truncated
    assert sum(steps) == ends_at == len(env.unwrapped.given) == observation[0]
    assert rewards == 0.5 * cost == 0.5 * sum(range(1, ends_at + 1))


def test_truncation_inside_a_chunk():
    env = sw.ChunkHandover(gym.wrappers.TimeLimit(Line(), 6), 8, 4, rate_limit=5.0, fallback="zero")
    env.reset(seed=0)
    assert env.step(numbered(1, 8))[2:4] == (False, False)
    _, reward, terminated, truncated, info = env.step(numbered(1, 8))
    assert truncated and not terminated and info["handover/steps"] == 2 and reward == 0.5 * (5 + 6)


def test_what_was_executed_is_measured_not_what_was_sent():
    """A filter inside changes the commands: the figures are its, the limit is kept by what was sent."""

    class Flips(gym.Wrapper):
        def step(self, action):
            done = -action if self.unwrapped.steps % 2 else action
            observation, reward, terminated, truncated, info = self.env.step(done)
            info["executed_action"] = done
            return observation, reward, terminated, truncated, info

    env = sw.ChunkHandover(Flips(Line()), 4, 2, rate_limit=5.0, fallback="zero")
    commands, infos = run(env, [np.full((4, 1), 0.5, np.float32)] * 3)
    assert np.abs(commands).tolist() == [[0.5]] * 6
    assert [i["handover/peak_jerk"] for i in infos] == [10.0] * 3
    assert infos[0]["handover/seam_jump"].tolist() == [0.0] * 3
    assert infos[1]["handover/seam_jump"].tolist() == [1.0, 2.0, 4.0]


def test_a_seam_ends_the_blend_before_it_and_its_window():
    """A blend of nine is cut off by a chunk that needs one of one: what comes later is nobody's seam."""
    a, b = np.zeros((14, 1), np.float32), np.full((14, 1), 1.0, np.float32)
    env = sw.ChunkHandover(Line(), 14, 2, rate_limit=2.0, fallback="zero")
    env.reset(seed=0)
    env.step(a)
    infos = [env.step(b)[4]]
    at = float(env.unwrapped.given[-1][0])
    late = np.full((14, 1), at, np.float32)
    late[7:] += 0.1
    infos += [env.step(late)[4]]
    for _ in range(3):
        env.set_observation_time(None)
        infos.append(env.step(late)[4])
    assert infos[0]["handover/blend_time"] == pytest.approx(1.0)
    assert infos[1]["handover/blend_time"] == 0.0
    assert [bool(i["handover/peak_jerk"]) for i in infos] == [True, False, False, False, True]
    assert not infos[4]["handover/seam_jump"].any(), "the chunk's own step, five control steps after the seam"


def test_it_says_once_that_commands_are_held_back():
    env = sw.ChunkHandover(Line(), 4, 4, rate_limit=1.0, fallback="zero")
    env.reset(seed=0)
    with pytest.warns(UserWarning, match=r"rate_limit.*handover/limited"):
        env.step(np.array([[-1.0], [1.0], [-1.0], [1.0]], np.float32))
    with warnings.catch_warnings(action="error"):
        assert env.step(np.array([[-1.0], [1.0], [-1.0], [1.0]], np.float32))[4]["handover/limited"] > 0


def test_the_chunk_that_was_given_is_not_changed_and_may_be_reused():
    chunk = np.linspace(-2, 2, 8).reshape(8, 1).astype(np.float32)
    before = chunk.tobytes()
    env = sw.ChunkHandover(Line(), 8, 2, rate_limit=0.3, fallback="zero")
    env.reset(seed=0)
    for _ in range(4):
        env.step(chunk)
        assert chunk.tobytes() == before
    wanted = np.array(env.unwrapped.given)
    env.reset(seed=0)
    for _ in range(4):
        mine = chunk.copy()
        env.step(mine)
        mine[:] = 7.0
    np.testing.assert_array_equal(np.array(env.unwrapped.given), wanted)


# Ensembling and replacement -------------------------------------------------------------------------------------


@pytest.mark.parametrize("delay", [0, 2])
@pytest.mark.parametrize("decay", [0.0, 0.01, 0.5])
def test_temporal_ensembling_by_its_formula(delay, decay):
    """w_i = exp(-decay i) over what every chunk at hand says of this control step, i = 0 the oldest."""
    rng, size, horizon = np.random.default_rng(0), 9, 2
    chunks = rng.uniform(-1, 1, (8, size, 2)).astype(np.float32)
    env = sw.ChunkHandover(Line(2), size, horizon, delay, blend="ensemble", decay=decay, fallback="zero")
    commands, infos = run(env, chunks)
    for t, command in enumerate(commands):
        top, bottom, i = np.zeros(2), 0.0, 0
        for k in range(len(chunks)):
            observed = k * horizon
            if observed + delay <= t < observed + size:
                weight = math.exp(-decay * i)
                top, bottom, i = top + weight * chunks[k][t - observed], bottom + weight, i + 1
        np.testing.assert_allclose(command, top / bottom if i else 0.0, rtol=0, atol=1e-6)
    assert sum(i["handover/starved"] for i in infos) == delay


def test_two_chunks_that_are_there_at_once_both_count_in_the_ensemble():
    """The first takes the whole horizon, the second none: both are there at control step 2."""

    env = sw.ChunkHandover(Line(), 6, 2, [0, 2], blend="ensemble", decay=0.0, fallback="zero")
    delays = WrapperRng("ChunkHandover")
    for seed in range(100):
        delays.reset(env, seed)
        if [int(delays.draw.integers(0, 3)) for _ in range(2)] == [2, 0]:
            break
    env.reset(seed=seed)
    env.step(np.full((6, 1), 0.2, np.float32))
    env.step(np.full((6, 1), 0.4, np.float32))
    np.testing.assert_allclose([c[0] for c in env.unwrapped.given], [0.0, 0.0, 0.3, 0.3], atol=1e-6)


def test_replacement_is_the_new_chunk_at_once_and_its_seam_is_measured():
    env = sw.ChunkHandover(Line(), 4, 2, blend="replace", fallback="zero")
    commands, infos = run(env, [np.full((4, 1), x, np.float32) for x in (1.0, -1.0)])
    assert commands[:, 0].tolist() == [1.0, 1.0, -1.0, -1.0]
    assert infos[0]["handover/seam_jump"].tolist() == [0.0, 0.0, 0.0]
    assert infos[1]["handover/seam_jump"].tolist() == [2.0, 2.0, 4.0]
    assert infos[1]["handover/peak_jerk"] == pytest.approx(20.0)


# Order and construction -----------------------------------------------------------------------------------------


def handover(env, **changed):
    arguments = {"chunk_size": 8, "execution_horizon": 4, "fallback": "zero", "rate_limit": 5.0, **changed}
    return sw.ChunkHandover(env, **arguments)


@pytest.mark.parametrize(
    ("changed", "says"),
    [
        ({"execution_horizon": 9}, "chunk_size .*= 8.*choose it up to 8"),
        ({"inference_delay": 5}, "d <= s <= H - d.*no s fits, choose H >= 10"),
        ({"inference_delay": [0, 5], "execution_horizon": 8}, "d <= s <= H - d"),
        ({"inference_delay": 3, "execution_horizon": 6}, "choose s from 3 to 5"),
        ({"inference_delay": 3, "execution_horizon": 2}, "choose s from 3 to 5"),
        ({"inference_delay": 1, "execution_horizon": 8}, "choose s from 1 to 7"),
        ({"inference_delay": 9, "execution_horizon": 8}, "has 0 commands"),
        ({"inference_delay": -1}, "inference_delay .* at least 0; got -1"),
        ({"inference_delay": [2, 1]}, r"\[least, most\]"),
        ({"inference_delay": [1]}, r"\[least, most\]"),
        ({"inference_delay": [0, 1, 2]}, r"\[least, most\]"),
        ({"inference_delay": []}, r"\[least, most\]"),
        ({"inference_delay": [-1, 2]}, "at least 0; got -1"),
        ({"inference_delay": ["a", 2]}, "at least 0; got 'a'"),
        ({"inference_delay": [0, True]}, "got True"),
        ({"inference_delay": 0.5}, "got 0.5"),
        ({"inference_delay": None}, "got None"),
        ({"chunk_size": True, "execution_horizon": 1}, "chunk_size .* at least 1; got True"),
        ({"execution_horizon": True}, "execution_horizon .* at least 1; got True"),
        ({"chunk_size": 0}, "at least 1; got 0"),
        ({"chunk_size": -4}, "at least 1; got -4"),
        ({"chunk_size": 8.0}, "got 8.0"),
        ({"execution_horizon": 0}, "at least 1; got 0"),
        ({"execution_horizon": -1}, "at least 1; got -1"),
        ({"execution_horizon": "4"}, "got '4'"),
        ({"blend": "linear"}, "no blend 'linear'; choose smoothstep, quintic, hermite, replace, ensemble"),
        ({"blend": None}, "no blend None"),
        ({"blend": "replace"}, "baseline that bounds nothing.*smoothstep"),
        ({"blend": "ensemble", "rate_limit": None, "blend_time": 0.3}, "baseline that bounds nothing"),
        ({"rate_limit": 0.0}, "rate_limit .*> 0"),
        ({"rate_limit": -1.0}, "rate_limit .*> 0"),
        ({"rate_limit": math.nan}, "rate_limit .*finite"),
        ({"rate_limit": math.inf}, "rate_limit .*finite"),
        ({"rate_limit": "fast"}, "rate_limit .*number"),
        ({"rate_limit": [5.0, 5.0]}, "one for each of the 1 action components"),
        ({"rate_limit": []}, "one for each of the 1 action components"),
        ({"rate_limit": [-1.0]}, "rate_limit .*> 0"),
        ({"rate_limit": [[1.0]]}, "rate_limit .*number"),
        ({"rate_limit": 1e-7}, "float32 resolves.*choose a larger one"),
        ({"blend_time": 0.0}, "blend_time .*> 0"),
        ({"blend_time": -0.1}, "blend_time .*> 0"),
        ({"blend_time": math.nan}, "blend_time .*finite"),
        ({"blend_time": 0.9}, "blend_time = 0.9 s is longer.*8 control steps.*choose a longer chunk_size"),
        ({"blend_time": 0.7, "inference_delay": 3}, "5 control steps"),
        (
            {"rate_limit": None, "execution_horizon": 8},
            "no left-over to blend with: pass rate_limit or blend_time",
        ),
        ({"rate_limit": None, "execution_horizon": 5, "inference_delay": [0, 3]}, "no left-over"),
        ({"rate_limit": None, "chunk_size": 1, "execution_horizon": 1}, "no left-over"),
        ({"control_dt": 0.2}, "dt = 0.1"),
        ({"control_dt": 0.0}, "control_dt .*> 0"),
        ({"decay": -0.1, "blend": "ensemble", "rate_limit": None}, "decay .*>= 0"),
        ({"decay": math.nan, "blend": "ensemble", "rate_limit": None}, "decay .*finite"),
        ({"fallback": "sleep"}, "no fallback 'sleep'; choose brake, hold, zero"),
        ({"fallback": "brake"}, "(?i)mujoco"),
        ({"plant": 3}, "plant is a MujocoPlant"),
    ],
)
def test_bad_arguments_are_refused_with_a_way_out(changed, says):
    with pytest.raises(ConfigurationError, match=says):
        handover(Line(), **changed)


@pytest.mark.parametrize("limit", [[5.0, 1e-7], [1e-7, 5.0]])
def test_every_component_needs_a_limit_that_its_numbers_resolve(limit):
    with pytest.raises(ConfigurationError, match="float32 resolves"):
        handover(Line(2), rate_limit=limit)


def test_the_longest_blend_time_that_fits_is_accepted():
    assert handover(Line(), blend_time=0.8, rate_limit=None).control_dt == HOLD
    assert handover(Line(), blend_time=0.5, inference_delay=3, rate_limit=None).chunk_size == 8


def test_an_env_that_does_not_say_how_long_a_step_lasts_needs_control_dt():
    class Timeless(Line):
        def __init__(self):
            super().__init__()
            del self.dt

    with pytest.raises(ConfigurationError, match="pass control_dt"):
        handover(Timeless())
    env = handover(Timeless(), control_dt=0.02)
    env.reset(seed=0)
    env.step(numbered(0, 8))
    assert env.now_s == pytest.approx(0.08)


@pytest.mark.parametrize(
    "space", [gym.spaces.Discrete(3), gym.spaces.Box(-1, 1, (2, 2)), gym.spaces.Box(0, 5, (2,), np.int64)]
)
def test_other_action_spaces_are_refused(space):
    env = Line()
    env.action_space = space
    with pytest.raises(ConfigurationError):
        handover(env)


@pytest.mark.parametrize(
    "chunk",
    [
        np.zeros((4, 1)),
        np.zeros((8, 2)),
        np.zeros(8),
        np.zeros((1, 8, 1)),
        0.0,
        None,
        "go",
        [[1.0], [2.0, 3.0]],
        {},
    ],
)
def test_wrong_shapes_are_refused_and_the_env_is_not_stepped(chunk):
    env = handover(Line())
    env.reset(seed=0)
    with pytest.raises(ActionError, match=r"expected a chunk of shape \(8, 1\)"):
        env.step(chunk)
    assert env.unwrapped.given == []
    assert env.step([[0.25]] * 8)[4]["handover/latency"] == 0, "a list of the right shape is a chunk"


@pytest.mark.parametrize("stamp", [math.nan, math.inf])
def test_stamps_are_times(stamp):
    env = handover(Line())
    env.reset(seed=0)
    with pytest.raises(ActionError, match="time in seconds"):
        env.set_observation_time(stamp)


def test_a_step_before_the_first_reset_is_refused():
    with pytest.raises(gym.error.ResetNeeded, match="reset"):
        handover(Line()).step(numbered(0, 8))


def reacher(**arguments):
    return sw.ChunkHandover(gym.make("Reacher-v5"), 8, 4, rate_limit=20.0, **arguments)


@pytest.mark.parametrize(
    "outer",
    [
        lambda env: sw.CBFActionFilter(env, [sw.constraints.JointSpeedLimit(4.0)]),
        lambda env: sw.LeaseExpiry(
            env, sw.StoppingBudget(lambda e: ([1.0], [0.0]), braking=1.0, acceleration=1.0)
        ),
        sw.RecordInterventions,
        lambda env: sw.AdaptionPenalty(env, penalty=1.0),
        lambda env: sw.ChunkHandover(env, 8, 4, rate_limit=20.0),
    ],
)
@pytest.mark.parametrize("between", [lambda env: env, lambda env: gym.wrappers.TimeLimit(env, 5)])
def test_orders_known_to_be_wrong_are_refused(outer, between):
    with pytest.raises(ConfigurationError):
        outer(between(reacher()))


@pytest.mark.parametrize(
    ("outer", "says"),
    [
        (sw.RecordInterventions, r"ChunkHandover\(RecordInterventions"),
        (lambda env: sw.AdaptionPenalty(env, penalty=1.0), r"ChunkHandover\(AdaptionPenalty"),
        (lambda env: sw.ChunkHandover(env, 8, 4, rate_limit=20.0), "takes chunks already"),
    ],
)
def test_wrong_orders_are_named(outer, says):
    with pytest.raises(ConfigurationError, match=says):
        outer(reacher())


def test_a_spec_holds_plain_data():
    env = sw.ChunkHandover(gym.make("Reacher-v5"), np.int64(8), np.int32(4), (1, 2), rate_limit=20.0)
    kwargs = env.spec.additional_wrappers[-1].kwargs
    assert kwargs["inference_delay"] == [1, 2] and type(kwargs["chunk_size"]) is int
    assert (
        gym.make(gym.envs.registration.EnvSpec.from_json(env.spec.to_json())).action_space == env.action_space
    )


@pytest.mark.parametrize(
    "limit",
    [
        5,
        np.float32(5),
        np.array(5.0),
        np.array([5.0, 6.0], np.float32),
        [5, 6.0],
        (5.0, 6.0),
        [np.float32(5), 6],
    ],
)
def test_limits_may_be_numpys_and_are_recorded_as_plain_numbers(limit):
    env = sw.ChunkHandover(
        gym.make("Reacher-v5"),
        8,
        4,
        rate_limit=limit,
        blend_time=np.float32(0.1),
        control_dt=np.float64(0.02),
    )
    again = gym.make(gym.envs.registration.EnvSpec.from_json(env.spec.to_json()))
    recorded = again.spec.additional_wrappers[-1].kwargs["rate_limit"]
    assert np.broadcast_to(recorded, 2).tolist() == np.broadcast_to(np.asarray(limit, float), 2).tolist()


def test_each_component_keeps_its_own_limit():
    limits = np.array([2.0, 0.5])
    env = sw.ChunkHandover(Line(2), 8, 4, 2, rate_limit=limits, fallback="zero")
    rng = np.random.default_rng(0)
    commands, _ = run(env, rng.uniform(-1, 1, (20, 8, 2)).astype(np.float32))
    steps = np.abs(np.diff(commands.astype(np.float64), axis=0)).max(axis=0)
    assert (steps <= limits * HOLD).all() and (steps > 0.8 * limits * HOLD).all()


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_a_bad_entry_of_a_slower_policy_refuses_its_chunk(bad):
    env = sw.ChunkHandover(Line(), 4, 3, rate_limit=5.0, fallback="zero", steps_per_entry=3)
    env.reset(seed=0)
    chunk = numbered(1, 4)
    chunk[3] = bad
    info = env.step(chunk)[4]
    assert info["handover/refused"] and info["handover/starved"] == 3


def test_in_the_middle_of_an_episode_it_can_be_pickled():
    env = sw.ChunkHandover(Line(), 8, 4, [0, 3], rate_limit=2.0, fallback="zero")
    env.reset(seed=2)
    rng = np.random.default_rng(0)
    chunks = rng.uniform(-1, 1, (10, 8, 1)).astype(np.float32)
    for chunk in chunks[:5]:
        env.step(chunk)
    for twin in (pickle.loads(pickle.dumps(env)), copy.deepcopy(env)):
        for chunk in chunks[5:]:
            twin.step(chunk)
        wanted = copy.deepcopy(env)
        for chunk in chunks[5:]:
            wanted.step(chunk)
        assert np.array(twin.unwrapped.given).tobytes() == np.array(wanted.unwrapped.given).tobytes()


# The chunk seams' bugs seen in others ---------------------------------------------------------------------------


def test_bug_latency_is_measured_consumption_not_an_estimate():
    """Declared to come at once, stamped two control steps old: entry 2 is next, whatever was declared."""
    env = sw.ChunkHandover(Line(), 8, 4, 0, blend="replace", fallback="zero")
    env.reset(seed=0)
    env.step(numbered(1, 8))
    env.set_observation_time(0.2)
    info = env.step(numbered(2, 8))[4]
    np.testing.assert_array_equal(env.unwrapped.given[4:], numbered(2, 8)[2:6])
    assert info["handover/latency"] == 2


def test_bug_left_over_is_not_padded_with_zeros():
    """A left-over of two under a blend of five: it starts from the last command and never heads for zero."""
    env = sw.ChunkHandover(Line(), 8, 6, blend_time=0.6, fallback="zero")
    commands, _ = run(env, [np.full((8, 1), 0.5, np.float32), np.full((8, 1), 0.9, np.float32)])
    assert commands.min() == 0.5 and (np.diff(commands[6:12, 0]) >= 0).all()


def test_bug_blend_weight_is_not_constant():
    env = sw.ChunkHandover(Line(), 12, 6, blend_time=0.6, fallback="zero")
    commands, _ = run(env, [np.full((12, 1), x, np.float32) for x in (0.0, 0.8)])
    weights = commands[6:12, 0] / 0.8
    np.testing.assert_allclose(weights, [BLEND(i / 6) for i in range(1, 7)], atol=1e-6)


def test_bug_an_empty_queue_never_sends_nothing():
    """Every control step of every step has a command, though nothing ever comes."""
    env = sw.ChunkHandover(Line(), 8, 4, 2, rate_limit=5.0, fallback="zero")
    env.reset(seed=0)
    for _ in range(5):
        env.set_observation_time(None)
        assert env.step(numbered(1, 8))[4]["handover/starved"] == 4
    assert len(env.unwrapped.given) == 20


def test_bug_a_latency_spike_is_forgotten():
    """One chunk that is three control steps old does not age the next ones."""
    env = sw.ChunkHandover(Line(), 8, 4, 1, blend="replace", fallback="zero")
    env.reset(seed=0)
    latencies = []
    for k in range(5):
        if k == 2:
            env.set_observation_time(env.now_s - 0.2)
        latencies.append(env.step(numbered(k, 8))[4]["handover/latency"])
    assert latencies == [1, 1, 3, 1, 1]


@pytest.mark.parametrize("horizon", [-1, -8, 0])
def test_bug_negative_execution_horizons_are_refused(horizon):
    with pytest.raises(ConfigurationError, match="execution_horizon"):
        handover(Line(), execution_horizon=horizon)


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
    env = sw.ChunkHandover(Listener(Line()), 6, 3, 1, rate_limit=5.0, fallback="zero")
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


@pytest.mark.parametrize("between", [lambda env: env, lambda env: DroppedRefreshes(env, 0.0)])
def test_admission_inside_refuses_a_chunk_and_the_left_over_goes_on(between):
    def reached(env):
        return np.zeros(1), np.zeros(1)

    lease = sw.LeaseExpiry(
        Line(),
        sw.StoppingBudget(lambda env: ([9.0], [0.0]), braking=1.0, acceleration=1.0),
        motion_limits={"max_speed": 1.0, "max_acceleration": 10.0},
        measured=reached,
        fallback="zero",
    )
    env = sw.ChunkHandover(between(lease), 6, 3, rate_limit=5.0, fallback="zero")
    env.reset(seed=0)
    assert not env.step(np.full((6, 1), 0.1, np.float32))[4]["handover/refused"]
    far = env.step(np.full((6, 1), 0.9, np.float32))[4]  # 0.6 s at 1 per second
    assert far["handover/refused"] and far["lease/refused"] and far["handover/latency"] == -1
    assert [float(c[0]) for c in env.unwrapped.given] == [float(np.float32(0.1))] * 6


# Faults outside -------------------------------------------------------------------------------------------------


def test_a_frozen_policy_runs_dry_and_the_fallback_acts():
    env = sw.ChunkHandover(Line(), 8, 4, rate_limit=5.0, fallback="zero")
    frozen = FrozenPolicy(env, mean_between_s=1e-9, mean_length_s=1e9)
    frozen.reset(seed=0)
    infos = [frozen.step(np.full((8, 1), 0.3, np.float32))[4] for _ in range(6)]
    assert infos[-1]["handover/starved"] == 4
    assert float(env.unwrapped.given[-1][0]) == 0.0


def test_a_repeated_chunk_is_refused():
    env = RepeatedCommands(sw.ChunkHandover(Line(), 8, 4, rate_limit=5.0, fallback="zero"), share=0.5)
    env.reset(seed=0)
    infos = [env.step(numbered(k, 8))[4] for k in range(40)]
    again = [i["fault/active"] for i in infos]
    assert any(again) and not all(again)
    assert [i["handover/refused"] for i in infos][1:] == again[1:]


def test_unknown_names_are_unknown_names():
    with pytest.raises(UnknownNameError):
        handover(Line(), blend="cubic")


def test_an_ordinary_policys_action_is_a_chunk_of_one():
    one = gym.make("Reacher-v5")
    env = sw.ChunkHandover(gym.make("Reacher-v5"), 1, 1, rate_limit=1e6)
    one.reset(seed=0)
    env.reset(seed=0)
    one.action_space.seed(0)
    for _ in range(10):
        action = one.action_space.sample()
        assert np.array_equal(one.step(action)[0], env.step(action)[0])
    with pytest.raises(ActionError, match=r"\(1, 2\)"):
        env.step(np.zeros(3))
    pair = sw.ChunkHandover(gym.make("Reacher-v5"), 2, 1, rate_limit=1.0)
    pair.reset(seed=0)
    with pytest.raises(ActionError, match=r"\(2, 2\)"):
        pair.step(np.zeros(2))


@pytest.mark.parametrize(("allowed_s", "refused"), [(0.0, True), (0.025, True), (0.03, False), (1.0, False)])
def test_a_clock_that_is_ahead_is_forgiven_as_far_as_it_is_declared(allowed_s, refused):
    arm = sw.ChunkHandover(gym.make("FlexJointReach-v0"), 8, 4, rate_limit=50.0, clock_error_s=allowed_s)
    env = ClockSkew(arm, offset_s=0.03)  # three control steps
    env.reset(seed=0)
    assert gym.make(arm.spec).get_wrapper_attr("_clock_error_s") == allowed_s
    for _ in range(5):
        info = env.step(np.zeros((8, 2), np.float32))[4]
        assert info["handover/refused"] is refused
        assert info["handover/starved"] == (4 if refused else 0)
        assert info["handover/latency"] == (-1 if refused else 0)


def test_a_clock_error_is_a_time():
    with pytest.raises(ConfigurationError, match="clock_error_s"):
        sw.ChunkHandover(gym.make("Reacher-v5"), 8, 4, rate_limit=50.0, clock_error_s=-0.1)
