"""protect: the recommended stack for a known env, in one call."""

import inspect
from typing import Any

import gymnasium as gym

from safe_wrappers.errors import UnknownNameError, UnsupportedEnvError
from safe_wrappers.recipes import RECIPES
from safe_wrappers.wrappers.cbf_action_filter import CBFActionFilter


def protect_options() -> frozenset[str]:
    """Every option that `protect` knows, for whichever env."""
    of_recipes = {n for recipe in RECIPES.values() for n in inspect.signature(recipe).parameters}
    return frozenset(
        (of_recipes | inspect.signature(CBFActionFilter).parameters.keys()) - {"env", "constraints"}
    )


def protect(env: gym.Env[Any, Any], **options: Any) -> CBFActionFilter:
    """Wrap a known env with the constraints that we recommend and test for it.

    Args:
        env: Made by `gymnasium.make`; its id says which recipe applies, whatever the version.
        options: Passed to `CBFActionFilter`: `margin` (added to the recipe's own), `fallback`, `solver`,
            `plant`. SafePointGoal also takes `detour` (go around a hazard instead of stopping before it,
            default True), `brake` (count on the drive to stop, default True) and `uncertainty` (of mass and
            damping, a fraction, default 0); SafeCarGoal takes `detour`; Fetch takes `low` and `high` (corners of the
            gripper's box, m), `keep_out` (obstacles for its fingers) and `table` (keep them off it, default True).

    Raises:
        UnsupportedEnvError: No recipe for this env; the message has the lines that protect it by hand.

    Example:
        >>> import gymnasium as gym, safe_wrappers as sw
        >>> env = sw.protect(gym.make("SafePointGoal1-v0"))
    """
    if not isinstance(env, gym.Env):
        raise UnsupportedEnvError(f"expected an env, got {env!r}; write protect(gym.make({str(env)!r}))")
    env_id = env.spec.id if env.spec is not None else ""
    family = env_id.rpartition("/")[2].rpartition("-v")[0].removesuffix("Dense")
    robot = family.removeprefix("Safe").removesuffix("Velocity") if family.endswith("Velocity") else family
    recipe = RECIPES.get(robot, RECIPES.get(robot.partition("_")[0]))
    if recipe is None:
        raise UnsupportedEnvError(
            f"no recipe for {env_id or env.unwrapped!r}; there are recipes for {', '.join(sorted(RECIPES))}. "
            "By hand it is three lines:\n"
            "    import safe_wrappers as sw\n"
            "    limit = sw.JointSpeedLimit(limit=4.0)  # or sw.Clearance(...), sw.Barrier(h, alpha=...)\n"
            "    env = sw.CBFActionFilter(env, [limit])"
        )
    of_recipe = [name for name in inspect.signature(recipe).parameters if name != "env"]
    of_filter = [n for n in inspect.signature(CBFActionFilter).parameters if n not in ("env", "constraints")]
    for name in options:
        if name not in of_recipe + of_filter:
            raise UnknownNameError(
                f"protect has no option {name!r} for {family}; it has {', '.join(of_filter + of_recipe)}"
            )
    constraints = recipe(env, **{n: options.pop(n) for n in of_recipe if n in options})
    return CBFActionFilter(env, constraints, **options)
