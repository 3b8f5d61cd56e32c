"""MuJoCo's enums are compared as integers: from 3.12 on `enum == numpy.int32(...)` is False, and `in` asks so."""

import ast
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
FILES = [
    path for folder in ("safe_wrappers", "envs", "train") for path in sorted((ROOT / folder).rglob("*.py"))
]


def bare(node):
    """The members `mjtKind.mjNAME` below a node that nothing (an `int`) is called with."""
    if isinstance(node, ast.Call):
        return
    if (
        isinstance(node, ast.Attribute)
        and isinstance(node.value, ast.Attribute)
        and node.value.attr.startswith("mjt")
    ):
        yield node
    for child in ast.iter_child_nodes(node):
        yield from bare(child)


def compared(tree):
    """The members that are compared as they are, or kept in a set or tuple to be searched in."""
    kept = [node.value for node in ast.walk(tree) if isinstance(node, ast.Assign)]
    kept = [node for node in kept if isinstance(node, ast.Set | ast.Tuple)]
    for node in [*kept, *(n for n in ast.walk(tree) if isinstance(n, ast.Compare))]:
        yield from bare(node)


@pytest.mark.parametrize(
    "code",
    [
        "found = m.jnt_type[j] in (mujoco.mjtJoint.mjJNT_FREE, mujoco.mjtJoint.mjJNT_BALL)",
        "assert mujoco.mjtTrn.mjTRN_SITE == m.actuator_trntype[0]",
        "KINDS = {mujoco.mjtTrn.mjTRN_SITE}",
        "def scalar(m):\n    kinds = (mujoco.mjtJoint.mjJNT_HINGE,)\n    return m.jnt_type[0] in kinds",
    ],
)
def test_what_is_looked_for_is_found(code):
    assert list(compared(ast.parse(code)))


def test_no_enum_is_compared_as_it_is():
    assert len(FILES) > 100
    found = {
        f"{path.relative_to(ROOT)}:{member.lineno}: {ast.unparse(member)}"
        for path in FILES
        for member in compared(ast.parse(path.read_text()))
    }
    assert not found, "write int(...) around"
