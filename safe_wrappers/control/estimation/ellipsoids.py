"""Signed distances of points from ellipsoids, and their normals: of obstacles known with a covariance."""

import math
from collections.abc import Iterable
from operator import mul

import numpy as np

from safe_wrappers.checks import Array
from safe_wrappers.errors import ConfigurationError

_ROUNDING = 8.0 * float(np.finfo(np.float64).eps)
"""Error of an eigenvalue over the largest one, where the shape is not diagonal."""
_CONVERGED = 1e-11
"""Of the secular equation; the distance errs with its square, and downwards."""
_TINY = 1e-150
"""Smaller numbers count as zero: their squares underflow, quotients by them overflow."""
_MOST_STEPS = 100


def ellipsoid_gap(offset: Array, shape: Array) -> tuple[Array, Array]:
    """Signed distances (n,), m, of points to ellipsoids, and the unit normals (n, d) along which they grow.

    The ellipsoid is {S^(1/2) u : |u| <= 1}, filled. S may be singular or zero: then it is flat, a segment or a point,
    which has no inside. The signed distance is the largest of `n @ offset - sqrt(n @ S @ n)` over unit vectors n:
    Euclidean outside, minus the distance to the boundary inside. It is never overestimated, save by rounding (1e-15
    of the lengths involved), and underestimated by at most 5e-8 of the longest half-axis, and that only for a shape
    that is (nearly) singular and not diagonal.

    Source: Moré and Sorensen, Computing a trust region step (1983), for Newton's method on the secular equation.

    Args:
        offset: Point minus centre, shape (n, d), m; d is 2 or 3.
        shape: S, symmetric positive semidefinite, shape (n, d, d), m²: for k sigma of a covariance P it is k² P.

    Raises:
        ConfigurationError: Numbers that are not finite.
    """
    if not (np.isfinite(offset).all() and np.isfinite(shape).all()):
        raise ConfigurationError(f"offsets and shapes must be finite, got {offset} and {shape}")
    squares, bases = np.linalg.eigh(shape)
    coupled = np.any(shape * (1.0 - np.eye(offset.shape[1])), axis=(1, 2)).tolist()
    along = (offset[:, None, :] @ bases)[:, 0]
    found = [_gap(*point) for point in zip(along.tolist(), squares.tolist(), coupled, strict=True)]
    distances = np.array([distance for distance, _ in found])
    normals = np.array([normal for _, normal in found]).reshape(offset.shape)
    return distances, (bases @ normals[:, :, None])[:, :, 0]


def _gap(y: list[float], squares: list[float], coupled: bool) -> tuple[float, list[float]]:
    """Distance and normal in the eigenbasis: y the point, squares those of the half-axes, smallest first."""
    lost = _ROUNDING * squares[-1] if coupled else 0.0
    squares = [square + lost if square > 0.0 else lost for square in squares]
    axes = [math.sqrt(square) for square in squares]
    beyond = [square - squares[0] for square in squares]
    s, filled = _secular_root(map(abs, map(mul, axes, y)), beyond)
    normal = [x * s / (s + b) if b > 0.0 else x for x, b in zip(y, beyond, strict=True)]
    length = math.hypot(*normal)
    if length < _TINY:
        # The point lies in the plane across the shortest axis: two nearest points, one of them is taken.
        normal = [axes[0] * x / b if b > 0.0 else 0.0 for x, b in zip(y, beyond, strict=True)]
        normal[0] = math.sqrt(max(1.0 - filled, 0.0))
        length = math.hypot(*normal)
    normal = [x / length for x in normal] if length > 0.0 else [1.0, *normal[1:]]
    return sum(map(mul, y, normal)) - math.hypot(*map(mul, axes, normal)), normal


def _secular_root(numerators: Iterable[float], beyond: list[float]) -> tuple[float, float]:
    """The root s >= 0 of G(s) = sum of (numerator / (s + beyond))² = 1, or 0 where there is none, and G there."""
    terms = [(c, b) for c, b in zip(numerators, beyond, strict=True) if c > _TINY]
    # Each term alone bounds the root from below; from there on no denominator is smaller than its numerator.
    s = max([0.0, *[c - b for c, b in terms]])
    total = 0.0
    for _ in range(_MOST_STEPS):
        total = steepness = 0.0
        for c, b in terms:
            below = s + b
            share = c / below
            total += share * share
            steepness += share * share / below
        excess = math.sqrt(total) - 1.0
        if excess <= _CONVERGED:
            break
        s += excess * total / steepness
    return s, total
