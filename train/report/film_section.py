"""The same episodes on film, without and with the filter."""

from __future__ import annotations

from ..config import ArmConfig, ExperimentConfig
from ..videos.film import first_frame
from ..videos.record import Filmed, Video, load_video, video_path, video_problem
from .markup import data_uri, keys, text

_CONDITIONS = {"filter_off": "filter off", "filter_on": "filter on"}
_KNOWN = (
    '<p class="line">With the filter on, films show what it knows, where it has a place in the scene: in red what is '
    "kept free, in yellow the way of a backup, in purple estimates; proposed actions in orange, executed ones in "
    "blue.</p>"
)


def films(experiment: ExperimentConfig) -> str:
    """The videos that are there, or one line that says why there are none."""
    found = [
        (arm, words, video)
        for arm in experiment.arms
        for condition, words in _CONDITIONS.items()
        if (video := load_video(video_path(experiment, arm, condition))) is not None
    ]
    problem = video_problem(experiment)
    if not found:
        why = (
            problem
            or "nothing has been filmed yet; safe-wrappers evaluate does, where the task can draw frames."
        )
        if not experiment.evaluation.films:
            why = "the config wants none (evaluation.films); safe-wrappers enjoy RUN --output FILM.webp makes one."
        return f'<p class="line"><b>No videos.</b> {text(why[:1].upper() + why[1:])}</p>'
    marks = keys(
        {
            "strip below: changed by the filter": ("film-changed", "fill"),
            "in violation": ("film-violated", "fill"),
            "left alone": ("film-bare", "fill"),
        }
    )
    known = _KNOWN if any(words == _CONDITIONS["filter_on"] for _, words, _ in found) else ""
    parts = "".join(_film(*item) for item in found)
    more = f'<p class="line">{text(problem)}</p>' if problem else ""
    return f'{marks}{known}<div class="films">{parts}</div>{more}'


def _film(arm: ArmConfig, words: str, video: Video) -> str:
    title = f"{arm.name}, {words}"
    said = f"{' '.join(map(_episode, video.episodes))} Shown {_speed(video.speed)}."
    still = data_uri("image/webp", first_frame(video.animation))
    moving = data_uri("image/webp", video.animation)
    return (
        f"<figure><h3>{text(title)}</h3><picture>"
        f'<source media="(prefers-reduced-motion: reduce), print" srcset="{still}">'
        f'<img src="{moving}" alt="{text(f"Video: {title}. {said}")}"></picture>'
        f"<figcaption>{text(said)}</figcaption></figure>"
    )


def _episode(episode: Filmed) -> str:
    title = episode.title[:1].upper() + episode.title[1:]
    return f"{title}; of {episode.steps:,} steps {episode.changed:,} changed."


def _speed(times: float) -> str:
    if 0.95 <= times <= 1.05:
        return "in real time"
    return f"{times:.1f} times faster than real" if times > 1 else f"{1 / times:.1f} times slower than real"
