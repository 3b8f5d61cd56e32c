"""Integers, float32 and arrays without axes: the same answers as float64, from the public functions of control/."""

import numpy as np
import pytest

from safe_wrappers.control.contact import friction_cone, impact
from safe_wrappers.control.estimation import covariance, kalman, observability
from safe_wrappers.control.filtering import cbf, manipulability
from safe_wrappers.control.handover import polynomials, smoothstep, splines
from safe_wrappers.control.legged import predicted_positions, support
from safe_wrappers.control.teleop import passivity
from safe_wrappers.control.vehicle import slip
from safe_wrappers.control.watchdog import leases, sampling
from safe_wrappers.filter import projection

EYE = [[1, 0], [0, 1]]
EYE3 = [[1, 0, 0], [0, 1, 0], [0, 0, 1]]
CHAIN = [[0, 1], [0, 0]]
UP = [0, 0, 1]
SQUARE = [[0, 0], [2, 0], [2, 2], [0, 2]]
CORNERS = [[0, 0, 0], [2, 0, 0], [2, 2, 0], [0, 2, 0]]

CALLS = {
    "lie_derivatives": (cbf.lie_derivatives, [[1, 2], [3, 4], EYE]),
    "cbf_rows": (cbf.cbf_rows, [2, [3, 1], 2]),
    "numerical_gradient": (lambda x: cbf.numerical_gradient(lambda y: y @ y, x), [[3, 4]]),
    "complementarity_residuals": (impact.complementarity_residuals, [[1, 0], [0, 2]]),
    "discretise": (covariance.discretise, [CHAIN, EYE, 2]),
    "discretise_drift": (covariance.discretise_drift, [CHAIN, [1, 2], 2]),
    "blind_time": (covariance.blind_time, [EYE, CHAIN, EYE, [1, 0], 9, 1, 60]),
    "normal_and_tangential": (friction_cone.normal_and_tangential, [[1, 2, 3], UP]),
    "cone_excess": (friction_cone.cone_excess, [[1, 2, 3], UP, 1]),
    "tangents": (friction_cone.tangents, [UP]),
    "restitution_velocity": (impact.restitution_velocity, [-3, 1]),
    "normal_impulse": (impact.normal_impulse, [2, -3, 1]),
    "in_series": (impact.in_series, [2, 6]),
    "peak_force": (impact.peak_force, [2, 4, 100]),
    "speed_limit": (impact.speed_limit, [2, 4, 100]),
    "time_to_peak": (impact.time_to_peak, [4, 100]),
    "braked_deflection": (impact.braked_deflection, [2, 4, 100, 3, 1]),
    "pushed_peak_force": (impact.pushed_peak_force, [2, 4, 100, 3, 1]),
    "predict": (kalman.predict, [[1, 2], EYE, CHAIN, EYE]),
    "update": (kalman.update, [[1, 2], EYE, [1], [[1, 0]], [[1]]]),
    "longest_lease": (leases.longest_lease, [1, 1, 1, 0]),
    "longest_lease, all": (leases.longest_lease, [9, 2, 1, 1, 1, 1, 1, 4]),
    "longest_lease, jerk": (leases.longest_lease, [9, 2, 1, 1, 1, 1, 1, 4, 3]),
    "longest_lease_of_room": (leases.longest_lease_of_room, [9, 2, 1]),
    "round_trip_ceiling": (leases.round_trip_ceiling, [9, 1, 1, 0, 1, 1]),
    "manipulability": (manipulability.manipulability, [[[1, 2], [0, 3]]]),
    "worst_joint_rates": (manipulability.worst_joint_rates, [[[1, 2], [0, 3]]]),
    "unobservable_directions": (
        lambda a, c: len(observability.unobservable_directions(a, c)),
        [CHAIN, [[1, 0]]],
    ),
    "to_waves": (passivity.to_waves, [2, 3, 4]),
    "effort_and_outgoing": (passivity.effort_and_outgoing, [2, 3, 4]),
    "ChannelLedger": (lambda *a: filled(passivity.ChannelLedger(a[0]), a[1:]), [1, 2, 3, 1, 4, 1, 2]),
    "differentiate": (splines.differentiate, [[1, 2, 3]]),
    "extrema": (polynomials.extrema, [[0, 3, -1], 2]),
    "largest_acceleration": (predicted_positions.largest_acceleration, [2, 1, 1]),
    "project, one row": (lambda *a: projection.project(*a)[0], [[1, 1], [[1, 1]], [1], -1, 1]),
    "project, rows": (lambda *a: projection.project(*a)[0], [[1, 1], [[2, 1], [1, 2]], [1, 1], -1, 1]),
    "hold_lag_s": (sampling.hold_lag_s, [2]),
    "phase_lag": (sampling.phase_lag, [2, 1, 1]),
    "slip_ratio": (slip.slip_ratio, [3, 2, 1]),
    "smoothstep": (smoothstep.smoothstep, [1]),
    "shortest_latched_blend": (smoothstep.shortest_latched_blend, [2, 3]),
    "hermite_series": (splines.hermite_series, [[0, 1, 3], [0, 2, 1], [1, 0, 1], 2]),
    "support_polygon": (support.support_polygon, [SQUARE]),
    "support_rows": (
        lambda p, o, n, i: support.support_rows(p, support.plane(o, n), i),
        [CORNERS, [0, 0, 0], UP, 0],
    ),
}


def filled(ledger, step):
    ledger.add(*step)
    return ledger.created_j, ledger.passive


def as_kind(value, kind):
    """One argument, a number or nested lists of integers, as the kind of number in question."""
    if isinstance(value, list):
        return np.array(value, dtype={"int": np.int64, "0-d": np.float64}.get(kind, kind))
    if kind == "int":
        return value
    return np.array(value, dtype=np.float64) if kind == "0-d" else np.dtype(kind).type(value)


def parts(answer):
    """The numbers in an answer, flat."""
    several = isinstance(answer, tuple)
    return [np.asarray(part, dtype=np.float64) for part in (answer if several else (answer,))]


@pytest.mark.parametrize("kind", ["int", "float32", "0-d"])
@pytest.mark.parametrize("name", CALLS)
def test_the_answer_does_not_depend_on_the_kind_of_number(name, kind):
    function, arguments = CALLS[name]
    expected = parts(function(*(as_kind(value, "float64") for value in arguments)))
    found = parts(function(*(as_kind(value, kind) for value in arguments)))
    for one, other in zip(expected, found, strict=True):
        np.testing.assert_allclose(other, one, rtol=1e-12, atol=1e-12)
