"""Many projections at once, in one compiled loop."""

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from safe_wrappers.checks import Array
from safe_wrappers.errors import ConfigurationError
from safe_wrappers.filter.projection import OWN, STATUSES, check_solver, project_unchecked
from safe_wrappers.filter.rows_and_box import BAD_NOMINAL, UNSOLVED, keep_rows_of_each

_NAMES = np.array(STATUSES, dtype="<U10")


class BatchProjection(NamedTuple):
    """The answers to B problems, each as in `Projection`.

    Attributes:
        controls: Shape (B, m), always finite and inside the box.
        status: The strings of `Status`, shape (B,).
        violation: Largest `normals @ control - offsets` of each problem, at least 0, shape (B,), row units.
        multipliers: One per row, shape (B, k), at least 0; zeros unless `projected`.
    """

    controls: Array
    status: NDArray[np.str_]
    violation: Array
    multipliers: Array


def project_batch(
    u_nom: ArrayLike,
    normals: ArrayLike,
    offsets: ArrayLike,
    lower: ArrayLike,
    upper: ArrayLike,
    solver: str = OWN,
) -> BatchProjection:
    """Project B nominal controls, each onto its own half-spaces and box; the answers are those of `project`.

    Args:
        u_nom: Nominal controls, shape (B, m), finite.
        normals: Row normals, shape (B, k, m). Rows that ask for nothing fill up a problem with fewer rows: a zero
            normal and an offset of +inf.
        offsets: Shape (B, k).
        lower: Box, shape (m,) or (B, m); -inf is no bound.
        upper: Box, shape (m,) or (B, m); +inf is no bound.
        solver: As in `project`.

    Raises:
        ConfigurationError: Shapes do not match, bounds cross, or an argument that must be finite is not.
        UnknownNameError: No such solver is installed.
    """
    check_solver(solver)
    u = np.array(u_nom, dtype=np.float64, order="C")
    a, b = (np.array(given, dtype=np.float64, order="C") for given in (normals, offsets))
    if u.ndim != 2 or b.ndim != 2 or len(b) != len(u) or a.shape != (*b.shape, u.shape[1]):
        wanted = "u_nom (B, m), normals (B, k, m) and offsets (B, k)"
        raise ConfigurationError(f"expected {wanted}; got {u.shape}, {a.shape} and {b.shape}")
    try:
        lo, hi = (np.full(u.shape, bound, dtype=np.float64) for bound in (lower, upper))
    except ValueError:
        wanted, given = f"({u.shape[1]},) or {u.shape}", f"{np.shape(lower)} and {np.shape(upper)}"
        raise ConfigurationError(f"expected bounds of shape {wanted}; got {given}") from None
    ended, violation = np.empty(len(u), dtype=np.int64), np.empty(len(u))
    controls, multipliers = np.empty(u.shape), np.empty(b.shape)
    keep_rows_of_each(u, a, b, lo, hi, solver != OWN, controls, multipliers, violation, ended)
    if (ended >= BAD_NOMINAL).any():
        if (ended == BAD_NOMINAL).any():
            where = np.flatnonzero(ended == BAD_NOMINAL).tolist()
            raise ConfigurationError(
                f"u_nom must be finite, replace it before projecting; rows {where} are not"
            )
        raise ConfigurationError(f"lower must not exceed upper, got {lo} and {hi}")
    answer = BatchProjection(controls, _NAMES[np.minimum(ended, UNSOLVED)], violation, multipliers)
    for i in np.flatnonzero(ended >= UNSOLVED):
        one = project_unchecked(u[i], a[i], b[i], lo[i], hi[i], solver)
        answer.controls[i], answer.status[i], answer.violation[i], answer.multipliers[i] = one[:4]
    return answer
