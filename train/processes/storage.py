"""A disk that is full, or that cannot be written to, told in a line that says how to go on."""

from __future__ import annotations

import contextlib
import errno
import os
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Final

from safe_wrappers.errors import RunStateError, SafeWrappersError

_TROUBLE: Final = {
    errno.ENOSPC: "no space is left on the disk",
    errno.EDQUOT: "the quota of the disk is used up",
    errno.EFBIG: "a file is larger than this process may write (ulimit -f)",
    errno.EROFS: "the file system is read-only",
    errno.EACCES: "there is no permission to write",
    errno.EPERM: "there is no permission to write",
    errno.EIO: "the disk fails",
    errno.ESTALE: "the network disk has gone",
}


def check_writable(folder: Path) -> None:
    """Refuses a folder that could not be made or written to, without making it.

    Raises:
        RunStateError: It could not.
    """
    there = next(path for path in (folder, *folder.absolute().parents) if path.exists())
    if not there.is_dir():
        raise RunStateError(f"{str(there)!r} is a file where a folder is needed; choose another `output`.")
    if not os.access(there, os.W_OK | os.X_OK):
        raise RunStateError(
            f"{str(there)!r} cannot be written to (read-only, or another user's); choose another `output`."
        )


@contextlib.contextmanager
def telling_of_storage(folder: Path) -> Iterator[None]:
    """In this block what the storage refuses becomes a line for people.

    Raises:
        RunStateError: A file could not be written; says why, where, and how to go on.
    """
    try:
        yield
    except SafeWrappersError:
        raise
    except Exception as error:
        refused = _refused(error)
        if refused is None:
            raise
        path = Path(refused.filename) if isinstance(refused.filename, str) else folder
        there = path if path.is_dir() else path.parent
        free = f" ({shutil.disk_usage(there).free:,} bytes are free)" if there.exists() else ""
        raise RunStateError(
            f"{str(path)!r}: {_TROUBLE[refused.errno or 0]}{free}. What was saved before is whole: mend that, and the"
            " same command goes on from the last checkpoint."
        ) from error


def _refused(error: BaseException | None) -> OSError | None:
    """What the storage refused, in an error or in what led to it: torch reports it as an error of its own."""
    while error is not None:
        if isinstance(error, OSError) and error.errno in _TROUBLE:
            return error
        error = error.__cause__ or error.__context__
    return None
