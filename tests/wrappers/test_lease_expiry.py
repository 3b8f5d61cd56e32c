"""LeaseExpiry against a book-keeping written from its words, on carts that are driven at walls."""

import copy
import math
import warnings

import gymnasium as gym
import numpy as np
import pytest
from braked_cart import Book, BrakedCart, cart_plant, lease, lease_by_bisection, read_cart, stop, worst_way
from gymnasium.envs.mujoco.inverted_pendulum_v5 import InvertedPendulumEnv
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import safe_wrappers as sw
from safe_wrappers.wrappers.stopping import BoundBudget

pytestmark = pytest.mark.filterwarnings("ignore:the policy's action is not finite")
FULL = np.array([1.0, 0.0])


def leased(env, **more):
    """The cart under a lease that knows its drive and brake."""
    cart = env.unwrapped
    known = {"braking": cart.braking, "acceleration": cart.drive, "fallback": stop}
    return lease(env, read_cart, **{**known, "plant": cart_plant(cart.dt), **more})


def lease_info(info):
    return tuple(info[f"lease/{k}"] for k in ("refused", "braking"))


def draw(rng):
    """A cart somewhere in front of a wall, and the lease's arguments, all at random."""
    dt = float(rng.choice([0.02, 0.1]))
    cart = {
        "dt": dt,
        "drive": float(rng.choice([0.0, rng.uniform(0.2, 3.0)])),
        "braking": rng.uniform(0.5, 6.0),
        "top": float(rng.choice([math.inf, rng.uniform(0.5, 4.0)])),
        "age_s": float(rng.choice([0.0, rng.uniform(0.0, 4 * dt)])),
        "noise": float(rng.choice([0.0, rng.uniform(0.0, 0.2)])),
    }
    v = rng.uniform(0.0, min(cart["top"], 4.0))
    cart["delay_s"] = float(rng.uniform(0.0, 4.5 * dt) * rng.integers(0, 2))
    margin = float(rng.choice([0.0, rng.uniform(0.0, 0.2)]))
    cart["reserve"] = cart["noise"] + margin
    options = {
        "delays_s": cart["delay_s"] + cart["age_s"],
        "max_lease_s": float(rng.choice([2 * dt, 5 * dt, rng.uniform(2 * dt, 1.0), 1.0])),
        "blend_time": float(rng.choice([0.0, dt, rng.uniform(0.0, 5 * dt)])),
        "top_speed": None if math.isinf(cart["top"]) else cart["top"],
    }
    options["max_lease_s"] = max(options["max_lease_s"], options["blend_time"] + 2 * dt)
    # Wherever it starts, it can still stop, if the brakes are put on now, with all their delays.
    way, speed = worst_way(cart["delay_s"], v, cart["drive"], cart["top"])
    reserve = margin + 2.0 * cart["noise"]
    cart["wall"] = way + speed**2 / (2.0 * cart["braking"]) + reserve + rng.exponential(1.5)
    cart["v"] = v
    return cart, options


def said(rng, env, t):
    """What the policy says at a step, and the stamp that comes with it."""
    action = np.where(rng.random(2) < 0.5, rng.uniform([-1.0, 0.0], 1.0), FULL)
    what = rng.choice(["fresh", "fresh", "fresh", "none", "repeat", "late", "old", "future", "sick"])
    now = t * env.control_dt
    stamps = {
        "none": None,
        "late": now - rng.uniform(0.0, 2.0) * env.control_dt,
        "old": now - 3.0 * env.control_dt,
    }
    stamps["future"] = now + rng.uniform(0.1, 2.0) * env.control_dt
    if what == "repeat" and t:
        stamps["repeat"] = env.repeated
    if what == "sick":
        action[rng.integers(2)] = rng.choice([np.nan, np.inf, -np.inf])
    env.repeated = stamps.get(what, now) if what != "none" else now
    return action.astype(env.action_space.dtype), stamps.get(what, now)


# Against the book ---------------------------------------------------------------------------------------------


def follow(seed, steps=60):
    """One random episode of wrapper and book side by side; how often each thing happened."""
    rng = np.random.default_rng(seed)
    arguments, options = draw(rng)
    cart = BrakedCart(**arguments)
    env = leased(cart, **options)
    env.reset(seed=seed)
    reserve, fixed = cart.reserve, options["delays_s"]

    def lease(clearance, speed, more):
        return lease_by_bisection(clearance, speed, cart.braking, cart.drive, cart.top, reserve, fixed + more)

    book = Book(
        env.control_dt,
        lease,
        longest=options["max_lease_s"],
        blend=options["blend_time"],
    )
    read = []

    def see():
        read.append(True)
        return cart.seen  # what the wrapper saw: the book runs after it

    dead_from = rng.integers(5, steps)
    counts = np.zeros(2, int)
    for t in range(steps):
        action, stamp = said(rng, env, t)
        if t >= dead_from:
            stamp = None
        if stamp != t * env.control_dt or rng.random() < 0.5:
            env.set_observation_time(stamp)
        asked = len(read)
        before = cart.readings
        info = env.step(action)[4]
        wanted, *flags, remaining = book.step(action, stamp, see)
        assert cart.readings - before == len(read) - asked  # the clearance is read for fresh commands alone
        assert lease_info(info) == tuple(flags), f"step {t}"
        # Never longer than the book's, and shorter by no more than what counts as the same time.
        assert remaining - 2e-6 * env.control_dt <= info["lease/remaining_s"] <= remaining + 1e-9
        np.testing.assert_allclose(cart.given[-1], wanted, rtol=0, atol=2e-7)
        counts += flags
    assert cart.farthest <= cart.wall - (reserve - cart.noise) + 1e-9
    return counts


@settings(suppress_health_check=list(HealthCheck))
@given(seed=st.integers(0, 2**32 - 1))
def test_every_step_is_what_the_book_says_and_nothing_is_hit(seed):
    follow(seed)


def test_the_random_episodes_have_everything_in_them():
    counts = sum(follow(seed) for seed in range(30))
    assert (counts > 20).all(), counts


# The bound is tight -------------------------------------------------------------------------------------------


@pytest.mark.parametrize("dt", [0.02, 0.1])
@pytest.mark.parametrize("drive", [0.0, 1.5])
def test_the_lease_is_just_long_enough_and_one_five_percent_longer_hits(dt, drive, monkeypatch):
    rng = np.random.default_rng(int(100 * dt + 10 * drive))
    true = BoundBudget.longest_time
    hits = 0
    for _ in range(20):
        braking, v, steps = rng.uniform(1.0, 6.0), rng.uniform(0.3, 3.0), int(rng.integers(20, 40))
        delay, age = rng.uniform(0.0, 6.0 * dt), rng.uniform(0.0, 2.0 * dt)
        tau = steps * dt + delay + age
        way, speed = worst_way(tau, v, drive, math.inf)
        # The lease is worth exactly so many steps. It is granted `age` late: the cart has sped up by nothing, then.
        wall = way + speed**2 / (2.0 * braking) + 1e-7
        for stretch in (1.0, 1.05):
            monkeypatch.setattr(BoundBudget, "longest_time", lambda self, d, s=stretch: s * true(self, d))
            cart = BrakedCart(dt, wall, drive, braking, v=v, delay_s=delay)
            # The worst case of an old reading: full drive from the moment on at which it was taken.
            cart.reset()
            x, now = worst_way(age, v, drive, math.inf)
            env = leased(cart, delays_s=delay + age, max_lease_s=10.0)
            env.reset(options={"start": (x, now)})
            cart.applied = (1.0, 0.0)
            cart.measured = lambda w=wall, v=v: (w, v)
            braked = [env.step(FULL)[4]["lease/braking"]]
            while cart.v > 0.0 and len(braked) < 2000:
                env.set_observation_time(None)
                braked.append(env.step(FULL)[4]["lease/braking"])
            assert cart.v == 0.0
            if stretch == 1.0:
                assert braked.index(True) == steps
                assert 0.0 <= cart.wall - cart.farthest <= 2e-7
            else:
                assert braked.index(True) > steps
                hits += cart.farthest > cart.wall
    assert hits == 20


@pytest.mark.parametrize("part", ["delay_s", "age_s", "noise"])
def test_every_part_of_the_budget_is_needed(part):
    # Among random worlds none is hit with it, and some are without it.
    hits = {True: 0, False: 0}
    for seed in range(200):
        for counted in hits:
            rng = np.random.default_rng(seed)
            dt = 0.02
            size = 0.3 if part == "noise" else rng.uniform(3.0, 10.0) * dt
            counted_as = "reserve" if part == "noise" else "delays_s"
            known = {counted_as: size if counted else 0.0}
            cart = BrakedCart(
                dt,
                drive=3.0,
                braking=2.0,
                v=1.0,
                wall=rng.uniform(1.5, 4.0),
                reserve=known.pop("reserve", 0.0),
                **{part: size},
            )
            env = leased(cart, max_lease_s=2.0, **known)
            env.reset(seed=seed)
            dead_from = rng.integers(1, 20)
            for t in range(80):
                if t >= dead_from:
                    env.set_observation_time(None)
                env.step(FULL)
            hits[counted] += cart.farthest > cart.wall
    assert hits[True] == 0 and hits[False] > 5, hits


def test_a_hair_less_than_whole_steps_is_a_step_less():
    # What counts as the same time is never taken from the clearance.
    for hair, steps in ((5e-7, 4), (-2e-6, 5)):
        cart = BrakedCart(wall=0.1 * (5.0 - hair), drive=0.0, v=1.0, braking=1e12)
        env = leased(cart, max_lease_s=9.0)
        env.reset()
        braking = [env.step(FULL)[4]["lease/braking"]]
        for _ in range(6):
            env.set_observation_time(None)
            braking.append(env.step(FULL)[4]["lease/braking"])
        assert braking.index(True) == steps and cart.farthest <= cart.wall


# Authority ----------------------------------------------------------------------------------------------------


def far(**more):
    """A cart with all the room in the world."""
    cart = BrakedCart(wall=1e6, drive=1.0, **more)
    return cart, leased(cart, max_lease_s=0.5, blend_time=0.3)


def test_expired_then_braking_until_something_fresh_comes_and_smoothly_back():
    cart, env = far()
    env.reset()
    infos = [env.step(FULL)[4]]
    for _ in range(9):
        env.set_observation_time(None)
        infos.append(env.step(FULL)[4])
    assert [i["lease/braking"] for i in infos] == [False] * 5 + [True] * 5
    np.testing.assert_allclose(
        [i["lease/remaining_s"] for i in infos[:6]], [0.4, 0.3, 0.2, 0.1, 0, 0], atol=1e-12
    )
    for stamp in (0.0, -1.0, 0.05, 99.0):  # in force before, older, older than the newest, from the future
        env.set_observation_time(0.0 if stamp == 0.05 else stamp)
        assert env.step(FULL)[4]["lease/braking"]
    assert not env.step(FULL)[4]["lease/braking"]
    for _ in range(4):
        env.step(FULL)
    given_ = np.array(cart.given, np.float64)
    into, back = given_[5:8, 1], given_[14:19, 1]
    assert (into == 1.0).all()
    np.testing.assert_allclose(back, [1.0 - smooth_step(i / 4.0) for i in (1, 2, 3, 4, 4)], atol=1e-6)
    # No difference is larger than the steepest of the smoothstep.
    assert np.abs(np.diff(given_[8:], axis=0)).max() <= 1.875 / 3.0


def smooth_step(s):
    return 6 * s**5 - 15 * s**4 + 10 * s**3


def test_refused_brakes_at_once_though_the_old_lease_would_run_on():
    cart = BrakedCart(wall=1e6, drive=1.0)
    env = leased(cart, max_lease_s=1.0)
    env.reset()
    assert env.step(FULL)[4]["lease/remaining_s"] == pytest.approx(0.9)
    cart.wall = cart.x + 0.01
    info = env.step(FULL)[4]
    assert lease_info(info) == (True, True) and info["lease/remaining_s"] == 0.0
    assert cart.given[-1].tolist() == [0.0, 1.0]
    cart.wall = 1e6
    env.set_observation_time(0.1)  # the refused one again, when there is room: still not fresh
    assert env.step(FULL)[4]["lease/braking"]
    assert not env.step(FULL)[4]["lease/braking"]


def test_the_age_of_a_command_counts():
    for age in (0.0, 0.15):
        cart = BrakedCart(wall=10.0, drive=0.0, v=1.0, braking=1e9)
        env = leased(cart, max_lease_s=1e3)
        env.reset()
        for stamp in (0.0, None, None):
            env.set_observation_time(stamp)
            env.step(FULL)
        env.set_observation_time(0.3 - age)
        left = cart.wall - cart.x
        assert env.step(FULL)[4]["lease/remaining_s"] == pytest.approx(left - age - 0.1)


def test_an_older_stamp_is_refused_and_the_command_in_force_goes_on():
    cart, env = far()
    env.reset()
    for u in (0.1, 0.2, 0.3):
        env.step(np.array([u, 0.0]))
    env.set_observation_time(0.1)
    info = env.step(FULL)[4]
    assert lease_info(info) == (True, False)
    assert cart.given[-1][0] == pytest.approx(0.3)
    env.set_observation_time(0.2)  # the evidence in force: executed, on the old lease
    before = cart.readings
    info = env.step(np.array([-0.5, 0.0]))[4]
    assert cart.given[-1][0] == -0.5 and cart.readings == before
    assert info["lease/remaining_s"] == pytest.approx(0.2)


def test_a_chunks_commands_share_one_lease():
    cart = BrakedCart(wall=1e6)
    env = sw.ChunkHandover(
        leased(cart, max_lease_s=0.6), 6, 3, 2, rate_limit=1e3, fallback="zero", plant=cart_plant(0.1)
    )
    env.reset(seed=0)
    infos = [env.step(np.tile([u, 0.0], (6, 1)))[4] for u in (0.1, 0.2, 0.3)]
    # The first chunk comes at step 2; the leases are of 0.6 s from the takeover on, the chunk's age is cut off it.
    assert cart.readings == 3
    assert [i["lease/braking"] for i in infos] == [True, False, False]


# Bit for bit ---------------------------------------------------------------------------------------------------


class Witness(gym.Wrapper):
    """Keeps what is sent, and spoils it afterwards, as an env that scales in place does."""

    def step(self, action):
        self.sent = np.array(action)
        result = super().step(action)
        if isinstance(action, np.ndarray) and action.flags.writeable:
            action *= np.nan
        return result


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_commands_pass_bit_for_bit_while_leases_last(dtype):
    cart = BrakedCart(wall=1e6, dtype=dtype)
    env = leased(Witness(cart))
    env.reset(seed=0)
    rng = np.random.default_rng(1)
    for given_as in (np.float32, np.float64):
        for _ in range(30):
            action = (rng.uniform([-1.0, 0.0], 1.0) * rng.choice([1.0, 1e-30])).astype(given_as)
            before = action.tobytes()
            env.step(action)
            assert env.env.sent.tobytes() == before and env.env.sent.dtype == given_as
            env.set_observation_time(None)  # held: the same bits again
            env.step(np.zeros(2))
            assert env.env.sent.tobytes() == before and env.env.sent.dtype == given_as
    assert env.step([0.5, 0.25])[4]["lease/braking"] is False
    assert env.env.sent.tolist() == [0.5, 0.25]
    with pytest.warns(UserWarning, match="left the action space by 6; it is clipped"):
        info = env.step([7.0, 0.25])[4]
    assert env.env.sent.tolist() == [1.0, 0.25] and info["action/clipped"] == 6.0


@pytest.mark.parametrize("huge", [1e300, -1e300, 1.7e308])
def test_what_is_finite_stays_finite_in_a_blend(huge):
    cart = BrakedCart(wall=1e9, drive=1.0)
    env = leased(Witness(cart), max_lease_s=0.4, blend_time=0.2)
    env.reset()
    rng = np.random.default_rng(0)
    for t in range(30):
        if rng.random() < 0.7 or t < 4:
            env.set_observation_time(None)
        env.step(np.array([huge if t % 2 else -huge, huge]))
        assert np.isfinite(env.env.sent).all()


# Info ----------------------------------------------------------------------------------------------------------


def test_a_filter_inside_has_the_last_word_on_what_was_executed():
    env = gym.make("InvertedPendulum-v5")
    rail = [sw.constraints.Plane([-0.9], [1]), sw.constraints.Plane([0.9], [-1])]
    inside = sw.CBFActionFilter(env, [sw.constraints.Clearance(rail, bodies=["cart"], braking=8.0)])
    env = sw.LeaseExpiry(
        inside,
        sw.StoppingBudget(sw.constraints.Clearance(rail, bodies=["cart"], braking=8.0), acceleration=30.0),
    )
    env.reset(seed=0)
    changed = 0
    for _ in range(40):
        info = env.step(np.array([3.0], np.float32))[4]
        changed += info["executed_action"][0] != 3.0 and not info["lease/braking"]
        if info["cbf/intervened"]:
            assert info["executed_action"] != info["proposed_action"]
    assert changed > 0


def test_a_command_that_is_not_finite_is_warned_of_once_and_refused():
    cart, env = far()
    env.reset()
    env.step(np.array([0.25, 0.0]))
    with pytest.warns(UserWarning, match="not finite"):
        info = env.step(np.array([np.nan, 0.0]))[4]
    assert lease_info(info) == (True, False) and cart.given[-1].tolist() == [0.25, 0.0]
    with warnings.catch_warnings(action="error"):
        env.step(np.array([np.inf, 0.0]))


def test_reset_forgets_the_episode():
    def trace(env):
        seen = [env.reset(seed=0)]
        for t in range(20):
            if t % 4 == 1:
                env.set_observation_time(None)
            *rest, info = env.step(FULL)
            seen.append((*map(str, rest), str(info)))
        return str(seen)

    fresh_, used = leased(BrakedCart(wall=4.0)), leased(BrakedCart(wall=4.0))
    first = trace(fresh_)
    used.reset()
    for _ in range(7):
        used.step(-FULL)
    used.set_observation_time(None)
    assert trace(used) == first
    # An action before the episode's first observation is one of the new episode.
    used.reset()
    assert not used.step(FULL)[4]["lease/braking"]


# Bad input -----------------------------------------------------------------------------------------------------


def test_a_fallback_that_is_not_finite_or_outside_the_box_is_made_so():
    cart = BrakedCart()
    answers = iter([[np.nan, 1.0], [9.0, -9.0]])
    env = leased(cart, fallback=lambda plant: next(answers))
    env.reset()
    for wanted in ([0.0, 0.0], [1.0, 0.0]):
        env.set_observation_time(None)
        env.step(FULL)
        assert cart.given[-1].tolist() == wanted


def test_a_copy_of_an_env_that_is_made_anew_does_not_go_on_under_the_lease():
    """Also where Gymnasium's OrderEnforcing is not around the env."""
    rail = [sw.constraints.Plane([-0.9], [1]), sw.constraints.Plane([0.9], [-1])]
    clearance = sw.constraints.Clearance(rail, bodies=["cart"], braking=8.0)
    env = sw.LeaseExpiry(InvertedPendulumEnv(), sw.StoppingBudget(clearance, acceleration=30.0))
    with pytest.raises(gym.error.ResetNeeded):
        env.step(env.action_space.high)
    env.reset(seed=0)
    env.step(env.action_space.high)
    copied = copy.deepcopy(env)
    with pytest.raises(gym.error.ResetNeeded):
        copied.step(env.action_space.high)
    copied.reset(seed=0)
    copied.step(env.action_space.high)
