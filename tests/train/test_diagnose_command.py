"""safe-wrappers diagnose: what it writes, whose policies it takes, and what it refuses."""

import json
import re
import shutil
import subprocess

import gymnasium as gym
import numpy as np
import pytest
from stable_baselines3 import A2C, DDPG, PPO, SAC, TD3

from safe_wrappers.errors import ConfigurationError
from safe_wrappers.train.cli import main
from safe_wrappers.train.diagnosis.trained import of_file, of_run
from safe_wrappers.train.files import read_rows

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


def test_the_command_prints_and_writes_page_and_json(tmp_path, capsys):
    page = tmp_path / "deep" / "rover.html"
    assert main(["diagnose", "SafeRover-v0", "--steps", "60", "--output", str(page)]) == 0
    out = capsys.readouterr().out
    assert "FOUND     wheel_slip" in out and "sw.SlipLimiter(env" in out and f"Page: {page}" in out
    there = json.loads(page.with_suffix(".json").read_text())
    assert there["findings"][0]["symptom"] == "wheel_slip" and there["steps"] == 60
    html = page.read_text()
    assert "sw.SlipLimiter(env" in html and "<svg" in html and "safe-wrappers diagnose SafeRover-v0" in html
    assert "Not found, or not measured" in html and "http" not in html
    (table,) = (page.parent / "rover_data").iterdir()  # a plot per symptom that was found
    assert f'href="rover_data/{table.name}"' in html and table.name == "symptom-wheel_slip.csv"
    rows = read_rows(table)
    assert [row["step"] for row in rows] == list(range(60))
    slipping = np.mean([row["value"] > 0.2 for row in rows])
    assert slipping == pytest.approx(there["findings"][0]["figure"]) and slipping > 0.0


@pytest.mark.skipif(shutil.which("chromium") is None, reason="no browser")
@pytest.mark.parametrize("width", [1200, 600])
def test_nothing_of_the_page_is_beyond_the_window(tmp_path, width):
    page = tmp_path / "rover.html"
    assert main(["diagnose", "SafeRover-v0", "--steps", "40", "--output", str(page)]) == 0
    page.write_text(
        page.read_text() + "<script>document.title = document.documentElement.scrollWidth</script>"
    )
    command = ["chromium", "--headless", "--no-sandbox", "--disable-gpu", f"--window-size={width},900"]
    shown = subprocess.run([*command, "--dump-dom", str(page)], capture_output=True, text=True, timeout=60)
    assert int(re.search(r"<title>(\d+)</title>", shown.stdout)[1]) <= width


def test_the_policy_of_a_run_acts_as_it_was_trained(run, tmp_path):
    env, policy = of_run(run, "SafePointGoal1-v0")
    observation, _ = env.reset(seed=0)
    first = policy(observation)
    assert np.array_equal(policy(observation + 1.0), first)  # repeated: it was trained with action_repeat 2
    page = tmp_path / "goal.html"
    words = ["diagnose", "SafePointGoal1-v0", "--policy", str(run), "--steps", "40", "--output", str(page)]
    assert main(words) == 0
    assert json.loads(page.with_suffix(".json").read_text())["drivers"] == ["random", "attacking", "policy"]


@pytest.mark.parametrize("algorithm", [PPO, A2C, SAC, TD3, DDPG])
def test_a_model_file_is_loaded_as_what_it_is(algorithm, tmp_path):
    made = algorithm("MlpPolicy", gym.make("Swimmer-v5"), device="cpu", seed=0)
    made.save(tmp_path / "model.zip")
    loaded = of_file(tmp_path / "model.zip")
    # DDPG is TD3 with other settings: its file does not tell, and it acts the same.
    assert type(loaded) is (TD3 if algorithm is DDPG else algorithm)
    observation = np.linspace(-1.0, 1.0, 8)
    assert np.array_equal(
        loaded.predict(observation, deterministic=True)[0], made.predict(observation, deterministic=True)[0]
    )


@pytest.mark.parametrize(
    ("name", "policy"),
    [("RecurrentPPO", "MlpLstmPolicy"), ("MaskablePPO", "MlpPolicy"), ("TRPO", "MlpPolicy")],
)
def test_a_model_file_of_sb3_contrib_is_loaded_as_what_it_is(name, policy, tmp_path):
    algorithm = getattr(pytest.importorskip("sb3_contrib"), name)
    algorithm(policy, gym.make("CartPole-v1"), device="cpu", n_steps=8, batch_size=8).save(
        tmp_path / "model.zip"
    )
    assert type(of_file(tmp_path / "model.zip")) is algorithm


def test_what_is_no_policy_is_refused(run, tmp_path, capsys):
    with pytest.raises(ConfigurationError, match=r"is no run's folder \(it has no run\.json\)"):
        of_run(tmp_path, "SafePointGoal1-v0")
    with pytest.raises(ConfigurationError, match="was trained on SafePointGoal1-v0, not on Swimmer-v5"):
        of_run(run, "Swimmer-v5")
    (tmp_path / "model.zip").write_text("no")
    for path in (tmp_path / "model.zip", tmp_path / "gone.zip"):
        with pytest.raises(ConfigurationError, match="is no model that Stable-Baselines3 has saved"):
            of_file(path)
    assert main(["diagnose", "Swimer-v5"]) == 1
    assert "Swimmer" in capsys.readouterr().err


@pytest.mark.parametrize("words", [
    ["train", "a.yaml", "--policy", "runs/a"], ["compare", "a.yaml", "--steps", "2000"],
    ["diagnose", "Swimmer-v5", "Reacher-v5"], ["diagnose", "Swimmer-v5", "--report"],
])  # fmt: skip
def test_options_of_other_commands_are_refused(words, capsys):
    with pytest.raises(SystemExit) as stop:
        main(words)
    assert stop.value.code == 2 and "diagnose" in capsys.readouterr().err
