"""Streams whose reader has gone."""

import contextlib
import errno
import io
import os

import pytest

from safe_wrappers.train.processes.output import lasting_output


def test_a_closed_pipe_is_no_exception_then_or_later():
    reader, writer = os.pipe()
    os.close(reader)
    with os.fdopen(writer, "w") as stream:
        with contextlib.redirect_stdout(stream), lasting_output():
            for _ in range(3):
                print("x" * 100_000, flush=True)
            print("still buffered when the block ends")
        stream.write("and what is buffered when the interpreter ends")


def test_a_full_disk_still_is_one():
    class Full(io.StringIO):
        def write(self, text):
            raise OSError(errno.ENOSPC, "No space left on device")

    with contextlib.redirect_stdout(Full()), lasting_output(), pytest.raises(OSError, match="No space"):
        print("x")
