"""Files that are there whole or not at all."""

from __future__ import annotations

import contextlib
import glob
import json
import os
import socket
from pathlib import Path
from typing import Any


def write_bytes(path: Path, data: bytes) -> None:
    """Writes a file beside its place and moves it there, so that a kill leaves the old one or the new one."""
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.name}.{socket.gethostname()}.{os.getpid()}.tmp")
    _clear(temporary)
    try:
        with temporary.open("wb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())  # or a power cut could leave the new name on an empty file
        os.replace(temporary, path)
    except OSError as error:
        error.filename = str(path)  # a write that fails does not say to which file
        raise
    finally:
        with contextlib.suppress(OSError):  # a read-only disk refuses this, too
            temporary.unlink()


def _clear(temporary: Path) -> None:
    """Removes what killed processes of this machine left of the same file."""
    mine = temporary.name.removesuffix(f"{os.getpid()}.tmp")
    for left in temporary.parent.glob(f"{glob.escape(mine)}*.tmp"):
        pid = left.name[len(mine) : -len(".tmp")]
        if pid.isdigit() and not _alive(int(pid)):
            left.unlink(missing_ok=True)


def _alive(pid: int) -> bool:
    """Whether this machine has a process with this number."""
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except PermissionError:  # another user's
        pass
    return True


def write_text(path: Path, text: str) -> None:
    """`write_bytes` of UTF-8 text."""
    write_bytes(path, text.encode())


def write_json(path: Path, value: Any) -> None:
    """`write_bytes` of readable JSON."""
    write_bytes(path, json_bytes(value))


def json_bytes(value: Any) -> bytes:
    """What `write_json` writes."""
    return (json.dumps(value, indent=2, sort_keys=True) + "\n").encode()
