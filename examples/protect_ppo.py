"""PPO on SafePointGoal1 through the filter: what was changed, how often, and what it cost.

python examples/protect_ppo.py --steps 100000
"""

import argparse

import gymnasium as gym
from stable_baselines3 import PPO
from stable_baselines3.common.monitor import Monitor

import safe_wrappers as sw
from safe_wrappers.sb3 import InterventionCallback

parser = argparse.ArgumentParser(description=__doc__)
parser.add_argument("--steps", type=int, default=100_000)
steps = parser.parse_args().steps

env = sw.protect(gym.make("SafePointGoal1-v0"))  # every action is checked
recorder = sw.RecordInterventions(env)  # and what that cost is counted
model = PPO("MlpPolicy", Monitor(recorder), n_steps=min(2048, steps), seed=0, device="cpu")
model.learn(steps, callback=InterventionCallback())  # figures in SB3's log, under interventions/

observation = recorder.reset(seed=1)[0]
done = False
while not done:
    action = model.predict(observation, deterministic=True)[0]
    observation, reward, terminated, truncated, info = recorder.step(action)
    done = terminated or truncated
episode = info["interventions"]
print(f"return {episode['return']:.1f}, steps in violation {episode['violations']}")
print(f"{episode['intervention_rate']:.0%} of the actions changed")
