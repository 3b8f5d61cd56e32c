"""Compiling: where a filter is made and at its first reset, so that no step waits for it."""

import os
import subprocess
import sys

import pytest

from safe_wrappers.control.compiled import IS_COMPILED

pytestmark = [
    pytest.mark.skipif(not IS_COMPILED, reason="nothing is compiled in this process"),
    pytest.mark.skipif(not hasattr(os, "fork"), reason="no child processes here"),
]

EPISODES = """
import os, sys
import gymnasium as gym
import gymnasium_robotics
import safe_wrappers as sw

def ready():
    modules = [vars(module) for name, module in list(sys.modules.items()) if name.startswith("safe_wrappers.")]
    compiled = [thing for module in modules for thing in module.values() if hasattr(thing, "py_func")]
    return {(one.py_func.__qualname__, str(signature)) for one in compiled for signature in one.signatures}

for name in sys.argv[1:]:
    if os.fork():
        os.wait()
        continue
    name, together = name.removesuffix(" together"), name.endswith(" together")
    env = sw.protect(gym.make_vec(name, 2, vectorization_mode="sync") if together else gym.make(name))
    env.reset(seed=0)
    if together:
        env.step(0.0 * env.action_space.high)
    before, changed = ready(), 0
    for k in range(300):
        swing = env.action_space.low if name == "Swimmer-v5" and k % 20 < 10 else env.action_space.high
        changed = changed + env.step(swing)[-1]["cbf/intervened"]
    print(name, bool(changed.sum() if together else changed), sorted(ready() - before), flush=True)
    os._exit(0)
"""
ENVS = ["Swimmer-v5", "Reacher-v5", "SafePointGoal1-v0", "PointMaze_UMaze-v3", "OccludedCrossing-v0"]


def test_no_step_compiles():
    command = [sys.executable, "-c", EPISODES, *ENVS, "SafePointGoal1-v0 together"]
    said = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True).stdout.splitlines()
    assert said == [f"{name} True []" for name in [*ENVS, "SafePointGoal1-v0"]]
