"""Contacts: pyramids inside their cones, impacts as integrated and as dropped in MuJoCo, and their residuals."""

import math

import mujoco
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from oracles import support_margin
from scipy.integrate import solve_ivp

from safe_wrappers.control.contact import (
    complementarity_residuals,
    cone_excess,
    friction_pyramid,
    peak_force,
    tangents,
)
from safe_wrappers.control.legged import support_distances

UP = np.array([0.0, 0.0, 1.0])
DIRECTIONS = st.tuples(*[st.floats(-1.0, 1.0)] * 3).filter(lambda v: np.linalg.norm(v) > 0.1)


def reach(rows, normal, tangent):
    """How far along a tangent the rows allow a force with one newton along the normal."""
    slope, at = rows @ tangent, -(rows @ normal)
    return float(np.min(at[slope > 1e-12] / slope[slope > 1e-12]))


@given(DIRECTIONS, st.floats(0.01, 3.0), st.integers(3, 40), st.floats(0.0, math.tau))
def test_a_pyramid_is_inside_its_cone_for_any_number_of_edges(normal, friction, edges, angle):
    n = np.array(normal) / np.linalg.norm(normal)
    axes, rows, half = np.vstack([tangents(n), n]), friction_pyramid(n, friction, edges), math.pi / edges
    np.testing.assert_allclose(axes @ axes.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(axes) == pytest.approx(1.0)  # right-handed
    farthest, edge, middle = (
        reach(rows, n, math.cos(turn) * axes[0] + math.sin(turn) * axes[1]) for turn in (angle, 0.0, half)
    )
    assert friction * math.cos(half) * (1 - 1e-9) <= farthest <= friction * (1 + 1e-9)
    # Its edges are on the cone, the middles of its sides where the figure says.
    assert edge == pytest.approx(friction) and middle == pytest.approx(friction * math.cos(half))


def test_four_edges_on_a_floor_are_mujocos_pyramid_and_the_cone_is_its_formula():
    rows = friction_pyramid(UP, 0.8, 4)
    for force in np.random.default_rng(0).normal(0.5, 1.0, size=(500, 3)):
        inside = abs(force[0]) + abs(force[1]) <= 0.8 * force[2]
        assert (rows @ force <= 0.0).all() == inside
        across = math.hypot(force[0], force[1])
        assert cone_excess(force, UP, 0.8) == pytest.approx(max(across - 0.8 * force[2], -force[2]))
    assert math.isnan(cone_excess([0, 0, math.nan], UP, 0.8))


speeds, masses = st.floats(0.01, 10.0), st.floats(0.05, 100.0)
stiffnesses, pushes = st.floats(100.0, 1e6), st.floats(0.0, 300.0)


def integrated(v, m, k, push=0.0, start=0.0):
    """Depth of the first peak, from the equation of motion."""

    def peak(t, x):
        return x[1]

    peak.terminal, peak.direction = True, -1
    period = 2.0 * np.pi * np.sqrt(m / k)
    tight = {"rtol": 1e-11, "atol": 1e-14, "max_step": period / 8.0}
    motion = lambda t, x: [x[1], (push - k * x[0]) / m]  # noqa: E731
    return solve_ivp(motion, (0.0, 10.0 * period), [start, v], "DOP853", events=peak, **tight).y_events[0][0][
        0
    ]


@given(speeds, masses, stiffnesses, pushes, st.floats(0.0, 3.0))
def test_peaks_are_those_of_the_integrated_oscillator(v, m, k, push, depth):
    assert peak_force(v, m, k) == pytest.approx(k * integrated(v, m, k), rel=1e-8)
    assert peak_force(-v, m, k) == 0.0
    # A push that goes on, from any deflection.
    start = depth * v * np.sqrt(m / k)
    deep = integrated(v, m, k, push, start)
    assert peak_force(v, m, k, push, start) == pytest.approx(k * deep, rel=1e-6)


def test_a_drop_in_mujoco_has_the_peak_force_of_its_spring():
    """Negative solref asks for a stiffness per mass; an impedance near 1 leaves it as it is."""
    mass, stiffness, height = 2.0, 2e5, 0.3
    model = mujoco.MjModel.from_xml_string(
        f"""<mujoco><option timestep="2e-5"/>
        <default><geom condim="1" solref="{-stiffness / mass} 0" solimp=".9999 .9999 .001"/></default>
        <worldbody><geom type="plane" size="1 1 .1"/><body pos="0 0 {0.1 + height}"><freejoint/>
        <geom size=".1" mass="{mass}"/></body></worldbody></mujoco>"""
    )
    data, peak = mujoco.MjData(model), 0.0
    while data.time < 0.35:
        mujoco.mj_step(model, data)
        peak = max(peak, data.efc_force.max(initial=0.0))
    fall = np.sqrt(2.0 * 9.81 * height)
    assert peak == pytest.approx(float(peak_force(fall, mass, stiffness, 9.81 * mass)), rel=5e-3)


def test_residuals_are_zero_for_ideal_contacts_and_name_what_is_missed():
    ideal = complementarity_residuals(np.array([0.3, 0.0, 0.0]), np.array([0.0, 0.0, 50.0]))
    assert all((r == 0.0).all() for r in ideal)
    missed = complementarity_residuals(np.array([-0.002, 0.1, 0.0]), np.array([40.0, 5.0, -3.0]))
    assert missed[0].tolist() == [0.002, 0.0, 0.0]
    np.testing.assert_allclose(missed[1], [0.08, 0.5, 0.0])


# Distances of zero moment points from edges, all at once: statics, and polygons built one by one ----------------

CORNERS = np.array([[0.2, 0.1, 0.0], [-0.2, 0.1, 0.0], [-0.2, -0.1, 0.0], [0.2, -0.1, 0.0]])
UPRIGHT = np.tile(UP, (4, 1))


@pytest.mark.parametrize(
    ("shares", "distance"),
    [
        ([1, 1, 1, 1], 0.1),
        ([1, 0, 0, 1], 0.0),  # it begins to tip
        ([9, 1, 1, 9], 0.04),  # 0.16 ahead of the middle
        ([0, 0, 0, 1], 0.0),
        ([-1, 3, 3, -1], -0.2),  # beyond an edge: something pulls
        ([0, -1, 0, 2], -np.hypot(0.4, 0.2)),  # beyond a corner: at (0.6, -0.3)
    ],
)
def test_the_zero_moment_point_of_a_pressed_square(shares, distance):
    forces = np.outer(shares, UP)
    assert support_distances(np.zeros(4), CORNERS, UPRIGHT, forces) == pytest.approx([distance], abs=1e-12)
    assert support_margin(CORNERS, UPRIGHT, forces) == pytest.approx(distance, abs=1e-12)


@pytest.mark.parametrize(
    "change",
    [
        lambda p, n, f: (p + np.outer([0, 0, 0, 0.05], UP), n, f),  # several heights
        lambda p, n, f: (p, np.array([UP, UP, UP, [0.1, 0.0, np.sqrt(0.99)]]), f),  # a slope beside the plane
        lambda p, n, f: (p * [1, 0, 1], n, f),  # on a line
        lambda p, n, f: (p * 0, n, f),  # at a point
        lambda p, n, f: (p, n, 0 * f),  # nothing presses
        lambda p, n, f: (p, np.outer([1, -1, 1, -1], UP), f),  # a wedge
        lambda p, n, f: (p[:2], n[:2], f[:2]),
        lambda p, n, f: (p[:0], n[:0], f[:0]),
    ],
)
def test_what_is_no_support_gives_no_number_and_harms_no_other(change):
    p, n, f = change(CORNERS, UPRIGHT, UPRIGHT)
    assert support_distances(np.zeros(len(p)), p, n, f).shape == (0,)
    both = [np.concatenate([a, b, a]) for a, b in zip((p, n, f), (CORNERS, UPRIGHT, UPRIGHT), strict=True)]
    instant = np.repeat([4, 5, 6], [len(p), 4, len(p)])
    assert support_distances(instant, *both) == pytest.approx([0.1])


@given(st.integers(0, 2**32 - 1), st.integers(1, 6), st.integers(0, 40), st.booleans(), st.booleans())
def test_distances_of_all_instants_are_those_of_each(seed, instants, contacts, coarse, rough):
    rng = np.random.default_rng(seed)
    normal = UP + rng.normal(0.0, 0.5, 3)
    normal /= np.linalg.norm(normal)
    flat = rng.uniform(-1.0, 1.0, (contacts, 2))
    flat = np.round(flat, 1) if coarse else flat  # with duplicates, and several on one edge
    heights = rng.uniform(-0.007, 0.007, (contacts, 1)) * rough
    points = flat @ tangents(normal) + heights * normal + [3.0, -2.0, 1.0]
    normals = normal + rng.normal(0.0, 0.02, (contacts, 3)) * rough
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    forces = rng.normal(0.0, 1.0, (contacts, 3)) + rng.uniform(0.5, 3.0) * normal
    instant = rng.integers(0, instants, contacts)
    each = (instant == k for k in range(instants))
    expected = [support_margin(points[here], normals[here], forces[here]) for here in each]
    found = support_distances(instant, points, normals, forces)
    np.testing.assert_allclose(np.sort(found), np.sort(expected)[: len(found)], rtol=1e-6, atol=1e-9)
    assert len(found) == np.isfinite(expected).sum()
