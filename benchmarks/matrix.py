"""The library's tests on the oldest, the pinned and the newest of its dependencies, on every Python of this machine.

    make matrix                                      # an hour or so for each combination
    make matrix MATRIX="--quick --only 3.13,newest"  # parts of the tests; one combination

Each combination has an environment of its own in build/matrix. What has passed is not run again: the table in
benchmarks/results/matrix.csv goes on where it stands. Needs nothing but Python.
"""

import argparse
import csv
import os
import re
import shutil
import subprocess
import sys
import tomllib
from collections.abc import Iterator, Sequence
from pathlib import Path
from time import monotonic
from typing import NamedTuple

ROOT = Path(__file__).parents[1]
RESULTS = ROOT / "benchmarks" / "results"
PYTHONS = ("3.11", "3.12", "3.13", "3.14")
BETWEEN = ("3.12.0", "3.17.0")
"""MuJoCo, with everything else pinned: those beside the floor, the pin and the newest that changed what is read."""
QUICK = (
    "tests/filter",
    "tests/test_protect.py",
    "tests/envs/test_goal_env.py",
    "tests/envs/test_car_goal.py",
    "tests/envs/test_gymnasium_contract.py",
    "tests/plants/test_contact_forecast.py",
    "tests/constraints/test_heading_drive_clearance.py",
)
WHOLE = ("--ignore", "tests/train", "--ignore", "tests/sb3")
SHOWN = ("mujoco", "numpy", "scipy", "gymnasium", "numba", "qpsolvers", "daqp", "clarabel")
COLUMNS = ("combination", "tests", "python", *SHOWN, "passed", "failed", "skipped", "minutes", "reason")
_FLOOR = re.compile(r"([\w-]+)(?:\[[\w,]+\])?>=([\d.]+)")
_ENDING = re.compile(r"(\d+) (passed|failed|skipped|error)")


class Combination(NamedTuple):
    """One line of the table: a Python, which versions, and a MuJoCo if not that of these versions."""

    python: str
    versions: str
    mujoco: str = ""

    def __str__(self) -> str:
        return ",".join(filter(None, self))


def floors(project: str) -> dict[str, str]:
    """The least version of each of the library's own dependencies, by name, from the text of pyproject.toml."""
    dependencies = tomllib.loads(project)["project"]["dependencies"]
    return {found[1]: found[2] for found in map(_FLOOR.match, dependencies) if found}


def constraints(combination: Combination, project: str, pins: str) -> str:
    """What pip is given as constraints: the floors, constraints.txt, or nothing; and a MuJoCo."""
    lines = {"oldest": [f"{name}=={version}" for name, version in floors(project).items()], "newest": []}
    lines["pinned"] = [line for line in pins.splitlines() if not line.startswith("#")]
    found = lines[combination.versions]
    if combination.mujoco:
        found = [line for line in found if not line.startswith("mujoco==")]
        found.append(f"mujoco=={combination.mujoco}")
    return "\n".join([*found, ""])


def combinations(pythons: Sequence[str]) -> Iterator[Combination]:
    """All of them for these Pythons; the MuJoCos in between on the first alone."""
    for python in pythons:
        yield from (Combination(python, versions) for versions in ("oldest", "pinned", "newest"))
    yield from (Combination(python, "pinned", mujoco) for python in pythons[:1] for mujoco in BETWEEN)


def _answers(program: str) -> bool:
    """Whether it is there; a version manager's stand-in for one that is not chosen only complains."""
    found = shutil.which(program)
    return found is not None and subprocess.run([found, "-V"], capture_output=True).returncode == 0


def measure(combination: Combination, quick: bool) -> dict[str, str]:
    """A row of the table."""
    row = dict.fromkeys(COLUMNS, "") | {
        "combination": str(combination),
        "tests": "quick" if quick else "whole",
    }
    folder = ROOT / "build" / "matrix" / str(combination).replace(",", "-")
    python = folder / "bin" / "python"
    begin = monotonic()
    reason = _installed(combination, folder, python)
    if not reason:
        listing = "import sys, importlib.metadata as m; print(sys.version.split()[0], *map(m.version, sys.argv[1:]))"
        versions = subprocess.check_output([python, "-c", listing, *SHOWN], text=True)
        row |= dict(zip(("python", *SHOWN), versions.split(), strict=True))
        tests = QUICK if quick else WHOLE
        command = [python, "-m", "pytest", "-q", "--tb=line", "-p", "no:cacheprovider", *tests]
        env = os.environ | {"MUJOCO_GL": "disabled", "OMP_NUM_THREADS": "1"}
        done = subprocess.run(command, cwd=ROOT, env=env, capture_output=True, text=True)
        lines = done.stdout.splitlines() or [""]
        counts = {kind: int(number) for number, kind in _ENDING.findall(lines[-1])}
        row |= {kind: str(counts.get(kind, 0)) for kind in ("passed", "skipped")}
        row["failed"] = str(counts.get("failed", 0) + counts.get("error", 0))
        if done.returncode:
            reason = next((line for line in lines if line.startswith(("FAILED", "ERROR"))), "")
            reason = reason or f"pytest ended with {done.returncode}: {done.stderr[-200:]}"
    row |= {"reason": " ".join(reason.split()), "minutes": f"{(monotonic() - begin) / 60:.0f}"}
    return row


def _installed(combination: Combination, folder: Path, python: Path) -> str:
    """Makes the environment; what pip could not do, or nothing."""
    subprocess.check_call([f"python{combination.python}", "-m", "venv", "--clear", folder])
    told = folder / "constraints.txt"
    pins = (ROOT / "constraints.txt").read_text()
    told.write_text(constraints(combination, (ROOT / "pyproject.toml").read_text(), pins))
    pip = [python, "-m", "pip", "install", "--quiet", "--disable-pip-version-check", "--only-binary", ":all:"]
    done = subprocess.run([*pip, "-c", told, "-e", ".[test]"], cwd=ROOT, capture_output=True, text=True)
    errors = [line for line in done.stderr.splitlines() if line.startswith("ERROR")]
    return "" if done.returncode == 0 else f"cannot be installed: {' '.join(errors[:2])}"


def table(rows: Sequence[dict[str, str]]) -> str:
    """The page's table."""
    head = ("Python, versions, MuJoCo", "tests", *SHOWN[:5], "passed", "failed", "skipped", "why")
    shown = ("combination", "tests", *SHOWN[:5], "passed", "failed", "skipped", "reason")
    lines = [head, ["---"] * len(head)]
    lines += [[row[key].replace("|", "/").replace(",", ", ") for key in shown] for row in rows]
    return "".join(f"| {' | '.join(cells)} |\n" for cells in lines)


def main() -> int:
    """Runs what has not passed yet; the exit status is 1 if something fails."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument(
        "--quick", action="store_true", help="parts of the tests, for the combinations without others"
    )
    parser.add_argument(
        "--only", nargs="+", default=[], metavar="PYTHON,VERSIONS[,MUJOCO]", help="combinations"
    )
    options = parser.parse_args()
    known = list(combinations([python for python in PYTHONS if _answers(f"python{python}")]))
    if unknown := set(options.only) - set(map(str, known)):
        parser.error(
            f"no such combination: {' '.join(sorted(unknown))}; there are {' '.join(map(str, known))}"
        )
    path = RESULTS / "matrix.csv"
    rows = {row["combination"]: row for row in csv.DictReader(path.open())} if path.exists() else {}
    for combination in known:
        name = str(combination)
        before = rows.get(name)
        done = before and not before["reason"] and (options.quick or before["tests"] == "whole")
        if done or (options.only and name not in options.only):
            continue
        row = rows[name] = measure(combination, options.quick)
        print(name, row["passed"], "passed,", row["failed"], "failed", row["reason"], flush=True)
        ordered = [rows[name] for name in sorted(rows)]
        with path.open("w", newline="") as file:
            writer = csv.DictWriter(file, COLUMNS, lineterminator="\n")
            writer.writeheader()
            writer.writerows(ordered)
        path.with_suffix(".md").write_text(table(ordered))
    return int(any(row["reason"] for row in rows.values()))


if __name__ == "__main__":
    sys.exit(main())
