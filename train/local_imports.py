"""Modules that are not installed: what a config names may lie beside it, or in the folder that one works in."""

from __future__ import annotations

import contextlib
import os
import sys
from collections.abc import Iterable, Iterator
from pathlib import Path


@contextlib.contextmanager
def importable(folders: Iterable[Path]) -> Iterator[None]:
    """Lets Python find modules in these folders too, last of all; so do the processes that are started meanwhile.

    Args:
        folders: Taken off `sys.path` again at the end, those that were not on it before.
    """
    added = [path for path in dict.fromkeys(str(f.resolve()) for f in folders) if path not in sys.path]
    # Last: a file of one's own called yaml.py must not take an installed module's place.
    sys.path.extend(added)
    try:
        yield
    finally:
        for path in added:
            with contextlib.suppress(ValueError):
                sys.path.remove(path)


def own_folders() -> list[str]:
    """The folders on `sys.path` that are no part of the Python installation, for a message."""
    installed = tuple({sys.prefix, sys.base_prefix, sys.exec_prefix})
    return [
        path or os.getcwd()
        for path in sys.path
        if Path(path).is_dir()
        and not path.startswith(installed)
        and Path(path).name not in ("site-packages", "dist-packages")
    ]
