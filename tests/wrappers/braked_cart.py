"""A cart that is driven at a wall and has a brake, exact in continuous time; and the lease's book-keeping, by hand.

`Book` is the oracle of LeaseExpiry: written from its docstring and the appendix's inequality alone, in plain scalars,
with a bisection where the library has a closed form.
"""

import math
from dataclasses import fields

import gymnasium as gym
import numpy as np

import safe_wrappers as sw


class BrakedCart(gym.Env):
    """x'' = drive * throttle - braking * brake while it moves forward; the brake lets it stand.

    Actions are (throttle in [-1, 1], brake in [0, 1]). A command takes effect `delay_s` after it was sent; until the
    first one the cart rolls on. `reading` is `age_s` old and off by at most `noise`. Motion is solved piece by piece,
    so that `farthest` is exact between samples, too. A receding cart is not braked.
    """

    def __init__(
        self,
        dt=0.1,
        wall=10.0,
        drive=2.0,
        braking=4.0,
        top=math.inf,
        x=0.0,
        v=0.0,
        delay_s=0.0,
        age_s=0.0,
        noise=0.0,
        reserve=0.0,
        dtype=np.float32,
    ):
        self.dt, self.wall, self.drive, self.braking, self.top = dt, wall, drive, braking, top
        self.start, self.delay_s, self.age_s, self.noise = (x, v), delay_s, age_s, noise
        self.reserve = reserve
        self.action_space = gym.spaces.Box(
            np.array([-1.0, 0.0], dtype), np.array([1.0, 1.0], dtype), dtype=dtype
        )
        self.observation_space = gym.spaces.Box(-np.inf, np.inf, (2,), np.float64)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.x, self.v = (options or {}).get("start", self.start)
        self.t, self.readings, self.given = 0.0, 0, []
        self.applied, self.coming = (0.0, 0.0), []
        self.pieces = [(-math.inf, self.x, self.v, 0.0)]
        self.farthest = self.x
        self.hidden = np.random.default_rng(seed)
        return np.array([self.x, self.v]), {}

    def step(self, action):
        action = np.array(action)
        self.given.append(action)
        assert np.isfinite(action).all()
        throttle, brake = np.clip(action.astype(np.float64), [-1.0, 0.0], [1.0, 1.0])
        self.coming.append((self.t + self.delay_s, (float(throttle), float(brake))))
        end = len(self.given) * self.dt
        while self.coming and self.coming[0][0] < end:
            due, command = self.coming.pop(0)
            self._roll(due - self.t)
            self.applied = command
        self._roll(end - self.t)
        self.t = end
        return np.array([self.x, self.v]), -abs(float(throttle)), False, False, {}

    def _roll(self, left):
        throttle, brake = self.applied
        while left > 0.0:
            pull, drag = throttle * self.drive, brake * self.braking
            a = pull
            if self.v > 0.0:
                a = pull - drag
            elif self.v == 0.0 and pull > 0.0:
                a = max(pull - drag, 0.0)
            if self.v >= self.top and a > 0.0:
                a = 0.0
            step, reached = left, None
            if self.v * a < 0.0 and -self.v / a <= step:
                step, reached = -self.v / a, 0.0
            if a > 0.0 and self.v < self.top and (self.top - self.v) / a < step:
                step, reached = (self.top - self.v) / a, self.top
            self.pieces.append((self.t, self.x, self.v, a))
            self.x += self.v * step + 0.5 * a * step**2
            self.v = self.v + a * step if reached is None else reached
            self.t += step
            left -= step
            self.farthest = max(self.farthest, self.x)

    def measured(self):
        """Clearance and approach speed as they were `age_s` ago, seen with an error."""
        self.readings += 1
        then = self.t - self.age_s
        since, x, v, a = next(p for p in reversed(self.pieces) if p[0] <= then)
        if since == -math.inf:  # before the episode it cruised
            since, a = 0.0, 0.0
        error = self.hidden.uniform(-self.noise, self.noise)
        self.seen = (
            self.wall - (x + v * (then - since) + 0.5 * a * (then - since) ** 2) + error,
            (v + a * (then - since)),
        )
        return self.seen


def read_cart(env):
    """For LeaseExpiry's `clearance`: less what it may be wrong by, and what is to be kept."""
    clearance, speed = env.unwrapped.measured()
    return [clearance - env.unwrapped.reserve], [speed]


def lease(env, clearance, **options):
    """A LeaseExpiry, with the options of its budget among the others."""
    budget = {f.name: options.pop(f.name) for f in fields(sw.StoppingBudget) if f.name in options}
    return sw.LeaseExpiry(env, sw.StoppingBudget(clearance, **budget), **options)


def stop(plant):
    """Throttle off, full brake: LeaseExpiry's `fallback`."""
    return np.array([0.0, 1.0])


def _drift(x):
    return np.array([x[1], 0.0])


def _push(x):
    return np.array([[0.0, 0.0], [1.0, -1.0]])


def _state(env):
    return np.array([env.x, env.v])


def cart_plant(dt):
    """For fallbacks, which want one."""
    return sw.AnalyticPlant(f=_drift, g=_push, state=_state, control_dt=dt)


def worst_way(tau, v, drive, top):
    """The way in tau at full drive (a cart that is too fast already keeps its speed), and the speed then."""
    top = max(top, v)
    if drive == 0.0:
        return v * tau, v
    rising = min(tau, (top - v) / drive)
    cruising = top * (tau - rising) if tau > rising else 0.0
    return v * rising + 0.5 * drive * rising**2 + cruising, v + drive * rising


def lease_by_bisection(clearance, v, braking, drive, top, reserve, delays):
    """The longest lease by the appendix's inequality, found by trying."""
    if not all(map(math.isfinite, (clearance, v))):
        return -math.inf
    room = clearance - reserve

    def fits(tau):
        way, speed = worst_way(tau, v, drive, top)
        return way + max(speed, 0.0) ** 2 / (2.0 * braking) <= room

    if v <= 0.0 and room <= 0.0:
        return -math.inf
    if not fits(0.0):
        return -1.0
    low, high = 0.0, 1e3
    if fits(high):
        return high - delays
    for _ in range(100):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if fits(middle) else (low, middle)
    return low - delays


def smooth(s):
    return 6.0 * s**5 - 15.0 * s**4 + 10.0 * s**3


class Book:
    """What must be sent, step by step: tell it what comes and what is seen."""

    def __init__(self, hold, leases, *, longest, blend):
        self.hold, self.leases, self.longest = hold, leases, longest
        self.blend = math.ceil(blend / hold - 1e-6)
        self.k, self.end, self.newest = 0, None, -math.inf
        self.command = self.last = None
        self.acting = True  # does the policy act? with nothing executed before there is nothing to blend
        self.fade = None

    def step(self, action, stamp, see):
        """The control to be sent, and refused, braking, remaining; `see` reads clearance and speed."""
        now, same = self.k * self.hold, 1e-6 * self.hold
        comes, refused, fresh = stamp is not None, False, False
        if comes:
            usable = np.isfinite(action).all()
            usable &= self.newest - same <= stamp <= now + same
            comes, refused = bool(usable), not usable
            fresh = comes and stamp > self.newest + same
        if fresh:
            self.newest = stamp
            old = max(now - stamp, 0.0)
            lease = min(self.leases(*see(), old), self.longest)
            self.granted = lease + same >= self.hold
            if self.granted:
                self.end = now + lease
            else:
                self.end, refused = None, True
        covered = self.end is not None and now + self.hold <= self.end + same
        if covered:
            if comes:
                self.command = np.array(action, np.float64)
            if not self.acting:
                self._switch(True, self.blend)
            target = self.command
        else:
            self.end = None
            if self.acting:
                self._switch(False, 0)
            target = np.array([0.0, 1.0])
        if self.fade is not None:
            latched, n, i = self.fade
            self.fade = (latched, n, i + 1) if i + 1 < n else None
            target = latched + smooth((i + 1) / (n + 1)) * (target - latched)
        self.last = target
        self.k += 1
        remaining = 0.0 if self.end is None else max(self.end - self.k * self.hold, 0.0)
        return target, refused, not covered, remaining

    def _switch(self, acting, steps):
        self.acting = acting
        self.fade = (self.last, steps, 0) if steps and self.last is not None else None
