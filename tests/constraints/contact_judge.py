"""Contact forces of an env's own steps, from the numbers of MuJoCo's solver, and drivers that make feet slide."""

import mujoco
import numpy as np

from safe_wrappers.plants.mujoco.contacts import Replay


def moves(model, body):
    """Whether a body has a joint between itself and the world."""
    while body:
        if model.body_dofnum[body]:
            return True
        body = model.body_parentid[body]
    return False


def solver_force(model, data, contact):
    """Along the normal and the two tangents: what a contact's rows of the solver add up to, N."""
    first, dim = contact.efc_address, contact.dim
    if dim == 1:
        return np.array([data.efc_force[first], 0.0, 0.0])
    if model.opt.cone == mujoco.mjtCone.mjCONE_ELLIPTIC:
        return np.array(data.efc_force[first : first + 3])
    # A row pushes along an edge of the pyramid: the normal, plus or minus a tangent times its friction.
    edges = data.efc_force[first : first + 2 * (dim - 1)].reshape(-1, 2)
    sideways = (edges[:2, 0] - edges[:2, 1]) * contact.friction[:2]
    return np.array([edges.sum(), *sideways])


def touches(model, data):
    """Body, point, normal, force on the robot and friction of each contact with what does not move."""
    found = []
    for contact in data.contact:
        if contact.efc_address < 0 or -1 in contact.geom:
            continue
        one, two = (int(model.geom_bodyid[g]) for g in contact.geom)
        if moves(model, one) == moves(model, two):
            continue
        frame = contact.frame.reshape(3, 3)
        body, side = (two, 1.0) if moves(model, two) else (one, -1.0)
        force = side * frame.T @ solver_force(model, data, contact)
        friction = min(contact.friction[:2]) if contact.dim > 1 else 0.0
        found.append((body, contact.pos.copy(), side * frame[0], force, friction))
    return found


class ConeJudge:
    """By how much the contact forces of an env's step leave their cones.

    Args:
        env: The filtered one.
        share: Of the friction.
    """

    def __init__(self, env, share):
        self.raw, self.share = env.unwrapped, share
        m = self.raw.model
        mass = sum(m.body_mass[b] for b in range(m.nbody) if moves(m, b))
        self.weight = mass * np.linalg.norm(m.opt.gravity)
        self._replay = Replay(self.raw)

    def step(self, env, action):
        """The largest excess at any evaluation, a share of the weight (-inf: nothing touches), and the step."""
        self._replay.before()
        result = env.step(action)
        self.instants = []
        assert self._replay.after(lambda data, _: self.instants.append(touches(self.raw.model, data)))
        return max((e for at in self.instants for e in self._excesses(at)), default=-np.inf), result

    def _excesses(self, contacts):
        for _, _, normal, force, friction in contacts:
            pressure = force @ normal
            sideways = np.linalg.norm(force - pressure * normal)
            yield max(sideways - self.share * friction * pressure, -pressure) / self.weight


def at_random(space, k, rng):
    return rng.uniform(space.low, space.high)


def bang_bang(space, k, rng):
    bits = np.random.default_rng(k // 7).random(space.shape) < 0.5
    return np.where(bits, space.low, space.high)


def noisy(space, k, rng):
    """A weak policy: it stands, falls and scrapes."""
    return 0.15 * space.high * rng.normal(size=space.shape).clip(-3, 3)


DRIVERS = {d.__name__: d for d in (at_random, bang_bang, noisy)}
