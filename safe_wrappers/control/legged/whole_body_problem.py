"""The whole-body control problem at one instant of a robot in contact: `M qacc + h = B u + sum J_k' f_k`.

Source: appendix "Hierarchical whole-body control quadratic program" and its caveat: a bound at the present position
does not cover the motion between samples. So `predicted_position_rows` bound accelerations such that positions keep
their ranges until a horizon, which is no shorter than stopping takes.
"""

from dataclasses import dataclass, field, fields

import numpy as np
from numpy.typing import ArrayLike, NDArray

from safe_wrappers.checks import Array, finite_arrays, positive
from safe_wrappers.control.contact.friction_cone import checked_friction
from safe_wrappers.errors import ConfigurationError


@dataclass(frozen=True, eq=False)
class WholeBodyProblem:
    """One instant of a robot in contact.

    Attributes:
        inertia: M, shape (nv, nv), positive definite.
        bias: h, shape (nv,): Coriolis, centrifugal and gravity forces minus passive ones, on the left-hand side.
        actuation: B, shape (nv, nu): generalised force per control.
        jacobians: J_k of the contact points, shape (k, 3, nv); k may be 0.
        drift: `dJ/dt qvel` of the contact points, shape (k, 3), m/s^2.
        normals: Unit normals, pointing at the body that the forces push, shape (k, 3).
        friction: Coefficients, at least 0, shape (k,). At 0 a contact acts along its normal only.
        lower: Smallest control, shape (nu,).
        upper: Largest control, shape (nu,).
        nominal: The control whose distance is minimised, shape (nu,).
        contact_acceleration: Wanted at the contact points, shape (k, 3), m/s^2; None is zero.
        force_weight: Of the squared contact forces, positive, per N^2. It chooses among forces of equal effect.
        breaking: Contacts that are to open, shape (k,): force 0, normal acceleration at least the wanted; None: none.
        first_tangents: Direction of each pyramid's first edge, shape (k, 3); None for a default.
        acceleration_rows: G in `G qacc <= g`, shape (m, nv) (`predicted_position_rows` makes some).
        acceleration_limits: g, shape (m,).
    """

    inertia: Array
    bias: Array
    actuation: Array
    jacobians: Array
    drift: Array
    normals: Array
    friction: Array
    lower: Array
    upper: Array
    nominal: Array
    contact_acceleration: Array | None = None
    force_weight: float = 1e-8
    breaking: NDArray[np.bool_] | None = None
    first_tangents: Array | None = None
    acceleration_rows: Array | None = None
    acceleration_limits: Array | None = None
    stance: NDArray[np.intp] = field(init=False)
    """Indices of the contacts that are to stay."""
    opening: NDArray[np.intp] = field(init=False)
    """Indices of the contacts that are to open."""
    wanted: Array = field(init=False)
    """Wanted `J qacc`: `contact_acceleration`, or zeros, minus the drift, shape (k, 3)."""

    def __post_init__(self) -> None:
        for part in fields(self):
            value = getattr(self, part.name, None)
            array = isinstance(value, np.ndarray) and part.name not in ("lower", "upper")
            if array and not np.isfinite(np.asarray(value)).all():
                raise ConfigurationError(f"{part.name} must be finite, got {value}")
        if not (self.lower <= self.upper).all():
            raise ConfigurationError(f"lower must not exceed upper, got {self.lower} and {self.upper}")
        checked_friction(self.friction)
        positive("force_weight", self.force_weight, "1/N^2")
        opens = np.zeros(len(self.normals), bool) if self.breaking is None else self.breaking
        acceleration = 0.0 if self.contact_acceleration is None else self.contact_acceleration
        object.__setattr__(self, "stance", np.flatnonzero(~opens))
        object.__setattr__(self, "opening", np.flatnonzero(opens))
        object.__setattr__(self, "wanted", acceleration - self.drift)


def largest_acceleration(distance: ArrayLike, speed: ArrayLike, horizon_s: float) -> Array:
    """The largest constant acceleration that stays within a limit until a horizon > 0, shape (...).

    The distance to the limit is in m or rad, the speed towards it in m/s or rad/s. From beyond the limit (a negative
    distance): the largest that returns to it by the end of the horizon.
    """
    d, v = finite_arrays(distance=distance, speed=speed)
    positive("horizon_s", horizon_s, "s")
    at_end = 2.0 * (d - horizon_s * v) / horizon_s**2
    # Where the top of the parabola is before the end, the top may just reach the limit.
    top_is_inside = (d > 0.0) & (2.0 * d < horizon_s * v)
    with np.errstate(over="ignore"):  # very close to the limit: the largest finite number
        at_top = np.maximum(-(v * v) / (2.0 * np.where(d > 0.0, d, 1.0)), -np.finfo(np.float64).max)
    return np.asarray(np.where(top_is_inside, at_top, at_end))


def predicted_position_rows(
    dofs: ArrayLike,
    positions: ArrayLike,
    velocities: ArrayLike,
    lower: ArrayLike,
    upper: ArrayLike,
    horizon_s: float,
    nv: int,
) -> tuple[Array, Array]:
    """Rows `G qacc <= g`, shapes (m, nv) and (m,), that keep joints in range until the horizon, upper limits first.

    The acceleration is constant; there is one row for each finite limit.

    Args:
        dofs: Indices of the joints' degrees of freedom (slides and hinges), shape (n,).
        positions: Shape (n,), m or rad.
        velocities: Shape (n,).
        lower: Smallest positions, shape (n,); -inf is no limit.
        upper: Largest positions, shape (n,); inf is no limit.
        horizon_s: s; a control step, or the time that stopping takes if that is longer.
        nv: Degrees of freedom of the whole model.
    """
    q, v = finite_arrays(positions=positions, velocities=velocities)
    low, high = np.asarray(lower, dtype=np.float64), np.asarray(upper, dtype=np.float64)
    above, below = np.isfinite(high), np.isfinite(low)
    units = np.eye(nv)[np.asarray(dofs)]
    rows = np.concatenate([units[above], 0.0 - units[below]])  # 0 - x: no negative zeros
    upwards = largest_acceleration(high[above] - q[above], v[above], horizon_s)
    downwards = largest_acceleration(q[below] - low[below], -v[below], horizon_s)
    return rows, np.concatenate([upwards, downwards])
