"""StepMonitor: base of the monitors, which look at the physics of every control step and change nothing."""

from abc import ABC, abstractmethod
from typing import Any, ClassVar

import mujoco

from safe_wrappers.errors import UnsupportedEnvError
from safe_wrappers.plants.mujoco.replay import Replay
from safe_wrappers.stack import Layer
from safe_wrappers.wrappers.common.layer import Env, LayerWrapper, Step


class StepMonitor(LayerWrapper, ABC):
    """Makes each control step of a MuJoCo env once more, visits its physics, and warns once where it ends elsewhere.

    Raises:
        UnsupportedEnvError: No MuJoCo model.
        ConfigurationError: A `ChunkHandover` inside, whose step is many control steps, or a second of its kind.
    """

    layer: ClassVar = Layer.MONITOR
    partial: ClassVar[str]
    """Its info key for steps that could not be replayed."""

    def __init__(self, env: Env) -> None:
        LayerWrapper.__init__(self, env)
        raw: Any = env.unwrapped
        name = type(self).__name__
        if not isinstance(getattr(raw, "model", None), mujoco.MjModel) or not hasattr(raw, "data"):
            raise UnsupportedEnvError(f"{name} needs an env with MuJoCo's .model and .data; {raw} has none")
        self._replay = Replay(raw)

    def step(self, action: Any) -> Step:
        """Step the env, and look at the physics of that step."""
        self._replay.before()
        answer = self._pass_on(action)
        raw: Any = self.unwrapped
        self._begin(raw.model)
        whole = self._replay.after(self._visit)
        if not whole:
            message = (
                f"a control step of {raw}, made once more, ends elsewhere: the env changes inputs or state between "
                f"substeps, or MuJoCo has reset it; only the contacts left behind are read (info[{self.partial!r}])"
            )
            self._warn_once("partial", message)
            self._begin(raw.model)
            self._visit(raw.data, float(raw.model.opt.timestep))
        answer[4].update(self._figures(raw.data) | {self.partial: not whole})
        return answer

    @abstractmethod
    def _begin(self, model: mujoco.MjModel) -> None:
        """Forget what was visited; the env may have made itself another model, or was unpickled."""

    @abstractmethod
    def _visit(self, data: mujoco.MjData, time_s: float) -> None:
        """Look at one evaluation of the physics, which acts for some time, s."""

    @abstractmethod
    def _figures(self, data: mujoco.MjData) -> dict[str, Any]:
        """The info of what was visited and of the state after the step."""
