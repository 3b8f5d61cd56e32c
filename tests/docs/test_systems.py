"""The table of the appendix's systems: every row's formulas are used by what it says, as the imports show."""

import ast
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PACKAGE = ROOT / "safe_wrappers"
PAGE = (ROOT / "docs" / "systems.md").read_text()
ROWS = [re.split(r"\s*\|\s*", line.strip("| \n")) for line in PAGE.splitlines() if re.match(r"\| S\d", line)]


def named(cell):
    return re.findall(r"`([\w.]+)`", cell)


def imports():
    """Module -> the modules of the package that it imports, without the package's name."""
    graph = {}
    for path in PACKAGE.rglob("*.py"):
        name = ".".join(path.relative_to(PACKAGE).with_suffix("").parts).removesuffix("__init__").rstrip(".")
        found = set()
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.ImportFrom) and node.module:
                found |= {node.module, *(f"{node.module}.{alias.name}" for alias in node.names)}
            elif isinstance(node, ast.Import):
                found |= {alias.name for alias in node.names}
        graph[name] = {
            one.removeprefix("safe_wrappers.") for one in found if one.startswith("safe_wrappers.")
        }
    return graph


GRAPH = imports()


def reached(start):
    """All modules that a module imports, directly or not; packages only re-export, and are not followed."""
    seen, left = set(), [start]
    while left:
        for one in GRAPH[left.pop()] & GRAPH.keys():
            if one not in seen and not (PACKAGE / one.replace(".", "/") / "__init__.py").exists():
                seen.add(one)
                left.append(one)
    return seen


def test_there_are_all_26_systems():
    assert [row[0] for row in ROWS] == [f"S{number}" for number in range(1, 27)]


@pytest.mark.parametrize("row", ROWS, ids=[row[0] for row in ROWS])
def test_the_formulas_of_a_system_are_used_by_what_the_table_says(row):
    (formulas,), (user,) = named(row[2]), named(row[3])
    assert formulas.startswith(("control.", "filter.")) and formulas in GRAPH
    assert user in GRAPH and not user.startswith("control.")
    assert formulas in reached(user)


def test_no_module_of_control_is_on_the_shelf():
    outside = [name for name in GRAPH if not name.startswith("control.") and name != "control"]
    used = set().union(*(reached(name) for name in outside))
    files = {
        name
        for name in GRAPH
        if name.startswith("control.") and (PACKAGE / f"{name.replace('.', '/')}.py").exists()
    }
    assert files <= used, files - used
