"""Small dense quadratic programs with half-spaces, a box and second-order cones, by daqp and clarabel directly.

    minimise 1/2 y' H y + q' y    so that    G y <= h,  lower <= y <= upper,  c_i + C_i y in the cone,

where a cone is {(t, x): |x| <= t}. Answers are candidates: the caller checks their residuals.
"""

from typing import NamedTuple

import clarabel
import daqp
import numpy as np

from safe_wrappers.checks import Array

_UNBOUNDED = 1e30
"""daqp's infinity."""
_ACCURACY = 1e-10
"""Tolerance for clarabel; answers of slightly lower accuracy are accepted, since the caller checks."""
_FOUND = (
    clarabel.SolverStatus.Solved,
    clarabel.SolverStatus.AlmostSolved,
    clarabel.SolverStatus.InsufficientProgress,
)
_NONE_EXISTS = (clarabel.SolverStatus.PrimalInfeasible, clarabel.SolverStatus.AlmostPrimalInfeasible)
_FAILED, _INFEASIBLE, _SOLVED = "failed", "infeasible", "solved"


class Program(NamedTuple):
    """The program above; H is positive definite."""

    hessian: Array  # (n, n)
    linear: Array  # (n,)
    rows: Array  # (k, n)
    limits: Array  # (k,)
    lower: Array  # (n,), -inf is no bound
    upper: Array  # (n,), inf is no bound
    cones: Array | None = None  # C_i, (m, d, n)
    cone_offsets: Array | None = None  # c_i, (m, d)

    def with_first(self, values: Array) -> "Program":
        """The program in the remaining unknowns, with the first ones fixed."""
        i = len(values)
        cones, offsets = self.cones, self.cone_offsets
        if cones is not None and offsets is not None:
            cones, offsets = cones[:, :, i:], offsets + cones[:, :, :i] @ values
        return Program(
            self.hessian[i:, i:],
            self.linear[i:] + self.hessian[i:, :i] @ values,
            self.rows[:, i:],
            self.limits - self.rows[:, :i] @ values,
            self.lower[i:],
            self.upper[i:],
            cones,
            offsets,
        )

    def softened(self, count: int) -> "Program":
        """The first rows made soft: half the squares of their violations are added to the objective."""
        n, k = self.linear.size, self.limits.size
        hessian = np.zeros((n + count, n + count))
        hessian[:n, :n] = self.hessian
        hessian[n:, n:] = np.eye(count)
        give = np.zeros((k, count))
        give[:count] = -np.eye(count)
        none = np.full(count, np.inf)
        cones = self.cones
        if cones is not None:
            cones = np.concatenate([cones, np.zeros((*cones.shape[:2], count))], axis=2)
        return self._replace(
            hessian=hessian,
            linear=np.concatenate([self.linear, np.zeros(count)]),
            rows=np.concatenate([self.rows, give], axis=1),
            lower=np.concatenate([self.lower, -none]),
            upper=np.concatenate([self.upper, none]),
            cones=cones,
        )

    def scaled(self) -> tuple["Program", Array]:
        """The program scaled to unit curvature along each unknown, and the factor of its answer."""
        scale = 1.0 / np.sqrt(self.hessian.diagonal())
        cones = None if self.cones is None else self.cones * scale
        return self._replace(
            hessian=self.hessian * scale * scale[:, None],
            linear=self.linear * scale,
            rows=self.rows * scale,
            lower=self.lower / scale,
            upper=self.upper / scale,
            cones=cones,
        ), scale


class Candidate(NamedTuple):
    """Answer of a solver: y, shape (n,), or None and why ("infeasible" is the solver's claim)."""

    verdict: str  # "solved", "infeasible" or "failed"
    y: Array | None


def by_daqp(program: Program) -> Candidate:
    """Active-set solution of a program without cones."""
    p, scale = program.scaled()
    n, k = p.linear.size, p.limits.size
    most = np.minimum(np.concatenate((p.upper, p.limits)), _UNBOUNDED)
    least = np.concatenate((np.maximum(p.lower, -_UNBOUNDED), np.full(k, -_UNBOUNDED)))
    y, _, flag, _ = daqp.solve(
        p.hessian, p.linear, np.ascontiguousarray(p.rows), most, least, np.zeros(n + k, np.int32)
    )
    if flag == -1:
        return Candidate(_INFEASIBLE, None)
    answer = np.asarray(y) * scale
    return Candidate(_SOLVED, answer) if flag > 0 and np.isfinite(answer).all() else Candidate(_FAILED, None)


def by_clarabel(program: Program) -> Candidate:
    """Interior-point solution, with or without cones."""
    from scipy import sparse  # here: SciPy takes a while to import

    p, scale = program.scaled()
    n = p.linear.size
    at_most, at_least = np.flatnonzero(np.isfinite(p.upper)), np.flatnonzero(np.isfinite(p.lower))
    unit = np.eye(n)
    matrix = [p.rows, unit[at_most], -unit[at_least]]
    right = [p.limits, p.upper[at_most], -p.lower[at_least]]
    count = p.limits.size + at_most.size + at_least.size
    kinds = [clarabel.NonnegativeConeT(count)] if count else []
    if p.cones is not None and p.cone_offsets is not None:
        matrix.append(-p.cones.reshape(-1, n))
        right.append(p.cone_offsets.reshape(-1))
        kinds += [clarabel.SecondOrderConeT(p.cones.shape[1])] * len(p.cones)
    settings = clarabel.DefaultSettings()
    settings.verbose = False
    settings.tol_gap_abs = settings.tol_gap_rel = settings.tol_feas = _ACCURACY
    solution = clarabel.DefaultSolver(
        sparse.csc_matrix(np.triu(p.hessian)),
        p.linear,
        sparse.csc_matrix(np.concatenate(matrix)),
        np.concatenate(right),
        kinds,
        settings,
    ).solve()
    if solution.status in _NONE_EXISTS:
        return Candidate(_INFEASIBLE, None)
    answer = np.asarray(solution.x) * scale
    found = solution.status in _FOUND and np.isfinite(answer).all()
    return Candidate(_SOLVED, answer) if found else Candidate(_FAILED, None)
