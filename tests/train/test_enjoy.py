"""safe-wrappers enjoy: a trained policy acts, in its filter or in another, and is filmed."""

import io
import re

import numpy as np
import pytest
from PIL import Image
from test_run import Reports

from safe_wrappers.train.cli import main
from safe_wrappers.train.run.training import train_run
from safe_wrappers.train.videos import HEIGHT, STRIP, WIDTH

LINE = r"episode (\d): return -?[\d.]+, 20 steps, (\d+) in violation"


@pytest.fixture
def run(fake_experiment, tmp_path):
    """The folder of a run on the filmed task."""
    arm = fake_experiment("total_steps=128", "env=fake_task:FilmedGoal-v0").arms[1]
    train_run(arm, 0, tmp_path / "seed_0", Reports().progress)
    return tmp_path / "seed_0"


def test_it_prints_a_line_per_episode(run, capsys):
    assert main(["enjoy", str(run)]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert [re.fullmatch(LINE + r", [\d.]+ % changed", line)[1] for line in lines[:3]] == ["0", "1", "2"]
    assert (
        lines[3].startswith("filtered, filter trained, mean of 3 episodes: return ")
        and " 60 steps, " in lines[3]
    )
    assert main(["enjoy", str(run), "--episodes", "1", "--filter", "none"]) == 0
    line, _ = capsys.readouterr().out.splitlines()
    assert re.fullmatch(LINE, line), "without a filter nothing is changed, and nothing is said of it"


def test_it_films_a_typical_episode_and_names_the_file(run, tmp_path, capsys):
    film = tmp_path / "deep" / "film.webp"
    assert main(["enjoy", str(run), "--episodes", "3", "--output", str(film)]) == 0
    out = capsys.readouterr().out
    returns = [float(value) for value in re.findall(r"episode \d: return (-?[\d.]+)", out)]
    assert f"Film: {film}. Episode {np.argsort(returns, kind='stable')[1]}, return" in out
    picture = Image.open(io.BytesIO(film.read_bytes()))
    assert picture.n_frames == 20 and picture.size == (WIDTH, HEIGHT + STRIP)


def test_what_cannot_be_drawn_is_refused(run, tmp_path, capsys):
    assert main(["enjoy", str(run), "--render"]) == 1
    assert "has no render mode human; it has: rgb_array" in capsys.readouterr().err
    assert main(["enjoy", str(tmp_path)]) == 1
    assert "is no run's folder" in capsys.readouterr().err
