"""Paired evaluation: every policy on the same episode seeds, with the filter on and with it off."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path
from typing import Any, Final

from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.logger import configure
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from safe_wrappers import interventions as keys
from safe_wrappers.wrappers.record_interventions import COLUMNS

from .atomic import write_json
from .checkpoint import Checkpoint
from .config import ArmConfig, EvaluationConfig, FilterConfig
from .run import Progress, finished_checkpoint
from .scene import Scene, SceneRecorder, save_scenes
from .stack import make_stack
from .tables import write_rows

EVALUATION_COLUMNS: Final = ("episode_seed", *COLUMNS)
STATE_FILE: Final = "evaluation.json"


def evaluation_folder(run_folder: Path) -> Path:
    """Where a run's evaluation lies: `filter_off.csv`, `filter_on.csv`, and the scenes beside them."""
    return run_folder / "evaluation"


def evaluate_run(
    arm: ArmConfig,
    seed: int,
    folder: Path,
    settings: EvaluationConfig,
    default_filter: FilterConfig,
    progress: Progress,
) -> None:
    """Evaluates a finished run, deterministically, with the filter off and on.

    Episode i starts from env seed `settings.seed + i`, whatever the arm, the training seed and the filter:
    the rows of two conditions can be compared one by one. Does nothing if this has been done already.

    Args:
        arm: The run's arm.
        seed: The run's seed.
        folder: The run's folder.
        settings: Episodes and their seeds.
        default_filter: The filter put on for an arm that has none of its own; "none" leaves that part out.
        progress: Where to report to.

    Raises:
        RunStateError: The run is not finished, or its folder or policy cannot be used.
    """
    checkpoint = finished_checkpoint(arm, seed, folder)
    action_filter = arm.filter if arm.filter.kind != "none" else default_filter
    conditions = {"filter_off": FilterConfig()}
    if action_filter.kind != "none":
        conditions["filter_on"] = action_filter
    out = evaluation_folder(folder)
    state = {
        "settings": asdict(settings),
        "filter": asdict(action_filter),
        "timesteps": checkpoint.timesteps,
    }
    if (out / STATE_FILE).exists() and json.loads((out / STATE_FILE).read_text()) == state:
        return
    (out / STATE_FILE).unlink(missing_ok=True)  # from here on the rows may be of two settings
    logger = configure(str(folder / "tensorboard"), ["tensorboard"])
    for at, (condition, used) in enumerate(conditions.items()):
        rows: list[dict[str, Any]] = []
        scenes: dict[int, Scene] = {}
        for row, scene in _episodes(arm, checkpoint, settings, used):
            rows.append(row)
            if scene is not None:
                scenes[int(row["episode_seed"])] = scene
            for key, value in row.items():
                if key != "episode_seed":
                    logger.record_mean(f"evaluation_{condition}/{key}", float(value))
            progress.steps(at * settings.episodes + len(rows))
        logger.dump(checkpoint.timesteps)
        write_rows(out / f"{condition}.csv", EVALUATION_COLUMNS, rows)
        save_scenes(out / f"{condition}.npz", scenes)
    logger.close()
    write_json(out / STATE_FILE, state)


def _episodes(
    arm: ArmConfig, checkpoint: Checkpoint, settings: EvaluationConfig, used: FilterConfig
) -> Iterator[tuple[dict[str, Any], Scene | None]]:
    policy = _Policy(arm, checkpoint)
    env = make_stack(arm.env, used)
    try:
        for episode_seed in range(settings.seed, settings.seed + settings.episodes):
            observation, _ = env.reset(seed=episode_seed)
            scene = SceneRecorder(env)
            done = False
            while not done:
                observation, _, terminated, truncated, info = env.step(policy(observation))
                scene.step(info)
                done = terminated or truncated
            yield {"episode_seed": episode_seed, **info[keys.EPISODE_SUMMARY]}, scene.finish()
    finally:
        env.close()


class _Policy:
    """The trained policy with the observation scaling that it was trained with, frozen."""

    def __init__(self, arm: ArmConfig, checkpoint: Checkpoint) -> None:
        self.model: BaseAlgorithm = checkpoint.load_model(arm.algorithm, None, arm.device)
        scaled = checkpoint.load_normalize(DummyVecEnv([lambda: make_stack(arm.env, FilterConfig())]))
        self.normalize = scaled if isinstance(scaled, VecNormalize) else None
        scaled.close()

    def __call__(self, observation: Any) -> Any:
        if self.normalize is not None:
            observation = self.normalize.normalize_obs(observation)
        return self.model.predict(observation, deterministic=True)[0]
