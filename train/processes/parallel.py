"""Runs in parallel processes; none of them outlives this one."""

from __future__ import annotations

import multiprocessing
import os
import signal
import time
import traceback
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from multiprocessing import resource_tracker
from multiprocessing.connection import Connection, wait
from multiprocessing.context import SpawnProcess
from typing import Any, Final

from rich.console import Console

from safe_wrappers.errors import SafeWrappersError

from .output import lasting_output
from .parent import end_with_parent
from .progress_display import ProgressDisplay
from .stopping import Interrupted, RunStoppedError, stop_request

Message = tuple[str, Any]
_POLL_S: Final = 0.2
_SAVE_S: Final = 60.0
"""How long stopped jobs may take: a rollout, its update and a checkpoint with a large replay buffer."""


@dataclass(frozen=True)
class Progress:
    """Where a job reports to: its steps so far, lines that a person should read, and figures by their names."""

    steps: Callable[[int], None]
    say: Callable[[str], None]
    figures: Callable[[Mapping[str, str]], None] = lambda _: None


@dataclass(frozen=True)
class Job:
    """One process's work: `call(*arguments, progress)`; both must pickle."""

    name: str
    total: int
    unit: str
    call: Callable[..., None]
    arguments: tuple[Any, ...]


class RunsFailedError(SafeWrappersError):
    """Some runs of an experiment failed; the others were brought to their end.

    Attributes:
        names: Of the jobs that failed.
    """

    def __init__(self, message: str, names: Iterable[str] = ()) -> None:
        super().__init__(message)
        self.names = frozenset(names)


def run_jobs(
    jobs: Sequence[Job],
    workers: int | None,
    console: Console,
    title: str,
    before: int = 0,
    later: int = 0,
    unwanted: Callable[[str], bool] = lambda _: False,
) -> None:
    """Runs jobs in parallel, spawned processes, one BLAS and torch thread each.

    A job that fails does not stop the others. If this process is killed, the jobs' processes end by
    themselves: nobody goes on writing into the folders. SIGINT, SIGTERM and SIGHUP, where they are not ignored, stop
    the jobs by SIGTERM and wait for at most a minute, in which runs save checkpoints; a second one does not wait.

    Args:
        jobs: The work.
        workers: Processes at a time; None for one per core that this process may use.
        console: Where progress, messages and failures are shown.
        title: What is going on.
        before: Units of jobs that went before, which count as done.
        later: Units of jobs that will come after these, which are still to do.
        unwanted: Asked often, by a job's name, whether nobody needs it any more: it is stopped like by a signal, or not
            begun, and that is no failure.

    Raises:
        RunsFailedError: At least one job failed; holds all their messages.
        Interrupted: A signal stopped the jobs; none of their processes is left.
    """
    at_once = min(workers or _cores(), len(jobs))
    waiting = list(jobs)
    running: dict[Connection, tuple[Job, SpawnProcess]] = {}
    failures: dict[str, str] = {}
    given_up: set[str] = set()
    stopped_at: float | None = None
    totals = {job.name: job.total for job in jobs}
    unit = jobs[0].unit if jobs else ""
    with (
        stop_request() as request,
        ProgressDisplay(title, unit, totals, console, before=before, later=later) as display,
        # Read by the BLAS libraries when the spawned process loads them; more threads would only fight for cores.
        environment(dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")),
    ):
        try:
            while running or (waiting and not request.signum):
                while waiting and len(running) < at_once and not request.signum:
                    job = waiting.pop(0)
                    if unwanted(job.name):
                        display.end(job.name, "stopped")
                        continue
                    connection, process = _start(job)
                    running[connection] = (job, process)
                    display.start(job.name)
                for ready in wait(list(running), _POLL_S):
                    assert isinstance(ready, Connection)
                    job, process = running[ready]
                    message = _receive(ready)
                    if message is None:
                        del running[ready]
                        process.join()
                        how = "failed" if job.name in failures else "done"
                        if process.exitcode != 0 and how == "done":
                            how = "stopped" if request.signum or job.name in given_up else "failed"
                        if how == "failed":
                            failures.setdefault(job.name, _death(process.exitcode))
                        display.end(job.name, how)
                    elif message[0] == "steps":
                        display.steps(job.name, message[1])
                    elif message[0] == "figures":
                        display.figures(job.name, message[1])
                    elif message[0] == "say":
                        display.say(f"{job.name}: {message[1]}")
                    else:
                        failures[job.name] = message[1]
                display.tick()
                for job, process in running.values():
                    if job.name not in given_up and unwanted(job.name):
                        given_up.add(job.name)
                        process.terminate()
                if request.signum and stopped_at is None:
                    stopped_at = time.monotonic()
                    display.say(f"Stopping, for at most {_SAVE_S:.0f} s; another signal stops at once.")
                    for _, process in running.values():
                        process.terminate()
                if stopped_at is not None and (request.at_once or time.monotonic() - stopped_at > _SAVE_S):
                    break
        finally:
            for _, process in running.values():
                process.kill()
                process.join()
    texts = "\n".join(f"{name}: {text}" for name, text in failures.items())
    if request.signum:
        if failures:
            console.print(texts, highlight=False, markup=False, soft_wrap=True)
        raise Interrupted(request.signum)
    if failures:
        raise RunsFailedError(f"{title}: {len(failures)} of {len(jobs)} failed.\n{texts}", failures)


def _cores() -> int:
    if hasattr(os, "sched_getaffinity"):  # in a container fewer than the machine has; not on macOS
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def _start(job: Job) -> tuple[Connection, SpawnProcess]:
    context = multiprocessing.get_context("spawn")
    receiver, sender = context.Pipe(duplex=False)
    # Not a daemon: those may not have processes, and a run's envs may (`vec_env: subproc`). It ends with this one.
    process = context.Process(target=_work, args=(job, sender))
    # A terminal sends these to every process in it; this one's answer is enough. Blocked, not ignored, from the new
    # process's first instruction on. The tracker is started before: its own start would unblock them.
    resource_tracker.ensure_running()
    blocked = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT, signal.SIGHUP})
    try:
        process.start()
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, blocked)
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
    end_with_parent()
    progress = Progress(
        steps=lambda steps: sender.send(("steps", steps)),
        say=lambda text: sender.send(("say", text)),
        figures=lambda figures: sender.send(("figures", figures)),
    )
    with lasting_output():
        try:
            job.call(*job.arguments, progress)
        except RunStoppedError as stop:
            progress.say(str(stop))
            os._exit(128 + signal.SIGTERM)  # all is saved, and taking torch down can take seconds
        except SafeWrappersError as error:
            sender.send(("failed", str(error)))
        except Exception:  # whatever a task or a hyperparameter can do wrong: shown, and the other runs go on
            sender.send(("failed", traceback.format_exc()))


@contextmanager
def environment(variables: Mapping[str, str]) -> Iterator[None]:
    """Environment variables for the processes that are started inside."""
    before = {name: os.environ.get(name) for name in variables}
    os.environ.update(variables)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value
