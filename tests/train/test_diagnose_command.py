"""safe-wrappers diagnose: what it writes, whose policies it takes, and what it refuses."""

import json

import numpy as np
import pytest

from safe_wrappers.errors import ConfigurationError
from safe_wrappers.train.acting import of_run
from safe_wrappers.train.cli import main

pytestmark = pytest.mark.filterwarnings("ignore")
TINY = """
name: tiny
total_steps: 64
seeds: [0]
workers: 1
env: SafePointGoal1-v0
algorithm: PPO
action_repeat: 2
hyperparameters: {n_steps: 32, batch_size: 32, n_epochs: 1}
normalize: {observation: true}
arms:
  plain: {filter: none}
"""


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """The folder of a trained run."""
    folder = tmp_path_factory.mktemp("runs")
    (folder / "tiny.yaml").write_text(TINY)
    assert main(["train", str(folder / "tiny.yaml"), f"output={folder}"]) == 0
    return folder / "tiny" / "plain" / "seed_0"


def test_the_command_prints_and_writes_json(tmp_path, capsys):
    path = tmp_path / "deep" / "rover.json"
    assert main(["diagnose", "SafeRover-v0", "--steps", "60", "--output", str(path)]) == 0
    out = capsys.readouterr().out
    assert "FOUND     wheel_slip" in out and "sw.SlipLimiter(env" in out and f"JSON: {path}" in out
    there = json.loads(path.read_text())
    assert there["findings"][0]["symptom"] == "wheel_slip" and there["steps"] == 60


def test_the_policy_of_a_run_acts_as_it_was_trained(run, tmp_path):
    env, policy = of_run(run, "SafePointGoal1-v0")
    observation, _ = env.reset(seed=0)
    first = policy(observation)
    assert np.array_equal(policy(observation + 1.0), first)  # repeated: it was trained with action_repeat 2
    path = tmp_path / "goal.json"
    words = ["diagnose", "SafePointGoal1-v0", "--policy", str(run), "--steps", "40", "--output", str(path)]
    assert main(words) == 0
    assert json.loads(path.read_text())["drivers"] == ["random", "attacking", "policy"]


def test_what_is_no_policy_is_refused(run, tmp_path, capsys):
    with pytest.raises(ConfigurationError, match=r"is no run's folder \(it has no run\.json\)"):
        of_run(tmp_path, "SafePointGoal1-v0")
    with pytest.raises(ConfigurationError, match="was trained on SafePointGoal1-v0, not on Swimmer-v5"):
        of_run(run, "Swimmer-v5")
    assert main(["diagnose", "Swimer-v5"]) == 1
    assert "Swimmer" in capsys.readouterr().err
