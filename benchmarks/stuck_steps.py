"""How often deterministic policies get stuck in the filter, and what StuckEscape makes of it.

    safe-wrappers compare configs/pointgoal1_sac.yaml
    python -m benchmarks.stuck_steps

Drives the trained policies of that experiment with the filter on, over the same episodes with `StuckEscape` reporting
alone and acting.
"""

import argparse
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from safe_wrappers.train.config import ArmConfig, FilterConfig, parse_experiment
from safe_wrappers.train.config.file import read_config
from safe_wrappers.train.run.policy import TrainedPolicy
from safe_wrappers.train.run.stack import make_stack
from safe_wrappers.train.run.training import finished_checkpoint

ROOT = Path(__file__).parents[1]
RESULTS = Path(__file__).parent / "results" / "stuck_steps.json"
CONFIG = ROOT / "configs" / "pointgoal1_sac.yaml"
ESCAPE = {"progress": 0.1}
"""Two seconds with less than 0.1 m gained: standing, or going around in circles."""
FIRST_SEED = 2_000_000


def drive(arm: ArmConfig, used: FilterConfig, policy: TrainedPolicy, episodes: int) -> dict[str, float]:
    """Return per episode, steps, and those that were stuck, escaping and in violation."""
    env = make_stack(arm.env, used)
    found: dict[str, Any] = dict.fromkeys(("steps", "stuck", "escaping", "violations"), 0)
    returns = []
    for episode in range(episodes):
        observation, _ = env.reset(seed=FIRST_SEED + episode)
        policy.begin()
        over, total = False, 0.0
        while not over:
            observation, reward, terminated, truncated, info = env.step(policy(observation))
            over, total = terminated or truncated, total + float(reward)
            found["steps"] += 1
            found["stuck"] += info["cbf/stuck"]
            found["escaping"] += info["cbf/escaping"]
            found["violations"] += info["cost_substep"] > 0
        returns.append(total)
    env.close()
    return found | {"return": float(np.mean(returns)), "lowest": float(np.min(returns))}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--episodes", type=int, default=50, help="per policy and condition")
    parser.add_argument("--output", default="runs", help="where the experiment lies")
    arguments = parser.parse_args()
    experiment = parse_experiment(read_config(CONFIG, [f"output={arguments.output}"]))
    rows = []
    for arm in experiment.arms:
        for seed in experiment.seeds:
            folder = experiment.run_folder(arm, seed)
            if not (folder / "finished.json").exists():
                continue
            policy = TrainedPolicy(arm, finished_checkpoint(arm, seed, folder))
            for escape_s in (0.0, 1.0):
                used = replace(experiment.evaluation_filter, escape={**ESCAPE, "escape_s": escape_s})
                row = {"arm": arm.name, "seed": seed, "escape_s": escape_s}
                rows.append(row | drive(arm, used, policy, arguments.episodes))
                print(rows[-1], flush=True)
    RESULTS.write_text(json.dumps(rows, indent=1) + "\n")
    print("| trained | escape | return | lowest | stuck steps | escaping | violations |")
    print("|---|---|---|---|---|---|---|")
    for name in ("unfiltered", "filtered"):
        for escape_s in (0.0, 1.0):
            same = [row for row in rows if (row["arm"], row["escape_s"]) == (name, escape_s)]
            steps = sum(row["steps"] for row in same)
            mean, lowest = np.mean([row["return"] for row in same]), min(row["lowest"] for row in same)
            stuck, escaping = (100 * sum(row[key] for row in same) / steps for key in ("stuck", "escaping"))
            violations = sum(row["violations"] for row in same)
            print(
                f"| {name} | {'on' if escape_s else 'off'} | {mean:.1f} | {lowest:.1f} | {stuck:.2f} % |"
                f" {escaping:.2f} % | {violations} of {steps:,} |"
            )


if __name__ == "__main__":
    main()
