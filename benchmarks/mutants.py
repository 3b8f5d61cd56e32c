"""Makes one mistake at a time in a copy of the package, runs the tests around it, and says whether they notice.

    python -m benchmarks mutants                        # those that matter most, then 40 that are drawn; half an hour
    python -m benchmarks mutants --only filter lease    # in modules whose path has one of these words
    python -m benchmarks mutants --drawn 400 --seed 1   # more of them, and others
    python -m benchmarks mutants --old                  # mistakes that the package once had, put back one by one

A mistake is made in the syntax tree: a comparison turned round, + for -, another constant, `not` before a condition,
min for max, a statement left out. The tests of a module are the files that mention most of its
names. A mutant is killed if a test fails or is more than three times as late as without. Exit status 1 if one of
those that matter survives, or is gone with its function.

Old mistakes are in `old_bugs.yaml`: what went wrong for a user, the text that stands in a file exactly once, the text
that puts it back, and the tests, where they are not those of the module. All of them matter; "gone" is the text.
"""

import ast
import importlib
import multiprocessing
import os
import random
import re
import shutil
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import yaml

from benchmarks.tables import markdown, options

ROOT = Path(__file__).parents[1]
PRELOADED = ("numba", "gymnasium", "hypothesis", "mujoco", "scipy.optimize", "pytest")
"""Imported once for all the processes that run tests."""
AREAS = "filter", "constraints", "control", "plants", "wrappers", "train/evaluation"
MOST_TESTS = 5
VERDICTS = ("killed", "survived", "gone", "untested")
"""Gone: with its function; untested: its tests fail without a mistake, or there are none."""
PYTEST = "-x", "-q", "-p", "no:cacheprovider", "-W", "ignore::RuntimeWarning"
"""NumPy warns where compiled code does not."""
TURNED: dict[type[ast.cmpop], type[ast.cmpop]] = {
    ast.Lt: ast.GtE, ast.GtE: ast.Lt, ast.Gt: ast.LtE, ast.LtE: ast.Gt, ast.Eq: ast.NotEq, ast.NotEq: ast.Eq,
    ast.Is: ast.IsNot, ast.IsNot: ast.Is, ast.In: ast.NotIn, ast.NotIn: ast.In,
}  # fmt: skip
OTHER: dict[type[ast.operator], type[ast.operator]] = {
    ast.Add: ast.Sub, ast.Sub: ast.Add, ast.Mult: ast.Div, ast.Div: ast.Mult,
}  # fmt: skip
OPPOSITE = {"min": "max", "max": "min", "minimum": "maximum", "maximum": "minimum", "argmin": "argmax"}
_LEFT_OUT = (ast.Assign, ast.AugAssign, ast.Expr, ast.Raise, ast.Break, ast.Continue)


class Mutant(NamedTuple):
    """One mistake: the `number`-th of its kind in a function ("" is the module) of a file in the package."""

    file: str
    function: str
    kind: str
    number: int = 0


_MATTER = {
    "filter/search.py": "SafeActionSearch.decide not; SafeActionSearch._decide not;"
    " SafeActionSearch._nearby not; SafeActionSearch._search not; SafeActionSearch.relinearize not",
    "filter/linearize.py": "Tangents._corrected not",
    "control/projection.py": "_missed comparison; project_unchecked comparison",
    "filter/bound.py": "Bound._of min/max; Bound._wanted min/max; Bound.slack min/max; Bound.admits not",
    "constraints/detour.py": "Detour.observe arithmetic; Detour._kept_side comparison",
    "control/backup/heading_drive.py": "clearances not; clearances comparison",
    "constraints/backup/coasting_clearance.py": "CoastingClearance._course comparison;"
    " CoastingClearance.proposals not; CoastingClearance.h_along not",
    "constraints/backup/escape_clearance.py": "EscapeClearance.clearance not; EscapeClearance.proposals not",
    "constraints/backup/wall_clearance.py": "WallClearance.proposals not; WallClearance.h_along arithmetic",
    "control/backup/point_among_walls.py": "way min/max; distances min/max; slides comparison",
    "constraints/predictive_shield.py": "PredictiveShield.plan comparison; PredictiveShield._after not",
    "wrappers/presets.py": "ActionShield.step not; ActionShield.action_masks not",
    "wrappers/stopping.py": "BoundBudget.longest_time not; BoundBudget.can_stop_after not",
    "wrappers/lease_expiry.py": (
        "LeaseExpiry.step not; LeaseExpiry._accepted not; LeaseExpiry._grant min/max"
    ),
    "wrappers/chunk_handover.py": "ChunkHandover._submit not; ChunkHandover._submit min/max;"
    " ChunkHandover._take_over comparison; ChunkHandover._sendable not; Admission.admits not",
}
MATTER = [Mutant(file, *one.rsplit(" ", 1)) for file, of in _MATTER.items() for one in of.split("; ")]
"""What a filter must never get wrong, the first mistake of a kind in a function each."""
OLD: list[dict[str, str]] = yaml.safe_load(Path(__file__).with_name("old_bugs.yaml").read_text())


def _mistakes(node: Any) -> Iterator[tuple[str, Callable[[], None]]]:
    """What can be wrong at a node, by kind, and what makes it so."""
    if isinstance(node, ast.Compare) and type(node.ops[0]) in TURNED:
        yield "comparison", lambda: node.ops.__setitem__(0, TURNED[type(node.ops[0])]())
    if isinstance(node, ast.BinOp | ast.AugAssign) and type(node.op) in OTHER:
        yield "arithmetic", lambda: setattr(node, "op", OTHER[type(node.op)]())
    if isinstance(node, ast.Constant) and type(node.value) in (int, float):
        yield "constant", lambda: setattr(node, "value", 2 * node.value + (node.value == 0))
    if isinstance(node, ast.If | ast.While | ast.IfExp):
        yield "not", lambda: setattr(node, "test", ast.UnaryOp(ast.Not(), node.test))
    place = "id" if isinstance(node, ast.Name) else "attr"
    if isinstance(node, ast.Name | ast.Attribute) and getattr(node, place) in OPPOSITE:
        yield "min/max", lambda: setattr(node, place, OPPOSITE[getattr(node, place)])
    body = node.body if isinstance(node, ast.FunctionDef | ast.If | ast.For | ast.While | ast.With) else ()
    for i, one in enumerate(body):
        if isinstance(one, _LEFT_OUT) and not isinstance(getattr(one, "value", None), ast.Constant):
            yield "statement", lambda i=i: body.__setitem__(i, ast.Pass())  # type: ignore[misc]


def mistakes(node: ast.AST, name: str = "") -> Iterator[tuple[str, str, Callable[[], None]]]:
    """Of a module: in which function, of which kind, and what makes it; nothing in docstrings or annotations."""
    yield from ((name, kind, make) for kind, make in _mistakes(node))
    for field, value in ast.iter_fields(node):
        for child in value if isinstance(value, list) else [value]:
            if isinstance(child, ast.AST) and field not in ("annotation", "returns", "decorator_list"):
                own = getattr(child, "name", "") if isinstance(child, ast.FunctionDef | ast.ClassDef) else ""
                yield from mistakes(child, ".".join(filter(None, (name, own))))


def every(package: Path, only: list[str]) -> list[Mutant]:
    """All mutants of the areas."""
    counts: Counter[tuple[str, str, str]] = Counter()
    found = []
    for path in sorted(path for area in AREAS for path in (package / area).rglob("*.py")):
        file = str(path.relative_to(package))
        if not only or any(word in file for word in only):
            for function, kind, _ in mistakes(ast.parse(path.read_text())):
                found.append(Mutant(file, function, kind, counts[file, function, kind]))
                counts[file, function, kind] += 1
    return found


def mistaken(text: str, mutant: Mutant) -> tuple[str, str] | None:
    """A module's text with a mistake, and the line that it is in; None if its function is gone."""
    if mutant.kind == "old":
        now, was = OLD[mutant.number]["now"], OLD[mutant.number]["was"]
        return (text.replace(now, was), now.partition("\n")[0]) if text.count(now) == 1 else None
    tree = ast.parse(text)
    before = ast.unparse(tree).splitlines()
    made = [make for function, kind, make in mistakes(tree) if (function, kind) == mutant[1:3]]
    if len(made) <= mutant.number:
        return None
    made[mutant.number]()
    changed = ast.unparse(ast.fix_missing_locations(tree))
    line = next((old for old, new in zip(before, changed.splitlines(), strict=False) if old != new), "")
    return changed, line.strip()


def named_tests(mutant: Mutant) -> str:
    """Those that the list of old mistakes names; "" for the module's."""
    return OLD[mutant.number].get("tests", "") if mutant.kind == "old" else ""


def tests_of(where: Path, file: str) -> list[str]:
    """The test files that import a module or are named after it, then those that mention most of its names."""
    tree = ast.parse((where / "safe_wrappers" / file).read_text())
    stem = Path(file).stem
    names = [n.name for n in tree.body if isinstance(n, ast.FunctionDef | ast.ClassDef) if n.name[0] != "_"]
    names += [f"{stem} import", *(name.removeprefix("Bound") for name in names)]
    word = re.compile(rf"\b({'|'.join(names)})\b")
    paths = sorted((where / "tests").glob("test_*.py"))
    for folder in ("filter", "constraints", "control", "plants", "wrappers", "vector", "contract", "train"):
        paths += sorted((where / "tests" / folder).rglob("test_*.py"))
    texts = {path: path.read_text() for path in paths}
    counts = {
        path: len(word.findall(text)) / len(text) + (stem in path.stem) + (f"{stem} import" in text)
        for path, text in texts.items()
    }
    best = sorted((path for path in counts if counts[path]), key=lambda path: -counts[path])[:MOST_TESTS]
    return [str(path.relative_to(where)) for path in best]


def copied(into: Path) -> None:
    """The package as an install lays it out, and its tests."""
    ignore = shutil.ignore_patterns("__pycache__")
    for name in ("safe_wrappers", "tests", "benchmarks", "docs", "configs", "examples"):
        shutil.copytree(ROOT / name, into / name, ignore=ignore)
    for name in ("envs", "train"):
        shutil.copytree(ROOT / name, into / "safe_wrappers" / name, ignore=ignore)
    shutil.copy(ROOT / "pyproject.toml", into)


def _tests(where: Path, files: list[str]) -> None:
    os.chdir(where)
    sys.path[:] = [str(where), *(path for path in sys.path if path not in ("", str(ROOT)))]
    with (where / "output.txt").open("w") as output:
        os.dup2(output.fileno(), 1)
        os.dup2(output.fileno(), 2)
    import safe_wrappers

    assert Path(str(safe_wrappers.__file__)).is_relative_to(where), "the tests import another package"
    os._exit(int(importlib.import_module("pytest").main([*PYTEST, *files])))


def fails(where: Path, files: list[str], longest_s: float | None) -> bool:
    """Whether a test fails on the copy, or is late, in a process that has the copied package."""
    process = multiprocessing.get_context("fork").Process(target=_tests, args=(where, files))
    process.start()
    process.join(longest_s)
    late = process.is_alive()
    process.kill()
    process.join()
    return late or process.exitcode != 0


def verdicts(where: Path, mutants: list[Mutant]) -> Iterator[tuple[Mutant, str, str]]:
    """Of each mutant what became of it, and the line; module by module, the tests once without a mistake before."""
    for file, named in dict.fromkeys((mutant.file, named_tests(mutant)) for mutant in mutants):
        path = where / "safe_wrappers" / file
        text = path.read_text() if path.exists() else ""
        files, began = named.split() or (tests_of(where, file) if text else []), time.monotonic()
        untested = not files or fails(where, files, None)
        longest_s = 30.0 + 3.0 * (time.monotonic() - began)
        for number, mutant in enumerate(mutants):
            if (mutant.file, named_tests(mutant)) != (file, named):
                continue
            made = mistaken(text, mutant)
            if made is None or untested:
                yield mutant, "gone" if made is None else "untested", " ".join(files)
                continue
            path.write_text(made[0])
            os.utime(path, (number, number))  # bytecode is kept by size and second of change
            yield mutant, "killed" if fails(where, files, longest_s) else "survived", made[1]
        if text:
            path.write_text(text)


def main() -> None:
    """Print what became of each mutant, and a table of the areas."""
    given = options(__doc__, only=[], drawn=40, seed=0, old=False)
    os.environ |= {"MUJOCO_GL": "disabled", "OMP_NUM_THREADS": "1", "SAFE_WRAPPERS_COMPILED": "0"}
    for name in PRELOADED:
        importlib.import_module(name)
    with tempfile.TemporaryDirectory() as folder:
        where = Path(folder).resolve()
        copied(where)
        found = every(where / "safe_wrappers", given.only)
        drawn = random.Random(given.seed).sample(found, 0 if given.old else min(given.drawn, len(found)))
        old = [Mutant(bug["file"], bug["bug"], "old", number) for number, bug in enumerate(OLD)]
        matter = [
            m
            for m in (old if given.old else MATTER)
            if not given.only or any(word in m.file for word in given.only)
        ]
        counts: dict[str, Counter[str]] = {}
        bad = 0
        for mutant, verdict, line in verdicts(where, [*matter, *sorted(drawn)]):
            print(f"{verdict:9} {' '.join(map(str, mutant))}: {line}", flush=True)
            counts.setdefault(mutant.file.partition("/")[0], Counter())[verdict] += 1
            bad += mutant in matter and verdict != "killed"
    counts["all"] = sum(counts.values(), Counter())
    lines = [[area, of.total(), *(of[verdict] for verdict in VERDICTS)] for area, of in counts.items()]
    print(markdown(f"area | mutants | {' | '.join(VERDICTS)}", lines))
    sys.exit(bad > 0)
