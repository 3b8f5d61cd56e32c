"""ChunkHandover against a slow simulator of its docstrings; a machine's limits; slow chunks; ends within reach."""

import math
from types import SimpleNamespace

import gymnasium as gym
import mujoco
import numpy as np
import pytest
import ruckig
from hypothesis import assume, given
from hypothesis import strategies as st
from scipy.interpolate import BPoly, CubicHermiteSpline
from slow_handover import Slow, smooth

import safe_wrappers as sw
from safe_wrappers.errors import ConfigurationError, UnsupportedEnvError
from safe_wrappers.wrappers.layer import CommandReceiver, WrapperRng

HOLD = 0.1
pytestmark = pytest.mark.filterwarnings("ignore:a command was held back:UserWarning")


class Line(gym.Env):
    """Every command counts, and is kept."""

    def __init__(self, controls=1, bound=1.0, dtype=np.float64, dt=HOLD, ends_at=None):
        self.dt, self.ends_at = dt, ends_at
        self.action_space = gym.spaces.Box(-bound, bound, (controls,), dtype)
        self.observation_space = gym.spaces.Box(-np.inf, np.inf, (1,), np.float64)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.given = []
        return np.zeros(1), {}

    def step(self, action):
        assert isinstance(action, np.ndarray) and action.dtype == self.action_space.dtype
        assert np.isfinite(action).all() and self.action_space.contains(action), action
        self.given.append(action.copy())
        steps = len(self.given)
        return np.array([steps]), 0.5 * steps, steps == self.ends_at, False, {}


def handed(env, chunks, horizon=None, **options):
    """The infos of some chunks, and the commands that the env got."""
    options = {"fallback": "hold", **options}
    env = sw.ChunkHandover(env, len(chunks[0]), horizon or len(chunks[0]), **options)
    env.reset(seed=0)
    infos = [env.step(chunk)[4] for chunk in chunks]
    return infos, np.array(env.unwrapped.given)


def blend_steps(sent, chunk):
    """Commands that are sent before the chunk's own."""
    differ = (sent[: len(chunk)] != chunk[: len(sent)]).any(axis=1)
    return int(np.flatnonzero(differ).max(initial=-1)) + 1


# Against the slow simulator -------------------------------------------------------------------------------------


def unmoved(fallback):
    """A fallback of one's own, on a plant that it does not look at."""
    plant = sw.AnalyticPlant(lambda x: x, lambda x: np.ones((1, 1)), lambda env: np.zeros(1), HOLD)
    return {"fallback": lambda plant: fallback(), "plant": plant}


EVENTS = ("fresh",) * 8 + ("stale",) * 3 + ("nothing", "future", "nan", "inf")


@st.composite
def scenarios(draw, limited=False, scales=(1.0, 0.3, 3.0), bounds=(1.0, 1.0, 0.3, math.inf)):
    most = draw(st.integers(0, 4))
    horizon = draw(st.just(max(most, 1)) | st.integers(max(most, 1), 6))
    size = horizon + most + draw(st.integers(0, 6))
    fewest = draw(st.just(0) | st.integers(0, 5 if size == 1 else size - most - 1))
    limits = st.floats(0.05, 50.0)
    return SimpleNamespace(
        size=size,
        horizon=horizon,
        delay=[draw(st.just(most) | st.integers(0, most)), most],
        fewest=fewest,
        limit=draw(limits if limited or not fewest else limits | st.just(math.inf)),
        controls=draw(st.integers(1, 3)),
        dtype=draw(st.sampled_from([np.float32, np.float32, np.float64])),
        bound=draw(st.sampled_from(bounds)),
        fallback=draw(st.sampled_from(["zero", "hold", "wander"])),
        scale=draw(st.sampled_from(scales)),
        smooth=draw(st.booleans()),
        seed=draw(st.integers(0, 2**31)),
        ends_at=draw(st.integers(1, 60)),
        events=draw(st.lists(st.sampled_from(EVENTS), min_size=4, max_size=16)),
    )


def handover(s):
    """A handover as a scenario has it, on a line."""
    rng = np.random.default_rng(s.seed)
    wander = unmoved(lambda: s.scale * rng.uniform(-1, 1, s.controls))
    return sw.ChunkHandover(
        Line(s.controls, s.bound, s.dtype, ends_at=s.ends_at),
        s.size,
        s.horizon,
        s.delay[0] if s.delay[0] == s.delay[1] else s.delay,
        blend_time=(s.fewest + 1) * HOLD if s.fewest else None,
        rate_limit=s.limit if math.isfinite(s.limit) else None,
        **(wander if s.fallback == "wander" else {"fallback": s.fallback}),
    )


def act(event, env, now, chunk, rng):
    """Tell the env what happens; the chunk, and the control step of its observation, None for nothing."""
    observed = now
    if event == "nothing":
        env.set_observation_time(None)
        return chunk, None
    if event in ("stale", "future"):
        observed += 2 if event == "future" else -int(rng.integers(1, 3 * env.execution_horizon))
        env.set_observation_time((observed + rng.choice([0.0, 0.9])) * HOLD)
    if event in ("nan", "inf"):
        chunk[tuple(rng.integers(0, chunk.shape))] = (
            np.nan if event == "nan" else rng.choice([-np.inf, np.inf])
        )
    return chunk, observed


def play(s):
    """One episode of both: the commands, the simulator, and per step the env's info and reward, and its ticks."""
    env, bound = handover(s), min(s.bound, float(np.finfo(np.float32).max))
    slow = Slow(HOLD, s.fewest, s.limit, -bound, bound, s.dtype)
    env.reset(seed=s.seed)
    rng, wander, delays = *(np.random.default_rng(s.seed) for _ in range(2)), WrapperRng("ChunkHandover")
    delays.reset(env, s.seed)
    commands, steps = env.unwrapped.given, []

    def fall_back():
        if s.fallback == "wander":
            return s.scale * wander.uniform(-1, 1, s.controls)
        return commands[slow.now - 1] if s.fallback == "hold" and slow.now else np.zeros(s.controls)

    for event in s.events:
        made = rng.uniform(-1, 1, (s.size, s.controls))
        made = s.scale * (rng.uniform(-1, 1) + np.cumsum(0.1 * made, axis=0) if s.smooth else made)
        delay = int(delays.draw.integers(s.delay[0], s.delay[1] + 1))
        chunk, observed = act(event, env, slow.now, np.clip(made, -3e38, 3e38).astype(s.dtype), rng)
        refused = observed is not None and not slow.submit(chunk, observed, slow.now + delay)
        # With chunks of one entry, an ordinary policy's actions are taken, too.
        _, reward, terminated, _, info = env.step(chunk[0] if s.size == 1 else chunk)
        ticks = [slow.tick(fall_back) for _ in range(min(s.horizon, s.ends_at - slow.now))]
        steps.append((info, reward, ticks, refused))
        if terminated:
            break
    return np.array(commands), slow, steps


@given(scenarios())
def test_every_command_and_every_figure_is_the_slow_simulators(scenario):
    commands, slow, steps = play(scenario)
    assume(not slow.close_calls)  # some in a hundred
    ticks = [tick for _, _, ticks, _ in steps for tick in ticks]
    tolerance = 1e-6 * max(1.0, scenario.scale * 4) if scenario.dtype is np.float32 else 1e-9
    for command, tick in zip(commands, ticks, strict=True):
        np.testing.assert_allclose(command, tick.control, rtol=0, atol=tolerance)
        if tick.exact:
            assert command.tobytes() == np.array(tick.control, scenario.dtype).tobytes()
    rates = [0.0, *(np.abs(np.diff(commands.astype(float), axis=0)).max(axis=1) / HOLD)]
    now = 0
    for info, reward, own, refused in steps:
        assert info["handover/starved"] == sum(tick.starved for tick in own)
        assert info["handover/limited"] == sum(tick.limited for tick in own)
        assert info["handover/refused"] == (refused or any(tick.refused for tick in own))
        now += len(own)
        assert info["handover/peak_jerk"] == pytest.approx(max(rates[now - len(own) : now]), abs=1e-12)
        assert reward == pytest.approx(sum(0.5 * (k + 1) for k in range(now - len(own), now)))


HUGE = scenarios(True, scales=(1e2, 1e5, 1e8, 1e30, 3e38), bounds=(math.inf,))


@given(scenarios(limited=True) | HUGE, st.sampled_from([1.0, 1.0, 1e-2]))
def test_no_two_neighbours_are_farther_apart_than_the_limit_allows(scenario, part):
    """Also where the simulator is not asked: ties, and numbers that are coarser than the limit."""
    scenario.limit *= part
    commands, _, steps = play(scenario)
    assert np.abs(np.diff(commands.astype(float), axis=0)).max(initial=0.0) <= scenario.limit * HOLD
    assert max(info["handover/peak_jerk"] for info, *_ in steps) <= scenario.limit


@given(st.floats(0.05, 9.0), st.floats(0.001, 0.1))
def test_the_rate_of_a_command_that_is_held_back_is_not_above_the_limit_by_rounding(limit, dt):
    infos, _ = handed(Line(dt=dt), [np.zeros((1, 1)), np.ones((1, 1))], rate_limit=limit)
    assert infos[1]["handover/limited"] and infos[1]["handover/peak_jerk"] <= limit


def test_what_is_held_back_is_counted_where_the_dtype_hardly_resolves_the_limit():
    swing = np.float32(1e5 + 0.02 * (-1.0) ** np.arange(8)[:, None])
    chunks = [np.full((8, 1), 1e5, np.float32), *[swing] * 5]
    infos, _ = handed(Line(1, 1e6, np.float32), chunks, 4, rate_limit=0.01)
    assert all(info["handover/limited"] for info in infos[1:])


def test_by_how_much_an_entry_left_the_action_space_is_told_and_the_first_time_warned_of():
    chunk = np.array([[1.0, 0.0], [4.0, -5.0], [1.5, 0.0]])
    with pytest.warns(UserWarning, match="left the action space by 5;") as warned:
        (info, again), sent = handed(Line(2), [chunk, chunk], rate_limit=99.0)
    assert len(warned) == 1 and info["action/clipped"] == again["action/clipped"] == 5.0
    assert sent.tolist() == 2 * [[1.0, 0.0], [1.0, -1.0], [1.0, 0.0]]


@pytest.mark.parametrize("value", [np.nan, np.inf, 1e300])
def test_a_broken_fallback_sends_nothing_that_is_not_finite(value):
    options = {"inference_delay": 2, "rate_limit": 5.0, **unmoved(lambda: [value])}
    infos, _ = handed(Line(1, np.inf, np.float32), [np.zeros((4, 1))] * 3, 2, **options)  # the line looks
    assert infos[0]["handover/starved"] == 2


class Listener(gym.Wrapper, CommandReceiver):
    """Keeps the stamps that it is told, one per control step."""

    stamps = ()

    def set_observation_time(self, observed_s):
        self.stamps += (observed_s,)


def test_whoever_is_inside_is_told_what_every_command_is_made_from():
    """Nothing before the first chunk; the chunk in force for its commands, its left-over, and while it starves."""
    env = sw.ChunkHandover(Listener(Line()), 6, 3, 1, rate_limit=5.0, fallback="zero")
    env.reset(seed=0)
    for stamp in (0.0, 0.3, None, None, 1.1):  # the last is made at control step 11, and there at 13
        env.set_observation_time(stamp)
        env.step(np.zeros((6, 1)))
    told = [None if stamp is None else round(stamp / HOLD, 6) for stamp in env.env.stamps]
    assert told == [None, 0, 0, 0, *[3] * 9, 11, 11]


class Executed(gym.Wrapper):
    """Keeps what is sent to a filter, and what it executes."""

    sent, executed = (), ()

    def step(self, action):
        *found, info = self.env.step(action)
        self.sent += (np.array(action, np.float64),)
        self.executed += (info["executed_action"],)
        return *found, info


def test_a_filter_inside_may_break_the_limit_and_then_it_shows():
    watch = Executed(sw.CBFActionFilter(gym.make("Reacher-v5"), [sw.constraints.JointSpeedLimit(6.0)]))
    env = sw.ChunkHandover(watch, 16, 8, rate_limit=4.0)
    env.reset(seed=0)
    infos = [env.step(np.full((16, 2), level, np.float32))[4] for level in (0.8, -0.8, 0.8)]
    assert np.abs(np.diff(watch.sent, axis=0)).max() <= 4.0 * env.control_dt
    rates = np.abs(np.diff(watch.executed, axis=0)).max(axis=1) / env.control_dt
    peaks = [rates[:7].max(), rates[7:15].max(), rates[15:].max()]
    assert [info["handover/peak_jerk"] for info in infos] == pytest.approx(peaks) and max(peaks) > 4.0


# A machine's limits ---------------------------------------------------------------------------------------------


def flat(*levels, entries=12):
    return [np.full((entries, 1), level) for level in levels]


@given(st.integers(0, 2**32 - 1), st.floats(1.0, 40.0), st.floats(10.0, 400.0), st.floats(50.0, 8000.0))
def test_no_executed_bridge_breaks_a_limit_anywhere(seed, velocity, acceleration, jerk):
    rng = np.random.default_rng(seed)
    chunks = [np.linspace(*rng.uniform(-1, 1, (2, 2)), 12) for _ in range(5)]
    limits = sw.SeamLimits(velocity=velocity, acceleration=[acceleration, 1e9], jerk=jerk)
    infos, sent = handed(Line(2), chunks, limits=limits)
    for k, chunk in enumerate(chunks):
        if infos[k]["handover/refused"] or not k:
            continue
        last, steps = sent[12 * k - 3 : 12 * k], blend_steps(sent[12 * k :], chunk)
        starts = [last[-1], (last[-1] - last[-2]) / HOLD, np.diff(last, n=2, axis=0)[0] / HOLD**2]
        ends = [chunk[steps], (chunk[1] - chunk[0]) / HOLD, np.zeros(2)]
        curve = BPoly.from_derivatives([0.0, (steps + 1) * HOLD], [starts, ends])
        made = curve(HOLD * np.arange(1, steps + 1))
        np.testing.assert_allclose(made, sent[12 * k : 12 * k + steps], atol=1e-9)
        t = np.linspace(0.0, (steps + 1) * HOLD, 5000)
        assert (np.abs(curve(t, 1)) <= velocity * 1.0001).all()
        assert (np.abs(curve(t, 2))[:, 0] <= acceleration * 1.0001).all()
        assert (np.abs(curve(t, 3)) <= jerk * 1.0001).all()


@pytest.mark.parametrize(
    ("name", "order", "peak"), [("velocity", 1, 1.875), ("acceleration", 2, 5.7735026919), ("jerk", 3, 60.0)]
)
@pytest.mark.parametrize("steps", [3, 5, 8])
def test_a_blend_is_as_long_as_its_limit_asks_and_no_longer(name, order, peak, steps):
    limit = peak / ((steps + 1) * HOLD) ** order * 1.0001
    chunks = flat(-0.5, 0.5)
    _, sent = handed(Line(), chunks, 11, limits={name: limit})
    assert blend_steps(sent[11:], chunks[1]) == steps
    # To the fallback and back, where nothing is bridged, commands are faded in the same time.
    _, sent = handed(Line(), [[[-0.5]], [[np.nan]], *[[[0.5]]] * 12], limits={name: limit})
    alphas = [smooth(min(1.0, i / (steps + 1))) for i in range(1, 13)]
    np.testing.assert_allclose(sent[2:, 0], np.array(alphas) - 0.5, atol=1e-12)


def test_without_a_blend_that_will_do_the_chunk_is_refused_for_good_and_the_old_one_goes_on():
    # Once the old one has come to rest, the second could be reached, and is not; the third is.
    ramp, level = np.minimum(0.1 * np.arange(12.0), 0.4)[:, None], np.full((12, 1), 0.41)
    infos, sent = handed(Line(), [ramp, level, level], 4, limits={"acceleration": 0.5})
    assert [info["handover/refused"] for info in infos] == [False, True, False]
    assert np.array_equal(sent[:8], ramp[:8]) and sent[-1] > 0.4


@pytest.mark.parametrize(("low", "refused"), [(0.0, True), (0.5, False)])
def test_a_bridge_that_the_box_would_cut_is_not_taken(low, refused):
    """It goes on with the rate that it had: beyond 1, where the box ends there."""
    rising, top = np.linspace(-0.5, 1.0, 12)[:, None], np.full((12, 1), 1.0)
    infos, _ = handed(Line(), [rising - low, top - low], limits={"velocity": 1e6}, blend_time=0.5)
    assert infos[1]["handover/refused"] is refused


INERTIA = 0.02 + 1.5 * 0.5**2 + 0.4 * 1.5 * 0.05**2
PENDULUM = """<mujoco><worldbody><body><joint name="j" type="hinge" axis="0 1 0" damping="0.3" armature="0.02"/>
<geom type="sphere" size="0.05" pos="0.5 0 0" mass="1.5"/></body></worldbody><actuator>
<position joint="j" kp="50" ctrlrange="-2 2"/></actuator></mujoco>"""


class Modelled(Line):
    """Commands of a MuJoCo model, which stays where it is."""

    def __init__(self, text, bound, dt):
        self.model = mujoco.MjModel.from_xml_string(text)
        self.data = mujoco.MjData(self.model)
        self.model.opt.timestep = dt / 2
        super().__init__(self.model.nu, bound, dt=dt)


def quintic_peak_torque(steps):
    """From 0.2 to 0.6 rad: m g l cos q about y, axes turned; positive q turns it down."""
    span = (steps + 1) * 0.02
    curve = BPoly.from_derivatives([0.0, span], [[0.2, 0, 0], [0.6, 0, 0]])
    t = np.linspace(0, span, 20001)
    torque = INERTIA * curve(t, 2) - 1.5 * 9.81 * 0.5 * np.cos(curve(t)) + 0.3 * curve(t, 1)
    return np.abs(torque).max(), np.abs(np.diff(torque)).max() / (t[1] - t[0])


@pytest.mark.parametrize(
    ("name", "limit"), [("torque", 12.0), ("torque", 20.0), ("torque_slew", 200.0), ("torque_slew", 900.0)]
)
def test_a_position_commands_torque_is_that_of_the_equations_of_motion(name, limit):
    chunks = flat(0.2, 0.6, entries=20)
    _, sent = handed(Modelled(PENDULUM, 2.0, 0.02), chunks, limits={name: limit})
    steps, column = blend_steps(sent[20:], chunks[1]), int(name == "torque_slew")
    # Slews are taken between quarters of a control step: a little below the steepest one.
    assert quintic_peak_torque(steps)[column] <= limit * (1.15 if column else 1.0)
    assert quintic_peak_torque(steps - 1)[column] > limit


# Slow chunks ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("entries", "steps", "delay"), [(4, 2, 0), (5, 4, 3), (9, 33, 0)])
def test_commands_between_entries_are_the_spline_through_them(entries, steps, delay):
    chunk = np.random.default_rng(0).uniform(-1, 1, (entries, 3))
    times, size = np.arange(entries) * steps, (entries - 1) * steps + 1
    options = {"inference_delay": delay, "steps_per_entry": steps, "rate_limit": 1e9}
    infos, sent = handed(Line(3, 9.0), [chunk, np.full_like(chunk, np.nan)], size - delay, **options)
    spline = CubicHermiteSpline(times, chunk, np.gradient(chunk, steps, axis=0))
    assert sent[delay:size] == pytest.approx(spline(np.arange(delay, size)), abs=1e-12)
    exact = times >= delay
    assert np.array_equal(sent[times[exact]], chunk[exact])
    assert infos[1]["handover/starved"] == size - 2 * delay  # then it has ended


@pytest.mark.parametrize(("factor", "refused"), [(1.001, False), (0.999, True)])
def test_a_slow_chunks_knots_are_refused_by_the_torque_steps_there(factor, refused):
    chunk, at = 0.3 * np.random.default_rng(1).uniform(-1, 1, (6, 1)), np.arange(6) * 0.08
    bend = CubicHermiteSpline(at, chunk, np.gradient(chunk, 0.08, axis=0)).derivative(2)
    largest = np.abs(bend(at[1:-1] + 1e-9) - bend(at[1:-1] - 1e-9)).max() * INERTIA / 0.02
    limits = {"torque_slew": factor * largest}
    infos, _ = handed(Modelled(PENDULUM, 2.0, 0.02), [chunk], steps_per_entry=4, limits=limits)
    assert infos[0]["handover/refused"] is refused


def test_a_seam_on_the_flexible_arm_leaves_no_more_than_its_share():
    """One change of torque at the elbow from rest: what rings on after it, against what rings on after a step."""

    def left(**how):
        env = sw.ChunkHandover(gym.make("FlexJointReach-v0"), 40, 20, fallback="zero", **how)
        env.reset(seed=0)
        # The arm hardly turns, so that its resonances stay.
        infos = [env.step(np.full((40, 2), [0.0, level]))[4] for level in (0.0, 0.05, 0.05)]
        return infos[2]["vibration_energy"]

    step = left(rate_limit=1e9)
    period_s = 2.0 * np.pi / sw.plants.rigid_model_check(gym.make("FlexJointReach-v0")).resonances[0]
    for limits in (None, {"jerk": 1e9}):
        assert left(limits=limits, blend_time=1.73 * period_s) <= 0.01 * step
    assert left(blend_time=0.03) > 0.1 * step


# Ends within reach ----------------------------------------------------------------------------------------------

REACH = {"acceleration": 2.0, "velocity": 1.0, "arrival": "moving"}


def servos(positions, velocities, dt=HOLD):
    """Position servos of slides, which stay where a test says."""
    bodies = '<body><joint name="j{}" type="slide"/><geom size="0.1"/></body>'
    servos = '<position joint="j{}" ctrlrange="-9 9"/>'
    each = ["".join(map(text.format, range(len(positions)))) for text in (bodies, servos)]
    env = Modelled("<mujoco><worldbody>{}</worldbody><actuator>{}</actuator></mujoco>".format(*each), 9.0, dt)
    env.data.actuator_length[:], env.data.actuator_velocity[:] = positions, velocities
    return env


def admitted(state, end, duration_s, arrival="moving"):
    """Whether a chunk is executed that ends there in such a time."""
    limits = {**REACH, "arrival": arrival}
    env = servos(*state, dt=duration_s / 6)
    infos, _ = handed(env, [np.tile(end, (6, 1))], fallback="zero", rate_limit=1e9, limits=limits)
    return not infos[0]["handover/refused"]


numbers = st.integers(-800, 800).map(lambda thousandths: thousandths / 1000.0)


@given(numbers, numbers, st.floats(-0.9, 0.9), st.floats(0.0, 0.5))
def test_what_a_motion_reaches_is_admitted_and_rest_needs_the_constrained_time(q, v, goal, late):
    request, trajectory = ruckig.InputParameter(1), ruckig.Trajectory(1)
    request.current_position, request.current_velocity, request.target_position = [q], [v], [goal]
    request.max_velocity, request.max_acceleration, request.max_jerk = [1.0], [2.0], [math.inf]
    ruckig.Ruckig(1).calculate(request, trajectory)
    assume(trajectory.duration > 1e-3)
    enough = trajectory.duration + 1e-9 + late
    assert admitted(([q], [v]), [goal], enough, "rest")
    assert admitted(([q], [v]), [goal], enough)  # what can stop there can pass there
    assert not admitted(([q], [v]), [goal], trajectory.duration * (1.0 - 1e-6) - 1e-9, "rest")


def test_moving_admits_ends_at_which_no_machine_could_stop_in_time():
    state = [0.0, 0.0], [0.9, 0.0]
    # At 2 m/s^2 to 1 m/s 0.0475 m in 0.05 s, then 0.05 m in as much; the other axis counts, too.
    for end, passed in (([0.0974, 0.0], True), ([0.0976, 0.0], False), ([0.09, 0.0101], False)):
        assert admitted(state, end, 0.1) is passed and not admitted(state, end, 0.1, "rest")


def test_a_chunk_out_of_reach_is_refused_and_the_left_over_goes_on():
    chunks = [np.full((6, 1), 0.1), np.full((6, 1), 0.9)]  # in 0.6 s at 1 per second
    infos, sent = handed(servos([0.0], [0.0]), chunks, 3, limits={**REACH, "acceleration": 10.0})
    assert [info["handover/refused"] for info in infos] == [False, True]
    assert np.ravel(sent).tolist() == [0.1] * 6


STILL = servos([0.0], [0.0])


@pytest.mark.parametrize(
    ("env", "error", "words"),
    [
        (Line(), UnsupportedEnvError, "MuJoCo's actuators"),
        (gym.wrappers.RescaleAction(STILL, -1.0, 1.0), ConfigurationError, "setpoints"),
        (gym.wrappers.TransformAction(STILL, np.negative, None), ConfigurationError, "changes the actions"),
    ],
)
def test_ends_are_judged_only_where_actions_are_lengths_of_actuators(env, error, words):
    with pytest.raises(error, match=words):
        sw.ChunkHandover(env, 6, 3, blend_time=0.2, fallback="zero", limits=REACH)
