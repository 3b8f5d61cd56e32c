"""A film shows its episode evenly, at the speed that it says, and when the filter acted."""

import io

import gymnasium as gym
import numpy as np
import pytest
from PIL import Image

from safe_wrappers import info as keys
from safe_wrappers.train import videos
from safe_wrappers.train.videos import HEIGHT, STRIP, WIDTH, film_episode


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


class Still:
    """A policy."""

    def reset(self):
        pass

    def __call__(self, observation):
        return 0


def played(env):
    """Frames and durations of the env's film, and what is said of it."""
    data, said = film_episode(Still(), env, 0)
    picture = Image.open(io.BytesIO(data))
    frames, durations = [], []
    for at in range(picture.n_frames):
        picture.seek(at)
        picture.load()
        frames.append(np.asarray(picture.convert("RGB"), dtype=int))
        durations.append(picture.info["duration"])
    return frames, durations, said


@pytest.mark.parametrize(("steps", "shown_s"), [(60, 6.0), (119, 10.0), (1000, 10.0), (7, 4.0)])
def test_the_frames_are_evenly_spaced_not_too_many_and_as_fast_as_is_said(steps, shown_s):
    frames, durations, said = played(Shot(steps))
    assert min(steps, videos.MOST_FRAMES / 2) <= len(frames) <= videos.MOST_FRAMES
    stride = -(-steps // len(frames))
    shown = [frame[HEIGHT // 2, WIDTH // 2].mean() for frame in frames]
    assert shown == pytest.approx([stride * at % 200 for at in range(len(frames))], abs=12)
    assert sum(durations) == pytest.approx(1000 * shown_s, rel=0.1)
    assert f"of {steps:,} steps 0 in violation, 0 changed. Shown {steps / 10 / shown_s:.1f} times" in said


def test_the_strip_shows_when_the_filter_acted_and_where_it_is_now():
    frames, _, said = played(Shot(80, changed=range(32, 48), violated=[64]))
    assert frames[0].shape == (HEIGHT + STRIP, WIDTH, 3) and "1 in violation, 16 changed" in said

    def strip(frame, step):
        pixel = frames[frame][HEIGHT + STRIP // 2, int((step + 0.5) * WIDTH / 80)]
        colors = {name: np.abs(pixel - color).sum() for name, color in videos._COLORS.items()}
        return min(colors, key=colors.get)

    seen = [strip(0, step) for step in (16, 33, 40, 46, 52, 64)]
    assert seen == ["bare", "changed", "changed", "changed", "bare", "violated"]
    assert strip(0, 0) == strip(24, 24) == "now" and strip(24, 40) == "changed"


def test_one_step_that_hurt_is_seen_in_a_long_episode():
    frames, *_ = played(Shot(1000, violated=[501]))
    red = frames[0][HEIGHT + STRIP // 2]
    assert ((red[:, 0] > 150) & (red[:, 1] < 90)).any()
