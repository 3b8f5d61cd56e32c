"""A robot that crosses a road whose cars it does not always see: it keeps clear of where they may be.

python examples/occlusion.py --steps 500
"""

import argparse

import gymnasium as gym
import numpy as np

import safe_wrappers as sw

parser = argparse.ArgumentParser(description=__doc__)
parser.add_argument("--steps", type=int, default=500)
steps = parser.parse_args().steps

cars = sw.occlusion.Track(
    "car*",
    acceleration_noise=[0.0225, 0],  # m^2/s^3, along and across the lane
    start_velocity_std=[1, 0],  # m/s
)
task = gym.make("OccludedCrossing-v0")
watched = sw.OcclusionPenalty(task, [cars], sensor="eye", tolerance=0.5, weight=0.05)
env = sw.protect(watched)  # keeps clear of where the cars may be

env.reset(seed=0)
seen, penalty, changed = [], 0.0, 0
for step in range(steps):
    action = np.array([0.0, 1.0, np.sin(step / 25)], np.float32)  # ahead, looking left and right
    _, _, terminated, truncated, info = env.step(action)
    seen.append(np.mean(info["occlusion/visible"]))
    penalty += info["occlusion/penalty"]
    changed += info["cbf/intervened"]
    if terminated or truncated:
        env.reset(seed=step)
print(
    f"cars in sight {np.mean(seen):.0%} of the time, penalty {penalty:.2f}, {changed} of {steps} actions changed"
)
