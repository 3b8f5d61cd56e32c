"""How long an env of MuJoCo holds an action."""

from typing import Any

import gymnasium as gym

from safe_wrappers.errors import UnsupportedEnvError


def control_interval(raw: Any) -> float:
    """How long an unwrapped MuJoCo env holds one action, s."""
    return physics_steps(raw) * float(raw.model.opt.timestep)


def physics_steps(raw: Any) -> int:
    """How many physics substeps an unwrapped MuJoCo env takes with one action."""
    env = _stepped(raw)
    named = getattr(env, "frame_skip", getattr(env, "n_substeps", None))
    if named is not None:
        return int(named)
    if not hasattr(env, "dt"):
        raise UnsupportedEnvError(
            f"{raw} does not say how long a step lasts: give it an attribute dt (s) or frame_skip (physics steps)"
        )
    return round(float(env.dt) / float(raw.model.opt.timestep))


def _stepped(raw: Any) -> Any:
    """The env that steps the physics: this one, or one that it holds over the same data (a maze holds its robot)."""
    if hasattr(raw, "frame_skip"):
        return raw
    held = (e for e in vars(raw).values() if isinstance(e, gym.Env) and getattr(e, "data", None) is raw.data)
    return next(held, raw)
