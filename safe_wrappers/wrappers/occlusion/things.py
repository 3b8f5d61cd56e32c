"""What the tracks of an `OcclusionPenalty` follow, and the observation space that shows it."""

from collections.abc import Callable, Sequence, Sized
from fnmatch import fnmatchcase
from typing import Any

import gymnasium as gym
import mujoco
import numpy as np

from safe_wrappers.errors import UnknownNameError, UnsupportedEnvError
from safe_wrappers.wrappers.occlusion.track import Track


def tracked_things(
    model: mujoco.MjModel, tracks: Sequence[Track], published: Callable[[Track], Sized]
) -> tuple[list[int], list[str], list[int]]:
    """Body (-1: a published point) and name of every tracked thing, and how many each track follows."""
    bodies: list[int] = []
    names: list[str] = []
    counts: list[int] = []
    for track in tracks:
        if track.bodies is not None:
            there = {model.body(b).name: b for b in range(1, model.nbody) if model.body(b).name}
            found = [b for name, b in there.items() if fnmatchcase(name, track.bodies)]
            if not found:
                listed = ", ".join(there) or "none"
                raise UnknownNameError(f"the model has no body {track.bodies!r}; it has: {listed}")
            bodies += found
            names += [model.body(b).name for b in found]
            counts.append(len(found))
        else:
            count = len(published(track))
            bodies += [-1] * count
            names += [f"{track.published}[{i}]" for i in range(count)]
            counts.append(count)
    return bodies, names, counts


def with_tracks(space: gym.Space[Any], size: int) -> gym.Space[Any]:
    """The observation space with so many numbers more."""
    if isinstance(space, gym.spaces.Dict):
        if "tracks" in space.spaces:
            raise UnsupportedEnvError(
                "the observation has an entry 'tracks' already, which the estimates would replace; rename it inside, "
                "or pass observe=False"
            )
        more = gym.spaces.Box(-np.inf, np.inf, (size,), dtype=np.float64)
        return gym.spaces.Dict({**space.spaces, "tracks": more})
    if (
        isinstance(space, gym.spaces.Box)
        and len(space.shape) == 1
        and np.issubdtype(space.dtype, np.floating)
    ):
        bound = np.full(size, np.inf)
        low, high = np.concatenate([space.low, -bound]), np.concatenate([space.high, bound])
        return gym.spaces.Box(low.astype(space.dtype), high.astype(space.dtype), dtype=space.dtype.type)
    raise UnsupportedEnvError(
        f"with observe=True the observation must be a flat Box of floats or a Dict, got {space}; flatten it inside, "
        "or pass observe=False"
    )


def check_env(env: gym.Env[Any, Any]) -> None:
    """Refuse an env without a MuJoCo model."""
    raw: Any = env.unwrapped
    if not isinstance(getattr(raw, "model", None), mujoco.MjModel) or not hasattr(raw, "data"):
        raise UnsupportedEnvError(
            f"OcclusionPenalty casts rays in MuJoCo: it needs an env with .model and .data; {raw} has none"
        )
