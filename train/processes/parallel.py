"""Runs in parallel processes; none of them outlives this one."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Final

from rich.console import Console

from safe_wrappers.errors import SafeWrappersError

from .job import Job, Workers
from .local import LocalWorkers
from .progress_display import ProgressDisplay
from .stopping import Interrupted, stop_request

_POLL_S: Final = 0.2
_SAVE_S: Final = 60.0
"""How long stopped jobs may take: a rollout, its update and a checkpoint with a large replay buffer."""


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
    on: str | None = None,
) -> None:
    """Runs jobs in parallel, each in a process of its own with one BLAS and torch thread.

    A job that fails does not stop the others. If this process is killed, the jobs' processes end by
    themselves: nobody goes on writing into the folders. SIGINT, SIGTERM and SIGHUP, where they are not ignored, stop
    the jobs by SIGTERM and wait for at most a minute, in which runs save checkpoints; a second one does not wait.

    Args:
        jobs: The work.
        workers: Processes at a time; None for one per core that this process may use, or that the cluster has.
        console: Where progress, messages and failures are shown.
        title: What is going on.
        before: Units of jobs that went before, which count as done.
        later: Units of jobs that will come after these, which are still to do.
        unwanted: Asked often, by a job's name, whether nobody needs it any more: it is stopped like by a signal,
            or not begun, and that is no failure.
        on: Where: None for this machine, or `ray` or `ray:ADDRESS`.

    Raises:
        RunsFailedError: At least one job failed; holds all their messages.
        Interrupted: A signal stopped the jobs; none of their processes is left.
    """
    waiting = list(jobs)
    running: set[str] = set()
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
        _workers(on, workers) as place,
    ):
        while running or (waiting and not request.signum):
            while waiting and len(running) < place.at_once and not request.signum:
                job = waiting.pop(0)
                if unwanted(job.name):
                    display.end(job.name, "stopped")
                    continue
                place.start(job)
                running.add(job.name)
                display.start(job.name)
            for name, (kind, told) in place.messages(_POLL_S):
                if kind == "end":
                    running.remove(name)
                    how = "failed" if name in failures else "done"
                    if told and how == "done":
                        how = "stopped" if request.signum or name in given_up else "failed"
                    if how == "failed":
                        failures.setdefault(name, told)
                    display.end(name, how)
                elif kind == "steps":
                    display.steps(name, told)
                elif kind == "figures":
                    display.figures(name, told)
                elif kind == "say":
                    display.say(f"{name}: {told}")
                else:
                    failures[name] = told
            display.tick()
            for name in running - given_up:
                if unwanted(name):
                    given_up.add(name)
                    place.stop(name)
            if request.signum and stopped_at is None:
                stopped_at = time.monotonic()
                display.say(f"Stopping, for at most {_SAVE_S:.0f} s; another signal stops at once.")
                for name in running:
                    place.stop(name)
            if stopped_at is not None and (request.at_once or time.monotonic() - stopped_at > _SAVE_S):
                break
    texts = "\n".join(f"{name}: {text}" for name, text in failures.items())
    if request.signum:
        if failures:
            console.print(texts, highlight=False, markup=False, soft_wrap=True)
        raise Interrupted(request.signum)
    if failures:
        raise RunsFailedError(f"{title}: {len(failures)} of {len(jobs)} failed.\n{texts}", failures)


@contextmanager
def _workers(on: str | None, at_once: int | None) -> Iterator[Workers]:
    """Where jobs run; none of them is left afterwards."""
    place: Workers
    if on is None:
        place = LocalWorkers(at_once)
    else:
        from .on_ray import RayWorkers

        place = RayWorkers(on, at_once)
    try:
        yield place
    finally:
        place.kill()


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
