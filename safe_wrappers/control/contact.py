"""Contacts: friction cones, residuals of rigid contacts, peak force of elastic ones.

**Friction.** A force f on the robot, at a contact with unit normal n (pointing at the robot) and friction coefficient
mu, is feasible where `f_n = f . n >= 0` and `|f - f_n n| <= mu f_n`: Coulomb's law with one coefficient in every
direction. It does not say that a foothold carries the load.

**Impact.** One mass on one massless linear spring without damping, with a push p, `m x'' = -k x + p`, `x(0) = 0`,
`x'(0) = v`, up to the first peak of the deflection x. Not modelled: stiffness that grows with depth, damping, a pad
at the end of its stroke, a second contact. **Braking after contact is too late**: the peak comes a quarter of a
period after the touch, 4 to 44 ms for a robot of 10 kg on parts of a body, and a brake that acts later does not
reduce it. So protection needs clearance before contact.

Arguments are numbers or arrays that broadcast. They are not checked: masses and stiffnesses are positive, NaN gives
NaN; speeds of approach that are negative count as at rest.

Source: appendix "Rigid Body Contact Mechanics", "Non-smooth collision manifolds and velocity jumps", "Elastodynamic
impact force and compliance deformation" and "Physical contact feasibility constraints".
"""

import math

import numpy as np
from numpy.typing import ArrayLike

from safe_wrappers.errors import Array

Numbers = Array | float


def normal_and_tangential(forces: ArrayLike, normals: ArrayLike) -> tuple[Array, Array]:
    """The part of each force along its normal, shape (...), below 0 where it pulls, and the rest, (..., 3), N.

    Forces are on the robot, shape (..., 3), N; unit normals point at the robot, shape (..., 3).
    """
    f, n = np.asarray(forces, dtype=np.float64), np.asarray(normals, dtype=np.float64)
    along = np.einsum("...i,...i->...", f, n)
    return along, f - along[..., None] * n


def cone_excess(forces: ArrayLike, normals: ArrayLike, friction: ArrayLike) -> Array:
    """Largest violation of the two conditions, shape (...), N: at most 0 inside the cone."""
    along, rest = normal_and_tangential(forces, normals)
    return np.asarray(np.maximum(np.linalg.norm(rest, axis=-1) - np.asarray(friction) * along, -along))


def tangents(normals: ArrayLike) -> Array:
    """Two unit tangents for each unit normal, shape (..., 2, 3); with the normal as third they are right-handed.

    The first follows the axis of the world that is farthest from the normal.
    """
    n = np.asarray(normals, dtype=np.float64)
    axis = np.eye(3)[np.abs(n).argmin(axis=-1)]
    along = axis - (axis * n).sum(axis=-1, keepdims=True) * n
    along /= np.linalg.norm(along, axis=-1, keepdims=True)
    return np.stack([along, np.cross(n, along)], axis=-2)


def friction_pyramid(normals: ArrayLike, friction: ArrayLike, edges: int = 4) -> Array:
    """Half-spaces inside the friction cone: `rows @ f <= 0` is a pyramid whose edges lie on the cone.

    Halfway between two edges it allows `cos(pi / edges)` of the friction (four edges: 71 %, eight: 92 %). The first
    edge is along the first of the `tangents`.

    Args:
        normals: Unit normals, pointing at the robot, shape (..., 3).
        friction: Coefficient mu, at least 0, shape (...).
        edges: Of the pyramid, at least 3.

    Returns:
        One row for each side, shape (..., edges, 3); with friction above 0 they imply that nothing pulls.
    """
    n, mu = np.asarray(normals, dtype=np.float64), np.asarray(friction, dtype=np.float64)
    middle = (np.arange(edges) + 0.5) * (2.0 * math.pi / edges)
    facing = np.stack([np.cos(middle), np.sin(middle)], axis=-1)
    slope = mu[..., None, None] * math.cos(math.pi / edges) * n[..., None, :]
    return np.asarray(facing @ tangents(n) - slope)


def complementarity_residuals(gap: Numbers, force: Numbers) -> tuple[Array, Array]:
    """Violations of `gap >= 0` and of `gap * force = 0`, shapes (...), 0 where they hold: m and N m.

    The gap is a signed distance, m, shape (...), negative where the bodies penetrate; the force is along the normal,
    N, shape (...), positive where it pushes the bodies apart. Compliant contacts, MuJoCo's among them, violate the
    law by design.
    """
    return np.maximum(np.negative(gap), 0.0), np.abs(gap * force)


def peak_force(
    speed: Numbers, mass: Numbers, stiffness: Numbers, push: Numbers = 0.0, deflection: Numbers = 0.0
) -> Array:
    """The largest force of a contact, shape (...), N: `v sqrt(k m)`, with a push `p + sqrt((k x - p)^2 + k m v^2)`.

    Args:
        speed: v, m/s.
        mass: m, kg.
        stiffness: k, N/m.
        push: p, a force that goes on, N.
        deflection: x, how deep the contact is already, m.
    """
    pressed, struck = stiffness * deflection - push, np.maximum(speed, 0.0) * np.sqrt(stiffness * mass)
    return np.asarray(push + np.hypot(pressed, struck))
