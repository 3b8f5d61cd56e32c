"""The translation for Warp, where Warp itself need not be: it fits the source as it is."""

import ast

import pytest

from benchmarks.warp_source import CONSTANTS, ROOTS, TABLES, Translator


def exchanged(a: float, b: float) -> float:
    a, b = b, a
    return a - b


@pytest.mark.parametrize("real", CONSTANTS)
def test_the_whole_decision_is_translated(real):
    tree = ast.parse(Translator(TABLES, CONSTANTS[real]).translate(ROOTS))
    functions = {node.name for node in tree.body if isinstance(node, ast.FunctionDef)}
    assert {"predict", "stopping_path", "look", "rows", "project_in_plane", "_decide"} <= functions
    assert {root.__name__ for root in ROOTS} <= functions
    assert "np." not in ast.unparse(tree)
    loops = [ast.unparse(node.iter) for node in ast.walk(tree) if isinstance(node, ast.For)]
    assert all(loop.startswith("range(") for loop in loops)


def difference(a: float, b: float) -> float:
    return a - b


@pytest.mark.parametrize(
    ("function", "constants", "said"),
    [(exchanged, {}, "no rule"), (difference, {"SLACK": 1.0}, "not in the source.*SLACK")],
)
def test_what_no_rule_covers_and_what_the_source_does_not_have_is_refused(function, constants, said):
    with pytest.raises(ValueError, match=said):
        Translator(frozenset(), constants).translate([function])
