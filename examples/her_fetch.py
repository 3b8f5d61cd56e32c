"""SAC with hindsight replay on a Fetch arm, through the filter. Needs gymnasium-robotics.

python examples/her_fetch.py --steps 20000
"""

import argparse

import gymnasium as gym
import gymnasium_robotics
from stable_baselines3 import SAC
from stable_baselines3.common.monitor import Monitor

import safe_wrappers as sw
from safe_wrappers.sb3 import ExecutedActionHerReplayBuffer

parser = argparse.ArgumentParser(description=__doc__)
parser.add_argument("--steps", type=int, default=20_000)
steps = parser.parse_args().steps

gym.register_envs(gymnasium_robotics)
arm = sw.protect(gym.make("FetchReach-v4"))  # fingers off the table, gripper in its box
env = Monitor(sw.RecordInterventions(arm))
model = SAC(
    "MultiInputPolicy",  # observations are dicts with goals
    env,
    buffer_size=steps,
    learning_starts=min(1000, steps // 2),  # at least an episode, here 50 steps
    replay_buffer_class=ExecutedActionHerReplayBuffer,
    replay_buffer_kwargs={"n_sampled_goal": 4},
    seed=0,
    device="cpu",
)
model.learn(steps)

episodes, reached, lowest = 5, 0, float("inf")
for seed in range(episodes):
    observation = env.reset(seed=seed)[0]
    truncated = False
    while not truncated:
        action = model.predict(observation, deterministic=True)[0]
        observation, reward, terminated, truncated, info = env.step(action)
        lowest = min(lowest, info["cbf/margin"])
    reached += info["is_success"]
print(f"{reached:.0f} of {episodes} goals reached; the smallest margin was {lowest:.3f} m")
