"""Jobs in spawned processes of this machine; none of them outlives this one."""

from __future__ import annotations

import multiprocessing
import os
import signal
import traceback
from collections.abc import Iterator
from multiprocessing import resource_tracker
from multiprocessing.connection import Connection, wait
from multiprocessing.context import SpawnProcess

from safe_wrappers.errors import SafeWrappersError

from .job import Job, Message, Progress
from .output import lasting_output
from .parent import end_with_parent
from .stopping import RunStoppedError


class LocalWorkers:
    """Processes, one torch thread each.

    Args:
        at_once: How many; None for one per core that this process may use.
    """

    def __init__(self, at_once: int | None) -> None:
        self.at_once = at_once or _cores()
        self._running: dict[Connection, tuple[Job, SpawnProcess]] = {}

    def start(self, job: Job) -> None:
        """Begins a job."""
        connection, process = _start(job)
        self._running[connection] = (job, process)

    def messages(self, timeout_s: float) -> Iterator[tuple[str, Message]]:
        """What jobs have to say, by their names; waits for the first of it, for at most so long."""
        for ready in wait(list(self._running), timeout_s):
            assert isinstance(ready, Connection)
            job, process = self._running[ready]
            message = _receive(ready)
            if message is None:
                del self._running[ready]
                process.join()
                message = ("end", _death(process.exitcode) if process.exitcode else "")
            yield job.name, message

    def stop(self, name: str) -> None:
        """Asks a job to save and end."""
        for job, process in self._running.values():
            if job.name == name:
                process.terminate()

    def kill(self) -> None:
        """Ends all jobs at once."""
        for _, process in self._running.values():
            process.kill()
            process.join()


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
