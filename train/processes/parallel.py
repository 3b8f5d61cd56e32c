"""run_jobs: jobs side by side, what they tell, and their end at a signal."""

from __future__ import annotations

import signal
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from typing import Any, Final

from rich.console import Console
from rich.progress import Progress, TaskID, TextColumn

from . import STOPPED, Interrupted, Job, RunsFailedError, environment
from .local import LocalWorkers

_POLL_S: Final = 0.2
_LINES_S: Final = 30.0
_SAVE_S: Final = 60.0
"""How long stopped jobs may take: a rollout, its update and a checkpoint with a large replay buffer."""


def run_jobs(
    jobs: Sequence[Job],
    workers: int | None,
    console: Console,
    title: str,
    unwanted: Callable[[str], bool] = lambda _: False,
    on: str | None = None,
) -> None:
    """Runs jobs in parallel, each in a process of its own with one BLAS and torch thread.

    A job that fails does not stop the others. If this process is killed, the jobs' processes end by themselves.
    SIGINT, SIGTERM and SIGHUP, where they are not ignored, ask the jobs to stop and wait for at most a minute, in
    which runs save checkpoints; a second one does not wait.

    Args:
        jobs: The work.
        workers: Processes at a time; None for one per core that this process may use, or that the cluster has.
        console: Where progress, messages and failures are shown.
        title: What is going on.
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
    asked: set[str] = set()
    wait_until = float("inf")
    with ExitStack() as stack:
        signals = stack.enter_context(_noted_signals())
        # Read by the BLAS libraries when the spawned process loads them; more threads would only fight for cores.
        one = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")
        stack.enter_context(environment(one))
        place = _workers(on, workers)
        stack.callback(place.kill)
        shown = _Shown(console)
        stack.enter_context(shown.bars)
        while running or (waiting and not signals):
            while waiting and len(running) < place.at_once and not signals:
                job = waiting.pop(0)
                if not unwanted(job.name):
                    place.start(job)
                    running.add(job.name)
                    shown.start(job)
            for name, (kind, told) in place.messages(_POLL_S):
                if kind == "end":
                    running.remove(name)
                    if told not in ("", STOPPED):
                        failures[name] = told
                    shown.end(name, "failed" if name in failures else told or "done")
                elif kind == "say":
                    shown.say(f"{name}: {told}")
                else:
                    shown.update(name, kind, told)
            shown.tick()
            if signals and wait_until == float("inf"):
                wait_until = time.monotonic() + _SAVE_S
                shown.say(f"Stopping, for at most {_SAVE_S:.0f} s; another signal stops at once.")
            for name in {name for name in running - asked if signals or unwanted(name)}:
                asked.add(name)
                place.stop(name)
            if len(signals) > 1 or time.monotonic() > wait_until:
                break
    texts = "\n".join(f"{name}: {text}" for name, text in failures.items())
    if signals:
        console.print(texts, highlight=False, markup=False, soft_wrap=True)
        raise Interrupted(signals[0])
    if failures:
        raise RunsFailedError(f"{title}: {len(failures)} of {len(jobs)} failed.\n{texts}", failures)


def _workers(on: str | None, at_once: int | None) -> Any:
    if on is None:
        return LocalWorkers(at_once)
    from .on_ray import RayWorkers

    return RayWorkers(on, at_once)


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


class _Shown:
    """A bar for each running job on a terminal; now and then a line for each in a file or a pipe."""

    def __init__(self, console: Console) -> None:
        columns = (*Progress.get_default_columns(), TextColumn("{task.fields[figures]}"))
        self.bars = Progress(*columns, console=console, transient=True, disable=not console.is_terminal)
        self._tasks: dict[str, TaskID] = {}
        self._said_at = time.monotonic()

    def start(self, job: Job) -> None:
        self._tasks[job.name] = self.bars.add_task(job.name, total=job.total, figures="")
        if not self.bars.console.is_terminal:
            self.say(f"{job.name}: started ({job.total:,} {job.unit})")

    def update(self, name: str, kind: str, told: Any) -> None:
        """A job's `steps` or `figures`."""
        figures = {} if kind == "steps" else {"figures": ", ".join(f"{key} {told[key]}" for key in told)}
        self.bars.update(self._tasks[name], completed=told if kind == "steps" else None, **figures)

    def end(self, name: str, how: str) -> None:
        self.bars.remove_task(self._tasks.pop(name))
        self.say(f"{name}: {how}")

    def say(self, text: str) -> None:
        self.bars.console.print(text, soft_wrap=True, highlight=False, markup=False)

    def tick(self) -> None:
        """To be called often."""
        if not self.bars.console.is_terminal and time.monotonic() - self._said_at > _LINES_S:
            self._said_at = time.monotonic()
            for task in self.bars.tasks:
                self.say(f"  {task.description}: {task.percentage:.0f} % {task.fields['figures']}".rstrip())
