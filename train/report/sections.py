"""The parts of an experiment's page between its headline and its origin."""

from __future__ import annotations

from collections.abc import Iterator

from ..config import ExperimentConfig
from ..evaluation.curves import event_rate, learning_curve
from ..evaluation.episode_selection import Pair, compared_pairs, shown_episode
from ..evaluation.evaluate import evaluated_steps, evaluation_folder
from ..evaluation.has_cost import judged_by
from ..evaluation.metrics import OF_THE_FILTER
from ..evaluation.scene import Scene, load_scenes
from ..evaluation.step_log import MOST_STEPS, StepLog, pool
from ..evaluation.summary import SEEDS_FOR_AN_INTERVAL, Summary, over_seeds
from ..figures.constraints import constraints_picture
from ..figures.corrections import corrections_picture
from ..figures.curve import curve_picture
from ..figures.finals import finals_picture
from ..figures.picture import Picture
from ..figures.plane import plane_picture
from ..figures.plot_files import PlotFiles
from ..figures.scenes import scene_frame, scene_picture
from ..figures.timelines import changes_picture, failures_picture, training_timeline_picture
from ..figures.where import choose_view, where_picture
from ..run.folder import FINISHED_FILE
from .markup import pictures, text

_CURVES = {
    "return": ("Return", "return per episode"),
    "cost": ("Cost", "cost per episode"),
    "intervention_rate": ("Steps changed", "share of steps that the filter changed"),
}
_FINALS = {
    "return": ("Return of the trained policies", "return per evaluation episode"),
    "cost": ("Cost of the trained policies", "cost per evaluation episode"),
    "intervention_rate": ("Steps that the filter changed", "share of evaluation steps"),
}


def table_note(experiment: ExperimentConfig, summary: Summary) -> str:
    """What the short table's numbers are, and who judged."""
    over = over_seeds(*summary.seeds)
    own = judged_by(experiment, summary.judged)
    return (
        f"<p>Return, cost and steps changed: {text(over)}."
        f" Violations, infeasible and fallback: steps of all seeds. {text(own)}</p>"
    )


def from_above(experiment: ExperimentConfig, files: PlotFiles) -> str:
    """The shown episode seen from above, for tasks that publish where things are."""
    shown = shown_episode(experiment)
    if shown is None:
        return ""
    pair = next(iter(compared_pairs(experiment)), None)
    wanted = (
        [(pair.bare, "filter_off"), (pair.filtered, "filter_on")]
        if pair
        else [(experiment.arms[0], "filter_off")]
    )
    scenes: dict[tuple[str, str], Scene] = {}
    for arm, condition in wanted:
        path = evaluation_folder(experiment.run_folder(arm, shown.seed)) / f"{condition}.npz"
        scene = load_scenes(path).get(shown.episode_seed)
        if scene is not None:
            scenes[arm.name, condition] = scene
    if not scenes:
        return ""
    names = _names(experiment)
    frame = scene_frame(*scenes.values())
    drawn = [
        scene_picture(
            f"scene-{condition}",
            f"{arm}, {condition.replace('_', ' ')}, from above",
            scene,
            names.index(arm),
            frame,
        )
        for (arm, condition), scene in scenes.items()
    ]
    return pictures(drawn, files)


def which_episode(experiment: ExperimentConfig) -> str:
    """Which episode is shown, and why this one."""
    shown = shown_episode(experiment)
    return f"<p>{text(shown.reason)}</p>" if shown else ""


def outcome(experiment: ExperimentConfig, summary: Summary, files: PlotFiles) -> str:
    """Return against cost, and each with its seeds as dots."""
    names = _names(experiment)
    judged = summary.judged
    finals = [
        finals_picture(f"final-{metric}", title, unit, metric, summary, names)
        for metric, (title, unit) in _FINALS.items()
        if judged or metric != "cost"
    ]
    drawn = [item for item in finals if item.svg]
    plane = [plane_picture(summary, names)] if judged else []
    return pictures([*plane, *drawn] or finals[:1], files)  # of nothing, that nothing has been evaluated


def interventions(experiment: ExperimentConfig, files: PlotFiles) -> str:
    """How large, which constraint, where, and when in an episode; from the recorded steps."""
    names = _names(experiment)
    acting = dict(_logs(experiment, "filter_on"))
    if not acting:
        return (
            '<p class="line"><b>No recorded steps with a filter on.</b> Run <code>safe-wrappers evaluate'
            "</code> (again) to see corrections, places, constraints and times.</p>"
        )
    places = list(_places(experiment, acting))
    items = [
        corrections_picture(acting, names),
        constraints_picture(acting, names),
        changes_picture(acting, names),
        failures_picture(acting, names),
        *places,
    ]
    left_out = sum(log.left_out for log in acting.values())
    notes = []
    if any(place.svg for place in places):
        notes.append(
            "The two coordinates are those, of all that are recorded, that tell changed steps from others best."
        )
    if left_out:
        notes.append(
            f"From the first {MOST_STEPS:,} steps of each run; {left_out:,} more were evaluated but not kept."
        )
    note = f"<p>{' '.join(notes)}</p>" if notes else ""
    return pictures(items, files) + note


def training(experiment: ExperimentConfig, summary: Summary, files: PlotFiles) -> str:
    """Learning curves with every seed, and when the filter was at a loss."""
    names = _names(experiment)
    filtered = [arm for arm in experiment.arms if arm.filter.kind != "none"]
    judged = summary.judged
    items = [
        curve_picture(
            f"curve-{metric}",
            title,
            unit,
            {
                arm.name: learning_curve(experiment, arm, metric)
                for arm in (filtered if metric in OF_THE_FILTER else experiment.arms)
            },
            names,
        )
        for metric, (title, unit) in _CURVES.items()
        if (filtered or metric not in OF_THE_FILTER) and (judged or metric != "cost")
    ]
    rates = {
        event: {
            arm.name: rate for arm in filtered if (rate := event_rate(experiment, arm, event)) is not None
        }
        for event in ("infeasible", "fallback")
    }
    if rates["infeasible"]:
        steps = sum(
            row["steps"]
            for row in summary.per_seed
            if row["condition"] == "training" and row["arm"] in rates["infeasible"]
        )
        items.append(training_timeline_picture(rates, steps, names))
    seeds = len(experiment.seeds)
    band = "range" if seeds < SEEDS_FOR_AN_INTERVAL else "bootstrap 95 % interval"
    told = f"<p>Faint lines are seeds, the band is the {band} over them.</p>" if seeds > 1 else ""
    return pictures(items, files) + told


def runs_note(experiment: ExperimentConfig) -> str:
    """What the runs' table is of."""
    running = sum(
        not (experiment.run_folder(arm, seed) / FINISHED_FILE).exists()
        for arm in experiment.arms
        for seed in experiment.seeds
    )
    left = f" Not finished: {running} of {len(experiment.arms) * len(experiment.seeds)}." if running else ""
    return f"<p>Training only: all episodes of each run, with what the policy was at the time.{left}</p>"


def notes(experiment: ExperimentConfig, summary: Summary) -> str:
    """What the numbers mean and what they do not."""
    items = [
        "Numbers are interquartile means over seeds (the middle half; with fewer than four the plain mean),"
        " brackets are percentile-bootstrap 95 % intervals over seeds. With a handful of seeds they are too"
        " narrow; of two seeds the range is given instead, which says nothing about a third; of one nothing.",
        judged_by(experiment, summary.judged)
        or "A violation is a control step in which the task's own truth reports a cost, at its end or at any"
        " physics substep. The filter's own opinion does not count.",
        "Evaluation is deterministic and paired: episode i starts from the same env seed in every row.",
        "Infeasible: the filter found that no action satisfies every constraint. Fallback: the filter's own"
        " last resort acted.",
    ]
    if any(arm.filter.kind != "none" for arm in experiment.arms):
        items.append(_learners(experiment))
    if experiment.evaluation_filter.kind != "none":
        items.append(
            "“Filter on” puts an arm's own filter on; an arm that has none gets the evaluation's, or the first"
            " filtered arm's."
        )
    return "<ul>" + "".join(f"<li>{text(item)}</li>" for item in items) + "</ul>"


def _learners(experiment: ExperimentConfig) -> str:
    kinds = {arm.name: arm.learner.kind for arm in experiment.arms if arm.filter.kind != "none"}
    named = "by the names of Krasowski et al., TMLR 2023"
    if set(kinds.values()) <= {"naive"}:
        return (
            "The policies learn from the action that they proposed, not from the executed one"
            f" (“naive”, {named})."
        )
    told = ", ".join(f"{arm} {kind}" for arm, kind in kinds.items())
    return f"What filtered arms learn from, {named}: {told}. Returns never hold a penalty."


def _places(experiment: ExperimentConfig, acting: dict[str, StepLog]) -> Iterator[Picture]:
    off = dict(_logs(experiment, "filter_off"))
    for index, pair in enumerate(compared_pairs(experiment)):
        if pair.filtered.name in acting:
            yield from _pair_of_places(index, pair, acting[pair.filtered.name], off.get(pair.bare.name))


def _pair_of_places(index: int, pair: Pair, log: StepLog, bare: StepLog | None) -> Iterator[Picture]:
    if bare is not None and list(bare.coordinate_names) != list(log.coordinate_names):
        bare = None
    view = choose_view(log, bare)
    if view is None:
        yield Picture(f"Where the filter stepped in: {pair.filtered.name}", _nothing_to_place(log))
        return
    if bare is not None and bare.violated.any():
        title = f"Where violations were: {pair.bare.name}, filter off"
        yield where_picture(f"where-off-{index}", title, bare, view, "violated")
    title = f"Where the filter stepped in: {pair.filtered.name}"
    yield where_picture(f"where-on-{index}", title, log, view, "intervened")


def _nothing_to_place(log: StepLog) -> str:
    if len(log.coordinate_names) < 2:
        return "This task has fewer than two coordinates that could be read."
    if log.intervened.all():
        return f"Everywhere: all of {len(log):,} steps were changed."
    return f"Nowhere: none of {len(log):,} steps was changed."


def _logs(experiment: ExperimentConfig, condition: str) -> Iterator[tuple[str, StepLog]]:
    for arm in experiment.arms:
        found = [evaluated_steps(experiment.run_folder(arm, seed), condition) for seed in experiment.seeds]
        log = pool([steps for steps in found if steps is not None])
        if log is not None and len(log):
            yield arm.name, log


def _names(experiment: ExperimentConfig) -> list[str]:
    return [arm.name for arm in experiment.arms]
