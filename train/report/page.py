"""One experiment's page: what the filter bought and what it cost, to be understood in a minute."""

from __future__ import annotations

import platform
from collections.abc import Iterator
from dataclasses import asdict
from importlib.metadata import version
from pathlib import Path
from typing import Final

import jinja2
import yaml

from safe_wrappers.errors import RunStateError

from ..config import ExperimentConfig
from ..evaluation.episode_selection import compared_pairs, shown_episode
from ..evaluation.evaluate import evaluated_steps, evaluation_folder
from ..evaluation.metrics import OF_THE_FILTER, REGISTRY
from ..evaluation.step_log import MOST_STEPS, StepLog, pool
from ..evaluation.summary import (
    SEEDS_FOR_AN_INTERVAL,
    Curve,
    Summary,
    judged_by,
    learning_curve,
    number,
    over_seeds,
    spread,
)
from ..files import Row, read_json, write_rows, write_text
from ..run.folder import START_FILE, finished_facts
from ..videos.record import load_video, video_path
from .drawing import Picture, color_of, data_uri
from .figures import CONDITIONS, curve_picture, over_the_episode, plane_picture, refusals
from .tables import RUN_COLUMNS, SHORT, every_metric, run_rows, short_rows
from .verdict import compare, percent, verdict
from .where import Scene, place_pictures, scene_pictures

_PACKAGES: Final = ("safe-wrappers", "gymnasium", "mujoco", "stable-baselines3", "torch", "numpy", "daqp")
_CURVES: Final = {
    "return": ("Return", "return per episode"),
    "cost": ("Cost", "cost per episode"),
    "intervention_rate": ("Steps changed", "share of steps that the filter changed"),
}
_CHANGED: Final = {"intervened": ("were changed", "-")}
_FAILED: Final = {"infeasible": ("were infeasible", "-"), "fallback": ("ran the fallback", ":")}
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
    """Writes an experiment's page, and its learning curves beside it, as `<name of the page>_curves.csv`.

    Args:
        experiment: The experiment; what its folder holds is shown, nothing is trained.
        summary: Its numbers.
        command: The command that makes the experiment, for the page.
        path: Where to; `report.html` in the experiment's folder if not given.

    Returns:
        Where the page is.

    Raises:
        RunStateError: There is nothing to report yet.
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
        found=compare(experiment, summary),
        number=number,
        percent=percent,
        spread=spread,
        short=SHORT,
        rows=[(a, list(short_rows(summary, a))) for a in experiment.arms if any(summary.table[a.name].values())],
        over=over_seeds(*summary.seeds),
        judge=judged_by(experiment, summary.judged),
        shown=shown,
        films=[
            (f"{arm.name}, filter {words}", data_uri("image/webp", video.animation), video.said)
            for arm in experiment.arms
            for condition, words in CONDITIONS.items()
            if (video := load_video(video_path(experiment, arm, condition))) is not None
        ],
        scenes=_scenes(experiment),
        plane=plane_picture(summary, names) if summary.judged else None,
        acting=acting,
        interventions=[] if not acting else [
            over_the_episode("When in an episode it stepped in", _CHANGED, acting, names),
            over_the_episode("Infeasible and fallback steps in evaluation", _FAILED, acting, names),
            refusals(acting),
            *_places(experiment, acting),
        ],
        most_steps=MOST_STEPS,
        left_out=sum(log.left_out for log in acting.values()),
        curves=[curve_picture(*_CURVES[metric], of_arms, names) for metric, of_arms in curves.items()],
        band="range" if len(seeds) < SEEDS_FOR_AN_INTERVAL else "bootstrap 95 % interval",
        run_columns=RUN_COLUMNS,
        runs=list(run_rows(experiment, summary)),
        unfinished=sum(not finished_facts(experiment.run_folder(a, seed)) for a in experiment.arms for seed in seeds),
        learners={arm.name: arm.learner.kind for arm in experiment.arms if arm.filter.kind != "none"},
        registry=REGISTRY,
        command=command,
        versions=[("python", platform.python_version()), *((each, version(each)) for each in _PACKAGES)],
        settings=yaml.safe_dump(values | {"arms": list(values["arms"])}, sort_keys=False),
        every=list(every_metric(experiment, summary)),
    )  # fmt: skip
    write_rows(path.with_name(f"{path.stem}_curves.csv"), _CURVE_COLUMNS, _curve_rows(experiment, curves))
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


_CURVE_COLUMNS: Final = ("metric", "arm", "what", "training_steps", "value")


def _curve_rows(experiment: ExperimentConfig, curves: dict[str, dict[str, Curve | None]]) -> Iterator[Row]:
    """Every line of every curve, point by point; `what` is `mean`, `low`, `high`, or `seed 0` and so on."""
    for metric, of_arms in curves.items():
        for arm, curve in of_arms.items():
            if curve is None:
                continue
            lines = {"mean": curve.iqm, "low": curve.low, "high": curve.high}
            lines |= {f"seed {s}": values for s, values in zip(experiment.seeds, curve.seeds, strict=True)}
            for what, values in lines.items():
                for steps, value in zip(curve.steps, () if values is None else values, strict=False):
                    point = {"training_steps": float(steps), "value": float(value)}
                    yield {"metric": metric, "arm": arm, "what": what, **point}


def _logs(experiment: ExperimentConfig, condition: str) -> Iterator[tuple[str, StepLog]]:
    for arm in experiment.arms:
        found = [evaluated_steps(experiment.run_folder(arm, seed), condition) for seed in experiment.seeds]
        log = pool([steps for steps in found if steps is not None])
        if log is not None and len(log):
            yield arm.name, log


def _places(experiment: ExperimentConfig, acting: dict[str, StepLog]) -> Iterator[Picture]:
    off = dict(_logs(experiment, "filter_off"))
    for bare, filtered in compared_pairs(experiment):
        if filtered.name in acting:
            yield from place_pictures(filtered.name, acting[filtered.name], bare.name, off.get(bare.name))


def _scenes(experiment: ExperimentConfig) -> list[Picture]:
    """The shown episode seen from above, for tasks that publish where things are."""
    shown = shown_episode(experiment)
    pair = next(iter(compared_pairs(experiment)), None)
    wanted = [(experiment.arms[0], "filter_off")]
    if pair is not None:
        wanted = [(pair.bare, "filter_off"), (pair.filtered, "filter_on")]
    scenes = []
    for arm, condition in wanted if shown is not None else ():
        assert shown is not None
        folder = experiment.run_folder(arm, shown.seed)
        places = read_json(evaluation_folder(folder) / f"{condition}_places.json").get(
            str(shown.episode_seed)
        )
        log = evaluated_steps(folder, condition)
        if places and log is not None and (log.episode_seed == shown.episode_seed).any():
            color = color_of(arm.name, [each.name for each in experiment.arms])
            title = f"{arm.name}, filter {CONDITIONS[condition]}, from above"
            scenes.append(Scene(title, color, log, log.episode_seed == shown.episode_seed, places))
    return scene_pictures(scenes)


def about(experiment: ExperimentConfig) -> str:
    """What was trained on what, for how long, and how it was judged."""
    kinds = ", ".join(dict.fromkeys(f"{arm.algorithm} on {arm.env.id}" for arm in experiment.arms))
    steps = sorted(  # whole rollouts, which may be more than `total_steps`
        int(finished_facts(experiment.run_folder(arm, seed)).get("timesteps", arm.total_steps))
        * arm.action_repeat
        for arm in experiment.arms
        for seed in experiment.seeds
    )
    how_long = f"{steps[0]:,}" if steps[0] == steps[-1] else f"{steps[0]:,} to {steps[-1]:,}"
    seeds = len(experiment.seeds)
    begun = ""
    for arm in experiment.arms:
        path = experiment.run_folder(arm, experiment.seeds[0]) / START_FILE
        start = read_json(path)
        if start:
            begun += (
                f" Arm {arm.name} began with the policy of {start['from']} after {start['timesteps']:,} steps, which"
                " do not count as its own."
            )
    return (
        f"{kinds}, {how_long} steps, {seeds} seed{'s' * (seeds > 1)}; evaluation on"
        f" {experiment.evaluation.episodes} episodes, the same ones for every arm and seed.{begun}"
    )
