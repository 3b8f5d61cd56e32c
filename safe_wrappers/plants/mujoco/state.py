"""The present state of a `MujocoPlant`: the env's, or under a delay the one predicted from it."""

from abc import ABC
from collections import deque
from typing import Any

import mujoco
import numpy as np

from safe_wrappers.checks import Array
from safe_wrappers.plants.mujoco.contacts import ContactForecast
from safe_wrappers.plants.mujoco.forecast import Forecast
from safe_wrappers.plants.plant import Plant

_STATE = mujoco.mjtState.mjSTATE_INTEGRATION


class MujocoState(Plant, ABC):
    """A snapshot of an env's data, and the plant's own data that is loaded with it when something is computed."""

    model: mujoco.MjModel
    data: mujoco.MjData
    substeps: int
    _raw: Any
    _pending: deque[Array]
    _forecasts: dict[bytes, Forecast]
    _contact_forecasts: dict[bytes, ContactForecast]

    def _start(self) -> None:
        """Called by `bind`, once the model and the control interval are known."""
        self._nq, self._nv = int(self.model.nq), int(self.model.nv)
        self._delay_steps = int(np.ceil(self.delay_s / self.model.opt.timestep - 1e-9))
        self._pending = deque(maxlen=max(1, -(-self._delay_steps // self.substeps)))
        self._snapshot = np.zeros(mujoco.mj_stateSize(self.model, int(_STATE)))
        self._forget()

    def _forget(self) -> None:
        """Called when the state or the model has changed."""
        self._loaded = self._forwarded = False
        self._forecasts, self._contact_forecasts = {}, {}

    def observe(self) -> None:
        """Take the env's present state; everything else is computed on demand."""
        mujoco.mj_getState(self._raw.model, self._raw.data, self._snapshot, int(_STATE))
        self._forget()
        self.observation_id += 1
        # MuJoCo resets a state with a NaN: a prediction would hide it.
        if self._delay_steps and bool(np.isfinite(self._snapshot).all()):
            self._predict_over_delay()

    def executed(self, control: Array | None) -> None:
        """Remember a sent command for the delay."""
        if control is None:
            self._pending.clear()
        elif self._delay_steps:
            self._pending.append(np.array(control))

    def _predict_over_delay(self) -> None:
        self._load()
        # The oldest command has already acted in part; before the first one the env's own control acts.
        early = self._delay_steps - self.substeps * len(self._pending)
        if early > 0:
            mujoco.mj_step(self.model, self.data, early)
        for i, control in enumerate(self._pending):
            self.data.ctrl[:] = control
            mujoco.mj_step(self.model, self.data, self.substeps + (min(early, 0) if i == 0 else 0))
        self._keep()

    def _keep(self) -> None:
        """Take the data's state as the present one."""
        mujoco.mj_getState(self.model, self.data, self._snapshot, int(_STATE))
        self._loaded = False

    def _load(self) -> None:
        if not self._loaded:
            mujoco.mj_setState(self.model, self.data, self._snapshot, int(_STATE))
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
