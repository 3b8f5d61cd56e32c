"""Lines that protect an env for which there is no recipe: the first of three filters that can be made of it."""

from typing import Any, Final, NamedTuple

import gymnasium as gym

from safe_wrappers.constraints import JointSpeedLimit, PredictiveShield
from safe_wrappers.errors import ConfigurationError
from safe_wrappers.filter.constraint import Constraint
from safe_wrappers.plants.env_checks import check_actions
from safe_wrappers.plants.simulator.plant import SimulatorPlant
from safe_wrappers.wrappers.action_shield import ActionShield
from safe_wrappers.wrappers.cbf_action_filter import CBFActionFilter
from safe_wrappers.wrappers.vector_cbf_action_filter import VectorCBFActionFilter

_SHIELD: Final = (
    "It can be simulated. Say by h(observation) what must stay positive, by backup(observation) which action keeps "
    "it so, and by horizon how many steps to look ahead; then these lines protect it"
)
_LIMIT_LINE: Final = "limit = sw.constraints.JointSpeedLimit(limit=4.0)  # rad/s, m/s; or another constraint"
_SHIELD_LINE: Final = "shield = sw.constraints.PredictiveShield(h, horizon, backup)"


class Remedy(NamedTuple):
    """Lines that protect an env, and the text that introduces them."""

    says: str
    code: str
    """Makes the filtered env out of `env`, with this library as `sw`."""
    is_open: bool = False
    """Whether the user has to give h, horizon and backup."""


def remedy_for(env: Any, single: gym.Env[Any, Any]) -> Remedy:
    """The first filter that can be made of an env: a speed limit by MuJoCo's model, else a simulation of the env.

    Args:
        env: What is to be filtered. The filters are made to be tried, and some of them reset it.
        single: The env itself, or one of a vector env's.

    Raises:
        ConfigurationError: None can be made; the message says why.
    """
    discrete = isinstance(single.action_space, gym.spaces.Discrete | gym.spaces.MultiDiscrete)
    vector = isinstance(env, gym.vector.VectorEnv)
    kind: Any = ActionShield if discrete else VectorCBFActionFilter if vector else CBFActionFilter
    if not discrete:
        check_actions(single)
        if _is_made(kind, env, JointSpeedLimit(4.0)) is None:
            return Remedy("These lines protect it", f"{_LIMIT_LINE}\nenv = sw.{kind.__name__}(env, [limit])")
    shield = PredictiveShield(lambda seen: 1.0, 2, "hold")
    code = f"{_SHIELD_LINE}\nenv = sw.{kind.__name__}(env, [shield])"
    if _is_made(kind, env, shield) is None:
        return Remedy(_SHIELD, code, is_open=True)
    refused = _is_made(kind, env, shield, plant=SimulatorPlant("fork"))
    if refused is None:
        return Remedy(_SHIELD, f'{code[:-1]}, plant=sw.SimulatorPlant("fork"))', is_open=True)
    raise refused


def _is_made(kind: Any, env: Any, constraint: Constraint, **plant: Any) -> ConfigurationError | None:
    """What refuses the filter, or None."""
    try:
        kind(env, [constraint], **plant)
    except ConfigurationError as error:
        return error
    return None
