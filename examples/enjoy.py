"""Loads a trained policy from its run's folder and lets it act on the env that it was trained in, filter and all.

safe-wrappers train configs/demo.yaml
python examples/enjoy.py runs/demo/filtered/seed_0 --episodes 3
"""

import argparse
from pathlib import Path

from safe_wrappers.train.policies import load_policy

parser = argparse.ArgumentParser(description=__doc__)
parser.add_argument("run", type=Path)
parser.add_argument("--episodes", type=int, default=3)
options = parser.parse_args()

trained = load_policy(options.run)
env = trained.make_env()  # make_env("none"): without the filter
for seed in range(options.episodes):
    observation = env.reset(seed=seed)[0]
    trained.reset()
    done = False
    while not done:
        observation, reward, terminated, truncated, info = env.step(trained(observation))
        done = terminated or truncated
    episode = info["interventions"]
    changed = f", {episode['intervention_rate']:.0%} changed" if "intervention_rate" in episode else ""
    print(f"seed {seed}: return {episode['return']:.1f}{changed}")
