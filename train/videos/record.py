"""The same episode on film: every arm's policy, without and with the filter."""

from __future__ import annotations

import json
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

from rich.console import Console

from safe_wrappers.errors import ConfigurationError

from ..config import ArmConfig, EnvConfig, ExperimentConfig, FilterConfig
from ..evaluation.episode_selection import ShownEpisode, shown_episode
from ..evaluation.evaluate import conditions
from ..files import read_json, write_bytes, write_json
from ..processes import Job, Progress, RunsFailedError, environment
from ..processes.parallel import run_jobs
from ..run.policy import TrainedPolicy
from ..run.stack import make_stack
from ..run.training import finished_checkpoint
from .film import film_episodes, for_film
from .rendering import find_rendering


class Video(NamedTuple):
    """Episodes on film, side by side, and a sentence that says what is seen."""

    animation: bytes
    said: str


def video_path(experiment: ExperimentConfig, arm: ArmConfig, condition: str) -> Path:
    """Where a video lies; its facts are beside it, `.json`."""
    return experiment.folder / "videos" / f"{arm.name}_{condition}.webp"


def load_video(path: Path) -> Video | None:
    """Reads a video back; None if there is none."""
    facts = read_json(path.with_suffix(".json"))
    if not facts or not path.exists():
        return None
    return Video(path.read_bytes(), facts["said"])


def delete_videos(experiment: ExperimentConfig, arm: ArmConfig) -> None:
    """Deletes an arm's videos: its policy is no longer the one that they show."""
    for condition in ("filter_off", "filter_on"):
        path = video_path(experiment, arm, condition)
        path.unlink(missing_ok=True)
        path.with_suffix(".json").unlink(missing_ok=True)


def record_videos(experiment: ExperimentConfig, console: Console) -> None:
    """Films the shown episodes for every arm and condition that are not on film yet, if the config wants films.

    Nothing here fails an evaluation: where no frame can be drawn, one line says why.
    """
    shown = shown_episode(experiment)
    if shown is None or not experiment.evaluation.films:
        return
    envs: list[EnvConfig] = []
    for arm in experiment.arms:
        if arm.env not in envs:
            envs.append(arm.env)
            problem = _record_env(experiment, arm.env, shown, console)
            if problem:
                console.print(f"No videos: {problem}", highlight=False, soft_wrap=True, markup=False)


def _record_env(experiment: ExperimentConfig, env: EnvConfig, shown: ShownEpisode, console: Console) -> str:
    """Films the arms of one env; returns what stood against it."""
    jobs = []
    for arm in experiment.arms:
        folder = experiment.run_folder(arm, shown.seed)
        for condition, used in conditions(arm, experiment.evaluation_filter).items():
            path = video_path(experiment, arm, condition)
            state = _state(arm, used, shown, finished_checkpoint(arm, shown.seed, folder).timesteps)
            same = read_json(path.with_suffix(".json")).get("state") == state and path.exists()
            if arm.env == env and not same:
                path.unlink(missing_ok=True)  # it shows another policy or episode
                name = f"video {arm.name} {condition.replace('_', ' ')}"
                jobs.append(Job(name, 1, "episodes", record_video, (arm, shown, folder, used, path)))
    if not jobs:
        return ""
    if "rgb_array" not in _render_modes(env):
        return f"{env.id} draws no frames (it has no render mode rgb_array)."
    rendering = find_rendering(env)
    if rendering.problem:
        return rendering.problem
    try:
        with environment(rendering.variables):
            run_jobs(jobs, experiment.workers, console, "Videos")
    except RunsFailedError as error:
        return f"filming {env.id} failed: {str(error).strip().splitlines()[-1]}"
    return ""


def record_video(
    arm: ArmConfig, shown: ShownEpisode, run_folder: Path, used: FilterConfig, path: Path, progress: Progress
) -> None:
    """Runs the shown episodes and writes their film, with what a filter knows drawn into it, and its facts.

    Args:
        arm: Whose policy.
        shown: Which seed and episodes.
        run_folder: The run's folder.
        used: The filter that is on.
        path: The film's.
        progress: Where to report to.
    """
    checkpoint = finished_checkpoint(arm, shown.seed, run_folder)
    policy = TrainedPolicy(arm, checkpoint.folder)
    filmed = replace(arm.env, kwargs={**arm.env.kwargs, "render_mode": "rgb_array"})
    with closing(for_film(make_stack(filmed, used, arm.learner.in_evaluation))) as env:
        animation, speed, films = film_episodes(policy, env, shown.filmed)
    write_bytes(path, animation)
    said = [f"{film.title}; of {len(film.changed):,} steps {sum(film.changed):,} changed." for film in films]
    facts = {
        "state": _state(arm, used, shown, checkpoint.timesteps),
        "said": " ".join([*said, f"Shown {speed:.1f} times as fast as real."]),
    }
    write_json(path.with_suffix(".json"), facts)
    progress.steps(1)


def _state(arm: ArmConfig, used: FilterConfig, shown: ShownEpisode, timesteps: int) -> dict[str, Any]:
    """Whose film of what it is, as JSON gives it back."""
    state = {
        "arm": arm.fingerprint(),
        "filter": used.plain(),
        "seed": shown.seed,
        "filmed": shown.filmed,
        "timesteps": timesteps,
    }
    found: dict[str, Any] = json.loads(json.dumps(state))
    return found


def _render_modes(env: EnvConfig) -> tuple[str, ...]:
    try:
        with closing(make_stack(env, FilterConfig())) as made:
            return tuple(made.unwrapped.metadata.get("render_modes") or ())
    except ConfigurationError:
        return ()
