"""EpisodeGuard: a wrapper's steps and resets one at a time, in the episode that its env is in."""

import functools
from collections.abc import Callable
from threading import get_ident
from typing import Any, Final

import gymnasium as gym

from safe_wrappers.errors import SafeWrappersError

_HOLDER: Final = "_stepping"
_LOST: Final = "its env was made anew, and is not in the episode that it remembers"
"""Holds what was copied until its next reset."""


class EpisodeGuard:
    """Base of all wrappers: guards `step` and `reset`, its own and those of subclasses.

    A call while another thread is in one is refused: env and wrapper have one episode. A copy, pickled or deep, of an
    env that is made anew by its constructor (EzPickle, as most MuJoCo envs) is at no state of the episode that the
    wrapper remembers: its step is refused until it is reset.
    """

    def __init_subclass__(cls, **kwargs: Any) -> None:
        super().__init_subclass__(**kwargs)
        for name in ("step", "reset"):
            if name in vars(cls) or EpisodeGuard in cls.__bases__:
                setattr(cls, name, _guarded(getattr(cls, name)))

    def __getstate__(self) -> dict[str, Any]:
        state = {name: value for name, value in vars(self).items() if name != _HOLDER}
        raw: Any = self.unwrapped  # type: ignore[attr-defined]
        if any(isinstance(env.unwrapped, gym.utils.EzPickle) for env in getattr(raw, "envs", [raw])):
            state[_HOLDER] = _LOST
        return state


def _guarded(method: Callable[..., Any]) -> Callable[..., Any]:
    @functools.wraps(method)
    def guarded(self: Any, *arguments: Any, **options: Any) -> Any:
        mine, own = (get_ident(),), self.__dict__
        holder = own.setdefault(_HOLDER, mine)  # one operation, in which threads do not change
        if holder is not mine:
            if holder == mine:  # of its base class
                return method(self, *arguments, **options)
            if holder != _LOST:
                raise SafeWrappersError(
                    f"{type(self).__name__}.{method.__name__} was called while another thread is in a step or reset "
                    "of the same env, which has one state: give every thread an env of its own, or a lock around both"
                )
            if method.__name__ == "step":
                raise gym.error.ResetNeeded(
                    f"this {type(self).__name__} is a copy: {_LOST}; call reset before step"
                )
            own[_HOLDER] = mine
        try:
            return method(self, *arguments, **options)
        finally:
            del own[_HOLDER]

    return guarded
