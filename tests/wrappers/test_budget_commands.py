"""StoppingBudget: which commands it lets through beside the limit, where only the rows of a Clearance know them."""

import numpy as np
import pytest
from braked_cart import BrakedCart, cart_plant

import safe_wrappers as sw
from safe_wrappers.wrappers.stopping_budget import BoundBudget

HOLD, BRAKING = 0.1, 4.0


def measured(room, own, reserves):
    """The budget of a cart at rest, so far from a wall."""
    cart, plant = BrakedCart(dt=HOLD, wall=room), cart_plant(HOLD)
    wall = sw.constraints.Plane([room], [-1.0])
    clearance = sw.constraints.Clearance([wall], braking=1.0, position=[0], velocity=[1], **own)
    cart.reset()
    # So fast a cart could be that no command is let through unseen.
    bound = BoundBudget(sw.StoppingBudget(clearance, BRAKING, acceleration=1e3, **reserves), cart)
    plant.bind(cart)
    bound.bind(bound.plant_of(plant))
    bound.reset()
    bound.measure()
    return bound


def throttle(value):
    return np.array([value, 0.0])


@pytest.mark.parametrize("room", [0.0, 0.002, 0.008])
@pytest.mark.parametrize(
    ("own", "extra"),
    [
        ({}, {}),
        ({"margin": 0.2}, {}),
        ({"state_error": 0.2}, {}),
        ({}, {"margin": 0.2}),
        ({}, {"localisation": 0.2}),
        ({"margin": 0.05, "state_error": 0.03}, {"margin": 0.08, "localisation": 0.04}),
    ],
    ids=str,
)
def test_what_a_command_may_do_counts_the_clearances_reserves_and_the_budgets(own, extra, room):
    """From rest, one hold of an acceleration takes a h^2 / 2, and one hold of braking back to rest as much."""
    left = room + sum(own.values()) + sum(extra.values())
    budget = measured(left, own, extra)
    most = room / HOLD**2
    for more, admitted in ((-1.0, True), (-1e-6, True), (1e-6, False), (0.5, False)):
        assert budget.can_stop_after(throttle(most + more), HOLD) == admitted


def test_while_the_brake_only_begins_to_act_no_command_is_known_to_lead_away():
    for act_s, admitted in ((0.0, True), (0.01, False)):
        budget = measured(0.0, {}, {"act_s": act_s})
        assert budget.longest_time() < HOLD
        assert budget.can_stop_after(throttle(-1.0), HOLD) == admitted
