"""The lock says what constraints.txt says, with hashes; the audit says what was not checked."""

import re
from pathlib import Path

import pytest

from benchmarks.audit import main, verdict

ROOT = Path(__file__).parents[2]
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


def package(name, *ids, skipped=False):
    if skipped:
        return {"name": name, "skip_reason": "not there"}
    return {"name": name, "version": "1.0", "vulns": [{"id": i, "fix_versions": ["1.1"]} for i in ids]}


@pytest.mark.parametrize("report", [None, {"dependencies": [package("a", skipped=True)]}])
def test_nothing_asked_is_nothing_checked(report):
    status, (line,) = verdict(report)
    assert status == 0 and line.endswith("Nothing was checked.")


def test_what_is_known_is_told_and_what_was_not_asked_too():
    status, lines = verdict(
        {"dependencies": [package("a"), package("b", "CVE-1"), package("c", skipped=True)]}
    )
    assert status == 1
    assert lines[0] == "b 1.0: CVE-1, mended in 1.1"
    assert lines[1] == "Audit: 2 packages asked about, 1 known vulnerabilities. Not checked: 1 (c)."
    assert verdict({"dependencies": [package("a")]}) == (
        0,
        ["Audit: 1 packages asked about, 0 known vulnerabilities."],
    )


def test_a_program_that_only_complains_has_checked_nothing(tmp_path, capfd):
    program = tmp_path / "pip-audit"
    program.write_text("#!/bin/sh\necho no network >&2\nexit 1\n")
    program.chmod(0o755)
    assert main(str(tmp_path)) == 0
    out, err = capfd.readouterr()
    assert "Nothing was checked." in out and "no network" in err
