"""What an arm over springs carries, and how it rings (Spong's two masses per joint).

K, J and M: `stiffness` and `rotor_inertia`, diagonals, shape (n,), N m/rad and kg m^2; `link_inertia`, shape
(..., n, n), kg m^2. With pose, speeds and bias frozen the deflection swings about the manifold z0 at the resonances,
roots of K W with W = J^-1 + M^-1.
"""

import numpy as np

from safe_wrappers.errors import Array


def resonances(stiffness: Array, rotor_inertia: Array, link_inertia: Array) -> Array:
    """Eigenvalues of the square root of K W, ascending, shape (..., n), rad/s."""
    root = np.sqrt(stiffness)
    mobility = np.diag(1.0 / rotor_inertia) + np.linalg.inv(link_inertia)
    return np.sqrt(np.linalg.eigvalsh(root[:, None] * mobility * root))


def inertia_of(arm, q):
    """M of the env's arm at link angles, shape (..., 2); shape (..., 2, 2), kg m^2."""
    cos = arm.coupling * np.cos(q[..., 1])
    side = arm.forearm + cos
    rows = [arm.inertia + 2.0 * cos, side, side, np.full_like(side, arm.forearm)]
    return np.stack(rows, axis=-1).reshape(*side.shape, 2, 2)


def bias_of(arm, q, q_dot):
    """Coriolis and centripetal torque C(q, q_dot) q_dot, shape (..., 2), N m; the arm is level."""
    sin = arm.coupling * np.sin(q[..., 1])
    v0, v1 = q_dot[..., 0], q_dot[..., 1]
    return np.stack([-sin * v1 * (2.0 * v0 + v1), sin * v0 * v0], axis=-1)


def vibration_energy(arm, qpos, qvel, torque):
    """Of the boundary layer, J, at coordinates motor 0, spring 0, motor 1, spring 1, shape (4,); from matrices."""
    q, q_dot = qpos[::2] + qpos[1::2], qvel[::2] + qvel[1::2]
    m, j, driving = inertia_of(arm, q), arm.rotor_inertia, torque - arm.motor_damping * qvel[::2]
    # What the gears of a rigid arm carry, N m: its rotors keep J q'' of the torque to themselves.
    z0 = driving - j * np.linalg.solve(m + np.diag(j), driving - bias_of(arm, q, q_dot))
    away, rate = -qpos[1::2] - z0 / arm.stiffness, -qvel[1::2]
    mobility = np.diag(1.0 / j) + np.linalg.inv(m)
    return 0.5 * (arm.stiffness @ away**2 + rate @ np.linalg.solve(mobility, rate))
