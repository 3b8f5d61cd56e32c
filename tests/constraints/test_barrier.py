"""Barrier: the user's own h, its decay, its relative degree and its unit."""

import numpy as np
import pytest
from asking import Asked
from judged_loops import slider

import safe_wrappers as sw
from safe_wrappers.errors import ConfigurationError
from safe_wrappers.filter.bound import Bound


def observed(x):
    """A plant of x' = -x^2 + (4 + x) u in the state x: scalar, so everything can be checked by hand."""
    plant = sw.AnalyticPlant(
        f=lambda x: -(x**2),
        g=lambda x: np.array([[4.0 + x[0]]]),
        state=lambda env: np.array([x]),
        control_dt=0.05,
    )
    plant.bind(slider())
    plant.observe()
    return plant


def h(x):
    return 1.0 - x[0] ** 2


@pytest.mark.parametrize("x", [-0.8, -0.1, 0.3, 0.9])
def test_row_is_the_barrier_condition(x):
    plant = observed(x)
    barrier = Asked(sw.constraints.Barrier(h, alpha=3.0, margin=0.05), plant)
    rows = barrier.rows()
    rng = np.random.default_rng(0)
    for u in rng.uniform(-1, 1, 20):
        step = 1e-6
        rate = (h([x + step * (-(x**2) + (4 + x) * u)]) - h([x])) / step
        left = rate + 3.0 * (h([x]) - 0.05)
        assert rows.offsets[0] - rows.normals[0] @ [u] == pytest.approx(left, abs=1e-4)
    np.testing.assert_allclose(barrier.value(), [h([x])])


def slider_filter(barrier):
    plant = sw.AnalyticPlant(
        f=lambda x: np.array([x[1], 0.0]),
        g=lambda x: np.array([[0.0], [1.0]]),
        state=lambda env: np.concatenate([env.data.qpos, env.data.qvel]),
        control_dt=0.05,
    )
    return sw.CBFActionFilter(slider(), [barrier], plant=plant)


UNITS = [1e-9, 1e3]


def driven(unit):
    """What is executed, and h in its unit, under a policy that heads for a speed beyond the limit."""
    of_h = lambda x: unit * (0.25 - x[1] ** 2)  # noqa: E731
    filtered = slider_filter(sw.constraints.Barrier(of_h, alpha=2.0))
    filtered.reset(seed=0)
    seen = []
    for _ in range(20):
        info = filtered.step(np.array([0.9]))[4]
        assert not info["cbf/fallback"]
        seen.append((info["executed_action"][0], info["cbf/margin"] / unit, info["cbf/intervened"]))
    return np.array(seen, dtype=float)


@pytest.mark.parametrize("unit", UNITS)
def test_the_unit_of_h_does_not_matter(unit):
    one = driven(1.0)
    assert 0 < one[:, 2].sum() < 20 and one[:, 1].min() > -1e-6
    np.testing.assert_allclose(driven(unit), one, atol=1e-5)


@pytest.mark.parametrize("unit", UNITS)
def test_an_h_that_no_control_acts_on_is_refused_in_every_unit(unit):
    for barrier, message in (
        (lambda x: unit, "no control acts on it"),
        (lambda x: unit * (1.0 - x[0]), "relative degree is 2.*put the braking distance into h.*Clearance"),
    ):
        with pytest.raises(ConfigurationError, match=message):
            slider_filter(sw.constraints.Barrier(barrier)).reset(seed=0)


def test_a_decay_that_outruns_the_hold_is_refused():
    Bound(sw.constraints.Barrier(h, alpha=20.0), observed(0.0))
    with pytest.raises(
        ConfigurationError, match=r"alpha = 20.1/s lets h cross zero within one hold of 0.05 s; .* 20/s"
    ):
        Bound(sw.constraints.Barrier(h, alpha=20.1), observed(0.0))
