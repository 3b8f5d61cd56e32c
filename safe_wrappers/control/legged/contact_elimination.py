"""Contact forces as a function of the control, by eliminating the wanted contact accelerations.

With qacc = M^-1 (B u + J' f - h), the contacts' accelerations are affine in u and f. Prescribing them determines f up
to inner forces, which cause no motion (two feet pressing against each other through a rigid ground). So the unknowns
of a whole-body problem are the control, the misses (errors of the contact accelerations) and the inner forces.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from safe_wrappers.control.legged.whole_body_problem import WholeBodyProblem

Array = NDArray[np.float64]

_RANK = 1e-9
"""Eigenvalues of the contacts' inverse inertia below this share of the largest count as zero."""


class Motion(NamedTuple):
    """`qacc = free + by_control @ u + by_force @ f`, f the stacked forces of the contacts that are to stay.

    Attributes:
        free: Shape (nv,).
        by_control: Shape (nv, nu).
        by_force: Shape (nv, 3 s).
        axes: Shape (3 s, r): directions in which contacts give force. All three with friction, the normal alone
            without.
        held: Jacobian along these axes, shape (r, nv).
        wanted: Wanted `held @ qacc`, shape (r,), m/s^2.
    """

    free: Array
    by_control: Array
    by_force: Array
    axes: Array
    held: Array
    wanted: Array


class Elimination(NamedTuple):
    """`f = offset + matrix @ y` with the unknowns y = (control, misses, inner forces).

    Attributes:
        offset: Shape (3 s,), N.
        matrix: Shape (3 s, n).
        controls: Number of controls among the unknowns.
        misses: How many are misses, m/s^2: coordinates, in an orthonormal basis, of the contacts' accelerations minus
            the wanted ones. 0 if these are met exactly.
        contradiction: Shape (r,), m/s^2: the part of the wanted accelerations that no motion gives, because they
            contradict each other.
    """

    offset: Array
    matrix: Array
    controls: int
    misses: int
    contradiction: Array

    @property
    def size(self) -> int:
        """Number of unknowns, n."""
        return int(self.matrix.shape[1])

    def acceleration(self, motion: Motion) -> tuple[Array, Array]:
        """`qacc = start + slope @ y`: shapes (nv,) and (nv, n)."""
        slope = motion.by_force @ self.matrix
        slope[:, : self.controls] += motion.by_control
        return motion.free + motion.by_force @ self.offset, slope


def motion_of(problem: WholeBodyProblem) -> Motion:
    """The accelerations of a problem as a function of controls and forces."""
    nv, nu = problem.actuation.shape
    kept = problem.stance
    stacked = problem.jacobians[kept].reshape(-1, nv)
    wanted = problem.wanted[kept].reshape(-1)
    right = np.concatenate([problem.actuation, stacked.T, problem.bias[:, None]], axis=1)
    solved = np.linalg.solve(problem.inertia, right)
    axes = _axes(problem.normals[kept], problem.friction[kept])
    return Motion(-solved[:, -1], solved[:, :nu], solved[:, nu:-1], axes, axes.T @ stacked, axes.T @ wanted)


def _axes(normals: Array, friction: Array) -> Array:
    if (friction > 0.0).all():
        return np.eye(normals.size)
    blocks = [np.eye(3) if mu > 0.0 else n[:, None] for n, mu in zip(normals, friction, strict=True)]
    axes = np.zeros((normals.size, sum(block.shape[1] for block in blocks)))
    column = 0
    for row, block in enumerate(blocks):
        axes[3 * row : 3 * row + 3, column : column + block.shape[1]] = block
        column += block.shape[1]
    return axes


def eliminate(motion: Motion) -> tuple[Elimination, Elimination]:
    """The forces of contacts that move as wanted (no misses), and of contacts that may deviate (with misses)."""
    nu = motion.by_control.shape[1]
    missing = motion.wanted - motion.held @ motion.free
    if not missing.size:
        nothing = Elimination(missing, np.zeros((0, nu)), nu, 0, missing)
        return nothing, nothing
    compliance = motion.held @ (motion.by_force @ motion.axes)
    values, vectors = np.linalg.eigh(0.5 * (compliance + compliance.T))
    counts = values > _RANK * max(float(values[-1]), np.finfo(np.float64).tiny)
    moving, inner = vectors[:, counts], vectors[:, ~counts]
    by_miss = moving / values[counts]
    inverse = by_miss @ moving.T
    by_control = -inverse @ (motion.held @ motion.by_control)
    # Inner forces cause no acceleration, so no control meets a wanted acceleration along them.
    contradiction = inner @ (inner.T @ missing)
    offset = motion.axes @ (inverse @ missing)
    rigid = motion.axes @ np.concatenate([by_control, inner], axis=1)
    loose = motion.axes @ np.concatenate([by_control, by_miss, inner], axis=1)
    return (
        Elimination(offset, rigid, nu, 0, contradiction),
        Elimination(offset, loose, nu, by_miss.shape[1], contradiction),
    )
