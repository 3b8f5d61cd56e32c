"""What an arm over springs carries, and what a change of torque leaves ringing in it (Spong's two masses per joint).

K, J and M: `stiffness` and `rotor_inertia`, diagonals, shape (n,), N m/rad and kg m^2; `link_inertia`, shape
(..., n, n), kg m^2. With pose, speeds and bias frozen the deflection swings about the manifold z0 at the resonances,
roots of K W with W = J^-1 + M^-1; the energies are those of this swinging, for one change from one held torque to
another.
"""

import numpy as np
from numpy.typing import ArrayLike

from safe_wrappers.checks import Array
from safe_wrappers.control.handover.vibration import smoothstep_share


def manifold(torque: Array, rotor_inertia: Array, link_inertia: Array, taken: Array | float = 0.0) -> Array:
    """z0, shape (..., n), N m: what the gears of a rigid arm carry.

    Args:
        torque: Of the motors less their friction, shape (..., n), N m.
        rotor_inertia: See the module.
        link_inertia: See the module.
        taken: C(q, q') q' + g(q), shape (..., n), N m.
    """
    net = np.asarray(torque - np.asarray(taken))
    both = link_inertia + np.diag(rotor_inertia)
    # The rotors keep J q'' of the torque to themselves.
    return np.asarray(torque - rotor_inertia * np.linalg.solve(both, net[..., None])[..., 0])


def resonances(stiffness: Array, rotor_inertia: Array, link_inertia: Array) -> Array:
    """Eigenvalues of the square root of K W, ascending, shape (..., n), rad/s."""
    return _modes(stiffness, rotor_inertia, link_inertia)[0]


def step_energies(torque_step: ArrayLike, *machine: Array) -> Array:
    """Energy that a step of the torque, shape (n,), N m, leaves in each resonance, shape (..., n), J."""
    _, per_torque = _modes(*machine)
    return np.asarray(0.5 * np.einsum("...ij,j->...i", per_torque, np.asarray(torque_step)) ** 2)


def smoothstep_energy(
    torque_step: ArrayLike, duration: float, *machine: Array, cut_short: bool = False
) -> Array:
    """The most that the same change leaves as a smoothstep over a duration in s, shape (...,), J.

    With `cut_short` for a blend that may stop anywhere on its way.
    """
    phase = resonances(*machine) * duration
    # Stopped on its way, a change whose rate rises once and falls once leaves at most 2 max(s') / w, by parts.
    share = np.minimum(1.0, 3.75 / phase) ** 2 if cut_short else smoothstep_share(phase)
    return np.asarray((step_energies(torque_step, *machine) * share).sum(axis=-1))


def torque_slew_limit(energy: float, *machine: Array, weights: Array, control_dt: float) -> Array:
    """Torque rates of the joints, shape (..., n), N m/s, that keep every ramp within them below an energy in J.

    A ramp's start kicks the deflection's rate, its stop kicks it again; at worst, half a period on, the two add up,
    to twice the speed and four times the energy. A torque held over control steps of `control_dt` s is a staircase,
    whose kicks are (w hold / 2) / sin(w hold / 2) times as large at a resonance w. `weights`, shape (n,): relative
    rates.
    """
    omega, per_torque = _modes(*machine)
    per_rate = per_torque / (omega * np.sinc(omega * control_dt / (2.0 * np.pi)))[..., None]
    squares = np.abs(per_rate.swapaxes(-1, -2) @ per_rate)
    scale = np.sqrt(energy / (2.0 * np.einsum("i,...ij,j->...", weights, squares, weights)))
    return np.asarray(scale[..., None] * weights)


def _modes(stiffness: Array, rotor_inertia: Array, link_inertia: Array) -> tuple[Array, Array]:
    """The resonances, and the change of each mode's K^1/2-scaled deflection per torque, shape (..., n, n)."""
    root = np.sqrt(stiffness)
    mobility = np.diag(1.0 / rotor_inertia) + np.linalg.inv(link_inertia)
    squares, shapes = np.linalg.eigh(root[:, None] * mobility * root)
    both = link_inertia + np.diag(rotor_inertia)
    carried = np.linalg.solve(both, link_inertia).swapaxes(-1, -2)  # W^-1 J^-1 = M (M + J)^-1
    return np.sqrt(squares), np.asarray(shapes.swapaxes(-1, -2) @ (carried / root[:, None]))
