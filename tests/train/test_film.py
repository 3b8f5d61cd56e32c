import io

import numpy as np
import pytest
from PIL import Image

from safe_wrappers.train.videos import film
from safe_wrappers.train.videos.film import (
    HEIGHT,
    STRIP,
    TITLE,
    WIDTH,
    Film,
    encode,
)


def shot(steps, changed=(), violated=(), stride=1):
    """A film whose frames are as bright as their step's number."""
    made = Film(stride)
    for step in range(steps):
        if made.wants_frame:
            made.add_frame(np.full((60, 80, 3), step % 200, np.uint8))
        made.changed.append(step in changed)
        made.violated.append(step in violated)
    return made


def played(data):
    picture = Image.open(io.BytesIO(data))
    frames, durations = [], []
    for at in range(picture.n_frames):
        picture.seek(at)
        picture.load()
        frames.append(np.asarray(picture.convert("RGB"), dtype=int))
        durations.append(picture.info["duration"])
    return frames, durations


@pytest.mark.parametrize(("steps", "stride"), [(119, 1), (1000, 1), (1000, 10), (2000, 9)])
def test_the_frames_are_evenly_spaced_and_not_too_many(steps, stride):
    made = shot(steps, stride=stride)
    assert film.MOST_FRAMES / 2 < len(made.frames) <= film.MOST_FRAMES
    shown = [frame.getpixel((0, 0))[0] for frame in made.frames]
    assert shown == [step % 200 for step in range(0, steps, made.stride)]


def test_the_playing_time_is_what_the_speed_says():
    made = shot(1000, stride=20)
    _, durations = played(encode([made], 100.0))
    assert sum(durations) == pytest.approx(10_000, rel=0.05)


def test_the_strip_shows_when_the_filter_acted_and_where_it_is_now():
    made = shot(100, changed=range(40, 60), violated=[80])
    frames, _ = played(encode([made], 10.0))
    width = WIDTH
    assert frames[0].shape == (TITLE + HEIGHT + STRIP, width, 3)

    def strip(frame, step):
        pixel = frames[frame][TITLE + HEIGHT + STRIP // 2, int((step + 0.5) * width / 100)]
        colors = {name: np.abs(pixel - color).sum() for name, color in film._COLORS.items()}
        return min(colors, key=colors.get)

    assert [strip(0, step) for step in (20, 41, 50, 58, 65, 80)] == [
        *("bare", "changed", "changed", "changed", "bare", "violated"),
    ]
    assert strip(0, 0) == strip(30, 30) == "now"
    assert strip(30, 50) == "changed"
    assert (
        frames[0][: TITLE + HEIGHT].mean() < frames[60][: TITLE + HEIGHT].mean()
    )  # the picture above goes on


def test_one_step_that_hurt_is_seen_in_a_long_episode():
    made = shot(1000, violated=[501], stride=50)
    frames, _ = played(encode([made], 100.0))
    red = frames[0][TITLE + HEIGHT + STRIP // 2]
    assert ((red[:, 0] > 150) & (red[:, 1] < 90)).any()


def test_a_film_that_is_too_large_loses_every_other_frame(monkeypatch):
    rng = np.random.default_rng(0)
    made = Film(1)
    for _ in range(16):
        made.add_frame(rng.integers(0, 255, (240, 320, 3), dtype=np.uint8))
        made.changed.append(False)
        made.violated.append(False)
    monkeypatch.setattr(film, "MOST_BYTES", 100_000_000)
    whole = encode([made], 10.0)
    monkeypatch.setattr(film, "MOST_BYTES", int(0.3 * len(whole)))
    small = encode([made], 10.0)
    assert len(small) <= 0.3 * len(whole)
    (frames, durations), (_, before) = played(small), played(whole)
    assert len(frames) == 4
    assert sum(durations) == pytest.approx(sum(before))  # as long as before


def test_episodes_are_side_by_side_and_the_shorter_one_waits_at_its_end():
    long, short = shot(60), shot(20)
    long.title = short.title = "an episode"
    frames, _ = played(encode([long, short], 10.0))
    assert len(frames) == 60
    height = film.TITLE + HEIGHT + STRIP
    assert frames[0].shape[0] == height and frames[0].shape[1] > 2 * WIDTH
    middle = film.TITLE + HEIGHT // 2
    seen = [frame[middle, [WIDTH // 2, -WIDTH // 2]].mean(axis=-1) for frame in frames]
    assert seen[15] == pytest.approx([15, 15], abs=4)
    assert seen[50] == pytest.approx([50, 19], abs=4)
    assert np.ptp(frames[0][: film.TITLE]) > 150  # words on paper
