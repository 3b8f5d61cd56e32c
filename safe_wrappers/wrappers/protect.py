"""protect: the recommended stack for a known env, in one call."""

import difflib
import inspect
import textwrap
from typing import Any, Final, overload

import gymnasium as gym
import mujoco

from safe_wrappers.errors import UnknownNameError, UnsupportedEnvError
from safe_wrappers.plants.env_checks import check_actions
from safe_wrappers.wrappers.cbf_action_filter import CBFActionFilter
from safe_wrappers.wrappers.presets import ActionShield
from safe_wrappers.wrappers.recipes import EVERY, PLANTS, family_of, recipe_of
from safe_wrappers.wrappers.stack import refuse_order
from safe_wrappers.wrappers.vector_cbf_action_filter import EACH, VectorCBFActionFilter, single_envs

VectorEnv = gym.vector.VectorEnv[Any, Any, Any]
_BY_HAND: Final = {
    "limit": "sw.constraints.JointSpeedLimit(limit=4.0)  # rad/s, m/s; or another constraint",
    "shield": "sw.constraints.PredictiveShield(h, horizon, backup)  # backup(seen) keeps h(seen) positive",
}
"""Constraints of an env with a MuJoCo model, and of any other, which has to be simulated."""


@overload
def protect(env: gym.Env[Any, Any], **options: Any) -> CBFActionFilter: ...
@overload
def protect(env: VectorEnv, **options: Any) -> VectorCBFActionFilter: ...
def protect(env: gym.Env[Any, Any] | VectorEnv, **options: Any) -> CBFActionFilter | VectorCBFActionFilter:
    """Wrap a known env, or a vector env of it, with the constraints that we recommend and test for it.

    Args:
        env: Made by `gymnasium.make`; its id without the version selects the recipe. Or a `SyncVectorEnv` of one id.
        options: Those of `CBFActionFilter`, with `margin` added to the recipe's own. SafePointGoal also takes
            `detour` (go around a hazard instead of stopping before it, default True) and `uncertainty` (of mass and
            damping, a fraction, default 0; above 0 nothing is proved); SafeCarGoal takes `detour`; Fetch takes
            `keep_out` (obstacles for its fingers).

    Raises:
        UnsupportedEnvError: No env, or no recipe for it; the message has the lines that protect it by hand.
        ConfigurationError: A layer inside that belongs outside, such as `RecordInterventions`.

    Example:
        >>> import gymnasium as gym, safe_wrappers as sw
        >>> env = sw.protect(gym.make("SafePointGoal1-v0"))
    """
    kind: Any = CBFActionFilter
    if isinstance(env, gym.vector.VectorEnv):
        kind, (single, *others) = VectorCBFActionFilter, single_envs(env)
        ids = sorted({one.spec.id if one.spec is not None else "" for one in (single, *others)})
        if len(ids) > 1:
            raise UnsupportedEnvError(f"expected a vector env of one id, got {ids}; protect each env of it")
        if isinstance(env.single_action_space, gym.spaces.Discrete):
            raise UnsupportedEnvError(f"discrete actions are shielded env by env, got {env!r}; {EACH}")
    elif isinstance(env, gym.Env):
        refuse_order(env, CBFActionFilter.layer, "protect")
        kind, single = ActionShield if isinstance(env.action_space, gym.spaces.Discrete) else kind, env
    else:
        raise UnsupportedEnvError(
            f"expected an env as gym.make returns it, or a Gymnasium vector env, got {env!r}; with other vector envs "
            "protect each env of it, such as make_vec_env(..., wrapper_class=sw.protect)"
        )
    family, name = family_of(single), recipe_of(single.spec.id) if single.spec is not None else None
    if name is None:
        if not isinstance(single.action_space, gym.spaces.Discrete):
            check_actions(single)  # no lines would protect it
        raise UnsupportedEnvError(_without_recipe(kind.__name__, single))
    recipe = EVERY[name]
    of_recipe, of_filter = ([*inspect.signature(takes).parameters] for takes in (recipe, CBFActionFilter))
    known = [option for option in (*of_filter, *of_recipe) if option not in ("env", "constraints")]
    for option in options:
        if option not in known:
            raise UnknownNameError(
                f"protect has no option {option!r} for {family}; it has {', '.join(known)}"
            )
    constraints = recipe(single, **{n: options.pop(n) for n in of_recipe if n in options})
    if family in PLANTS:
        options.setdefault("plant", PLANTS[family]())
    filtered: CBFActionFilter | VectorCBFActionFilter = kind(env, constraints, **options)
    return filtered


def _without_recipe(kind: str, single: gym.Env[Any, Any]) -> str:
    """Lines that make a filter, of that kind, and the recipes of similar names."""
    known = kind != ActionShield.__name__ and isinstance(
        getattr(single.unwrapped, "model", None), mujoco.MjModel
    )
    what = "limit" if known else "shield"
    lines = f"import safe_wrappers as sw\n{what} = {_BY_HAND[what]}\nenv = sw.{kind}(env, [{what}])"
    near = difflib.get_close_matches(family_of(single), EVERY, n=3, cutoff=0.5)
    similar = f"\nRecipes of similar names: {', '.join(near)}" if near else ""
    name = single.spec.id if single.spec is not None else repr(single.unwrapped)
    return f"no recipe for {name}. These lines protect it:\n{textwrap.indent(lines, '    ')}{similar}"
