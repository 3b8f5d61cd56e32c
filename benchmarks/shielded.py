"""Discrete actions: PPO without a shield, PPO whose actions are shielded, and MaskablePPO that sees the masks.

    python -m benchmarks.shielded
    python -m benchmarks.shielded --only FrozenLake8x8-v1 --steps 20000 --seeds 0 1 2

A gridworld (FrozenLake 8x8, not slippery: holes) and LunarLander-v3 (crashes, tilt, leaving the field; needs
gymnasium's extra "box2d"). Rows go to `benchmarks/results/shielded.csv`, the table to `shielded.md`. LunarLander
simulates in child processes: half an hour per seed.
"""

import argparse
import csv
import importlib
import time
import warnings
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import torch
from sb3_contrib import MaskablePPO
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback

import safe_wrappers as sw
from benchmarks.tables import markdown, total
from safe_wrappers.constraints import PredictiveShield
from safe_wrappers.train.files import write_rows

RESULTS = Path(__file__).parent / "results" / "shielded.csv"
WAYS = ("no shield", "shielded", "masked")
COLUMNS = (
    "env", "way", "seed", "steps", "training_violations", "training_changed", "episodes", "return", "violations",
    "changed", "infeasible", "minutes",
)  # fmt: skip
EPISODES = 20


def on_ice(env: Any) -> float:
    """Negative in a hole."""
    row, column = divmod(int(env.s), env.ncol)
    return -1.0 if env.desc[row, column] == b"H" else 1.0


def in_flight(env: Any) -> float:
    """Negative after a crash, tilted by more than 0.6 rad, or beside the field."""
    place = env.lander.position.x / (0.5 * 600.0 / 30.0) - 1.0
    return -1.0 if env.game_over else min(0.6 - abs(env.lander.angle), 1.0 - abs(place))


TASKS: dict[str, tuple[Any, int, str]] = {
    "FrozenLake8x8-v1": (on_ice, 10_000, "gymnasium"),
    "LunarLander-v3": (in_flight, 20_000, "Box2D"),
}
"""Env id -> judge of the env, steps, and the module that it needs."""


class Judged(gym.Wrapper[Any, Any, Any, Any]):
    """Counts the steps of the env after which the judge is negative, and those that were changed or infeasible."""

    def __init__(self, env: gym.Env[Any, Any], judge: Any) -> None:
        super().__init__(env)
        self.judge = judge
        self.start()

    def start(self) -> None:
        self.steps = self.violations = self.changed = self.infeasible = 0

    def step(self, action: Any) -> Any:
        answer = self.env.step(action)
        self.steps += 1
        self.violations += self.judge(self.unwrapped) < 0.0
        self.changed += bool(answer[4].get("cbf/intervened"))
        self.infeasible += bool(answer[4].get("cbf/infeasible"))
        return answer

    def action_masks(self) -> Any:
        return self.env.get_wrapper_attr("action_masks")()


def made(env_id: str, way: str) -> Judged:
    """The env, shielded or not."""
    judge = TASKS[env_id][0]
    if env_id.startswith("FrozenLake"):
        env: Any = gym.make("FrozenLake-v1", map_name="8x8", is_slippery=False)
        shield = PredictiveShield(on_ice, horizon=2, backup=[0, 1, 2, 3], sees="env")
        return Judged(env if way == "no shield" else sw.ActionShield(env, [shield]), judge)
    env = gym.make(env_id)
    return Judged(env if way == "no shield" else sw.protect(env), judge)


class Progress(BaseCallback):
    """Says now and then how far a training is."""

    def _on_step(self) -> bool:
        if self.num_timesteps % 2_000 == 0:
            print(f"  {self.num_timesteps} steps", flush=True)
        return True


def row(env_id: str, way: str, seed: int, steps: int) -> dict[str, Any]:
    """Train and evaluate once."""
    started = time.perf_counter()
    env = made(env_id, way)
    algorithm: Any = MaskablePPO if way == "masked" else PPO
    model = algorithm(
        "MlpPolicy", env, n_steps=512, batch_size=64, gamma=0.99, ent_coef=0.01, seed=seed, device="cpu"
    )
    model.learn(steps, callback=Progress())
    training = env.violations, env.changed / env.steps
    env.start()
    returns = []
    for episode in range(EPISODES):
        observation, _ = env.reset(seed=1000 + episode)
        total, done = 0.0, False
        while not done:
            masks = {"action_masks": env.action_masks()} if way == "masked" else {}
            action, _ = model.predict(observation, deterministic=True, **masks)
            observation, reward, terminated, truncated, _ = env.step(int(action))
            total, done = total + float(reward), terminated or truncated
        returns.append(total)
    return {
        "env": env_id,
        "way": way,
        "seed": seed,
        "steps": steps,
        "training_violations": training[0],
        "training_changed": round(training[1], 4),
        "episodes": EPISODES,
        "return": round(float(np.mean(returns)), 3),
        "violations": env.violations,
        "changed": round(env.changed / env.steps, 4),
        "infeasible": round(env.infeasible / env.steps, 5),
        "minutes": round((time.perf_counter() - started) / 60.0, 1),
    }


def table_of(rows: list[dict[str, Any]]) -> str:
    """The table that the docs show: means over seeds, sums of violations."""
    lines = []
    for env_id, way in dict.fromkeys((one["env"], one["way"]) for one in rows):
        same = [one for one in rows if (one["env"], one["way"]) == (env_id, way)]

        def mean(key: str, same: list[dict[str, Any]] = same) -> float:
            return float(np.mean([float(one[key]) for one in same]))

        cells = [env_id, way, f"{int(same[0]['steps']):,} x {len(same)}"]
        cells += [f"{total(same, 'training_violations'):,}", f"{100 * mean('training_changed'):.2g} %"]
        cells += [f"{mean('return'):.3g}", f"{total(same, 'violations'):,}"]
        cells += [f"{100 * mean(key):.2g} %" for key in ("changed", "infeasible")]
        lines.append([*cells, f"{mean('minutes'):.2g}"])
    head = "env | way | steps x seeds | violations in training | changed | return | violations in evaluation"
    return markdown(f"{head} | changed | infeasible | minutes per seed", lines) + "\n"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--only", nargs="+", choices=TASKS, default=list(TASKS), help="envs")
    parser.add_argument("--ways", nargs="+", choices=WAYS, default=WAYS)
    parser.add_argument("--steps", type=int)
    parser.add_argument("--seeds", nargs="+", type=int, default=[0])
    arguments = parser.parse_args()
    warnings.simplefilter("ignore")  # of unsafe states, which are counted
    torch.set_num_threads(1)
    rows: list[dict[str, Any]] = []
    if RESULTS.exists():
        with RESULTS.open() as file:
            rows = list(csv.DictReader(file))
    for env_id in arguments.only:
        try:
            importlib.import_module(TASKS[env_id][2])
        except ImportError:
            print(f"{env_id}: {TASKS[env_id][2]} is not installed")
            continue
        for way in arguments.ways:
            for seed in arguments.seeds:
                new = row(env_id, way, seed, arguments.steps or TASKS[env_id][1])
                key = (env_id, way, seed)
                rows = [one for one in rows if (one["env"], one["way"], int(one["seed"])) != key]
                rows.append(new)
                rows.sort(key=lambda one: (one["env"], WAYS.index(one["way"]), int(one["seed"])))
                print(new, flush=True)
                write_rows(RESULTS, COLUMNS, rows)
                RESULTS.with_suffix(".md").write_text(table_of(rows))
    print(table_of(rows))


if __name__ == "__main__":
    main()
