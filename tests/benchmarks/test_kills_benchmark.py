"""What the benchmark of kills waits for and counts."""

import json
import os
import signal
import time

import pytest

pytest.importorskip("stable_baselines3")

from benchmarks import kills


def test_a_group_is_waited_for_with_all_that_it_began(tmp_path):
    def work():
        if not os.fork():
            time.sleep(60)
        os.write(1, b"begun")
        time.sleep(60)
        return 0

    log = tmp_path / "log"
    group = kills.in_a_fork(work, log)
    while not log.exists() or "begun" not in log.read_text():
        time.sleep(0.01)
    os.killpg(group, signal.SIGKILL)
    assert kills.ended(group) == -signal.SIGKILL
    assert kills.ended(kills.in_a_fork(lambda: 3, log)) == 3
    assert kills.ended(kills.in_a_fork(lambda: 1 // 0, log)) == 70  # and does not go on as its parent
    assert "ZeroDivisionError" in log.read_text()


def test_what_a_run_leaves_is_told_apart_but_for_the_wall_clock(tmp_path):
    facts = {"timesteps": 8, "elapsed_s": 1.0, "filter_time_us": None}
    for name in ("run.json", "episodes.csv"):
        (tmp_path / name).write_text("same")
    (tmp_path / "finished.json").write_text(json.dumps(facts))
    left = kills.left_by(tmp_path)
    (tmp_path / "finished.json").write_text(json.dumps(facts | {"elapsed_s": 2.0}))
    assert kills.left_by(tmp_path) == left
    for other in ({"timesteps": 9}, {"filter_time_us": 3.0}):
        (tmp_path / "finished.json").write_text(json.dumps(facts | other))
        assert kills.left_by(tmp_path) != left


def test_the_page_counts_by_phase_and_tells_what_is_wrong():
    lost = [("training", 100, 0), ("training", 50, 0), ("checkpoint", 128, 1)]
    rounds = [
        {
            "kills": [dict(zip(("phase", "lost", "results_lost"), each, strict=True)) for each in lost],
            "wrong": [],
        },
        {"kills": [], "wrong": ["a is gone"]},
    ]
    page = kills.summary(rounds, "the command")
    assert (
        "| training | 2 | 75 | 100 | 0 |\n| checkpoint | 1 | 128 | 128 | 1 |\n| all | 3 | 93 | 128 | 1 |"
        in page
    )
    assert "3 kills in 2 comparisons; 1 of them came to an end" in page
    assert page.endswith("* a is gone\n")
