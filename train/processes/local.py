"""Jobs in spawned processes of this machine; none of them outlives this one."""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
from collections.abc import Iterator
from concurrent.futures import Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from typing import Any

from . import Job, Message, work

_here: dict[str, Any] = {}
"""In a job's process: the queue of its messages, and the event that stops it."""


class LocalWorkers:
    """An executor of one process for each job: one that is killed, or runs out of memory, takes no other with it.

    Args:
        at_once: How many; None for one per core that this process may use.
    """

    def __init__(self, at_once: int | None) -> None:
        # A container may have fewer than the machine; macOS does not tell.
        cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
        self.at_once = at_once or cores
        self._running: dict[Future[str], tuple[Job, ProcessPoolExecutor, Any, Any]] = {}

    def start(self, job: Job) -> None:
        """Begins a job."""
        context = multiprocessing.get_context("spawn")
        queue, stop = context.SimpleQueue(), context.Event()
        pool = ProcessPoolExecutor(1, context, _begin, (queue, stop))
        self._running[pool.submit(_work, job)] = job, pool, queue, stop

    def messages(self, timeout_s: float) -> Iterator[tuple[str, Message]]:
        """What jobs have to say, by their names; waits for an end, for at most so long."""
        ended = wait(self._running, timeout_s, "FIRST_COMPLETED").done if self._running else set()
        for future, (job, pool, queue, _) in list(self._running.items()):
            while not queue.empty():
                yield job.name, queue.get()
            if future in ended:
                del self._running[future]
                pool.shutdown(wait=False)  # taking torch down can take seconds
                yield job.name, ("end", _told(future))

    def stop(self, name: str) -> None:
        """Asks a job to save and end."""
        for job, _, _, stop in self._running.values():
            if job.name == name:
                stop.set()

    def kill(self) -> None:
        """Ends all jobs at once."""
        if self._running:
            for child in multiprocessing.active_children():
                child.kill()
        for _, pool, _, _ in self._running.values():
            pool.shutdown()


def _told(future: Future[str]) -> str:
    try:
        return future.result()
    except BrokenProcessPool:
        return "its process was killed (out of memory?). The same command goes on from its last checkpoint."


def _begin(queue: Any, stop: Any) -> None:
    """In a job's process, before all else."""
    _here.update(queue=queue, stop=stop)
    # A terminal, or a machine that goes down, sends these to every process; the first one's answer is enough.
    for which in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(which, signal.SIG_IGN)
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    assert parent is not None
    parent.join()
    os._exit(1)


def _work(job: Job) -> str:
    return work(job, _here["queue"].put, _here["stop"].is_set)
