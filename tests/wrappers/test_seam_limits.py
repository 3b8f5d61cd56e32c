"""Machines' limits: no executed blend breaks them between its ends; slow chunks; joints that ring."""

import gymnasium as gym
import mujoco
import numpy as np
import pytest
from chunk_worlds import ChunkHandover, Line
from hypothesis import given
from hypothesis import strategies as st
from scipy.interpolate import BPoly, CubicHermiteSpline

import safe_wrappers as sw
from safe_wrappers.errors import ConfigurationError, UnsupportedEnvError
from safe_wrappers.wrappers.chunk_handover import upsampled

pytestmark = pytest.mark.filterwarnings("ignore:a command was held back:UserWarning")


HOLD = 0.1


def driven(chunks, horizon=4, delay=0, **more):
    """The infos of some chunks on a line, and what it was sent."""
    line = Line(chunks[0].shape[1], dtype=np.float64)
    env = ChunkHandover(line, len(chunks[0]), horizon, delay, fallback="hold", **more)
    env.reset(seed=0)
    return [env.step(chunk)[4] for chunk in chunks], np.array(line.given)


def flat(*levels, entries=12):
    return [np.full((entries, 1), level) for level in levels]


@given(
    st.integers(0, 2**32 - 1),
    st.floats(1.0, 40.0),
    st.floats(10.0, 400.0),
    st.floats(50.0, 8000.0),
)
def test_no_executed_bridge_breaks_a_limit_anywhere(seed, velocity, acceleration, jerk):
    rng = np.random.default_rng(seed)
    chunks = [np.linspace(*rng.uniform(-1, 1, (2, 2)), 12) for _ in range(8)]
    limits = sw.SeamLimits(velocity=velocity, acceleration=[acceleration, 1e9], jerk=jerk)
    infos, sent = driven(chunks, horizon=12, limits=limits)
    for k in range(1, len(chunks)):
        steps = round(infos[k]["handover/blend_time"] / HOLD) - 1
        begins = 12 * k
        if infos[k]["handover/refused"] or steps < 1 or begins < 3 or infos[k]["handover/starved"]:
            continue
        last = sent[begins - 3 : begins]
        slope, bend = chunks[k][1] - chunks[k][0], np.zeros(2)
        starts = [last[-1], (last[-1] - last[-2]) / HOLD, np.diff(last, n=2, axis=0)[0] / HOLD**2]
        ends = [chunks[k][steps], slope / HOLD, bend]
        curve = BPoly.from_derivatives([0.0, (steps + 1) * HOLD], [starts, ends])
        t = np.linspace(0.0, (steps + 1) * HOLD, 5000)
        np.testing.assert_allclose(
            curve(HOLD * np.arange(1, steps + 1)), sent[begins : begins + steps], atol=1e-9
        )
        assert (np.abs(curve(t, 1)) <= velocity * 1.0001).all()
        assert (np.abs(curve(t, 2))[:, 0] <= acceleration * 1.0001).all()
        assert (np.abs(curve(t, 3)) <= jerk * 1.0001).all()


@pytest.mark.parametrize(
    ("name", "order", "peak"), [("velocity", 1, 1.875), ("acceleration", 2, 5.7735026919)]
)
def test_a_blend_is_as_long_as_its_limit_asks_and_no_longer(name, order, peak):
    for steps in (3, 5, 8):
        limit = peak * 1.0 / ((steps + 1) * HOLD) ** order * 1.0001
        infos, _ = driven(flat(-0.5, 0.5), limits={name: limit})
        assert infos[1]["handover/blend_time"] == pytest.approx((steps + 1) * HOLD)


def test_without_a_blend_that_will_do_the_chunk_is_refused_and_the_old_one_goes_on():
    chunks = flat(-0.5, 0.5, 0.5)
    infos, sent = driven(chunks, limits={"acceleration": 0.5})
    assert [info["handover/refused"] for info in infos] == [False, True, True]
    assert (sent == -0.5).all()
    assert [info["handover/latency"] for info in infos] == [0, -1, -1]
    assert not any(info["handover/starved"] for info in infos)


def test_a_bridge_that_the_box_would_cut_is_not_taken():
    """It goes on with the rate that it had: beyond 1, where the box ends there."""
    rising, top = np.linspace(-0.5, 1.0, 12)[:, None], np.full((12, 1), 1.0)
    for low, refused in ((0.0, True), (0.5, False)):
        infos, _ = driven([rising - low, top - low], horizon=12, limits={"velocity": 1e6}, blend_time=0.5)
        assert infos[1]["handover/refused"] is refused


def test_a_change_to_and_from_the_fallback_is_faded_within_the_limits():
    line = Line(1, dtype=np.float64)
    limits = {"acceleration": 5.7735026919 / 0.7**2 * 1.0001}
    env = ChunkHandover(line, 1, 1, fallback="hold", limits=limits)
    env.reset(seed=0)
    env.step(np.array([-0.5]))
    env.set_observation_time(None)
    env.step(np.array([0.5]))
    info = env.step(np.array([0.5]))[4]
    assert info["handover/blend_time"] == pytest.approx(0.7)


# Torques of position commands -----------------------------------------------------------------------------------

PENDULUM = """<mujoco><option timestep="0.01"/><worldbody><body><joint name="j" type="hinge" axis="0 1 0"
damping="{d}" armature="0.02"/><geom type="sphere" size="0.05" pos="0.5 0 0" mass="1.5"/></body></worldbody>
<actuator>{a}</actuator>
</mujoco>"""
SERVO = '<position name="servo" joint="j" kp="50" ctrlrange="-2 2"/>'


class Pendulum(gym.Env):
    def __init__(self, actuator=SERVO, damping=0.3):
        self.model = mujoco.MjModel.from_xml_string(PENDULUM.format(d=damping, a=actuator))
        self.data, self.frame_skip, self.dt = mujoco.MjData(self.model), 2, 0.02
        self.action_space = gym.spaces.Box(-2.0, 2.0, (1,), np.float64)
        self.observation_space = gym.spaces.Box(-np.inf, np.inf, (2,))

    def seen(self):
        return np.concatenate([self.data.qpos, self.data.qvel]).astype(np.float32)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        mujoco.mj_resetData(self.model, self.data)
        return self.seen(), {}

    def step(self, action):
        self.data.ctrl[:] = action
        mujoco.mj_step(self.model, self.data, 2)
        return self.seen(), 0.0, False, False, {}


def torque_by_hand(q, v, a):
    """Of the pendulum: m g l cos q about y, axes turned; positive q turns it down."""
    inertia = 0.02 + 1.5 * 0.5**2 + 0.4 * 1.5 * 0.05**2
    return inertia * a - 1.5 * 9.81 * 0.5 * np.cos(q) + 0.3 * v


def held_pendulum(limits, levels, entries=20, **pendulum):
    env = ChunkHandover(Pendulum(**pendulum), entries, 8, fallback="zero", limits=limits)
    env.reset(seed=0)
    return [env.step(np.full((entries, 1), level))[4] for level in levels]


def quintic_peak_torque(low, high, steps):
    span = (steps + 1) * 0.02
    curve = BPoly.from_derivatives([0.0, span], [[low, 0, 0], [high, 0, 0]])
    t = np.linspace(0, span, 20001)
    torque = torque_by_hand(curve(t), curve(t, 1), curve(t, 2))
    return np.abs(torque).max(), np.abs(np.diff(torque)).max() / (t[1] - t[0])


def test_a_position_commands_torque_is_that_of_the_equations_of_motion():
    peak = np.array([quintic_peak_torque(0.2, 0.6, n) for n in range(20)])
    for column, name in ((0, "torque"), (1, "torque_slew")):
        for limit in (12.0, 20.0) if name == "torque" else (200.0, 900.0):
            infos = held_pendulum({name: limit}, (0.2, 0.6))
            steps = round(infos[1]["handover/blend_time"] / 0.02) - 1
            # Slews are taken between quarters of a control step: a little below the steepest one.
            assert peak[steps, column] <= limit * (1.0 if column == 0 else 1.15)
            assert peak[steps - 1, column] > limit


def test_a_slow_chunks_knots_are_refused_by_the_torque_steps_there():
    rng = np.random.default_rng(1)
    chunk = 0.3 * rng.uniform(-1, 1, (6, 1))
    spacing = 4 * 0.02
    rates = np.gradient(chunk, spacing, axis=0)
    bend = CubicHermiteSpline(np.arange(6) * spacing, chunk, rates).derivative(2)
    at = np.arange(1, 5) * spacing
    inertia = 0.02 + 1.5 * 0.5**2 + 0.4 * 1.5 * 0.05**2
    largest = np.abs(bend(at + 1e-9) - bend(at - 1e-9)).max() * inertia / 0.02
    for factor, refused in ((1.001, False), (0.999, True)):
        limits = {"torque_slew": factor * largest}
        env = ChunkHandover(Pendulum(), 6, 8, steps_per_entry=4, fallback="zero", limits=limits)
        env.reset(seed=0)
        assert env.step(chunk)[4]["handover/refused"] is refused


@pytest.mark.parametrize(
    "actuator",
    [
        '<motor joint="j" ctrlrange="-2 2"/>',
        '<position joint="j" kp="50" ctrlrange="-2 2"/><velocity joint="j" kv="1" ctrlrange="-2 2"/>',
    ],
)
def test_what_is_no_position_servo_tells_no_torque(actuator):
    env = Pendulum(actuator)
    env.action_space = gym.spaces.Box(-2.0, 2.0, (env.model.nu,), np.float64)
    with pytest.raises(UnsupportedEnvError, match="no position servo"):
        ChunkHandover(env, 8, 4, limits={"torque": 3.0})


# Bad input --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("entries", "steps"), [(2, 3), (5, 4), (9, 33)])
def test_commands_between_entries_are_the_spline_through_them(entries, steps):
    chunk = np.random.default_rng(0).normal(size=(entries, 3))
    commands = upsampled(chunk, steps)
    times = np.arange(entries) * steps
    spline = CubicHermiteSpline(times, chunk, np.gradient(chunk, steps, axis=0))
    assert commands == pytest.approx(spline(np.arange(times[-1] + 1)), abs=1e-12)
    assert np.array_equal(commands[::steps], chunk)


class Sent(gym.Wrapper):
    def __init__(self, env):
        super().__init__(env)
        self.sent = []

    def step(self, action):
        self.sent.append(np.array(action))
        return self.env.step(action)


def test_a_slow_chunk_drives_a_fast_loop_late_and_within_the_limit():
    inner = Sent(gym.make("FlexJointReach-v0"))
    env = ChunkHandover(inner, 5, 10, inference_delay=3, steps_per_entry=5, rate_limit=[30.0, 10.0])
    assert env.action_space.shape == (5, 2)
    env.reset(seed=0)
    rng = np.random.default_rng(0)
    chunks = [
        0.4 * rng.uniform(env.action_space.low, env.action_space.high).astype(np.float32) for _ in range(3)
    ]
    for chunk in chunks:
        info = env.step(chunk)[4]
    assert info["handover/latency"] == 3
    sent = np.array(inner.sent, dtype=np.float64)
    assert (np.abs(np.diff(sent, axis=0)) <= np.array([30.0, 10.0]) * 0.01 + 1e-12).all()


@pytest.mark.parametrize(
    ("sizes", "words"),
    [
        ({"steps_per_entry": 0}, "steps_per_entry"),
        ({"steps_per_entry": 1.5}, "steps_per_entry"),
        ({"chunk_size": 1, "execution_horizon": 1, "steps_per_entry": 2}, "chunk_size .* at least 2"),
        ({"execution_horizon": 20, "steps_per_entry": 4}, "H = 17 control steps"),
    ],
)
def test_bad_sizes(sizes, words):
    with pytest.raises(ConfigurationError, match=words):
        ChunkHandover(
            gym.make("Reacher-v5"), **{"chunk_size": 5, "execution_horizon": 3, "rate_limit": 5.0, **sizes}
        )


def test_a_seam_on_the_flexible_arm_leaves_no_more_than_its_share():
    """One change of torque at the elbow from rest: what rings on after it, against what rings on after a step."""

    def left(**how):
        env = ChunkHandover(gym.make("FlexJointReach-v0"), 40, 20, fallback="zero", **how)
        env.reset(seed=0)
        # The arm hardly turns, so that its resonances stay.
        for level in (0.0, 0.05):
            env.step(np.full((40, 2), [0.0, level], np.float32))
        return env.step(np.full((40, 2), [0.0, 0.05], np.float32))[4]["vibration_energy"]

    step = left(rate_limit=1e9)
    period_s = 2.0 * np.pi / sw.plants.rigid_model_check(gym.make("FlexJointReach-v0")).resonances[0]
    for limits in (None, {"jerk": 1e9}):
        assert left(limits=limits, blend_time=1.73 * period_s) <= 0.01 * step
    assert left(blend_time=0.03) > 0.1 * step
