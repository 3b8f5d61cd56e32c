"""Stopping on request: SIGINT, SIGTERM and SIGHUP ask the runs to save a checkpoint and end."""

from __future__ import annotations

import contextlib
import signal
import threading
import time
from collections.abc import Callable, Iterator
from types import FrameType
from typing import Final

from safe_wrappers.errors import SafeWrappersError

_ONE_REQUEST_S: Final = 0.5
"""Signals this close together are one: `timeout` and many a launcher send to a process and to its group."""


class RunStoppedError(SafeWrappersError):
    """A run was asked to stop; the message says from which step it will go on."""


class Interrupted(KeyboardInterrupt):
    """An experiment was stopped by a signal.

    Attributes:
        signum: The signal's number.
        standing: A line for each run, if runs were being trained: where it will go on.
    """

    def __init__(self, signum: int) -> None:
        super().__init__(signum)
        self.signum = signum
        self.standing: list[str] = []


class StopRequest:
    """Whether signals came, and whether another one came after the first."""

    def __init__(self) -> None:
        self.signum = 0
        self.at_once = False
        self._first_at = 0.0

    def receive(self, signum: int, frame: FrameType | None = None) -> None:
        """The signal handler."""
        now = time.monotonic()
        if not self.signum:
            self.signum, self._first_at = signum, now
        elif now - self._first_at > _ONE_REQUEST_S:
            self.at_once = True


@contextlib.contextmanager
def stop_request() -> Iterator[StopRequest]:
    """In this block signals that would end the process are noted instead; those that it ignores stay ignored.

    `nohup` ignores SIGHUP, and a shell without job control SIGINT in what it starts in the background.
    """
    ending = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
    with _noting([s for s in ending if signal.getsignal(s) is not signal.SIG_IGN]) as request:
        yield request


@contextlib.contextmanager
def heeding_termination() -> Iterator[Callable[[], bool]]:
    """In this block SIGTERM does not end the process; yields the question whether it came."""
    with _noting([signal.SIGTERM]) as request:
        yield lambda: bool(request.signum)


@contextlib.contextmanager
def _noting(signals: list[signal.Signals]) -> Iterator[StopRequest]:
    request = StopRequest()
    if threading.current_thread() is not threading.main_thread():  # only the main thread may set handlers
        yield request
        return
    before = {which: signal.signal(which, request.receive) for which in signals}
    try:
        yield request
    finally:
        for which, handler in before.items():
            signal.signal(which, signal.SIG_DFL if handler is None else handler)
