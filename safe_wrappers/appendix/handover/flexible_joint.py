"""Flexible joints: two masses and a spring per joint, the rigid manifold, and the energy of oscillation.

Source: appendix "Flexible joint dynamics and singular perturbations", after Spong (1987), Modeling and Control of
Elastic Joint Robots. Motor angles theta (behind the gear), link angles q, spring torque z = K (theta - q):

    M(q) q'' + C(q, q') q' + g(q) = z + D (theta' - q')
    J theta'' + B theta' + z + D (theta' - q') = torque

The damping D across the spring is an addition; the appendix has it zero. With the slow angles frozen, z is an
oscillator about the manifold z0: with W = J^-1 + M^-1, the deflection's deviation d = K^-1 (z - z0) and its rate v,

    dv/dt = -W K d        and        E = (d . K d + v . W^-1 v) / 2,

and E, in J, changes only by damping. A torque change moves the manifold and leaves energy E, which oscillates at the
`resonances`.

**Frozen** means that pose, velocities and bias hardly change over some periods of the resonances. The energies are
those of the boundary layer, exact in that limit; the tests give the errors on a moving arm. A bound on the torque's
rate alone bounds no energy: a torque that oscillates at a resonance adds energy, however slowly it changes, until
damping balances it. The bounds here are for one monotone change from one constant torque to another; the sqrt(E) of
successive changes may add up.

Common arguments: `stiffness` K and `rotor_inertia` J, diagonals, shape (n,), N m/rad and kg m^2, positive;
`link_inertia` M, shape (..., n, n), kg m^2, symmetric and positive definite. Leading axes of every other argument
broadcast with those of M. Anything else raises `ConfigurationError`.
"""

import numpy as np
from numpy.typing import ArrayLike

from safe_wrappers.checks import Array
from safe_wrappers.control.handover.vibration import smoothstep_share
from safe_wrappers.errors import ConfigurationError


def accelerations(
    theta: ArrayLike,
    q: ArrayLike,
    theta_dot: ArrayLike,
    q_dot: ArrayLike,
    torque: ArrayLike,
    stiffness: ArrayLike,
    rotor_inertia: ArrayLike,
    link_inertia: ArrayLike,
    *,
    bias: ArrayLike = 0.0,
    motor_damping: ArrayLike = 0.0,
    joint_damping: ArrayLike = 0.0,
) -> tuple[Array, Array]:
    """Accelerations of motors and links, each of shape (..., n), rad/s^2.

    Args:
        theta: Motor angles, shape (..., n), rad.
        q: Link angles, shape (..., n), rad.
        theta_dot: rad/s.
        q_dot: rad/s.
        torque: Of the motors, shape (..., n), N m.
        stiffness: See the module.
        rotor_inertia: See the module.
        link_inertia: M at q.
        bias: C(q, q') q' + g(q), shape (..., n), N m.
        motor_damping: B, shape (n,), N m s/rad.
        joint_damping: D, shape (n,), N m s/rad.
    """
    k, j, m = _checked(stiffness, rotor_inertia, link_inertia)
    v = _array(theta_dot)
    carried = k * (_array(theta) - _array(q)) + _array(joint_damping) * (v - _array(q_dot))
    motors = (_array(torque) - _array(motor_damping) * v - carried) / j
    return np.asarray(motors), _solve(m, carried - _array(bias))


def manifold(
    torque: ArrayLike,
    rotor_inertia: ArrayLike,
    link_inertia: ArrayLike,
    *,
    bias: ArrayLike = 0.0,
    motor_friction: ArrayLike = 0.0,
) -> Array:
    """z0 = W^-1 [J^-1 (torque - friction) + M^-1 bias], shape (..., n), N m: what a rigid arm's gears carry.

    The appendix leaves the motors' friction B theta' out of z0, but has B q' in the rigid equation that z0 is to
    give back, (M + J) q'' + bias + B q' = torque. Only with the friction does M q'' + bias = z0 give that.

    Args:
        torque: Of the motors, shape (..., n), N m.
        rotor_inertia: See the module.
        link_inertia: See the module.
        bias: C(q, q') q' + g(q), shape (..., n), N m.
        motor_friction: B theta', shape (..., n), N m.
    """
    _, j, m = _checked(1.0, rotor_inertia, link_inertia)
    net = _array(torque) - _array(motor_friction)
    # The same, solved for the rigid acceleration: the rotors keep J q'' of the torque to themselves.
    return np.asarray(net - j * _solve(m + np.diag(j), net - _array(bias)))


def resonances(stiffness: ArrayLike, rotor_inertia: ArrayLike, link_inertia: ArrayLike) -> Array:
    """Eigenvalues of the square root of K W, ascending, shape (..., n), rad/s."""
    return _modes(stiffness, rotor_inertia, link_inertia)[1]


def damping_ratios(
    stiffness: ArrayLike,
    rotor_inertia: ArrayLike,
    link_inertia: ArrayLike,
    motor_damping: ArrayLike = 0.0,
    joint_damping: ArrayLike = 0.0,
) -> Array:
    """Damping ratio of each resonance, to first order in the damping, shape (..., n); B and D as in `accelerations`.

    With the total momentum J theta' + M q' frozen, theta' follows the deflection's rate by (J + M)^-1 M. The
    deflection then has the damping matrix W D + J^-1 B (J + M)^-1 M, of which each mode feels its own share.
    """
    root, omega, shapes = _modes(stiffness, rotor_inertia, link_inertia)
    _, j, m = _checked(stiffness, rotor_inertia, link_inertia)
    b, d = np.broadcast_to(_array(motor_damping), j.shape), np.broadcast_to(_array(joint_damping), j.shape)
    matrix = _mobility(j, m) * d + (b / j)[:, None] * np.linalg.solve(m + np.diag(j), m)
    own = np.einsum("...ji,...jk,...ki->...i", shapes, root[:, None] * matrix / root, shapes)
    return np.asarray(own / (2.0 * omega))


def boundary_layer_energy(
    deflection: ArrayLike,
    deflection_rate: ArrayLike,
    manifold_torque: ArrayLike,
    stiffness: ArrayLike,
    rotor_inertia: ArrayLike,
    link_inertia: ArrayLike,
    manifold_rate: ArrayLike = 0.0,
) -> Array:
    """E of the deviation from the manifold, shape (...,), J.

    Args:
        deflection: theta - q, shape (..., n), rad.
        deflection_rate: rad/s.
        manifold_torque: z0, N m.
        stiffness: See the module.
        rotor_inertia: See the module.
        link_inertia: See the module.
        manifold_rate: dz0/dt, shape (..., n), N m/s. Zero asks what would ring on if the torque stayed as it is
            from now on; the ramp's own rate asks what rings about the moving manifold.
    """
    k, j, m = _checked(stiffness, rotor_inertia, link_inertia)
    away = _array(deflection) - _array(manifold_torque) / k
    rate = _array(deflection_rate) - _array(manifold_rate) / k
    return np.asarray(
        0.5 * ((k * away * away).sum(axis=-1) + (rate * _solve(_mobility(j, m), rate)).sum(axis=-1))
    )


def step_energy(
    torque_step: ArrayLike, stiffness: ArrayLike, rotor_inertia: ArrayLike, link_inertia: ArrayLike
) -> Array:
    """Energy that a torque step injects into an arm on its manifold, dz0 . K^-1 dz0 / 2, shape (...,), J.

    The manifold jumps by dz0 = W^-1 J^-1 dtorque while angles and velocities stay.

    Args:
        torque_step: Change of the motors' torque, shape (..., n), N m.
        stiffness: See the module.
        rotor_inertia: See the module.
        link_inertia: See the module.
    """
    return np.asarray(_step_energies(torque_step, stiffness, rotor_inertia, link_inertia)[0].sum(axis=-1))


def ramp_energy(
    torque_step: ArrayLike,
    duration: float,
    stiffness: ArrayLike,
    rotor_inertia: ArrayLike,
    link_inertia: ArrayLike,
) -> Array:
    """The most that the same change injects as a ramp, if it stops at its end or anywhere before, shape (...,), J.

    At its end it leaves the share |sin(w T / 2) / (w T / 2)|^2 (see `safe_wrappers.control.handover.vibration`): at
    most (2 / (w T))^2, and never more than 1.

    Args:
        torque_step: Whole change, shape (..., n), N m.
        duration: T, s, positive.
        stiffness: See the module.
        rotor_inertia: See the module.
        link_inertia: See the module.
    """
    energies, omega = _step_energies(torque_step, stiffness, rotor_inertia, link_inertia)
    share = np.minimum(1.0, 2.0 / (omega * _positive("duration", duration)))
    return np.asarray((energies * share**2).sum(axis=-1))


def smoothstep_energy(
    torque_step: ArrayLike,
    duration: float,
    stiffness: ArrayLike,
    rotor_inertia: ArrayLike,
    link_inertia: ArrayLike,
    *,
    cut_short: bool = False,
) -> Array:
    """The most that the same change injects as a smoothstep s = 10 x^3 - 15 x^4 + 6 x^5, x = t / T, shape (...,), J.

    Args:
        torque_step: Whole change, shape (..., n), N m.
        duration: T, s, positive.
        stiffness: See the module.
        rotor_inertia: See the module.
        link_inertia: See the module.
        cut_short: Bound it for a blend that may stop anywhere on its way, where its rate is not zero.
    """
    energies, omega = _step_energies(torque_step, stiffness, rotor_inertia, link_inertia)
    share = smoothstep_share(omega * _positive("duration", duration), cut_short)
    return np.asarray((energies * share).sum(axis=-1))


def torque_slew_limit(
    energy: float,
    stiffness: ArrayLike,
    rotor_inertia: ArrayLike,
    link_inertia: ArrayLike,
    *,
    weights: ArrayLike = 1.0,
    control_dt: float = 0.0,
) -> Array:
    """Torque rates of the joints, shape (..., n), N m/s, that keep every ramp within them below an energy.

    On a ramp the manifold moves at dz0/dt = W^-1 J^-1 rate =: K r, so the deflection's quasi-steady rate is r, not
    zero. An arm at rest on the manifold has it at none: the start is a kick of -r in the deviation's rate, worth
    r . W^-1 r / 2, and the stop another of +r. About the moving manifold the energy between them stays; at worst,
    half a period on, the second kick adds to the first, and twice the speed is four times the energy:

        E <= 2 r . W^-1 r = 2 rate . Q rate,    Q = J^-1 W^-1 K^-1 W^-1 K^-1 W^-1 J^-1.

    Within |rate_i| <= s weights_i the right side is at most 2 s^2 weights . |Q| weights, which gives s (for two
    joints the worst signs reach it; for more it is on the safe side).

    A torque held over control steps is a staircase, whose kicks add up to (w hold / 2) / sin(w hold / 2) times as
    much at a resonance w: `control_dt` counts that.

    It is one ramp from one constant torque to another, from an arm on its manifold: see the module for what a rate
    limit does not bound. Over several poses take the smallest.

    Args:
        energy: J, positive.
        stiffness: See the module.
        rotor_inertia: See the module.
        link_inertia: See the module.
        weights: Relative rates of the joints, shape (n,), positive.
        control_dt: Control step over which a torque is held, s; 0: a continuous ramp.

    Raises:
        ConfigurationError: Bad input, or a resonance at the control's Nyquist frequency or above.
    """
    root, omega, shapes = _modes(stiffness, rotor_inertia, link_inertia)
    half = omega * control_dt / 2.0
    if not control_dt >= 0.0 or (half >= np.pi / 2.0).any():
        raise ConfigurationError(
            f"control_dt must be 0 or more, and less than half a period of every resonance "
            f"(up to {omega.max() / (2.0 * np.pi):.3g} Hz); got {control_dt!r}"
        )
    _, j, m = _checked(stiffness, rotor_inertia, link_inertia)
    per_rate = shapes.swapaxes(-1, -2) @ (_manifold_per_torque(j, m) / root[:, None])
    per_rate = per_rate / (omega * np.sinc(half / np.pi))[..., None]
    q = per_rate.swapaxes(-1, -2) @ per_rate
    w = np.broadcast_to(_array(weights), j.shape)
    if not (w > 0.0).all():
        raise ConfigurationError(f"weights must be positive, got {w.tolist()}")
    scale = np.sqrt(_positive("energy", energy) / (2.0 * np.einsum("i,...ij,j->...", w, np.abs(q), w)))
    return np.asarray(scale[..., None] * w)


def _step_energies(
    torque_step: ArrayLike, stiffness: ArrayLike, rotor_inertia: ArrayLike, link_inertia: ArrayLike
) -> tuple[Array, Array]:
    """The step's energy by resonance and the resonances, each of shape (..., n)."""
    root, omega, shapes = _modes(stiffness, rotor_inertia, link_inertia)
    _, j, m = _checked(stiffness, rotor_inertia, link_inertia)
    moved = np.einsum("...ij,...j->...i", _manifold_per_torque(j, m), _array(torque_step)) / root
    return np.asarray(0.5 * np.einsum("...ji,...j->...i", shapes, moved) ** 2), omega


def _modes(
    stiffness: ArrayLike, rotor_inertia: ArrayLike, link_inertia: ArrayLike
) -> tuple[Array, Array, Array]:
    """K^1/2 (n,), the resonances (..., n), and the eigenvectors of K^1/2 W K^1/2 as columns (..., n, n)."""
    k, j, m = _checked(stiffness, rotor_inertia, link_inertia)
    root = np.sqrt(k)
    squares, shapes = np.linalg.eigh(root[:, None] * _mobility(j, m) * root)
    return root, np.sqrt(squares), shapes


def _mobility(j: Array, m: Array) -> Array:
    """W = J^-1 + M^-1, symmetric."""
    inverse = np.linalg.inv(m)
    return np.asarray(np.diag(1.0 / j) + 0.5 * (inverse + inverse.swapaxes(-1, -2)))


def _manifold_per_torque(j: Array, m: Array) -> Array:
    """W^-1 J^-1 = M (M + J)^-1."""
    return np.asarray(np.linalg.solve(m + np.diag(j), m).swapaxes(-1, -2))


def _solve(matrix: Array, vector: Array) -> Array:
    return np.asarray(np.linalg.solve(matrix, vector[..., None])[..., 0])


def _array(value: ArrayLike) -> Array:
    return np.asarray(value, dtype=np.float64)


def _positive(name: str, value: float) -> float:
    if not 0.0 < value < np.inf:
        raise ConfigurationError(f"{name} must be positive and finite, got {value!r}")
    return value


def _checked(
    stiffness: ArrayLike, rotor_inertia: ArrayLike, link_inertia: ArrayLike
) -> tuple[Array, Array, Array]:
    m = _array(link_inertia)
    n = m.shape[-1] if m.ndim > 1 else 0
    if n == 0 or m.shape[-2] != n:
        raise ConfigurationError(f"link_inertia must have shape (..., n, n), got {m.shape}")
    diagonals = []
    for name, value in (("stiffness", stiffness), ("rotor_inertia", rotor_inertia)):
        diagonal = _array(value)
        if diagonal.shape not in ((), (n,)) or not (np.isfinite(diagonal) & (diagonal > 0.0)).all():
            raise ConfigurationError(f"{name} must be {n} positive numbers, got {diagonal.tolist()}")
        diagonals.append(np.broadcast_to(diagonal, (n,)))
    symmetric = np.isfinite(m).all() and np.allclose(
        m, m.swapaxes(-1, -2), rtol=0.0, atol=1e-9 * np.abs(m).max()
    )
    if not symmetric or not (np.linalg.eigvalsh(m) > 0.0).all():
        raise ConfigurationError(f"link_inertia must be symmetric and positive definite, got {m.tolist()}")
    return diagonals[0], diagonals[1], m
