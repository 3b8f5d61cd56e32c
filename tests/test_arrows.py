"""The floors of the library, by its imports; and the appendix's systems, whose formulas are used as the page says."""

import ast
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
FLOORS = (
    {"errors", "info"},
    {"control"},
    {"plants", "envs"},
    {"filter"},
    {"constraints"},
    {"wrappers", "sb3"},
    {"diagnosis"},
    {"__init__", "train"},
)
"""Folders and single modules, from the lowest floor up; each uses itself and lower floors."""
LEARNERS = {"torch", "stable_baselines3"}
SIMULATORS = {"gymnasium", "mujoco"}
FORBIDDEN = dict.fromkeys(("control", "filter", "errors", "info"), LEARNERS | SIMULATORS) | {
    "sb3": set(),
    "train": set(),
}
"""By folder; elsewhere the learners."""


def imports(path, module):
    """Absolute dotted names of everything a module imports, inside functions too."""
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            above = ["safe_wrappers", *module.split(".")][: -node.level or None] if node.level else []
            base = ".".join([*above, *filter(None, [node.module])])
            yield from (f"{base}.{alias.name}" for alias in node.names)


def sources():
    """The path of every module by its dotted name without the package's; `envs` and `train` are installed inside."""
    for folder, inside in (("safe_wrappers", ()), ("envs", ("envs",)), ("train", ("train",))):
        for path in (ROOT / folder).rglob("*.py"):
            yield ".".join([*inside, *path.relative_to(ROOT / folder).with_suffix("").parts]), path


PATHS = dict(sources())
IMPORTS = {module: set(imports(path, module)) for module, path in PATHS.items()}
PLACES = {module.partition(".")[0] for module in PATHS}


def place(name):
    """The folder or single module that an import is of; a public name is the package's own."""
    first = name.removeprefix("safe_wrappers").lstrip(".").partition(".")[0]
    return first if first in PLACES else "__init__"


@pytest.mark.parametrize("module", PATHS)
def test_no_arrow_points_back_up_and_heavy_libraries_stay_in_their_layers(module):
    own = module.partition(".")[0]
    floor = next(number for number, names in enumerate(FLOORS) if own in names)
    used = {place(name) for name in IMPORTS[module] if name.partition(".")[0] == "safe_wrappers"}
    assert used <= {own}.union(*FLOORS[:floor])
    roots = {name.partition(".")[0] for name in IMPORTS[module]}
    assert not roots & FORBIDDEN.get(own, LEARNERS)


# The appendix's systems: every row's formulas are used by what it says --------------------------------------------

PAGE = (ROOT / "docs" / "systems.md").read_text()
ROWS = [re.split(r"\s*\|\s*", line.strip("| \n")) for line in PAGE.splitlines() if re.match(r"\| S\d", line)]
GRAPH = {
    module: {name.removeprefix("safe_wrappers.") for one in found for name in (one, one.rpartition(".")[0])}
    for module, found in IMPORTS.items()
}
"""Module -> what it imports, and of `from module import name` the module."""


def reached(start):
    """All modules that a module imports, directly or not; packages only re-export, and are not followed."""
    seen, left = set(), [start]
    while left:
        new = (GRAPH[left.pop()] & GRAPH.keys()) - seen
        seen |= new
        left += new
    return seen


def test_the_formulas_of_every_system_are_used_by_what_the_table_says():
    assert [row[0] for row in ROWS] == [f"S{number}" for number in range(1, 27)]
    for row in ROWS:
        (formulas,), (user,) = (re.findall(r"`([\w.]+)`", cell) for cell in row[2:4])
        assert formulas.startswith(("control.", "filter.")) and not user.startswith("control.")
        assert formulas in GRAPH and formulas in reached(user), row


def test_no_module_of_control_is_on_the_shelf():
    files = {name for name in GRAPH if name.startswith("control.") and not name.endswith("__init__")}
    used = set().union(*(reached(name) for name in GRAPH if not name.startswith("control.")))
    assert files <= used, files - used
