import io
import os
import shutil

import numpy as np
import pytest
from PIL import Image
from rich.console import Console

from safe_wrappers.plants.env_checks import wrappers_of
from safe_wrappers.train import videos
from safe_wrappers.train.evaluation.evaluate import (
    evaluate_run,
    evaluated_steps,
    evaluation_folder,
    shown_episode,
)
from safe_wrappers.train.files import read_rows
from safe_wrappers.train.processes.parallel import RunsFailedError
from safe_wrappers.train.run import Progress, train_run
from safe_wrappers.train.videos import HEIGHT, load_video, record_videos, video_path

SILENT = Progress(lambda steps: None, pytest.fail)
ENV = "env=fake_task:FilmedGoal-v0"


@pytest.fixture(scope="module")
def kept(tmp_path_factory):
    """Where the experiment without overrides is kept, once it has been trained."""
    return tmp_path_factory.mktemp("evaluated") / "experiment"


@pytest.fixture
def evaluated(fake_experiment, kept):
    """The fake experiment with a task that draws frames, trained and evaluated, one seed."""

    def make(*overrides):
        experiment = fake_experiment(ENV, "seeds=[0]", "normalize.observation=false", *overrides)
        if not overrides and kept.exists():
            shutil.copytree(kept, experiment.folder)
            return experiment
        for arm in experiment.arms:
            folder = experiment.run_folder(arm, 0)
            train_run(arm, 0, folder, SILENT)
            evaluate_run(arm, 0, folder, experiment.evaluation, experiment.evaluation_filter, SILENT)
        if not overrides:
            shutil.copytree(experiment.folder, kept)
        return experiment

    return make


@pytest.fixture
def inline(monkeypatch):
    """Jobs run in this process, without GL; returns their names as they come."""
    names = []

    def run(jobs, workers, console, title):
        for job in jobs:
            names.append(job.name)
            job.call(*job.arguments, SILENT)

    monkeypatch.setattr(videos, "run_jobs", run)
    return names


def said(experiment):
    console = Console(file=io.StringIO(), width=400)
    record_videos(experiment, console)
    return console.file.getvalue()


def test_every_arm_is_filmed_in_the_same_episode_with_the_filter_off_and_on(evaluated, inline, monkeypatch):
    monkeypatch.setenv("MUJOCO_GL", "disabled")  # the task paints its frames blue under EGL
    experiment = evaluated("arms.filtered.filter.kwargs.margin=0.6")  # so wide that it acts at once
    assert said(experiment) == ""
    shown = shown_episode(experiment)
    changed = 0
    assert sorted(inline) == [
        f"video {arm} filter {state}" for arm in ("filtered", "unfiltered") for state in ("off", "on")
    ]
    for arm in experiment.arms:
        for condition in ("filter_off", "filter_on"):
            animation, said_of = load_video(video_path(experiment, arm, condition))
            rows = read_rows(evaluation_folder(experiment.run_folder(arm, 0)) / f"{condition}.csv")
            frames = Image.open(io.BytesIO(animation))
            log = evaluated_steps(experiment.run_folder(arm, 0), condition)
            seed = shown.episode_seed
            (row,) = [row for row in rows if row["episode_seed"] == seed]
            # The film is of the very episode that was evaluated.
            count = round(row.get("intervention_rate", 0) * row["length"])
            told = f"of {row['length']:.0f} steps {row['violations']:.0f} in violation, {count} changed."
            assert said_of.startswith(f"Episode {seed}, return {row['return']:.1f}: {told}")
            assert said_of.endswith("Shown 0.5 times as fast as real.")  # 20 steps at 10 a second: 2 s in 4
            changed += count
            pixels = np.asarray(frames.convert("RGB"), dtype=int)[:HEIGHT]
            dot = np.argwhere(pixels[..., 0] - pixels[..., 1] > 100).mean(axis=0)[::-1]
            # Where this episode starts, to half a pixel of the task's.
            start = log.coordinates[log.episode_seed == seed][0, :2] * (20, 15) + (40, 30)
            assert dot == pytest.approx((start.astype(int) + 0.5) * HEIGHT / 60, abs=4)
            assert frames.n_frames == 20
            frames.seek(19)
            background = np.asarray(frames.convert("RGB"), dtype=int)[10, 10]
            assert background == pytest.approx([5 * 19] * 3, abs=6)
    assert changed > 0


def test_a_film_is_made_once_and_again_for_another_episode(evaluated, inline):
    experiment = evaluated()
    said(experiment)
    inline.clear()
    said(experiment)
    assert inline == []
    video_path(experiment, experiment.arms[0], "filter_on").unlink()
    said(experiment)
    assert inline == ["video unfiltered filter on"]
    inline.clear()
    said(evaluated("evaluation.seed=500"))
    assert len(inline) == 4


def test_a_task_without_frames_is_not_asked_for_any(evaluated, inline):
    experiment = evaluated("env=fake_task:FakeGoal-v0")
    line = "fake_task:FakeGoal-v0 draws no frames (it has no render mode rgb_array)."
    assert said(experiment) == f"No videos: {line}\n"
    assert inline == []


def test_where_mujoco_may_not_draw_one_line_says_so_and_nothing_is_tried(evaluated, inline, monkeypatch):
    experiment = evaluated()
    monkeypatch.setattr(videos, "find_renderer", lambda env: object())
    monkeypatch.delattr("mujoco.GLContext", raising=False)
    monkeypatch.setenv("MUJOCO_GL", "disabled")
    assert said(experiment) == "No videos: MUJOCO_GL=disabled has MuJoCo draw nothing.\n"
    assert inline == []


def test_a_crash_while_filming_does_not_fail_the_evaluation(evaluated, inline, monkeypatch):
    experiment = evaluated()
    said(experiment)

    def crash(jobs, workers, console, title):
        raise RunsFailedError("Videos: 1 of 4 failed.\nvideo: its process was killed")

    monkeypatch.setattr(videos, "run_jobs", crash)
    again = evaluated("evaluation.seed=500")
    assert said(again).startswith("No videos: filming failed: video: its process was killed")
    # Films of another episode are gone even where none can be made.
    assert load_video(video_path(again, again.arms[0], "filter_off")) is None


@pytest.mark.slow
def test_in_processes_of_its_own_without_a_screen(evaluated, monkeypatch):
    experiment = evaluated("arms={unfiltered: {filter: none}}")
    monkeypatch.delenv("MUJOCO_GL", raising=False)
    assert "video unfiltered filter off: done" in said(experiment)
    animation, _ = load_video(video_path(experiment, experiment.arms[0], "filter_off"))
    pixel = np.asarray(Image.open(io.BytesIO(animation)).convert("RGB"))[10, 10]
    assert pixel[2] > 200 > 50 > pixel[0]  # black, but for the blue of a process without a screen
    assert "MUJOCO_GL" not in os.environ


def test_what_a_filter_knows_is_drawn_into_its_film_and_into_no_other(evaluated, inline, monkeypatch):
    def fake_filter(env):
        return next((inner for inner in wrappers_of(env) if type(inner).__name__ == "FakeFilter"), None)

    monkeypatch.setattr(videos, "filter_inside", fake_filter)
    experiment = evaluated()
    said(experiment)
    for arm in experiment.arms:
        lower = {}
        for condition in ("filter_off", "filter_on"):
            animation, _ = load_video(video_path(experiment, arm, condition))
            frames = Image.open(io.BytesIO(animation))
            frames.seek(19)
            lower[condition] = np.asarray(frames.convert("RGB"))[
                290:320, 225:260
            ].mean()  # of the lowest fifth
        assert lower["filter_on"] < 0.5 * lower["filter_off"]
