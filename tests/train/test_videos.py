"""Films: of the episode that was evaluated, evenly, as fast as they say, with robot and filter in sight."""

import io
import os
from types import SimpleNamespace
from unittest.mock import Mock

import gymnasium as gym
import mujoco
import numpy as np
import pytest
from PIL import Image
from rich.console import Console
from running import SILENT, evaluated, trained

import safe_wrappers  # noqa: F401  (registers its envs)
from safe_wrappers import info as keys
from safe_wrappers.plants.env_checks import wrappers_of
from safe_wrappers.train import videos
from safe_wrappers.train.evaluation.evaluate import shown_episode
from safe_wrappers.train.evaluation.step_log import load_steps
from safe_wrappers.train.files import read_rows
from safe_wrappers.train.processes.parallel import RunsFailedError
from safe_wrappers.train.videos import HEIGHT, STRIP, WIDTH, film_episode, for_film, load_video, video_path
from safe_wrappers.wrappers.safety_overlay import find_renderer


def frames_of(data):
    """A film's frames and how long each is shown, ms."""
    picture = Image.open(io.BytesIO(data))
    frames, durations = [], []
    for at in range(picture.n_frames):
        picture.seek(at)
        picture.load()
        frames.append(np.asarray(picture.convert("RGB"), dtype=int))
        durations.append(picture.info["duration"])
    return frames, durations


@pytest.fixture
def inline(monkeypatch):
    """Jobs run in this process, without GL; returns their names as they come."""
    names = []

    def run(jobs, workers, console, title):
        for job in jobs:
            names.append(job.name)
            job.call(*job.arguments, SILENT)

    monkeypatch.setattr(videos, "run_jobs", run)
    monkeypatch.setenv("MUJOCO_GL", "disabled")  # the task paints its frames blue under EGL
    return names


def said(experiment):
    console = Console(file=io.StringIO(), width=400)
    videos.record_videos(experiment, console)
    return console.file.getvalue()


def taken(names):
    """The films that were made since it was last asked."""
    made = sorted(names)
    names.clear()
    return made


EVERY = [f"video {arm} filter {state}" for arm in ("filtered", "unfiltered") for state in ("off", "on")]


def test_every_arm_is_filmed_in_the_very_episode_that_was_evaluated(finished, inline, monkeypatch):
    def fake_filter(env):
        return next((inner for inner in wrappers_of(env) if type(inner).__name__ == "FakeFilter"), None)

    monkeypatch.setattr(videos, "filter_inside", fake_filter)
    experiment = finished()
    assert said(experiment) == "" and taken(inline) == EVERY
    seed, total = shown_episode(experiment).episode_seed, 0
    for arm in experiment.arms:
        folder, lower = experiment.run_folder(arm, 0), []
        for condition in ("filter_off", "filter_on"):
            animation, told = load_video(video_path(experiment, arm, condition))
            rows = read_rows(folder / "evaluation" / f"{condition}.csv")
            log = load_steps(folder / "evaluation" / f"{condition}_steps.npz")
            (row,) = [row for row in rows if row["episode_seed"] == seed]
            count = round(row.get("intervention_rate", 0) * row["length"])
            of_steps = f"of {row['length']:.0f} steps {row['violations']:.0f} in violation, {count} changed."
            assert told.startswith(f"Episode {seed}, return {row['return']:.1f}: {of_steps}")
            assert told.endswith("Shown 0.5 times as fast as real.")  # 20 steps at 10 a second: 2 s in 4
            total += count
            frames, _ = frames_of(animation)
            dot = np.argwhere(frames[0][:HEIGHT, :, 0] - frames[0][:HEIGHT, :, 1] > 100).mean(axis=0)[::-1]
            # Where this episode starts, to half a pixel of the task's.
            start = log.coordinates[log.episode_seed == seed][0, :2] * (20, 15) + (40, 30)
            assert dot == pytest.approx((start.astype(int) + 0.5) * HEIGHT / 60, abs=4)
            assert len(frames) == 20 and frames[19][10, 10] == pytest.approx([5 * 19] * 3, abs=6)
            lower.append(frames[19][348:356, 225:260].mean())
        # What a filter did is drawn into its film, and into no other.
        assert lower == pytest.approx([5 * 19, 43], abs=8)
    assert total > 0


def test_films_are_made_once_and_again_for_another_episode(finished, inline, monkeypatch):
    experiment = finished()
    for expected in (EVERY, []):
        said(experiment)
        assert taken(inline) == expected
    video_path(experiment, experiment.arms[0], "filter_on").unlink()
    said(experiment)
    assert taken(inline) == ["video unfiltered filter on"]

    def evaluate(again):
        for arm in (0, 1):
            evaluated(again, arm)
        return again

    said(evaluate(finished("evaluation.seed=500", "seeds=[0]")))
    assert taken(inline) == EVERY

    def crash(jobs, workers, console, title):  # which does not fail the evaluation
        raise RunsFailedError("Videos: 1 of 4 failed.\nvideo: its process was killed")

    monkeypatch.setattr(videos, "run_jobs", crash)
    assert said(evaluate(experiment)).startswith("No videos: filming failed: video: its process was killed")
    # Films of another episode are gone even where none can be made.
    assert load_video(video_path(experiment, experiment.arms[0], "filter_off")) is None


def test_where_nothing_can_be_drawn_one_line_says_so_and_nothing_is_tried(finished, inline, monkeypatch):
    experiment = finished()
    monkeypatch.setattr(videos, "find_renderer", lambda env: object())
    monkeypatch.delattr("mujoco.GLContext", raising=False)
    assert said(experiment) == "No videos: MUJOCO_GL=disabled has MuJoCo draw nothing.\n"
    monkeypatch.setattr(videos, "make_env", lambda *_: gym.make("fake_task:FakeGoal-v0"))
    assert "FakeGoal-v0 has no render mode rgb_array; it has: none." in said(experiment)
    assert said(finished("evaluation.films=false")) == "" and taken(inline) == []


@pytest.mark.slow
def test_in_processes_of_its_own_without_a_screen(fake_experiment, monkeypatch):
    experiment = fake_experiment(
        "env=fake_task:FilmedGoal-v0", "arms={unfiltered: {filter: none}}", "seeds=[0]"
    )
    trained(experiment, 0)
    evaluated(experiment, 0)
    monkeypatch.delenv("MUJOCO_GL", raising=False)
    assert "video unfiltered filter off: done" in said(experiment)
    animation, _ = load_video(video_path(experiment, experiment.arms[0], "filter_off"))
    pixel = frames_of(animation)[0][0][10, 10]
    assert pixel[2] > 200 > 50 > pixel[0]  # black, but for the blue of a process without a screen
    assert "MUJOCO_GL" not in os.environ


# One film ---------------------------------------------------------------------------------------------------------


class Shot(gym.Env):
    """Frames as bright as their step's number; the filter acts and the task is hurt at chosen steps."""

    metadata = {"render_modes": ["rgb_array"], "render_fps": 10}  # noqa: RUF012

    def __init__(self, steps, changed=(), violated=()):
        self.steps, self.changed, self.violated = steps, changed, violated

    def reset(self, *, seed=None, options=None):
        self.at = 0
        return 0, {}

    def render(self):
        return np.full((60, 80, 3), self.at % 200, np.uint8)

    def step(self, action):
        info = {keys.CBF_INTERVENED: self.at in self.changed, keys.COST: float(self.at in self.violated)}
        info[keys.EPISODE_SUMMARY] = {"return": 1.0, "violations": len(self.violated)}
        self.at += 1
        return 0, 0.0, False, self.at >= self.steps, info


def played(env):
    """Frames and durations of the env's film, and what is said of it."""
    still = Mock(return_value=0)  # a policy
    data, told = film_episode(still, env, 0)
    return *frames_of(data), told


@pytest.mark.parametrize(("steps", "shown_s"), [(1000, 10.0), (7, 4.0)])
def test_the_frames_are_evenly_spaced_not_too_many_and_as_fast_as_is_said(steps, shown_s):
    frames, durations, told = played(Shot(steps, violated=[501]))
    assert min(steps, videos.MOST_FRAMES / 2) <= len(frames) <= videos.MOST_FRAMES
    stride = -(-steps // len(frames))
    shown = [frame[HEIGHT // 2, WIDTH // 2].mean() for frame in frames]
    assert shown == pytest.approx([stride * at % 200 for at in range(len(frames))], abs=12)
    assert sum(durations) == pytest.approx(1000 * shown_s, rel=0.1)
    assert f"of {steps:,} steps" in told and f"Shown {steps / 10 / shown_s:.1f} times" in told
    # One step that hurt is seen in a long episode.
    red = frames[0][HEIGHT + STRIP // 2]
    assert ((red[:, 0] > 150) & (red[:, 1] < 90)).any() == (steps == 1000)


def test_the_strip_shows_when_the_filter_acted_and_where_it_is_now():
    frames, _, told = played(Shot(80, changed=range(32, 48), violated=[64]))
    assert frames[0].shape == (HEIGHT + STRIP, WIDTH, 3) and "1 in violation, 16 changed" in told

    def strip(frame, step):
        red, green, blue = frames[frame][HEIGHT + STRIP // 2, int((step + 0.5) * WIDTH / 80)]
        if min(red, green, blue) > 200:
            return "now"
        return "violated" if red > green + 120 else "changed" if red > blue + 120 else "bare"

    seen = [strip(0, step) for step in (16, 33, 40, 46, 52, 64)]
    assert seen == ["bare", "changed", "changed", "changed", "bare", "violated"]
    assert strip(0, 0) == strip(24, 24) == "now" and strip(24, 40) == "changed"
    few = played(Shot(7, changed=[3]))[0][0][HEIGHT + STRIP // 2]
    assert (few[:, 0] > few[:, 2] + 120).sum() == pytest.approx(WIDTH / 7, abs=8)  # as long as the step


# The robot is in the middle of the picture, wherever it goes --------------------------------------------------------

ROBOTS = {
    "SafePointGoal1-v0": "agent",
    "SafeRover-v0": "rover",
    "PatrolledPointMaze-v0": "particle",
    "SafeHalfCheetahVelocity-v0": "torso",
}


@pytest.mark.parametrize("env_id", ROBOTS)
def test_the_camera_follows_the_robot(env_id, monkeypatch):
    if "Maze" in env_id:
        pytest.importorskip("gymnasium_robotics")
    env = for_film(gym.make(env_id, render_mode="rgb_array"))
    renderer, camera = find_renderer(env), mujoco.MjvCamera()
    viewer = SimpleNamespace(cam=camera, scn=mujoco.MjvScene(renderer.model, 1000), add_marker=Mock())
    black = np.zeros((renderer.height, renderer.width, 3), dtype=np.uint8)
    monkeypatch.setattr(renderer, "_get_viewer", lambda mode: viewer)  # without GL
    monkeypatch.setattr(renderer, "render", lambda mode: black)
    env.reset(seed=0)
    env.render()
    assert camera.type == mujoco.mjtCamera.mjCAMERA_TRACKING
    assert renderer.model.body(camera.trackbodyid).name == ROBOTS[env_id]
    env.close()
