"""What the filter adds to a whole training: PPO with and without it, one rollout after the other in turn.

    python -m benchmarks training_time

In turn, so that whatever else the machine does hits both arms alike. The ratio is of the wall times' sums.
"""

import time
from pathlib import Path

import torch

from benchmarks.tables import markdown, options
from safe_wrappers.sb3 import InterventionCallback
from safe_wrappers.train.config import parse_experiment, read_config
from safe_wrappers.train.run.model import new_model
from safe_wrappers.train.run.stack import make_vec_env

CONFIGS = Path(__file__).parents[1] / "configs"
EXPERIMENTS = ("pointgoal1_300k", "halfcheetah_velocity_ppo")


def seconds(experiment: str, steps: int) -> dict[str, float]:
    """Wall time of training each arm of a config for so many steps."""
    arms = {arm.name: arm for arm in parse_experiment(read_config(CONFIGS / f"{experiment}.yaml")).arms}
    models = {name: new_model(arms[name], 0, make_vec_env(arms[name])) for name in ("unfiltered", "filtered")}
    spent = dict.fromkeys(models, 0.0)
    while any(model.num_timesteps < steps for model in models.values()):
        for name, model in models.items():
            begin = time.perf_counter()
            model.learn(1, callback=InterventionCallback(), reset_num_timesteps=False)
            spent[name] += time.perf_counter() - begin
    return spent


def main() -> None:
    """Print the table."""
    given = options(__doc__, steps=20_480)
    torch.set_num_threads(1)
    rows = []
    for name in EXPERIMENTS:
        spent = seconds(name, given.steps)
        rows.append(
            [name, *(f"{s:.1f}" for s in spent.values()), f"{spent['filtered'] / spent['unfiltered']:.2f}"]
        )
    print(markdown(f"PPO, {given.steps:,} steps | without (s) | with the filter (s) | ratio", rows))
