"""Jobs side by side, on this machine and on a Ray cluster: what is shown of them, how they fail, and signals."""

import io
import multiprocessing
import os
import re
import signal
import threading
import time

import fake_task
import pytest
from rich.console import Console
from running import episodes, finish
from stable_baselines3.common.save_util import load_from_zip_file

from safe_wrappers.train.experiment import evaluate_experiment, train_experiment
from safe_wrappers.train.processes import Interrupted, Job, work
from safe_wrappers.train.processes.parallel import RunsFailedError, run_jobs


def job(name, call, *arguments):
    return Job(name, 100, "steps", call, arguments)


def test_side_by_side_lines_in_a_file_and_a_failure_beside_others(tmp_path):
    text, left = io.StringIO(), tmp_path / "pid"
    jobs = [job("gone", fake_task.vanish, left), job("good", fake_task.count, 10)]
    with pytest.raises(RunsFailedError) as failure:
        run_jobs(jobs, 2, Console(file=text, width=100), "Counting")
    os.kill(int(left.read_text()), signal.SIGKILL)  # what the killed job began was not waited for
    assert failure.value.names == {"gone"}
    assert str(failure.value).startswith("Counting: 1 of 2 failed.\ngone: its process was killed")
    begun, lines = text.getvalue().splitlines()[:2], text.getvalue().splitlines()[2:]
    assert begun == ["gone: started (100 steps)", "good: started (100 steps)"]
    lines.remove("gone: failed")
    assert lines == ["good: a line to read", "good: done"]


def test_a_refusal_is_a_line_and_a_mistake_its_traceback():
    told = {
        call.__name__: work(job("", call), pytest.fail, bool) for call in (fake_task.fail, fake_task.crash)
    }
    assert told["fail"] == "too hot"
    assert re.match(r"Traceback(.|\n)*ValueError: nobody expected this", told["crash"])


class Signals(io.StringIO):
    """SIGTERM comes when a job tells that it works, and when it tells what it has heard."""

    def write(self, text):
        if any(f": {word}" in text for word in ("working", "goes on")):
            os.kill(os.getpid(), signal.SIGHUP)  # ignored
            for _ in range(2):  # at once: of one sender
                os.kill(os.getpid(), signal.SIGTERM)
        return super().write(text)


@pytest.fixture
def interrupted():
    """What was said of jobs that `Signals` interrupted."""
    text, before = Signals(), signal.signal(signal.SIGHUP, signal.SIG_IGN)

    def run(*jobs):
        with pytest.raises(Interrupted) as stopped:
            run_jobs(jobs, 1, Console(file=text, width=100), "Waiting")
        assert stopped.value.signum == signal.SIGTERM
        assert signal.getsignal(signal.SIGHUP) is signal.SIG_IGN  # stays ignored, and the others are put back
        assert signal.getsignal(signal.SIGTERM) is signal.SIG_DFL
        return text.getvalue()

    yield run
    signal.signal(signal.SIGHUP, before)


def test_a_signal_asks_jobs_to_stop_and_the_rest_do_not_begin(interrupted):
    said = interrupted(job("waits", fake_task.until_stopped), job("unwanted", fake_task.fail))
    assert "waits: stopped" in said and "unwanted" not in said


def test_a_second_signal_waits_for_nobody(interrupted):
    said = interrupted(job("deaf", fake_task.never_stopped))
    assert "deaf: goes on" in said and "deaf: stopped" not in said
    assert not multiprocessing.active_children()


# A Ray cluster of two nodes on this machine ------------------------------------------------------------------------


@pytest.fixture
def cluster():
    """A head that runs no tasks, and two nodes of one CPU."""
    ray = pytest.importorskip("ray", reason="ray is not installed: pip install 'safe-wrappers[ray]'")
    from ray.cluster_utils import Cluster

    memory = 100 * 1024**2
    made = Cluster(initialize_head=True, head_node_args={"num_cpus": 0, "object_store_memory": memory})
    try:
        nodes = [made.add_node(num_cpus=1, object_store_memory=memory) for _ in range(2)]
        ray.init(address=made.address, log_to_driver=False, logging_level="ERROR")
        made.wait_for_nodes()
        yield made, nodes
    finally:
        ray.shutdown()
        made.shutdown()


def console():
    return Console(file=io.StringIO(), width=100)


def learned(experiment):
    """All that was learned and what it came to, of every run."""
    found = {}
    for arm in experiment.arms:
        folder = experiment.run_folder(arm, 0)
        weights = load_from_zip_file(folder / "policy" / "model.zip")[1]["policy"]["action_net.weight"]
        tables = [folder / "episodes.csv", folder / "evaluation" / "filter_on.csv"]
        found[arm.name] = weights.tolist(), [table.read_text() for table in tables]
    return found


@pytest.mark.slow
def test_a_cluster_learns_what_one_machine_learns_bit_for_bit(cluster, fake_experiment, tmp_path):
    there = fake_experiment("seeds=[0]", "workers=2", f"output={tmp_path}/there")
    here = fake_experiment("seeds=[0]", "workers=2", f"output={tmp_path}/here")
    for experiment, on in ((there, "ray"), (here, None)):
        train_experiment(experiment, console(), on)
        evaluate_experiment(experiment, console(), on)
    assert learned(there) == learned(here)


@pytest.mark.slow
def test_a_node_is_lost_and_its_run_goes_on_from_its_checkpoint_elsewhere(cluster, fake_experiment):
    made, nodes = cluster
    experiment = fake_experiment("total_steps=8192", "checkpoint_every=256", "seeds=[0]")
    folders = [experiment.run_folder(arm, 0) for arm in experiment.arms]
    kept = {}

    def lose_a_node():
        end = time.monotonic() + 240.0
        while not all(list(folder.glob("checkpoints/step_*/state.json")) for folder in folders):
            if time.monotonic() > end:
                return  # nothing is kept: the test fails
            time.sleep(0.1)
        for folder in folders:
            at = max(int(path.name[5:]) for path in folder.glob("checkpoints/step_*"))
            kept[folder] = [row for row in episodes(folder) if row["timesteps"] <= at]
        made.remove_node(nodes[0], allow_graceful=False)

    loses = threading.Thread(target=lose_a_node, daemon=True)
    loses.start()
    train_experiment(experiment, console(), "ray")
    loses.join()
    assert set(kept) == set(folders)
    for folder in folders:
        assert finish(folder)["timesteps"] == 8192
        rows = episodes(folder)
        assert kept[folder] and rows[: len(kept[folder])] == kept[folder]  # nothing done is done again
        assert sum(row["length"] for row in rows) <= 8192


def test_failures_and_messages_come_back(cluster):
    jobs = [job("good", fake_task.count, 10), job("bad", fake_task.fail)]
    told = console()
    with pytest.raises(RunsFailedError, match="bad: too hot"):
        run_jobs(jobs, 2, told, "Counting", on="ray")
    assert "good: a line to read" in told.file.getvalue()
    assert "good: done" in told.file.getvalue()
