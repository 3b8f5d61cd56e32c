"""What wrappers share that look at the physics of every control step: the replay, and words for where it fails."""

import warnings
from typing import Any

import gymnasium as gym
import mujoco

from safe_wrappers.errors import UnsupportedEnvError
from safe_wrappers.plants.mujoco.replay import Replay, Visit
from safe_wrappers.stack import Layer, refuse_order


class StepWatch:
    """Makes each control step of a MuJoCo env once more, and warns once where that ends elsewhere.

    Args:
        name: Of the wrapper that looks.
        env: What it wraps.
        partial: Its info key for steps that were not seen.

    Raises:
        UnsupportedEnvError: No MuJoCo model.
        ConfigurationError: A `ChunkHandover` inside, whose step is many control steps, or a second of its kind.
    """

    def __init__(self, name: str, env: gym.Env[Any, Any], partial: str) -> None:
        raw: Any = env.unwrapped
        if not isinstance(getattr(raw, "model", None), mujoco.MjModel) or not hasattr(raw, "data"):
            raise UnsupportedEnvError(f"{name} needs an env with MuJoCo's .model and .data; {raw} has none")
        refuse_order(env, Layer.MONITOR, name)
        self._name, self._raw, self._partial = name, raw, partial
        self._replay = Replay(raw)
        self._warned = False

    def before(self) -> None:
        """Keep the state that the env's step starts from."""
        self._replay.before()

    def after(self, visit: Visit) -> bool:
        """Visit every evaluation of the physics of the step since; whether they are those of the env's own."""
        whole = self._replay.after(visit)
        if not whole and not self._warned:
            self._warned = True
            warnings.warn(
                f"a control step of {self._raw}, made once more, does not end where the env's did: the env "
                "changes its inputs or its state between physics substeps, or MuJoCo has reset it. For such steps "
                f"{self._name} reads only the contacts that the step has left behind, and says so in "
                f"info[{self._partial!r}]; forces before are missed",
                UserWarning,
                stacklevel=3,
            )
        return whole
