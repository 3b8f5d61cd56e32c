"""Small dense quadratic programs with half-spaces, a box and second-order cones, by daqp and clarabel directly.

    minimise 1/2 y' H y + q' y    so that    G y <= h,  lower <= y <= upper,  c_i + C_i y in the cone,

where a cone is {(t, x): |x| <= t}. Answers are candidates: who asks checks them with a residual of his own.
"""

from typing import NamedTuple

import clarabel
import daqp
import numpy as np
from numpy.typing import NDArray
from scipy import sparse

Array = NDArray[np.float64]

_UNBOUNDED = 1e30
"""What daqp takes as "no bound"."""
_NO_ANSWER = "failed"
_INFEASIBLE = "infeasible"
_SOLVED = "solved"


class Candidate(NamedTuple):
    """What a backend says.

    Attributes:
        verdict: "solved", "infeasible" (the backend claims that there is no answer) or "failed".
        y: The answer, shape (n,); None unless solved.
    """

    verdict: str
    y: Array | None


def by_daqp(
    hessian: Array, linear: Array, rows: Array, limits: Array, lower: Array, upper: Array
) -> Candidate:
    """Active-set solution of a program without cones; `hessian` is positive definite."""
    n, k = linear.size, limits.size
    most = np.minimum(np.concatenate((upper, limits)), _UNBOUNDED)
    least = np.concatenate((np.maximum(lower, -_UNBOUNDED), np.full(k, -_UNBOUNDED)))
    y, _, flag, _ = daqp.solve(
        hessian, linear, np.ascontiguousarray(rows), most, least, np.zeros(n + k, np.int32)
    )
    if flag == -1:
        return Candidate(_INFEASIBLE, None)
    answer = np.asarray(y)
    if flag < 1 or not np.isfinite(answer).all():
        return Candidate(_NO_ANSWER, None)
    return Candidate(_SOLVED, answer)


def by_clarabel(
    hessian: Array,
    linear: Array,
    rows: Array,
    limits: Array,
    lower: Array,
    upper: Array,
    cones: Array | None = None,
    cone_offsets: Array | None = None,
) -> Candidate:
    """Interior-point solution, with cones or without.

    Args:
        hessian: Shape (n, n), positive semidefinite.
        linear: Shape (n,).
        rows: Shape (k, n).
        limits: Shape (k,).
        lower: Shape (n,), -inf is no bound.
        upper: Shape (n,).
        cones: C_i, shape (m, d, n).
        cone_offsets: c_i, shape (m, d).
    """
    n = linear.size
    at_most, at_least = np.flatnonzero(np.isfinite(upper)), np.flatnonzero(np.isfinite(lower))
    unit = np.eye(n)
    matrix = [rows, unit[at_most], -unit[at_least]]
    right = [limits, upper[at_most], -lower[at_least]]
    count = limits.size + at_most.size + at_least.size
    kinds = [clarabel.NonnegativeConeT(count)] if count else []
    if cones is not None and cone_offsets is not None and len(cones):
        matrix.append(-cones.reshape(-1, n))
        right.append(cone_offsets.reshape(-1))
        kinds += [clarabel.SecondOrderConeT(cones.shape[1])] * len(cones)
    settings = clarabel.DefaultSettings()
    settings.verbose = False
    settings.tol_gap_abs = settings.tol_gap_rel = settings.tol_feas = 1e-10
    upper_half = sparse.csc_matrix(np.triu(hessian))
    constraints = sparse.csc_matrix(np.concatenate(matrix))
    solution = clarabel.DefaultSolver(
        upper_half, linear, constraints, np.concatenate(right), kinds, settings
    ).solve()
    status = solution.status
    if status in (clarabel.SolverStatus.PrimalInfeasible, clarabel.SolverStatus.AlmostPrimalInfeasible):
        return Candidate(_INFEASIBLE, None)
    answer = np.asarray(solution.x)
    if status not in (clarabel.SolverStatus.Solved, clarabel.SolverStatus.AlmostSolved):
        return Candidate(_NO_ANSWER, None)
    return Candidate(_SOLVED, answer) if np.isfinite(answer).all() else Candidate(_NO_ANSWER, None)
