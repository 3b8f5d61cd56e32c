"""Runs in parallel processes, with a bar for each; none of them outlives this one."""

from __future__ import annotations

import multiprocessing
import os
import signal
import sys
import time
import traceback
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from multiprocessing.connection import Connection, wait
from multiprocessing.context import SpawnProcess
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, Progress, TaskID, TextColumn, TimeRemainingColumn

from safe_wrappers.errors import SafeWrappersError

from .parent import end_with_parent
from .run import Progress as RunProgress

Message = tuple[str, Any]


@dataclass(frozen=True)
class Job:
    """One process's work: `call(*arguments, progress)`; both must pickle."""

    name: str
    total: int
    unit: str
    call: Callable[..., None]
    arguments: tuple[Any, ...]


class RunsFailedError(SafeWrappersError):
    """Some runs of an experiment failed; the others were brought to their end."""


def run_jobs(jobs: Sequence[Job], workers: int | None, console: Console, title: str) -> None:
    """Runs jobs in parallel, spawned processes, one BLAS and torch thread each.

    A job that fails does not stop the others. If this process is killed, the jobs' processes end by
    themselves: nobody goes on writing into the folders.

    Args:
        jobs: The work.
        workers: Processes at a time; None for one per core that this process may use.
        console: Where bars, messages and failures are shown.
        title: What is going on, for the failure message.

    Raises:
        RunsFailedError: At least one job failed; holds all their messages.
    """
    at_once = min(workers or _cores(), len(jobs))
    waiting = list(jobs)
    running: dict[Connection, tuple[Job, SpawnProcess]] = {}
    failures: dict[str, str] = {}
    with _Bars(console) as bars, _one_thread_each():
        try:
            while waiting or running:
                while waiting and len(running) < at_once:
                    job = waiting.pop(0)
                    connection, process = _start(job)
                    running[connection] = (job, process)
                    bars.start(job)
                for ready in wait(list(running)):
                    assert isinstance(ready, Connection)
                    job, process = running[ready]
                    message = _receive(ready)
                    if message is None:
                        del running[ready]
                        process.join()
                        if process.exitcode != 0 and job.name not in failures:
                            failures[job.name] = _death(process.exitcode)
                        bars.end(job, failed=job.name in failures)
                    elif message[0] == "steps":
                        bars.steps(job, message[1])
                    elif message[0] == "say":
                        console.print(f"[yellow]{job.name}:[/yellow] {message[1]}", highlight=False)
                    else:
                        failures[job.name] = message[1]
        finally:
            for _, process in running.values():
                process.terminate()
    if failures:
        texts = "\n".join(f"{name}: {text}" for name, text in failures.items())
        raise RunsFailedError(f"{title}: {len(failures)} of {len(jobs)} failed.\n{texts}")


def _cores() -> int:
    if hasattr(os, "sched_getaffinity"):  # in a container fewer than the machine has; not on macOS
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def _start(job: Job) -> tuple[Connection, SpawnProcess]:
    context = multiprocessing.get_context("spawn")
    receiver, sender = context.Pipe(duplex=False)
    # Not a daemon: those may not have processes, and a run's envs may (`vec_env: subproc`). It ends with this one.
    process = context.Process(target=_work, args=(job, sender))
    process.start()
    sender.close()  # so that the process's end is the pipe's end
    return receiver, process


def _receive(connection: Connection) -> Message | None:
    try:
        message: Message = connection.recv()
    except (EOFError, ConnectionResetError):
        return None
    return message


def _death(exitcode: int | None) -> str:
    return (
        f"its process ended with exit code {exitcode} (killed, or out of memory?). The same command goes on"
        " from its last checkpoint."
    )


def _work(job: Job, sender: Connection) -> None:
    import torch

    torch.set_num_threads(1)
    # Ctrl-C goes to every process of the terminal; the parent's answer is enough.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    end_with_parent()
    progress = RunProgress(
        steps=lambda steps: sender.send(("steps", steps)), say=lambda text: sender.send(("say", text))
    )
    try:
        job.call(*job.arguments, progress)
    except SafeWrappersError as error:
        sender.send(("failed", str(error)))
    except Exception:  # whatever a task or a hyperparameter can do wrong: shown, and the other runs go on
        sender.send(("failed", traceback.format_exc()))


@contextmanager
def _one_thread_each() -> Iterator[None]:
    # Read by the BLAS libraries when the spawned process loads them; more threads would only fight for cores.
    names = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
    before: Mapping[str, str | None] = {name: os.environ.get(name) for name in names}
    os.environ.update(dict.fromkeys(names, "1"))
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


class _Bars:
    """A bar per job on a terminal; in a file or a pipe, a line at each start and end."""

    def __init__(self, console: Console) -> None:
        self._console = console
        self._progress = Progress(
            TextColumn("{task.description}"),
            BarColumn(bar_width=None),
            TextColumn("{task.completed:.0f}/{task.total:.0f} {task.fields[unit]}"),
            TextColumn("{task.fields[speed]}"),
            TimeRemainingColumn(compact=True),
            console=console,
            disable=not console.is_terminal,
        )
        self._tasks: dict[str, TaskID] = {}
        self._begun: dict[str, tuple[float, int]] = {}
        self._speed: dict[str, float] = {}

    def __enter__(self) -> _Bars:
        self._progress.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._progress.stop()

    def start(self, job: Job) -> None:
        self._tasks[job.name] = self._progress.add_task(job.name, total=job.total, unit=job.unit, speed="")
        if not self._console.is_terminal:
            self._console.print(f"{job.name}: started ({job.total} {job.unit})", highlight=False)

    def steps(self, job: Job, steps: int) -> None:
        now = time.monotonic()
        since, first = self._begun.setdefault(job.name, (now, steps))
        if now > since:
            self._speed[job.name] = (steps - first) / (now - since)
        speed = f"{self._speed[job.name]:.0f} {job.unit}/s" if job.name in self._speed else ""
        self._progress.update(self._tasks[job.name], completed=steps, speed=speed)

    def end(self, job: Job, failed: bool) -> None:
        if self._console.is_terminal:
            mark = "[red]failed[/red]" if failed else "[green]done[/green]"
            self._progress.update(self._tasks[job.name], description=f"{job.name} {mark}")
        else:
            speed = f", {self._speed[job.name]:.0f} {job.unit}/s" if job.name in self._speed else ""
            self._console.print(f"{job.name}: {'failed' if failed else 'done'}{speed}", highlight=False)
        sys.stdout.flush()
