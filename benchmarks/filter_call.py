"""A whole filter call on a double integrator: ours beside CBFpy, the same barrier, in one run.

python -m benchmarks.filter_call

h = D - v^2 / (2 a) against a wall, one control in a box; states and nominal controls are the same on both sides.
Ours is read through an env, as it runs in training; CBFpy's is its jitted `safety_filter`.
"""

from collections.abc import Callable
from typing import Any

import gymnasium as gym
import jax
import jax.numpy as jnp
import numpy as np
from cbfpy import CBF, CBFConfig

import safe_wrappers as sw
from benchmarks.timing import paired_us

WALL, BRAKE, ALPHA = 1.0, 1.0, 2.0


class DoubleIntegrator(gym.Env[np.ndarray, np.ndarray]):
    """Position and velocity; `place` sets them, `step` does nothing but answer."""

    observation_space = gym.spaces.Box(-np.inf, np.inf, (2,), np.float64)
    action_space = gym.spaces.Box(-1.0, 1.0, (1,), np.float64)
    x = np.zeros(2)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        """Nothing to reset."""
        return self.x, {}

    def step(self, action: np.ndarray) -> Any:
        """Nothing to compute: what is timed is the filter."""
        return self.x, 0.0, False, False, {}


class WallConfig(CBFConfig):  # type: ignore[misc]
    """The same problem in CBFpy's terms."""

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


def main() -> None:
    """Print the ratio."""
    jax.config.update("jax_platform_name", "cpu")
    rng = np.random.default_rng(0)
    states = np.column_stack([rng.uniform(-0.5, 0.6, 256), rng.uniform(0.05, 0.8, 256)])
    nominal = rng.uniform(0.0, 1.0, (256, 1))
    env = DoubleIntegrator()
    effect = np.array([[0.0], [1.0]])
    plant = sw.AnalyticPlant(
        f=lambda x: np.array([x[1], 0.0]), g=lambda x: effect, state=lambda e: e.x, control_dt=0.02
    )
    barrier = sw.constraints.Barrier(
        lambda x: WALL - x[0] - x[1] ** 2 / (2.0 * BRAKE),
        gradient=lambda x: np.array([-1.0, -x[1] / BRAKE]),
        alpha=ALPHA,
    )
    ours = sw.CBFActionFilter(env, [barrier], plant=plant)
    ours.reset()
    theirs = CBF.from_config(WallConfig())
    theirs.safety_filter(states[0], nominal[0]).block_until_ready()

    def cycle(call: Callable[[int], Any]) -> Callable[[], Any]:
        state = {"i": 0}

        def step() -> Any:
            state["i"] = (state["i"] + 1) % len(states)
            return call(state["i"])

        return step

    def filter_ours(i: int) -> Any:
        env.x = states[i]
        return ours.step(nominal[i])

    worst = 0.0
    for i in range(len(states)):
        executed = filter_ours(i)[4]["executed_action"]
        worst = max(
            worst, float(np.abs(executed - np.asarray(theirs.safety_filter(states[i], nominal[i]))).max())
        )
    us = paired_us(
        {
            "safe-wrappers, whole env.step": cycle(filter_ours),
            "CBFpy, safety_filter": cycle(lambda i: np.asarray(theirs.safety_filter(states[i], nominal[i]))),
        }
    )
    print("| filter call, double integrator | us |\n|---|---|")
    for name, value in us.items():
        print(f"| {name} | {value:.1f} |")
    a, b = us.values()
    print(f"\nCBFpy / safe-wrappers: {b / a:.1f}; largest difference of the executed control: {worst:.1e}")


if __name__ == "__main__":
    main()
