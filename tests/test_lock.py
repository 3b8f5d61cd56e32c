"""The lock says what constraints.txt says, with hashes."""

import re
from pathlib import Path

ROOT = Path(__file__).parents[1]
PIN = re.compile(r"^([\w.-]+)==([^\s;\\]+)", re.MULTILINE)


def pins(text):
    return {re.sub(r"[-_.]+", "-", name).lower(): version for name, version in PIN.findall(text)}


def test_the_lock_has_the_versions_of_constraints_with_hashes_and_no_address():
    lock = (ROOT / "requirements.lock").read_text()
    known, locked = pins((ROOT / "constraints.txt").read_text()), pins(lock)
    assert {"numpy", "torch", "mujoco", "pytest", "ruff", "sb3-contrib"} <= locked.keys()
    assert {name: known[name] for name in locked.keys() & known.keys()} == {
        name: version for name, version in locked.items() if name in known
    }
    of_cuda = {name for name in locked.keys() - known.keys() if name.startswith(("nvidia-", "cuda-"))}
    assert locked.keys() - known.keys() - of_cuda <= {
        "triton",
        "setuptools",
        "colorama",
    }  # and other systems' own
    entries = re.split(r"^(?=[\w.-]+==)", lock, flags=re.MULTILINE)[1:]
    assert len(entries) == len(PIN.findall(lock))
    assert all(re.search(r"--hash=sha256:[0-9a-f]{64}", entry) for entry in entries)
    assert "://" not in lock
