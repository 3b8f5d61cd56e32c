"""Controls on a ray against closed forms: half-spaces, whose edge is known, and stretches with gaps."""

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from safe_wrappers.filter.ray_map import Ray, centre, mapped_on_ray

FINE = 2.0**-9
"""The edge is found to this share of the ray, rounding included."""

numbers = st.floats(-1.0, 1.0, allow_subnormal=True)
sizes = st.integers(1, 4)
seeds = st.integers(0, 2**32 - 1)


def half_spaces(rng, m, anchor, count=3):
    """Random rows that the anchor keeps with room, as a function and in closed form."""
    normals = rng.normal(size=(count, m))
    offsets = normals @ anchor + rng.uniform(0.05, 1.5, count)

    def admits(control):
        return bool((normals @ control <= offsets).all())

    def share(edge):
        """Of the way from the anchor to the edge of the box that is admitted, at most 1."""
        grows = normals @ (edge - anchor)
        room = offsets - normals @ anchor
        return min([1.0, *(r / g for r, g in zip(room, grows, strict=True) if g > 0.0)])

    return admits, share


def edge_of_box(anchor, through):
    """Where the ray leaves [-1, 1]^m, component by component."""
    away = through - anchor
    reaches = [(np.sign(a) - c) / a for a, c in zip(away, anchor, strict=True) if a != 0.0]
    return anchor + min(reaches) * away


@given(seeds, sizes, st.sampled_from([np.float32, np.float64]))
def test_a_control_goes_the_same_share_of_the_admitted_way_as_of_the_ray(seed, m, dtype):
    rng = np.random.default_rng(seed)
    anchor, through = rng.uniform(-1.0, 1.0, (2, m)).astype(dtype).astype(float)
    admits, share = half_spaces(rng, m, anchor)
    low, high = -np.ones(m), np.ones(m)
    control, scale = mapped_on_ray(admits, Ray(anchor, through, low, high, dtype), through)
    edge = edge_of_box(anchor, through)
    known = share(edge)
    assert admits(control) and (control == control.astype(dtype)).all() and (np.abs(control) <= 1.0).all()
    assert known - FINE <= scale <= known + 1e-6
    np.testing.assert_allclose(control, anchor + scale * (through - anchor), atol=1e-6)
    if known == 1.0:
        assert control is through and scale == 1.0


@given(seeds, sizes, st.lists(st.integers(1, 1000), min_size=2, max_size=6, unique=True))
def test_controls_on_a_ray_stay_distinct_and_in_order(seed, m, thousandths):
    rng = np.random.default_rng(seed)
    anchor, other = rng.uniform(-1.0, 1.0, (2, m))
    admits, share = half_spaces(rng, m, anchor)
    edge = edge_of_box(anchor, other)
    assume(share(edge) > 0.01)
    low, high = -np.ones(m), np.ones(m)
    far = []
    for part in sorted(thousandths):
        through = anchor + 0.001 * part * (edge - anchor)
        control, _ = mapped_on_ray(admits, Ray(anchor, through, low, high, np.float64), through)
        far.append(float(np.linalg.norm(control - anchor)))
    assert (np.diff(far) > 0.0).all()


@given(st.lists(st.tuples(numbers, numbers), min_size=1, max_size=4))
def test_a_ray_stays_in_the_box_and_passes_through_its_control(pairs):
    anchor, through = np.array(pairs).T
    assume((anchor != through).any())
    low, high = -np.ones(anchor.size), np.ones(anchor.size)
    ray = Ray(anchor, through, low, high, np.float64)
    assert 0.0 < ray.place <= 1.0
    for share in (0.0, 0.3, 1.0):
        control = ray.at(share)
        assert np.isfinite(control).all() and (np.abs(control) <= 1.0).all()
    np.testing.assert_allclose(ray.at(ray.place), through, atol=1e-12)
    np.testing.assert_array_equal(ray.at(0.0), anchor)
    assert (np.abs(ray.at(1.0)) >= 1.0 - 1e-12).any()


def on_a_line(*stretches):
    """Of controls from -1, the anchor, to 1: the shares of the ray that are admitted."""
    return lambda u: any(start <= 0.5 * (float(u[0]) + 1.0) <= end for start, end in stretches)


def mapped(admits, share):
    through = np.array([2.0 * share - 1.0])
    ray = Ray(-np.ones(1), through, -np.ones(1), np.ones(1), np.float64)
    control, scale = mapped_on_ray(admits, ray, through)
    return 0.5 * (float(control[0]) + 1.0), scale


def test_of_several_stretches_the_first_is_used():
    admits = on_a_line((0.0, 0.4), (0.6, 1.0))
    places = [mapped(admits, share)[0] for share in (0.1, 0.5, 0.7, 1.0)]
    np.testing.assert_allclose(places, [0.04, 0.2, 0.28, 0.4], atol=FINE)


@pytest.mark.parametrize("share", [0.3, 0.61, 0.62, 0.8])
def test_a_gap_that_the_march_does_not_see_is_never_executed(share):
    admits = on_a_line((0.0, 0.6), (0.64, 1.0))
    place, scale = mapped(admits, share)
    if share < 0.6 or share > 0.64:
        assert place == pytest.approx(share) and scale == 1.0
    else:
        assert place <= 0.6 and 0.0 < scale < 1.0


def test_a_mapped_control_in_a_gap_before_the_edge_comes_before_the_gap():
    admits = on_a_line((0.0, 0.3), (0.35, 0.8))  # the march sees 0.25, 0.5 and 0.75 admitted, and 1 refused
    place, _ = mapped(admits, 0.4)  # would be 0.32
    assert place <= 0.3


def test_where_the_anchor_alone_is_admitted_it_is_what_is_left():
    assert mapped(on_a_line((0.0, 0.0)), 0.5) == (0.0, 0.0)
    assert mapped(on_a_line((0.0, 1e-4)), 1.0) == (0.0, 0.0)
    assert mapped(on_a_line((0.0, 0.01)), 1.0)[0] == pytest.approx(0.01, abs=FINE)


def test_a_dozen_controls_are_asked_about():
    asked = []

    def admits(control):
        asked.append(control)
        return control[0] <= 0.83

    mapped(admits, 1.0)
    assert len(asked) <= 13
    asked.clear()
    mapped(admits, 0.01)
    assert len(asked) <= 13


@given(seeds, sizes, st.sampled_from([np.float32, np.float64]))
def test_the_centre_of_a_box_is_its_middle_from_wherever_one_starts(seed, m, dtype):
    rng = np.random.default_rng(seed)
    low, high = -np.ones(m), np.ones(m)
    least, most = np.sort(rng.uniform(-1.0, 1.0, (2, m)), axis=0)
    start = rng.uniform(least, most).astype(dtype).astype(float)
    assume(((start >= least) & (start <= most)).all())
    found = centre(lambda u: bool(((u >= least) & (u <= most)).all()), start, low, high, dtype)
    np.testing.assert_allclose(found, 0.5 * (least + most), atol=2.0 * 2.0**-5)
    assert (found == found.astype(dtype)).all()
    np.testing.assert_array_equal(centre(lambda u: True, start, low, high, dtype), np.zeros(m))
    np.testing.assert_array_equal(centre(lambda u: (u == start).all(), start, low, high, dtype), start)


@given(seeds, sizes)
def test_the_centre_is_admitted_and_inside_of_half_spaces_whose_edge_it_starts_on(seed, m):
    rng = np.random.default_rng(seed)
    low, high = -np.ones(m), np.ones(m)
    start = rng.uniform(-0.9, 0.9, m)
    normal = rng.choice([-1.0, 1.0], m) * rng.uniform(0.2, 1.0, m)

    def admits(control):
        return bool(normal @ control <= normal @ start)

    found = centre(admits, start, low, high, np.float64)
    assert admits(found) and (np.abs(found) <= 1.0).all()
    assert normal @ start - normal @ found > 0.001
