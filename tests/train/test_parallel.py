import io

import fake_task
import pytest
from rich.console import Console

from safe_wrappers.train.processes import Job, progress_display
from safe_wrappers.train.processes.parallel import RunsFailedError, run_jobs


def run(jobs, terminal, workers=2):
    text = io.StringIO()
    console = Console(file=text, force_terminal=terminal, width=100, color_system=None)
    try:
        run_jobs(jobs, workers, console, "Counting")
    finally:
        shown = text.getvalue()
    return shown


def job(name, call, *arguments):
    return Job(name, 100, "steps", call, arguments)


def test_a_terminal_shows_a_table_with_speed_and_messages():
    shown = run([job("first", fake_task.count, 100)], terminal=True)
    assert "first: done, " in shown
    assert "100 %" in shown
    assert "steps/s" in shown
    assert "first: a line to read" in shown


def test_lines_in_a_file_and_one_failure_among_others(monkeypatch):
    monkeypatch.setattr(
        progress_display, "_EVERY_S", float("inf")
    )  # only what happens, on a slow machine too
    jobs = [job("good", fake_task.count, 10), job("bad", fake_task.fail), job("worse", fake_task.crash)]
    text = io.StringIO()
    with pytest.raises(RunsFailedError) as failure:
        run_jobs(jobs, 1, Console(file=text, width=100), "Counting")
    first, refused, *trace = str(failure.value).strip().splitlines()
    assert (first, refused) == ("Counting: 2 of 3 failed.", "bad: too hot")
    assert trace[0].startswith("worse: Traceback")
    assert trace[-1] == "ValueError: nobody expected this"
    assert [line.split(",")[0] for line in text.getvalue().splitlines()] == [
        "good: started (100 steps)",
        "good: a line to read",
        "good: done",
        "bad: started (100 steps)",
        "bad: failed",
        "worse: started (100 steps)",
        "worse: failed",
    ]
