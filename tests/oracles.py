"""Short formulas, written a second time, to hold the library against."""

import numpy as np
from scipy.spatial import ConvexHull, QhullError

from safe_wrappers.control.contact import cone_excess, tangents
from safe_wrappers.control.estimation import discretise


def blind_covariance(start, a, q, time_s):
    """The covariance after a time without measurements, from the exact steps of `discretise`."""
    transition, _, noise = discretise(a, q, time_s)
    return transition @ start @ np.swapaxes(transition, -1, -2) + noise


def in_cone(forces, normals, friction, tolerance=0.0):
    return cone_excess(forces, normals, friction) <= tolerance


def common_normal(points, normals):
    """Of contacts in one plane; None where they are at several heights or face different ways."""
    mean = normals.sum(axis=0) / max(np.linalg.norm(normals.sum(axis=0)), 0.5 * len(points), 1e-9)
    level = np.abs((points - points.mean(axis=0)) @ mean) <= 0.01 if len(points) else np.zeros(1, bool)
    facing = normals @ mean >= np.cos(0.05) - 1e-12
    return mean if level.all() and facing.all() else None


def margin_inside(point, corners):
    """Distance of a point, shape (2,), from the edge of a convex polygon, anticlockwise; negative outside."""
    edges = np.roll(corners, -1, axis=0) - corners
    inward = np.stack([-edges[:, 1], edges[:, 0]], axis=1) / np.linalg.norm(edges, axis=1)[:, None]
    inside = (inward * (point - corners)).sum(axis=1).min()
    if inside >= 0.0:
        return inside
    along = ((point - corners) * edges).sum(axis=1) / (edges**2).sum(axis=1)
    nearest = corners + np.clip(along, 0.0, 1.0)[:, None] * edges
    return -np.linalg.norm(point - nearest, axis=1).min()


def support_margin(points, normals, forces):
    """Distance of the zero moment point from the edge of the support polygon; NaN where one of them is none."""
    normal = common_normal(points, normals)
    if normal is None or (pressure := forces.sum(axis=0) @ normal) <= 0.0:
        return np.nan
    arms, across = points - points.mean(axis=0), tangents(normal)
    try:
        corners = (flat := arms @ across.T)[ConvexHull(flat).vertices]
    except (QhullError, ValueError):  # on a line; too few
        return np.nan
    zero_moment_point = np.cross(normal, np.cross(arms, forces).sum(axis=0)) / pressure
    return margin_inside(across @ zero_moment_point, corners)


def damping_ratios(arm, inertia):
    """Of the two-mass model of an arm with elastic joints, from the eigenvalues of its whole linear system."""
    k, j, n = arm.stiffness, arm.rotor_inertia, len(arm.stiffness)
    springs = np.block([[np.diag(k), -np.diag(k)], [-np.diag(k), np.diag(k)]])
    d = np.diag(np.broadcast_to(arm.joint_damping, n))
    damping = np.block([[d + np.diag(np.broadcast_to(arm.motor_damping, n)), -d], [-d, d]])
    inverse = np.block([[np.diag(1.0 / j), np.zeros((n, n))], [np.zeros((n, n)), np.linalg.inv(inertia)]])
    system = np.block([[np.zeros((2 * n, 2 * n)), np.eye(2 * n)], [-inverse @ springs, -inverse @ damping]])
    values = np.linalg.eigvals(system)
    ringing = sorted(values[values.imag > 1.0], key=abs)
    return np.array([-value.real / abs(value) for value in ringing])


def held(axis, x, v, u):
    """Every physics step of one control step of an env that clips the speed at its start; the speed at its end."""
    v, u = min(max(v, -axis.clip), axis.clip), min(max(u, axis.low), axis.high)
    xs = []
    for _ in range(axis.substeps):
        v = axis.decay * v + axis.gain * u
        x += axis.timestep * v
        xs.append(x)
    return xs, v


def to_rest(axis, v):
    """The control that ends a hold at rest, bounds left aside: from two trial steps, as a step is linear in it."""
    (_, none), (_, full) = held(axis, 0.0, v, 0.0), held(axis, 0.0, v, axis.high)
    return -none * axis.high / (full - none)
