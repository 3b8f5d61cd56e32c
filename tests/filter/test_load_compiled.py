"""Compiling: where a filter is made and at its first reset, so that no step waits for it; and not in silence."""

import os
import subprocess
import sys

import pytest

from safe_wrappers.control.compiled import IS_COMPILED

pytestmark = pytest.mark.skipif(not IS_COMPILED, reason="nothing is compiled in this process")

EPISODE = """
import sys
import gymnasium as gym
import gymnasium_robotics
import safe_wrappers as sw

def ready():
    modules = [vars(module) for name, module in list(sys.modules.items()) if name.startswith("safe_wrappers.")]
    compiled = [thing for module in modules for thing in module.values() if hasattr(thing, "py_func")]
    return {(one.py_func.__qualname__, str(signature)) for one in compiled for signature in one.signatures}

env = sw.protect(gym.make(sys.argv[1]))
env.reset(seed=0)
before, changed = ready(), 0
for k in range(300):
    swing = env.action_space.low if sys.argv[1] == "Swimmer-v5" and k % 20 < 10 else env.action_space.high
    changed += env.step(swing)[-1]["cbf/intervened"]
print(changed > 0, sorted(ready() - before))
"""


def run(script, *arguments, **environment):
    command = [sys.executable, "-c", script, *arguments]
    done = subprocess.run(
        command, capture_output=True, text=True, check=True, env={**os.environ, **environment}
    )
    return done.stdout.strip(), done.stderr.strip()


COMPILED = ("SafePointGoal1-v0", "PointMaze_UMaze-v3", "OccludedCrossing-v0")


@pytest.mark.parametrize("env_id", ["Swimmer-v5", "Reacher-v5", *COMPILED])
def test_no_step_compiles(env_id):
    assert run(EPISODE, env_id)[0] == "True []"


def test_no_later_step_of_a_vector_env_compiles():
    script = EPISODE.replace(
        "gym.make(sys.argv[1])", "gym.make_vec(sys.argv[1], 2, vectorization_mode='sync')"
    )
    script = script.replace("env.reset(seed=0)", "env.reset(seed=0), env.step(0.0 * env.action_space.high)")
    script = script.replace('["cbf/intervened"]', '["cbf/intervened"].sum()')
    assert run(script, "SafePointGoal1-v0")[0] == "True []"
