"""LeaseExpiry with stops of limited jerk: a cart whose policy dies, and chunks that run as far as they can stop."""

import gymnasium as gym
import numpy as np
import pytest
import ruckig
from braked_cart import cart_plant
from hypothesis import given
from hypothesis import strategies as st

import safe_wrappers as sw
from safe_wrappers import info as keys
from safe_wrappers.control.watchdog.leases import jerk_limited_stop
from safe_wrappers.errors import ConfigurationError
from safe_wrappers.wrappers.admission import Admission

pytestmark = pytest.mark.filterwarnings("ignore::UserWarning")
DT, WALL, DRIVE, BRAKING, JERK = 0.02, 2.0, 1.5, 3.0, 10.0
BRAKE = np.array([-1.0])


class JerkyCart(gym.Env):
    """Throttle at once; brakes that build up, and are taken back until it stands, with limited jerk (by ruckig)."""

    observation_space = gym.spaces.Box(-np.inf, np.inf, (2,))
    action_space = gym.spaces.Box(-1.0, 1.0, (1,), dtype=np.float64)
    x = v = a = farthest = 0.0
    dt = DT

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.x, self.v, self.a, self.farthest = 0.0, 0.5, 0.0, 0.0
        return np.zeros(2), {}

    def step(self, action):
        if action[0] < 0.0:
            stop = profile((self.x, self.v, self.a))
            self.x, self.v, self.a = (float(s[0]) for s in stop.at_time(min(DT, stop.duration)))
        else:
            self.a = DRIVE * float(action[0])
            self.x += self.v * DT + 0.5 * self.a * DT**2
            self.v += self.a * DT
        self.farthest = max(self.farthest, self.x)
        return np.array([self.x, self.v]), 0.0, False, False, {}


def profile(state, braking=BRAKING, jerk=JERK):
    request = ruckig.InputParameter(1)
    request.control_interface = ruckig.ControlInterface.Velocity
    request.current_position, request.current_velocity, request.current_acceleration = ([s] for s in state)
    request.target_velocity, request.target_acceleration = [0.0], [0.0]
    request.max_acceleration, request.max_jerk = [braking], [jerk]
    trajectory = ruckig.Trajectory(1)
    ruckig.Ruckig(1).calculate(request, trajectory)
    return trajectory


def leased(clearance, **more):
    budget = sw.StoppingBudget(clearance, braking=BRAKING, acceleration=DRIVE, **more)
    return sw.LeaseExpiry(
        JerkyCart(),
        budget,
        fallback=lambda plant: BRAKE,
        plant=cart_plant(DT),
        max_lease_s=3.0,
        blend_time=0.0,
    )


def silent_after(env, step, longer=1.0):
    """How much is left when a policy at full throttle dies with this step's command; its lease times `longer`."""
    env.reset(seed=0)
    for k in range(400):
        if k > step:
            env.set_observation_time(None)
        info = env.step(np.ones(1))[4]
        if k == step:
            env._until_s += (longer - 1.0) * (env._until_s - k * DT)
        if info[keys.LEASE_BRAKING] and env.unwrapped.v <= 1e-9:
            break
    return WALL - env.unwrapped.farthest


def ahead(env):
    return [WALL - env.unwrapped.x], [env.unwrapped.v]


@pytest.mark.parametrize("step", [0, 5, 11, 23])
def test_a_cart_whose_policy_dies_stops_inside_and_hits_without_the_jerk(step):
    left = silent_after(leased(ahead, jerk=JERK), step)
    # Less than a control step before the wall: leases end with the last whole step.
    assert -1e-9 <= left < 3.0 * DT
    assert silent_after(leased(ahead), step) < -0.1


def test_five_percent_more_than_the_lease_hits():
    # A clearance at which the lease is a whole number of control steps, which nothing rounds off.
    lease = 41 * DT
    way = 0.5 * lease + 0.5 * DRIVE * lease**2 + jerk_limited_stop(0.5 + DRIVE * lease, DRIVE, BRAKING, JERK)

    env = leased(lambda env: ([float(way) + 1e-5], [0.5]), jerk=JERK)
    left = silent_after(env, 0) + float(way) - WALL
    assert -1e-9 <= left < 1e-4
    assert silent_after(env, 0, longer=1.05) + float(way) - WALL < -0.05


def test_without_a_jerk_nothing_changes_and_with_one_the_rows_no_longer_do():
    rail = [sw.constraints.Plane([-0.9], [1]), sw.constraints.Plane([0.9], [-1])]
    clearance = sw.constraints.Clearance(rail, bodies=["cart"], braking=8.0)

    def lease(**more):
        env = sw.LeaseExpiry(
            gym.make("InvertedPendulum-v5"), sw.StoppingBudget(clearance, acceleration=20.0, **more)
        )
        env.reset(seed=0)
        return env.step(np.zeros(1, np.float32))[4][keys.LEASE_REMAINING_S]

    assert lease() == lease(jerk=None) > lease(jerk=1e6) > lease(jerk=2000.0)
    assert lease(jerk=1e6) == pytest.approx(lease(), abs=1e-4)
    with pytest.raises(ConfigurationError, match=r"jerk must be a finite number > 0 in m/s\^3"):
        sw.StoppingBudget(clearance, acceleration=20.0, jerk=0.0)
    with pytest.raises(ConfigurationError, match="counts braking already: give closing_speed alone"):
        sw.StoppingBudget(sw.constraints.JointSpeedLimit(limit=5.0), closing_speed=1.0, jerk=9.0)


# Chunks of setpoints ------------------------------------------------------------------------------------------

LIMITS = {"max_acceleration": BRAKING, "max_jerk": JERK, "stopping": True}


class Nowhere(gym.Env):
    """Says nothing of where it is."""


def admission(state, axes=1, **more):
    return Admission(Nowhere(), LIMITS | more, lambda env: state, axes)


@given(
    st.floats(0.0, 1.0),
    st.floats(0.0, 2.5),
    st.floats(0.01, 2.0),
    st.floats(0.0, 0.2),
    st.sampled_from([1.0, -1.0]),
)
def test_the_points_that_can_stop_are_those_of_the_closed_form(v, a, room, late, side):
    times = DT * np.arange(1, 31)
    chunk = v * times + 0.5 * a * times**2
    fit = admission(([0.0], [side * v])).stoppable(side * chunk[:, None], DT, room, late)
    moving = np.diff(chunk, prepend=0.0) / DT
    gaining = np.diff(moving, prepend=v) / DT
    both = zip(moving, np.maximum(gaining, 0.0), strict=True)
    ways = chunk + late * moving + [jerk_limited_stop(*one, BRAKING, JERK) for one in both]
    if np.abs(ways - room).min() > 1e-6:
        assert fit == (np.flatnonzero(ways > room)[0] if (ways > room).any() else 30)


def test_axes_add_up_and_what_is_not_finite_does_not_count():
    line = np.linspace(0.01, 0.2, 20)
    for direction in np.array([[1.0, 1.0], [0.6, -0.8]]) / [[np.sqrt(2.0)], [1.0]]:
        moving = 0.5 * np.abs(direction)
        fit = admission(([0.0, 0.0], 0.5 * direction), 2).stoppable(line[:, None] * direction, DT, 0.15, 0.0)
        alone = np.linalg.norm([jerk_limited_stop(speed, 0.0, BRAKING, JERK) for speed in moving])
        most = np.flatnonzero(line + alone > 0.15)[0]
        # The axes stop together, so that the slower one takes longer than it would alone.
        assert 0 < fit == most - (moving[0] != moving[1]) < 20
    assert admission(([np.nan], [0.5])).stoppable(line[:, None], DT, 9.0, 0.0) == 0
    assert admission(([0.0], [0.5])).stoppable(line[:, None], DT, -np.inf, 0.0) == 0
    assert admission(([0.0], [0.5])).stoppable(line[:, None], DT, np.nan, 0.0) == 0
    assert admission(([0.0], [0.5])).stoppable(line[:, None], DT, np.inf, 0.0) == 20
    # From faster than now, too: the delays count at the fastest that it has been.
    braking = np.cumsum(np.linspace(0.01, 0.005, 20))[:, None]
    assert 0 < admission(([0.0], [0.5])).stoppable(braking, DT, 0.4, 0.5) < 20
    assert admission(([0.0], [0.5])).stoppable(braking, DT, 0.45, 0.5) == 20


class Setpoints(gym.Env):
    """A slide that is where its setpoints say; told to stop, it makes its own, of limited jerk."""

    observation_space = gym.spaces.Box(-np.inf, np.inf, (1,))
    action_space = gym.spaces.Box(-9.0, 9.0, (1,), dtype=np.float64)
    dt = DT

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.x = self.v = self.a = self.farthest = 0.0
        self.stopping = None
        return np.zeros(1), {}

    def step(self, action):
        x, v = float(action[0]), (float(action[0]) - self.x) / DT
        if not (self.stopping is not None and x == self.stopping[0]):
            self.x, self.v, self.a = x, v, (v - self.v) / DT
        else:
            self.x, self.v, self.a = self.stopping
        self.farthest = max(self.farthest, self.x)
        return np.array([self.x]), 0.0, False, False, {}

    def stop(self, plant):
        found = profile((self.x, self.v, self.a))
        self.stopping = tuple(float(s[0]) for s in found.at_time(min(DT, found.duration)))
        return np.array([self.stopping[0]])


def handed_over(wall, stopping, **more):
    env = Setpoints()
    lease = sw.LeaseExpiry(
        env,
        sw.StoppingBudget(lambda env: ([wall - env.unwrapped.x], [0.0]), braking=BRAKING, acceleration=0.0),
        motion_limits=LIMITS | {"max_acceleration": 50.0, "max_jerk": np.inf, "stopping": stopping} | more,
        measured=lambda env: ([env.unwrapped.x], [env.unwrapped.v]),
        fallback=env.stop,
        plant=cart_plant(DT),
        blend_time=0.0,
        max_lease_s=2.0,
    )
    return sw.ChunkHandover(lease, 40, 40, blend="replace", fallback="hold")


def test_a_chunk_is_executed_as_far_as_it_can_be_stopped():
    chunk = (0.5 * 2.0 * (DT * np.arange(1, 41)) ** 2)[:, None]  # from rest with 2 m/s^2: 0.64 m
    for wall in (0.2, 0.35, 0.5):
        env = handed_over(wall, True, max_acceleration=BRAKING, max_jerk=JERK)
        env.reset(seed=0)
        assert env.step(chunk)[4][keys.LEASE_BRAKING]
        env.step(np.full((40, 1), np.nan))  # and nothing more
        left = wall - env.unwrapped.farthest
        assert 0.0 <= left < 0.08 and env.unwrapped.v == pytest.approx(0.0, abs=1e-9)
        one_more = handed_over(wall, True, max_acceleration=BRAKING, max_jerk=JERK)
        one_more.reset(seed=0)
        inner = one_more.env
        fits = inner._admission.stoppable

        def beyond(*arguments, fits=fits):
            return min(fits(*arguments) + 1, 40)

        inner._admission.stoppable = beyond
        one_more.step(chunk), one_more.step(np.full((40, 1), np.nan))
        assert wall - one_more.unwrapped.farthest < 1e-6
        env = handed_over(wall, False, max_acceleration=BRAKING, max_jerk=JERK)
        env.reset(seed=0)
        env.step(chunk)
        assert env.unwrapped.farthest > wall + 0.1  # only the clearance of the start was looked at
    env = handed_over(5.0, True)
    env.reset(seed=0)
    assert not env.step(chunk)[4][keys.LEASE_BRAKING] and env.unwrapped.x == pytest.approx(chunk[-1, 0])


def test_a_chunk_that_cannot_be_stopped_at_all_is_refused_through_a_fault_too():
    env = handed_over(0.05, True, max_acceleration=BRAKING, max_jerk=JERK)
    env.reset(seed=0)
    info = env.step(np.full((40, 1), 0.04))[4]  # 2 m/s at the first point
    assert info[keys.LEASE_REFUSED] and info[keys.HANDOVER_REFUSED] and env.unwrapped.farthest == 0.0
    lease = handed_over(0.002, True, max_acceleration=BRAKING, max_jerk=JERK).env
    outer = sw.faults.Jitter(lease, 0.01)
    outer.reset(seed=0)
    chunk = (0.5 * (DT * np.arange(1, 41)) ** 2)[:, None]
    assert outer.admits(chunk[-1], 40) and not outer.admits_chunk(chunk)
    assert outer.admits_chunk(np.full((5, 1), 1e-6))


def test_stopping_is_true_or_false_and_needs_a_length():
    with pytest.raises(ConfigurationError, match="stopping is True or False, got 'yes'"):
        admission(([0.0], [0.0]), stopping="yes")
    limits = {"max_acceleration": 1.0, "stopping": True}
    with pytest.raises(ConfigurationError, match="needs a clearance in the setpoints' unit of length"):
        sw.LeaseExpiry(
            gym.make("Reacher-v5"),
            sw.StoppingBudget(sw.constraints.JointSpeedLimit(limit=5.0), closing_speed=10.0),
            motion_limits=limits,
            measured=lambda env: (np.zeros(2), np.zeros(2)),
        )


def test_the_next_command_is_not_under_the_last_chunks_points():
    lease = handed_over(0.2, True, max_acceleration=BRAKING, max_jerk=JERK).env
    lease.reset(seed=0)
    chunk = (0.5 * 2.0 * (DT * np.arange(1, 41)) ** 2)[:, None]
    assert lease.admits_chunk(chunk)
    cut = lease.step(chunk[0])[4][keys.LEASE_REMAINING_S]
    assert 0.1 < cut < 0.4
    assert lease.step(chunk[0])[4][keys.LEASE_REMAINING_S] == pytest.approx(2.0 - DT)
