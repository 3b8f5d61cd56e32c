"""Snapshot: what a plant keeps of a MuJoCo env's state, and the names in its model."""

from typing import Final

import mujoco
import numpy as np

from safe_wrappers.checks import Array
from safe_wrappers.plants.mujoco import model as of_model
from safe_wrappers.plants.plant import Plant

STATE: Final = int(mujoco.mjtState.mjSTATE_INTEGRATION)


class Snapshot(Plant):
    """A plant with a model and data of its own, whose present state is a vector of MuJoCo's.

    Attributes:
        model: The plant's own.
        data: Likewise; at the present state only after `_load`.
    """

    model: mujoco.MjModel
    data: mujoco.MjData
    _loaded = _forwarded = False

    def _new_snapshot(self) -> None:
        self._nq, self._nv = int(self.model.nq), int(self.model.nv)
        self._snapshot: Array = np.zeros(mujoco.mj_stateSize(self.model, STATE))

    def _keep(self) -> None:
        """Make the data's state the present one."""
        mujoco.mj_getState(self.model, self.data, self._snapshot, STATE)
        self._loaded = False

    def _load(self) -> None:
        if not self._loaded:
            mujoco.mj_setState(self.model, self.data, self._snapshot, STATE)
            self._loaded, self._forwarded = True, False

    def _load_to_step(self) -> None:
        """The data at the present state; the caller may change it."""
        self._load()
        self._loaded = False

    @property
    def time(self) -> float:
        """Time of the present state, s; under a delay the predicted one."""
        return float(self._snapshot[0])

    @property
    def qpos(self) -> Array:
        """Positions, shape (nq,): m, rad, or quaternions."""
        return self._snapshot[1 : 1 + self._nq]

    @property
    def qvel(self) -> Array:
        """Velocities, shape (nv,): m/s or rad/s."""
        return self._snapshot[1 + self._nq : 1 + self._nq + self._nv]

    @property
    def state(self) -> Array:
        """(qpos, qvel), shape (nq + nv,)."""
        return self._snapshot[1 : 1 + self._nq + self._nv]

    @property
    def weight_n(self) -> float:
        """Weight of everything that moves, N; without gravity its mass in kg."""
        return of_model.weight_n(self.model)

    def named(self, kind: str, name: str, argument: str = "") -> int:
        """The id of a body, site, geom, joint or actuator; for an unknown name an error that lists all.

        The error also says which `argument` has the name, where the caller may have left that at its default.
        """
        return of_model.named(self.model, kind, name, argument)

    def names(self, kind: str, pattern: str = "*") -> list[str]:
        """All names of a kind that match a shell pattern."""
        return of_model.names(self.model, kind, pattern)
