"""Jobs in parallel processes: what runs elsewhere, what it reports, how it ends. `parallel.run_jobs` runs them."""

from __future__ import annotations

import os
import traceback
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, Final

from safe_wrappers.errors import SafeWrappersError

Message = tuple[str, Any]
"""`steps`, `say`, or at last `end` with what stopped or killed it, "" for nothing."""
STOPPED: Final = "stopped"
ONE_THREAD: Final = dict.fromkeys(
    ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NPROC"), "1"
)
"""Environment variables that BLAS libraries and XLA (the last one) read as they are loaded: more threads would only
fight for cores."""


class RunStoppedError(SafeWrappersError):
    """A run was asked to stop; the message says from which step it will go on."""


class Interrupted(KeyboardInterrupt):
    """An experiment was stopped by a signal, `signum`."""

    def __init__(self, signum: int) -> None:
        super().__init__(signum)
        self.signum = signum


class RunsFailedError(SafeWrappersError):
    """Some jobs failed, those in `names`; the others were brought to their end."""

    def __init__(self, message: str, names: Iterable[str] = ()) -> None:
        super().__init__(message)
        self.names = frozenset(names)


@dataclass(frozen=True)
class Progress:
    """What a job tells, and is told: whether it is to save and stop."""

    steps: Callable[[int], None]
    say: Callable[[str], None]
    stopping: Callable[[], bool] = lambda: False


@dataclass(frozen=True)
class Job:
    """One process's work: `call(*arguments, progress)`; both must pickle. `total` is counted in `unit`."""

    name: str
    total: int
    unit: str
    call: Callable[..., None]
    arguments: tuple[Any, ...]


def work(job: Job, tell: Callable[[Message], None], stopping: Callable[[], bool]) -> str:
    """Does a job in this process; returns what stopped it, "" for nothing."""
    import torch

    torch.set_num_threads(1)
    progress = Progress(
        steps=lambda steps: tell(("steps", steps)),
        say=lambda text: tell(("say", text)),
        stopping=stopping,
    )
    try:
        job.call(*job.arguments, progress)
    except RunStoppedError as stop:
        progress.say(str(stop))
        return STOPPED
    except (SafeWrappersError, OSError) as error:
        return str(error)
    except Exception:  # whatever a task or a hyperparameter can do wrong: shown, and the other runs go on
        return traceback.format_exc()
    return ""


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
