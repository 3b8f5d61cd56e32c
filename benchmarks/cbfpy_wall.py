"""The wall of `peers` in CBFpy's terms; needs the extra `bench`."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from cbfpy import CBF, CBFConfig

from benchmarks.peers import ALPHA, BRAKE, WALL


class WallConfig(CBFConfig):  # type: ignore[misc]
    """The same problem."""

    def __init__(self) -> None:
        super().__init__(n=2, m=1, u_min=[-1.0], u_max=[1.0])

    def f(self, z: Any) -> Any:
        return jnp.array([z[1], 0.0])

    def g(self, z: Any) -> Any:
        return jnp.array([[0.0], [1.0]])

    def h_1(self, z: Any) -> Any:
        return jnp.array([WALL - z[0] - z[1] ** 2 / (2.0 * BRAKE)])

    def alpha(self, h: Any) -> Any:
        return ALPHA * h


def safety_filter() -> Callable[[np.ndarray, np.ndarray], np.ndarray]:
    """State and nominal control to CBFpy's control; compiled."""
    jax.config.update("jax_platform_name", "cpu")
    made = CBF.from_config(WallConfig())
    return lambda x, u: np.asarray(made.safety_filter(x, u))
