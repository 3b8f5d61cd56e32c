"""Policies that give whole chunks, trained with SB3's PPO through `ChunkHandover`.

    python -m benchmarks.chunk_policy    # trains all, or says that they are there; about an hour on one core

The policy's action is a few knots per control, which a clamped cubic B-spline turns into the chunk. With a chunk's
entries as separate actions PPO's exploration noise is drawn for each of them and what it learns is jagged: then the
chunk's own inside shakes the arm, not the seam between two chunks. It is trained with plain replacement at every
chunk and a delay drawn anew for each, so no way of blending has an advantage; one of them through the blend, to show
what is gained where the policy knows it.
"""

import argparse
import pickle
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import torch
from scipy.interpolate import BSpline
from stable_baselines3 import PPO
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

import safe_wrappers as sw
from benchmarks.seam_bounds import bounds_of
from safe_wrappers.checks import Array

RUNS = Path(__file__).parents[1] / "runs" / "seams"

DEGREE = 3
"""Of the spline."""
REPORT = 51_200
"""Chunks between two lines of progress."""


@dataclass(frozen=True)
class Task:
    """What is learned, and how long.

    Attributes:
        env: Its id.
        chunk: H, control steps.
        horizon: s, control steps.
        delays: The least and the largest delay in training, control steps.
        steps: Chunks given in training.
        knots: Per chunk and control.
        seed: Of the training.
        range_per_second: Of the action, that the bound on the rate lets it go through, where no arm says more.
        bounded: Trained through the blend and its bounds, not through replacement.
        rollout: Chunks of each of the four envs between two updates.
    """

    env: str
    chunk: int
    horizon: int
    steps: int
    delays: tuple[int, int] = (0, 5)
    knots: int = 5
    seed: int = 0
    range_per_second: float = 1.0
    bounded: bool = False
    rollout: int = 512

    @property
    def name(self) -> str:
        """For the table."""
        through = ", trained through smoothstep with rate and time" if self.bounded else ""
        return f"{self.env}, H = {self.chunk}, s = {self.horizon}{through}"


TASKS = (
    Task("FlexJointReach-v0", chunk=24, horizon=8, steps=307_200),
    Task("Reacher-v5", chunk=16, horizon=5, steps=307_200),
    Task("FlexJointReach-v0", chunk=32, horizon=16, steps=204_800),
    Task("FlexJointReach-v0", chunk=32, horizon=16, steps=204_800, bounded=True),
    # A running gait goes from one end of the range to the other in two control steps.
    Task("HalfCheetah-v5", chunk=16, horizon=5, steps=1_024_000, range_per_second=10.0),
)

Policy = Callable[[Array], Array]
"""From an observation to a chunk, shape (H, m), in action units."""


def basis(entries: int, knots: int) -> Array:
    """What each knot adds to each entry, shape (entries, knots): a clamped cubic B-spline, evenly spaced."""
    inner = np.linspace(0.0, 1.0, knots - DEGREE + 1)
    t = np.concatenate([np.zeros(DEGREE), inner, np.ones(DEGREE)])
    return np.asarray(BSpline(t, np.eye(knots), DEGREE)(np.linspace(0.0, 1.0, entries)))


class Knots(gym.ActionWrapper[Any, Any, Any]):
    """The action is knots from -1 to 1, shape (knots, m), over the range of each control; the chunk follows."""

    def __init__(self, env: gym.Env[Any, Any], knots: int) -> None:
        super().__init__(env)
        space: Any = env.action_space
        self._middle, self._half = 0.5 * (space.high + space.low)[0], 0.5 * (space.high - space.low)[0]
        self._basis = basis(space.shape[0], knots)
        self.action_space = gym.spaces.Box(-1.0, 1.0, (knots, space.shape[1]), np.float32)

    def action(self, action: Any) -> Array:
        return np.asarray(self._basis @ (self._middle + self._half * action), dtype=np.float32)


def train(task: Task) -> tuple[Any, VecNormalize]:
    """PPO, and the statistics of its observations."""

    def make() -> gym.Env[Any, Any]:
        env = gym.make(task.env)
        given: dict[str, Any] = {"blend": "replace"}
        if task.bounded:
            bounds = bounds_of(env, task.horizon, task.range_per_second)
            given = {"rate_limit": bounds.rate_limit, "blend_time": bounds.blend_time}
        handover = sw.ChunkHandover(env, task.chunk, task.horizon, list(task.delays), **given)
        return Monitor(Knots(handover, task.knots))

    torch.set_num_threads(1)
    envs = VecNormalize(DummyVecEnv([make] * 4), gamma=0.95)
    model = PPO(
        "MlpPolicy",
        envs,
        n_steps=task.rollout,
        batch_size=256,
        n_epochs=10,
        gamma=0.95,
        gae_lambda=0.9,
        learning_rate=3e-4,
        seed=task.seed,
        device="cpu",
        policy_kwargs={"log_std_init": -1.0, "net_arch": [128, 128]},
    )
    begin = time.perf_counter()
    while model.num_timesteps < task.steps:
        model.learn(
            min(REPORT, task.steps - model.num_timesteps), reset_num_timesteps=not model.num_timesteps
        )
        mean = np.mean([e["r"] for e in model.ep_info_buffer or []] or [np.nan])
        print(
            f"{task.env}: {model.num_timesteps:,} chunks, {time.perf_counter() - begin:.0f} s, return {mean:.2f}",
            flush=True,
        )
    return model, envs


def policy(task: Task, runs: Path = RUNS) -> Policy:
    """The task's policy, deterministic; trained if it is not there yet."""
    runs.mkdir(parents=True, exist_ok=True)
    name = f"{task.env}_H{task.chunk}_s{task.horizon}_{task.knots}knots_{task.steps}_seed{task.seed}"
    name += "_through" if task.bounded else ""
    weights, statistics = runs / f"{name}.zip", runs / f"{name}.pkl"
    if not weights.exists():
        model, envs = train(task)
        envs.save(str(statistics))
        half = runs / f"{name}.half.zip"
        model.save(half)
        half.replace(weights)  # a killed run leaves nothing that looks finished
    model = PPO.load(weights, device="cpu")
    with statistics.open("rb") as file:
        normalise = pickle.load(file).normalize_obs
    knots = Knots(sw.ChunkHandover(gym.make(task.env), task.chunk, task.horizon, blend="replace"), task.knots)

    def chunk(observation: Array) -> Array:
        return knots.action(model.predict(normalise(observation), deterministic=True)[0])

    return chunk


def main() -> None:
    """Train what is not there."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.parse_args()
    for task in TASKS:
        policy(task)
        print(f"{task.env}: in {RUNS}")


if __name__ == "__main__":
    main()
