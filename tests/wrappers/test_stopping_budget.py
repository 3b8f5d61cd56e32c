"""What a stop takes by clearances and constraints, and what commands may do."""

import copy
import math

import gymnasium as gym
import numpy as np
import pytest
from asking import Asked
from braked_cart import BrakedCart, cart_plant, lease, lease_by_bisection

import safe_wrappers as sw
from safe_wrappers.errors import ConfigurationError
from safe_wrappers.wrappers.stopping import BoundBudget

pytestmark = pytest.mark.filterwarnings("ignore::UserWarning")


RAIL = [sw.constraints.Plane([-0.9], [1]), sw.constraints.Plane([0.9], [-1])]
FULL = np.array([1.0, 0.0])


def rail(**more):
    return sw.constraints.Clearance(RAIL, bodies=["cart"], braking=8.0, **more)


def granted(env, action):
    """The lease that the next fresh command gets, s; None if it is refused."""
    info = env.step(action)[4]
    return None if info["lease/refused"] else info["lease/remaining_s"] + env.control_dt


# Clearance ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("reserve", [(0.0, 0.0), (0.05, 0.02)])
def test_a_clearance_on_a_mujoco_cart(reserve):
    margin, error = reserve
    env = sw.LeaseExpiry(
        gym.make("InvertedPendulum-v5"),
        sw.StoppingBudget(
            rail(margin=margin, state_error=error),
            acceleration=20.0,
            top_speed=3.0,
            delays_s=0.01,
        ),
        max_lease_s=5.0,
        blend_time=0.0,
    )
    data = env.unwrapped.data
    rng = np.random.default_rng(0)
    leases, refused = 0, 0
    for _ in range(60):
        env.reset(seed=0)
        x, v = rng.uniform(-0.9, 0.9), rng.uniform(-3.0, 3.0)
        env.unwrapped.set_state(np.array([x, 0.0]), np.array([v, 0.0]))
        away = margin + error
        wanted = min(
            lease_by_bisection(0.9 - x, v, 8.0, 20.0, 3.0, away, 0.01),
            lease_by_bisection(0.9 + x, -v, 8.0, 20.0, 3.0, away, 0.01),
        )
        got = granted(env, np.zeros(1, np.float32))
        if got is None:
            assert wanted < env.control_dt
            refused += 1
        else:
            assert got == pytest.approx(wanted, abs=1e-6)
            leases += 1
        assert data.time > 0.0
    assert leases > 5 and refused > 5


def test_a_delayed_plants_prediction_is_used_with_the_commands_in_flight():
    # It sees the clearance after the delay: the way of the commands that were sent is gone by then.
    def lease(delay, throttle):
        cart = BrakedCart(wall=9.0, v=2.0, drive=1.0, delay_s=delay)
        plant = cart_plant(0.1)
        plant.delay_s = delay
        near = sw.constraints.Clearance(
            [sw.constraints.Plane([9.0], [-1.0])], braking=4.0, position=[0], velocity=[1]
        )
        env = sw.LeaseExpiry(
            cart, sw.StoppingBudget(near, acceleration=0.0), plant=plant, fallback="zero", max_lease_s=9.0
        )
        env.reset()
        for _ in range(3):
            found = granted(env, np.array([throttle, 0.0]))
        # Three steps have been granted, the last at 0.2 s; with the delay the command of 0 s just begins to act.
        x, v = 2.0 * 0.2, 2.0
        if delay:
            x, v = x + v * 0.2 + 0.5 * throttle * 0.2**2, v + throttle * 0.2
        else:
            x, v = x + 0.5 * throttle * 0.2**2, v + throttle * 0.2
        assert found == pytest.approx((9.0 - x - v**2 / 8.0) / v, abs=1e-6)
        # The next episode knows nothing of these commands.
        env.reset()
        again = granted(env, np.zeros(2))
        assert again == pytest.approx((9.0 - 2.0 * delay - 0.5) / 2.0, abs=1e-6)

    for delay in (0.0, 0.2):
        for throttle in (0.0, 0.7, -0.7):
            lease(delay, throttle)


# Other constraints --------------------------------------------------------------------------------------------


HAZARDS = [sw.constraints.Discs("hazard_positions", radius=0.2)]


def at_hazard(robot):
    """Full drive at the nearest hazard."""
    to = robot.hazard_positions - robot.agent_position
    dx, dy = to[np.argmin((to**2).sum(1))]
    angle = math.remainder(math.atan2(dy, dx) - robot.agent_heading, math.tau)
    return np.array([1.0, np.clip(4.0 * angle, -1.0, 1.0)], np.float32)


def test_a_heading_drive_never_violates_when_commands_stop():
    # The lease alone, no filter inside. The closing speed is measured first: the fastest that the value ever falls.
    clearance = sw.constraints.HeadingDriveClearance(HAZARDS, margin=0.01)
    bare = gym.make("SafePointGoal1-v0")
    plant, watch = sw.MujocoPlant(), copy.deepcopy(clearance)
    plant.bind(bare)
    watch = Asked(watch, plant)
    rng, fastest = np.random.default_rng(0), 0.0
    for seed in range(4):
        bare.reset(seed=seed)
        before = None
        for t in range(200):
            plant.observe()
            value = float(watch.value()[0])
            if before is not None:
                fastest = max(fastest, (before - value) / 0.02)
            before = value
            bare.step(at_hazard(bare.unwrapped) if t % 60 < 40 else np.float32(rng.choice([-1.0, 1.0], 2)))
    env = sw.LeaseExpiry(
        gym.make("SafePointGoal1-v0"),
        sw.StoppingBudget(clearance, closing_speed=1.3 * fastest),
        max_lease_s=0.3,
    )
    braked, entered = 0, 0
    for seed in range(6):
        env.reset(seed=seed)
        for t in range(250):
            if t % 40 >= 20:
                env.set_observation_time(None)
            info = env.step(at_hazard(env.unwrapped))[4]
            braked += info["lease/braking"]
            entered += info["cost_hazards"] > 0.0
    assert entered == 0 and braked > 100


# Functions ----------------------------------------------------------------------------------------------------


def told(answer, **more):
    env = sw.LeaseExpiry(
        BrakedCart(),
        sw.StoppingBudget(lambda env: answer, braking=1.0, acceleration=0.0),
        fallback="zero",
        max_lease_s=2.0,
        **more,
    )
    env.reset()
    return env


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("where", [0, 1])
def test_a_reading_that_is_not_finite_revokes(bad, where):
    answer = [[9.0, 9.0], [0.1, 0.1]]
    env = told(answer)
    assert granted(env, FULL) is not None
    answer[where][1] = bad
    info = env.step(FULL)[4]
    assert info["lease/refused"] and info["lease/braking"] and info["lease/remaining_s"] == 0.0
    answer[where][1] = 0.1
    assert granted(env, FULL) is not None


@pytest.mark.parametrize(
    ("clearance", "more"),
    [
        (rail(), {"acceleration": 1.0}),
        (sw.constraints.JointPositionLimit(-0.8, 0.8, ["slider"]), {"closing_speed": 4.0}),
    ],
)
def test_a_mujoco_state_that_is_not_a_number_revokes_and_nothing_else_passes(clearance, more):
    env = lease(gym.make("InvertedPendulum-v5"), clearance, **more)
    env.reset(seed=0)
    env.step(np.zeros(1, np.float32))
    env.unwrapped.data.qpos[0] = np.nan
    sent = []
    env.env.step = lambda action: (sent.append(action), (None, 0.0, False, False, {}))[1]
    info = env.step(np.ones(1, np.float32))[4]
    assert info["lease/refused"] and info["lease/braking"]
    assert sent[0].tolist() == [0.0]


# Bad input ----------------------------------------------------------------------------------------------------


def test_least_s_needs_a_filter_inside_and_no_more_than_max_lease_s():
    with pytest.raises(ConfigurationError, match=r"min_lease_s.*CBFActionFilter"):
        told((1.0, 0.0), min_lease_s=0.1)
    inside = sw.CBFActionFilter(gym.make("InvertedPendulum-v5"), [rail()])
    with pytest.raises(ConfigurationError, match="min_lease_s"):
        sw.LeaseExpiry(inside, sw.StoppingBudget(rail(), acceleration=1.0), min_lease_s=2.0)
    with pytest.raises(ConfigurationError, match="min_lease_s"):
        sw.LeaseExpiry(inside, sw.StoppingBudget(rail(), acceleration=1.0), min_lease_s=-0.1)


@pytest.mark.parametrize(
    ("clearance", "given", "needed"),
    [
        (lambda env: (1.0, 0.0), {"acceleration": 1.0}, "acceleration and braking"),
        (lambda env: (1.0, 0.0), {"braking": 1.0}, "acceleration and braking"),
        (rail(), {}, "takes acceleration, and maybe top_speed"),
        (rail(), {"acceleration": 1.0, "braking": 9.0}, "takes acceleration, and maybe top_speed"),
        (sw.constraints.JointSpeedLimit(1.0), {"acceleration": 1.0}, "takes closing_speed; got"),
        (
            sw.constraints.JointSpeedLimit(1.0),
            {"closing_speed": 1.0, "top_speed": 1.0},
            "takes closing_speed;",
        ),
    ],
)
def test_a_budget_takes_the_bounds_that_belong_to_its_clearance(clearance, given, needed):
    with pytest.raises(ConfigurationError, match=needed):
        sw.StoppingBudget(clearance, **given)


def test_the_margin_of_a_value_is_no_room():
    times = []
    for margin in (0.0, 0.2):
        limit = sw.constraints.JointPositionLimit(-0.8, 0.8, ["slider"], margin=margin)
        env = sw.LeaseExpiry(gym.make("InvertedPendulum-v5"), sw.StoppingBudget(limit, closing_speed=4.0))
        env.reset(seed=0)
        env._budget.measure()
        times.append(env._budget.longest_time())
    assert times[0] - times[1] == pytest.approx(0.2 / 4.0)


class Checked(sw.Constraint):
    """A constraint that only a state can show to be wrong."""

    def rows(self):
        raise AssertionError("a lease needs no rows")

    def h_along(self, path):
        return np.ones((1, 1))

    def observe(self, memory):
        if self.plant.qpos[0] > 1.0:
            raise ConfigurationError("too far out")


def test_what_only_a_state_can_show_is_refused_at_the_reset():
    cart = gym.make("InvertedPendulum-v5")
    lease = sw.LeaseExpiry(cart, sw.StoppingBudget(Checked(), closing_speed=1.0))
    lease.reset(seed=0)
    cart.unwrapped.reset_model = lambda: cart.unwrapped.set_state(np.array([2.0, 0.0]), np.zeros(2))
    with pytest.raises(ConfigurationError, match="too far out"):
        lease.reset(seed=0)


HOLD, BRAKING = 0.1, 4.0


def measured(room, own, **delay):
    """The budget of a cart at rest, so far from a wall."""
    cart, plant = BrakedCart(dt=HOLD, wall=room), cart_plant(HOLD)
    wall = sw.constraints.Plane([room], [-1.0])
    clearance = sw.constraints.Clearance([wall], braking=BRAKING, position=[0], velocity=[1], **own)
    cart.reset()
    # So fast a cart could be that no command is let through unseen.
    plant.bind(cart)
    bound = BoundBudget(sw.StoppingBudget(clearance, acceleration=1e3, **delay), cart, plant)
    bound.measure()
    return bound


def throttle(value):
    return np.array([value, 0.0])


@pytest.mark.parametrize("room", [0.0, 0.002, 0.008])
@pytest.mark.parametrize(
    "own", [{}, {"margin": 0.2}, {"state_error": 0.2}, {"margin": 0.05, "state_error": 0.03}], ids=str
)
def test_what_a_command_may_do_counts_the_clearances_reserves(own, room):
    """From rest, one hold of an acceleration takes a h^2 / 2, and one hold of braking back to rest as much."""
    budget = measured(room + sum(own.values()), own)
    most = room / HOLD**2
    for more, admitted in ((-1.0, True), (-1e-6, True), (1e-6, False), (0.5, False)):
        assert budget.can_stop_after(throttle(most + more), HOLD) == admitted


def test_while_the_brake_only_begins_to_act_no_command_is_known_to_lead_away():
    for delays_s, admitted in ((0.0, True), (0.01, False)):
        budget = measured(0.0, {}, delays_s=delays_s)
        assert budget.longest_time() < HOLD
        assert budget.can_stop_after(throttle(-1.0), HOLD) == admitted
