"""Output that nobody reads any more does not stop the work."""

from __future__ import annotations

import contextlib
import errno
import os
import sys
from collections.abc import Callable, Iterator
from typing import Any, TextIO, TypeVar

_T = TypeVar("_T")


class _Lasting:
    """A text stream that goes on into nothing when its reader has gone (a closed pipe, a terminal that hung up)."""

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream

    def write(self, text: str) -> int:
        return self._attempt(lambda: self._stream.write(text), len(text))

    def flush(self) -> None:
        self._attempt(self._stream.flush, None)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)

    def _attempt(self, call: Callable[[], _T], otherwise: _T) -> _T:
        try:
            return call()
        except OSError as error:
            if error.errno not in (errno.EPIPE, errno.EIO):
                raise
            # The descriptor itself, or what is still buffered would fail again when the interpreter ends.
            nothing = os.open(os.devnull, os.O_WRONLY)
            os.dup2(nothing, self._stream.fileno())
            os.close(nothing)
            return otherwise


@contextlib.contextmanager
def lasting_output() -> Iterator[None]:
    """In this block a closed standard output or error is no exception."""
    out, err = _Lasting(sys.stdout), _Lasting(sys.stderr)
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        try:
            yield
        finally:
            out.flush()
            err.flush()
