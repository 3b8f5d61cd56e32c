"""The same episode on film: every arm's policy, without and with the filter."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Final

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

_PROBLEM: Final = "problem.json"


@dataclass(frozen=True)
class Filmed:
    """What is to be said of one episode on film."""

    title: str
    steps: int
    changed: int


@dataclass(frozen=True)
class Video:
    """Episodes on film, side by side."""

    animation: bytes
    speed: float
    episodes: list[Filmed]


def video_path(experiment: ExperimentConfig, arm: ArmConfig, condition: str) -> Path:
    """Where a video lies; its facts are beside it, `.json`."""
    return experiment.folder / "videos" / f"{arm.name}_{condition}.webp"


def load_video(path: Path) -> Video | None:
    """Reads a video back; None if there is none."""
    facts = path.with_suffix(".json")
    if not (path.exists() and facts.exists()):
        return None
    values = read_json(facts)
    episodes = [Filmed(**episode) for episode in values["episodes"]]
    return Video(path.read_bytes(), values["speed"], episodes)


def delete_videos(experiment: ExperimentConfig, arm: ArmConfig) -> None:
    """Deletes an arm's videos: its policy is no longer the one that they show."""
    for condition in ("filter_off", "filter_on"):
        path = video_path(experiment, arm, condition)
        path.unlink(missing_ok=True)
        path.with_suffix(".json").unlink(missing_ok=True)


def video_problem(experiment: ExperimentConfig) -> str:
    """The one line that says why there are no videos; empty if nothing is known to stand against them."""
    path = experiment.folder / "videos" / _PROBLEM
    return str(read_json(path).get("problem", ""))


def record_videos(experiment: ExperimentConfig, console: Console) -> None:
    """Films the shown episodes for every arm and condition that are not on film yet, if the config wants films.

    Nothing here fails an evaluation: where no frame can be drawn, one line says why, on the console and later
    in the report.
    """
    shown = shown_episode(experiment)
    if shown is None or not experiment.evaluation.films:
        return
    problem = ""
    envs: list[EnvConfig] = []
    for arm in experiment.arms:
        if arm.env not in envs:
            envs.append(arm.env)
    for env in envs:
        arms = [arm for arm in experiment.arms if arm.env == env]
        problem = _record_arms(experiment, arms, env, shown, console) or problem
    path = experiment.folder / "videos" / _PROBLEM
    path.unlink(missing_ok=True)
    if problem:
        write_json(path, {"problem": problem})
        console.print(f"No videos: {problem}", highlight=False, soft_wrap=True, markup=False)


def _record_arms(
    experiment: ExperimentConfig, arms: list[ArmConfig], env: EnvConfig, shown: ShownEpisode, console: Console
) -> str:
    """Films arms of one env; returns what stood against it."""
    jobs = [
        Job(
            f"video {arm.name} {condition.replace('_', ' ')}",
            1,
            "episodes",
            record_video,
            (
                arm,
                shown,
                experiment.run_folder(arm, shown.seed),
                used,
                video_path(experiment, arm, condition),
            ),
        )
        for arm in arms
        for condition, used in conditions(arm, experiment.evaluation_filter).items()
        if not _up_to_date(experiment, arm, condition, used, shown)
    ]
    if not jobs:
        return ""
    for job in jobs:  # a film of another policy or episode must not be taken for this one
        job.arguments[-1].unlink(missing_ok=True)
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
    env = for_film(make_stack(filmed, used, arm.learner.in_evaluation))
    try:
        animation, speed, films = film_episodes(policy, env, shown.filmed)
    finally:
        env.close()
    write_bytes(path, animation)
    facts = {
        "state": _state(arm, used, shown, checkpoint.timesteps),
        "speed": speed,
        "episodes": [asdict(Filmed(film.title, len(film.changed), sum(film.changed))) for film in films],
    }
    write_json(path.with_suffix(".json"), facts)
    progress.steps(1)


def _state(arm: ArmConfig, used: FilterConfig, shown: ShownEpisode, timesteps: int) -> dict[str, Any]:
    return {
        "arm": arm.fingerprint(),
        "filter": used.plain(),
        "seed": shown.seed,
        "filmed": shown.filmed,
        "timesteps": timesteps,
    }


def _up_to_date(
    experiment: ExperimentConfig, arm: ArmConfig, condition: str, used: FilterConfig, shown: ShownEpisode
) -> bool:
    path = video_path(experiment, arm, condition)
    facts = path.with_suffix(".json")
    if not (path.exists() and facts.exists()):
        return False
    timesteps = finished_checkpoint(arm, shown.seed, experiment.run_folder(arm, shown.seed)).timesteps
    expected = json.loads(json.dumps(_state(arm, used, shown, timesteps)))
    return read_json(facts).get("state") == expected


def _render_modes(env: EnvConfig) -> tuple[str, ...]:
    try:
        made = make_stack(env, FilterConfig())
    except ConfigurationError:
        return ()
    modes = tuple(made.unwrapped.metadata.get("render_modes") or ())
    made.close()
    return modes
