"""protect: the recommended stack for a known env, in one call."""

import difflib
import inspect
import textwrap
from collections.abc import Callable
from typing import Any, Final, overload

import gymnasium as gym

from safe_wrappers.constraints import JointSpeedLimit, PredictiveShield
from safe_wrappers.errors import ConfigurationError, UnknownNameError, UnsupportedEnvError
from safe_wrappers.filter.constraint import Constraint
from safe_wrappers.plants.env_checks import check_actions
from safe_wrappers.plants.simulator.plant import SimulatorPlant
from safe_wrappers.recipes import RECIPES
from safe_wrappers.shelf import PLANTS, SHELF
from safe_wrappers.stack import refuse_order
from safe_wrappers.wrappers.action_shield import ActionShield
from safe_wrappers.wrappers.cbf_action_filter import CBFActionFilter
from safe_wrappers.wrappers.vector_cbf_action_filter import VectorCBFActionFilter, by_env, single_envs

_EVERY = {**RECIPES, **SHELF}
VectorEnv = gym.vector.VectorEnv[Any, Any, Any]
_SHIELD: Final = (
    "It can be simulated. Say by h(observation) what must stay positive, by backup(observation) which action keeps "
    "it so, and by horizon how many steps to look ahead; then these lines protect it"
)
_LIMIT_LINE: Final = "limit = sw.constraints.JointSpeedLimit(limit=4.0)  # rad/s, m/s; or another constraint"
_SHIELD_LINE: Final = "shield = sw.constraints.PredictiveShield(h, horizon, backup)"


def recipe_of(env_id: str) -> str | None:
    """The name of the recipe that `protect` has for an id, or None."""
    family = _family(env_id)
    robot = family.removeprefix("Safe").removesuffix("Velocity") if family.endswith("Velocity") else family
    return next((known for known in (robot, robot.partition("_")[0]) if known in _EVERY), None)


def recipe_names() -> list[str]:
    """Every recipe that `protect` has, by the env's id without its version."""
    return sorted(_EVERY)


def _options(takes: Callable[..., Any]) -> list[str]:
    return [name for name in inspect.signature(takes).parameters if name not in ("env", "constraints")]


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
            damping, a fraction, default 0); SafeCarGoal takes `detour`; Fetch takes `low` and `high` (corners of the
            gripper's box, m), `keep_out` (obstacles for its fingers) and `table` (keep the fingers off it, default
            True).

    Raises:
        UnsupportedEnvError: No env, or no recipe for it; the message has the lines that protect it by hand.
        ConfigurationError: A layer inside that belongs outside, such as `RecordInterventions`.

    Example:
        >>> import gymnasium as gym, safe_wrappers as sw
        >>> env = sw.protect(gym.make("SafePointGoal1-v0"))
    """
    if isinstance(env, gym.vector.VectorEnv):
        envs = single_envs(env)
        ids = sorted({_env_id(single) for single in envs})
        if len(ids) > 1:
            raise UnsupportedEnvError(f"expected a vector env of one id, got {ids}; protect each env of it")
        if isinstance(env.single_action_space, gym.spaces.Discrete):
            raise UnsupportedEnvError(
                f"discrete actions are shielded env by env, got {env!r}; protect each env of it: {by_env(env)}"
            )
        constraints = _recommended(envs[0], options, env)
        return VectorCBFActionFilter(env, constraints, **_with_plant(envs[0], options))
    if not isinstance(env, gym.Env):
        raise UnsupportedEnvError(f"expected one env, or a vector env, got {env!r}; {_of_no_env(env)}")
    refuse_order(env, CBFActionFilter.layer, "protect")
    constraints = _recommended(env, options)
    discrete = isinstance(env.action_space, gym.spaces.Discrete)
    return (ActionShield if discrete else CBFActionFilter)(env, constraints, **_with_plant(env, options))


def _with_plant(env: gym.Env[Any, Any], options: dict[str, Any]) -> dict[str, Any]:
    """The options, with the plant that the env needs, if it is not the default one."""
    of_env = PLANTS.get(_family(_env_id(env)))
    return options if of_env is None else {"plant": of_env(env)} | options


def _env_id(env: gym.Env[Any, Any]) -> str:
    return env.spec.id if env.spec is not None else ""


def _family(env_id: str) -> str:
    namespace, _, name = env_id.rpartition("/")
    if namespace == "dm_control":
        return f"{namespace}/{name.partition('-')[0]}"
    return name.rpartition("-v")[0].removesuffix("Dense").removesuffix("Sparse")


def _recommended(
    env: gym.Env[Any, Any], options: dict[str, Any], vector: VectorEnv | None = None
) -> list[Constraint]:
    """The recipe's constraints; takes its options out of all. `vector` is what the env is one of, if it is."""
    env_id = _env_id(env)
    name = recipe_of(env_id)
    if name is None:
        raise UnsupportedEnvError(_without_recipe(env if vector is None else vector, env))
    recipe = _EVERY[name]
    of_recipe, of_filter = _options(recipe), _options(CBFActionFilter)
    for name in options:
        if name not in of_recipe + of_filter:
            known = ", ".join(of_filter + of_recipe)
            raise UnknownNameError(f"protect has no option {name!r} for {_family(env_id)}; it has {known}")
    return recipe(env, **{n: options.pop(n) for n in of_recipe if n in options})


def _remedy(env: Any, single: gym.Env[Any, Any]) -> tuple[str, str]:
    """Lines that make the first filter that works out of `env`, and the text that introduces them.

    A speed limit by MuJoCo's model, else a simulation of the env. `single` is the env itself, or one of a vector
    env's, of which filters are made to be tried; some of them reset it.

    Raises:
        ConfigurationError: None can be made; the message says why.
    """
    discrete = isinstance(single.action_space, gym.spaces.Discrete)
    kind: Any = ActionShield if discrete else CBFActionFilter
    vector = isinstance(env, gym.vector.VectorEnv) and not discrete
    name = VectorCBFActionFilter.__name__ if vector else kind.__name__
    if not discrete:
        check_actions(single)
        if _is_made(kind, single, JointSpeedLimit(4.0)) is None:
            return "These lines protect it", f"{_LIMIT_LINE}\nenv = sw.{name}(env, [limit])"
    shield = PredictiveShield(lambda seen: 1.0, 2, "hold")
    code = f"{_SHIELD_LINE}\nenv = sw.{name}(env, [shield]"
    if _is_made(kind, single, shield) is None:
        return _SHIELD, f"{code})"
    refused = _is_made(kind, single, shield, plant=SimulatorPlant("fork"))
    if refused is None:
        return _SHIELD, f'{code}, plant=sw.SimulatorPlant("fork"))'
    if isinstance(refused, ConfigurationError):
        raise refused
    raise UnsupportedEnvError(f"{type(refused).__name__}: {refused}") from refused


def _is_made(kind: Any, env: Any, constraint: Constraint, **plant: Any) -> Exception | None:
    """What refuses the filter, or None."""
    try:
        kind(env, [constraint], **plant)
    except Exception as error:  # whatever the step of an env raises that cannot be copied
        return error
    return None


def _without_recipe(env: gym.Env[Any, Any] | VectorEnv, single: gym.Env[Any, Any]) -> str:
    """The lines that protect an env by hand, or why none do, and then the recipes of similar names."""
    try:
        says, code = _remedy(env, single)
        by_hand = f"{says}:\n" + textwrap.indent(f"import safe_wrappers as sw\n{code}", "    ")
    except ConfigurationError as error:
        by_hand = f"A filter by hand is refused, too: {error}"
    near = difflib.get_close_matches(_family(_env_id(single)), recipe_names(), n=3, cutoff=0.5)
    similar = f"\nRecipes of similar names: {', '.join(near)}" if near else ""
    return f"no recipe for {_env_id(single) or single.unwrapped!r}. {by_hand}{similar}"


def _of_no_env(given: Any) -> str:
    """What to write instead, where the argument is not an env."""
    if isinstance(given, str):
        return f"write protect(gym.make({given!r}))"
    if hasattr(given, "num_envs"):
        return f"protect each env of it: make_vec_env(..., n_envs={given.num_envs}, wrapper_class=sw.protect)"
    return "write protect(gym.make(...))"
