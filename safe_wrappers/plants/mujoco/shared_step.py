"""SharedStep: the rollout of the executed control is the env's own step, and need not be simulated twice."""

from typing import Any, Final

import gymnasium as gym
import mujoco
import numpy as np
from gymnasium.envs.mujoco import MujocoEnv

from safe_wrappers.checks import Array
from safe_wrappers.errors import ConfigurationError
from safe_wrappers.plants.mujoco.forecast import Recorder

_STATE: Final = int(mujoco.mjtState.mjSTATE_INTEGRATION)
_SLEEP: Final = int(mujoco.mjtEnableBit.mjENBL_SLEEP)
_MJ_STEP: Final = mujoco.mj_step
_KNOWN: Final = ("gymnasium.envs.mujoco.", "safe_wrappers.envs.velocity")
"""Envs whose shared step was measured equal bit for bit (`tests/plants/test_shared_step.py`)."""


def shared_step(
    env: gym.Env[Any, Any], substeps: int, exact: bool, wanted: bool | None
) -> "SharedStep | None":
    """What hands rollouts of `substeps` to an env, or None where they are not its own steps.

    `exact` says whether rollouts start from the env's present state, on a copy of its model. `wanted` is None to take
    the envs that were measured alone, True for any that does not override the step, or a ConfigurationError.
    """
    raw: Any = env.unwrapped
    inherits = getattr(type(raw), "_step_mujoco_simulation", None) is MujocoEnv._step_mujoco_simulation
    # MuJoCo's state, from which rollouts start, does not say which bodies sleep.
    same = exact and inherits and not raw.model.opt.enableflags & _SLEEP
    if wanted and not same:
        raise ConfigurationError(
            "share_step=True needs the env's own model, no delay, no flag sleep, and an env that steps as "
            f"Gymnasium's MujocoEnv does; {raw} and its plant do not have all of these: leave it out"
        )
    known = wanted or (wanted is None and type(raw).__module__.startswith(_KNOWN))
    return SharedStep(raw, substeps) if same and known else None


class SharedStep:
    """Hands a rollout's data to the env in the place of its simulation step.

    The rollout is used only if the env is about to simulate what was rolled out: the same number of physics steps,
    the same controls and the same integration state, byte for byte. Else the env simulates as ever. What is not
    compared is the model: the caller knows that the rollout's is the env's. `count` is the number of env steps that
    were taken over from a rollout.
    """

    def __init__(self, raw: Any, substeps: int) -> None:
        self._raw, self._substeps = raw, substeps
        self._state = np.zeros(mujoco.mj_stateSize(raw.model, _STATE))
        self._offered: Any = None
        self.count = 0

    def offer(self, rollout: Recorder, start: Array) -> None:
        """Let a rollout's first control interval, from the state `start`, be the env's next simulation."""
        raw = self._raw
        if mujoco.mj_step is not _MJ_STEP or "_step_mujoco_simulation" in vars(raw):
            return
        simulate = raw._step_mujoco_simulation

        def take_over(ctrl: Array, n_frames: int) -> None:
            del raw._step_mujoco_simulation  # a second simulation within one step is the env's own
            mujoco.mj_getState(raw.model, raw.data, self._state, _STATE)
            held = rollout.held_after(np.asarray(ctrl, dtype=np.float64).tobytes())
            if (
                held is None
                or n_frames != self._substeps
                or self._state.tobytes() != start.tobytes()
                or held.warning.number.any()
            ):
                simulate(ctrl, n_frames)
                return
            warned = raw.data.warning.number.copy()
            mujoco.mj_copyData(raw.data, raw.model, held)
            raw.data.warning.number[:] = warned
            mujoco.mj_rnePostConstraint(raw.model, raw.data)
            self.count += 1

        self._offered = raw._step_mujoco_simulation = take_over

    def withdraw(self) -> None:
        """Leave the env as it was, if it has not used what was offered."""
        if vars(self._raw).get("_step_mujoco_simulation") is self._offered:
            vars(self._raw).pop("_step_mujoco_simulation", None)
        self._offered = None
