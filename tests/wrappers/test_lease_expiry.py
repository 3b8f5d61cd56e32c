"""LeaseExpiry against a book-keeping written from its words; what a stop takes by clearances and constraints."""

import copy
import math

import gymnasium as gym
import numpy as np
import pytest
from braked_cart import BrakedCart, cart_plant, lease, read_cart, stop
from gymnasium.envs.mujoco.inverted_pendulum_v5 import InvertedPendulumEnv
from hypothesis import given
from hypothesis import strategies as st
from wrapper_examples import rail

import safe_wrappers as sw
from safe_wrappers.control.watchdog import longest_lease
from safe_wrappers.errors import ConfigurationError

pytestmark = pytest.mark.filterwarnings("ignore:the policy's action is not finite")
FULL = np.array([1.0, 0.0])


def leased(env, **more):
    """The cart under a lease that knows its drive and brake."""
    cart = env.unwrapped
    known = {"braking": cart.braking, "acceleration": cart.drive, "fallback": stop}
    return lease(env, read_cart, **{**known, "plant": cart_plant(cart.dt), **more})


def steps_until_braking(env, action=FULL):
    """Control steps under the lease of one command, which is the last."""
    steps = 0
    while not env.step(action)[4]["lease/braking"]:
        env.set_observation_time(None)
        steps += 1
    return steps


# Against the book -----------------------------------------------------------------------------------------------


def worst_way(tau, v, drive, top=math.inf):
    """The way in tau at full drive (a cart that is too fast already keeps its speed), and the speed then."""
    top = max(top, v)
    if drive == 0.0:
        return v * tau, v
    rising = min(tau, (top - v) / drive)
    cruising = top * (tau - rising) if tau > rising else 0.0
    return v * rising + 0.5 * drive * rising**2 + cruising, v + drive * rising


class Book:
    """What must be sent, step by step: tell it what comes and what is seen."""

    def __init__(self, hold, leases, *, longest, blend):
        self.hold, self.leases, self.longest = hold, leases, longest
        self.blend = math.ceil(blend / hold - 1e-6)
        self.k, self.readings, self.end, self.newest = 0, 0, None, -math.inf
        self.command = self.last = self.fade = None
        self.acting = True  # does the policy act? with nothing executed before there is nothing to blend

    def step(self, action, stamp, seen):
        """The control to be sent, and refused, braking, remaining, by what was seen last: clearance and speed."""
        now, same = self.k * self.hold, 1e-6 * self.hold
        comes = stamp is not None and np.isfinite(action).all() and self.newest - same <= stamp <= now + same
        refused = stamp is not None and not comes
        if comes and stamp > self.newest + same:
            self.newest, self.readings = stamp, self.readings + 1
            lease = min(self.leases(*seen, max(now - stamp, 0.0)), self.longest)
            refused = lease + same < self.hold
            self.end = None if refused else now + lease
        covered = self.end is not None and now + self.hold <= self.end + same
        if covered:
            self.command = np.array(action, np.float64) if comes else self.command
            self.fade = self.fade if self.acting or self.last is None else (self.last, 1)
            target = self.command
        else:
            self.end = self.fade = None
            target = np.array([0.0, 1.0])
        self.acting = covered
        if self.fade is not None:
            latched, i = self.fade
            s = min(i / (self.blend + 1), 1.0)
            target = latched + (6.0 * s**5 - 15.0 * s**4 + 10.0 * s**3) * (target - latched)
            self.fade = latched, i + 1
        self.last = target
        self.k += 1
        remaining = 0.0 if self.end is None else max(self.end - self.k * self.hold, 0.0)
        return target, refused, not covered, remaining


def draw(rng):
    """A cart somewhere in front of a wall, and the lease's arguments, all at random."""

    def maybe(low, high, other=0.0):
        return float(rng.choice([other, rng.uniform(low, high)]))

    dt = float(rng.choice([0.02, 0.1]))
    cart = BrakedCart(dt, drive=maybe(0.2, 3.0), braking=rng.uniform(0.5, 6.0), top=maybe(0.5, 4.0, math.inf))
    cart.delay_s, cart.age_s, cart.noise = maybe(0.0, 4.5 * dt), maybe(0.0, 4 * dt), maybe(0.0, 0.2)
    margin, v = maybe(0.0, 0.2), rng.uniform(0.0, min(cart.top, 4.0))
    cart.reserve = cart.noise + margin
    # Wherever it starts, it can still stop, if the brakes are put on now, with all their delays.
    way, speed = worst_way(cart.delay_s, v, cart.drive, cart.top)
    cart.wall = way + speed**2 / (2.0 * cart.braking) + margin + 2.0 * cart.noise + rng.exponential(1.5)
    cart.start = 0.0, v
    blend, longest = (float(rng.choice([low, rng.uniform(low, 5 * dt)])) for low in (0.0, 2 * dt))
    return cart, {
        "delays_s": cart.delay_s + cart.age_s,
        "max_lease_s": max(longest, blend + 2 * dt),
        "blend_time": blend,
        "top_speed": None if math.isinf(cart.top) else cart.top,
    }


def said(rng, env, before):
    """What the policy says at a step, and the stamp that comes with it."""
    action = np.where(rng.random(2) < 0.5, rng.uniform([-1.0, 0.0], 1.0), FULL)
    what = rng.choice(["fresh", "fresh", "fresh", "none", "repeat", "late", "old", "future", "sick"])
    if what == "sick":
        action[rng.integers(2)] = rng.choice([np.nan, np.inf, -np.inf])
    early = {"late": rng.uniform(0.0, 2.0), "old": 3.0, "future": -rng.uniform(0.1, 2.0)}.get(what, 0.0)
    stamp = {"none": None, "repeat": before}.get(what, env.now_s - early * env.control_dt)
    return action.astype(np.float32), stamp


def follow(seed, steps=40):
    """Two random episodes of wrapper and book side by side; how often each thing happened."""
    rng = np.random.default_rng(seed)
    cart, options = draw(rng)
    env = leased(cart, **options)
    counts = np.zeros(2, int)

    def leases(clearance, v, more):
        known = {"acceleration": cart.drive, "top_speed": cart.top}
        return longest_lease(clearance - cart.reserve, v, cart.braking, options["delays_s"] + more, **known)

    for _ in range(2):
        env.reset(seed=seed)
        book = Book(env.control_dt, leases, longest=options["max_lease_s"], blend=options["blend_time"])
        dead_from, stamp, cart.seen = rng.integers(5, steps), 0.0, None
        for t in range(steps):
            action, stamp = said(rng, env, stamp) if t < dead_from else (FULL, None)
            if stamp != env.now_s or rng.random() < 0.5:
                env.set_observation_time(stamp)
            info = env.step(action)[4]
            # The book runs after the wrapper, and is told what that has seen: for fresh commands alone.
            wanted, refused, braking, remaining = book.step(action, stamp, cart.seen)
            assert cart.readings == book.readings
            assert (info["lease/refused"], info["lease/braking"]) == (refused, braking), f"step {t}"
            # Never longer than the book's, and shorter by no more than what counts as the same time.
            assert remaining - 2e-6 * env.control_dt <= info["lease/remaining_s"] <= remaining + 1e-9
            np.testing.assert_allclose(cart.given[-1], wanted, rtol=0, atol=2e-7)
            counts += refused, braking
        assert cart.farthest <= cart.wall - (cart.reserve - cart.noise) + 1e-9
    return counts


@given(seed=st.integers(0, 2**32 - 1))
def test_every_step_is_what_the_book_says_and_nothing_is_hit(seed):
    follow(seed)


def test_the_random_episodes_have_everything_in_them():
    assert (sum(follow(seed) for seed in range(20)) > 100).all()


# The bound is tight ---------------------------------------------------------------------------------------------


@given(
    dt=st.sampled_from([0.02, 0.1]),
    drive=st.sampled_from([0.0, 1.5]),
    top=st.sampled_from([math.inf, 1.0]),
    braking=st.floats(1.0, 6.0),
    v=st.floats(0.3, 3.0),
    steps=st.integers(2, 40),
    delay_steps=st.floats(0.0, 6.0),
    age_steps=st.floats(0.0, 2.0),
)
def test_a_lease_is_just_long_enough(dt, drive, top, braking, v, steps, delay_steps, age_steps):
    delay, age = delay_steps * dt, age_steps * dt
    way, speed = worst_way(steps * dt + delay + age, v, drive, top)
    cart = BrakedCart(dt, way + speed**2 / (2.0 * braking) + 1e-7, drive, braking, top, delay_s=delay)
    # The worst case of an old reading: full drive from the moment on at which it was taken.
    cart.start, cart.measured = worst_way(age, v, drive, top), lambda: (cart.wall, v)
    declared = {} if math.isinf(top) else {"top_speed": top}
    env = leased(cart, delays_s=delay + age, max_lease_s=10.0, **declared)
    env.reset()
    cart.applied = (1.0, 0.0)
    assert steps_until_braking(env) == steps
    while cart.v > 0.0:
        env.set_observation_time(None)
        env.step(FULL)
    assert 0.0 <= cart.wall - cart.farthest <= 2e-7


@pytest.mark.parametrize(("hair", "steps"), [(5e-7, 4), (-2e-6, 5)])
def test_a_hair_less_than_whole_steps_is_a_step_less(hair, steps):
    # What counts as the same time is never taken from the clearance.
    cart = BrakedCart(wall=0.1 * (5.0 - hair), drive=0.0, v=1.0, braking=1e12)
    env = leased(cart, max_lease_s=9.0)
    env.reset()
    assert steps_until_braking(env) == steps and cart.farthest <= cart.wall


# What is sent ---------------------------------------------------------------------------------------------------


class Scaling(gym.Wrapper):
    """Keeps what it is sent, and spoils it afterwards, as an env that scales in place does."""

    def step(self, action):
        self.sent = np.array(action)
        result = super().step(action)
        if isinstance(action, np.ndarray) and action.flags.writeable:
            action *= np.nan
        return result


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("given_as", [np.float32, np.float64])
def test_commands_pass_and_are_held_bit_for_bit_while_leases_last(dtype, given_as):
    env, rng = leased(Scaling(BrakedCart(wall=1e6, dtype=dtype))), np.random.default_rng(1)
    env.reset(seed=0)
    for _ in range(30):
        action = (rng.uniform([-1.0, 0.0], 1.0) * rng.choice([1.0, 1e-30])).astype(given_as)
        before = action.tobytes()
        for _ in range(2):
            env.step(action)
            assert env.env.sent.tobytes() == before and env.env.sent.dtype == given_as
            env.set_observation_time(None)  # the same bits again
            action = np.zeros(2)
        env.set_observation_time(env.now_s)
    env.step([0.5, 0.25])
    assert env.env.sent.tolist() == [0.5, 0.25]
    with pytest.warns(UserWarning, match=r"left the action space by 1e\+300; it is clipped"):
        info = env.step([1e300, 0.25])[4]
    assert env.env.sent.tolist() == [1.0, 0.25] == info["executed_action"].tolist()
    assert info["action/clipped"] == 1e300


def test_a_fallback_is_asked_at_the_present_state_and_kept_finite_and_in_the_box():
    answers, asked = iter([[np.nan, 1.0], [9.0, -9.0]]), []
    env = leased(
        BrakedCart(v=1.0), fallback=lambda plant: asked.append(plant.state.tolist()) or next(answers)
    )
    states = [env.reset()[0].tolist()]
    for _ in range(2):
        env.set_observation_time(None)
        states.append(env.step(FULL)[0].tolist())
    assert np.array(env.unwrapped.given).tolist() == [[0.0, 0.0], [1.0, 0.0]]
    assert asked == states[:2]


# Clearances, constraints and functions --------------------------------------------------------------------------


def by_clearance(away):
    def longest(x, v):
        rooms, towards = [0.9 - x - away, 0.9 + x - away], [v, -v]
        return longest_lease(rooms, towards, 8.0, 0.01, acceleration=20.0, top_speed=3.0).min()

    return longest


SLIDER = sw.constraints.JointPositionLimit(-0.8, 0.8, ["slider"], margin=0.1)
DRIVEN = {"acceleration": 20.0, "top_speed": 3.0, "delays_s": 0.01}
BUDGETS = {
    "a Clearance": (sw.StoppingBudget(rail(), **DRIVEN), by_clearance(0.0)),
    "its reserves": (sw.StoppingBudget(rail(margin=0.05, state_error=0.02), **DRIVEN), by_clearance(0.07)),
    "a value": (
        sw.StoppingBudget(SLIDER, closing_speed=4.0, delays_s=0.01),
        lambda x, v: (0.7 - abs(x)) / 4.0 - 0.01,
    ),
}


def granted(env, action):
    """The lease that the next fresh command gets, s; None if it is refused."""
    info = env.step(action)[4]
    return None if info["lease/refused"] else info["lease/remaining_s"] + env.control_dt


@pytest.mark.parametrize("kind", BUDGETS)
def test_a_lease_on_a_mujoco_cart_is_the_appendix_s(kind):
    budget, formula = BUDGETS[kind]
    env = sw.LeaseExpiry(gym.make("InvertedPendulum-v5"), budget, max_lease_s=5.0)
    rng, found = np.random.default_rng(0), []
    for _ in range(60):
        env.reset(seed=0)
        x, v = rng.uniform(-0.9, 0.9), rng.uniform(-3.0, 3.0)
        env.unwrapped.set_state(np.array([x, 0.0]), np.array([v, 0.0]))
        wanted = formula(x, v)
        found.append(granted(env, np.zeros(1, np.float32)))
        assert found[-1] == (None if wanted < env.control_dt else pytest.approx(wanted, abs=1e-6))
    assert 5 < found.count(None) < 55


def test_an_error_that_is_in_the_value_is_counted_once():
    leases = []
    for radius, error in ((0.3, 0.0), (0.2, 0.1)):
        discs = [sw.constraints.Discs("hazard_positions", radius)]
        clearance = sw.constraints.HeadingDriveClearance(discs, state_error=error)
        env = lease(gym.make("SafePointGoal1-v0"), clearance, closing_speed=4.0)
        env.reset(seed=0)
        leases.append(granted(env, np.zeros(2, np.float32)))
    assert leases[0] == pytest.approx(leases[1]) and leases[0] < 1.0


@pytest.mark.parametrize("delay", [0.0, 0.2])
@pytest.mark.parametrize("throttle", [0.0, 0.7, -0.7])
def test_a_delayed_plants_prediction_is_used_with_the_commands_in_flight(delay, throttle):
    # It sees the clearance after the delay: the way of the commands that were sent is gone by then.
    near = sw.constraints.Clearance(
        [sw.constraints.Plane([9.0], [-1.0])], braking=4.0, position=[0], velocity=[1]
    )
    env = sw.LeaseExpiry(
        BrakedCart(wall=9.0, v=2.0, drive=1.0, delay_s=delay),
        sw.StoppingBudget(near, acceleration=0.0),
        plant=cart_plant(0.1, delay),
        fallback="zero",
        max_lease_s=9.0,
    )
    env.reset()
    for _ in range(3):
        found = granted(env, np.array([throttle, 0.0]))
    # The third at 0.2 s, when the command of 0 s has acted as long, or just begins to, and will then.
    x, v = 2.0 * (0.2 + delay) + 0.5 * throttle * 0.2**2, 2.0 + throttle * 0.2
    assert found == pytest.approx((9.0 - x - v**2 / 8.0) / v, abs=1e-6)
    # The next episode knows nothing of these commands.
    env.reset()
    assert granted(env, np.zeros(2)) == pytest.approx((9.0 - 2.0 * delay - 0.5) / 2.0, abs=1e-6)


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("where", [0, 1])
def test_a_reading_that_is_not_finite_revokes(bad, where):
    answer = [[9.0, 9.0], [0.1, 0.1]]
    env = lease(BrakedCart(), lambda env: answer, braking=1.0, acceleration=0.0, fallback="zero")
    env.reset()
    assert granted(env, FULL) is not None
    answer[where][1] = bad
    info = env.step(FULL)[4]
    assert info["lease/refused"] and info["lease/braking"] and info["lease/remaining_s"] == 0.0
    answer[where][1] = 0.1
    assert granted(env, FULL) is not None


@pytest.mark.parametrize("coordinate", [0, 1])  # a clearance of the cart says nothing of its pole
@pytest.mark.parametrize("kind", BUDGETS)
def test_a_mujoco_state_that_is_not_a_number_revokes_and_nothing_else_passes(kind, coordinate, monkeypatch):
    env, sent = sw.LeaseExpiry(gym.make("InvertedPendulum-v5"), BUDGETS[kind][0]), []
    env.reset(seed=0)
    env.unwrapped.data.qpos[coordinate] = np.nan
    monkeypatch.setattr(env.env, "step", lambda action: sent.append(action) or (None, 0.0, False, False, {}))
    info = env.step(np.ones(1, np.float32))[4]
    assert info["lease/refused"] and info["lease/braking"] and sent[0].tolist() == [0.0]


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
    env = lease(InvertedPendulumEnv(), Checked(), closing_speed=1.0)
    env.reset(seed=0)
    env.unwrapped.init_qpos[0] = 2.0
    with pytest.raises(ConfigurationError, match="too far out"):
        env.reset(seed=0)


def test_a_copy_of_an_env_that_is_made_anew_does_not_go_on_under_the_lease():
    """Also where Gymnasium's OrderEnforcing is not around the env."""
    env = lease(InvertedPendulumEnv(), rail(), acceleration=30.0)
    for _ in range(2):  # the env itself, then its copy in mid-episode
        with pytest.raises(gym.error.ResetNeeded):
            env.step(env.action_space.high)
        env.reset(seed=0)
        env.step(env.action_space.high)
        env = copy.deepcopy(env)
