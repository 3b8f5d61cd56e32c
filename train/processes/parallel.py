"""run_jobs: jobs side by side in spawned processes, what they tell, and their end at a signal."""

from __future__ import annotations

import multiprocessing
import os
import pickle
import signal
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from multiprocessing.connection import Connection, wait
from multiprocessing.context import SpawnProcess
from typing import Any, Final

from rich.console import Console
from rich.progress import Progress, TaskID

from ..files import say
from . import ONE_THREAD, STOPPED, Interrupted, Job, Message, RunsFailedError, environment, work

_POLL_S: Final = 0.2
_KILLED: Final = "its process was killed (out of memory?). The same command goes on from its last checkpoint."
_SAVE_S: Final = 60.0
"""How long stopped jobs may take: a rollout, its update and a checkpoint with a large replay buffer."""


def run_jobs(
    jobs: Sequence[Job],
    workers: int | None,
    console: Console,
    title: str,
    on: str | None = None,
) -> None:
    """Runs jobs in parallel, each in a process of its own with one BLAS, torch and XLA thread.

    A job that fails does not stop the others. If this process is killed, the jobs' processes end by themselves.
    SIGINT, SIGTERM and SIGHUP, where they are not ignored, ask the jobs to stop and wait for at most a minute, in
    which runs save checkpoints; a second one does not wait. `workers` is how many at a time, None for one per core of
    this process or of the cluster; `on` is None for this machine, or `ray` or `ray:ADDRESS`.

    Raises:
        RunsFailedError: At least one job failed; holds all their messages.
        Interrupted: A signal stopped the jobs; none of their processes is left.
    """
    waiting = list(jobs)
    running: dict[str, TaskID] = {}
    failures: dict[str, str] = {}
    wait_until = float("inf")
    with ExitStack() as stack:
        signals = stack.enter_context(_noted_signals())
        stack.enter_context(environment(ONE_THREAD))
        place: Any = LocalWorkers(workers)
        if on is not None:
            from .on_ray import RayWorkers

            place = RayWorkers(on, workers)
        stack.callback(place.kill)
        # A bar for each running job on a terminal; lines at its begin and end in a file or a pipe.
        bars = Progress(console=console, transient=True, disable=not console.is_terminal)
        stack.enter_context(bars)
        while running or (waiting and not signals):
            while waiting and len(running) < place.at_once and not signals:
                job = waiting.pop(0)
                place.start(job)
                running[job.name] = bars.add_task(job.name, total=job.total)
                if not console.is_terminal:
                    say(console, f"{job.name}: started ({job.total:,} {job.unit})")
            for name, (kind, told) in place.messages(_POLL_S):
                if kind == "end":
                    bars.remove_task(running.pop(name))
                    if told not in ("", STOPPED):
                        failures[name] = told
                    say(console, f"{name}: {'failed' if name in failures else told or 'done'}")
                elif kind == "say":
                    say(console, f"{name}: {told}")
                else:
                    bars.update(running[name], completed=told)
            if signals and wait_until == float("inf"):
                wait_until = time.monotonic() + _SAVE_S
                say(console, f"Stopping, for at most {_SAVE_S:.0f} s; another signal stops at once.")
                for name in running:
                    place.stop(name)
            if len(signals) > 1 or time.monotonic() > wait_until:
                break
    texts = "\n".join(f"{name}: {text}" for name, text in failures.items())
    if signals:
        say(console, texts)
        raise Interrupted(signals[0])
    if failures:
        raise RunsFailedError(f"{title}: {len(failures)} of {len(jobs)} failed.\n{texts}", failures)


@contextmanager
def _noted_signals() -> Iterator[list[int]]:
    """In this block signals that would end the process are noted instead; those that it ignores stay ignored."""
    noted: list[int] = []
    main = threading.current_thread() is threading.main_thread()  # no other thread may set handlers
    ending = [signal.SIGINT, signal.SIGTERM, signal.SIGHUP] if main else []
    first = 0.0

    def note(signum: int, _: object) -> None:
        nonlocal first
        # `timeout` and many a launcher send to a process and to its group: together they are one.
        if not noted or time.monotonic() - first > 0.5:
            noted.append(signum)
        first = first or time.monotonic()

    heeded = [which for which in ending if signal.getsignal(which) is not signal.SIG_IGN]
    before = {which: signal.signal(which, note) for which in heeded}
    try:
        yield noted
    finally:
        for which, handler in before.items():
            signal.signal(which, signal.SIG_DFL if handler is None else handler)


class LocalWorkers:
    """A process for each job: one that is killed, or runs out of memory, takes no other with it."""

    def __init__(self, at_once: int | None) -> None:
        # A container may have fewer than the machine; macOS does not tell.
        cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
        self.at_once = at_once or cores
        self._running: dict[Connection, tuple[Job, SpawnProcess, Any]] = {}

    def start(self, job: Job) -> None:
        """Begins a job."""
        context = multiprocessing.get_context("spawn")
        stop, (messages, told) = context.Event(), context.Pipe(duplex=False)
        process = context.Process(target=_work, args=(pickle.dumps(job), told, stop))
        process.start()
        told.close()  # the job's process alone has it now: its end is seen here
        self._running[messages] = job, process, stop

    def messages(self, timeout_s: float) -> Iterator[tuple[str, Message]]:
        """What jobs have to say, by their names; waits for a message, for at most so long."""
        wait(list(self._running), timeout_s)
        for messages, (job, process, _) in list(self._running.items()):
            alive = process.is_alive()  # asked first, as the last message may come in between
            message: Message = "end", _KILLED  # also where a process that the job began holds the pipe open
            if messages.poll():
                with suppress(EOFError, OSError):
                    message = messages.recv()
            elif alive:
                continue
            if message[0] == "end":  # not waited for: taking torch down can take seconds
                del self._running[messages]
            yield job.name, message

    def stop(self, name: str) -> None:
        """Asks a job to save and end."""
        for job, _, stop in self._running.values():
            if job.name == name:
                stop.set()

    def kill(self) -> None:
        """Ends all jobs at once."""
        for _, process, _ in self._running.values():
            process.kill()
            process.join()


def _work(pickled: bytes, told: Connection, stop: Any) -> None:
    """A job's process; what the job needs is imported when signals are dealt with."""
    # A terminal, or a machine that goes down, sends these to every process; the first one's answer is enough.
    for which in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(which, signal.SIG_IGN)
    threading.Thread(target=_end_with_parent, daemon=True).start()
    told.send(("end", work(pickle.loads(pickled), told.send, stop.is_set)))


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    assert parent is not None
    parent.join()
    os._exit(1)
