"""One time step with frictionless contacts as a linear complementarity problem.

Source: appendix "Rigid Body Contact Mechanics"; the steps after Stewart and Trinkle (1996), An implicit
time-stepping scheme for rigid body dynamics with inelastic collisions and Coulomb friction, and Moreau (1988),
Unilateral contact and dry friction in finite freedom dynamics. With impulses p at the contacts,

    M (v+ - v) = h f + J' p,    0 <= p  complementary to  J v+ - least >= 0,

    least = -e J v      where the contact is closed, or e > 0 and free motion would close it: Newton's restitution;
    least = -gap / h    elsewhere: it may close by the end of the step, and no more.

**The problem is linear by assumption**: no friction; inertia, forces and normals frozen over the step; gaps that
change by `h J v+`; an impulse per contact at one instant; one restitution law for simultaneous impacts, where real
ones have an order. It is an idealisation of rigid contact, not a prediction for a machine.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from safe_wrappers.appendix.contact.lemke import LcpStatus, solve_lcp
from safe_wrappers.checks import Array, finite_array
from safe_wrappers.errors import ConfigurationError


class ContactStep(NamedTuple):
    """The end of a step.

    Attributes:
        velocity: v+, shape (n,); without impulses unless `status` is solved.
        impulse: p, shape (k,), N s; zeros unless solved. Where normals depend on each other (four feet of a table)
            it is one of many; the velocity is the same for all.
        gap: Linearised at the end, `gap + h J v+`, shape (k,), m.
        status: RAY: no velocity satisfies all contacts, for example one that must bounce off and has no room to.
    """

    velocity: Array
    impulse: Array
    gap: Array
    status: LcpStatus


def contact_step(
    inertia: ArrayLike,
    jacobian: ArrayLike,
    gap: ArrayLike,
    velocity: ArrayLike,
    force: ArrayLike,
    step_s: float,
    restitution: ArrayLike = 0.0,
) -> ContactStep:
    """Velocities and impulses at the end of one step.

    A penetration is not pushed out, a ball turns round where it is when the step begins, and with restitution a
    closed contact that opens may be pressed back at e times its speed: gaps are kept to the order of h. Among
    contacts that are all closed and have one e, the impulses gain no energy.

    Args:
        inertia: M, shape (n, n).
        jacobian: J, shape (k, n); positive velocities open.
        gap: Signed distances, shape (k,), m.
        velocity: v, shape (n,).
        force: Generalised forces f, shape (n,).
        step_s: h, s.
        restitution: e, from 0 to 1, one or shape (k,).

    Raises:
        ConfigurationError: Bad input.
    """
    m, j = _matrices(inertia, jacobian)
    k, n = j.shape
    phi, v, f, e = (
        _vector(name, value, size)
        for name, value, size in (
            ("gap", gap, k),
            ("velocity", velocity, n),
            ("force", force, n),
            ("restitution", np.broadcast_to(restitution, k) if np.ndim(restitution) == 0 else restitution, k),
        )
    )
    if not ((e >= 0.0) & (e <= 1.0)).all():
        raise ConfigurationError(f"restitution must be between 0 and 1, got {e}")
    if not 0.0 < step_s < np.inf:
        raise ConfigurationError(f"step_s must be positive and finite, got {step_s!r}")
    lower = _cholesky(m)
    half: Array = np.asarray(np.linalg.solve(lower, j.T), dtype=np.float64)
    matrix = half.T @ half
    free = v + step_s * np.linalg.solve(lower.T, np.linalg.solve(lower, f))
    impacts = (phi <= 0.0) | ((e > 0.0) & (phi + step_s * (j @ free) <= 0.0))
    least = np.where(impacts, -e * (j @ v), -phi / step_s)
    if k == 0:
        return ContactStep(free, np.zeros(0), np.zeros(0), LcpStatus.SOLVED)
    found = solve_lcp(0.5 * (matrix + matrix.T), j @ free - least)  # exactly symmetric
    after = free + np.linalg.solve(lower.T, half @ found.z)
    return ContactStep(after, found.z, phi + step_s * (j @ after), found.status)


def _cholesky(m: Array) -> Array:
    try:
        return np.asarray(np.linalg.cholesky(m))
    except np.linalg.LinAlgError:
        raise ConfigurationError("inertia must be positive definite") from None


def _matrices(inertia: ArrayLike, jacobian: ArrayLike) -> tuple[Array, Array]:
    m, j = finite_array("inertia", inertia), finite_array("jacobian", jacobian)
    if m.ndim != 2 or m.shape[0] != m.shape[1] or j.ndim != 2 or j.shape[1] != len(m) or not len(m):
        raise ConfigurationError(
            f"expected an inertia of shape (n, n) and a jacobian of shape (k, n), got {m.shape} and {j.shape}"
        )
    if np.abs(m - m.T).max() > 1e-9 * np.abs(m).max():
        raise ConfigurationError("inertia must be symmetric")
    return m, j


def _vector(name: str, value: ArrayLike, size: int) -> Array:
    array = finite_array(name, value)
    if array.shape != (size,):
        raise ConfigurationError(f"{name} must have shape ({size},), got {array.shape}")
    return array
