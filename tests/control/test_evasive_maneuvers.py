"""Evasive manoeuvres against the manoeuvre played hold by hold, physics step by physics step."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from safe_wrappers.control.backup.damped_axis import damped_axis
from safe_wrappers.control.backup.evasive_maneuvers import EvasiveManeuvers, Maneuver

AXES = (
    damped_axis(0.98, 0.04, 0.01, 4, -1.0, 1.0),
    damped_axis(1.0, 0.05, 0.02, 3, -0.7, 1.3),  # no damping, and stronger one way than the other
)
BANK = [
    Maneuver(0.0, 0.0, 0),
    Maneuver(1.0, 0.0, 1),
    Maneuver(-1.0, 0.0, 5),
    Maneuver(0.0, 1.0, 9),
    Maneuver(0.5, -1.0, 20),
]
INSTANTS = np.arange(0, 41, 2)


def substeps(axis, x, v, control):
    for _ in range(axis.substeps):
        v = axis.decay * v + axis.gain * control
        x += axis.timestep * v
    return x, v


def played(axis, x, v, share, going, holds):
    """Positions after every hold: full force, then the brake, in its last hold just to rest."""
    force = share * (axis.high if share > 0 else -axis.low)
    xs = [x]
    for k in range(holds):
        if k < going:
            control = force
        else:  # the control that ends the hold at rest, as far as the axis has it
            (_, free), (_, pushed) = substeps(axis, 0.0, v, 0.0), substeps(axis, 0.0, 0.0, 1.0)
            control = float(np.clip(-free / pushed, axis.low, axis.high))
        x, v = substeps(axis, x, v, control)
        xs.append(x)
    return xs


speed = st.floats(-6.0, 6.0)


@given(position=st.tuples(speed, speed), velocities=st.lists(st.tuples(speed, speed), min_size=1, max_size=4))
def test_every_way_is_the_manoeuvre_played(position, velocities):
    bank = EvasiveManeuvers(AXES, BANK, INSTANTS)
    velocity = np.array(velocities)
    which = np.array([4, 0, 2, 3])
    starts = np.broadcast_to(np.array(position), velocity.shape)
    ways = bank.paths(starts, velocity, which)
    for i, axis in enumerate(AXES):
        for c, v in enumerate(velocity[:, i]):
            for row, m in enumerate(which):
                xs = played(axis, position[i], float(v), BANK[m][i], BANK[m].holds, int(INSTANTS[-1]))
                np.testing.assert_allclose(ways[i][c, row], np.array(xs)[INSTANTS], rtol=0, atol=1e-9)


def test_speeds_at_the_knots_are_as_exact():
    bank = EvasiveManeuvers(AXES, BANK[:1], INSTANTS)
    for i, axis in enumerate(AXES):
        for brake, direction in ((-axis.low, 1.0), (axis.high, -1.0)):
            v = 0.0
            for _ in range(5):
                v = (v + axis.add * brake) / axis.keep
                velocity = np.zeros((1, 2))
                velocity[0, i] = direction * v
                way = bank.paths(np.zeros((1, 2)), velocity, np.array([0]))[i][0, 0]
                xs = played(axis, 0.0, direction * v, 0.0, 0, int(INSTANTS[-1]))
                np.testing.assert_allclose(way, np.array(xs)[INSTANTS], rtol=0, atol=1e-9)


@pytest.mark.parametrize("m", range(len(BANK)))
def test_the_first_control_begins_the_manoeuvre(m):
    bank = EvasiveManeuvers(AXES, BANK, np.arange(0, 41))
    velocity = np.array([1.1, -0.4])
    control = bank.first(m, velocity)
    for i, axis in enumerate(AXES):
        after = substeps(axis, 0.3, velocity[i], control[i])[0]
        way = bank.paths(np.array([[0.3, 0.3]]), velocity[None], np.array([m]))[i][0, 0]
        assert after == pytest.approx(way[1], abs=1e-12)
    assert (np.abs(control) <= [1.0, 1.3]).all() and control[1] >= -0.7


def test_it_stays_where_it_has_come_to_rest():
    bank = EvasiveManeuvers(AXES, BANK, np.array([0, 60, 61, 80]))
    for way in bank.paths(np.zeros((1, 2)), np.array([[2.0, -2.0]]), np.arange(len(BANK))):
        assert (np.ptp(way[..., 1:], axis=-1) < 1e-12).all()
