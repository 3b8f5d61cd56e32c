"""A learner that is paid for violations, through the filter: does PPO find what the hand-written drivers do not?

    python -m benchmarks trained_adversary            # every env, 300,000 steps; goes on where it was stopped
    python -m benchmarks trained_adversary --steps 20000 --seed 1

The reward is 1 for a control step in which the env's own truth (`benchmarks/judges.py`) was broken at any physics
substep, and up to 0.1 for how near the state came to the limit, on a logarithmic scale, so that the last millimetre
is worth as much as the last metre. The filter is `protect` with its defaults. The trained policy is then evaluated
on episodes of other seeds, deterministic and stochastic, through the filter and, to see that it is after violations
at all, without. Flagged is a violation in a step that the filter reported as infeasible or fallback, or as one that
began unsafe.
"""

import warnings
from dataclasses import asdict, dataclass
from functools import reduce
from typing import Any, Final, NamedTuple

import gymnasium as gym
import numpy as np
import torch
from stable_baselines3 import PPO
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from benchmarks.cases import CASES
from benchmarks.judges import FLAGS, Judged, counted
from benchmarks.tables import RUNS, keep, markdown, measured, options, total
from safe_wrappers.errors import UnsafeStateWarning

SCALES: Final = {
    "SafePointGoal1-v0": 1.0,  # m
    "SafeCarGoal1-v0": 1.0,  # m
    "Reacher-v5": 5.0,  # rad/s, the limit
    "SafeHalfCheetahVelocity-v0": 3.2096,  # m/s, the limit
}
"""Env id -> a margin that is far from the limit, in the unit of h; 1 m for others."""
NEARNESS: Final = 0.1
"""Reward of a step that begins at the limit; a violation is 1."""
DECADES: Final = 4.0
"""Of the scale, over which the nearness rises from 0 to its largest."""
EPISODES: Final = 20
_FIRST_SEED: Final = 1_000_000
"""Of the evaluation: no training episode has it."""


class Job(NamedTuple):
    """One env's training."""

    env: str
    steps: int
    seed: int


@dataclass
class Tally:
    """What was counted over control steps; `smallest` is the least h of a step's start, in its own unit."""

    steps: int = 0
    violations: int = 0
    unflagged: int = 0
    intervened: int = 0
    infeasible: int = 0
    fallback: int = 0
    unsafe: int = 0
    smallest: float | None = None

    def plus(self, other: "Tally") -> "Tally":
        """Both together."""
        least = [t.smallest for t in (self, other) if t.smallest is not None]
        sums = {
            name: getattr(self, name) + getattr(other, name)
            for name in ("steps", "violations", "unflagged", *FLAGS)
        }
        return Tally(**sums, smallest=min(least, default=None))


class Adversary(Judged):
    """Pays for violations and nearness instead of the task, and counts.

    Args:
        env_id: One of `SCALES`, or another of `cases.CASES`.
        filtered: Through `protect`; without it there is no nearness and no flag.

    Attributes:
        tally: Of all steps so far.
    """

    def __init__(self, env_id: str, filtered: bool = True) -> None:
        case = CASES[env_id]
        bare = case.make()
        super().__init__(case.protect(bare) if filtered else bare, case.judge(bare.unwrapped))
        self._scale = SCALES.get(env_id, 1.0)
        self.tally = Tally()

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Steps, judges, counts and pays."""
        observation, _, terminated, truncated, info = super().step(action)
        reward, margin = float(info["cost_substep"]), info.get("cbf/margin")
        self.tally = self.tally.plus(Tally(1, **counted(info, reward > 0.0), smallest=margin))
        if margin is not None:
            reward += NEARNESS * nearness(margin, self._scale)
        return observation, reward, terminated, truncated, info


def nearness(margin: float, scale: float) -> float:
    """0 from `scale` on, 1 at or behind the limit, linear in the logarithm of the margin between them."""
    share = min(max(margin / scale, 10.0**-DECADES), 1.0)
    return float(-np.log10(share)) / DECADES


def run(job: Job, episodes: int = EPISODES) -> dict[str, Any]:
    """Train and evaluate the adversary of one env."""
    torch.set_num_threads(1)
    warnings.simplefilter("ignore", UnsafeStateWarning)  # counted
    made = [Adversary(job.env) for _ in range(4)]
    envs = VecNormalize(DummyVecEnv([lambda env=env: env for env in made]), gamma=0.99)  # type: ignore[misc]
    settings = {"n_steps": 512, "batch_size": 256, "n_epochs": 10, "learning_rate": 3e-4, "gamma": 0.99}
    policy = "MultiInputPolicy" if isinstance(envs.observation_space, gym.spaces.Dict) else "MlpPolicy"
    model = PPO(policy, envs, seed=job.seed, device="cpu", **settings)
    model.learn(job.steps)
    training = reduce(Tally.plus, (env.tally for env in made))
    row: dict[str, Any] = job._asdict() | {"training": asdict(training)}
    for name, deterministic, filtered in (
        ("deterministic", True, True),
        ("stochastic", False, True),
        ("unfiltered", False, False),
    ):
        row[name] = asdict(evaluate(model, envs, Adversary(job.env, filtered), deterministic, episodes))
    return row


def evaluate(model: PPO, scaling: VecNormalize, env: Adversary, deterministic: bool, episodes: int) -> Tally:
    """The trained policy in whole episodes of its own seeds, its observations scaled as they were at the end."""
    torch.manual_seed(_FIRST_SEED)
    for seed in range(_FIRST_SEED, _FIRST_SEED + episodes):
        observation, _ = env.reset(seed=seed)
        over = False
        while not over:
            action, _ = model.predict(scaling.normalize_obs(observation), deterministic=deterministic)
            observation, _, terminated, truncated, _ = env.step(action)
            over = terminated or truncated
    env.close()
    return env.tally


def table(rows: list[dict[str, Any]]) -> str:
    """Markdown: for each env its training and its evaluations."""
    lines = []
    parts = {"training": "training", "deterministic": "evaluation, deterministic"}
    parts |= {"stochastic": "evaluation, stochastic", "unfiltered": "the same without the filter"}
    for row in rows:
        for part, label in parts.items():
            t = row[part]
            counts = [row["env"], label, f"{t['steps']:,}", f"{t['violations']:,}"]
            filtered = [
                f"{t['unflagged']:,}",
                f"{t['smallest'] or 0.0:.3g}",
                f"{t['intervened'] / max(t['steps'], 1):.1%}",
                *(f"{t[name]:,}" for name in FLAGS[1:]),
            ]
            lines.append(counts + (["-"] * 6 if part == "unfiltered" else filtered))
    filtered_parts = [row[part] for row in rows for part in list(parts)[:-1]]
    sums = {key: total(filtered_parts, key) for key in ("steps", "violations", "unflagged")}
    text = f"In all, through the filter: {sums['violations']:,} violations in {sums['steps']:,} steps"
    head = (
        "env | part | steps | violations | unflagged | smallest h | changed | infeasible | fallback | unsafe"
    )
    return "\n".join([markdown(head, lines), "", f"{text}, {sums['unflagged']:,} of them unflagged."])


def main() -> None:
    """Train what is not trained yet, print the table."""
    given = options(__doc__, steps=300_000, seed=0)
    jobs = [Job(env, given.steps, given.seed) for env in SCALES]
    keep(
        "trained_adversary", table(measured(RUNS / "trained_adversary/trained_adversary.jsonl", jobs, run, 1))
    )
