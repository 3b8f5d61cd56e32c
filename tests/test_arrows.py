"""The floors of the library, by its imports; and the appendix's systems, whose formulas are used as the page says."""

import ast
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
FOLDERS = ("control", "plants", "filter", "constraints", "wrappers", "sb3")
LAYERS = {name: ROOT / "safe_wrappers" / name for name in FOLDERS} | {
    name: ROOT / name for name in ("envs", "train")
}
FLOORS = (
    {"errors", "info"},
    {"control"},
    {"plants", "envs"},
    {"filter"},
    {"constraints"},
    {"wrappers", "sb3"},
    {"diagnosis"},
    {"", "train"},
)
"""Folders and single modules, from the lowest floor up, "" the package itself; each uses itself and lower floors."""
LEARNERS = {"torch", "stable_baselines3"}
SIMULATORS = {"gymnasium", "mujoco"}
FORBIDDEN = {"control": LEARNERS | SIMULATORS, "filter": LEARNERS | SIMULATORS, "sb3": set(), "train": set()}
"""By layer; elsewhere the learners."""
IN_A_FUNCTION = {"models.py": {"torch"}}
"""What a module imports only where it is asked to fit; the test of the wheel says that importing us does not."""


def modules(layer):
    return sorted(LAYERS[layer].rglob("*.py"))


def imports(path, package):
    """Absolute dotted names of everything a module imports, inside functions too."""
    found = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            base = node.module or ""
            if node.level:
                above = package.split(".")[: len(package.split(".")) - node.level + 1]
                base = ".".join([*above, base]).rstrip(".")
            found |= {f"{base}.{alias.name}" for alias in node.names}
    return found


def dotted(layer, path):
    single = path.parent == ROOT / "safe_wrappers"
    inside = [] if single else [layer, *path.relative_to(LAYERS[layer]).parent.parts]
    return ".".join(["safe_wrappers", *inside])


def used(layer, path):
    """The folders and single modules that a module imports; "" is a public name of the package itself."""
    found = set()
    for name in imports(path, dotted(layer, path) if layer in LAYERS else "safe_wrappers"):
        top, _, rest = name.partition(".")
        if top == "safe_wrappers":
            second = rest.split(".")[0]
            known = second in LAYERS or (ROOT / "safe_wrappers" / f"{second}.py").exists()
            found.add(second if known else "")
    return found


@pytest.mark.parametrize("floor", range(len(FLOORS)))
def test_no_arrow_points_back_up(floor):
    below = set().union(*FLOORS[:floor])
    for layer in FLOORS[floor]:
        single = ROOT / "safe_wrappers" / f"{layer or '__init__'}.py"
        paths = modules(layer) if layer in LAYERS else [single]
        assert paths, f"{layer} has no modules: the test looks in the wrong place"
        for path in paths:
            wrong = used(layer, path) - below - {layer}
            assert not wrong, f"{path.relative_to(ROOT)} imports {sorted(wrong)}"


@pytest.mark.parametrize("layer", LAYERS)
def test_heavy_libraries_stay_in_their_layers(layer):
    lowest = [ROOT / "safe_wrappers" / f"{name}.py" for name in FLOORS[0]]  # which control stands on
    for path in [*modules(layer), *(lowest if layer == "control" else [])]:
        roots = {name.split(".")[0] for name in imports(path, dotted(layer, path))}
        wrong = roots & FORBIDDEN.get(layer, LEARNERS) - IN_A_FUNCTION.get(path.name, set())
        assert not wrong, f"{path.relative_to(ROOT)} imports {sorted(wrong)}"


def test_every_folder_and_module_of_the_library_is_on_one_floor():
    inside = (ROOT / "safe_wrappers").iterdir()
    names = {p.stem for p in inside if p.suffix == ".py" or (p.is_dir() and any(p.glob("*.py")))}
    placed = [layer or "__init__" for floor in FLOORS for layer in floor]
    assert sorted(placed) == sorted(names | {"envs", "train"})


# The appendix's systems: every row's formulas are used by what it says --------------------------------------------

PAGE = (ROOT / "docs" / "systems.md").read_text()
ROWS = [re.split(r"\s*\|\s*", line.strip("| \n")) for line in PAGE.splitlines() if re.match(r"\| S\d", line)]


def modules_by_import():
    """Module -> the modules of the package that it imports, without the package's name."""
    package, graph = ROOT / "safe_wrappers", {}
    for path in package.rglob("*.py"):
        parts = path.relative_to(package).with_suffix("").parts
        found = imports(path, ".".join(["safe_wrappers", *parts[:-1]]))
        found |= {name.rpartition(".")[0] for name in found}  # of `from module import name`
        graph[".".join(parts)] = {one.removeprefix("safe_wrappers.") for one in found}
    return graph


GRAPH = modules_by_import()


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
    used = set().union(*(reached(name) for name in GRAPH if not name.startswith("control.")))
    files = {name for name in GRAPH if name.startswith("control.") and not name.endswith("__init__")}
    assert files <= used, files - used
