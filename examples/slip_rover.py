"""A rover over a patch of ice under full throttle, without and with the slip limiter.

python examples/slip_rover.py --steps 150
"""

import argparse

import gymnasium as gym
import numpy as np

import safe_wrappers as sw

parser = argparse.ArgumentParser(description=__doc__)
parser.add_argument("--steps", type=int, default=150)
steps = parser.parse_args().steps

ground = {"patches": [{"ground": "ice", "center": [2, 0], "radius": 1}], "agent": [0, 0, 0]}
full_throttle = np.array([1, 1, 1, 1, 0], np.float32)  # four drives and the steering

for limited in (False, True):
    rover = gym.make("SafeRover-v0")
    # `sw.protect(rover)` would keep it out of the hazards, too.
    env = sw.SlipLimiter(rover, wheels=rover.get_wrapper_attr("wheels")) if limited else rover
    env.reset(seed=0, options={"layout": ground})
    worst = 0.0
    for _ in range(steps):
        info = env.step(full_throttle)[4]
        worst = max(worst, info["slip_max"])
    way = rover.get_wrapper_attr("data").qpos[0]
    print(f"{'limited' if limited else 'as it is'}: {way:.2f} m, largest slip {worst:.2f}")
    if limited:
        print("friction that the limiter believes in:", info["slip/mu_estimate"].round(2))
