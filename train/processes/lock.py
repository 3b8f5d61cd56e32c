"""One writer per run folder."""

from __future__ import annotations

import contextlib
import errno
import fcntl
import os
import socket
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Final, TextIO

from safe_wrappers.errors import RunStateError

_LOCK: Final = ".lock"
_PATIENCE_S: Final = 1.0
"""A process whose parent was killed has gone by then, and one that only looks at the lock has looked."""
_CANNOT_LOCK: Final = (errno.ENOLCK, errno.ENOSYS, errno.EOPNOTSUPP)


class FolderHeldError(RunStateError):
    """Another process is working on the run."""


@contextlib.contextmanager
def only_writer(folder: Path) -> Iterator[None]:
    """Holds the folder for this process; the system lets go of it when the process ends, however it ends.

    Raises:
        FolderHeldError: Another process holds it; says which.
        RunStateError: The file system has no locks.
    """
    folder.mkdir(parents=True, exist_ok=True)
    with (folder / _LOCK).open("a+") as file:
        _hold(file, folder)
        file.truncate(0)
        file.write(f"process {os.getpid()} on {socket.gethostname()}")
        file.flush()
        yield


def check_free(folder: Path) -> None:
    """Refuses a folder that another process holds now.

    Raises:
        FolderHeldError: It does; says which.
        RunStateError: The file system has no locks.
    """
    if (folder / _LOCK).exists():
        with (folder / _LOCK).open("r+") as file:
            _hold(file, folder)


def _hold(file: TextIO, folder: Path) -> None:
    end = time.monotonic() + _PATIENCE_S
    while True:
        try:
            return fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            if time.monotonic() < end:
                time.sleep(0.05)
                continue
            file.seek(0)
            who = file.read(200).strip()
            raise FolderHeldError(
                f"Another process is working on the run in {str(folder)!r} ({who or 'it left no name'}); wait for it,"
                " or end it first."
            ) from None
        except OSError as error:
            if error.errno not in _CANNOT_LOCK:
                raise
            raise RunStateError(
                f"The file system of {str(folder)!r} cannot lock files ({error.strerror}), and two processes could"
                " write there at once: choose an `output` on a disk of this machine, or on NFS 4."
            ) from None
