"""One experiment's page: what the filter bought and what it cost, to be understood in a minute."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path
from typing import Final

import jinja2
import yaml

from safe_wrappers.errors import RunStateError

from ..config.models import ExperimentConfig
from ..evaluation.evaluate import compared_pairs, shown_episode
from ..evaluation.metrics import OF_THE_FILTER, REGISTRY
from ..evaluation.step_log import MOST_STEPS, StepLog, load_steps, pool
from ..evaluation.summary import (
    SEEDS_FOR_AN_INTERVAL,
    Curve,
    Summary,
    judged_by,
    learning_curve,
    over_seeds,
)
from ..files import read_json, write_text
from ..run.folder import EVALUATION, FINISHED_FILE
from ..videos import load_video, video_path
from .figures import CONDITIONS, Picture, curve_picture, data_uri, place_pictures, refusals
from .tables import SHORT, every_metric, short_rows, verdict

_CURVES: Final = {
    "return": ("Return", "return per episode"),
    "cost": ("Cost", "cost per episode"),
    "intervention_rate": ("Steps changed", "share of steps that the filter changed"),
}
_TEMPLATES: Final = jinja2.Environment(
    loader=jinja2.PackageLoader("safe_wrappers.train.report", ""),
    autoescape=True,
    undefined=jinja2.StrictUndefined,
    trim_blocks=True,
    lstrip_blocks=True,
)


def write_report(
    experiment: ExperimentConfig, summary: Summary, command: str = "", path: Path | None = None
) -> Path:
    """Writes an experiment's page.

    Returns:
        Where the page is.
    """
    if not summary.per_seed:
        raise RunStateError(
            f"Nothing to report in {str(experiment.folder)!r} yet; run `safe-wrappers compare` first."
        )
    path = path or experiment.folder / "report.html"
    names, seeds = [arm.name for arm in experiment.arms], experiment.seeds
    curves = _curves(experiment, summary)
    acting = dict(_logs(experiment, "filter_on"))
    shown = shown_episode(experiment)
    first, *rest = verdict(experiment, summary)
    values = asdict(experiment) | {"output": str(experiment.output), "seeds": list(seeds)}
    page = _TEMPLATES.get_template("page.html").render(
        experiment=experiment,
        about=about(experiment),
        first=first,
        rest=rest,
        short=SHORT,
        rows=[(a, list(short_rows(summary, a))) for a in experiment.arms if any(summary.table[a.name].values())],
        over=over_seeds(*summary.seeds),
        judge=judged_by(experiment, summary.judged),
        shown=shown,
        films=[
            (f"{arm.name}, filter {words}", data_uri("image/webp", video[0]), video[1])
            for arm in experiment.arms
            for condition, words in CONDITIONS.items()
            if summary.table[arm.name][condition]  # else the film is of another policy
            and (video := load_video(video_path(experiment, arm, condition))) is not None
        ],
        acting=acting,
        interventions=[refusals(acting), *_places(experiment, acting)],
        most_steps=MOST_STEPS,
        left_out=sum(log.left_out for log in acting.values()),
        curves=[curve_picture(*_CURVES[metric], of_arms, names) for metric, of_arms in curves.items()],
        band="range" if len(seeds) < SEEDS_FOR_AN_INTERVAL else "bootstrap 95 % interval",
        learners={arm.name: arm.learner.kind for arm in experiment.arms if arm.filter.kind != "none"},
        registry=REGISTRY,
        command=command,
        settings=yaml.safe_dump(values | {"arms": list(values["arms"])}, sort_keys=False),
        every=list(every_metric(experiment, summary)),
    )  # fmt: skip
    write_text(path, page)
    return path


def _curves(experiment: ExperimentConfig, summary: Summary) -> dict[str, dict[str, Curve | None]]:
    """Metric -> arm -> its learning curve."""
    filtered = [arm for arm in experiment.arms if arm.filter.kind != "none"]
    arms = {metric: filtered if metric in OF_THE_FILTER else experiment.arms for metric in _CURVES}
    return {
        metric: {arm.name: learning_curve(experiment, arm, metric) for arm in of}
        for metric, of in arms.items()
        if of and (summary.judged or metric != "cost")
    }


def _logs(experiment: ExperimentConfig, condition: str) -> Iterator[tuple[str, StepLog]]:
    for arm in experiment.arms:
        folders = [experiment.run_folder(arm, seed) / EVALUATION for seed in experiment.seeds]
        found = [load_steps(folder / f"{condition}_steps.npz") for folder in folders]
        log = pool([steps for steps in found if steps is not None])
        if log is not None and len(log):
            yield arm.name, log


def _places(experiment: ExperimentConfig, acting: dict[str, StepLog]) -> Iterator[Picture]:
    off = dict(_logs(experiment, "filter_off"))
    for bare, filtered in compared_pairs(experiment):
        if filtered.name in acting:
            yield from place_pictures(filtered.name, acting[filtered.name], bare.name, off.get(bare.name))


def about(experiment: ExperimentConfig) -> str:
    """What was trained on what, for how long, and how it was judged."""
    kinds = ", ".join(dict.fromkeys(f"{arm.algorithm} on {arm.env.id}" for arm in experiment.arms))
    steps = sorted(  # whole rollouts, which may be more than `total_steps`
        int(read_json(experiment.run_folder(arm, seed) / FINISHED_FILE).get("timesteps", arm.total_steps))
        * arm.action_repeat
        for arm in experiment.arms
        for seed in experiment.seeds
    )
    how_long = f"{steps[0]:,}" if steps[0] == steps[-1] else f"{steps[0]:,} to {steps[-1]:,}"
    seeds = len(experiment.seeds)
    return (
        f"{kinds}, {how_long} steps, {seeds} seed{'s' * (seeds > 1)}; evaluation on"
        f" {experiment.evaluation.episodes} episodes, the same ones for every arm and seed."
    )
