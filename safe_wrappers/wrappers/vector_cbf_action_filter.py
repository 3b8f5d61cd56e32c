"""VectorCBFActionFilter: CBFActionFilter for all envs of a vector env."""

import copy
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, Final

import gymnasium as gym
from gymnasium.vector import SyncVectorEnv, VectorActionWrapper, VectorEnv, VectorWrapper

from safe_wrappers.errors import ConfigurationError, UnsupportedEnvError
from safe_wrappers.filter.constraint import Constraint
from safe_wrappers.filter.fallback import FallbackFunction
from safe_wrappers.plants.plant import Plant
from safe_wrappers.wrappers.cbf_action_filter import CBFActionFilter
from safe_wrappers.wrappers.layer import action_array

if TYPE_CHECKING:
    _Wrapper = VectorWrapper[Any, Any, Any, Any, Any]
else:
    _Wrapper = VectorWrapper  # no generic class in Gymnasium 1.1


EACH: Final = (
    "protect each env of it: gym.make_vec(id, num_envs=..., vectorization_mode='sync', wrappers=[sw.protect])"
)


class VectorCBFActionFilter(_Wrapper):
    """Filters the actions of all envs of a `SyncVectorEnv`.

    Every env gets a `CBFActionFilter` of its own, around it in the vector env, with the same guarantees and the same
    bits as alone.

    Args:
        env: A `SyncVectorEnv`, or vector wrappers around one that leave actions as they are. In an `AsyncVectorEnv`
            the states are in other processes: filter each env there. It is changed in place: its envs become
            `filters`.
        constraints: As for `CBFActionFilter`; so are the other arguments.
        plant: Not bound yet; every env gets a copy. None reads its MuJoCo model.
        fallback: See there.
        margin: See there.

    Attributes:
        filters: Each env's filter.

    Raises:
        UnsupportedEnvError: Not such a vector env.
        ConfigurationError: As `CBFActionFilter`.

    Example:
        >>> import gymnasium as gym, safe_wrappers as sw
        >>> envs = gym.make_vec("Reacher-v5", num_envs=2, vectorization_mode="sync")
        >>> envs = sw.VectorCBFActionFilter(envs, [sw.constraints.JointSpeedLimit(limit=4.0)])
        >>> _ = envs.reset(seed=0)
        >>> infos = envs.step(envs.action_space.sample())[4]
        >>> infos["cbf/margin"].shape
        (2,)
    """

    def __init__(
        self,
        env: VectorEnv[Any, Any, Any],
        constraints: Sequence[Constraint | dict[str, Any]],
        plant: Plant | None = None,
        fallback: str | FallbackFunction = "brake",
        margin: float = 0.0,
    ) -> None:
        super().__init__(env)
        envs = single_envs(env)
        self.filters = [
            CBFActionFilter(single, constraints, copy.deepcopy(plant), fallback, margin) for single in envs
        ]
        envs[:] = self.filters
        for single in self.filters:  # each warning once, not once for every env
            single.warned = self.filters[0].warned

    def step(self, actions: Any) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        """Filter the actions, shape (n, m), and step the envs with what may be executed."""
        space: Any = self.filters[0].action_space
        return self.env.step(list(action_array(actions, (self.num_envs, *space.shape))))


def single_envs(env: VectorEnv[Any, Any, Any]) -> list[gym.Env[Any, Any]]:
    """The list of envs in a `SyncVectorEnv`, or an error that says what to do with another vector env."""
    inner: Any = env
    while isinstance(inner, VectorWrapper):
        if isinstance(inner, VectorActionWrapper | VectorCBFActionFilter):
            raise ConfigurationError(
                f"{type(inner).__name__} inside the filter changes the actions that the filter has checked; put it "
                "outside (filter first, then this wrapper), so that the filter has the last word"
            )
        inner = inner.env
    if not isinstance(inner, SyncVectorEnv):
        raise UnsupportedEnvError(
            f"expected a SyncVectorEnv, whose envs are in this process, got {inner!r}; {EACH}"
        )
    envs: list[gym.Env[Any, Any]] = inner.envs
    return envs
