"""How often deterministic policies get stuck in the filter, and what StuckEscape makes of it.

    python -m benchmarks.table --only SafePointGoal1_sac
    python -m benchmarks.stuck_steps

Drives the trained policies of that experiment with the filter on, over the same episodes with `StuckEscape` reporting
alone, drawing actions at random, and choosing among them by the policy's own critic; and with the policy's own noise,
always and only while it is stuck.
"""

import argparse
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from benchmarks.table import TASKS, experiment_of
from safe_wrappers.plants.env_checks import wrappers_of
from safe_wrappers.sb3 import critic_value
from safe_wrappers.train.config import ArmConfig, FilterConfig
from safe_wrappers.train.run.policy import TrainedPolicy
from safe_wrappers.train.run.stack import make_stack
from safe_wrappers.train.run.training import finished_checkpoint
from safe_wrappers.wrappers.replaced_actions import StuckEscape

RESULTS = Path(__file__).parent / "results"
ESCAPE = {"progress": 0.1}
"""Two seconds with less than 0.1 m gained: standing, or going around in circles."""
FIRST_SEED = 2_000_000
TRAINED = ("unfiltered", "filtered")
NOISE, NOISE_IF_STUCK = "stochastic policy", "stochastic while stuck"
MODES = {"reported": 0.0, "random": 1.0, "critic": 2.0, NOISE_IF_STUCK: 0.0, NOISE: 0.0}
"""How long an escape lasts, s."""


def drive(
    arm: ArmConfig, used: FilterConfig, policy: TrainedPolicy, mode: str, episodes: int
) -> dict[str, float]:
    """Return per episode, steps, and those that were stuck, escaping and in violation."""
    policy.deterministic = mode != NOISE
    torch.manual_seed(0)
    env = make_stack(arm.env, used)
    if mode == "critic":
        escape = next(wrapper for wrapper in wrappers_of(env) if isinstance(wrapper, StuckEscape))
        escape.value = critic_value(policy.model)
    found: dict[str, Any] = dict.fromkeys(("steps", "stuck", "escaping", "violations"), 0)
    returns = []
    for episode in range(episodes):
        observation, _ = env.reset(seed=FIRST_SEED + episode)
        policy.begin()
        over, total = False, 0.0
        if mode == NOISE_IF_STUCK:
            policy.deterministic = True
        while not over:
            observation, reward, terminated, truncated, info = env.step(policy(observation))
            over, total = terminated or truncated, total + float(reward)
            found["steps"] += 1
            found["stuck"] += info["cbf/stuck"]
            if mode == NOISE_IF_STUCK:
                policy.deterministic = not info["cbf/stuck"]
            found["escaping"] += info["cbf/escaping"]
            found["violations"] += info["cost_substep"] > 0
        returns.append(total)
    env.close()
    return found | {"return": float(np.mean(returns)), "lowest": float(np.min(returns))}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--episodes", type=int, default=50, help="per policy and condition")
    parser.add_argument(
        "--task", default=TASKS[0].name, choices=[t.name for t in TASKS if t.config == "goal_sac"]
    )
    parser.add_argument("--output", default="runs", help="where the experiment lies")
    arguments = parser.parse_args()
    task = next(task for task in TASKS if task.name == arguments.task)
    experiment = experiment_of(task, arguments.output)
    rows = []
    arms = [arm for arm in experiment.arms if arm.name in TRAINED]
    for arm in arms:
        for seed in experiment.seeds:
            folder = experiment.run_folder(arm, seed)
            if not (folder / "finished.json").exists():
                continue
            policy = TrainedPolicy(arm, finished_checkpoint(arm, seed, folder))
            for mode, escape_s in MODES.items():
                used = replace(experiment.evaluation_filter, escape={**ESCAPE, "escape_s": escape_s})
                row = {"arm": arm.name, "seed": seed, "mode": mode}
                rows.append(row | drive(arm, used, policy, mode, arguments.episodes))
                print(rows[-1], flush=True)
    (RESULTS / f"stuck_steps_{task.name}.json").write_text(json.dumps(rows, indent=1) + "\n")
    print("| trained | escape | return | lowest | stuck steps | escaping | violations |")
    print("|---|---|---|---|---|---|---|")
    for name in TRAINED:
        for mode in MODES:
            same = [row for row in rows if (row["arm"], row["mode"]) == (name, mode)]
            if not same:
                continue
            steps = sum(row["steps"] for row in same)
            mean, lowest = np.mean([row["return"] for row in same]), min(row["lowest"] for row in same)
            stuck, escaping = (100 * sum(row[key] for row in same) / steps for key in ("stuck", "escaping"))
            violations = sum(row["violations"] for row in same)
            print(
                f"| {name} | {mode} | {mean:.1f} | {lowest:.1f} | {stuck:.2f} % | {escaping:.2f} % |"
                f" {violations} of {steps:,} |"
            )


if __name__ == "__main__":
    main()
