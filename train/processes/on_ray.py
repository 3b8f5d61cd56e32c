"""Jobs as tasks of a Ray cluster; all its nodes see the same folders."""

from __future__ import annotations

import importlib.util
import os
import pickle
import sys
import time
from collections.abc import Iterator
from typing import Any, Final

from safe_wrappers.errors import ConfigurationError

from . import ONE_THREAD, Job, Message, work

RETRIES: Final = 10
"""Nodes that one job may lose."""
_ASK_S: Final = 1.0


def check_place(on: str | None) -> None:
    """Refuses a place where nothing can run."""
    if on is None:
        return
    if on.partition(":")[0] != "ray" or on == "ray:":
        raise ConfigurationError(f"--on: expected ray or ray:ADDRESS, such as ray:10.0.0.1:6379, got {on!r}.")
    if importlib.util.find_spec("ray") is None:
        raise ConfigurationError("ray is not installed: pip install 'safe-wrappers[ray]'")


class RayWorkers:
    """Tasks of one CPU each, every one in a fresh process; they end with this process.

    A task whose node or process is lost is begun again elsewhere, where a run goes on from its last checkpoint.

    Args:
        on: `ray`: the cluster that this machine is part of, or a new one of this machine alone; or `ray:ADDRESS`.
        at_once: How many; None for one per CPU of the cluster.

    Raises:
        ConfigurationError: There is no cluster at that address.
    """

    def __init__(self, on: str, at_once: int | None) -> None:
        check_place(on)
        import ray
        from ray.util.scheduling_strategies import NodeAffinitySchedulingStrategy

        self._ray = ray
        self._mine = not ray.is_initialized()
        if self._mine:
            address = on.partition(":")[2] or None
            try:
                ray.init(address=address, log_to_driver=False, logging_level="ERROR")
            except ConnectionError as error:
                raise ConfigurationError(f"--on {on}: {error}") from None
        self.at_once = at_once or max(1, int(ray.cluster_resources().get("CPU", 1)))
        # Beside this process: a node that is lost takes no message with it.
        here = NodeAffinitySchedulingStrategy(ray.get_runtime_context().get_node_id(), soft=False)
        self._post = ray.remote(_Post).options(num_cpus=0, scheduling_strategy=here).remote()
        # A fresh process for each, as on one machine: nothing of one run is left for the next.
        self._task = ray.remote(num_cpus=1, max_retries=RETRIES, max_calls=1)(_work)
        self._running: dict[Any, str] = {}

    def start(self, job: Job) -> None:
        """Begins a job."""
        own = [os.path.abspath(path) for path in sys.path]
        reference = self._task.remote(pickle.dumps(job), job.name, own, os.getcwd(), self._post)
        self._running[reference] = job.name

    def messages(self, timeout_s: float) -> Iterator[tuple[str, Message]]:
        """What jobs have to say, by their names; waits for an end, for at most so long."""
        if not self._running:
            return
        ready, _ = self._ray.wait(list(self._running), num_returns=len(self._running), timeout=timeout_s)
        yield from self._ray.get(self._post.take.remote())
        for reference in ready:
            try:
                told = self._ray.get(reference)
            except self._ray.exceptions.RayError as error:
                told = f"its process was lost: {error} The same command goes on from its last checkpoint."
            yield self._running.pop(reference), ("end", told)

    def stop(self, name: str) -> None:
        """Asks a job to save and end; one that still waits for a CPU does so when it begins."""
        self._post.stop.remote(name)

    def kill(self) -> None:
        """Ends all jobs at once."""
        for reference in self._running:
            self._ray.cancel(reference, force=True)
        self._ray.kill(self._post)
        if self._mine:
            self._ray.shutdown()


class _Post:
    """What jobs say, until it is taken; and which of them are to stop. An actor."""

    def __init__(self) -> None:
        self._said: list[tuple[str, Message]] = []
        self._stopped: set[str] = set()

    def put(self, name: str, message: Message) -> None:
        self._said.append((name, message))

    def take(self) -> list[tuple[str, Message]]:
        taken, self._said = self._said, []
        return taken

    def stop(self, name: str) -> None:
        self._stopped.add(name)

    def is_stopped(self, name: str) -> bool:
        return name in self._stopped


def _work(pickled: bytes, name: str, path: list[str], folder: str, post: Any) -> str:
    """A task: does a job; returns what stopped it, "" for nothing."""
    import ray

    sys.path.extend(entry for entry in path if entry not in sys.path)
    os.chdir(folder)
    os.environ.update(
        ONE_THREAD
    )  # for processes that it starts, and XLA; of the others Ray gave this one its own
    asked, stopped = 0.0, False

    def stopping() -> bool:
        nonlocal asked, stopped
        if not stopped and time.monotonic() - asked > _ASK_S:
            stopped = ray.get(post.is_stopped.remote(name))
            asked = time.monotonic()
        return stopped

    # In their order, and before the end.
    return work(pickle.loads(pickled), lambda message: ray.get(post.put.remote(name, message)), stopping)
