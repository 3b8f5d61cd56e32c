"""A policy of whole chunks, which come late, drives an arm with elastic joints over seams that keep a rate limit.

python examples/chunk_policy.py --steps 20000
"""

import argparse

import gymnasium as gym
from stable_baselines3 import PPO
from stable_baselines3.common.monitor import Monitor

import safe_wrappers as sw

parser = argparse.ArgumentParser(description=__doc__)
parser.add_argument("--steps", type=int, default=20_000)
steps = parser.parse_args().steps  # of the policy: a chunk each

arm = sw.protect(gym.make("FlexJointReach-v0"))  # joint speeds
env = sw.ChunkHandover(
    arm,
    chunk_size=32,  # commands of 10 ms
    execution_horizon=16,  # every 160 ms the next chunk takes over
    inference_delay=[0, 4],  # control steps after its observation, drawn anew for each chunk
    rate_limit=25.0,  # of the commands, in action units per second
)
model = PPO("MlpPolicy", Monitor(env), n_steps=min(512, steps), seed=0, device="cpu")
model.learn(steps)

observation = env.reset(seed=1)[0]
done, peak, held_back = False, 0.0, 0
while not done:
    chunk = model.predict(observation, deterministic=True)[0]
    observation, reward, terminated, truncated, info = env.step(chunk)
    peak = max(peak, info["handover/peak_jerk"])
    held_back += info["handover/limited"]
    done = terminated or truncated
print(f"fastest change of a command: {peak:.1f} per second, limit 25.0; {held_back} commands held back")
