"""SAC that learns from the actions that were executed, not from those that it proposed.

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
charged = sw.AdaptionPenalty(sw.RecordInterventions(seeing), penalty=0.05)  # for what was changed
env = Monitor(sw.ActionRepeat(charged, repeat=4))  # an action every 80 ms explores farther
model = SAC(
    "MlpPolicy",
    env,
    buffer_size=steps,
    learning_starts=min(1000, steps // 2),
    replay_buffer_class=ExecutedActionReplayBuffer,
    replay_buffer_kwargs={"mode": "both"},  # "safe_action": the executed action alone, without a penalty
    seed=0,
    device="cpu",
)
model.learn(steps, callback=InterventionCallback())

buffer = model.replay_buffer
assert isinstance(buffer, ExecutedActionReplayBuffer)
print(
    f"{buffer.size()} steps; the filter changed {buffer.changed[: buffer.size()].mean():.0%} of the actions"
)
