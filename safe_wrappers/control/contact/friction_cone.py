"""Friction cones: which contact forces are feasible.

Source: appendix "Physical contact feasibility constraints". A force f on the robot, at a contact with unit normal n
(pointing at the robot) and friction coefficient mu, is feasible where

    f_n = f . n >= 0    and    |f - f_n n| <= mu f_n.

This is Coulomb's law with one coefficient in every direction. It does not say that a foothold carries the load.
"""

import math

import numpy as np
from numpy.typing import ArrayLike

from safe_wrappers.checks import Array, finite_array, finite_arrays, whole_number
from safe_wrappers.errors import ConfigurationError


def normal_and_tangential(forces: ArrayLike, normals: ArrayLike) -> tuple[Array, Array]:
    """The part of each force along its normal, shape (...), below 0 where it pulls, and the rest, (..., 3), N.

    Forces are on the robot, shape (..., 3), N; unit normals point at the robot, shape (..., 3).
    """
    f, n = finite_arrays(forces=forces, normals=normals)
    along = np.einsum("...i,...i->...", f, n)
    return along, f - along[..., None] * n


def cone_excess(forces: ArrayLike, normals: ArrayLike, friction: ArrayLike) -> Array:
    """Largest violation of the two conditions, shape (...), N: at most 0 inside the cone."""
    along, rest = normal_and_tangential(forces, normals)
    return np.asarray(np.maximum(np.linalg.norm(rest, axis=-1) - checked_friction(friction) * along, -along))


def tangents(normals: ArrayLike, first: ArrayLike | None = None) -> Array:
    """Two unit tangents for each normal, shape (..., 2, 3); with the normal as third they are right-handed.

    Args:
        normals: Unit normals, shape (..., 3).
        first: Direction whose tangential part the first tangent follows, shape (..., 3); None takes the axis of the
            world that is farthest from the normal.
    """
    n = finite_array("normals", normals)
    if first is None:
        wanted = np.zeros(n.shape)
        np.put_along_axis(wanted, np.abs(n).argmin(axis=-1)[..., None], 1.0, axis=-1)
    else:
        wanted, n = finite_arrays(first=first, normals=n)
    along = wanted - np.einsum("...i,...i->...", wanted, n)[..., None] * n
    length = np.linalg.norm(along, axis=-1, keepdims=True)
    if not (length > 1e-9).all():
        raise ConfigurationError("first must not be parallel to its normal, or zero")
    along = along / length
    return np.stack([along, np.cross(n, along)], axis=-2)


def friction_pyramid(
    normals: ArrayLike, friction: ArrayLike, edges: int = 4, first: ArrayLike | None = None
) -> Array:
    """Half-spaces inside the friction cone: `rows @ f <= 0` is a pyramid whose edges lie on the cone.

    An inner approximation: halfway between two edges it allows `cos(pi / edges)` of the friction (four edges: 71 %,
    eight: 92 %).

    Args:
        normals: Unit normals, pointing at the robot, shape (..., 3).
        friction: Coefficient mu, at least 0, shape (...).
        edges: Of the pyramid, at least 3.
        first: Direction of the first edge, shape (..., 3), as of `tangents`. With four edges and the first axis of
            a contact frame of MuJoCo, the pyramid is MuJoCo's own.

    Returns:
        Shape (..., edges + 1, 3): one row for each side, then `-normal`.
    """
    edges = whole_number("edges", edges, 3)
    n, mu = finite_array("normals", normals), checked_friction(friction)
    frame = tangents(n, first)
    middle = (np.arange(edges) + 0.5) * (2.0 * math.pi / edges)
    facing = np.stack([np.cos(middle), np.sin(middle)], axis=-1)
    slope = mu[..., None, None] * math.cos(math.pi / edges) * n[..., None, :]
    sides = facing @ frame - slope
    return np.concatenate([sides, np.broadcast_to(-n, (*sides.shape[:-2], 3))[..., None, :]], axis=-2)


def checked_friction(friction: ArrayLike) -> Array:
    """Friction coefficients as float64, finite and at least 0."""
    mu = finite_array("friction", friction)
    if not (mu >= 0.0).all():
        raise ConfigurationError(f"friction must be 0 or more, got {mu}")
    return mu
