"""Copies of envs with all their wrappers, in their present state."""

import copy
import inspect
import threading
from collections.abc import Iterator
from types import FunctionType, ModuleType
from typing import Any

import gymnasium as gym
import mujoco

from safe_wrappers.errors import ConfigurationError, UnsupportedEnvError
from safe_wrappers.plants.env_checks import name_of, wrappers_of
from safe_wrappers.plants.mujoco.model import Constants, every_constant

_DRAWING = ("pygame", "glfw", "OpenGL", "moviepy")
_SHARED = (gym.Space, gym.envs.registration.EnvSpec, ModuleType)
_LOCKS = {type(made()): made for made in (threading.Lock, threading.RLock)}
_WAYS_OUT = "Simulate in child processes, SimulatorPlant(snapshot='fork'), where the system has them"
_RECORDING = ("RecordVideo", "HumanRendering", "RenderCollection")
Memo = dict[int, Any]


def envs_of(env: gym.Env[Any, Any]) -> Iterator[gym.Env[Any, Any]]:
    """The env, what it wraps, and what these hold as attributes, each once."""
    found: dict[int, Any] = {}
    left: list[Any] = [env]
    while left:
        one = left.pop()
        if id(one) in found:
            continue
        found[id(one)] = one
        yield one
        left += [value for value in vars(one).values() if isinstance(value, gym.Env)]


def refuse_recorders(env: gym.Env[Any, Any]) -> None:
    """Refuse wrappers that would draw or write what only a copy has done."""
    for inner in wrappers_of(env):
        if type(inner).__name__ in _RECORDING:
            raise ConfigurationError(
                f"{type(inner).__name__} inside the filter would also record the steps of the filter's simulations; "
                "put it outside (filter first, then this wrapper)"
            )


def refuse_finalizers(env: gym.Env[Any, Any]) -> None:
    """Refuse to copy what closes something when it is deleted: copies would close it for the env, too."""
    seen: set[int] = set()
    left: list[tuple[str, Any]] = [(type(env).__name__, env)]
    while left:
        path, value = left.pop()
        if id(value) in seen or isinstance(value, (*_SHARED, type, FunctionType)) or is_drawn(value):
            continue
        seen.add(id(value))
        if hasattr(type(value), "__del__") and not isinstance(value, gym.Env):
            raise UnsupportedEnvError(
                f"{name_of(env)} cannot be copied: {path} is a {type(value).__name__}, which closes what it holds "
                f"when a copy of it is deleted. {_WAYS_OUT}"
            )
        if isinstance(value, dict):
            left += [(f"{path}[{key!r}]", one) for key, one in value.items()]
        elif isinstance(value, list | tuple | set):
            left += [(f"{path}[{i}]", one) for i, one in enumerate(value)]
        else:
            left += [(f"{path}.{name}", one) for name, one in getattr(value, "__dict__", {}).items()]


def is_drawn(value: Any) -> bool:
    """Whether a value is a window, a renderer or a picture, which no copy needs."""
    kind = type(value)
    # SWIG's types have no module.
    return getattr(kind, "__module__", "").partition(".")[0] in _DRAWING or kind.__name__.endswith(
        ("Renderer", "Viewer")
    )


class EnvCopier:
    """Copies an env again and again; MuJoCo's model is copied when it has changed, its data into one place.

    A copy is valid until the next one is made. EzPickle, whose copies are new envs, has no say. Spaces and specs are
    shared; windows and renderers are left out.

    Args:
        env: With all the wrappers inside the filter.
    """

    def __init__(self, env: gym.Env[Any, Any]) -> None:
        self._env = env
        self.start()

    def start(self) -> None:
        """Copy models again: a reset may have changed what is not compared."""
        self._models: dict[int, tuple[Any, Any, Constants]] = {}
        self._data: dict[int, tuple[Any, Any, Any]] = {}

    def __getstate__(self) -> dict[str, Any]:
        # What is copied is known by its address, which another process does not have.
        return vars(self) | {"_models": {}, "_data": {}}

    def copy(self) -> gym.Env[Any, Any]:
        """The env in its present state.

        Raises:
            UnsupportedEnvError: An attribute cannot be copied; the message has its name.
        """
        memo: Memo = {}
        envs = list(envs_of(self._env))
        for one in envs:
            memo[id(one)] = object.__new__(type(one))
            for value in vars(one).values():
                if isinstance(value, _SHARED):
                    memo[id(value)] = value
                elif isinstance(value, mujoco.MjModel):
                    memo[id(value)] = self._model(value)
                elif is_drawn(value):
                    memo[id(value)] = None
        for one in envs:
            for value in vars(one).values():
                if isinstance(value, mujoco.MjData):
                    memo[id(value)] = self._copy_of_data(value)
        for one in envs:
            attributes: dict[str, Any] = memo[id(one)].__dict__
            for name, value in vars(one).items():
                known = id(value) in memo  # as None, too, which deepcopy would take for "not copied yet"
                attributes[name] = memo[id(value)] if known else _copied(one, name, value, memo)
            if "render_mode" in attributes:
                attributes["render_mode"] = None
        copied: gym.Env[Any, Any] = memo[id(self._env)]
        return copied

    def _model(self, model: mujoco.MjModel) -> mujoco.MjModel:
        known = self._models.get(id(model))
        if known is None or known[2].changed():
            self._models[id(model)] = known = model, copy.copy(model), every_constant(model)
            self._data = {}
        return known[1]

    def _copy_of_data(self, data: mujoco.MjData) -> mujoco.MjData:
        if id(data) not in self._data:
            model = self._model(data.model)
            self._data[id(data)] = data, model, mujoco.MjData(model)
        _, model, own = self._data[id(data)]
        mujoco.mj_copyData(own, model, data)
        return own


def _copied(owner: Any, name: str, value: Any, memo: Memo) -> Any:
    if isinstance(value, FunctionType):
        held = inspect.getclosurevars(value).nonlocals.values()
        if any(id(getattr(one, "__self__", one)) in memo for one in held):
            raise UnsupportedEnvError(
                f"{name_of(owner)} cannot be copied: the function {type(owner).__name__}.{name} refers to the env "
                "itself, and in a copy would still act on that; make it a method of a wrapper or a subclass"
            )
        return value
    if type(value) in _LOCKS:  # a copy has its own
        return _LOCKS[type(value)]()
    try:
        return copy.deepcopy(value, memo)
    except Exception as error:
        raise UnsupportedEnvError(
            f"{name_of(owner)} cannot be copied: {type(owner).__name__}.{name} is a {type(value).__name__}"
            f" ({error}). {_WAYS_OUT}"
        ) from None
