"""Makes one mistake at a time in a copy of the package, runs the tests around it, and says whether they notice.

    python -m benchmarks.mutants                 # all; about ten minutes on one core
    python -m benchmarks.mutants --only search  # of the targets whose name has one of these words

A mutant is killed if a test fails, or does not end within two minutes. Exit status 1 if under 90 % of the mutants
that change behaviour are killed.
"""

import argparse
import importlib
import multiprocessing
import os
import shutil
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path

import pytest

from benchmarks.mutants.target import Mutant, Target
from benchmarks.mutants.targets import TARGETS

ROOT = Path(__file__).parents[2]
NEEDED = 0.9
"""Share of the mutants that change behaviour."""
TIMEOUT_S = 120.0
NOT_THE_COPY = 99
OUTPUT = "output.txt"


def copied(into: Path) -> Path:
    """The package as an install lays it out, and its tests; returns the package."""
    package = into / "safe_wrappers"
    no_bytecode = shutil.ignore_patterns("__pycache__")
    shutil.copytree(ROOT / "safe_wrappers", package, ignore=no_bytecode)
    for name in ("envs", "train"):
        shutil.copytree(ROOT / name, package / name, ignore=no_bytecode)
    for name in ("tests", "benchmarks"):
        shutil.copytree(ROOT / name, into / name, ignore=no_bytecode)
    shutil.copy(ROOT / "pyproject.toml", into)
    return package


def tests(where: Path, words: tuple[str, ...]) -> int:
    """Pytest's exit status on the copy, in a process that has the copied package instead of the installed one."""
    process = multiprocessing.get_context("fork").Process(target=_tests, args=(where, words))
    process.start()
    process.join(TIMEOUT_S)
    if process.is_alive():
        process.kill()
        process.join()
    status = process.exitcode
    if status == NOT_THE_COPY:
        sys.exit(f"the tests import another package than the copy in {where}")
    assert status is not None
    return status


def _tests(where: Path, words: tuple[str, ...]) -> None:
    os.chdir(where)
    sys.path[:] = [str(where), *(p for p in sys.path if p not in ("", str(ROOT)))]
    with (where / OUTPUT).open("w") as output:
        os.dup2(output.fileno(), 1)
        os.dup2(output.fileno(), 2)
    import safe_wrappers.envs as envs
    from safe_wrappers.filter import search

    for module in (envs, search):
        if not Path(str(module.__file__)).is_relative_to(where):
            os._exit(NOT_THE_COPY)
    os._exit(int(pytest.main(["-x", "-q", "-p", "no:cacheprovider", *words])))


def preload() -> None:
    """Import here what takes long, once for all the processes that run tests."""
    # Compiled code is cached by the time of change of its own file only.
    os.environ |= {"MUJOCO_GL": "disabled", "OMP_NUM_THREADS": "1", "SAFE_WRAPPERS_COMPILED": "0"}
    for name in ("daqp", "gymnasium", "hypothesis", "mujoco", "numpy", "scipy.optimize", "scipy.spatial"):
        importlib.import_module(name)


def check_tests(where: Path, targets: dict[str, Target]) -> None:
    """Stop if a test fails without any mistake."""
    for words in dict.fromkeys(
        w for target in targets.values() for w in (target.tests, *(m.tests for m in target.mutants))
    ):
        if words and tests(where, words):
            sys.exit(f"{' '.join(words)} fail without a mutant\n{(where / OUTPUT).read_text()[-3000:]}")


def place(package: Path, target: Target, mutant: Mutant) -> Path:
    """The one file of the target with the mutant's text, once."""
    found = [(file, file.read_text().count(mutant.old)) for file in sorted(package.glob(target.files))]
    holding = [file for file, times in found if times]
    if sum(times for _, times in found) != 1:
        sys.exit(f"{mutant.old!r} is {sum(times for _, times in found)} times in {target.files}, not once")
    return holding[0]


def survives(where: Path, file: Path, target: Target, mutant: Mutant, number: int) -> bool:
    """Whether all tests pass with the mistake."""
    text = file.read_text()
    mistaken = text.replace(mutant.old, mutant.new)
    compile(mistaken, file, "exec")  # a syntax error would say nothing about the tests
    try:
        file.write_text(mistaken)
        # Bytecode is kept by size and second of change.
        os.utime(file, (number, number))
        return tests(where, mutant.tests or target.tests) == 0
    finally:
        file.write_text(text)


def main() -> None:
    parser = argparse.ArgumentParser(prog="mutants", description=__doc__.splitlines()[0])
    parser.add_argument("--only", nargs="+", metavar="WORD", help=f"only some of {', '.join(TARGETS)}")
    parser.add_argument("--find", action="store_true", help="only check that every mutant's text is there")
    arguments = parser.parse_args()
    targets = {n: r for n, r in TARGETS.items() if not arguments.only or any(w in n for w in arguments.only)}
    with tempfile.TemporaryDirectory() as folder:
        where = Path(folder).resolve()
        package = copied(where)
        jobs = [
            (n, target, m, place(package, target, m)) for n, target in targets.items() for m in target.mutants
        ]
        if arguments.find:
            print(f"{len(jobs)} mutants")
            return
        preload()
        check_tests(where, targets)
        counts: dict[str, Counter[str]] = {name: Counter() for name in targets}
        for number, (name, target, mutant, file) in enumerate(jobs, start=1):
            began = time.perf_counter()
            lives = survives(where, file, target, mutant, number)
            verdict = ("equal" if mutant.equal else "SURVIVED") if lives else "killed"
            if mutant.equal and not lives:
                verdict = "killed, not equal"
            counts[name][verdict] += 1
            change = f"{mutant.old.strip()!r} -> {mutant.new.strip()!r}"
            print(f"{verdict:9} {time.perf_counter() - began:5.1f} s  {name}: {change}", flush=True)
    report(counts)


def report(counts: dict[str, "Counter[str]"]) -> None:
    """A table by target, and the exit status."""
    total = sum(counts.values(), Counter[str]())
    print(f"\n{'':18}{'mutants':>9}{'equal':>9}{'killed':>9}{'survived':>9}")
    for name, of in [*counts.items(), ("all", total)]:
        killed = of["killed"] + of["killed, not equal"]
        print(f"{name:18}{of.total():>9}{of['equal']:>9}{killed:>9}{of['SURVIVED']:>9}")
    share = 1.0 - total["SURVIVED"] / max(total.total() - total["equal"], 1)
    print(f"\nkilled: {share:.1%} of those that change behaviour; needed: {NEEDED:.0%}")
    sys.exit(0 if share >= NEEDED else 1)


if __name__ == "__main__":
    main()
