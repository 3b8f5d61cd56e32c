"""A cart whose commands stop coming now and then: without a lease it goes on with the last one, with it, it brakes.

python examples/lease_outages.py --steps 5000
"""

import argparse

import gymnasium as gym
import numpy as np

import safe_wrappers as sw

parser = argparse.ArgumentParser(description=__doc__)
parser.add_argument("--steps", type=int, default=5_000)
steps = parser.parse_args().steps

wall = 0.9  # m, to both sides
rail = [sw.constraints.Plane([-wall], [1]), sw.constraints.Plane([wall], [-1])]

for leased in (False, True):
    cart = gym.make("InvertedPendulum-v5")
    data, env = cart.get_wrapper_attr("data"), cart
    if leased:
        clearance = sw.constraints.Clearance(rail, bodies=["cart"], braking=8.0)
        env = sw.LeaseExpiry(cart, sw.StoppingBudget(clearance, acceleration=30.0))
    env = sw.faults.Outages(env, mean_between_s=2.0, mean_length_s=0.5)
    env.reset(seed=0)
    silent = braked = contacts = 0
    for step in range(steps):
        x, v = data.qpos[0], data.qvel[0]
        goal = 0.6 * (-1) ** (step // 25)  # to and fro; while its commands arrive, never near a wall
        _, _, _, _, info = env.step(np.array([8.0 * (goal - x) - 3.0 * v], np.float32).clip(-3, 3))
        silent += info["fault/active"]
        braked += info.get("lease/braking", False)
        contacts += abs(data.qpos[0]) > wall
    name = "lease" if leased else "no lease"
    print(f"{name}: {silent} silent steps, {braked} braked, {contacts} behind a wall")
