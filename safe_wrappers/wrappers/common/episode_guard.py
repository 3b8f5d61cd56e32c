"""EpisodeGuard: a wrapper's steps and resets one at a time, in the episode that its env is in."""

import functools
from collections.abc import Callable
from threading import get_ident
from typing import Any, Final

import gymnasium as gym

from safe_wrappers.errors import SafeWrappersError

_HOLDER: Final = "_stepping"
_NEW: Final = "new, and has no episode yet"
_LOST: Final = "a copy: its env was made anew, and is not in the episode that it remembers"
_FAILED: Final = "in no episode: its last reset failed"
"""These hold a wrapper until its next reset."""


class EpisodeGuard:
    """Base of all wrappers: guards `step` and `reset`, its own and those of subclasses.

    A step before the first reset, or after one that failed, is refused. So is a call while another thread is in one:
    env and wrapper have one episode. A copy, pickled or deep, of an env that is made anew by its constructor
    (EzPickle, as most MuJoCo envs) is at no state of the episode that the wrapper remembers: its step is refused
    until it is reset.
    """

    def __init_subclass__(cls, **kwargs: Any) -> None:
        super().__init_subclass__(**kwargs)
        for name in ("step", "reset"):
            if name in vars(cls) or EpisodeGuard in cls.__bases__:
                setattr(cls, name, _guarded(getattr(cls, name)))

    def await_reset(self) -> None:
        """Refuse steps until the first reset; called at construction."""
        vars(self)[_HOLDER] = _NEW

    def __getstate__(self) -> dict[str, Any]:
        state = dict(vars(self))
        if not isinstance(state.get(_HOLDER), str):
            state.pop(_HOLDER, None)
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
            if not isinstance(holder, str):
                raise SafeWrappersError(
                    f"{type(self).__name__}.{method.__name__} was called while another thread is in a step or reset "
                    "of the same env, which has one state: give every thread an env of its own, or a lock around both"
                )
            if method.__name__ == "step":
                raise gym.error.ResetNeeded(f"this {type(self).__name__} is {holder}; call reset before step")
            own[_HOLDER] = mine
        after: str | None = _FAILED if method.__name__ == "reset" else None
        try:
            found = method(self, *arguments, **options)
            after = None
            return found
        finally:
            if after is None:
                del own[_HOLDER]
            else:
                own[_HOLDER] = after

    return guarded
