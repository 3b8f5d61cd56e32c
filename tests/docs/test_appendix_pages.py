"""The pages of the appendix: every worked number of the text stands there beside one that the page's code prints."""

import ast
import importlib
import re
import runpy
from functools import reduce
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
DOCS = ROOT / "docs"
FOLDER = DOCS / "appendix"
PACKAGE = ROOT / "safe_wrappers"
BLOCKS = runpy.run_path(str(DOCS / "pages.py"))["blocks"]

WORKED = {
    "safety": [
        "relative degree 2",
        "relative degree 1",
        r"$(a_{\mathrm{brake}}/v)(\gamma h_k - v)$",
        r"$\dot h \ge 0$",
        "closed form",
        "clamped afterwards",
    ],
    "trajectories": [
        "6 × 6 system",
        r"2\,T^9",
        r"inverse of $\mathbf M_{33}$",
        "6 a_3 + 24 a_4 t + 60 a_5 t^2",
        "30 Hz",
        "1 kHz",
        "h_{00}(0) = 1",
        "h_{00}(1) = 0",
        "h'_{10}(0) = 1",
        "h'_{10}(1) = 0",
        "$C^1$ but not $C^2$",
        r"derivatives of $\alpha$ vanish",
        "1.875",
    ],
    "springs-and-sampling": [r"$\zeta < 0.05$", "$T_s/2$", "28.65°"],
    "reachability": [
        r"$\det(J J^\top) = 0$",
        r"$n \ge 6$",
        "tangential and centripetal",
        r"$d_{\mathrm{crit}} = v_{\max}^2 / a_{\max}$",
        r"$\tfrac14 a_{\max} \tau^2$",
        r"$v_{\max}(\tau - v_{\max}/a_{\max})$",
        r"$a_{\max}/j_{\max}$",
        "4 or 7 phases",
        "constant offset",
    ],
    "leases": ["5 intervals", r"$T_{\mathrm{lease}} \le 0$", "150 to 250 ms", "1 kHz"],
    "contact": [
        "$e$ from 0 to 1",
        "17.5 J",
        "15,000 N/m",
        "700 N",
        "ISO/TS 15066",
        "20 to 50 ms",
        r"$a_{\mathrm{brake}} = 0$",
        r"later than $t_{\mathrm{peak}}$",
    ],
    "wheels": [
        r"$\lambda = 0$",
        r"$\lambda = 1$",
        r"$\lambda = -1$",
        r"$\lambda \in [-1, 1]$",
        "0.10 to 0.15",
        "slope is negative",
    ],
    "covariance": [
        "bounded, linear, polynomial or exponential",
        r"$\Phi = I + A t$",
        "1/3, 1/2 and 1",
        "$t^2$ and $t^3/3$",
        "cubic term dominates",
        "rank $n$",
        "$n - 1$",
    ],
    "centroidal": [
        "6 coordinates",
        r"$J_k \in \mathbb R^{3 \times (n+6)}$",
        "both momentum equations",
        "three conditions",
    ],
    "whole-body": ["1 ms"],
    "passivity": [
        "$V(0)$",
        r"$-\omega\tau_d$",
        "90°",
        r"\tfrac12",
        r"\sqrt{2b}",
        "in flight",
        "lost packets",
    ],
}
"""Page -> what the text puts a number on, read from it and written as in the first column of the page's table.

The text works few numbers with units; factors, ranks, ranges and counts that code can confirm are in the list, too.
"""


def text_of(page):
    return (FOLDER / f"{page}.md").read_text(encoding="utf-8")


def section(page, heading):
    """What stands below a heading, until the next one."""
    return re.search(rf"^## {heading}\n(.*?)(?=^## |\Z)", text_of(page), re.MULTILINE | re.DOTALL)[1]


def rows(page):
    """The rows of the table of numbers: what the text says, and what stands in backticks beside it."""
    table = [line for line in section(page, "The text's numbers").splitlines() if line.startswith("|")][2:]
    cells = [re.split(r"(?<!\\) \| ", line.strip("| ")) for line in table]
    return [(said, re.findall(r"`([^`]+)`", ours)) for said, ours in cells]


def printed(page):
    return "".join(block.output for block in BLOCKS(f"appendix/{page}.md"))


def test_every_section_has_its_page_and_every_page_its_numbers():
    pages = {path.stem for path in FOLDER.glob("*.md")} - {"index"}
    assert pages == WORKED.keys()
    contents = re.search(r"```\{toctree\}\n:hidden:\n(.*?)```", text_of("index"), re.DOTALL)[1].split()
    assert sorted(contents) == sorted(pages)


@pytest.mark.parametrize("page", WORKED)
def test_every_worked_number_of_the_text_stands_beside_one_that_the_page_prints(page):
    table = rows(page)
    for number in WORKED[page]:
        assert sum(number in said for said, _ in table) == 1, number
    for said, ours in table:
        assert any(number in said for number in WORKED[page]), f"not in the list: {said}"
        assert ours, f"nothing of ours beside: {said}"
        assert [one for one in ours if one not in printed(page)] == []


@pytest.mark.parametrize("page", WORKED)
def test_what_is_said_not_to_be_consistent_has_numbers_of_the_page(page):
    told = section(page, "Where the text is not consistent")
    assert told.lstrip().startswith("* **")
    shown = text_of(page).replace(told, "")
    assert [number for number in re.findall(r"\d+\.\d+", told) if number not in shown] == []


MODULES = [
    ".".join(path.relative_to(PACKAGE).with_suffix("").parts)
    for path in sorted((PACKAGE / "control").rglob("*.py"))
    if path.stem != "__init__"
]
ALL = "".join(path.read_text(encoding="utf-8") for path in FOLDER.glob("*.md"))


def test_every_module_of_control_is_named():
    assert [name for name in MODULES if not re.search(rf"\b{re.escape(name)}\b", ALL)] == []


def resolved(name):
    """The thing behind a dotted name, module or attribute."""
    parts = name.split(".")
    for end in range(len(parts), 0, -1):
        try:
            module = importlib.import_module(".".join(parts[:end]))
        except ModuleNotFoundError:
            continue
        return reduce(getattr, parts[end:], module)
    raise ModuleNotFoundError(name)


@pytest.mark.parametrize("page", [*WORKED, "index"])
def test_every_role_names_something_that_can_be_imported(page):
    text = text_of(page)
    roles = re.findall(r"\{(?:func|class|mod)\}`~?([\w.]+)`", text)
    plain = re.findall(r"(?<!\})`((?:control|plants)\.[\w.]+)`", text)
    assert roles or plain
    for name in [*roles, *(f"safe_wrappers.{name}" for name in plain)]:
        resolved(name)


@pytest.fixture(scope="module")
def identifiers():
    """Everything in the package that has a name: modules, classes, functions, arguments, attributes."""
    found = {"safe_wrappers"}
    for path in PACKAGE.rglob("*.py"):
        found.update(path.relative_to(PACKAGE).with_suffix("").parts)
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            for name in ("id", "name", "arg", "attr"):
                value = getattr(node, name, None)
                if isinstance(value, str):
                    found.add(value)
    return found


@pytest.mark.parametrize("page", WORKED)
def test_every_name_in_backticks_is_one_of_the_library(page, identifiers):
    prose = re.sub(r"^```.*?^```", "", text_of(page), flags=re.MULTILINE | re.DOTALL)
    prose = prose.replace(section(page, "The text's numbers"), "")
    names = re.findall(r"(?<!\})`([A-Za-z_][\w.]*)`", prose)
    assert [name for name in names if not identifiers.issuperset(name.split("."))] == []
