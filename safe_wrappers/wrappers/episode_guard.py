"""EpisodeGuard: a wrapper's steps and resets one at a time, in the episode that its env is in."""

import functools
from collections.abc import Callable
from threading import get_ident
from typing import Any, Final

import gymnasium as gym

from safe_wrappers.errors import SafeWrappersError

_HOLDER: Final = "_stepping"
"""Which thread is in a step or reset; absent while none is."""
_AWAITS: Final = "_awaits_reset"
"""Why steps are refused until a reset; None while there is an episode."""
_NEW: Final = "new, and has no episode yet"
_LOST: Final = "a copy: its env was made anew, and is not in the episode that it remembers"
_FAILED: Final = "in no episode: its last reset failed"


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
        vars(self)[_AWAITS] = _NEW

    def __getstate__(self) -> dict[str, Any]:
        state = {name: value for name, value in vars(self).items() if name != _HOLDER}
        raw: Any = self.unwrapped  # type: ignore[attr-defined]
        if any(isinstance(env.unwrapped, gym.utils.EzPickle) for env in getattr(raw, "envs", [raw])):
            state[_AWAITS] = _LOST
        return state


def _guarded(method: Callable[..., Any]) -> Callable[..., Any]:
    begins = method.__name__ == "reset"

    @functools.wraps(method)
    def guarded(self: Any, *arguments: Any, **options: Any) -> Any:
        mine, own = (get_ident(),), self.__dict__
        holder = own.setdefault(_HOLDER, mine)  # one operation, in which threads do not change
        if holder is not mine:
            if holder == mine:  # of its base class
                return method(self, *arguments, **options)
            raise SafeWrappersError(
                f"{type(self).__name__}.{method.__name__} was called while another thread is in a step or reset "
                "of the same env, which has one state: give every thread an env of its own, or a lock around both"
            )
        try:
            if begins:
                own[_AWAITS] = _FAILED
            elif own[_AWAITS] is not None:
                raise gym.error.ResetNeeded(
                    f"this {type(self).__name__} is {own[_AWAITS]}; call reset before step"
                )
            found = method(self, *arguments, **options)
            if begins:
                own[_AWAITS] = None
            return found
        finally:
            del own[_HOLDER]

    return guarded
