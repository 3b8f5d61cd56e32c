"""The same episode on film, every arm's policy without and with the filter: small animated WebPs.

A strip below each frame shows when the filter acted.
"""

from __future__ import annotations

import contextlib
import io
import json
import os
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final

import gymnasium as gym
import mujoco
import numpy as np
from numpy.typing import NDArray
from PIL import Image
from rich.console import Console

from safe_wrappers import info as keys
from safe_wrappers.wrappers.cbf_action_filter import filter_inside
from safe_wrappers.wrappers.safety_overlay import SafetyOverlay, find_renderer, set_size

from .config.models import ArmConfig, ExperimentConfig, FilterConfig
from .evaluation.evaluate import ShownEpisode, conditions, shown_episode
from .evaluation.step_log import is_violation
from .files import read_json, say, write_bytes, write_json
from .processes import Job, Progress, RunsFailedError, environment
from .processes.parallel import run_jobs
from .run.policy import TrainedPolicy
from .run.stack import make_env, make_stack
from .run.training import finished_checkpoint

WIDTH: Final = 480
HEIGHT: Final = 360
"""Pixels of the picture, whose width an env that MuJoCo does not draw may decide."""
STRIP: Final = 16
"""Below it, px."""
MOST_FRAMES: Final = 80
_LONGEST_S: Final = 10.0
_SHORTEST_S: Final = 4.0
_QUALITY: Final = 55
_WIDE: Final = 3  # px: half of what marks one step in the strip
_COLORS: Final = {
    "bare": (120, 128, 138),
    "changed": (240, 178, 20),
    "violated": (214, 40, 52),
    "now": (255, 255, 255),
}


@contextlib.contextmanager
def drawing_without_a_screen() -> Iterator[None]:
    """Frames are drawn as MUJOCO_GL says; where it is not set, Linux takes EGL, which needs no screen."""
    chosen = "MUJOCO_GL" in os.environ or sys.platform != "linux"
    with environment({} if chosen else {"MUJOCO_GL": "egl"}):
        yield


def why_blind(env: gym.Env[Any, Any], mode: str) -> str | None:
    """Says why an env draws nothing in a render mode: it has no such one, or MuJoCo may not; None if it draws."""
    modes = env.unwrapped.metadata.get("render_modes") or ["none"]
    if mode not in modes:
        env_id = env.spec.id if env.spec is not None else env.unwrapped
        return f"{env_id} has no render mode {mode}; it has: {', '.join(modes)}."
    if find_renderer(env) is None or hasattr(mujoco, "GLContext"):
        return None
    return f"MUJOCO_GL={os.environ.get('MUJOCO_GL')} has MuJoCo draw nothing."


def for_film(env: gym.Env[Any, Any]) -> gym.Env[Any, Any]:
    """An env of which no frame was asked yet, as films show it: the robot in sight, and what its filter does."""
    set_size(env, WIDTH, HEIGHT)
    return InSight(env if filter_inside(env) is None else SafetyOverlay(env))


class InSight(gym.Wrapper[Any, Any, Any, Any]):
    """Frames in whose middle the robot stays: the free camera follows it.

    Fixed cameras stay where they are, and so does the picture of an env that MuJoCo does not draw.
    """

    def render(self) -> Any:
        """The env's frame."""
        renderer = find_renderer(self.env)
        if renderer is not None and renderer.camera_id in (None, -1):
            viewer, model = renderer._get_viewer(str(self.render_mode)), renderer.model
            # Half of what a frame costs without a graphics card.
            viewer.scn.flags[mujoco.mjtRndFlag.mjRND_SHADOW] = 0
            if model.nu and model.actuator_trntype[0] in _BODIES:
                body = _BODIES[model.actuator_trntype[0]](model)[model.actuator_trnid[0, 0]]
                viewer.cam.type, viewer.cam.trackbodyid = _TRACKING, int(model.body_rootid[body])
        return self.env.render()


_TRACKING: Final = int(mujoco.mjtCamera.mjCAMERA_TRACKING)
_BODIES: Final = {
    int(mujoco.mjtTrn.mjTRN_JOINT): lambda model: model.jnt_bodyid,
    int(mujoco.mjtTrn.mjTRN_JOINTINPARENT): lambda model: model.jnt_bodyid,
    int(mujoco.mjtTrn.mjTRN_SITE): lambda model: model.site_bodyid,
}
"""Of what an actuator moves, the bodies."""


def film_episode(policy: TrainedPolicy, env: gym.Env[Any, Any], seed: int) -> tuple[bytes, str]:
    """Runs an episode in an env as `for_film` returns it, with a `RecordInterventions` inside, and films it.

    Returns:
        The endless animated WebP, and a sentence that says what is seen.
    """
    longest = (env.spec.max_episode_steps if env.spec is not None else None) or 1
    stride = -(-longest // MOST_FRAMES)
    frames: list[Image.Image] = []
    changed: list[bool] = []
    violated: list[bool] = []
    observation, info = env.reset(seed=seed)
    policy.reset()
    done = False
    while not done:
        if len(changed) % stride == 0:
            if len(frames) == MOST_FRAMES:  # the episode is longer than thought
                frames, stride = frames[::2], 2 * stride
            if len(changed) % stride == 0:
                frames.append(_sized(env.render()))
        observation, _, terminated, truncated, info = env.step(policy(observation))
        changed.append(bool(info.get(keys.CBF_INTERVENED, False)))
        violated.append(is_violation(info))
        done = terminated or truncated
    steps = len(changed)
    # One speed for all conditions, also where one of them ends early; it takes 4 to 10 seconds.
    real_s = max(longest, steps) / float(env.metadata.get("render_fps") or 30.0)
    shown_s = min(max(real_s, _SHORTEST_S), _LONGEST_S)
    pictures = [
        with_strip(frame, at * stride, np.array(changed), np.array(violated))
        for at, frame in enumerate(frames)
    ]
    data = encode(pictures, 1000 * stride * shown_s / max(longest, steps), _QUALITY)
    figures = info[keys.EPISODE_SUMMARY]
    hurt = f"{figures['violations']:,} in violation, " if "violations" in figures else ""
    said = (
        f"Episode {seed}, return {figures['return']:.1f}: of {steps:,} steps {hurt}{sum(changed):,} changed."
    )
    return data, f"{said} Shown {real_s / shown_s:.1f} times as fast as real."


def encode(frames: list[Image.Image], frame_ms: float, quality: int, method: int = 4) -> bytes:
    """An endless animated WebP; method 6 takes ten times as long as 4, for a third less."""
    data, how = io.BytesIO(), {"save_all": True, "loop": 0, "quality": quality, "method": method}
    frames[0].save(data, "WEBP", append_images=frames[1:], duration=max(1, round(frame_ms)), **how)
    return data.getvalue()


def _sized(pixels: Any) -> Image.Image:
    picture = Image.fromarray(np.ascontiguousarray(pixels[..., :3], dtype=np.uint8))
    return picture.resize((round(picture.width * HEIGHT / picture.height), HEIGHT), Image.Resampling.LANCZOS)


def with_strip(
    frame: Image.Image, step: int, changed: NDArray[np.bool_], violated: NDArray[np.bool_]
) -> Image.Image:
    """A frame with the strip below."""
    columns = np.arange(frame.width) * len(changed) // frame.width
    row = np.tile(np.array(_COLORS["bare"], dtype=np.uint8), (frame.width, 1))
    # One step that hurt must not be lost between two columns, nor in the coding: it is several columns wide.
    for flags, color in ((changed, "changed"), (violated, "violated")):
        hits = np.flatnonzero(flags)[:, None] * frame.width // len(flags) + np.arange(-_WIDE, _WIDE + 1)
        row[np.clip(hits, 0, frame.width - 1)] = _COLORS[color]
        row[flags[columns]] = _COLORS[color]
    now = min(frame.width - 1, step * frame.width // len(changed))
    row[max(0, now - _WIDE) : now + _WIDE + 1] = _COLORS["now"]
    whole = Image.new("RGB", (frame.width, frame.height + STRIP))
    whole.paste(frame, (0, 0))
    whole.paste(Image.fromarray(np.tile(row[None], (STRIP, 1, 1))), (0, frame.height))
    return whole


def video_path(experiment: ExperimentConfig, arm: ArmConfig, condition: str) -> Path:
    """Where a video lies; its facts are beside it, `.json`."""
    return experiment.folder / "videos" / f"{arm.name}_{condition}.webp"


def load_video(path: Path) -> tuple[bytes, str] | None:
    """Reads a video back, and the sentence that says what is seen; None if there is none."""
    facts = read_json(path.with_suffix(".json"))
    return (path.read_bytes(), facts["said"]) if facts and path.exists() else None


def record_videos(experiment: ExperimentConfig, console: Console) -> None:
    """Films the shown episode for every arm and condition that is not on film yet, if the config wants films.

    Each film is made in a process of its own, which a GL library may abort. Nothing here fails an evaluation: where
    no frame can be drawn, one line says why.
    """
    shown = shown_episode(experiment)
    if shown is None or not experiment.evaluation.films:
        return
    jobs, cannot = [], set[str]()
    for arm in experiment.arms:
        folder = experiment.run_folder(arm, shown.seed)
        with contextlib.closing(make_env(arm.env.id, arm.env.kwargs)) as env:
            blind = why_blind(env, "rgb_array")
        for condition, used in conditions(arm, experiment.evaluation_filter).items():
            path = video_path(experiment, arm, condition)
            state = _state(arm, used, shown, finished_checkpoint(arm, shown.seed, folder).timesteps)
            if read_json(path.with_suffix(".json")).get("state") == state and path.exists():
                continue
            path.unlink(missing_ok=True)  # it shows another policy or episode
            if blind is not None:
                cannot.add(f"No videos: {blind}")
                continue
            name = f"video {arm.name} {condition.replace('_', ' ')}"
            jobs.append(Job(name, 1, "episodes", record_video, (arm, shown, folder, used, path)))
    for line in cannot:
        say(console, line)
    if not jobs:
        return
    try:
        with drawing_without_a_screen():
            run_jobs(jobs, experiment.workers, console, "Videos")
    except RunsFailedError as error:
        why = str(error).strip().splitlines()[-1]
        say(console, f"No videos: filming failed: {why} MUJOCO_GL=osmesa or egl may draw without a screen.")


def record_video(
    arm: ArmConfig, shown: ShownEpisode, run_folder: Path, used: FilterConfig, path: Path, progress: Progress
) -> None:
    """Runs the shown episode and writes its film, with what a filter knows drawn into it, and its facts."""
    checkpoint = finished_checkpoint(arm, shown.seed, run_folder)
    policy = TrainedPolicy(arm, checkpoint.folder)
    with contextlib.closing(for_film(make_stack(arm.env, used, render_mode="rgb_array"))) as env:
        animation, said = film_episode(policy, env, shown.episode_seed)
    write_bytes(path, animation)
    state = _state(arm, used, shown, checkpoint.timesteps)
    write_json(path.with_suffix(".json"), {"state": state, "said": said})
    progress.steps(1)


def _state(arm: ArmConfig, used: FilterConfig, shown: ShownEpisode, timesteps: int) -> dict[str, Any]:
    """Whose film of what it is, as JSON gives it back."""
    state = {"arm": arm.fingerprint(), "filter": used.plain(), "shown": shown[:2], "timesteps": timesteps}
    found: dict[str, Any] = json.loads(json.dumps(state))
    return found
