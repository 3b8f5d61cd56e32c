"""SAC that learns from the actions that were executed, not from those that it proposed.

An action is held for four control steps, and the filter may change it differently in each: the last one's is stored.

python examples/sac_executed_actions.py --steps 50000
"""

import argparse

import gymnasium as gym
from stable_baselines3 import SAC
from stable_baselines3.common.monitor import Monitor

import safe_wrappers as sw
from safe_wrappers.sb3 import ExecutedActionReplayBuffer, InterventionCallback

parser = argparse.ArgumentParser(description=__doc__)
parser.add_argument("--steps", type=int, default=50_000)
steps = parser.parse_args().steps

seeing = sw.FilterObservation(sw.protect(gym.make("SafePointGoal1-v0")))  # sees what the filter decides by
env = Monitor(
    sw.ActionRepeat(sw.RecordInterventions(seeing), repeat=4)
)  # an action every 80 ms explores farther
model = SAC(
    "MlpPolicy",
    env,
    buffer_size=steps,
    learning_starts=min(1000, steps // 2),
    replay_buffer_class=ExecutedActionReplayBuffer,  # stores what the filter executed
    seed=0,
    device="cpu",
)
model.learn(steps, callback=InterventionCallback())

assert isinstance(model.replay_buffer, ExecutedActionReplayBuffer)
print(f"{model.replay_buffer.size()} steps stored, each with the action that the filter executed")
