"""The contacts of a MuJoCo model: which bodies, how far apart, how much force along the normal."""

from collections.abc import Sequence
from typing import NamedTuple

import mujoco
import numpy as np

from safe_wrappers.checks import name_list
from safe_wrappers.errors import UnknownNameError


class NormalContact(NamedTuple):
    """One contact."""

    bodies: tuple[int, int]
    """Ids of the two bodies, the smaller first; `nbody` stands for something flexible."""
    gap: float
    """Signed distance, m; negative where they penetrate."""
    force: float
    """Along the normal, N; positive pushes them apart."""


class Contacts:
    """Reads the contacts between the named bodies of a model and those they touch; None is all of them.

    Raises:
        UnknownNameError: No body has that name; the message lists all names.
    """

    def __init__(
        self, model: mujoco.MjModel, bodies: Sequence[str] | None = None, against: Sequence[str] | None = None
    ) -> None:
        self.model = model
        one, other = (
            _chosen(model, name, given) for name, given in (("bodies", bodies), ("against", against))
        )
        self._watched = (one[:, None] & other | other[:, None] & one).tolist()
        # The last entry is for geom -1, of something flexible.
        self._body_of_geom: list[int] = [*model.geom_bodyid.tolist(), model.nbody]
        # A pyramidal cone's edges share the normal force; an elliptic cone's first row has it.
        pyramids = model.opt.cone == int(mujoco.mjtCone.mjCONE_PYRAMIDAL)
        self._rows = {dim: 2 * (dim - 1) if pyramids and dim > 1 else 1 for dim in (1, 3, 4, 6)}

    def read(self, data: mujoco.MjData) -> list[NormalContact]:
        """The watched contacts, as MuJoCo has computed them last."""
        if data.ncon == 0:
            return []
        contact, forces, found = data.contact, data.efc_force.tolist(), []
        body = self._body_of_geom
        for (geom1, geom2), gap, row, dim in zip(
            contact.geom.tolist(),
            contact.dist.tolist(),
            contact.efc_address.tolist(),
            contact.dim.tolist(),
            strict=True,
        ):
            first, second = body[geom1], body[geom2]
            if self._watched[first][second]:
                force = sum(forces[row : row + self._rows[dim]]) if row >= 0 else 0.0
                found.append(NormalContact((min(first, second), max(first, second)), gap, force))
        return found


def _chosen(model: mujoco.MjModel, argument: str, names: Sequence[str] | None) -> np.ndarray:
    """Which bodies are named, shape (nbody + 1,); the last entry stands for flexible parts, which have no name."""
    if names is None:
        return np.ones(model.nbody + 1, dtype=bool)
    names = name_list(argument, names, "names of bodies", "None for all")
    known = {model.body(i).name: i for i in range(model.nbody)}
    unknown = [name for name in names if name not in known]
    if unknown:
        there = ", ".join(name for name in known if name)
        raise UnknownNameError(f"{argument}: the model has no body {unknown[0]!r}; it has: {there}")
    chosen = np.zeros(model.nbody + 1, dtype=bool)
    chosen[[known[name] for name in names]] = True
    return chosen
