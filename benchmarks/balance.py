"""Walker2d, kept up and going on: a shield whose backup is a policy that was trained to stop.

    python -m benchmarks.balance                # trains both policies first if they are missing, a quarter of an hour
    python -m benchmarks.balance --episodes 2

One policy was trained to walk for a while, and falls; another one to stop, from states that the first one reaches.
`PredictiveShield` admits an action if after it the second one brings the robot to rest. Policies act
deterministically, on the same episode seeds in every arm. A fall is an episode that the env ended.
"""

import argparse
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import torch
from stable_baselines3 import PPO
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

import safe_wrappers as sw
from benchmarks.tables import RESULTS

Array = np.ndarray[Any, np.dtype[np.float64]]
SEED, ENVS = 0, 4


def walker_h(x: Array) -> float:
    """How far Walker2d is from where the env ends the episode, m or rad."""
    return float(min(x[0] - 0.8, 2.0 - x[0], 1.0 - abs(x[1])))


def walker_rests(x: Array) -> bool:
    """Whether it is upright and nothing is faster than 0.3 m/s or rad/s."""
    return bool(np.abs(x[8:]).max() < 0.3 and abs(x[1]) < 0.5)


class Actor:
    """A trained PPO policy in NumPy: a rollout asks it hundreds of times, and `predict` takes ten times as long.

    Args:
        model: With the default network of two tanh layers.
        normal: What normalised its observations.
    """

    def __init__(self, model: PPO, normal: VecNormalize) -> None:
        self._mean, self._scale = normal.obs_rms.mean, np.sqrt(normal.obs_rms.var + normal.epsilon)
        weights = {name: part.double().numpy() for name, part in model.policy.state_dict().items()}
        names = ["mlp_extractor.policy_net.0", "mlp_extractor.policy_net.2", "action_net"]
        *self._hidden, self._last = [(weights[f"{name}.weight"], weights[f"{name}.bias"]) for name in names]
        self._deviation = np.exp(weights["log_std"])
        self._low, self._high = model.action_space.low, model.action_space.high

    def __call__(self, observation: Array, random: np.random.Generator | None = None) -> Any:
        """The action, shape (m,); with a generator drawn as in training."""
        x = np.clip((observation - self._mean) / self._scale, -10.0, 10.0)
        for weight, bias in self._hidden:
            x = np.tanh(weight @ x + bias)
        action = self._last[0] @ x + self._last[1]
        if random is not None:
            action += self._deviation * random.normal(size=action.shape)
        return np.clip(action, self._low, self._high).astype(np.float32)


class Stopping(gym.Wrapper[Any, Any, Any, Any]):
    """Episodes of 200 steps that begin in the middle of another policy's; the reward is for staying up, at rest."""

    def __init__(self, env: Any, walk: Actor, seed: int) -> None:
        super().__init__(env)
        self._walk, self._random, self._left = walk, np.random.default_rng(seed), 0

    def reset(self, **arguments: Any) -> Any:
        while True:
            observation, info = self.env.reset(**arguments)
            arguments = {}
            for _ in range(int(self._random.integers(121))):
                noise = self._random if self._random.random() < 0.8 else None
                observation, _, fell, _, info = self.env.step(self._walk(observation, noise))
                if fell:
                    break
            else:
                self._left = 200
                return observation, info

    def step(self, action: Any) -> Any:
        observation, _, fell, _, info = self.env.step(action)
        self._left -= 1
        effort = float(np.mean((action / self.env.action_space.high) ** 2))
        speed = min(5.0, abs(float(self.env.unwrapped.data.qvel[0])))
        reward = -5.0 if fell else 1.0 - 0.1 * speed - 0.05 * effort
        return observation, reward, fell, self._left == 0, info


def trained(path: Path, make: Callable[[int], Any], steps: int, **hyperparameters: Any) -> Actor:
    """The policy at a path, trained by PPO on four envs if it is not there."""
    if not path.with_suffix(".zip").exists():
        torch.set_num_threads(1)
        gamma = hyperparameters.setdefault("gamma", 0.99)
        env = VecNormalize(DummyVecEnv([lambda i=i: make(i) for i in range(ENVS)]), gamma=gamma)
        settings: dict[str, Any] = {"n_steps": 512, "batch_size": 256, **hyperparameters}
        model = PPO("MlpPolicy", env, seed=SEED, device="cpu", **settings)
        print(f"training {path.name}: {steps:,} steps", flush=True)
        model.learn(steps)
        path.parent.mkdir(parents=True, exist_ok=True)
        env.save(str(path.with_suffix(".normalize")))
        model.save(path.with_suffix(".zip"))
    model = PPO.load(path.with_suffix(".zip"), device="cpu")
    return Actor(
        model, VecNormalize.load(str(path.with_suffix(".normalize")), DummyVecEnv([lambda: make(0)]))
    )


@dataclass
class Row:
    """One arm, summed over its episodes."""

    arm: str
    episodes: int = 0
    falls: int = 0
    steps: int = 0
    forward_m: float = 0.0
    seconds: float = 0.0
    changed: int = 0
    infeasible: int = 0
    decision_ms: float = 0.0


def shielded(env: Any, stop: Actor, candidates: int) -> Any:
    """The env with the stopping policy as its shield's backup."""
    shield = sw.constraints.PredictiveShield(
        walker_h, horizon=200, backup=stop, terminal=walker_rests, candidates=candidates
    )
    return sw.CBFActionFilter(env, [shield], plant=sw.SimulatorPlant())


def drive(arm: str, wrap: Callable[[Any], Any], walk: Actor, episodes: int, limit: int) -> Row:
    """One arm of the table."""
    row, env = Row(arm), wrap(gym.make("Walker2d-v5", max_episode_steps=limit))
    raw = env.unwrapped
    for episode in range(episodes):
        observation, info = env.reset(seed=100 + episode)
        start, done = float(raw.data.qpos[0]), False
        began = time.perf_counter()
        while not done:
            observation, _, fell, out_of_time, info = env.step(walk(observation))
            done = fell or out_of_time
            row.steps += 1
            row.falls += fell
            row.changed += bool(info.get("cbf/intervened"))
            row.infeasible += bool(info.get("cbf/infeasible"))
        row.decision_ms += 1e3 * (time.perf_counter() - began)
        row.forward_m += float(raw.data.qpos[0]) - start
        row.episodes += 1
    row.seconds = row.steps * float(raw.dt)
    row.decision_ms /= row.steps
    env.close()
    return row


HEADER = "| arm | falls | steps | m/s forward | changed | infeasible | ms per step |\n" + "|---" * 7 + "|"


def line(row: Row) -> str:
    """A row of the Markdown table."""
    speed = row.forward_m / row.seconds
    shares = (
        ("-", "-")
        if row.arm == "no filter"
        else (f"{row.changed / row.steps:.0%}", f"{row.infeasible / row.steps:.1%}")
    )
    cells = (row.arm, f"{row.falls} of {row.episodes}", f"{row.steps:,}", f"{speed:.2f}", *shares)
    return "| " + " | ".join((*cells, f"{row.decision_ms:.1f}")) + " |"


def kept_up(policies: Path, episodes: int, limit: int) -> list[str]:
    """The table's lines."""
    steps, lines = 400_000, []

    def make(_: int) -> Any:
        return gym.make("Walker2d-v5")

    walk = trained(policies / "Walker2d_walks", make, steps, n_epochs=10)
    stop = trained(
        policies / "Walker2d_stops", lambda index: Stopping(make(index), walk, index), steps, n_epochs=10
    )
    arms: dict[str, Callable[[Any], Any]] = {
        "no filter": lambda env: env,
        "shield": lambda env: shielded(env, stop, 16),
        "shield, no neighbours": lambda env: shielded(env, stop, 0),
    }
    print(HEADER)
    for arm, wrap in arms.items():
        lines.append(line(drive(arm, wrap, walk, episodes, limit)))
        print(lines[-1], flush=True)
    return lines


def main() -> None:
    """Train what is missing, print the table and write it."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--episodes", type=int, default=10)
    parser.add_argument("--limit", type=int, default=500, help="steps per episode at most")
    parser.add_argument("--policies", type=Path, default=Path("runs/balance"), help="where they lie")
    parser.add_argument("--results", type=Path, default=RESULTS)
    given = parser.parse_args()
    text = f"{given.episodes} episodes of at most {given.limit} steps\n"
    text += "\n".join(["", HEADER, *kept_up(given.policies, given.episodes, given.limit), ""])
    given.results.mkdir(parents=True, exist_ok=True)
    (given.results / "balance.md").write_text(text)


if __name__ == "__main__":
    main()
