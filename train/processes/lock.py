"""One writer per run folder."""

from __future__ import annotations

import contextlib
import fcntl
from collections.abc import Iterator
from pathlib import Path

from safe_wrappers.errors import RunStateError


class FolderHeldError(RunStateError):
    """Another process is working on the run."""


@contextlib.contextmanager
def only_writer(folder: Path) -> Iterator[None]:
    """Holds the folder for this process; the system lets go of it when the process ends, however it ends.

    Raises:
        FolderHeldError: Another process holds it.
    """
    folder.mkdir(parents=True, exist_ok=True)
    with (folder / ".lock").open("w") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise FolderHeldError(
                f"Another process is working on the run in {str(folder)!r}; wait for it, or end it first."
            ) from None
        yield
