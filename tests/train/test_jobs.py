"""Jobs side by side: what is shown of them, how they fail, and signals."""

import io
import multiprocessing
import os
import signal

import fake_task
import pytest
from rich.console import Console

from safe_wrappers.train.processes import Interrupted, Job
from safe_wrappers.train.processes.parallel import RunsFailedError, _noted_signals, run_jobs


def job(name, call, *arguments):
    return Job(name, 100, "steps", call, arguments)


def test_lines_in_a_file_and_failures_among_others():
    jobs = [
        job("good", fake_task.count, 10),
        job("bad", fake_task.fail),
        job("worse", fake_task.crash),
        job("gone", fake_task.vanish),
    ]
    text = io.StringIO()
    with pytest.raises(RunsFailedError) as failure:
        run_jobs(jobs, 1, Console(file=text, width=100), "Counting")
    assert failure.value.names == {"bad", "worse", "gone"}
    first, refused, *trace = str(failure.value).strip().splitlines()
    assert (first, refused) == ("Counting: 3 of 4 failed.", "bad: too hot")
    assert trace[0].startswith("worse: Traceback")
    assert "ValueError: nobody expected this" in trace
    assert trace[-1].startswith("gone: its process was killed")
    lines = [line for line in text.getvalue().splitlines() if not line.startswith("  ")]
    assert lines == [
        "good: started (100 steps)",
        "good: a line to read",
        "good: done",
        "bad: started (100 steps)",
        "bad: failed",
        "worse: started (100 steps)",
        "worse: failed",
        "gone: started (100 steps)",
        "gone: failed",
    ]


class Signals(io.StringIO):
    """SIGTERM comes when a job tells that it works, and when it tells what it has heard."""

    def write(self, text):
        if any(f": {word}" in text for word in ("working", "goes on")):
            os.kill(os.getpid(), signal.SIGTERM)
        return super().write(text)


def test_a_signal_asks_jobs_to_stop_and_the_rest_do_not_begin():
    text = Signals()
    jobs = [job("waits", fake_task.until_stopped), job("unwanted", fake_task.fail)]
    with pytest.raises(Interrupted) as stopped:
        run_jobs(jobs, 1, Console(file=text, width=100), "Waiting")
    assert stopped.value.signum == signal.SIGTERM
    assert "waits: stopped" in text.getvalue()
    assert "unwanted" not in text.getvalue()


def test_a_second_signal_waits_for_nobody():
    text = Signals()
    with pytest.raises(Interrupted):
        run_jobs([job("deaf", fake_task.never_stopped)], 1, Console(file=text, width=100), "Waiting")
    assert "deaf: goes on" in text.getvalue() and "deaf: stopped" not in text.getvalue()
    assert not multiprocessing.active_children()


def test_what_is_ignored_stays_ignored_and_all_is_put_back():
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        with _noted_signals() as noted:
            os.kill(os.getpid(), signal.SIGHUP)
            assert not noted
            os.kill(os.getpid(), signal.SIGTERM)
            os.kill(os.getpid(), signal.SIGTERM)  # at once: of one sender
            assert noted == [signal.SIGTERM]
        assert signal.getsignal(signal.SIGHUP) is signal.SIG_IGN
        assert signal.getsignal(signal.SIGTERM) is signal.SIG_DFL
    finally:
        signal.signal(signal.SIGHUP, before)
