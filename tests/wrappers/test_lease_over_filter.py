"""LeaseExpiry around a filter: what the filter executed is where the way to the fallback begins."""

import numpy as np
import pytest
from worlds import Cart, Raw, cart_plant

import safe_wrappers as sw

HOLD, MOST = 0.1, np.float32(0.3)


def far_away(env):
    return [1e6], [0.0]


def leased(**options):
    """Leases of one control step over a filter that lets no more than MOST through."""
    cart = Cart(HOLD)
    inside = sw.CBFActionFilter(cart, [Raw([[1.0]], [float(MOST)])], plant=cart_plant(HOLD))
    budget = sw.StoppingBudget(far_away, braking=1.0, acceleration=1.0)
    env = sw.LeaseExpiry(inside, budget, max_lease_s=HOLD, **options)
    env.reset(seed=0)
    return cart, env


def smooth(s):
    return 6.0 * s**5 - 15.0 * s**4 + 10.0 * s**3


def test_braking_blends_from_what_the_filter_let_through():
    cart, env = leased(fallback="zero", brake_blend_time=3 * HOLD)
    env.step(np.ones(1, np.float32))
    assert cart.given[-1][0] == pytest.approx(MOST)
    for k in range(1, 5):
        env.set_observation_time(None)
        assert env.step(np.ones(1, np.float32))[4]["lease/braking"]
        left = 1.0 - smooth(min(k / 4.0, 1.0))
        assert cart.given[-1][0] == pytest.approx(left * MOST, abs=1e-6)
