"""What the filter adds to a whole training: PPO with and without it, in turn, slice by slice.

    python -m benchmarks training_time

Both arms of a config (same seed, same hyperparameters, the stack of the training scripts) collect and learn from
one rollout after the other in turn, so that whatever else the machine does hits both alike. Reported: the sum of
the filtered arm's wall time over the other's, and the median of the slices' ratios.
"""

import statistics
import time
from pathlib import Path
from typing import Any

import torch
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv, VecNormalize

from benchmarks.tables import markdown, options
from safe_wrappers.sb3 import InterventionCallback
from safe_wrappers.train.config import ArmConfig, parse_experiment, read_config
from safe_wrappers.train.config.algorithms import algorithm_class
from safe_wrappers.train.run.stack import make_stack

CONFIGS = Path(__file__).parents[1] / "configs"
EXPERIMENTS = ("pointgoal1_300k", "halfcheetah_velocity_ppo")


class Training:
    """One arm in training.

    Attributes:
        slice: Steps of one rollout over all envs.
        seconds: Wall time of each slice so far.
    """

    def __init__(self, arm: ArmConfig, seed: int) -> None:
        envs: VecEnv = DummyVecEnv([lambda: make_stack(arm.env, arm.filter, arm.learner)] * arm.n_envs)
        if arm.normalize.observation or arm.normalize.reward:
            norm: dict[str, Any] = {
                "norm_obs": arm.normalize.observation,
                "norm_reward": arm.normalize.reward,
                "gamma": arm.hyperparameters["gamma"],
            }
            envs = VecNormalize(envs, **norm)
        self._model: Any = algorithm_class(arm.algorithm)("MlpPolicy", envs, seed=seed, **arm.hyperparameters)
        self.slice = int(arm.hyperparameters["n_steps"]) * arm.n_envs
        self.seconds: list[float] = []

    def go_on(self) -> None:
        """Collect one rollout and learn from it."""
        begin = time.perf_counter()
        self._model.learn(self.slice, callback=InterventionCallback(), reset_num_timesteps=not self.seconds)
        self.seconds.append(time.perf_counter() - begin)


def compare(experiment: str, steps: int) -> list[str]:
    """Train both arms of a config for so many steps each: the cells of a row."""
    arms = {arm.name: arm for arm in parse_experiment(read_config(CONFIGS / f"{experiment}.yaml")).arms}
    without, filtered = (Training(arms[name], seed=0) for name in ("unfiltered", "filtered"))
    for _ in range(-(-steps // without.slice)):
        without.go_on()
        filtered.go_on()
    ratios = [b / a for a, b in zip(without.seconds, filtered.seconds, strict=True)]
    seconds = sum(without.seconds), sum(filtered.seconds)
    cells = [f"{without.slice * len(ratios):,}", *(f"{s:.1f}" for s in seconds)]
    return [*cells, f"{seconds[1] / seconds[0]:.2f}", f"{statistics.median(ratios):.2f}"]


def main() -> None:
    """Print the table."""
    given = options(__doc__, steps=20_000)
    torch.set_num_threads(1)
    head = "PPO on | steps per arm | without (s) | with filter (s) | ratio | median of slices"
    print(markdown(head, [[name, *compare(name, given.steps)] for name in EXPERIMENTS]))
