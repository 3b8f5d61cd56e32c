"""What the filters outside the recipes' hot paths add to an env step, as `env_step` measures it.

    python -m benchmarks.other_steps                # all cases; the words in the names of cases choose some
    python -m benchmarks.other_steps Rover Pusher

Beside each filtered env runs one without the filter, but with everything else around it, that makes the same steps.
The ratio is the median over steps of the CPU time with the filter over that without.
"""

import sys
import time
import warnings
from collections.abc import Callable
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np

import safe_wrappers as sw
from benchmarks import impact, mujoco_drivers, patrol_drivers, tracked
from benchmarks.arm_and_wall import ArmAndWall
from benchmarks.arms import ARMS
from benchmarks.cases import PROTECTED
from benchmarks.crossing_drivers import DRIVERS as CROSSING
from benchmarks.drivers import Driver, held
from benchmarks.env_step import Figures, Filter, compare, gentle
from benchmarks.mujoco_drivers import Maker


class Steps(NamedTuple):
    """One filter on one task."""

    make: Callable[[], gym.Env[Any, Any]]  # without the filter
    protect: Filter
    attack: Maker  # who makes the filter act
    calm: Maker = gentle  # who does not


class _Approaches(gym.Wrapper[Any, Any, Any, Any]):
    """Approaches of the arm to the wall, each from another pose, as in `benchmarks.impact`."""

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        self._left = impact.STEPS
        return self.env.reset(seed=seed, options=impact.start(np.random.default_rng(seed)))

    def step(self, action: Any) -> Any:
        self._left -= 1
        observation, reward, terminated, _, info = self.env.step(action)
        return observation, reward, terminated, self._left == 0, info


def _pressing(env: Any, rng: np.random.Generator) -> Driver:
    """At the wall, as hard as the arm can."""
    return impact.Driver("corner", env, rng).act


def _pushing_out(env: Any, rng: np.random.Generator) -> Driver:
    """Into random corners of the action space, for random times: an arm ends stretched or out of reach."""
    low, high = (bound.astype(np.float64) for bound in (env.action_space.low, env.action_space.high))
    return held(lambda: (int(rng.integers(5, 25)), np.where(rng.random(low.size) < 0.5, low, high)))


def _on_legs(robot: str, **arguments: Any) -> Steps:
    def protect(env: gym.Env[Any, Any]) -> sw.CBFActionFilter:
        return sw.WholeBodyFilter(env, **arguments)

    return Steps(lambda: gym.make(f"{robot}-v5"), protect, mujoco_drivers.random)


def _arm(name: str) -> Steps:
    arm = ARMS[name]
    return Steps(
        lambda: gym.wrappers.TimeLimit(arm.make(), 100),
        lambda env: sw.CBFActionFilter(env, [arm.margin()]),
        _pushing_out,
    )


def _impact(env: gym.Env[Any, Any]) -> sw.CBFActionFilter:
    limit = sw.constraints.ImpactSpeedLimit(
        ["fingertip"], ["wall"], force_limit=150.0, stiffness=3e4, margin=3.0, horizon=6
    )
    return sw.CBFActionFilter(env, [limit])


def _protected(name: str, attack: Maker) -> Steps:
    return Steps(PROTECTED[name].make, sw.protect, attack)


CASES: dict[str, Steps] = {
    "WholeBodyFilter, forecast, Ant-v5": _on_legs("Ant"),
    "WholeBodyFilter, pyramid, Ant-v5": _on_legs("Ant", contacts="pyramid"),
    "WholeBodyFilter, cone, Ant-v5": _on_legs("Ant", contacts="cone"),
    "WholeBodyFilter, forecast, Humanoid-v5": _on_legs("Humanoid"),
    "WholeBodyFilter, pyramid, Humanoid-v5": _on_legs("Humanoid", contacts="pyramid"),
    "SupportMargin, forecast, Ant-v5": _on_legs("Ant", zmp_inset=0.01, joint_tolerance=None),
    "EscapeClearance, PatrolledPointMaze-v0": Steps(
        lambda: tracked.patrolled(PROTECTED["PatrolledPointMaze-v0"].make()),
        sw.protect,
        patrol_drivers.patrol_seeking,
    ),
    "EscapeClearance, OccludedCrossing-v0": Steps(
        lambda: tracked.crossing(PROTECTED["OccludedCrossing-v0"].make()),
        sw.protect,
        CROSSING["goal-seeking"],
    ),
    "Traction, SafeRover-v0": _protected("SafeRover-v0", mujoco_drivers.end_seeking),
    "SingularityMargin, Reacher-v5": _arm("Reacher"),
    "SingularityMargin, Pusher-v5": _arm("Pusher"),
    "SingularityMargin, FetchReach-v4": _arm("Fetch"),
    "ImpactSpeedLimit, arm and wall": Steps(lambda: _Approaches(ArmAndWall(3e4)), _impact, _pressing),
    "Workspace, AntMaze_UMaze-v5": _protected("AntMaze_UMaze-v5", mujoco_drivers.running_into_walls),
    "Workspace, Pusher-v5": _protected("Pusher-v5", mujoco_drivers.speed_seeking),
}


def measure(case: Steps, active: bool, steps: int = 1000) -> Figures:
    """CPU time of the steps that the filter changed without its fallback, or left alone."""
    driver = case.attack if active else case.calm
    return compare(case.make, case.protect, driver, active, steps, time.process_time)


def main() -> None:
    """Print the table."""
    warnings.simplefilter("ignore")
    chosen = [name for name in CASES if not sys.argv[1:] or any(word in name for word in sys.argv[1:])]
    print(
        "| filter | | share of the steps | step (us) | with filter (us) | ratio |\n|---|---|---|---|---|---|"
    )
    for name in chosen:
        for active in (False, True):
            found = measure(CASES[name], active)
            print(
                f"| {name} | {'active' if active else 'inactive'} | {found.share:.0%} "
                f"| {found.without_us:.0f} | {found.with_us:.0f} | {found.ratio:.2f} |",
                flush=True,
            )


if __name__ == "__main__":
    main()
