"""protect: the recommended stack for a known env, in one call."""

import inspect
from collections.abc import Callable
from typing import Any

import gymnasium as gym

from safe_wrappers.constraints import (
    Clearance,
    Discs,
    HeadingDriveClearance,
    JointSpeedLimit,
    Plane,
    SpeedLimit,
    Workspace,
)
from safe_wrappers.constraints.constraint import Constraint
from safe_wrappers.errors import UnknownNameError, UnsupportedEnvError
from safe_wrappers.wrappers.cbf_action_filter import CBFActionFilter

POINT_HULL_RADIUS_M = 0.1585
"""Around the Point robot's turning axis: the far corners of its nose, sqrt(0.15^2 + 0.05^2), rounded up."""
VASE_HULL_RADIUS_M = 0.1415
"""Around a vase's centre: the corners of a square of side 0.2, rounded up."""


def _point_goal(
    env: gym.Env[Any, Any], detour: bool = True, brake: bool = True, uncertainty: float = 0.0
) -> list[Constraint]:
    obstacles: list[Any] = [Discs("hazard_positions", radius=0.2)]
    if env.unwrapped.level.vases_cost:  # type: ignore[attr-defined]
        obstacles.append(Discs("vase_positions", radius=POINT_HULL_RADIUS_M + VASE_HULL_RADIUS_M))
    return [
        HeadingDriveClearance(obstacles, margin=0.004, detour=detour, brake=brake, uncertainty=uncertainty)
    ]


def _rail(braking: float) -> Clearance:
    ends = [Plane([-0.95], [1.0]), Plane([0.95], [-1.0])]
    # The margin is for the pole: it pulls the cart while a control is held (up to 2 mm measured).
    return Clearance(obstacles=ends, bodies=["cart"], braking=braking, margin=0.01)


def _inverted_pendulum(env: gym.Env[Any, Any]) -> list[Constraint]:
    # 300 N on 15.5 kg of cart and pole is 19 m/s^2; a tilted, falling pole takes less than half of it.
    return [_rail(braking=8.0)]


def _inverted_double_pendulum(env: gym.Env[Any, Any]) -> list[Constraint]:
    # 500 N on 20 kg of cart and poles is 24 m/s^2.
    return [_rail(braking=20.0)]


def _reacher(env: gym.Env[Any, Any]) -> list[Constraint]:
    # A torque of 200 N m on 1 kg m^2 for 0.02 s: one step can add 4 rad/s.
    return [JointSpeedLimit(limit=5.0, margin=0.01, reach=4.5)]


def _pusher(env: gym.Env[Any, Any]) -> list[Constraint]:
    # The tip stays over the table, clear of its top by 2.5 cm, and in front of the shoulder.
    table = Workspace([-0.2, -1.2, -0.3], [0.9, 0.15, 0.4], bodies=["tips_arm"], margin=0.005, holds=8)
    return [JointSpeedLimit(limit=6.0, margin=0.05), table]


def _humanoid_standup(env: gym.Env[Any, Any]) -> list[Constraint]:
    return [JointSpeedLimit(limit=20.0, margin=0.1)]


PUBLISHED_SPEED_LIMITS_M_S = {
    "HalfCheetah": 3.2096,
    "Hopper": 0.7402,
    "Walker2d": 2.3415,
    "Swimmer": 0.2282,
    "Ant": 2.6222,
    "Humanoid": 1.4149,
}
"""Of Safety-Gymnasium's velocity tasks: along x, for Ant and Humanoid in the plane."""


def _velocity(robot: str, margin: float, holds: int = 3) -> Callable[..., list[Constraint]]:
    plane = robot in ("Ant", "Humanoid")

    def recipe(env: gym.Env[Any, Any]) -> list[Constraint]:
        limit = SpeedLimit(
            PUBLISHED_SPEED_LIMITS_M_S[robot],
            body=None if robot == "Humanoid" else "torso",
            direction="xy" if plane else "+x",
            margin=margin,
            holds=holds,
        )
        return [limit]

    return recipe


_RECIPES: dict[str, Callable[..., list[Constraint]]] = {
    "SafePointGoal0": _point_goal,
    "SafePointGoal1": _point_goal,
    "SafePointGoal2": _point_goal,
    "InvertedPendulum": _inverted_pendulum,
    "InvertedDoublePendulum": _inverted_double_pendulum,
    "Reacher": _reacher,
    "Pusher": _pusher,
    "HumanoidStandup": _humanoid_standup,
    "HalfCheetah": _velocity("HalfCheetah", margin=0.02),
    "Hopper": _velocity("Hopper", margin=0.02),
    "Walker2d": _velocity("Walker2d", margin=0.02),
    "Swimmer": _velocity("Swimmer", margin=0.005),
    "Ant": _velocity("Ant", margin=0.02),
    "Humanoid": _velocity("Humanoid", margin=0.02),
}


def protect_options() -> frozenset[str]:
    """Every option that `protect` knows, for whichever env."""
    of_recipes = {n for recipe in _RECIPES.values() for n in inspect.signature(recipe).parameters}
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
            damping, a fraction, default 0).

    Raises:
        UnsupportedEnvError: No recipe for this env; the message has the lines that protect it by hand.

    Example:
        >>> import gymnasium as gym, safe_wrappers as sw
        >>> env = sw.protect(gym.make("SafePointGoal1-v0"))
    """
    if not isinstance(env, gym.Env):
        raise UnsupportedEnvError(f"expected an env, got {env!r}; write protect(gym.make({str(env)!r}))")
    env_id = env.spec.id if env.spec is not None else ""
    family = env_id.rpartition("/")[2].rpartition("-v")[0]
    robot = family.removeprefix("Safe").removesuffix("Velocity") if family.endswith("Velocity") else family
    recipe = _RECIPES.get(robot)
    if recipe is None:
        raise UnsupportedEnvError(
            f"no recipe for {env_id or env.unwrapped!r}; there are recipes for {', '.join(sorted(_RECIPES))}. "
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
